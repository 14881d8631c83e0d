"""Where are the detected MAVs, in the gravity-aligned body frame?"""

from agent.interface import messages
from agent.interface.frames import Array, direction, range_and_bearing


def levelled(message: messages.Sightings, tilt: Array) -> Array:
    """(M, 3) range m, azimuth rad, elevation rad, as the camera's set looks without the body's roll and pitch.

    Args:
        message: the set in the body frame.
        tilt: (3, 3) R_level_body at its time.
    """
    spherical = messages.read_spherical(message.spherical)
    turned = range_and_bearing(direction(spherical[:, 1], spherical[:, 2]) @ tilt.T)
    turned[:, 0] = spherical[:, 0]
    return turned
