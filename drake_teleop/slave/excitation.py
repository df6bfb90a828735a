"""What the design of an excitation trajectory needs to know about this arm."""

from __future__ import annotations

import numpy as np
from numba import njit

from drake_teleop.load.excitation import Array, ExcitationLimits, SensorMotion
from drake_teleop.slave.arm import MOTION_SIZE, ArmModel, sensor_motion

# Of the range in the model; the rest is for tracking errors.
_JOINT_SHARE = 0.8
# The tool's heaviest relative: its parameters this much larger (a grasped object of 0.8 kg).
_LOAD_FACTOR = 1.3
# Below the 200 N and 12 N m of the JR3's weakest axes.
_FORCE, _TORQUE = 180.0, 10.0
# The wrist's centre and the ball tip, and where both may be: in front of the arm, above the floor.
_POINTS_S = ((0.0, 0.0, -0.085), (0.0, 0.0, 0.2))
_BOX_W = ((0.25, -0.7, 0.1), (1.05, 0.7, 1.3))


def sensor_motion_of(arm: ArmModel) -> SensorMotion:
    """The arm's motion of S along whole trajectories, as `design_excitation` wants it."""

    def motion(q: Array, qd: Array, qdd: Array) -> tuple[Array, Array, Array, Array, Array]:
        out = np.empty((len(q), MOTION_SIZE))
        _sensor_motions(arm.table, q, qd, qdd, out)
        return out[:, :3], out[:, 3:6], out[:, 6:9], out[:, 9:12], out[:, 12:].reshape(-1, 3, 3)

    return motion


def excitation_limits(arm: ArmModel) -> ExcitationLimits:
    """80 % of the joints' ranges and speeds, the sensor's range, the room in front of the arm.

    The wrench is predicted for the arm's own load, made 30 % heavier.
    """
    middle, half = (arm.upper + arm.lower) / 2, (arm.upper - arm.lower) / 2
    return ExcitationLimits(
        q_lower=middle - _JOINT_SHARE * half,
        q_upper=middle + _JOINT_SHARE * half,
        velocity=_JOINT_SHARE * arm.velocity_limit,
        acceleration=arm.acceleration_limit,
        phi=_LOAD_FACTOR * arm.phi_load,
        force=_FORCE,
        torque=_TORQUE,
        points_S=np.array(_POINTS_S),
        box_W=np.array(_BOX_W),
    )


@njit(cache=True)
def _sensor_motions(table: Array, q: Array, qd: Array, qdd: Array, out: Array) -> None:
    for i in range(len(q)):
        sensor_motion(table, q[i], qd[i], qdd[i], out[i])
