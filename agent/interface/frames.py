"""What is a frame here, and how does a vector get from one to another?

Every frame is gravity-aligned (z up): frames differ by a position and a yaw. Names read
`quantity_frame_target`: "the quantity of target, expressed in frame". The frames are `world` (truth only),
`odom` (where a MAV's odometry began, f_i in the paper), `common` (the odometry frame of the agent that
estimates) and `body` (a MAV, roll and pitch taken out).
"""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def wrap(angle: Array | float) -> Array:
    """Angles in rad, any shape, wrapped to [-pi, pi)."""
    return np.asarray((np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi)


def rotate_z(yaw: Array | float, vectors: Array) -> Array:
    """Rz(yaw) @ v for vectors (..., 3) and yaws in rad that broadcast against (...)."""
    c, s = np.cos(yaw), np.sin(yaw)
    x, y = vectors[..., 0], vectors[..., 1]
    turned_x = c * x - s * y
    turned = np.empty((*turned_x.shape, 3))
    turned[..., 0], turned[..., 1], turned[..., 2] = turned_x, s * x + c * y, vectors[..., 2]
    return turned


def yaw_of(quaternion: Array) -> Array:
    """Yaw in rad of quaternions x y z w (..., 4)."""
    x, y, z, w = (quaternion[..., k] for k in range(4))
    return np.asarray(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))


def rotation_matrix(quaternion: Array) -> Array:
    """Rotation matrices (..., 3, 3) of unit quaternions x y z w (..., 4)."""
    single = quaternion.ndim == 1  # plain floats are ten times faster than arrays of one
    x, y, z, w = quaternion.tolist() if single else (quaternion[..., k] for k in range(4))
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return matrix if single else np.moveaxis(matrix, (0, 1), (-2, -1))


def relative_pose(pose_frame_station: Array, pose_frame_target: Array) -> Array:
    """Poses (..., 4) [x y z yaw] of targets in the body frame of stations, both given in one frame."""
    p_station_target = rotate_z(-pose_frame_station[..., 3], pose_frame_target[..., :3] - pose_frame_station[..., :3])
    yaw = wrap(pose_frame_target[..., 3] - pose_frame_station[..., 3])
    return np.concatenate([p_station_target, yaw[..., None]], axis=-1)


def compose(pose_a_b: Array, pose_b_c: Array) -> Array:
    """Poses (..., 4) [x y z yaw] of c in a, from b in a and c in b."""
    p_a_c = pose_a_b[..., :3] + rotate_z(pose_a_b[..., 3], pose_b_c[..., :3])
    yaw = wrap(pose_a_b[..., 3] + pose_b_c[..., 3])
    return np.concatenate([p_a_c, yaw[..., None]], axis=-1)


def inverse(pose_a_b: Array) -> Array:
    """Poses (..., 4) [x y z yaw] of a in b, from b in a."""
    return relative_pose(pose_a_b, np.zeros(4))


def direction(azimuth: Array, elevation: Array) -> Array:
    """Unit vectors (..., 3) of bearings in rad: azimuth from x towards y, elevation up from the xy plane."""
    cos_elevation = np.cos(elevation)
    unit = np.empty((*cos_elevation.shape, 3))
    unit[..., 0], unit[..., 1] = cos_elevation * np.cos(azimuth), cos_elevation * np.sin(azimuth)
    unit[..., 2] = np.sin(elevation)
    return unit


def range_and_bearing(vectors: Array) -> Array:
    """Vectors (..., 3) in m as (..., 3) [range m, azimuth rad, elevation rad]."""
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    spherical = np.empty(vectors.shape)
    level = np.hypot(x, y)
    spherical[..., 0], spherical[..., 1], spherical[..., 2] = np.hypot(level, z), np.arctan2(y, x), np.arctan2(z, level)
    return spherical
