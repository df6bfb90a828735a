"""Default joint limits for models that specify none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.slave.arm import SLIDES, ArmModel

Array = NDArray[np.float64]

# Default half range and speed: revolute [rad, rad/s], prismatic [m, m/s].
_TURNS, _SLIDES = (np.pi, np.pi), (1.0, 1.0)
# Largest plausible range of a revolute joint [rad]; a larger one may be in degrees.
_TURNS_AT_MOST = 8 * np.pi
# Default time to full speed [s].
_TIME_TO_SPEED = 0.4


def with_all_limits(
    arm: ArmModel, where: str, acceleration: tuple[float, ...] = (), hint: str = ""
) -> tuple[ArmModel, list[str]]:
    """Return the arm with every limit set, and one text per assumption.

    `acceleration` has 1 or n limits [rad/s^2] instead of the model's; `hint` is appended to the
    assumption about accelerations.

    Raises:
        DrakeTeleopError: for a fixed joint or a wrong number of accelerations.
    """
    n, assumptions = arm.num_joints, []
    # Exporters write 0 to 0 for unknown limits.
    endless = ~(np.isfinite(arm.lower) & np.isfinite(arm.upper)) | (
        (arm.lower == 0) & (arm.upper == 0)
    )
    slides = arm.table[:-1, SLIDES] != 0.0
    stuck = ~endless & (arm.lower == arm.upper)
    if stuck.any():
        unit = "m" if slides[stuck][0] else "rad"
        raise DrakeTeleopError(
            f"{np.array(arm.joint_names)[stuck][0]} cannot move: both of its limits are "
            f"{arm.lower[stuck][0]:g} {unit}",
            where=where,
            remedy="correct the limits, or make the joint a fixed one",
        )
    reach, speed = (np.where(slides, _SLIDES[k], _TURNS[k]) for k in range(2))
    velocity = np.where(_given(arm.velocity_limit), arm.velocity_limit, speed)
    effort = np.where(_given(arm.effort_limit), arm.effort_limit, np.inf)
    own = arm.acceleration_limit
    if acceleration:
        if len(acceleration) not in (1, n):
            raise DrakeTeleopError(
                f"{len(acceleration)} acceleration limits for {n} joints",
                where=where,
                remedy="give one for all joints or one for each",
            )
        own = np.broadcast_to(np.array(acceleration), n).copy()
    completed = replace(
        arm,
        lower=np.where(endless, -reach, arm.lower),
        upper=np.where(endless, reach, arm.upper),
        velocity_limit=velocity,
        acceleration_limit=np.where(_given(own), own, velocity / _TIME_TO_SPEED),
        effort_limit=effort,
    )
    in_reason = slides | endless | (arm.upper - arm.lower < _TURNS_AT_MOST)
    reaching = f"acceleration limits that reach full speed in {_TIME_TO_SPEED:g} s{hint}"
    for missing, of_turning, of_sliding in (
        (endless, f"a range of +-{_TURNS[0]:.4g} rad", f"a range of +-{_SLIDES[0]:g} m"),
        (
            ~_given(arm.velocity_limit),
            f"a speed limit of {_TURNS[1]:.4g} rad/s",
            f"a speed limit of {_SLIDES[1]:g} m/s",
        ),
        (~_given(own), reaching, reaching),
        (~np.isfinite(effort), "no torque limit", "no force limit"),
        (~in_reason, f"limits in rad, though more than {_TURNS_AT_MOST:.4g} apart,", ""),
    ):
        for words, of_kind in ((of_turning, ~slides), (of_sliding, slides)):
            lacking = missing & of_kind
            if lacking.any():
                names = ", ".join(np.array(arm.joint_names)[lacking])
                assumptions.append(f"{words} for {'all joints' if lacking.all() else names}")
    return completed, assumptions


def _given(limits: Array) -> NDArray[np.bool_]:
    """Return True for specified limits; exporters write 0 for unknown ones."""
    return np.isfinite(limits) & (limits > 0)
