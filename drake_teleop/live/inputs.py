"""Inputs of a live session as integers, exactly as recorded."""

from __future__ import annotations

import dataclasses
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.common.texts import read_text
from drake_teleop.common.vectors import quaternion_exponential, quaternion_logarithm
from drake_teleop.common.version import __version__
from drake_teleop.station.channel.network import PRESETS as NETWORK_PRESETS
from drake_teleop.station.operator.operator import GRIP_IMPEDANCES
from drake_teleop.station.passivity.methods import METHODS
from drake_teleop.station.scenario import Scenario
from drake_teleop.station.sensor.presets import PRESETS as SENSOR_PRESETS

UNCHANGED_CHOICE = "as in the scenario"
NETWORK_NAMES = (UNCHANGED_CHOICE, *NETWORK_PRESETS, "custom")
SENSOR_NAMES = (UNCHANGED_CHOICE, *SENSOR_PRESETS)

#: Length of a slice [ms]; inputs change between slices.
SLICE_MS = 5
INPUT_UNIT_M, INPUT_UNIT_RAD = 1e-5, 1e-4  #: units of position [m] and rotation [rad]
_SIGMA_UNIT, _FORCE_SCALE_UNIT = 1e-2, 1e-5
MAX_DURATION_MS = 36_000_000  # ms; ten hours, as for a scenario


def choice_names() -> dict[str, tuple[str, ...]]:
    """Return the names of all networks, grips, sensors and methods, in the order of `Inputs`."""
    shipped = {"network": NETWORK_NAMES, "grip": tuple(GRIP_IMPEDANCES), "sensor": SENSOR_NAMES}
    return shipped | {"method": tuple(METHODS)}


def choices_as_in_scenario(scenario: Scenario) -> dict[str, int]:
    """Return values of network, grip and other choices that leave a scenario unchanged."""
    return {
        "network": 0,
        "method": list(METHODS).index(scenario.passivity.method),
        "grip": list(GRIP_IMPEDANCES).index(scenario.operator.grip),
        "object": int(scenario.slave.payload.mass > 0.0),
        "detection": int(scenario.contact_detection is not None),
        "sensor": 0,
    }


def _integer_field_with_range(default: int, low: int, high: int) -> Any:
    return dataclasses.field(default=default, metadata={"range": (low, high)})


@dataclass(frozen=True)
class Inputs:
    """Integer inputs from the page that moves the hand.

    Attributes:
        x, y, z: intended displacement of the stylus in B [10 um].
        rx, ry, rz: intended rotation vector in B [0.1 mrad].
        held: 1 while the hand holds the stylus.
        clutch: 1 while motion is transmitted.
        sigma: scale of the non-contact wrench of the gripper, or of an undivided load [%].
        sigma_weight: scale of the load's weight [%]; -1: the scale of its inertia.
        sigma_object: scale of the non-contact wrench of a gripped object [%].
        gamma: scale of the contact wrench [%].
        force_scale: scale from slave to master force [1e-5].
        network, method, grip, sensor: index into `choice_names()`.
        delay, jitter, loss: of the network "custom" [0.1 ms, % of the delay, 0.1 %].
        object: 1 with a gripped object.
        detection: 1 with contact detection.
    """

    x: int = _integer_field_with_range(0, -15_000, 15_000)
    y: int = _integer_field_with_range(0, -15_000, 15_000)
    z: int = _integer_field_with_range(0, -15_000, 15_000)
    rx: int = _integer_field_with_range(0, -10_000, 10_000)
    ry: int = _integer_field_with_range(0, -10_000, 10_000)
    rz: int = _integer_field_with_range(0, -10_000, 10_000)
    held: int = _integer_field_with_range(1, 0, 1)
    clutch: int = _integer_field_with_range(1, 0, 1)
    sigma: int = _integer_field_with_range(0, 0, 300)
    sigma_weight: int = _integer_field_with_range(-1, -1, 300)
    sigma_object: int = _integer_field_with_range(0, 0, 300)
    gamma: int = _integer_field_with_range(100, 0, 300)
    force_scale: int = _integer_field_with_range(5714, 0, 100_000)
    network: int = _integer_field_with_range(0, 0, len(NETWORK_NAMES) - 1)
    delay: int = _integer_field_with_range(500, 0, 20_000)
    jitter: int = _integer_field_with_range(20, 0, 100)
    loss: int = _integer_field_with_range(0, 0, 500)
    method: int = _integer_field_with_range(0, 0, 0)  # see `input_range`
    grip: int = _integer_field_with_range(1, 0, len(GRIP_IMPEDANCES) - 1)
    object: int = _integer_field_with_range(0, 0, 1)
    detection: int = _integer_field_with_range(0, 0, 1)
    sensor: int = _integer_field_with_range(0, 0, len(SENSOR_NAMES) - 1)

    @classmethod
    def from_scenario(cls, scenario: Scenario) -> Inputs:
        config = scenario.force_scaling
        sigma, sigma_object, gamma = (round(s / _SIGMA_UNIT) for s in config.scales()[:3])
        apart = config.sigma_weight is not None or config.sigma_inertia is not None
        weight = round(config.scales().weight_gripper / _SIGMA_UNIT) if apart else -1
        started = cls(
            sigma=sigma,
            sigma_weight=weight,
            sigma_object=sigma_object,
            gamma=gamma,
            force_scale=round(config.force_scale / _FORCE_SCALE_UNIT),
        )
        return started.with_changes(choices_as_in_scenario(scenario))

    def with_changes(self, values: Mapping[str, Any]) -> Inputs:
        """Return the inputs with new values, clipped to their range; invalid ones are ignored."""
        changes = {}
        for name in values.keys() & INPUT_RANGES.keys():
            value, (low, high) = values[name], input_range(name)
            if isinstance(value, (int, float)) and abs(value) < 1e15:
                changes[name] = round(min(max(value, low), high))
        return dataclasses.replace(self, **changes) if changes else self

    @property
    def hand_pose_and_held(self) -> tuple[int, ...]:
        return self.x, self.y, self.z, self.rx, self.ry, self.rz, self.held

    @property
    def station_choices(self) -> tuple[int, ...]:
        """Values of the inputs whose change requires a new station."""
        is_custom = NETWORK_NAMES[self.network] == "custom"
        line = (self.delay, self.jitter, self.loss) if is_custom else ()
        choices = (self.network, self.method, self.grip, self.object, self.detection, self.sensor)
        return (*choices, *line)

    @property
    def channel_and_method_inputs(self) -> tuple[int, ...]:
        return self.station_choices[:2] + self.station_choices[6:]

    def intended_pose(self, p_BE_start: Array) -> Array | None:
        """Return the intended pose X_BE (7,), from p_BE at zero inputs; None: the hand lets go."""
        if not self.held:
            return None
        q = quaternion_exponential(tuple(INPUT_UNIT_RAD * r for r in (self.rx, self.ry, self.rz)))
        return np.concatenate([q, p_BE_start + INPUT_UNIT_M * np.array([self.x, self.y, self.z])])

    def with_hand_at_pose(self, pose: Array, p_BE_start: Array) -> Inputs:
        """Return the inputs that hold the stylus at the pose X_BE (7,)."""
        return self.with_changes(inputs_at_displacement(pose[4:] - p_BE_start, tuple(pose[:4])))

    @property
    def force_scales(self) -> dict[str, Any]:
        return {
            "sigma_weight": None if self.sigma_weight < 0 else _SIGMA_UNIT * self.sigma_weight,
            "sigma_gripper": _SIGMA_UNIT * self.sigma,
            "sigma_object": _SIGMA_UNIT * self.sigma_object,
            "gamma": _SIGMA_UNIT * self.gamma,
            "force_scale": _FORCE_SCALE_UNIT * self.force_scale,
        }


#: Range of each input. The end stops of the device are outside the hand's 0.3 m wide box.
INPUT_RANGES = {entry.name: entry.metadata["range"] for entry in dataclasses.fields(Inputs)}
#: Inputs whose change requires another station.
STATION_SWAP_INPUTS = frozenset(list(INPUT_RANGES)[list(INPUT_RANGES).index("network") :])
_CSV_COLUMNS = ("ms", *INPUT_RANGES)
# The scales of a scenario, up to 100, may exceed the ranges of the page.
_MAX_SCALES_IN_RECORDING = dict.fromkeys(("sigma", "sigma_weight", "sigma_object", "gamma"), 10_000)
_MAX_SCALES_IN_RECORDING["force_scale"] = 10_000_000


def input_range(name: str) -> tuple[int, int]:
    return (0, len(METHODS) - 1) if name == "method" else INPUT_RANGES[name]


def inputs_at_displacement(
    displacement: Sequence[float] | Array, rotation: Any
) -> dict[str, float]:
    """Return held, x ... rz of a hand at a displacement, in 10 um and 0.1 mrad.

    `displacement` (3,) is in B [m], `rotation` a quaternion [w, x, y, z].
    """
    values, turn = {"held": 1.0}, quaternion_logarithm(rotation)
    for k, name in enumerate("xyz"):
        values |= {name: displacement[k] / INPUT_UNIT_M, "r" + name: turn[k] / INPUT_UNIT_RAD}
    return values


_PROGRAM_VERSIONS = {"drake_teleop": __version__}


def csv_header(versions: Mapping[str, str] = _PROGRAM_VERSIONS) -> str:
    comment = ", ".join(f"{name} {version}" for name, version in versions.items())
    return f"# {comment}\n{','.join(_CSV_COLUMNS)}\n"


def csv_row(ms: int, inputs: Inputs) -> str:
    values = vars(inputs) | {n: words[vars(inputs)[n]] for n, words in choice_names().items()}
    return ",".join(map(str, (ms, *values.values()))) + "\n"


def read_inputs(
    path: Path, versions: Mapping[str, str] = _PROGRAM_VERSIONS
) -> list[tuple[int, Inputs]]:
    """Return the recorded changes as (time [ms], inputs); the time of the last one is the end.

    Raise DrakeTeleopError if the file is invalid or was not written by these `versions`.
    """
    complete = read_text(path).rpartition("\n")[0]
    lines = [line.split(",") for line in complete.split("\n")]
    if tuple(lines[0]) == _CSV_COLUMNS:
        raise _unrepeatable_error("lacks the version of drake_teleop that wrote it", path)
    if tuple(lines[1:2]) != (list(_CSV_COLUMNS),) or not complete.startswith("# "):
        what = "does not contain the inputs of a recorded live session"
        remedy = f"use the columns {', '.join(_CSV_COLUMNS)}"
        raise DrakeTeleopError(what, where=str(path), remedy=remedy)
    recorded = dict(re.findall(r"(\w+) ([^,\s]+)", complete.split("\n")[0]))
    for name, value in versions.items():
        if recorded.get(name) != value:
            what = f"was recorded with {name} {recorded.get(name, 'unknown')}, not with {value}"
            changed = "the models or other files that its scenario names have changed"
            raise _unrepeatable_error(changed if name == "files" else what, path)
    changes = list(_parse_csv_rows(lines[2:], path))
    if not changes or changes[-1][0] == 0:
        remedy = "record the session again"
        raise DrakeTeleopError("has a duration of 0 s", where=str(path), remedy=remedy)
    return changes


def _unrepeatable_error(what: str, path: Path) -> DrakeTeleopError:
    folder = shlex.quote(str(path.parent))
    remedy = f"it cannot be repeated exactly; to see its log, run drake-teleop replay {folder}"
    return DrakeTeleopError(what, where=str(path), remedy=remedy)


def _parse_csv_rows(lines: list[list[str]], path: Path) -> Iterator[tuple[int, Inputs]]:
    earlier, choices = -1, choice_names()
    for number, line in enumerate(lines, start=3):
        where = f"{path}:{number}"
        if len(line) != len(_CSV_COLUMNS):
            what = f"has {len(line)} values, must have {len(_CSV_COLUMNS)}, one for each column"
            raise _csv_row_error(what, where)
        for column, name in enumerate(_CSV_COLUMNS):
            if line[column] in choices.get(name, ()):
                line[column] = str(choices[name].index(line[column]))
            elif name in choices:
                raise _unrepeatable_error(f"has the unknown {name} {line[column]!r}", path)
        try:
            ms, *values = map(int, line)
        except ValueError:
            what = "has a value that is not a whole number (all inputs are integers)"
            raise _csv_row_error(what, where) from None
        if not max(earlier, 0) <= ms <= MAX_DURATION_MS or (earlier < 0 and ms):
            what = f"{ms} ms is not a valid time (first 0, never decreasing, at most 10 hours)"
            raise _csv_row_error(what, where)
        earlier, inputs = ms, dict(zip(INPUT_RANGES, values, strict=True))
        for name in INPUT_RANGES:
            low, high = input_range(name)
            high = _MAX_SCALES_IN_RECORDING.get(name, high)
            if not low <= inputs[name] <= high:
                raise _csv_row_error(f"{name} = {inputs[name]} is outside {low} to {high}", where)
        yield ms, Inputs(**inputs)


def _csv_row_error(what: str, where: str) -> DrakeTeleopError:
    return DrakeTeleopError(what, where=where, remedy="use the file as recorded")
