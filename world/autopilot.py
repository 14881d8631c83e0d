"""What must the rotors do for a MAV to follow its setpoint?

Geometric control in the manner of Lee, Leok and McClamroch (2010): the wanted push gives the attitude, its error gives
torques, thrust and torques give what each rotor shall push.
"""

import numpy as np

from agent.interface.frames import Array, wrap
from world.physics import GRAVITY_M_S2, ROTORS, Airframe, State
from world.scenario import Setpoints

POSITION_GAIN = 9.0  # 1/s^2
VELOCITY_GAIN = 5.0  # 1/s
ATTITUDE_GAIN = 240.0  # 1/s^2
RATE_GAIN = 26.0  # 1/s; the rotors' lag of 0.03 s bounds it: stable while 0.03 * ATTITUDE_GAIN < RATE_GAIN
MAX_SIDEWAYS_M_S2 = 8.0  # per axis: tilts of up to 49 deg
VERTICAL_M_S2 = (3.0, 18.0)  # thrust per mass: never upside down, never above 1.8 times the weight
MAX_YAW_ERROR_RAD = 0.3  # acted upon at once: yaw has little torque, roll and pitch must not wait for it


class Autopilot:
    """Flies N like MAVs at once. It has no memory: rotor commands follow from state and setpoints."""

    def __init__(self, airframe: Airframe) -> None:
        self._hover = airframe.mass_kg * GRAVITY_M_S2 / ROTORS
        self._airframe = airframe
        self._thrust_per_wrench = np.linalg.inv(airframe.wrench_per_thrust).T

    def commands(self, state: State, wanted: Setpoints) -> Array:
        """(N, 4) thrusts asked of the rotors, N."""
        push = POSITION_GAIN * (wanted.position - state.position)
        push += VELOCITY_GAIN * (wanted.velocity - state.velocity)
        push += wanted.acceleration
        push[:, 2] += GRAVITY_M_S2
        push = np.minimum(np.maximum(push, _LEAST), _MOST)
        rotation = _rotations(state.quaternion_wxyz)
        push_body = (push[:, None] @ rotation)[:, 0]  # R^T push
        wrench = np.empty((len(push), 4))
        wrench[:, 0] = self._airframe.mass_kg * push_body[:, 2]
        wrench[:, 1:] = ATTITUDE_GAIN * _attitude_error(push_body, rotation, wanted.yaw) - RATE_GAIN * state.rates
        wrench[:, 1:] *= self._airframe.inertia
        return np.minimum(np.maximum(wrench @ self._thrust_per_wrench, 0.0), self._airframe.max_thrust_n)


def _attitude_error(push_body: Array, rotation: Array, yaw: Array) -> Array:
    """(N, 3) rad: the turn, about the body's axes, that brings its z axis onto the wanted push and its x axis to the
    wanted yaw; 2 sin of half the angle, which is the angle when small and bounded when not."""
    strength = np.sqrt((push_body * push_body).sum(axis=1))
    half = np.sqrt(2 * strength * np.maximum(strength + push_body[:, 2], 1e-3 * strength))
    yaw_error = wrap(yaw - np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]))
    error = np.empty((len(push_body), 3))
    error[:, 0] = -2 * push_body[:, 1] / half
    error[:, 1] = 2 * push_body[:, 0] / half
    error[:, 2] = np.minimum(np.maximum(yaw_error, -MAX_YAW_ERROR_RAD), MAX_YAW_ERROR_RAD)
    return error


def _rotations(quaternion_wxyz: Array) -> Array:
    """(N, 3, 3) rotation matrices: each entry is a sum of products of two quaternion entries, so one product with a
    constant matrix gives them all."""
    products = (quaternion_wxyz[:, :, None] * quaternion_wxyz[:, None, :]).reshape(-1, 16)
    return (products @ _ENTRIES).reshape(-1, 3, 3)


_LEAST = np.array([-MAX_SIDEWAYS_M_S2, -MAX_SIDEWAYS_M_S2, VERTICAL_M_S2[0]])
_MOST = np.array([MAX_SIDEWAYS_M_S2, MAX_SIDEWAYS_M_S2, VERTICAL_M_S2[1]])


def _entries() -> Array:
    """(16, 9): from the products w w, w x, ... z z to the entries of a rotation matrix, row by row."""
    w, x, y, z = range(4)
    signed = (
        ((1, w, w), (1, x, x), (-1, y, y), (-1, z, z)), ((2, x, y), (-2, w, z)), ((2, x, z), (2, w, y)),
        ((2, x, y), (2, w, z)), ((1, w, w), (-1, x, x), (1, y, y), (-1, z, z)), ((2, y, z), (-2, w, x)),
        ((2, x, z), (-2, w, y)), ((2, y, z), (2, w, x)), ((1, w, w), (-1, x, x), (-1, y, y), (1, z, z)),
    )  # fmt: skip
    entries = np.zeros((16, 9))
    for entry, terms in enumerate(signed):
        for factor, a, b in terms:
            entries[4 * a + b, entry] = factor
    return entries


_ENTRIES = _entries()
