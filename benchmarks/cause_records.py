"""Records of a wrist sensor whose wrench contains planted causes of misfit, with the truth.

A load of 0.25 to 8 kg moves along a path of `known_paths`. `make_record` draws a record, `write`
writes its files with a description. The records do not use the package, so that errors of its signs
are found.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import yaml
from known_paths import (
    MOTIONS,
    Array,
    Load,
    Motion,
    Path_W,
    Rng,
    Span,
    direction,
    random_load,
    wrist,
)
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

GRAVITY = 9.80665
SENSORS = ("poses", "imu")
_RAMP_S = 0.25  # time in which a load goes from the table to the gripper, if it does not step
# Torque in N m over the written value, for a mistaken unit or sign.
_FACTORS = (-1.0, 10.0, 0.1, 8.8507, 1 / 8.8507, 1e3, 1e-3, 100.0, 9.80665, 1.3558, -10.0)


@dataclass
class Truth:
    """Right result of a record.

    Attributes:
        names: of the right causes.
        loads: (phi, span in s) in the order of time; one of the whole record unless it changes.
        offsets: all that may be called the offsets (before or after a factor); none if they change.
        times: spans of each cause that has a time; a step has start = stop.
        values: other figures, by name.
    """

    names: set[str]
    loads: list[tuple[Array, Span]]
    offsets: list[Array]
    times: dict[str, list[Span]] = field(default_factory=dict)
    values: dict[str, Any] = field(default_factory=dict)


@dataclass
class Draft:
    """Record without noise: causes change its wrench (N, 6), which contains the offsets."""

    rng: Rng
    t: Array
    motion: Motion
    gravity_W: Array
    load: Load
    wrench: Array
    truth: Truth
    # of the poses, in S
    frame: Array = field(default_factory=lambda: np.zeros(3))
    turn: Rotation = field(default_factory=Rotation.identity)

    @property
    def span(self) -> float:
        return float(self.t[-1])


@dataclass(frozen=True)
class CauseRecord:
    """Record: streams by name with times "t" and fields; exact `motion` at the wrench's times."""

    kind: str
    motion_name: str
    sensor: str
    seed: int
    sign: int
    streams: dict[str, dict[str, Array]]
    motion: Motion
    gravity_W: Array
    truth: Truth


def coloured(rng: Rng, shape: tuple[int, int], colour: float) -> Array:
    """Return stationary AR(1) noise of standard deviation 1."""
    x = rng.normal(size=shape)
    start = colour * rng.normal(size=(1, shape[1]))
    scale = np.sqrt(1 - colour**2)
    return np.asarray(lfilter([scale], [1, -colour], x, axis=0, zi=start)[0])


def _smooth(t: Array, start: float, stop: float, ramp: float) -> Array:
    """Return 1 between start and stop and 0 elsewhere, with ramps centred on these times."""
    up, down = (np.clip((t - x) / ramp + 0.5, 0, 1) for x in (start, stop))
    return np.asarray(up**2 * (3 - 2 * up) - down**2 * (3 - 2 * down))


def _pull(d: Draft, force_W: Array, point: Array) -> None:
    """Add an external force (N, 3) on the load at a point in S, which the sensor balances."""
    force = d.motion.in_S(force_W)
    d.wrench -= np.hstack([force, np.cross(np.broadcast_to(point, force.shape), force)])


def _scaled(d: Draft, matrix: Array) -> None:
    d.wrench = d.wrench @ matrix.T
    d.truth.offsets += [matrix @ offset for offset in d.truth.offsets]


def plant_axes(d: Draft) -> None:
    Q = np.eye(3)
    while (np.eye(3) == Q).all():
        Q = np.eye(3)[d.rng.permutation(3)] * d.rng.choice([-1.0, 1.0], 3)
    _scaled(d, np.asarray(np.kron(np.eye(2), Q)))
    d.truth.values["Q"] = Q


def plant_gravity(d: Draft) -> None:
    """Record the gravity of a tilted base, which `_draft` has drawn."""
    d.truth.values["gravity_W"] = d.gravity_W


def plant_weight(d: Draft, removed: Load | None = None) -> None:
    """Subtract the weight by the pose, as robots do, and zero the rest at the start."""
    d.wrench -= (removed or d.load).weight(d.motion, d.gravity_W)
    if removed is None or d.rng.random() < 0.5:
        d.truth.offsets = [offset - d.wrench[0] for offset in d.truth.offsets]
        d.wrench -= d.wrench[0].copy()


def plant_payload(d: Draft) -> None:
    share = d.rng.choice([d.rng.uniform(0.3, 0.85), d.rng.uniform(1.15, 1.6)])
    com = d.load.com + d.rng.uniform(0.01, 0.04) * direction(d.rng)
    removed = Load(share * d.load.mass, com, np.zeros((3, 3)))
    plant_weight(d, removed)
    d.truth.values["configured"] = removed.phi[:4]


def plant_factor(d: Draft) -> None:
    k = float(d.rng.choice(_FACTORS))
    _scaled(d, np.diag([1.0, 1.0, 1.0, k, k, k]))
    d.truth.values["k"] = k


def _a_time(d: Draft) -> float:
    """Draw a time away from the ends, and 3 s from all other causes if possible."""
    taken = [span for spans in d.truth.times.values() for span in spans]

    def room(time: float) -> float:
        return min([3.0, *(max(start - time, time - stop) for start, stop in taken)])

    return float(max(d.rng.uniform(0.2, 0.8, 50) * d.span, key=room))


def plant_tare(d: Draft) -> None:
    time = _a_time(d)
    k = int(np.searchsorted(d.t, time))
    d.wrench[k:] -= d.wrench[k].copy()
    d.truth.offsets.clear()
    d.truth.times["zero change"] = [(time, time)]


def plant_grasp(d: Draft) -> None:
    """Grasp an object, release it, or carry it for a while; at once or within 0.25 s."""
    carried = random_load(d.rng, max(0.1, d.rng.uniform(0.15, 0.6) * d.load.mass), (0.05, 0.15))
    both = d.load.with_object(carried)
    how, ramp = d.rng.choice(["grasp", "release", "carry"]), d.rng.choice([1e-6, _RAMP_S])
    start, stop = _a_time(d), 2 * d.span
    if how == "carry":
        start, stop = d.span * d.rng.uniform(0.2, 0.4), d.span * d.rng.uniform(0.55, 0.8)
    held = _smooth(d.t, start, stop, ramp)[:, None]
    parts = [d.load.phi, both.phi, d.load.phi]
    if how == "release":
        held, parts = 1 - held, [both.phi, d.load.phi]
    d.wrench += held * carried.wrench(d.motion, d.gravity_W)
    edges = [0.0, *(x for x in (start, stop) if x < d.span), d.span]
    spans = list(pairwise(edges))
    d.truth.loads = list(zip(parts, spans, strict=False))
    d.truth.times["load change"] = [(x, x) for x in edges[1:-1]]
    d.truth.values |= {"how": str(how), "ramp_s": float(ramp)}


def plant_drift(d: Draft) -> None:
    size = np.concatenate([direction(d.rng), 0.05 * direction(d.rng)]) * d.rng.uniform(1.0, 4.0)
    x = d.t / d.span
    if d.rng.random() < 0.5:
        rate = d.rng.uniform(1.0, 4.0)
        x = (1 - np.exp(-rate * x)) / (1 - np.exp(-rate))
    d.wrench += np.outer(x, size)
    d.truth.offsets.clear()
    d.truth.values["drift"] = size


def plant_gain(d: Draft) -> None:
    channel, size = int(d.rng.integers(6)), d.rng.uniform(0.015, 0.04) * d.rng.choice([-1, 1])
    _scaled(d, np.eye(6) + size * np.diag(np.eye(6)[channel]))
    d.truth.values |= {"channel": channel, "gain": float(size)}


def plant_frame(d: Draft) -> None:
    d.frame = d.rng.uniform(0.1, 0.2) * direction(d.rng)
    d.truth.values["p_SoPo_S"] = d.frame


def plant_turn(d: Draft) -> None:
    """Rotate the axes of the poses against those of the sensor."""
    d.turn = Rotation.from_rotvec(np.radians(d.rng.uniform(3, 60)) * direction(d.rng))
    d.truth.values["R_SP"] = d.turn.as_matrix()


def plant_contact(d: Draft) -> None:
    """Touch in 30 to 60 % of the time in one to three stretches, or in 88 % of it."""
    share, n = d.rng.uniform(0.3, 0.6), int(d.rng.integers(1, 4))
    if d.truth.names == {"contact"} and d.rng.random() < 0.2:
        share, n = 0.88, 1
    lengths, gaps = d.rng.uniform(0.6, 1.0, n), d.rng.uniform(0.5, 1.0, n + 1)
    lengths, gaps = lengths * share / lengths.sum(), gaps * (1 - share) / gaps.sum()
    edges = d.span * np.cumsum(np.ravel([gaps[:n], lengths], "F"))
    spans = [(float(a), float(b)) for a, b in edges.reshape(n, 2)]
    for start, stop in spans:
        within = _smooth(d.t, start, stop, d.rng.uniform(0.05, 0.2))[:, None]
        # A push that varies by 30 % in the course of seconds.
        change = coloured(d.rng, (int(d.span) + 3, 3), 0.7)
        knots = np.arange(len(change))
        varied = np.array([np.interp(d.t, knots, x) for x in change.T]).T
        push = d.rng.uniform(5.0, 20.0) * (direction(d.rng) + 0.3 * varied)
        _pull(d, within * push, d.rng.uniform(0.05, 0.17) * direction(d.rng))
    d.truth.times["contact"] = spans
    d.truth.values["share"] = share


def plant_cable(d: Draft) -> None:
    stiffness = d.rng.uniform(10.0, 40.0)
    a = d.rng.uniform(0.05, 0.15) * direction(d.rng)
    away = direction(d.rng)
    anchor_W = 0.5 + d.rng.uniform(0.6, 0.9) * np.array([*away[:2], abs(away[2])])
    line = anchor_W - (d.motion.p + d.motion.R @ a)
    length = np.linalg.norm(line, axis=1, keepdims=True)
    _pull(d, stiffness * np.maximum(length - 0.3, 0.0) * line / length, a)
    d.truth.offsets.clear()
    d.truth.values["stiffness"] = stiffness


def plant_nothing(d: Draft) -> None:
    """Leave the record as it is: good, or of a bare flange (`_draft`)."""


def plant_creep(d: Draft) -> None:
    """Add 3 % of the wrench, delayed by a first-order lag of 8 s."""
    share = -np.expm1(-(d.t[1] - d.t[0]) / 8.0)
    start = (1 - share) * d.wrench[:1]
    d.wrench += 0.03 * lfilter([share], [1, share - 1], d.wrench, axis=0, zi=start)[0]
    d.truth.offsets.clear()


def plant_hysteresis(d: Draft) -> None:
    """Add loops as wide as 2 % of the channel's range about the calibrated line."""
    half, middle = 0.01 * np.ptp(d.wrench, axis=0), d.wrench.mean(axis=0)
    out = d.wrench.copy()
    for k in range(1, len(out)):
        out[k] = np.clip(out[k - 1], out[k] - half, out[k] + half)
    x, y = d.wrench - middle, out - out.mean(axis=0)
    d.wrench = middle + y * (x * x).sum(axis=0) / (x * y).sum(axis=0)


def plant_gains(d: Draft) -> None:
    unit = np.repeat([1.0, 0.06], 3)
    _scaled(d, np.eye(6) + 0.01 * d.rng.normal(size=(6, 6)) * np.outer(unit, 1 / unit))


def plant_bumps(d: Draft) -> None:
    for time in d.rng.uniform(0.5, d.span - 0.5, 25):
        half = d.rng.uniform(0.1, 0.3)
        x = np.clip((d.t - time) / half, -1, 1)
        push = 2.0 * (1 + np.cos(np.pi * x))[:, None] * direction(d.rng)
        _pull(d, push, d.rng.uniform(0.05, 0.15) * direction(d.rng))


PLANTS: dict[str, Callable[[Draft], None]] = {
    "axes": plant_axes,
    "gravity direction": plant_gravity,
    "weight removed": plant_weight,
    "payload configured": plant_payload,
    "torque factor": plant_factor,
    "zero change": plant_tare,
    "load change": plant_grasp,
    "drift": plant_drift,
    "gain": plant_gain,
    "pose frame": plant_frame,
    "sensor rotation": plant_turn,
    "contact": plant_contact,
    "cable": plant_cable,
    "no load": plant_nothing,
}
"""Plant each cause by its name in `IdentifiedLog.causes`."""
SEVERAL = {
    "zero change + load change": ("load change", "zero change"),
    "gravity direction + drift": ("gravity direction", "drift"),
    "contact + zero change": ("contact", "zero change"),
    "load change + drift": ("load change", "drift"),
}
OUTSIDE: dict[str, Callable[[Draft], None]] = {
    "creep": plant_creep,
    "hysteresis": plant_hysteresis,
    "gain matrix": plant_gains,
    "clipping": plant_nothing,  # after the noise
    "bumps": plant_bumps,
}
GOOD = ("none", "wrist only")
KINDS = (*PLANTS, *SEVERAL, *OUTSIDE, *GOOD)
_NEED_PLACE = {"gravity direction", "pose frame", "sensor rotation", "cable"}
_NEED_TURN = {"weight removed", "payload configured"}


def possible(kind: str, sensor: str) -> bool:
    """Return whether the sensor can show the cause: an IMU shows gravity, but no position."""
    return sensor == "poses" or not _NEED_PLACE & set(SEVERAL.get(kind, (kind,)))


def make_record(
    kind: str, motion: str, sensor: str, seed: int, *, quiet: bool = False
) -> CauseRecord:
    """Return a record of one of `KINDS`, `MOTIONS`, `SENSORS`; quiet: 1e-5 of noise and delay."""
    rng = np.random.default_rng([zlib.crc32(f"{kind} {motion} {sensor}".encode()), seed])
    causes, small = SEVERAL.get(kind, (kind,)), 1e-5 if quiet else 1.0
    span = rng.uniform(40, 60) if motion == "slow" else rng.uniform(15, 60)
    span = max(span, 25.0) if kind in SEVERAL else span
    path = MOTIONS[motion](rng, span)
    if kind == "wrist only":
        path = wrist(rng, path, span, series=motion != "pick")
    draft = _draft(rng, causes, path, span)
    for cause in causes:
        (PLANTS | OUTSIDE).get(cause, plant_nothing)(draft)
    wrench = draft.wrench + small * _noise(draft, [0.0, 0.0, 0.9] + [0.97] * (kind in GOOD))
    if kind == "clipping":
        middle = np.median(wrench, axis=0)
        most = np.quantile(np.abs(wrench - middle), 0.9, axis=0)
        wrench = middle + np.clip(wrench - middle, -most, most)
    sign = int(rng.choice([-1, 1]))
    force, torque = np.split(sign * wrench, 2, axis=1)
    streams = {"wrench": {"t": draft.t, "force": force, "torque": torque}}
    streams |= (_poses if sensor == "poses" else _imu)(draft, path, causes, small)
    truth, gravity_W = draft.truth, draft.gravity_W
    return CauseRecord(kind, motion, sensor, seed, sign, streams, draft.motion, gravity_W, truth)


def _draft(rng: Rng, causes: tuple[str, ...], path: Path_W, span: float) -> Draft:
    """Draw a good record with the load and the gravity that the causes require."""
    mass = 0.0 if "no load" in causes else float(np.exp(rng.uniform(*np.log([0.25, 8.0]))))
    gravity_W = np.array([0.0, 0.0, -GRAVITY])
    if "gravity direction" in causes:
        x, y = rng.normal(size=2)
        axis = np.array([x, y, 0.0]) / np.hypot(x, y)
        degrees = np.exp(rng.uniform(0, np.log(90)))
        gravity_W = Rotation.from_rotvec(np.radians(degrees) * axis).apply(gravity_W)
    t = np.arange(0.0, span, 1 / rng.choice([125.0, 250.0, 500.0, 1000.0]))
    load, exact = random_load(rng, mass), path(t)
    offsets = rng.uniform(-1, 1, 6) * np.repeat([10.0, 0.5], 3)
    truth = Truth(set(causes) & PLANTS.keys(), [(load.phi, (0.0, span))], [offsets])
    return Draft(rng, t, exact, gravity_W, load, load.wrench(exact, gravity_W) + offsets, truth)


def _noise(d: Draft, colours: list[float]) -> Array:
    """Return the noise (N, 6) of the wrench, in the units that are written."""
    weight, colour = GRAVITY * (d.load.mass or 1.0), float(d.rng.choice(colours))
    size = float(np.clip(weight * d.rng.uniform(0.005, 0.03), 0.03, 0.3))
    d.truth.values |= {"mass": d.load.mass, "noise": size, "colour": colour}
    unit = size * np.repeat([1.0, abs(d.truth.values.get("k", 1.0)) / 20], 3)
    return np.asarray(unit * coloured(d.rng, d.wrench.shape, colour))


def _stamps(d: Draft, rates: tuple[float, ...], late: float) -> tuple[Array, Array]:
    """Draw the rows of a stream; return their true times, and their later stamps."""
    stamps = np.arange(d.rng.uniform(0.0, 0.002), d.span, 1 / d.rng.choice(rates))
    return stamps - late, stamps


def _posed(d: Draft, path: Path_W, taken: Array, stamps: Array, small: float) -> dict[str, Array]:
    motion = path(taken).displaced(d.frame)
    place = small * float(np.exp(d.rng.uniform(*np.log([20e-6, 200e-6]))))
    noise = coloured(d.rng, (len(taken), 6), float(d.rng.choice([0.0, 0.9])))
    turn = Rotation.from_rotvec(2.0 * place * noise[:, 3:])
    quaternion = (Rotation.from_matrix(motion.R) * d.turn * turn).as_quat()[:, [3, 0, 1, 2]]
    return {"t": stamps, "orientation": quaternion, "position": motion.p + place * noise[:, :3]}


def _poses(d: Draft, path: Path_W, causes: tuple[str, ...], small: float) -> dict[str, Any]:
    taken, stamps = _stamps(d, (125.0, 250.0, 500.0), float(small * d.rng.uniform(0.0, 0.01)))
    return {"pose": _posed(d, path, taken, stamps, small)}


def _imu(d: Draft, path: Path_W, causes: tuple[str, ...], small: float) -> dict[str, Any]:
    """Return specific force and rate of S; and the orientation if the robot removed a weight."""
    late = float(small * d.rng.uniform(0.0, 0.01))
    taken, stamps = _stamps(d, (100.0, 200.0, 250.0, 500.0), late)
    motion, noise = path(taken), small * d.rng.uniform([0.02, 0.001], [0.05, 0.003])
    s = motion.specific_force(d.gravity_W) + noise[0] * d.rng.normal(size=motion.a.shape)
    omega = motion.omega + noise[1] * d.rng.normal(size=motion.a.shape)
    streams = {"imu": {"t": stamps, "specific_force": s, "angular_velocity": omega}}
    if _NEED_TURN & set(causes):
        streams["pose"] = _posed(d, path, *_stamps(d, (125.0, 250.0), late), small)
        del streams["pose"]["position"]
    return streams


def write(record: CauseRecord, folder: Path) -> Path:
    """Write Parquet files and a description that is right but for the cause; return its path."""
    description: dict[str, Any] = {"gravity": GRAVITY}
    for stream, fields in record.streams.items():
        file, table = f"{stream}.parquet", dict[str, Array]()
        entry: dict[str, Any] = {"file": file, "time": {"column": "t"}}
        for name, x in fields.items():
            columns = ["t"] if name == "t" else [f"{name}_{i}" for i in range(x.shape[1])]
            table |= dict(zip(columns, np.atleast_2d(x.T), strict=True))
            if name != "t":
                form = {"form": "quaternion_wxyz"} if name == "orientation" else {}
                entry[name] = {"columns": columns} | form
        pl.DataFrame(table).write_parquet(folder / file)
        description[stream] = entry
    description["wrench"]["sign"] = record.sign
    path = folder / "log.yaml"
    path.write_text(yaml.safe_dump(description), encoding="utf-8")
    return path
