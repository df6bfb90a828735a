"""Scenarios: configuration of a station as dataclasses, read from YAML."""

import copy
import dataclasses
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar, cast

from pydrake.common.yaml import yaml_dump, yaml_load_typed

from drake_teleop.common import config
from drake_teleop.common.config import choice, plain, quantity, settings
from drake_teleop.common.errors import DrakeTeleopError, expect_type, suggest_name
from drake_teleop.common.files import scenarios_dir
from drake_teleop.common.registry import Registry
from drake_teleop.common.texts import read_yaml
from drake_teleop.station.channel.channel import MAX_TIMEOUT_S, Channel
from drake_teleop.station.channel.network import NetworkConfig
from drake_teleop.station.environment.environment import Environment, SeveralObjects
from drake_teleop.station.environment.sheet_spring import SheetSpring
from drake_teleop.station.environment.slot import PEG_RADIUS_M, TIP_BALL_CENTRE_Z_S_M, Slot
from drake_teleop.station.environment.solids import Block, Box, Wall
from drake_teleop.station.estimation.contact_detection import ContactDetectionConfig
from drake_teleop.station.estimation.load_estimator import LoadEstimatorConfig
from drake_teleop.station.master.data_sheets import FIGURES, Master
from drake_teleop.station.operator.operator import OperatorConfig
from drake_teleop.station.operator.task import check_target_beyond_standoff
from drake_teleop.station.passivity.methods import PassivityConfig
from drake_teleop.station.scaling.force_scaling import ForceScalingConfig
from drake_teleop.station.scaling.kinematic_scaling import KinematicScalingConfig
from drake_teleop.station.sensor.motion_estimation import MotionEstimationConfig
from drake_teleop.station.sensor.presets import PRESETS
from drake_teleop.station.sensor.sensor_chain import WristSensorConfig
from drake_teleop.station.slave.joint_control import POSITION_INTERFACE_PRESETS, JointControlConfig
from drake_teleop.station.slave.model.model_references import list_model_files
from drake_teleop.station.slave.scene import Scene
from drake_teleop.station.slave.slave_config import Ball, Slave

_T = TypeVar("_T")
ENVIRONMENTS: Registry[type[Environment]] = Registry(
    "environment",
    {each.__name__: each for each in (Wall, Box, Block, SheetSpring, Slot, Scene)},
    Environment,
)
"""Classes of the objects in `environment` by the tag in a file, without its `!`."""
#: Longest fixed step in contact [s]: ball and leaf vibrate at up to 700 Hz.
_MAX_FIXED_STEP_S = 1.25e-4
_MIN_KINEMATIC_SCALE_WITH_PASSIVITY = 1e-4  # 0.1 um at the slave for 1 mm at the hand


@settings
@dataclass
class Rates:
    """Sampling rates; in the paper: sensor 8 kHz, hand > 2 kHz, joint control 10 kHz."""

    sensor_hz: float = quantity(8000.0, "Hz", 10.0, 1e5, "rate of wrist sensor and encoders")
    hand_hz: float = quantity(
        2000.0, "Hz", 10.0, 1e5,
        "rate of haptic device and channel; 1 kHz or more with a simulated device",
    )  # fmt: skip
    joint_control_hz: float = quantity(
        2000.0, "Hz", 10.0, 1e5, "slave's joint control rate; above 2 kHz: several per event"
    )
    estimator_hz: float = quantity(1000.0, "Hz", 10.0, 1e5, "rate of estimator and detection")
    log_hz: float = quantity(1000.0, "Hz", 1.0, 1e5, "rate of log rows")


@settings
@dataclass
class Simulation:
    """Duration and integrator of a simulation.

    The log starts with t = 0 after the settling time. Times of the operator's intent and task are
    from the start of the simulation, `settle` earlier.
    """

    duration: float = quantity(1.0, "s", 1e-3, 36000.0, "logged time")
    settle: float = quantity(0.5, "s", 0.0, 60.0, "settling time before the log, at t < 0")
    integrator: str = choice(
        "runge_kutta3", ("runge_kutta3", "runge_kutta2", "semi_explicit_euler"), "Drake's scheme"
    )
    max_step: float = quantity(1e-3, "s", 1e-6, 0.1, "longest step; sampling shortens it")
    accuracy: float = quantity(2e-4, "1", 1e-12, 0.1, "tolerance of error-controlled integrators")
    seed: int = quantity(0, "1", 0, 2**32 - 1, "random seed; equal seeds give equal logs")
    end_with_task: bool = plain(False, "end within 20 ms after the log contains the task's outcome")
    on_fault: str = choice(
        "continue", ("continue", "stop"), "after a fault: hold a safe state, or stop with an error"
    )


@settings
@dataclass
class Scenario:
    """Complete configuration of the station in the paper's Fig. 4."""

    description: str = plain("", "subject of the scenario")
    simulation: Simulation = field(default_factory=Simulation)
    rates: Rates = field(default_factory=Rates)
    operator: OperatorConfig = field(default_factory=OperatorConfig)
    master: Master = field(default_factory=Master)
    kinematic_scaling: KinematicScalingConfig = field(default_factory=KinematicScalingConfig)
    channel: Channel = field(default_factory=Channel)
    passivity: PassivityConfig = field(default_factory=PassivityConfig)
    slave: Slave = field(default_factory=Slave)
    joint_control: JointControlConfig = field(default_factory=JointControlConfig)
    wrist_sensor: WristSensorConfig = field(default_factory=WristSensorConfig)
    motion_estimation: MotionEstimationConfig = field(default_factory=MotionEstimationConfig)
    load_estimator: LoadEstimatorConfig = field(default_factory=LoadEstimatorConfig)
    force_scaling: ForceScalingConfig = field(default_factory=ForceScalingConfig)
    contact_detection: ContactDetectionConfig | None = None
    sheet_spring: SheetSpring | None = None
    slot: Slot | None = None
    environment: list[Environment] = plain(
        [], "further objects to touch, such as [!Wall {stiffness: 2e4}, !Block {}]", ENVIRONMENTS
    )

    @property
    def surroundings(self) -> Environment | None:
        """All objects that the tool can touch as one `Environment`, or None."""
        things = self._environments
        return SeveralObjects(things) if len(things) > 1 else next(iter(things), None)

    @property
    def first_sheet_spring(self) -> SheetSpring | None:
        """Elastic sheet to touch, from `sheet_spring` or `environment`, or None."""
        return next((thing for thing in self._environments if isinstance(thing, SheetSpring)), None)

    @property
    def _environments(self) -> list[Environment]:
        own = (thing for thing in (self.sheet_spring, self.slot) if thing is not None)
        return [*own, *self.environment]

    def without_environment(self) -> "Scenario":
        """Return a copy of the scenario without objects to touch."""
        return replace(self, sheet_spring=None, slot=None, environment=[])

    @property
    def has_no_network_or_passivity(self) -> bool:
        """True if the channel has no network, no passivity method and default wrench limits."""
        own, default = self.passivity, PassivityConfig()
        names = ("method", "force_limit", "torque_limit")
        is_plain = all(getattr(own, name) == getattr(default, name) for name in names)
        return is_plain and self.channel.networks_of_directions() == (NetworkConfig(),) * 2

    def check(self, where: str = "scenario") -> None:
        """Check all fields; raise a DrakeTeleopError that names `where` and the invalid field."""
        config.check_all_field_values(self, where)
        self.force_scaling.scales(f"{where}:force_scaling")
        for name in ("operator", "passivity", "load_estimator", "master", "slave"):
            getattr(self, name).check(f"{where}:{name}")
        self.joint_control.check(f"{where}:joint_control", self.rates.joint_control_hz)
        self.wrist_sensor.check(f"{where}:wrist_sensor", self.rates.sensor_hz)
        for index, thing in enumerate(self.environment):
            thing.check(f"{where}:environment[{index}]")
        for kind, name in ((SheetSpring, "sheet spring"), (Slot, "slot")):
            if sum(isinstance(thing, kind) for thing in self._environments) > 1:
                what = f"the scenario has more than one {name} (one is permitted)"
                raise DrakeTeleopError(what, where=f"{where}:environment", remedy="keep one")
        tool, tip = self.slave.tool, Ball(PEG_RADIUS_M, [0.0, 0.0, TIP_BALL_CENTRE_Z_S_M])
        has_slot = any(isinstance(thing, Slot) for thing in self._environments)
        if has_slot and tool is not None and tool.mass > 0.0 and tip not in tool.shapes:
            what = "a slot requires the ball of its peg as a shape"
            remedy = f"add !Ball {{radius: {tip.radius:g}, position: {tip.position}}}"
            raise DrakeTeleopError(what, where=f"{where}:slave.tool.shapes", remedy=remedy)
        _check_operator_task(self, where)
        _check_integration_step(self, where)
        _check_channel_and_passivity(self, where)


def check_scenario(scenario: Any) -> None:
    remedy = "load one: LoadScenario(name)"
    if isinstance(scenario, (str, Path)):
        remedy = f"write LoadScenario({str(scenario)!r})"
    expect_type(Scenario, scenario, "scenario", remedy)
    scenario.check()


def ScenarioNames() -> list[str]:
    """Return the names of the shipped scenarios."""
    return sorted(path.stem for path in scenarios_dir().glob("*.yaml"))


def LoadScenario(name_or_path: str | Path) -> Scenario:
    """Load a shipped scenario by name, or a YAML file.

    Missing fields have their defaults. Paths in the file are relative to its folder.
    """
    return ScenarioFromData(*ReadScenarioData(name_or_path))


def ReadScenarioData(name_or_path: str | Path, where: str = "") -> tuple[Any, str]:
    """Read a scenario file; return the unchecked data, and the file's name for messages."""
    path = find_shipped_file("scenario", name_or_path, scenarios_dir(), where)
    return read_yaml(path, tagged=True), str(path)


def find_shipped_file(kind: str, name_or_path: str | Path, folder: Path, where: str = "") -> Path:
    """Return the path of the YAML file with this name in `folder`, or else the given path.

    A DrakeTeleopError is raised if neither exists. `kind` is the kind of file in its message.
    """
    expect_type((str, Path), name_or_path, kind)
    names = sorted(path.stem for path in folder.glob("*.yaml"))
    path = folder / f"{name_or_path}.yaml" if str(name_or_path) in names else Path(name_or_path)
    if not os.path.isfile(path):  # False also for invalid file names
        remedy = suggest_name(name_or_path, names, f"give a YAML file or one of {', '.join(names)}")
        what = f"there is no {kind} '{name_or_path}'"
        raise DrakeTeleopError(what, where=where, remedy=remedy)
    return path


def settings_without_range_check(
    schema: type[_T], data: Any, where: str, defaults: _T | None = None
) -> _T:
    """Return an object of class `schema` from YAML data, without range checks of its fields."""
    config.check_structure(schema, data, where)
    data = dict(data)
    things = [dict(thing) for thing in data.pop("environment", [])] if schema is Scenario else []
    with config.unchecked_assignments():
        text = yaml_dump(data)
        loaded = yaml_load_typed(schema=schema, data=text, defaults=defaults or schema())
        for thing in things:
            kind = ENVIRONMENTS[thing.pop("_tag", "!Wall").removeprefix("!")]
            loaded.environment.append(yaml_load_typed(schema=kind, data=yaml_dump(thing)))
    return cast(_T, loaded)


def ScenarioFromData(data: Any, where: str) -> Scenario:
    """Convert parsed YAML data to a checked scenario, or raise DrakeTeleopError.

    `where` is the file's name for messages. Paths in the data are relative to its folder.
    """
    config.check_structure(Scenario, data, where)  # before the presets are read
    sensor, master, control = (
        data.get(name) or {} for name in ("wrist_sensor", "master", "joint_control")
    )
    preset = PRESETS.get(str(sensor.get("preset")), WristSensorConfig())
    defaults = Scenario(wrist_sensor=preset)
    if master.get("figures") is not None:  # changes the data sheet
        defaults.master.figures = FIGURES.get(str(master.get("model")))
    if control.get("interface") is not None:
        servo = str(control.get("servo"))
        defaults.joint_control.interface = POSITION_INTERFACE_PRESETS.get(servo)
    scenario = settings_without_range_check(Scenario, data, where, defaults)
    scenario.check(where)
    absolute: Scenario = config.with_absolute_paths(scenario, Path(where).parent)
    return absolute


def referenced_files(scenario: Scenario) -> list[Path]:
    """Return the files at absolute paths in the scenario, and the files that they include."""
    leader = scenario.master.leader
    packages = map(Path, () if leader is None else leader.package_paths)
    folders = (*scenario.slave.package_folders, *packages)
    files: list[Path] = []
    left: list[Any] = [dataclasses.asdict(scenario)]
    while left:
        value = left.pop()
        if isinstance(value, (dict, list)):
            left.extend(value.values() if isinstance(value, dict) else value)
        elif isinstance(value, str) and os.path.isabs(value):
            files += list_model_files(Path(value), folders)
    return files


def replace(scenario: Scenario, **changes: object) -> Scenario:
    """Return a copy of a scenario with changed fields; `a__b` is field b of block a.

    >>> replace(Scenario(), force_scaling__sigma=0.5).force_scaling.sigma
    0.5

    A DrakeTeleopError is raised for an invalid name or value.
    """
    expect_type(Scenario, scenario, "scenario")
    scenario = copy.deepcopy(scenario)
    for name, value in changes.items():
        block, _, inner = name.partition("__")
        config.check_field_name(Scenario, block, f"scenario:{block}")
        if inner:
            present, place = getattr(scenario, block), f"scenario:{block}.{inner}"
            if present is None or isinstance(present, (str, list)):
                what = f"{block} is {present!r} in this scenario, so it has no field {inner}"
                remedy = f"set the whole block {block} first"
                raise DrakeTeleopError(what, where=place, remedy=remedy)
            config.check_field(type(present), inner, value, place)
            value = dataclasses.replace(present, **{inner: value})
        config.check_field(Scenario, block, value, f"scenario:{block}")
        scenario = dataclasses.replace(scenario, **{block: value})  # type: ignore[arg-type]
    return scenario


def _check_operator_task(scenario: Scenario, where: str) -> None:
    if scenario.operator.task is None:
        return
    check_target_beyond_standoff(scenario.operator.task, f"{where}:operator.task")
    if scenario.kinematic_scaling.translation_scale == 0.0:
        what = "the scale is 0, but the operator's task requires motion of the slave (above 0)"
        remedy = "set it above 0, or operator.task: null"
        place = f"{where}:kinematic_scaling.translation_scale"
        raise DrakeTeleopError(what, where=place, remedy=remedy)


def _check_integration_step(scenario: Scenario, where: str) -> None:
    simulation = scenario.simulation
    fixed = simulation.integrator != "runge_kutta3"
    if scenario.surroundings is not None and fixed and simulation.max_step > _MAX_FIXED_STEP_S:
        what = f"fixed steps of {simulation.max_step:g} s are too long for contact"
        remedy = f"set it to {_MAX_FIXED_STEP_S:g}, or integrator: runge_kutta3"
        raise DrakeTeleopError(what, where=f"{where}:simulation.max_step", remedy=remedy)


def _check_channel_and_passivity(scenario: Scenario, where: str) -> None:
    lines = scenario.channel.networks_of_directions(f"{where}:channel")
    for line, name in zip(lines, ("channel", "channel.backward"), strict=True):
        line.check(f"{where}:{name}")
        timeout = scenario.channel.timeout or MAX_TIMEOUT_S
        if line.rate_hz is not None and timeout < 2 / line.rate_hz:
            what = f"the timeout, {timeout:g} s, is below two packet intervals"
            what = f"{what} at {line.rate_hz:g} Hz"
            remedy = "raise timeout or rate_hz; otherwise the station stays in its safe state"
            raise DrakeTeleopError(what, where=f"{where}:channel.timeout", remedy=remedy)
    is_direct = scenario.has_no_network_or_passivity and scenario.contact_detection is None
    if scenario.master.is_joint_leader and not is_direct:
        what = "a leader that commands joints requires a direct channel (a network transmits poses)"
        remedy = "set it to pose, or remove network, passivity and contact_detection"
        raise DrakeTeleopError(what, where=f"{where}:master.leader.leads", remedy=remedy)
    scales = scenario.kinematic_scaling.scales
    if scenario.passivity.method != "none" and min(scales) < _MIN_KINEMATIC_SCALE_WITH_PASSIVITY:
        least = _MIN_KINEMATIC_SCALE_WITH_PASSIVITY
        what = f"passivity methods require kinematic scales >= {least:g}, not {min(scales):g}"
        remedy = "increase both scales of kinematic_scaling, or set method: none"
        raise DrakeTeleopError(what, where=f"{where}:passivity.method", remedy=remedy)
