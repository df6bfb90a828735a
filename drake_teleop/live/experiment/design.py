"""Tasks and conditions of an experiment, from its YAML file."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn, TypeAlias

from drake_teleop.common.config import check_all_field_values, choice, plain, quantity, settings
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.texts import read_yaml
from drake_teleop.live.inputs import NETWORK_NAMES, UNCHANGED_CHOICE
from drake_teleop.station.operator.task import Insert
from drake_teleop.station.passivity.methods import METHODS
from drake_teleop.station.scenario import (
    ReadScenarioData,
    Scenario,
    ScenarioFromData,
    ScenarioNames,
    find_shipped_file,
    settings_without_range_check,
)

_EXPERIMENTS_FOLDER = Path(__file__).parent


@settings
@dataclass
class Condition:
    """Condition of a trial, hidden from the participant."""

    name: str = plain("", "name in tables and pictures, hidden from participants")
    sigma: float = quantity(0.0, "1", 0.0, 3.0, "scale of the non-contact wrench")
    gamma: float = quantity(1.0, "1", 0.05, 3.0, "scale of the contact wrench")
    eta: float | None = quantity(
        None, "1", 0.0, 1.0, "scale of a held object's non-contact wrench; requires sigma 0"
    )
    network: str = choice(
        UNCHANGED_CHOICE,
        tuple(name for name in NETWORK_NAMES if name != "custom"),
        "network between master and slave",
    )
    delay: float | None = quantity(None, "s", 0.0, 2.0, "one-way delay; replaces the network")
    method: str = choice(UNCHANGED_CHOICE, (UNCHANGED_CHOICE,), "passivity method", METHODS)

    @property
    def non_contact_scale(self) -> float:
        return self.sigma if self.eta is None else self.eta


@dataclass
class _CommonTaskFields:
    scenario: str = plain("touch", "scenario: shipped name, or YAML file relative to this file")
    trials: int = quantity(40, "1", 1, 1000, "number of trials of each condition")
    practice: int = quantity(
        4, "1", 0, 100, "number of practice trials, which show the right answer"
    )


@settings
@dataclass
class ContactDetection(_CommonTaskFields):
    """Task to identify the interval (of two) with a rendered force; both contain a contact."""

    low: float = quantity(0.2, "N", 1e-3, 1e3, "smallest rendered contact force at the tool")
    high: float = quantity(
        20.0, "N", 1e-2, 1e3, "largest rendered contact force, also for practice"
    )
    pressed: float = quantity(8.0, "N", 0.1, 1e3, "expected contact force of the first trials")
    interval: float = quantity(4.0, "s", 0.5, 60.0, "length of an interval")


@settings
@dataclass
class ApparentMass(_CommonTaskFields):
    """Task to identify the interval (of two) with the heavier tool, while the hand moves."""

    low: float = quantity(0.004, "kg", 1e-4, 10.0, "smallest added mass at the hand")
    high: float = quantity(0.15, "kg", 1e-3, 10.0, "largest added mass, also for practice")
    interval: float = quantity(4.0, "s", 0.5, 60.0, "length of an interval")


@settings
@dataclass
class PegInSlot(_CommonTaskFields):
    """Task to insert the tool into a slot; measured: time and contact force."""

    scenario: str = plain("insert", "shipped name, or YAML file; its operator needs a task !Insert")
    trials: int = quantity(8, "1", 1, 1000, "number of trials of each condition")
    practice: int = quantity(1, "1", 0, 100, "number of practice trials")
    timeout: float = quantity(30.0, "s", 1.0, 600.0, "time limit; a longer trial has failed")


Task: TypeAlias = ContactDetection | ApparentMass | PegInSlot


@settings
@dataclass
class SimulatedParticipant:
    """Participant of `--simulated`, who compares rendered forces of two intervals."""

    noise: float = quantity(0.06, "N", 1e-4, 100.0, "constant noise of the perceived force (std)")
    weber: float = quantity(0.1, "1", 0.0, 1.0, "noise (std) relative to the perceived force")
    lapse: float = quantity(0.02, "1", 0.0, 0.5, "share of guessed answers")
    reach: float = quantity(0.088, "m", 1e-3, 0.3, "downward displacement of the hand for contact")
    sway: float = quantity(
        0.03, "m", 1e-3, 0.1, "amplitude of the hand's motion at 1 Hz, to judge a mass"
    )


@settings
@dataclass
class Experiment:
    """Blind experiment: tasks, and conditions of its trials."""

    description: str = plain("", "description, hidden from participants")
    consent: str = plain("", "text that participants read and agree to")
    tasks: list[Task] = plain([], "tasks, in random order for each participant")
    conditions: list[Condition] = plain([], "conditions of the trials, in random order")
    feedback: str = choice(
        "vibration",
        ("vibration", "bar"),
        "display of the rendered force; vibration: gamepad or haptic device; bar: also page",
    )
    break_after: int = quantity(40, "1", 1, 10_000, "number of trials between breaks")
    seed: int = quantity(0, "1", 0, 1e9, "random seed")
    simulated: SimulatedParticipant = field(default_factory=SimulatedParticipant)

    def check(self, where: str) -> None:
        def fail(place: str, what: str, remedy: str) -> NoReturn:
            raise DrakeTeleopError(what, where=f"{where}:{place}", remedy=remedy)

        check_all_field_values(self, where)
        for name in ("tasks", "conditions"):
            if not getattr(self, name):
                fail(name, "is empty", "add at least one")
        kinds = [type(task).__name__ for task in self.tasks]
        for kind in kinds:
            if kinds.count(kind) > 1:
                fail("tasks", f"the task !{kind} is listed twice", "remove one")
        for index, task in enumerate(self.tasks):
            if not isinstance(task, PegInSlot) and not 2.0 * task.low <= task.high:
                what = f"{task.high:g} is less than twice low, {task.low:g}: the range is too small"
                remedy = "increase high, so that the range contains the threshold"
                fail(f"tasks[{index}].high", what, remedy)
        names = [condition.name for condition in self.conditions]
        for index, condition in enumerate(self.conditions):
            place = f"conditions[{index}]"
            if not condition.name or condition.name in names[:index]:
                what = f"{condition.name!r} is empty, or the name of an earlier condition"
                fail(f"{place}.name", what, "give each condition its own name")
            if condition.eta is not None and condition.sigma != 0.0:
                fail(f"{place}.eta", "cannot be combined with sigma > 0", "set sigma: 0")
            if condition.delay is not None and condition.network != UNCHANGED_CHOICE:
                what = f"cannot be combined with network {condition.network!r}"
                fail(f"{place}.delay", what, "remove delay or network")


def LoadExperiment(path: str | Path) -> tuple[Experiment, list[Scenario]]:
    """Return the checked experiment of a file or shipped name, and the scenario of each task."""
    path = find_shipped_file("experiment", path, _EXPERIMENTS_FOLDER)
    experiment = settings_without_range_check(Experiment, read_yaml(path, tagged=True), str(path))
    experiment.check(str(path))
    return experiment, [
        _load_task_scenario(task, path, index) for index, task in enumerate(experiment.tasks)
    ]


def _load_task_scenario(task: Task, path: Path, index: int) -> Scenario:
    known = task.scenario in ScenarioNames()
    place = f"{path}:tasks[{index}].scenario"
    file = task.scenario if known else path.parent / task.scenario
    scenario = ScenarioFromData(*ReadScenarioData(file, place))
    if isinstance(task, PegInSlot) and not isinstance(scenario.operator.task, Insert):
        remedy = "give its operator a task !Insert"
        raise DrakeTeleopError(f"{task.scenario} has no slot", where=place, remedy=remedy)
    if isinstance(task, ContactDetection) and scenario.surroundings is None:
        what = f"{task.scenario} has no object to touch"
        raise DrakeTeleopError(what, where=place, remedy="give one with an object, such as touch")
    return scenario
