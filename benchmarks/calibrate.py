"""Does `calibrate` stop in time, and is the load that it calls identified correct?

`python benchmarks/calibrate.py [--json FILE] [--loads 100]` calibrates simulated loads (0.8 to 6
kg,
radii of gyration of 4 to 9 cm) in virtual time at 500 Hz. Three cases: "mass 0.5 %, com 0.5 mm"
from
a hand's motion; also "inertia 5 %" from the motion of `excite` for the shipped station; the former
from noisy poses of a hand (`posed_hand.py`).

* hand: rotations and accelerations of sines from 0.2 to 1.5 Hz with a rms of 1 to 3 rad/s, another
  motion for each load, after half a second of rest;
* noise of the wrench 0.25 N and 0.012 N m per sample at 1 kHz, white, AR(1) 0.5 or 0.9; of the
  motion 0.05 m/s^2, 0.002 rad/s, 0.2 rad/s^2, white; motion late by 0 to 8 ms; offsets.

Figures: numbers that are called known but are wrong by more than their tolerance; how often the
stated 95 % intervals contain the truth when it stops; seconds until then. Baseline: stopping at
the first check at which all 95 % intervals are inside the tolerances. The gains of the sensor are
correct, because no interval here includes gain errors.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from posed_hand import COLOURS, HZ, NOISE, posed
from scipy.signal import lfilter

from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.load.tolerance import (
    Tolerance,
    display_values_of_required_entries,
    parse_tolerance,
    tolerances_in_display_units,
)
from drake_teleop.robots.calibration import RecordEvaluation, calibrate
from drake_teleop.robots.recording import Recorder
from drake_teleop.robots.streams import Reading

Array = NDArray[np.float64]

SECONDS = 40.0
MOTION_NOISE = np.repeat([0.05, 0.002, 0.2], 3)
Motion = tuple[Array, Array, Array]


def load_of(rng: np.random.Generator) -> Array:
    """Return phi (10,) of a random tool."""
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    m, radii = rng.uniform(0.8, 6.0), rng.uniform(0.04, 0.09, 3)
    squares = m * radii**2
    inertia = (
        R @ np.diag([squares[1] + squares[2], squares[0] + squares[2], squares[:2].sum()]) @ R.T
    )
    com = rng.normal(size=3) * 0.02 + np.array([0.0, 0.0, rng.uniform(0.03, 0.12)])
    return phi_from_mass_com_inertia(m, com, 0.5 * (inertia + inertia.T))


def hand(rng: np.random.Generator, t: Array) -> Motion:
    """Return the motion of a hand that rotates and moves the tool, from rest."""
    rates = rng.uniform(0.2, 1.5, (6, 5)) * 2.0 * np.pi
    phases = rng.uniform(0.0, 2.0 * np.pi, (6, 5))
    waves = np.sin(t[:, None, None] * rates + phases).sum(axis=2) / np.sqrt(2.5)
    start = np.clip((t - 0.5) / 0.5, 0.0, 1.0)[:, None]
    start = start**2 * (3.0 - 2.0 * start)
    omega = rng.uniform(1.0, 3.0) / np.sqrt(3.0) * waves[:, :3] * start
    up = turned(omega, t[1] - t[0])
    s = 9.81 * up + rng.uniform(0.5, 2.0) * waves[:, 3:] * start
    return s, omega, np.gradient(omega, t[1] - t[0], axis=0)


def turned(omega: Array, dt: float) -> Array:
    """Return the vertical (N, 3) in S, which is z at first."""
    up = np.empty_like(omega)
    up[0] = [0.0, 0.0, 1.0]
    for k in range(1, len(omega)):  # gravity in S turns by -omega
        w = 0.5 * (omega[k] + omega[k - 1]) * dt
        angle = float(np.linalg.norm(w))
        e = w / angle if angle > 0.0 else w
        u = up[k - 1]
        up[k] = (
            u * np.cos(angle) - np.cross(e, u) * np.sin(angle) + e * (e @ u) * (1 - np.cos(angle))
        )
    return up


def excited(t: Array) -> Motion:
    """Return the motion of `excite` for the station's slave, period after period."""
    from drake_teleop.lab.excitation.excite import excite, trajectory_sensor_motion
    from drake_teleop.lab.excitation.robot import RobotFromScenario
    from drake_teleop.station.scenario import LoadScenario

    robot = RobotFromScenario(LoadScenario("contact_transition"))
    found = excite(robot, seed=0, progress=False)
    period = found.trajectory.period
    rows = np.round((t % period) * 1000.0).astype(int)
    s, omega, alpha = (
        x[np.minimum(rows, len(x) - 1)] for x in trajectory_sensor_motion(robot, found.trajectory)
    )
    return s, omega, alpha


class Stream:
    """Source that delivers readings without waiting."""

    live = False

    def __init__(self, t: Array, values: Array) -> None:
        self.dt = float(t[1] - t[0])
        self._t, self._values, self._at = t, values, 0

    @property
    def recorded(self) -> tuple[Array, Array]:
        """Return times (N,) and values (N, 15) of all readings."""
        return self._t, self._values

    def read(self, timeout_s: float) -> list[Reading] | None:
        """See `Source`."""
        start, self._at = self._at, min(self._at + 64, len(self._t))
        if start == len(self._t):
            return None
        return [Reading(k, float(self._t[k]), self._values[k]) for k in range(start, self._at)]

    def close(self) -> None:
        """See `Source`."""


def stream_of(
    rng: np.random.Generator, phi: Array, t: Array, motion: Motion, late: int | None = None
) -> Stream:
    """Return the sensors' readings; the motion is `late` samples late, or 0 to 4."""
    a = rng.choice(COLOURS)
    white = rng.normal(size=(len(t) + 500, 6)) * np.sqrt(1.0 - a * a)
    noise = lfilter([1.0], [1.0, -a], white, axis=0)[500:] * NOISE
    wrench = (
        non_contact_wrench(*motion, phi) + rng.normal(size=6) * np.repeat([5.0, 0.3], 3) + noise
    )
    drawn = int(rng.integers(0, 5))
    late = drawn if late is None else late
    moved = np.hstack(motion)
    moved = np.concatenate([np.repeat(moved[:1], late, axis=0), moved[: len(moved) - late]])
    return Stream(t, np.hstack([wrench, moved + MOTION_NOISE * rng.normal(size=moved.shape)]))


def judged(at: RecordEvaluation, tolerance: Tolerance, phi: Array) -> dict[str, Any]:
    """Return errors over tolerances, and which intervals contain the truth, at one check."""
    assert at.identified_log is not None
    found = at.identified_log.identification.phi
    error = np.abs(
        display_values_of_required_entries(tolerance, found)
        - display_values_of_required_entries(tolerance, phi)
    ) / tolerances_in_display_units(tolerance, phi)
    return {
        "t": at.record_length_s,
        "error": error.tolist(),
        "held": (error <= at.relative_half_widths).tolist(),
    }


def study(name: str, until: str, loads: int, folder: Path) -> dict[str, float]:
    """Return the figures of one motion."""
    tolerance, t = parse_tolerance(until), np.arange(round(SECONDS * HZ)) / HZ
    motion = excited(t) if name == "excite" else None
    stops: list[dict[str, Any]] = []
    first: list[dict[str, Any]] = []
    false, unknown, counted = 0, 0, 0
    for k in range(loads):
        rng = np.random.default_rng([k, len(name)])
        phi = load_of(rng)
        stream: Any
        keeps: Any
        if name == "poses":
            stream, keeps = posed(rng, phi, SECONDS)
        else:
            stream, keeps = stream_of(rng, phi, t, motion or hand(rng, t)), Recorder()
        looks = calibrate(stream, keeps, folder / keeps.log_file_name, tolerance)
        for at in looks:
            if at.identified_log is not None:
                wrong = np.array(judged(at, tolerance, phi)["error"]) > 1.0
                false += int((wrong & at.is_known).sum())
                counted += int(at.is_known.sum())
        last = looks[-1]
        if not last.is_known.all():
            unknown += 1
            continue
        stops.append(judged(last, tolerance, phi))
        hasty = next(
            at
            for at in looks
            if at.identified_log is not None and (at.relative_half_widths <= 1.0).all()
        )
        first.append(judged(hasty, tolerance, phi))
    figures: dict[str, float] = {"loads": loads, "not_known": unknown}
    figures |= {"false_known": false, "called_known_at_any_look": counted}
    for label, ends in (("", stops), ("baseline_", first)):
        held = np.array([end["held"] for end in ends])
        wrong = np.array([end["error"] for end in ends]) > 1.0
        figures[f"{label}coverage"] = float(held.mean())
        figures[f"{label}coverage_least"] = float(held.mean(axis=0).min())
        figures[f"{label}coverage_most"] = float(held.mean(axis=0).max())
        figures[f"{label}wrong_at_the_end"] = int(wrong.sum())
        figures[f"{label}median_s"] = float(np.median([end["t"] for end in ends]))
        figures[f"{label}longest_s"] = float(np.max([end["t"] for end in ends]))
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--loads", type=int, default=100, help="loads for each motion")
    parser.add_argument("--only", choices=["hand", "excite", "poses"], help="only this motion")
    options = parser.parse_args()
    figures = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, until in (
            ("hand", "mass 0.5 %, com 0.5 mm"),
            ("excite", "mass 0.5 %, com 0.5 mm, inertia 5 %"),
            ("poses", "mass 0.5 %, com 0.5 mm"),
        ):
            if options.only not in (None, name):
                continue
            for key, value in study(name, until, options.loads, Path(folder)).items():
                figures[f"{name}.{key}"] = round(value, 4)
                print(f"{name + '.' + key:40} {value:.4g}", flush=True)
    if options.json is not None:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
