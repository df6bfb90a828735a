"""Columns of a sample, one row of numbers for sensor, estimators and logs.

    [measured wrench (6) | specific force (3) | angular velocity (3) | angular acceleration (3) |
     saturated or lost | joint positions (n) | time]

Logs use the first 15. Only the output of the wrist sensor contains the time. SI, at So in S.
"""

from __future__ import annotations

WRENCH = slice(0, 6)
SPECIFIC_FORCE = slice(6, 9)
ANGULAR_VELOCITY = slice(9, 12)
ANGULAR_ACCELERATION = slice(12, 15)
MOTION = slice(6, 15)  #: specific force, angular velocity and angular acceleration of S
WRENCH_AND_MOTION = slice(0, 15)
SATURATED = 15  #: above 0.5 the wrench is not valid
#: At this value of SATURATED and above, the reading was lost or impossible: the sample is an old
#: one. The excess counts the samples with remaining effects.
LOST = 2.0
BEFORE_JOINTS = 16
JOINT_POSITION = slice(BEFORE_JOINTS, None)
TIME = -1  #: [s], only in the output of the wrist sensor
#: Motion from a second source, only for `drake_teleop.load.online.instrumental`.
INSTRUMENTS = slice(15, 24)


def sample_parts(num_joints: int) -> dict[str, int]:
    """Return the parts of a wrist sensor's sample: signal name -> size."""
    return {
        "measured_wrench_S": 6,
        "specific_force_S": 3,
        "angular_velocity_S": 3,
        "angular_acceleration_S": 3,
        "saturated": 1,
        "joint_position": num_joints,
    }


def sample_size(num_joints: int) -> int:
    """Return the length of a wrist sensor's sample without its time."""
    return BEFORE_JOINTS + num_joints
