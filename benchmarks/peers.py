"""Is the load of `identify` truer than that of other tools, and is less of the wrench left?

`python benchmarks/peers.py [--json FILE] [--loads 30] [--ntnu DIR] [--bota PYTHON]`, in 10 s each:

* ours: `identify` of one motion of `excite` for the shipped arm, noise, offsets and delay as in
  calibrate.py; `known` by the rule of `calibrate` for "mass 0.5 %, com 0.5 mm, inertia 5 %";
* least squares: mass, centre of mass, inertia and offsets by plain least squares of the same log,
  low-passed, without delay, N and N m with equal weights, as in scripts; intervals of white noise;
* kth: 20 poses at rest in the same time in all, without time between poses; mass, centre of mass
  and offsets by plain least squares, as force_torque_tools and ft_tools_ros2 do it; no inertia.
  The mean of a pose has the residual error of the same coloured noise;
* ours at rest: `identify` of those poses;
* static: the same without offsets, as aiofranka's payload.py does it from joint torques after a
  tare in free air: offsets are removed with an error of 0.2 N and 0.01 N m;
* vendor: gravity alone, by the true mass and centre of mass as user input, and a tare at the start.

With --rls, recursive least squares of gravity, bias and mounting is compared for this number of
loads, in slow motion and in a hand's. Its model is a 3 x 4 matrix times [vertical, 1] for force and
for torque, as arXiv 2604.23696 describes it; its forgetting factor is ours. Next to it: `identify`
of one motion of `excite`, and a tare. Figures are the removed share of the wrench in the second
half.

The held-out record is another motion of the same load, with other offsets, a tare, and 30 Hz. With
--bota, the Python of an environment that has bota-payload-utils and numpy, its estimator gets five
loads' motions (a hand's, 15 s each), paced by the clock. With --ntnu, the load of NTNU's 24 poses
and its residual of the two records in motion, without the mean.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from calibrate import COLOURS, HZ, NOISE, Motion, Stream, excited, hand, load_of, stream_of, turned
from numpy.typing import NDArray

from drake_teleop.load.batch.methods import identify_batch
from drake_teleop.load.batch.uncertainty import confidence_intervals
from drake_teleop.load.inertia import is_physically_consistent, mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench, regressor
from drake_teleop.load.tolerance import (
    display_values_of_required_entries,
    parse_tolerance,
    tolerances_in_display_units,
)
from drake_teleop.logs.processing import identify_log, phi_with_inertia_replaced
from drake_teleop.logs.read.alignment import choose_delay, low_pass, remove_delay
from drake_teleop.logs.read.canonical import Log, write_log
from drake_teleop.logs.read.reading import read_log
from drake_teleop.robots.calibration import evaluate_record

Array = NDArray[np.float64]

ASKED = parse_tolerance("mass 0.5 %, com 0.5 mm, inertia 5 %")
SECONDS, POSES = 10.0, 20
WORDS = ("mass_%", "com_mm", "inertia_%", "physical", "left_N", "left_N_m")
PEERS = ("ours", "least squares", "kth", "ours at rest", "static", "vendor")


class Found(NamedTuple):
    """Load by one of the methods, with ends (16,) of its intervals, or None."""

    phi: Array
    low: Array | None = None
    high: Array | None = None


def log_of(stream: Stream) -> Log:
    """Return the log of a stream."""
    t, values = stream.recorded
    return Log(t, *np.split(values, [6, 9, 12], axis=1))


def ours(log: Log, path: Path) -> Found:
    """Return the result of `identify`."""
    write_log(log, path)
    load = identify_log(path).identification
    return Found(load.phi, *confidence_intervals(load))


def least_squares(log: Log) -> Found:
    """Return the result of plain least squares, with the covariance for white noise."""
    wrench, *motion = (low_pass(x, log.dt, 30.0) for x in (log.wrench, *log.motion))
    V = regressor(*motion)
    rows = np.concatenate([np.tile(np.eye(6), (len(V), 1, 1)), V], axis=2).reshape(-1, 16)
    theta, squares, *_ = np.linalg.lstsq(rows, wrench.ravel(), rcond=None)
    deviations = np.sqrt(np.diag(np.linalg.inv(rows.T @ rows)) * squares[0] / len(rows))
    return Found(theta[6:], theta - 1.96 * deviations, theta + 1.96 * deviations)


def at_rest(rng: np.random.Generator, phi: Array, *, tared: bool) -> tuple[Array, Array]:
    """Return specific forces (20, 3) and mean wrenches (20, 6) of poses at rest."""
    up = rng.normal(size=(POSES, 3))
    s = 9.81 * up / np.linalg.norm(up, axis=1, keepdims=True)
    still = np.zeros_like(s)
    a = rng.choice(COLOURS)  # AR(1): the variance of a mean grows by (1 + a) / (1 - a)
    noise = NOISE * rng.normal(size=(POSES, 6)) / np.sqrt(SECONDS * HZ / POSES)
    noise *= np.sqrt((1.0 + a) / (1.0 - a))
    left = rng.normal(size=6) * (np.repeat([0.2, 0.01] if tared else [5.0, 0.3], 3))
    return s, non_contact_wrench(s, still, still, phi) + left + noise


def static(s: Array, wrench: Array, *, offsets: bool) -> Found:
    """Return first moments, with or without offsets, by plain least squares."""
    still = np.zeros_like(s)
    rows = regressor(s, still, still)[:, :, :4]
    if offsets:
        rows = np.concatenate([rows, np.tile(np.eye(6), (POSES, 1, 1))], axis=2)
    theta = np.linalg.lstsq(rows.reshape(6 * POSES, -1), wrench.ravel(), rcond=None)[0]
    return Found(np.concatenate([theta[:4], np.zeros(6)]))


def ours_at_rest(s: Array, wrench: Array) -> Found:
    """Return the result of `identify` for static poses."""
    still = np.zeros_like(s)
    load = identify_batch(wrench, s, still, still, shared_noise=True).identification
    return Found(phi_with_inertia_replaced(load)[0])


def held_out(log: Log, phi: Array, up: Array | None = None) -> tuple[float, float]:
    """Return the rms residual of |f| and |tau| after a tare over the record, at 30 Hz.

    If the vertical `up` in S (N, 3) is given, only the weight is removed.
    """
    s, omega, alpha = log.motion
    if up is not None:
        s, omega, alpha = 9.81 * up, still_of(log), still_of(log)
    left = low_pass(log.wrench - non_contact_wrench(s, omega, alpha, phi), log.dt, 30.0)
    left = left - left.mean(axis=0)
    f, tau = (float(np.sqrt((x**2).sum(axis=1).mean())) for x in (left[:, :3], left[:, 3:]))
    return f, tau


def simulated(loads: int, folder: Path) -> dict[str, Any]:
    """Return the figures of the simulated arm."""
    t = np.arange(round(SECONDS * HZ)) / HZ
    motion = excited(t)
    rows: dict[str, list[list[float]]] = {name: [] for name in PEERS}
    covered: dict[str, list[Array]] = {"ours": [], "least squares": []}
    false = 0
    for k in range(loads):
        rng = np.random.default_rng([k, 99])
        phi = load_of(rng)
        log, path = log_of(stream_of(rng, phi, t, motion, late=2)), folder / "log.parquet"
        fresh: Motion = hand(rng, t)
        other = log_of(stream_of(rng, phi, t, fresh, late=0))
        up = turned(fresh[1], t[1])
        poses = at_rest(rng, phi, tared=False)
        found = {
            "ours": ours(log, path),
            "least squares": least_squares(log),
            "kth": static(*poses, offsets=True),
            "ours at rest": ours_at_rest(*poses),
            "static": static(*at_rest(rng, phi, tared=True), offsets=False),
            "vendor": Found(np.concatenate([phi[:4], np.zeros(6)])),
        }
        at = evaluate_record(path, ASKED, None, cutoff_hz=30.0, delay="auto")
        for name, each in found.items():
            error = np.abs(
                display_values_of_required_entries(ASKED, each.phi)
                - display_values_of_required_entries(ASKED, phi)
            )
            relative = (
                error
                / tolerances_in_display_units(ASKED, phi)
                * np.repeat([0.5, 0.5, 5.0], [1, 3, 6])
            )
            if name == "ours":
                false += int(
                    (
                        at.is_within_tolerance & (relative > np.repeat([0.5, 0.5, 5.0], [1, 3, 6]))
                    ).sum()
                )
            if each.low is not None and each.high is not None:
                held = (each.low[6:] <= phi) & (phi <= each.high[6:])
                covered[name].append(held)
            left = held_out(other, each.phi, up if name == "vendor" else None)
            physical = float(is_physically_consistent(each.phi))
            rows[name].append(
                [relative[0], relative[1:4].max(), relative[4:].max(), physical, *left]
            )
    figures: dict[str, Any] = {"ours.false_known": false}
    for name in PEERS:
        medians, mean = np.median(rows[name], axis=0), np.mean(rows[name], axis=0)
        for i, word in enumerate(WORDS):
            figures[f"{name}.{word}"] = float(mean[i] if word == "physical" else medians[i])
    for name, held in covered.items():
        figures[f"{name}.coverage_95"] = float(np.mean(held))
    return figures


def slowed(rng: np.random.Generator, t: Array, factor: float) -> Motion:
    """Return a hand's motion that is `factor` times as slow."""
    s, omega, alpha = hand(rng, t / factor)
    up = turned(omega, (t[1] - t[0]) / factor)
    return 9.81 * up + (s - 9.81 * up) / factor**2, omega / factor, alpha / factor**2


def recursive_gravity(up: Array, wrench: Array, forgetting: float) -> Array:
    """Return predictions (N, 6) of the wrench, each from the samples before it."""
    P, theta, predicted = 1e6 * np.eye(4), np.zeros((4, 6)), np.empty_like(wrench)
    for row, measured, out in zip(np.c_[up, np.ones(len(up))], wrench, predicted, strict=True):
        out[:] = row @ theta
        gain = P @ row / (forgetting + row @ P @ row)
        theta += np.outer(gain, measured - out)
        P = (P - np.outer(gain, row @ P)) / forgetting
    return predicted


def recursive(loads: int, folder: Path) -> dict[str, Any]:
    """Return the removed shares of the wrench by recursive least squares and by ours [%]."""
    shares: dict[str, list[Array]] = {}
    t = np.arange(round(SECONDS * HZ)) / HZ
    excitation = excited(t)
    for k in range(loads):
        rng = np.random.default_rng([k, 23696])
        phi = load_of(rng)
        found = ours(log_of(stream_of(rng, phi, t, excitation, late=0)), folder / "log.parquet")
        for domain, factor in (("slow", 10.0), ("fast", 1.0)):
            seen = np.arange(6000) / 100.0
            motion = slowed(rng, seen, factor)
            log = log_of(stream_of(rng, phi, seen, motion, late=0))
            up = turned(motion[1], log.dt)
            half = len(seen) // 2
            ours_left = log.wrench - non_contact_wrench(*log.motion, found.phi)
            ours_left -= ours_left[:half].mean(axis=0)
            peer_left = log.wrench - recursive_gravity(up, log.wrench, 0.999)
            for name, left in (("rls", peer_left), ("ours", ours_left)):
                of = [
                    np.sqrt((x[half:].reshape(-1, 2, 3) ** 2).sum(axis=2).mean(axis=0))
                    for x in (low_pass(left, log.dt, 10.0), log.wrench)
                ]
                shares.setdefault(f"{name} {domain}", []).append(100.0 * (1.0 - of[0] / of[1]))
    return {
        f"{name}.removed_{what}_%": float(np.median(rows, axis=0)[i])
        for name, rows in shares.items()
        for i, what in enumerate(("force", "torque"))
    }


# Script for another Python: config, and t and rows as .npy; in the sensor's convention, paced by
# the clock.
_BOTA = """
import sys, time
import numpy as np
from bota_payload_utils import BotaPayloadEstimator
estimator = BotaPayloadEstimator(sys.argv[1])
t, rows = np.load(sys.argv[2]), np.load(sys.argv[3])
estimator.start_payload_estimation()
start = time.monotonic()
for when, row in zip(t, rows):
    while (now := time.monotonic() - start) < when:
        time.sleep(2e-4)
    estimator.update(now, row)
    if not estimator.is_estimator_running():
        break
print("STOPPED", when, int(estimator.is_estimation_successful()))
"""


def bota(python: Path, loads: int, folder: Path) -> dict[str, Any]:
    """Return the figures of bota-payload-utils, with guessed thresholds and covariances."""
    t = np.arange(round(15.0 * HZ)) / HZ
    stops, errors, physical = [], [], []
    for k in range(loads):
        rng = np.random.default_rng([k, 4])
        phi = load_of(rng)
        _, values = stream_of(rng, phi, t, hand(rng, t), late=0).recorded
        rows = np.ascontiguousarray(np.hstack([-values[:, :6], values[:, 6:12]]))
        np.save(folder / "t.npy", t)
        np.save(folder / "rows.npy", rows)
        result = folder / f"bota{k}.json"
        axes = (*"xyz", "Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
        variances = {
            "force": 0.03,
            "torque": 7e-5,
            "linear_acc": 2.5e-3,
            "angular_vel": 4e-6,
            "angular_acc": 0.04,
            "wrench_bias": 1e-6,
        }
        entries = ("Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
        config = {
            "min_time": 3.0,
            "max_time": 14.5,
            "estimation_covariance_convergence_threshold": {
                "mass": 1e-2,
                "com": 1e-3,
                "inertia": 1e-3,
                "wrench_bias": 1e-1,
            },
            "measurement_noise_covariance": {
                name: dict.fromkeys(axes, variance) for name, variance in variances.items()
            },
            "output_bias_estimate": True,
            "output_config_file_name": str(result),
            "prior_payload_properties": {
                "mass": 1.0,
                "com": {"x": 0.0, "y": 0.0, "z": 0.05},
                "inertia": dict(zip(entries, (0.01, 0.0, 0.0, 0.01, 0.0, 0.01), strict=True)),
            },
        }
        (folder / "config.json").write_text(json.dumps({"payload_estimator_config": config}))
        files = [str(folder / name) for name in ("config.json", "t.npy", "rows.npy")]
        said = subprocess.run(
            [str(python), "-c", _BOTA, *files], capture_output=True, text=True, check=True
        ).stdout
        words = said[said.index("STOPPED") :].split()
        if words[2] != "1":
            continue
        stops.append(float(words[1]))
        load = json.loads(result.read_text())["payload_compensator_config"]["payload_properties"]
        com = np.array([load["com"][a] for a in "xyz"])
        about = np.array([load["inertia"][name] for name in entries])
        I = about[[0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(3, 3)  # noqa: E741
        m, c, true = mass_com_inertia(phi)
        moments = np.linalg.eigvalsh(I)
        physical.append(moments[0] > 0.0 and 2.0 * moments[2] <= moments.sum())
        errors.append(
            [
                100.0 * abs(load["mass"] / m - 1.0),
                1e3 * np.abs(com - c).max(),
                100.0 * np.abs(I - true).max() / (np.trace(true) / 3.0),
            ]
        )
    figures: dict[str, Any] = {"bota.loads": loads, "bota.called_converged": len(stops)}
    if stops:
        medians = np.median(errors, axis=0)
        false = (np.array(errors) > [0.5, 0.5, 5.0]).any(axis=1).sum()
        figures |= {
            "bota.converged_but_wrong": int(false),
            "bota.median_s": float(np.median(stops)),
            **{f"bota.{word}": float(x) for word, x in zip(WORDS, medians, strict=False)},
            "bota.physical": float(np.mean(physical)),
        }
    return figures


def ntnu(records: Path, folder: Path) -> dict[str, Any]:
    """Return the residual of NTNU's two records in motion, by the load of its 24 poses."""
    figures = {}
    poses = np.genfromtxt(records / "0-calibration_fts-accel.csv", delimiter=",", names=True)
    wrench = -np.column_stack([poses[name] for name in ("fx", "fy", "fz", "tx", "ty", "tz")])
    gravity = np.column_stack([poses[name] for name in ("gx", "gy", "gz")])
    still = np.zeros_like(gravity)
    rows = np.concatenate(
        [regressor(-gravity, still, still)[:, :, :4], np.tile(np.eye(6), (len(poses), 1, 1))],
        axis=2,
    )
    theta = np.linalg.lstsq(rows.reshape(-1, 10), wrench.ravel(), rcond=None)[0]
    fit = identify_batch(wrench, -gravity, still, still, shared_noise=True).identification
    by_peer = {
        "ours": phi_with_inertia_replaced(fit)[0],
        "kth": np.concatenate([theta[:4], np.zeros(6)]),
    }
    for record in ("1-baseline", "2-vibrations"):
        log = read_log(described(records, record, folder))
        late = remove_delay(log, choose_delay(log, 30.0, "auto", by_peer["ours"])[0])
        for name, phi in by_peer.items():
            # Other methods have neither a delay nor more than gravity.
            of = late if name == "ours" else log
            motion = of.motion if name == "ours" else (-of.gravity, still_of(of), still_of(of))
            left = low_pass(of.wrench - non_contact_wrench(*motion, phi), of.dt, 30.0)[:, :3]
            left = left - left.mean(axis=0)
            figures[f"{name}.{record}.left_N"] = float(np.sqrt((left**2).sum(axis=1).mean()))
        figures[f"{record}.weight_N"] = 9.82085 * float(by_peer["kth"][0])
    return figures


def still_of(log: Log) -> Array:
    """Return zeros (N, 3)."""
    return np.zeros((len(log), 3))


def described(records: Path, record: str, folder: Path) -> Path:
    """Return the description of a record, as in docs/logs.md."""
    time = {"column": "t", "unit": "us"}
    files = {name: str(records / f"{record}_{name}.csv") for name in ("wrench", "accel")}
    document = {
        "gravity": 9.82085,
        "wrench": {
            "file": files["wrench"],
            "time": time,
            "force": {"columns": ["fx", "fy", "fz"], "unit": "N"},
            "torque": {"columns": ["tx", "ty", "tz"], "unit": "N m"},
            "sign": -1,
        },
        "imu": {
            "file": files["accel"],
            "time": time,
            "specific_force": {
                "columns": ["ax", "ay", "az"],
                "unit": "g",
                "bias": [-0.0037, 0.0088, 0.0771],
            },
            "frame": [[0, -1, 0], [0, 0, 1], [-1, 0, 0]],
        },
        "pose": {
            "file": str(records / f"{record}_orientations.csv"),
            "time": time,
            "orientation": {
                "columns": [f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)],
                "form": "matrix",
            },
        },
    }
    path = folder / f"{record}.yaml"
    path.write_text(json.dumps(document))
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--loads", type=int, default=30)
    parser.add_argument("--rls", type=int, default=0, help="loads for recursive least squares")
    parser.add_argument("--ntnu", type=Path, help="folder of the records of NTNU")
    parser.add_argument(
        "--bota", type=Path, help="Python of an environment with bota-payload-utils and numpy"
    )
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        figures = simulated(options.loads, Path(folder)) if options.loads else {}
        if options.rls:
            figures |= recursive(options.rls, Path(folder))
        if options.ntnu is not None:
            figures |= ntnu(options.ntnu, Path(folder))
        if options.bota is not None:
            figures |= bota(options.bota, 5, Path(folder))
    for name, value in figures.items():
        print(f"{name:32} {value:.4g}")
    if options.json is not None:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
