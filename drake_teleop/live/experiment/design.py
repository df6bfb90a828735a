"""Design of an experiment: its YAML file."""

# No postponed annotations: yaml_load_typed reads the types of the fields.
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

from pydrake.common.yaml import yaml_dump, yaml_load_typed

from drake_teleop.common.errors import DrakeTeleopError, expect, meant
from drake_teleop.common.fields import settings
from drake_teleop.common.quantities import check_ranges, check_structure, choice, plain, quantity
from drake_teleop.common.texts import read_yaml
from drake_teleop.live.inputs import NETWORKS, OWN
from drake_teleop.station.operator.task import Insert
from drake_teleop.station.passivity.methods import METHODS
from drake_teleop.station.scenario import LoadScenario, Scenario, ScenarioNames

_FOLDER = Path(__file__).parent


@settings
@dataclass
class Condition:
    """Condition of a trial, hidden from the participant."""

    name: str = plain("", "for tables and pictures; no participant sees it")
    sigma: float = quantity(0.0, "1", 0.0, 3.0, "share of the non-contact wrench that is felt")
    gamma: float = quantity(1.0, "1", 0.05, 3.0, "scale of the contact wrench")
    eta: float | None = quantity(
        None, "1", 0.0, 1.0, "share of a held object that is felt, with sigma = 0"
    )
    network: str = choice(
        OWN, tuple(name for name in NETWORKS if name != "custom"), "between hand and arm"
    )
    delay: float | None = quantity(None, "s", 0.0, 2.0, "one way, in place of a network")
    method: str = choice(OWN, (OWN, *METHODS), "that keeps the station passive")


@dataclass
class _Task:
    scenario: str = plain(
        "touch", "name of a shipped one, or a YAML file; its path is relative to this file"
    )
    trials: int = quantity(40, "1", 1, 1000, "of each condition")
    practice: int = quantity(4, "1", 0, 100, "trials before, with the right answer shown")


@settings
@dataclass
class ContactDetection(_Task):
    """In which of two intervals was the contact rendered? The tool touches in both."""

    low: float = quantity(0.2, "N", 1e-3, 1e3, "least contact force at the tool that is shown")
    high: float = quantity(20.0, "N", 1e-2, 1e3, "largest one, also that of practice")
    pressed: float = quantity(8.0, "N", 0.1, 1e3, "force at the tool that is expected at first")
    interval: float = quantity(4.0, "s", 0.5, 60.0, "length of an interval")


@settings
@dataclass
class ApparentMass(_Task):
    """In which of two intervals was the tool heavier? It is moved back and forth in both."""

    low: float = quantity(0.004, "kg", 1e-4, 10.0, "least additional mass at the hand")
    high: float = quantity(0.15, "kg", 1e-3, 10.0, "largest one, also that of practice")
    interval: float = quantity(4.0, "s", 0.5, 60.0, "length of an interval")


@settings
@dataclass
class PegInSlot(_Task):
    """Insertion of the tool into a slot, with completion time and largest contact force."""

    scenario: str = plain("insert", "as of the others; its operator has a task !Insert")
    trials: int = quantity(8, "1", 1, 1000, "of each condition")
    practice: int = quantity(1, "1", 0, 100, "trials before")
    timeout: float = quantity(30.0, "s", 1.0, 600.0, "after which a trial has failed")


Task: TypeAlias = ContactDetection | ApparentMass | PegInSlot


@settings
@dataclass
class SimulatedParticipant:
    """Participant of `--simulated`, who compares changes of the rendered force."""

    noise: float = quantity(0.06, "N", 1e-4, 100.0, "standard deviation at rest, at the hand")
    weber: float = quantity(0.1, "1", 0.0, 1.0, "and as a share of the response")
    lapse: float = quantity(0.02, "1", 0.0, 0.5, "share of the answers that are guessed")
    reach: float = quantity(0.088, "m", 1e-3, 0.3, "how far down it goes to touch, at the hand")
    sway: float = quantity(0.03, "m", 1e-3, 0.1, "to and fro at 1 Hz, to judge a mass")


@settings
@dataclass
class Experiment:
    """Blind experiment: tasks, and conditions of its trials."""

    description: str = plain("", "what the experiment is about; no participant sees it")
    consent: str = plain("", "what participants read first, and agree to")
    tasks: list[Task] = plain([], "in an order that is drawn for each participant")
    conditions: list[Condition] = plain([], "each trial has one, in an order that is drawn")
    feedback: str = choice(
        "vibration",
        ("vibration", "bar"),
        "the felt force comes by gamepad or haptic device, or is drawn as a bar besides",
    )
    break_after: int = quantity(40, "1", 1, 10_000, "trials until a break is offered")
    seed: int = quantity(0, "1", 0, 1e9, "of all that is drawn")
    simulated: SimulatedParticipant = field(default_factory=SimulatedParticipant)

    def check(self, where: str) -> None:
        """Check the experiment without its scenarios.

        Raises:
            DrakeTeleopError: with the field.
        """
        check_ranges(self, where)
        for name in ("tasks", "conditions"):
            if not getattr(self, name):
                raise DrakeTeleopError("there is none", where=f"{where}:{name}")
        kinds = [type(task).__name__ for task in self.tasks]
        if len(set(kinds)) < len(kinds):
            raise DrakeTeleopError("a task stands there twice", where=f"{where}:tasks")
        for index, task in enumerate(self.tasks):
            if not isinstance(task, PegInSlot) and not 2.0 * task.low <= task.high:
                raise DrakeTeleopError(
                    f"{task.low:g} to {task.high:g} is no range to look for a threshold in",
                    where=f"{where}:tasks[{index}].high",
                    remedy="set it to twice low at least",
                )
        names = [condition.name for condition in self.conditions]
        for index, condition in enumerate(self.conditions):
            place = f"{where}:conditions[{index}]"
            if not condition.name or condition.name in names[:index]:
                raise DrakeTeleopError("each condition has its own name", where=f"{place}.name")
            if condition.eta is not None and condition.sigma != 0.0:
                raise DrakeTeleopError(
                    "eta is the share of the object alone", where=f"{place}.eta", remedy="sigma: 0"
                )
            if condition.delay is not None and condition.network != OWN:
                raise DrakeTeleopError(
                    "delay and network are two lines",
                    where=f"{place}.delay",
                    remedy="give one of them",
                )


def ExperimentNames() -> list[str]:
    """Return the shipped names."""
    return sorted(path.stem for path in _FOLDER.glob("*.yaml"))


def LoadExperiment(path: str | Path) -> tuple[Experiment, list[Scenario]]:
    """Return a checked experiment by file or name, and its scenarios.

    Raises:
        DrakeTeleopError: with the invalid field.
    """
    expect((str, Path), path, "study")
    names = ExperimentNames()
    path = _FOLDER / f"{path}.yaml" if str(path) in names else Path(path)
    if not os.path.isfile(path):
        raise DrakeTeleopError(
            f"there is no experiment '{path}'",
            remedy=meant(path, names, f"give a YAML file or one of {', '.join(names)}"),
        )
    data = read_yaml(path, tagged=True)
    check_structure(Experiment, data, str(path))
    experiment = yaml_load_typed(schema=Experiment, data=yaml_dump(data), defaults=Experiment())
    experiment.check(str(path))
    return experiment, [_scenario(task, path, index) for index, task in enumerate(experiment.tasks)]


def _scenario(task: Task, path: Path, index: int) -> Scenario:
    known = task.scenario in ScenarioNames()
    scenario = LoadScenario(task.scenario if known else path.parent / task.scenario)
    place = f"{path}:tasks[{index}].scenario"
    if isinstance(task, PegInSlot) and not isinstance(scenario.operator.task, Insert):
        raise DrakeTeleopError(
            "says nothing of a slot", where=place, remedy="give its operator a task !Insert"
        )
    if isinstance(task, ContactDetection) and scenario.surroundings is None:
        raise DrakeTeleopError("has nothing to touch", where=place, remedy="such as touch")
    return scenario
