"""How many contacts are detected, how soon, and by which detector?

`python benchmarks/contact_detection.py [--json FILE] [--hours 1]` moves a load of 3.1 kg fast and
touches it 500 times with 0.05 to 5 N in any direction, 0.3 s each. The wrench has white noise
(0.08 N, 3 mN m) and gain errors of 0.3 %; the motion has noise and an uncorrected delay of 1 ms.
Load and offsets are identified from a second motion with the same sensors; the noise floors are
fitted to a third. At the chosen thresholds, 1 % of the windows of 0.3 s have a false alarm in the
same motion without contacts, so that all detectors are compared at one rate. The rate in a fourth
motion shows whether a threshold is transferable.

The table has three wrenches: measured (tared), without the static weight (same identification), and
eliminated. Its figures are the AUC of a window's largest statistic, the share of detected contacts,
and their median delay; missed contacts count as the latest. Baselines are the raw wrench, and for
the noise floor that rises with the motion, a constant one. The time is that of one sample with all
three statistics.

The second part compares delays of the eliminated wrench at equal false alarms per time: each
statistic has the threshold that it reaches in one second of 600, in `--hours` of free motion. A
contact lasts 1 s and rises within 5 ms (hard) or 100 ms (soft). The delay is the mean, with 1 s for
a missed contact; its difference to the plain threshold is paired and has a standard error. There
are two cases: with correct gains and delay, so that the residual is white as in the station
(benchmarks/contact_in_station.py), and with the errors above. Each size has 300 contacts; the
cumulative sum has a slack for small contacts and one for large contacts.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from drake_teleop.load.batch.methods import identify_batch
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.contact.detection import fit_noise_floor, statistics_of_log
from drake_teleop.load.contact.noise_floor import (
    STATISTIC_NAMES,
    NoiseFloor,
    limit_covariance_to_scales,
)
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench

DT, WARM, WINDOW, CONTACTS = 1e-3, 700, 300, 500
FORCES = (0.05, 0.2, 1.0, 5.0)
TOOL = phi_from_mass_com_inertia(3.13, [0.004, -0.003, 0.085], np.diag([0.014, 0.0135, 0.006]))
OFFSETS = np.array([9.1, -1.0, 10.0, 0.43, -0.69, -0.16])
TIP = np.array([0.0, 0.0, 0.17])
GRAVITY = np.array([0.0, 0.0, -9.81])
WRENCH_NOISE = np.repeat([0.08, 0.003], 3)
MOTION_NOISE = (0.02, 0.002, 0.1)
LATE = 1
RIGHT = np.ones(6)
GAINS = np.array([1.003, 0.997, 1.002, 0.998, 1.003, 0.997])

Array = NDArray[np.float64]


def free_threshold(free: Array, share: float) -> float:
    """Return the least threshold that at most this share of free-motion values (N,) reach."""
    ordered = np.sort(free)[::-1]
    allowed = math.floor(share * len(ordered))
    # A statistic equal to the threshold is an alarm, so the threshold is just above the next value.
    return float(np.nextafter(ordered[allowed], np.inf)) if allowed < len(ordered) else -math.inf


def auc(free: Array, touched: Array) -> float:
    """Return the share of pairs with contact (M,) above free motion (N,); ties count half."""
    ordered = np.sort(free)
    lower, upper = (np.searchsorted(ordered, touched, side) for side in ("left", "right"))
    return float(np.mean(lower + upper) / (2.0 * len(ordered)))


def motion(samples: int, rng: np.random.Generator) -> tuple[Array, ...]:
    """Return (s, omega, alpha, gravity in S): slow swings and shakes at varying speed."""
    t = DT * np.arange(samples)

    def sines(low: float, high: float, size: float) -> Array:
        rates = 2.0 * np.pi * rng.uniform(low, high, (4, 3))
        phases = rng.uniform(0.0, 2.0 * np.pi, (4, 3))
        return size * np.sin(t[:, None, None] * rates + phases).sum(axis=1)

    busy = 0.5 + 0.5 * np.sin(2.0 * np.pi * 0.07 * t)[:, None]
    R = Rotation.from_euler("xyz", sines(0.05, 0.6, 0.3))
    steps = (R[:-1].inv() * R[1:]).as_rotvec() / DT
    omega = np.vstack([steps[:1], 0.5 * (steps[1:] + steps[:-1]), steps[-1:]])
    gravity = R.inv().apply(GRAVITY)
    acceleration = R.inv().apply(busy * sines(0.5, 3.0, 1.5))
    return acceleration - gravity, omega, np.gradient(omega, DT, axis=0), gravity


class Record:
    """Readings of the sensors along one motion; forces (N, 3) push the tool at its tip."""

    def __init__(
        self,
        samples: int,
        seed: int,
        push: Array | None = None,
        gains: Array = GAINS,
        lag: int = LATE,
    ) -> None:
        rng = np.random.default_rng(seed)
        *true, gravity = motion(samples, rng)
        self.wrench = non_contact_wrench(*true, TOOL)
        if push is not None:
            self.wrench -= np.hstack([push, np.cross(TIP, push)])
        self.wrench = OFFSETS + gains * self.wrench + WRENCH_NOISE * rng.normal(size=(samples, 6))
        late = [np.vstack([x[:1].repeat(lag, axis=0), x[: samples - lag]]) for x in true]
        self.motion = [
            x + std * rng.normal(size=x.shape) for x, std in zip(late, MOTION_NOISE, strict=True)
        ]
        self.gravity = gravity

    def rows(self, kind: str, phi: Array, offsets: Array) -> tuple[Array, ...]:
        """Return (wrench of this kind, s, omega, alpha, a)."""
        rest = np.zeros_like(self.gravity)
        if kind == "raw":
            wrench = self.wrench - offsets
        elif kind == "gravity only":
            wrench = contact_wrench(self.wrench, offsets, -self.gravity, rest, rest, phi)
        else:
            wrench = contact_wrench(self.wrench, offsets, *self.motion, phi)
        return wrench, *self.motion, self.motion[0] + self.gravity


def windows(floor: NoiseFloor, rows: tuple[Array, ...]) -> Array:
    """Return statistics (K, WINDOW, 3) up to each sample of a window; sums start with it."""
    length = WARM + WINDOW
    return np.stack(
        [
            statistics_of_log(floor, *(x[k : k + length] for x in rows))[WARM:]
            for k in range(0, len(rows[0]) - length + 1, length)
        ]
    )


def forces(rng: np.random.Generator) -> tuple[Array, Array]:
    """Return sizes (CONTACTS,) and pushes (N, 3); each rises within 5 ms."""
    sizes = np.geomspace(FORCES[0], FORCES[-1], CONTACTS)
    rng.shuffle(sizes)
    directions = rng.normal(size=(CONTACTS, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    rise = np.minimum(np.arange(1, WINDOW + 1) / 5.0, 1.0)
    push = np.zeros((CONTACTS, WARM + WINDOW, 3))
    push[:, WARM:] = rise[:, None] * (sizes[:, None] * directions)[:, None]
    return sizes, push.reshape(-1, 3)


def measure() -> dict[str, Any]:
    learnt = Record(30_000, 1)
    result = identify_batch(learnt.wrench, *learnt.motion).identification
    phi = result.phi
    sizes, push = forces(np.random.default_rng(7))
    records = [
        Record(120_000, 2),
        Record(CONTACTS * (WARM + WINDOW), 3),
        Record(CONTACTS * (WARM + WINDOW), 4),
        Record(CONTACTS * (WARM + WINDOW), 4, push),
    ]
    table = []
    for kind, fixed in (("raw", 0), ("gravity only", 0), ("eliminated", 1), ("eliminated", 0)):
        calm, elsewhere, untouched, touched = (r.rows(kind, phi, result.offsets) for r in records)
        if kind == "raw":
            # Tare within the motion: the mean weight is part of the offsets.
            mean = calm[0].mean(axis=0)
            calm, elsewhere, untouched, touched = (
                (rows[0] - mean, *rows[1:]) for rows in (calm, elsewhere, untouched, touched)
            )
        P = limit_covariance_to_scales(phi, result.covariance)
        if fixed or kind == "raw":
            P = np.zeros((16, 16))
        if fixed:
            still = [np.zeros_like(x) for x in calm[1:]]
            floor = fit_noise_floor(calm[0], *still, P)
        else:
            floor = fit_noise_floor(*calm, P)
        other, free, found = (windows(floor, rows) for rows in (elsewhere, untouched, touched))
        for i, name in enumerate(STATISTIC_NAMES):
            peaks = free[:, :, i].max(axis=1)
            threshold = free_threshold(peaks, 0.01)
            alarms = found[:, :, i] >= threshold
            delays = np.where(alarms.any(axis=1), alarms.argmax(axis=1) * 1e3 * DT, np.inf)
            row: dict[str, Any] = {
                "wrench": kind + (", fixed floor" if fixed else ""),
                "statistic": name,
                "false_elsewhere": float((other[:, :, i].max(axis=1) >= threshold).mean()),
            }
            for low, high in pairwise(FORCES):
                band = (sizes >= low) & (sizes <= high)
                row[f"{low:g} to {high:g} N"] = {
                    "auc": auc(peaks, found[band, :, i].max(axis=1)),
                    "noticed": float(alarms[band].any(axis=1).mean()),
                    "delay_ms": float(np.median(delays[band])),
                }
            table.append(row)
    start = time.thread_time()
    statistics_of_log(floor, *calm)
    return {"table": table, "us_a_sample": 1e6 * (time.thread_time() - start) / len(calm[0])}


SIZES = (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 2.0, 5.0)
RISES = {"hard": 5, "soft": 100}
SLACKS = (1.0, 1.5)
CHUNK, SECOND, EACH, BEFORE = 300_000, 1000, 300, 500


def compared(floor: NoiseFloor, rows: tuple[Array, ...]) -> Array:
    """Return (N, 4) level, glr, and the cumulative sum with each slack."""
    found = [statistics_of_log(floor, *rows, slack=slack) for slack in SLACKS]
    return np.column_stack([found[0][:, 0], found[0][:, 2], *(x[:, 1] for x in found)])


def at_equal_rate(gains: Array, lag: int, hours: float) -> dict[str, Any]:
    """Return delays at one false alarm in ten minutes, by rise and size of the contact."""
    learnt = Record(30_000, 1, None, gains, lag)
    result = identify_batch(learnt.wrench, *learnt.motion).identification
    phi, offsets = result.phi, result.offsets

    def rows(samples: int, seed: int, push: Array | None = None) -> tuple[Array, ...]:
        return Record(samples, seed, push, gains, lag).rows("eliminated", phi, offsets)

    floor = fit_noise_floor(*rows(120_000, 2), limit_covariance_to_scales(phi, result.covariance))
    chunks = round(hours * 3600 * SECOND / CHUNK)
    peaks = [
        compared(floor, rows(CHUNK, 100 + k)).reshape(-1, SECOND, 2 + len(SLACKS)).max(axis=1)
        for k in range(chunks)
    ]
    thresholds = np.array([free_threshold(x, 1 / 600) for x in np.vstack(peaks).T])
    names = ["level", "glr", *(f"cusum, slack {slack:g}" for slack in SLACKS)]
    table: dict[str, Any] = {"thresholds": dict(zip(names, thresholds, strict=True))}
    directions = np.random.default_rng(7).normal(size=(EACH, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    length = BEFORE + SECOND
    for kind, rise in RISES.items():
        for size in SIZES:
            push = np.zeros((EACH, length, 3))
            ramp = np.minimum(np.arange(1, SECOND + 1) / rise, 1.0)
            push[:, BEFORE:] = ramp[:, None] * (size * directions)[:, None]
            touched = rows(EACH * length, 9, push.reshape(-1, 3))
            alarms = [
                compared(floor, tuple(x[k : k + length] for x in touched))[BEFORE:] >= thresholds
                for k in range(0, EACH * length, length)
            ]
            delays = np.array([np.where(a.any(0), a.argmax(0), SECOND) for a in alarms], float)
            sooner = delays[:, 0] - delays[:, 1]
            table[f"{kind}, {size:g} N"] = {
                "delay_ms": dict(zip(names, delays.mean(axis=0), strict=True)),
                "glr_sooner_by_ms": float(sooner.mean()),
                "standard_error_ms": float(sooner.std(ddof=1) / np.sqrt(EACH)),
            }
    return table


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument(
        "--hours", type=float, default=1.0, help="hours of free motion for thresholds"
    )
    figures = measure() if (given := parser.parse_args()) else {}
    figures["gains and delay right"] = at_equal_rate(RIGHT, 0, given.hours)
    figures["gains and delay wrong"] = at_equal_rate(GAINS, LATE, given.hours)
    if given.json:
        given.json.write_text(json.dumps(figures, indent=2) + "\n")
    bands = [key for key in figures["table"][0] if key.endswith(" N")]
    print(f"{'AUC, noticed, median delay':36s} elsewhere " + "".join(f"{b:>24s}" for b in bands))
    for row in figures["table"]:
        cells = "".join(
            f"{c['auc']:9.3f}{100 * c['noticed']:5.0f} %{c['delay_ms']:5.0f} ms"
            for c in (row[b] for b in bands)
        )
        print(
            f"{row['wrench']:26s} {row['statistic']:10s}"
            f"{100 * row['false_elsewhere']:8.1f} %{cells}"
        )
    print(f"{figures['us_a_sample']:.2f} µs a sample")
    for regime in ("gains and delay right", "gains and delay wrong"):
        print(f"\n{regime}: mean delay [ms] at one false alarm in ten minutes; glr sooner by")
        thresholds = figures[regime].pop("thresholds")
        print(" " * 14 + "".join(f"{name:>18s}" for name in thresholds))
        print("threshold     " + "".join(f"{x:18.2f}" for x in thresholds.values()))
        for name, row in figures[regime].items():
            cells = "".join(f"{x:18.1f}" for x in row["delay_ms"].values())
            error = f"{row['glr_sooner_by_ms']:12.2f} ± {row['standard_error_ms']:.2f}"
            print(f"{name:14s}{cells}{error}")


if __name__ == "__main__":
    main()
