"""Parameters of a haptic device for compiled code, and its end stops."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Array


class DeviceParameters(NamedTuple):
    """Parameters of a haptic device; those after `in_task_space` are of a device in task space.

    Attributes:
        hand_mass: mass of the hand on the grip [kg].
        hand_inertia: inertia of the hand about every axis through E [kg m^2].
        peak_force: largest displayed force [N].
        peak_torque: (3,) largest torque about the three rotational axes [N m]; 0: none.
        dry_friction: (6,) Coulomb friction of the device's axes [N or N m].
        damping: (6,) damping of these axes [N s/m or N m s/rad].
        in_task_space: True for a device of `task_space`, False for the Phantom.
        mass: apparent mass at the grip [kg].
        inertia: apparent inertia at the grip about every axis [kg m^2].
        workspace_centre: (3,) centre of the workspace, p_B [m].
        half_workspace: (3,) half edges of the workspace [m].
        max_rotation: (3,) largest yaw, pitch and roll [rad].
    """

    hand_mass: float
    hand_inertia: float
    peak_force: float
    peak_torque: Array
    dry_friction: Array = np.zeros(6)
    damping: Array = np.zeros(6)
    in_task_space: bool = True
    mass: float = 0.0
    inertia: float = 0.0
    workspace_centre: Array = np.zeros(3)
    half_workspace: Array = np.zeros(3)
    max_rotation: Array = np.zeros(3)


@njit(cache=True)
def end_stop_force(x, rate, lower, upper, stiffness, damping):
    """Return the force of a spring and damper that never pull, on a coordinate outside limits."""
    if x > upper:
        return min(0.0, -stiffness * (x - upper) - damping * rate)
    if x < lower:
        return max(0.0, -stiffness * (x - lower) - damping * rate)
    return 0.0
