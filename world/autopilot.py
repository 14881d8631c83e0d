"""What must the rotors do for a MAV to follow its setpoint?

Geometric control in the manner of Lee, Leok and McClamroch (2010), in two loops as on a real autopilot. The outer one
(`aim`, at 50 Hz) turns position and velocity errors into the push that is wanted, and that into a thrust and an
attitude. Both are held while the inner one (`commands`, at every step of the physics, 200 Hz or more) turns the MAV to
that attitude: torques from the attitude error and the rates, then what each rotor shall push.
"""

import numpy as np

from agent.interface.frames import Array, wrap
from world.physics import GRAVITY_M_S2, ROTORS, Airframe, State
from world.poses import CONJUGATE, UNIT_PRODUCTS, multiply, rotations
from world.scenario import Setpoints

AIM_PERIOD_S = 0.02  # of the outer loop, at most
POSITION_GAIN = 9.0  # 1/s^2
VELOCITY_GAIN = 5.0  # 1/s
ATTITUDE_GAIN = 240.0  # 1/s^2
RATE_GAIN = 26.0  # 1/s; the rotors' lag of 0.03 s bounds it: stable while 0.03 * ATTITUDE_GAIN < RATE_GAIN
MAX_SIDEWAYS_M_S2 = 8.0  # per axis: tilts of up to 49 deg
VERTICAL_M_S2 = (3.0, 18.0)  # thrust per mass: never upside down, never above 1.8 times the weight
MAX_YAW_ERROR_RAD = 0.3  # acted upon at once: yaw has little torque, roll and pitch must not wait for it


class Autopilot:
    """Flies N like MAVs at once.

    The attitude error is 2 sin of half the angle about the body's axes, which is the angle when small and bounded when
    not: twice the vector part of the quaternion that leads from the attitude to the wanted one. With the wanted one
    held that is linear in the attitude. So the outer loop leaves one matrix per MAV, which the inner one applies.
    """

    def __init__(self, airframe: Airframe, mavs: int, max_yaw_error_rad: float = MAX_YAW_ERROR_RAD) -> None:
        """max_yaw_error_rad: acted upon at once. Small where turns are asked for: much of it leaves roll and pitch no
        thrust."""
        self._max_yaw_error_rad = max_yaw_error_rad
        self._airframe = airframe
        thrust_per_wrench = np.linalg.inv(airframe.wrench_per_thrust)
        self._thrust_per_push = thrust_per_wrench[:, 0] * airframe.mass_kg  # (4,) N per m/s^2
        thrust_per_turn = thrust_per_wrench[:, 1:] * airframe.inertia  # (4, 3) N per rad/s^2
        # The error is 2 vec(q* q_wanted): a sum over the entries a of q and b of q_wanted.
        error = 2 * np.einsum("abi,a->iab", UNIT_PRODUCTS[..., :3], CONJUGATE)
        gains = ATTITUDE_GAIN * np.einsum("ri,iab->bra", thrust_per_turn, error)
        self._gains_per_attitude = gains[..., [3, 0, 1, 2]].reshape(4, 16)  # from q_wanted to [rotor, q's w x y z]
        self._reading = np.ones((mavs, 8, 1))  # attitude w x y z, rates x y z rad/s, 1
        self._attitude, self._rates = self._reading[:, :4, 0], self._reading[:, 4:7, 0]
        self._gains = np.empty((mavs, ROTORS, 8))  # from the reading to the rotors, N
        self._gains[:, :, 4:7] = -RATE_GAIN * thrust_per_turn
        self._asked = np.empty((mavs, ROTORS, 1))
        self._thrusts = self._asked[:, :, 0]

    def aim(self, state: State, wanted: Setpoints) -> None:
        """The outer loop: the thrust and the attitude that are held until the next call."""
        push = POSITION_GAIN * (wanted.position - state.position)
        push += VELOCITY_GAIN * (wanted.velocity - state.velocity)
        push += wanted.acceleration
        push += _WEIGHT
        np.minimum(np.maximum(push, _LEAST, out=push), _MOST, out=push)
        attitude = state.quaternion_wxyz.take(_XYZW, axis=1)
        rotation = rotations(attitude)
        push_body = (push[:, None] @ rotation)[:, 0]  # R^T push
        wanted_attitude = multiply(attitude, _turn(push_body, rotation, wanted.yaw, self._max_yaw_error_rad))
        self._gains[:, :, :4] = (wanted_attitude @ self._gains_per_attitude).reshape(-1, ROTORS, 4)
        self._gains[:, :, 7] = push_body[:, 2:] * self._thrust_per_push

    def commands(self, state: State) -> Array:
        """The inner loop: (N, 4) thrusts asked of the rotors, N, overwritten by the next call."""
        self._attitude[:], self._rates[:] = state.quaternion_wxyz, state.rates
        np.matmul(self._gains, self._reading, out=self._asked)
        np.maximum(self._thrusts, 0.0, out=self._thrusts)
        return np.minimum(self._thrusts, self._airframe.max_thrust_n, out=self._thrusts)


def _turn(push_body: Array, rotation: Array, yaw: Array, most: float) -> Array:
    """Quaternions (N, 4) x y z w of the turn, in the body's frame, that brings its z axis onto the wanted push by the
    shortest way, then its x axis to the wanted yaw, or as far towards it as is allowed, rad."""
    x, y, z = push_body.T
    strength = np.sqrt(np.vecdot(push_body, push_body))
    cosine = np.sqrt(np.maximum(0.5 + 0.5 * z / strength, 5e-4))  # of half the tilt
    twice = 2 * strength * cosine
    yaw_error = wrap(yaw - np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]))
    half = 0.5 * np.minimum(np.maximum(yaw_error, -most), most)
    c, s = np.cos(half), np.sin(half)
    turn = np.empty((len(push_body), 4))
    turn[:, 0] = (x * s - y * c) / twice
    turn[:, 1] = (x * c + y * s) / twice
    turn[:, 2], turn[:, 3] = cosine * s, cosine * c
    return turn


_XYZW = np.array([1, 2, 3, 0])
_WEIGHT = np.array([0.0, 0.0, GRAVITY_M_S2])
_LEAST = np.array([-MAX_SIDEWAYS_M_S2, -MAX_SIDEWAYS_M_S2, VERTICAL_M_S2[0]])
_MOST = np.array([MAX_SIDEWAYS_M_S2, MAX_SIDEWAYS_M_S2, VERTICAL_M_S2[1]])
