"""Parameters of a haptic device for compiled code, and its end stops."""

from __future__ import annotations

from collections import namedtuple

import numpy as np

from drake_teleop.common.compiled import njit

#: Parameters of a haptic device for compiled code: mass [kg] of the hand, its inertia about every
#: axis through E [kg m^2]; largest force [N] (some postures of a leader arm allow less) and torques
#: (3,) about the rotational axes [N m], 0: none; Coulomb friction (6,) and damping (6,) of the
#: axes. Then, for a device in `task_space` only: apparent mass and inertia at the grip, centre p_B
#: (3,) and half edges (3,) of the workspace [m], largest yaw, pitch and roll (3,) [rad].
DeviceParameters = namedtuple(
    "DeviceParameters",
    "hand_mass hand_inertia peak_force peak_torque dry_friction damping in_task_space"
    " mass inertia workspace_centre half_workspace max_rotation",
    defaults=(np.zeros(6), np.zeros(6), True, 0.0, 0.0, np.zeros(3), np.zeros(3), np.zeros(3)),
)


@njit(cache=True)
def end_stop_force(x, rate, lower, upper, stiffness, damping):
    """Return the force of a spring and damper that never pull, on a coordinate outside limits."""
    if x > upper:
        return min(0.0, -stiffness * (x - upper) - damping * rate)
    if x < lower:
        return max(0.0, -stiffness * (x - lower) - damping * rate)
    return 0.0
