"""Where do we depart from the paper, and why? Each row with the file that does it."""

from typing import NamedTuple


class Deviation(NamedTuple):
    paper: str  # what it says
    here: str  # what is done
    why: str
    code: str  # the file, from the root of the repository


DEVIATIONS = (
    Deviation(
        "the initial configuration is unknown; how the filter finds it is left open",
        "agents begin from nothing, register each other, and say `ambiguous` where it cannot be known",
        "from 2 m and 1 rad of uncertainty the filter alone settles on wrong identities",
        "agent/registration/registrar.py",
    ),
    Deviation(
        "one filter for the team, in the frame of robot 1",
        "every agent runs the coupled filter itself, with itself as station, on what reaches it",
        "no robot may be indispensable",
        "agent/agent.py",
    ),
    Deviation(
        "7N numbers of state",
        "8 per robot (3 + 1 + 3 + 1), and where the station's odometry began",
        "a slip; the latter makes absolute poses profit from everybody's odometry",
        "agent/estimator/state.py",
    ),
    Deviation(
        "diagonal process noise",
        "a drifting frame turns about its body, and the station's own drift moves everybody at once",
        "with a diagonal Q the filter is overconfident, the more the further away the others are",
        "agent/estimator/prediction.py",
    ),
    Deviation(
        "sigma points over the whole state",
        "exact moments over the poses that a detection depends on, for Gaussian yaws; linear once those are known",
        "sigma points over 8N entries lie √(8N) standard deviations out, and their yaws wrap",
        "agent/estimator/moments.py",
    ),
    Deviation(
        "noise of range and bearing, no word of their covariance in space",
        "5 % of the range along the line of sight, below 1 % across it",
        "an isotropic covariance would give most of the information away",
        "agent/estimator/detection_model.py",
    ),
    Deviation(
        "F = exp(μᵀS⁻¹μ) / √((2π)^D det S)",
        "exp(−½ μᵀS⁻¹μ) / √((2π)^(3D) det S)",
        "a slip: μ is 3D-dimensional, and a Gaussian falls",
        "agent/estimator/cpdaf.py",
    ),
    Deviation(
        "clutter exponent L − D; C(L, D)² hypotheses",
        "M − D; C(L, D) C(M, D)",
        "slips: what is not associated is clutter, of M detections",
        "agent/estimator/cpdaf.py",
    ),
    Deviation(
        "K(φ) = (Φ P_zx)ᵀ P_zz⁻¹",
        "(Φ P_zx)ᵀ S(φ)⁻¹, and the spread term in closed form",
        "a slip: only what is detected is inverted; the printed brackets do not close",
        "agent/estimator/cpdaf.py",
    ),
    Deviation(
        "a hypothesis tree, visited depth first",
        "what is unambiguous is one Kalman block; the rest is grown best first, with a bound on what is left out",
        "the tree of nine robots has 1.4 million leaves",
        "agent/estimator/hypotheses.py",
    ),
    Deviation(
        "station by station",
        "all unambiguous sets of a tick at once, the others station by station",
        "a fifth of the cost; gates are laid at the tick's prior",
        "agent/estimator/joint_update.py",
    ),
    Deviation(
        "robots controlled from one place along predefined paths, in ROS",
        "the same paths, with a take-off to different heights before them",
        "a regular circle or line looks the same from more than one place: nobody can tell who is who",
        "deploy/experiments/paper_run_1.toml",
    ),
    Deviation(
        "an open-loop controller: planned once from the first estimate",
        "every agent plans for itself, and anew when its estimate has moved; once, by `replan_beyond_m = inf`",
        "the paper's own future work",
        "agent/controller/pilot.py",
    ),
)
