"""Tasks and movement parameters of the operator; sources in `docs/operator.md`."""

import math
from dataclasses import dataclass
from typing import TypeAlias

from drake_teleop.common.config import quantity, settings
from drake_teleop.common.errors import DrakeTeleopError


@dataclass
class _Task:
    t_start: float = quantity(0.5, "s", 0.0, 1e6, "start of the task, from simulation start")
    timeout: float = quantity(10.0, "s", 0.1, 3600.0, "time after which the operator gives up")
    translation: list[float] = quantity(
        [0.0, 0.0, -0.1], "m", -2.0, 2.0, "displacement from the tool's start to the target, in W"
    )

    @property
    def target_distance(self) -> float:
        """Distance from the tool's start to the target [m]."""
        return math.hypot(*self.translation)


@settings
@dataclass
class Reach(_Task):
    """Task of Fitts: move the tool's tip into a sphere in free space and keep it there."""

    width: float = quantity(0.01, "m", 5e-4, 0.5, "diameter of the target")
    dwell: float = quantity(0.3, "s", 0.0, 10.0, "required time in the target")


@dataclass
class _ContactTask(_Task):
    standoff: float = quantity(0.015, "m", 0.0, 0.5, "distance to the target of careful approach")


@settings
@dataclass
class Touch(_ContactTask):
    """Task: approach a surface at the target, detect contact, and stop."""

    dwell: float = quantity(0.3, "s", 0.0, 10.0, "rest time of the tool after its stop")


@settings
@dataclass
class Press(_ContactTask):
    """Task: approach a surface at the target and press on it with a desired force."""

    force: float = quantity(8.0, "N", 0.1, 500.0, "desired force of the tool on the surface")
    tolerance: float = quantity(2.0, "N", 0.05, 100.0, "tolerance of the desired force")
    hold: float = quantity(1.0, "s", 0.0, 60.0, "duration of the desired force")


@settings
@dataclass
class Insert(_ContactTask):
    """Task: insert the tool into a slot with its mouth at the target, down to the slot's floor."""

    timeout: float = quantity(20.0, "s", 0.1, 3600.0, "time after which the operator gives up")
    depth: float = quantity(0.04, "m", 1e-3, 0.5, "depth of the slot")
    push: float = quantity(10.0, "N", 0.1, 500.0, "downward force of the tool in the slot")
    dwell: float = quantity(0.3, "s", 0.0, 10.0, "rest time on the floor of the slot")


Task: TypeAlias = Reach | Touch | Press | Insert
KIND_REACH, KIND_TOUCH, KIND_PRESS, KIND_INSERT = range(4)
TASK_CLASSES = (Reach, Touch, Press, Insert)

#: Names of the measures that `station.task_measures` defines.
TASK_MEASURE_NAMES = (
    *("success", "task_time_s", "contact_force_overshoot_N", "effort_Ns", "task_work_J"),
    *("detection_time_s", "false_notices", "press_error_N"),
)


@settings
@dataclass
class Movement:
    """Speed, accuracy and contact force of the operator's movements; see docs/operator.md."""

    acceleration: float = quantity(1.5, "m/s^2", 0.01, 50.0, "peak acceleration in a submovement")
    shortest: float = quantity(0.2, "s", 0.05, 2.0, "least duration of a submovement")
    noise: float = quantity(0.05, "1", 0.0, 0.5, "end-point standard deviation per move length")
    approach_speed: float = quantity(
        0.03, "m/s", 1e-3, 1.0, "tool speed in a careful approach, at full trust in touch"
    )
    gentle_force: float = quantity(2.0, "N", 0.01, 100.0, "harmless contact force at the tool")


def check_target_beyond_standoff(task: Task, where: str) -> None:
    """Raise a DrakeTeleopError if the tool starts nearer to the target than radius or standoff."""
    least = task.width / 2 if isinstance(task, Reach) else task.standoff
    if (at := task.target_distance) <= least:
        rule = f"within its radius or standoff of {least:g} m"
        what = f"the target is {at:g} m from the tool's start, {rule}"
        remedy = "choose a target farther from the tool's start"
        raise DrakeTeleopError(what, where=f"{where}.translation", remedy=remedy)
