"""Default joint limits for models that specify none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.slave.arm import SLIDES, ArmModel

Array = NDArray[np.float64]

# Default half range and speed: revolute [rad, rad/s], prismatic [m, m/s].
_DEFAULT_REVOLUTE, _DEFAULT_PRISMATIC = (np.pi, np.pi), (1.0, 1.0)
# Largest plausible range of a revolute joint [rad]; a larger one may be in degrees.
_MAX_PLAUSIBLE_RANGE_RAD = 8 * np.pi
# Default time to full speed [s].
_TIME_TO_FULL_SPEED_S = 0.4


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
    unlimited = ~(np.isfinite(arm.lower) & np.isfinite(arm.upper)) | (
        (arm.lower == 0) & (arm.upper == 0)
    )
    slides = arm.table[:-1, SLIDES] != 0.0
    immovable = ~unlimited & (arm.lower == arm.upper)
    if immovable.any():
        unit = "m" if slides[immovable][0] else "rad"
        raise DrakeTeleopError(
            f"{np.array(arm.joint_names)[immovable][0]} cannot move: both of its limits are "
            f"{arm.lower[immovable][0]:g} {unit}",
            where=where,
            remedy="correct the limits, or make the joint a fixed one",
        )
    reach, speed = (np.where(slides, _DEFAULT_PRISMATIC[k], _DEFAULT_REVOLUTE[k]) for k in range(2))
    velocity = np.where(_is_specified(arm.velocity_limit), arm.velocity_limit, speed)
    effort = np.where(_is_specified(arm.effort_limit), arm.effort_limit, np.inf)
    specified = arm.acceleration_limit
    if acceleration:
        if len(acceleration) not in (1, n):
            raise DrakeTeleopError(
                f"{len(acceleration)} acceleration limits for {n} joints",
                where=where,
                remedy="give one for all joints or one for each",
            )
        specified = np.broadcast_to(np.array(acceleration), n).copy()
    completed = replace(
        arm,
        lower=np.where(unlimited, -reach, arm.lower),
        upper=np.where(unlimited, reach, arm.upper),
        velocity_limit=velocity,
        acceleration_limit=np.where(
            _is_specified(specified), specified, velocity / _TIME_TO_FULL_SPEED_S
        ),
        effort_limit=effort,
    )
    plausible = slides | unlimited | (arm.upper - arm.lower < _MAX_PLAUSIBLE_RANGE_RAD)
    acceleration_text = (
        f"acceleration limits that reach full speed in {_TIME_TO_FULL_SPEED_S:g} s{hint}"
    )
    for missing, revolute_text, prismatic_text in (
        (
            unlimited,
            f"a range of +-{_DEFAULT_REVOLUTE[0]:.4g} rad",
            f"a range of +-{_DEFAULT_PRISMATIC[0]:g} m",
        ),
        (
            ~_is_specified(arm.velocity_limit),
            f"a speed limit of {_DEFAULT_REVOLUTE[1]:.4g} rad/s",
            f"a speed limit of {_DEFAULT_PRISMATIC[1]:g} m/s",
        ),
        (~_is_specified(specified), acceleration_text, acceleration_text),
        (~np.isfinite(effort), "no torque limit", "no force limit"),
        (~plausible, f"limits in rad, though more than {_MAX_PLAUSIBLE_RANGE_RAD:.4g} apart,", ""),
    ):
        for text, kind in ((revolute_text, ~slides), (prismatic_text, slides)):
            assumed = missing & kind
            if assumed.any():
                names = ", ".join(np.array(arm.joint_names)[assumed])
                assumptions.append(f"{text} for {'all joints' if assumed.all() else names}")
    return completed, assumptions


def _is_specified(limits: Array) -> NDArray[np.bool_]:
    """Return True for specified limits; exporters write 0 for unknown ones."""
    return np.isfinite(limits) & (limits > 0)
