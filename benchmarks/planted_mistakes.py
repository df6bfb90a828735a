"""How many planted mistakes of a description are found, and how many are false alarms?

Records are 24 s of the arm and the load of `pose_noise`, motions F and P, as files with a
description: a wrench at 500 Hz with noise and offsets, poses at 125 Hz, an IMU at 250 Hz; wrench
and
pose, wrench and IMU, or all three. A mistake is planted into the numbers or the description, and
`check_log` runs. The mistake is named if a finding has one of the right names and contains the
right
line. False alarms are findings, except "lag", of good logs: as above, with gain errors of 1 %,
slow,
hardly tilted, and real ones.

    python benchmarks/planted_mistakes.py [--runs 1] [--seed 0] [--only KIND ...] [--no-good]
        [--streams pose imu both] [--data FOLDER] [--json FILE]

FOLDER contains the records ntnu_fts_imu_contact.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import yaml
from numpy.typing import NDArray
from pose_noise import GRAVITY_W, MOTIONS, OFFSETS, PHI, kinematics
from scipy.spatial.transform import Rotation

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.processing import check_log

Array = NDArray[np.float64]
SPAN = 24.0
_WRENCH_HZ, _POSE_HZ, _IMU_HZ = 500.0, 125.0, 250.0
_HOME = np.array([0.0, -1.6, 1.8, -1.8, -1.57, 0.0])
STREAMS = {"pose": ("wrench", "pose"), "imu": ("wrench", "imu"), "both": ("wrench", "imu", "pose")}


@dataclass
class Record:
    """Numbers of each stream, by field, and the description without its columns."""

    t: dict[str, Array]
    values: dict[str, dict[str, Array]]
    seed: int
    fields: dict[str, dict[str, dict[str, Any]]] = field(default_factory=dict)
    top: dict[str, Any] = field(default_factory=dict)

    def declare(self, stream: str, name: str, **what: Any) -> None:
        self.fields.setdefault(stream, {}).setdefault(name, {}).update(what)


def make(
    motion: str, seed: int, *, gain: float = 0.0, slow: float = 1.0, tilt: float = 1.0
) -> Record:
    """Return a good record."""
    rng, path = np.random.default_rng([seed, len(motion), 3]), np.random.default_rng([seed, 7])
    t = {
        "wrench": np.arange(0.0, SPAN, 1 / _WRENCH_HZ),
        "pose": np.arange(0.0013, SPAN, 1 / _POSE_HZ),
        "imu": np.arange(0.0007, SPAN, 1 / _IMU_HZ),
    }
    q, v, vdot = MOTIONS[motion](path, np.concatenate(list(t.values())) / slow)
    q = _HOME + tilt * (q - _HOME)
    moved = kinematics(q, tilt * v / slow, tilt * vdot / slow**2)
    ends = np.cumsum([len(x) for x in t.values()])[:-1]
    parts = dict(zip(t, zip(*(np.split(x, ends) for x in moved), strict=True), strict=True))

    def in_S(stream: str) -> list[Array]:
        R, _, omega, alpha, a = parts[stream]
        return [np.einsum("nji,nj->ni", R, x) for x in (a - GRAVITY_W, omega, alpha)]

    wrench = non_contact_wrench(*in_S("wrench"), PHI)
    unit = np.repeat([1.0, 0.06], 3)
    wrench = wrench @ (np.eye(6) + gain * rng.normal(size=(6, 6)) * np.outer(unit, 1 / unit)).T
    wrench += OFFSETS + np.repeat([0.1, 0.004], 3) * rng.normal(size=wrench.shape)
    s, omega, alpha = (
        x + std * rng.normal(size=x.shape)
        for x, std in zip(in_S("imu"), (0.03, 2e-3, 0.1), strict=True)
    )
    R, p = parts["pose"][:2]
    noise = rng.normal(size=(2, len(p), 3))
    R = R @ Rotation.from_rotvec(1e-4 * noise[0]).as_matrix()
    return Record(
        t,
        {
            "wrench": {"force": wrench[:, :3], "torque": wrench[:, 3:]},
            "pose": {"orientation": _wxyz(R), "position": p + 5e-5 * noise[1]},
            "imu": {"specific_force": s, "angular_velocity": omega, "angular_acceleration": alpha},
        },
        seed,
    )


def _wxyz(R: Array) -> Array:
    return np.asarray(Rotation.from_matrix(R).as_quat()[:, [3, 0, 1, 2]])


def _matrices(record: Record) -> Array:
    q = record.values["pose"]["orientation"][:, [1, 2, 3, 0]]
    return np.asarray(Rotation.from_quat(q).as_matrix())


def written(record: Record, folder: Path, streams: tuple[str, ...]) -> Path:
    """Write the record's files and description; return its path."""
    data: dict[str, Any] = dict(record.top)
    for stream in streams:
        t = record.t[stream]
        table, told = {"t": t}, {"file": f"{stream}.parquet", "time": {"column": "t"}}
        for name, x in record.values[stream].items():
            columns = [f"{name}_{i}" for i in range(x.shape[1])]
            table |= dict(zip(columns, x.T, strict=True))
            form = {"form": "quaternion_wxyz"} if name == "orientation" else {}
            told[name] = {"columns": columns} | form | record.fields.get(stream, {}).get(name, {})
        pl.DataFrame(table).write_parquet(folder / f"{stream}.parquet")
        data[stream] = told
    path = folder / "log.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def _scaled(stream: str, name: str, factor: float) -> Callable[[Record], None]:
    def plant(record: Record) -> None:
        record.values[stream][name] = factor * record.values[stream][name]

    return plant


def _declared(stream: str, name: str, unit: str) -> Callable[[Record], None]:
    return lambda record: record.declare(stream, name, unit=unit)


def _turned(R: Array) -> Callable[[Record], None]:
    """Rotate the axes of the sensor: x of the file is R x."""

    def plant(record: Record) -> None:
        wrench = record.values["wrench"]
        for name in wrench:
            wrench[name] = wrench[name] @ np.asarray(R).T

    return plant


def _inverse(record: Record) -> None:
    record.values["pose"]["orientation"] = _wxyz(_matrices(record).transpose(0, 2, 1))


def _xyzw(record: Record) -> None:
    pose = record.values["pose"]
    pose["orientation"] = pose["orientation"][:, [1, 2, 3, 0]]


def _tcp(record: Record) -> None:
    record.values["pose"]["position"] += _matrices(record) @ [0.0, 0.0, 0.15]


def _direction(record: Record) -> Array:
    """Return a direction (3,) of length 1, from the record's seed."""
    x = np.random.default_rng([record.seed, 11]).normal(size=3)
    return np.asarray(x / np.linalg.norm(x))


def _off(record: Record) -> None:
    record.values["pose"]["position"] += _matrices(record) @ (0.02 * _direction(record))


def _tilted(record: Record) -> None:
    _turned(Rotation.from_rotvec(np.radians(10.0) * _direction(record)).as_matrix())(record)


def _slow_clock(stream: str) -> Callable[[Record], None]:
    def plant(record: Record) -> None:
        record.t[stream] = 1.01 * record.t[stream]

    return plant


def _gyro_axes(record: Record) -> None:
    imu = record.values["imu"]
    imu["angular_velocity"] = imu["angular_velocity"][:, [1, 0, 2]]
    imu["angular_acceleration"] = imu["angular_acceleration"][:, [1, 0, 2]]


def _dead(stream: str, name: str) -> Callable[[Record], None]:
    def plant(record: Record) -> None:
        record.values[stream][name][:, 1] = 0.0375

    return plant


def _same_column(stream: str, name: str) -> Callable[[Record], None]:
    def plant(record: Record) -> None:
        record.declare(stream, name, columns=[f"{name}_{i}" for i in (0, 0, 2)])

    return plant


def _copied(record: Record) -> None:
    wrench = record.values["wrench"]
    wrench["force"][:, 1] = wrench["force"][:, 0]


def _upside_down(record: Record) -> None:
    record.top["gravity"] = (-GRAVITY_W).tolist()


@dataclass(frozen=True)
class Mistake:
    """Mistake, the streams in which it is possible, and the right names and words of a finding."""

    plant: Callable[[Record], None]
    streams: tuple[str, ...]
    names: tuple[str, ...]
    says: tuple[str, ...]


ALL, POSED, SENSED = ("pose", "imu", "both"), ("pose", "both"), ("imu", "both")
_TORQUE = "wrench.torque.unit: "
_ABOUT_Z = Rotation.from_euler("z", 45, degrees=True).as_matrix()
KINDS: dict[str, Mistake] = {
    "mm as m": Mistake(
        _scaled("pose", "position", 1e3), POSED, ("units",), ("pose.position.unit: mm",)
    ),
    "m as mm": Mistake(
        _declared("pose", "position", "mm"), POSED, ("units",), ("pose.position.unit: m",)
    ),
    "N mm as N m": Mistake(
        _scaled("wrench", "torque", 1e3), ALL, ("torque factor",), (_TORQUE + "N mm",)
    ),
    "N m as N mm": Mistake(
        _declared("wrench", "torque", "N mm"), ALL, ("torque factor",), (_TORQUE,)
    ),
    "lbf in as N m": Mistake(
        _scaled("wrench", "torque", 1 / 0.1129848), ALL, ("torque factor",), (_TORQUE + "lbf in",)
    ),
    "lbf as N": Mistake(
        _scaled("wrench", "force", 1 / 4.4482216),
        ALL,
        ("torque factor",),
        ("wrench.force.unit: lbf",),
    ),
    "x, y exchanged": Mistake(
        _turned(np.eye(3)[[1, 0, 2]]), ALL, ("swapped axes",), ("_1', 'force_0', 'force_2",)
    ),
    "y mirrored": Mistake(
        _turned(np.diag([1.0, -1.0, 1.0])), ALL, ("axes",), ("sign: -1 and wrench.frame: [[-1",)
    ),
    "sign": Mistake(_turned(-np.eye(3)), ALL, ("sign",), ("wrench.sign: -1",)),
    "turned 45 deg": Mistake(
        _turned(_ABOUT_Z),
        ALL,
        ("sensor rotation", "pose frame"),
        ("rotation_in_sensor", "imu.frame"),
    ),
    "turned 180 deg": Mistake(
        _turned(np.diag([1.0, -1.0, -1.0])),
        ALL,
        ("swapped axes", "pose frame"),
        ("wrench.frame", "rotation_in_sensor"),
    ),
    "TCP 150 mm": Mistake(_tcp, POSED, ("pose frame",), ("pose.position_in_sensor",)),
    "shift 20 mm": Mistake(_off, POSED, ("pose frame",), ("pose.position_in_sensor",)),
    "turn 10 deg": Mistake(
        _tilted, POSED, ("sensor rotation", "pose frame"), ("rotation_in_sensor",)
    ),
    "clock of the pose 1 %": Mistake(_slow_clock("pose"), POSED, ("clock",), (".time.scale",)),
    "clock of the IMU 1 %": Mistake(_slow_clock("imu"), SENSED, ("clock",), (".time.scale",)),
    "alpha in deg": Mistake(
        _scaled("imu", "angular_acceleration", 180 / np.pi),
        SENSED,
        ("degrees",),
        ("imu.angular_acceleration.unit: deg/s^2",),
    ),
    "gyro in deg": Mistake(
        _scaled("imu", "angular_velocity", 180 / np.pi),
        SENSED,
        ("degrees",),
        ("imu.angular_velocity.unit: deg/s",),
    ),
    "gyro axes": Mistake(
        _gyro_axes, SENSED, ("swapped axes",), ("imu.angular_velocity.columns",)
    ),
    "s in mm/s^2": Mistake(
        _scaled("imu", "specific_force", 1e3), SENSED, ("units",), ("mm/s^2",)
    ),
    "s in g": Mistake(
        _scaled("imu", "specific_force", 1 / 9.80665),
        SENSED,
        ("units",),
        ("imu.specific_force.unit: g",),
    ),
    "|gravity| 5 % off": Mistake(
        _scaled("imu", "specific_force", 1.05), SENSED, ("gravity",), ("gravity",)
    ),
    "reversed s": Mistake(
        _scaled("imu", "specific_force", -1.0),
        SENSED,
        ("reversed gravity",),
        ("imu.sign: -1",),
    ),
    "gravity up": Mistake(
        _upside_down, ("pose",), ("reversed gravity", "sign"), ("gravity: [", "wrench.sign")
    ),
    "inverse orientation": Mistake(
        _inverse, POSED, ("inverted orientation",), ("pose.orientation.inverse: true",)
    ),
    "quaternion order": Mistake(
        _xyzw, POSED, ("quaternion order",), ("pose.orientation.form: quaternion_xyzw",)
    ),
    "dead torque": Mistake(
        _dead("wrench", "torque"), ALL, ("dead channel",), ("torque_1",)
    ),
    "dead gyro": Mistake(
        _dead("imu", "angular_velocity"), SENSED, ("dead channel",), ("angular_velocity_1",)
    ),
    "column twice": Mistake(
        _same_column("wrench", "torque"), ALL, ("repeated channel",), ("wrench.torque.columns",)
    ),
    "equal columns": Mistake(_copied, ALL, ("repeated channel",), ("wrench.force.columns",)),
}  # fmt: skip
GOOD: dict[str, dict[str, float]] = {
    "good": {},
    "gains 1 %": {"gain": 0.01},
    "slow": {"slow": 3.0},
    "hardly tilted": {"tilt": 0.35},
}


def asked(path: Path) -> list[tuple[str, str]]:
    """Return names and messages of the findings; an error counts as one without a name."""
    try:
        return [(found.name, found.message) for found in check_log(path).findings]
    except DrakeTeleopError as error:
        return [("", str(error))]


def is_named(mistake: Mistake, found: list[tuple[str, str]]) -> bool:
    return any(
        name in mistake.names and any(part in message for part in mistake.says)
        for name, message in found
    )


def of_kind(kind: str, streams: str, motion: str, seeds: range, folder: Path) -> dict[str, Any]:
    """Return how often a mistake is named."""
    named, said = 0, []
    for seed in seeds:
        record = make(motion, seed)
        KINDS[kind].plant(record)
        found = asked(written(record, folder, STREAMS[streams]))
        named += is_named(KINDS[kind], found)
        said.append(found)
    return {"named": named, "of": len(seeds), "said": said}


def alarms(kind: str, streams: str, motion: str, seeds: range, folder: Path) -> dict[str, Any]:
    """Return how many good logs have a finding."""
    said = [
        asked(written(make(motion, seed, **GOOD[kind]), folder, STREAMS[streams])) for seed in seeds
    ]
    said = [[entry for entry in found if entry[0] != "lag"] for found in said]
    return {"alarms": sum(map(bool, said)), "of": len(seeds), "said": said}


def real(data: Path, folder: Path) -> dict[str, Any]:
    """Return the findings for real records with correct descriptions."""
    matrix = [f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)]
    bias = [-0.0037, 0.0088, 0.0771]
    report: dict[str, Any] = {}
    for name in ("1-baseline", "2-vibrations"):
        files = data.resolve() / "ntnu_fts_imu_contact"
        fields: dict[str, dict[str, Any]] = {
            "wrench": {"force": {"columns": ["fx", "fy", "fz"]}, "sign": -1}
            | {"torque": {"columns": ["tx", "ty", "tz"]}},
            "accel": {"specific_force": {"columns": ["ax", "ay", "az"], "unit": "g", "bias": bias}}
            | {"frame": [[0, -1, 0], [0, 0, 1], [-1, 0, 0]]},
            "orientations": {"orientation": {"columns": matrix, "form": "matrix"}},
        }
        told = {
            stream: {
                "file": str(files / f"{name}_{file}.csv"),
                "time": {"column": "t", "unit": "us"},
            }
            | fields[file]
            for stream, file in (("wrench", "wrench"), ("imu", "accel"), ("pose", "orientations"))
        }
        for streams in ("pose", "both"):
            kept = {stream: told[stream] for stream in STREAMS[streams]}
            path = folder / "real.yaml"
            path.write_text(yaml.safe_dump({"gravity": 9.82} | kept))
            found = [entry for entry in asked(path) if entry[0] != "lag"]
            report[f"{name}, {streams}"] = {"alarms": int(bool(found)), "of": 1, "said": [found]}
    return report


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0, help="seed of the first run (default: 0)")
    parser.add_argument("--only", nargs="*", default=[], help="parts of the names of mistakes")
    parser.add_argument("--streams", nargs="*", default=list(STREAMS))
    parser.add_argument("--motions", default="FP")
    parser.add_argument("--no-good", action="store_true")
    parser.add_argument("--no-bad", action="store_true")
    parser.add_argument("--data", type=Path, help="folder of real records")
    parser.add_argument("--json", type=Path, help="file for the figures and messages")
    arguments = parser.parse_args()
    cases = [] if arguments.no_bad else [(k, of_kind, KINDS[k].streams) for k in KINDS]
    cases += [] if arguments.no_good else [(k, alarms, ALL) for k in GOOD]
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    report: dict[str, Any] = {}
    start = time.process_time()
    with tempfile.TemporaryDirectory() as name:
        for kind, count, possible in cases:
            if arguments.only and not any(part in kind for part in arguments.only):
                continue
            line = f"{kind:24s}"
            for motion in arguments.motions:
                for streams in STREAMS:
                    if streams not in possible or streams not in arguments.streams:
                        line += f"{'':12s}"
                        continue
                    got = count(kind, streams, motion, seeds, Path(name))
                    report.setdefault(kind, {})[f"{motion} {streams}"] = got
                    share = f"{got.get('named', got.get('alarms'))}/{got['of']}"
                    line += f"{motion} {streams} {share}".ljust(12)
            print(line, flush=True)
        if arguments.data:
            report["real"] = real(arguments.data, Path(name))
            for log, got in report["real"].items():
                print(f"{log:24s} alarms {got['alarms']}/{got['of']} {got['said'][0]}")
    bad = [x for k in KINDS for x in report.get(k, {}).values()]
    well = [x for k in (*GOOD, "real") for x in report.get(k, {}).values()]
    report["total"] = {
        "named": [sum(x["named"] for x in bad), sum(x["of"] for x in bad)],
        "alarms": [sum(x["alarms"] for x in well), sum(x["of"] for x in well)],
        "cpu_s": time.process_time() - start,
    }
    print(report["total"])
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
