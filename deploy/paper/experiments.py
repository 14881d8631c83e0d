"""Which of the paper's experiments are reproduced, and what does it say of each? (Sec. VI)

Its plots are not available: what stands here is what it prints in words or numbers.
"""

from typing import NamedTuple


class PaperExperiment(NamedTuple):
    experiment: str  # bundled name
    figure: str
    what: str
    reported: str


SEEDS = range(10)
RUN_1 = PaperExperiment(
    "paper_run_1",
    "absolute and relative state errors (run 1)",
    "circle of 1.35 m → 2.7 m → 1.35 m → 2.7 m → 1.35 m, along predefined paths",
    "“our state estimation converges very fast and matches the naïve method in the absolute state error while performs"
    " better in the relative state error”",
)
SEQUENCES = tuple(
    PaperExperiment(
        f"sequence_{letter}_scripted",
        f"configuration change ({letter})",
        what,
        "“our method's superior performance in other three experiments in relative state errors. Absolute state errors"
        " are omitted since both methods perform similarly”",
    )
    for letter, what in (
        ("a", "circle of 1.35 m → v → line of 12 m → circle of 1.35 m → line of 6 m"),
        ("b", "line of 6 m → line of 12 m → v → line of 6 m"),
        ("c", "line of 6 m → circle of 1.35 m → circle of 2.7 m → line of 12 m → line of 6 m"),
    )
)
LINE = PaperExperiment(
    "formation_line",
    "configuration change (d)",
    "take-off and a line of 6 m, planned and flown on board from the estimate",
    "“the error converges to 0 illustrating that our controller is able to converge to the desire state”",
)
FLIGHTS = (RUN_1, *SEQUENCES, LINE)

SENSOR_REPORTED = "bearing: σ = 0.008 rad; distance: σ = 0.0495 d + 0.0336 m"
COST_REPORTED = "“starting from 1.29 times with 3 robots to 12.6 times for 9 robots”"
COST_TIMES = {3: 1.29, 9: 12.6}  # what gating and hypothesis evaluation save there, by the number of robots
