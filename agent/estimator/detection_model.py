"""What does a detection tell, how noisy is it, and when is there one? (the paper, Sec. IV-B.2 and VI-A.2)

    h_j = Rz(psi_s)^T (p_common_body of j - p_common_body of station s)

Range noise grows with distance and is far larger than what the bearing noise makes across the line of sight, so the
covariance is anisotropic. Everything is kept in *levelled axes*: the common axes, into which a detection is turned by
the station's estimated yaw; there H is constant but for the station's yaw.
"""

import numpy as np
import numpy.typing as npt

from agent.interface.frames import Array, direction, range_and_bearing, rotate_z
from agent.interface.sensors import Detector


def cartesian(spherical: Array) -> Array:
    """Detections (M, 3) [range m, azimuth rad, elevation rad] as vectors (M, 3) in m."""
    return spherical[:, :1] * direction(spherical[:, 1], spherical[:, 2])


def noise_covariance(detector: Detector, lines: Array) -> Array:
    """R (..., 3, 3) in m^2 of detections of targets at lines of sight (..., 3) in m, in the axes of the lines.

    R = sigma_d^2 u u^T + (d sigma_b)^2 (I - u u^T), at the predicted distance d.
    """
    square = (lines * lines).sum(-1)
    square = np.where(square > 0, square, 1.0)
    distance = np.sqrt(square)
    across = (detector.bearing_sigma_rad**2) * square
    along = detector.range_sigma_m(distance) ** 2
    scaled = lines * ((along - across) / square)[..., None]
    R = scaled[..., :, None] * lines[..., None, :]
    R += across[..., None, None] * np.eye(3)
    return R


def detection_probability(detector: Detector, lines: Array, station_yaw: Array) -> npt.NDArray[np.float64]:
    """P_D of targets at lines of sight (..., 3) m in common axes, for stations with these yaws (...) rad.

    Zero outside the field of view and beyond the range. A station's roll and pitch are left out: peers do not send
    theirs.
    """
    if detector.sees_all_around:
        return np.where(np.vecdot(lines, lines) <= detector.max_range_m**2, detector.P_D, 0.0)
    spherical = range_and_bearing(rotate_z(-station_yaw, lines))
    return np.where(detector.in_view(spherical), detector.P_D, 0.0)
