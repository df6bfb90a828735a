"""Parameters of a haptic device in one vector for compiled code, and its end stops."""

from __future__ import annotations

from drake_teleop.common.compiled import njit
from drake_teleop.station.passivity.memory import SlotAllocator

NUM_DEVICE_PARAMETERS = 31  #: length of the vector
_layout = SlotAllocator(NUM_DEVICE_PARAMETERS)
HAND_MASS_SLOT = _layout.number()  #: mass of the hand on the grip [kg]
HAND_INERTIA_SLOT = _layout.number()  #: inertia of the hand about every axis through E [kg m^2]
DRY_FRICTION_SLOTS = _layout.vector(6)  #: Coulomb friction of the device's axes [N or N m]
DAMPING_SLOTS = _layout.vector(6)  #: damping of these axes [N s/m or N m s/rad]
PEAK_FORCE_SLOT = _layout.number()  #: largest displayed force [N]
PEAK_TORQUE_SLOTS = _layout.vector(
    3
)  #: largest torque about the three rotational axes [N m]; 0: none
IS_IN_TASK_SPACE_SLOT = _layout.number()  #: 1 for a device of `task_space`, 0 for the Phantom
# Only for a device in task space:
MASS_SLOT = _layout.number()  #: apparent mass at the grip [kg]
INERTIA_SLOT = _layout.number()  #: apparent inertia at the grip about every axis [kg m^2]
WORKSPACE_CENTRE_SLOTS = _layout.vector(3)  #: centre of the workspace, p_B [m]
HALF_WORKSPACE_SLOTS = _layout.vector(3)  #: half edges of the workspace [m]
MAX_ROTATION_SLOTS = _layout.vector(3)  #: largest yaw, pitch and roll [rad]


@njit(cache=True)
def end_stop_force(x, rate, lower, upper, stiffness, damping):
    """Return the force of a spring and damper that never pull, on a coordinate outside limits."""
    if x > upper:
        return min(0.0, -stiffness * (x - upper) - damping * rate)
    if x < lower:
        return max(0.0, -stiffness * (x - lower) - damping * rate)
    return 0.0
