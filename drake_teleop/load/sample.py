"""Where what lies in a sample, one row of numbers: what the sensor tells, and the estimators use.

    [measured wrench (6) | specific force (3) | angular velocity (3) | angular acceleration (3) |
     whether a channel was saturated | joint angles (n) | when it was taken]

The first 15 numbers are also a sample of a log, and of the truth; the rest is the wrist sensor's.
The time stands in what leaves the sensor, and not while the sample is made.
Units and frame as everywhere: N, N m, m/s^2, rad/s, rad/s^2, at So in S; rad.
"""

from __future__ import annotations

WRENCH = slice(0, 6)
SPECIFIC_FORCE = slice(6, 9)
ANGULAR_VELOCITY = slice(9, 12)
ANGULAR_ACCELERATION = slice(12, 15)
MOTION = slice(6, 15)  #: of S: specific force, angular velocity, angular acceleration
WRENCH_AND_MOTION = slice(0, 15)
SATURATED = 15  #: above 0.5 the wrench is not to be trusted
#: From here on nothing is: there was no reading, or none that can be, and the sample is an old one.
#: What it is more counts the samples for which that still shows.
LOST = 2.0
BEFORE_JOINTS = 16
JOINT_POSITION = slice(BEFORE_JOINTS, None)
TIME = -1  #: of what leaves the wrist sensor [s]
#: In the place of what only the wrist sensor tells, `drake_teleop.load.online.instrumental` has the
#: motion a second time, from another sensor.
INSTRUMENTS = slice(15, 24)


def sample_parts(num_joints: int) -> dict[str, int]:
    """The parts of a wrist sensor's sample by the names of their signals, with their sizes."""
    return {
        "measured_wrench_S": 6,
        "specific_force_S": 3,
        "angular_velocity_S": 3,
        "angular_acceleration_S": 3,
        "saturated": 1,
        "joint_position": num_joints,
    }


def sample_size(num_joints: int) -> int:
    """How many numbers a wrist sensor's sample has, without its time."""
    return BEFORE_JOINTS + num_joints
