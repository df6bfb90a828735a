"""Parameters of a haptic device for compiled code, and its end stops."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Records

DeviceParameters: TypeAlias = np.record
"""Parameters of a haptic device, read by compiled code as attributes; see `DEVICE_DTYPE`."""
DEVICE_DTYPE = np.dtype(
    (
        np.record,
        [
            ("hand_mass", float),  # [kg]
            ("hand_inertia", float),  # of the hand about every axis through E [kg m^2]
            ("peak_force", float),  # [N]; some postures of a leader arm allow less
            ("peak_torque", float, 3),  # about the rotational axes [N m]; 0: none
            ("dry_friction", float, 6),  # Coulomb friction of the axes [N m; N]
            ("damping", float, 6),  # of the axes [N m s/rad; N s/m]
            ("in_task_space", bool),  # the other fields are for a device in `task_space`
            ("mass", float),  # apparent mass at the grip [kg]
            ("inertia", float),  # apparent inertia at the grip [kg m^2]
            ("workspace_centre", float, 3),  # p_B [m]
            ("half_workspace", float, 3),  # half edges [m]
            ("max_rotation", float, 3),  # largest yaw, pitch and roll [rad]
        ],
    )
)


def pack_device_parameters(**values: ArrayLike) -> Records:
    """Return an array (1,) of `DEVICE_DTYPE` with fields from keywords, otherwise zero."""
    packed: Records = np.zeros(1, DEVICE_DTYPE)
    for name, value in values.items():
        packed[name] = value
    return packed


@njit(cache=True)
def end_stop_force(x, rate, lower, upper, stiffness, damping):
    """Return the force of an end stop at x with speed `rate`; it pushes only into the range."""
    if x > upper:
        return min(0.0, -stiffness * (x - upper) - damping * rate)
    if x < lower:
        return max(0.0, -stiffness * (x - lower) - damping * rate)
    return 0.0
