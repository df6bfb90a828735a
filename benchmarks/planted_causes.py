"""Does `identify` name the right cause at the right time, without a false certain number?

Records of `cause_records` contain a cause, several, none, or one without a name. `identify_log`
reads
them as files. A record is *right* if exactly the right causes are named, *part* if some of
several are, *wrong* if another one is, *silent* if none is, *error* if `identify_log` raises. A
number is *false* if it is called identified and off by more than four stated deviations and more
than 2 % of its natural scale. A record that is not right, or has a false number, is *faint* if it
hardly shows its cause (`evidence`). *late* counts times off by more than 0.1 s. Coverage is
the share of identified numbers within their 95 % interval, *known* the number of identified ones.
Offsets that change are not judged. Where the load changes, the load of each stretch is judged, and
the load of the whole record must be one of the true ones.

    python benchmarks/planted_causes.py [--set causes|good|several|outside|wrist] [--kinds a,b]
        [--motions fourier,pick,slow] [--sensors poses,imu] [--seeds 0-24] [--jobs 1] [--json FILE]
        [--check]
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
import traceback
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from cause_records import (
    GRAVITY,
    KINDS,
    MOTIONS,
    OUTSIDE,
    PLANTS,
    SENSORS,
    SEVERAL,
    CauseRecord,
    make_record,
    possible,
    write,
)
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation
from scipy.stats import t as student

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.identification import PARAMETER_NAMES, Identification, natural_scales
from drake_teleop.load.regressor import regressor
from drake_teleop.logs.processing import IdentifiedLog, identify_log

Array = NDArray[np.float64]
Case = tuple[str, str, str, int]
BOTH = ("fourier", "pick")
# Kinds, motions, sensors, number of seeds.
SETS: dict[str, list[tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...], int]]] = {
    "causes": [(tuple(name for name in PLANTS if name != "sensor rotation"), BOTH, SENSORS, 25)],
    "good": [(("none",), BOTH, SENSORS, 100), (("none",), ("slow",), SENSORS, 50)],
    "several": [
        (tuple(SEVERAL), BOTH, ("poses",), 5),
        (("zero change + load change",), BOTH, ("imu",), 5),
    ],
    "outside": [(tuple(OUTSIDE), BOTH, ("poses",), 5)],
    "wrist": [(("wrist only",), BOTH, ("poses",), 25)],
}
GROUPS = {
    "offsets": slice(0, 6),
    "mass": slice(6, 7),
    "com": slice(7, 10),
    "inertia": slice(10, 16),
}
OUTCOMES = ("right", "part", "wrong", "silent", "error")
_SMALLEST_MASS = 0.1  # mass for the natural scales of an empty sensor [kg]
_DEVIATIONS, _SHARE, _LATE_S, _FAINT = 4.0, 0.02, 0.1, 60.0


def judge(found: Identification, phi: Array, offsets: Array | None) -> dict[str, Any]:
    """Return the false numbers, and for each group how many of how many intervals hold."""
    truth = np.concatenate([np.zeros(6) if offsets is None else offsets, phi])
    judged = np.array(found.identifiable) & np.repeat([offsets is not None, True], [6, 10])
    error = np.concatenate([found.offsets, found.phi]) - truth
    deviations = found.standard_deviations
    scale = natural_scales(phi if phi[0] else np.array([_SMALLEST_MASS, *np.zeros(9)]))
    off = np.abs(error)
    false = judged & (off > _DEVIATIONS * deviations) & (off > _SHARE * scale)
    inside = judged & (off < student.ppf(0.975, found.degrees_of_freedom) * deviations)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.where(judged, off / deviations, 0.0)
    return {
        "false": [
            {"name": PARAMETER_NAMES[i], "error": float(error[i]), "deviations": float(z[i])}
            for i in np.flatnonzero(false)
        ],
        "worst": float(z.max()),
        "cover": {
            name: [int(inside[part].sum()), int(judged[part].sum())]
            for name, part in GROUPS.items()
        },
    }


def _added(verdicts: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "false": [x for verdict in verdicts for x in verdict["false"]],
        "worst": max(verdict["worst"] for verdict in verdicts),
        "cover": {
            name: np.sum([verdict["cover"][name] for verdict in verdicts], axis=0).tolist()
            for name in GROUPS
        },
    }


def _best(found: Identification, phis: Iterable[Array], offsets: list[Array]) -> dict[str, Any]:
    """Judge by the nearest of the possible loads and offsets."""
    none: list[Array | None] = [None]
    options = [judge(found, *pair) for pair in product(phis, [*offsets] or none)]
    return min(options, key=lambda verdict: (len(verdict["false"]), verdict["worst"]))


def numbers(result: IdentifiedLog, record: CauseRecord) -> dict[str, Any]:
    """Judge all stated numbers."""
    truth, parts = record.truth, getattr(result, "loads", ())
    whole = _best(result.identification, [phi for phi, _ in truth.loads], truth.offsets)
    if not parts:
        return whole
    verdicts = []
    for part in parts:
        shared = [min(part.stop_s, b) - max(part.start_s, a) for _, (a, b) in truth.loads]
        phi = truth.loads[int(np.argmax(shared))][0]
        load = replace(
            result.identification,
            phi=part.phi,
            covariance=part.covariance,
            identifiable=part.identifiable,
        )
        verdicts.append(_best(load, [phi], truth.offsets))
    return _added(verdicts) | {"false": whole["false"] + _added(verdicts)["false"]}


def outcome(names: set[str], record: CauseRecord) -> str:
    right = record.truth.names
    if names == right:
        return "right"
    if not names:
        return "silent"
    return "part" if names < right else "wrong"


def time_error(causes: tuple[Any, ...], record: CauseRecord) -> float | None:
    """Return the largest distance of a true time or stretch from the nearest stated one [s]."""
    errors = []
    for name, spans in record.truth.times.items():
        stated = [
            (cause.start_s, cause.start_s if cause.stop_s is None else cause.stop_s)
            for cause in causes
            if cause.name == name and cause.start_s is not None
        ]
        if name != "contact":  # a step: both ends of the stated time may be one
            stated = [(x, x) for span in stated for x in span]
        if stated:
            apart = np.abs(np.array(spans)[:, None] - np.array(stated)[None]).max(axis=2)
            errors.append(float(apart.min(axis=1).max()))
    return max(errors, default=None)


def run(case: Case) -> dict[str, Any]:
    """Make, write, identify and judge one record."""
    record = make_record(*case)
    kind, motion, sensor, seed = case
    row: dict[str, Any] = {"kind": kind, "motion": motion, "sensor": sensor, "seed": seed}
    with tempfile.TemporaryDirectory() as folder:
        path = write(record, Path(folder))
        start = time.process_time()
        try:
            result = identify_log(path)
        except DrakeTeleopError as error:
            return row | {"outcome": "error", "message": str(error).replace(folder, "")}
        except Exception:  # a crash is a result of the benchmark, with its traceback
            return row | {"outcome": "error", "message": traceback.format_exc(limit=-3)}
        cpu = time.process_time() - start
    causes = tuple(getattr(result, "causes", ()))
    row["outcome"] = outcome({cause.name for cause in causes}, record)
    row |= numbers(result, record)
    if row["outcome"] != "right" or row["false"]:
        row["evidence"] = evidence(case)
    return row | {
        "named": [[cause.name, cause.start_s, cause.stop_s] for cause in causes],
        "messages": [cause.message for cause in causes],
        "time_error": time_error(causes, record),
        "values": {k: np.asarray(v).tolist() for k, v in record.truth.values.items()},
        "times": record.truth.times,
        "cpu": cpu,
    }


def _from_stream(record: CauseRecord, t: Array) -> tuple[Array, Array, Array]:
    """Return specific force, omega and alpha at t by splines through a quiet stream."""
    if "imu" in record.streams:
        x = record.streams["imu"]
        omega = make_interp_spline(x["t"], x["angular_velocity"], 5)
        return make_interp_spline(x["t"], x["specific_force"], 5)(t), omega(t), omega(t, 1)
    x = record.streams["pose"]
    q = x["orientation"][:, [1, 2, 3, 0]]
    flips = np.sign(np.append(1.0, (q[1:] * q[:-1]).sum(axis=1)))
    orientation = make_interp_spline(x["t"], q * np.cumprod(flips)[:, None], 5)
    q, v, vdot = orientation(t), orientation(t, 1), orientation(t, 2)
    a = make_interp_spline(x["t"], x["position"], 5)(t, 2)
    # 2 q* q', its vector.
    omega, alpha = (
        2 * (q[:, 3:] * y[:, :3] - y[:, 3:] * q[:, :3] - np.cross(q[:, :3], y[:, :3]))
        for y in (v, vdot)
    )
    return Rotation.from_quat(q).inv().apply(a - record.gravity_W), omega, alpha


def _columns(s: Array, omega: Array, alpha: Array) -> Array:
    """Return [E V] of Eq. (8), (N, 6, 16)."""
    V = regressor(s, omega, alpha)
    return np.concatenate([np.broadcast_to(np.eye(6), (len(V), 6, 6)), V], axis=2)


def check() -> None:
    """Print errors of least squares with the exact motion and with that of the streams."""
    for motion, sensor in product(MOTIONS, SENSORS):
        record = make_record("none", motion, sensor, 0, quiet=True)
        t = record.streams["wrench"]["t"]
        inner = (t > 0.5) & (t < t[-1] - 0.5)
        wrench = record.sign * _wrench(record)[inner]
        moving = record.motion
        exact = moving.specific_force(record.gravity_W), moving.omega, moving.alpha
        truth = np.concatenate([record.truth.offsets[0], record.truth.loads[0][0]])
        line = f"{motion:8s} {sensor:6s}"
        for moved in (exact, _from_stream(record, t)):
            A = _columns(*(x[inner] for x in moved))
            found = np.linalg.lstsq(A.reshape(-1, 16), wrench.ravel(), rcond=None)[0]
            line += f"  {np.abs((found - truth) / natural_scales(truth[6:])).max():.1e}"
        print(line + "  of the natural scale: exact motion, motion of the stream")


def _wrench(record: CauseRecord) -> Array:
    return np.hstack([record.streams["wrench"][name] for name in ("force", "torque")])


def evidence(case: Case) -> float:
    """Return chi squared of the best load without any cause, for exact motion and no noise.

    Below about `_FAINT` the record does not show the cause. Without a load, or if all signs are
    reversed, the only evidence is the mass.
    """
    record = make_record(*case, quiet=True)
    values, moving = record.truth.values, record.motion
    moving = moving.displaced(values.get("p_SoPo_S", np.zeros(3)))
    gravity_W = np.array([0.0, 0.0, -GRAVITY]) if case[2] == "poses" else record.gravity_W
    step = max(1, round(0.02 / record.streams["wrench"]["t"][1]))
    R = values.get("R_SP", np.eye(3))
    moved = (x[::step] @ R for x in (moving.specific_force(gravity_W), moving.omega, moving.alpha))
    # Coloured noise counts by its power at low frequency.
    colour, torque = values["colour"], abs(values.get("k", 1.0)) / 20
    unit = values["noise"] * np.repeat([1.0, torque], 3) * np.sqrt((1 + colour) / (1 - colour))
    A = (_columns(*moved) / unit[:, None]).reshape(-1, 16)
    wrench = (_wrench(record)[::step] / unit).ravel()
    left = wrench - A @ np.linalg.lstsq(A, wrench, rcond=None)[0]
    return float(step * left @ left)


def all_rows(cases: list[Case], jobs: int) -> Iterator[dict[str, Any]]:
    if jobs == 1:
        yield from map(run, cases)
        return
    with ProcessPoolExecutor(jobs) as pool:
        yield from pool.map(run, cases)


def remarks(row: dict[str, Any]) -> list[str]:
    """Return a line for each deviation from the right result, with the case."""
    where = f"{row['kind']}/{row['motion']}/{row['sensor']}/{row['seed']}"
    if row["outcome"] == "error":
        return [f"error   {where}: {row['message']}"]
    lines, shown = [], f"evidence {row.get('evidence', 0.0):.3g}"
    if row["outcome"] != "right":
        named = ", ".join(name for name, *_ in row["named"]) or "-"
        lines.append(f"{row['outcome']:7s} {where}: {named}; {shown}")
    if row["false"]:
        off = "; ".join(f"{x['name']} {x['deviations']:.1f} sd" for x in row["false"])
        lines.append(f"false   {where}: {off}; {shown}")
    return lines


def figures(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return figures of some records by name."""
    good = [row for row in rows if row["outcome"] != "error"]
    times = [row["time_error"] for row in good if row["time_error"] is not None]
    known = sum(row["cover"][name][1] for row in good for name in GROUPS)
    return {
        **{name: sum(row["outcome"] == name for row in rows) for name in OUTCOMES},
        "faint": sum(row.get("evidence", _FAINT) < _FAINT for row in good),
        "time s": float(np.median(times)) if times else None,
        "late": sum(x > _LATE_S for x in times) if times else None,
        "false": sum(len(row["false"]) for row in good),
        **{f"{name} %": percent(row["cover"][name] for row in good) for name in GROUPS},
        "known": known / len(good) if good else None,
        "CPU s": float(np.median([row["cpu"] for row in good])) if good else None,
    }


def percent(pairs: Iterable[list[int]]) -> float | None:
    inside, of = np.sum([[0, 0], *pairs], axis=0)
    return 100.0 * float(inside / of) if of else None


def summary(rows: list[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return the figures of each kind and sensor, and of all."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(f"{row['kind']}, {row['sensor']}", []).append(row)
    return {name: figures(some) for name, some in (groups | {"all": rows}).items()}


def table(report: dict[str, dict[str, Any]]) -> Table:
    shown = Table()
    shown.add_column("kind, sensor")
    for head in report["all"]:
        shown.add_column(head, justify="right")
    for name, line in report.items():
        cells = (
            "" if x is None else f"{x:d}" if isinstance(x, int) else f"{x:.3g}"
            for x in line.values()
        )
        shown.add_row(name, *cells, end_section=name == list(report)[-2])
    return shown


def _kept(names: tuple[str, ...], asked: tuple[str, ...]) -> list[str]:
    return [name for name in names if not asked or name in asked]


def chosen(arguments: argparse.Namespace) -> list[Case]:
    """Return kind, motion, sensor and seed of each record."""
    blocks = SETS[arguments.set] if arguments.set else [(KINDS, tuple(MOTIONS), SENSORS, 1)]
    cases: list[Case] = []
    for kinds, motions, sensors, n in blocks:
        first, _, last = (arguments.seeds or f"0-{n - 1}").partition("-")
        seeds = range(int(first), int(last or first) + 1)
        kept = [_kept(kinds, arguments.kinds), _kept(motions, arguments.motions)]
        kept.append(_kept(sensors, arguments.sensors))
        cases += [
            (kind, motion, sensor, seed)
            for kind, motion, sensor in product(*kept)
            if possible(kind, sensor)
            for seed in seeds
        ]
    return cases


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    names = {"kinds": KINDS, "motions": tuple(MOTIONS), "sensors": SENSORS}
    parser.add_argument(
        "--set", choices=list(SETS), help="set of kinds, motions, sensors and seeds"
    )
    for name, values in names.items():
        parser.add_argument(f"--{name}", help=f"separated by commas: {', '.join(values)}")
    parser.add_argument("--seeds", help="seeds as first-last, or one")
    parser.add_argument("--check", action="store_true", help="check the generator itself")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--json", type=Path, help="file for the figures of each record")
    arguments = parser.parse_args()
    for name, values in names.items():
        asked = getattr(arguments, name)
        setattr(arguments, name, tuple(asked.split(",")) if asked else ())
        for value in getattr(arguments, name):
            if value not in values:
                parser.error(f"--{name}: {value!r} is none of {', '.join(values)}")
    if arguments.check:
        check()
        return
    cases, rows = chosen(arguments), []
    for row in all_rows(cases, arguments.jobs):
        rows.append(row)
        print(*(f"{line}\n" for line in remarks(row)), sep="", end="", flush=True)
        if arguments.json and (
            len(rows) % 25 == 0 or len(rows) == len(cases)
        ):  # the whole run takes long
            report = {"figures": summary(rows), "records": rows}
            arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    Console(width=170).print(table(summary(rows)))


if __name__ == "__main__":
    main()
