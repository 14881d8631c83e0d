"""The coupled probabilistic data association filter (the paper, Sec. V), one file per step."""
