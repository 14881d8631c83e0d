"""The paper's experiments, reproduced: flown, drawn and laid beside what it reports."""
