"""How does noise of the poses affect the load, and which estimator's intervals are correct?

Records are 60 s of a six-joint arm with the dimensions of a UR5e: F, Fourier series of 6 s period
and 5 harmonics; P, pick and place, minimum-jerk moves of 0.9 to 1.8 s with rests. The load is
1.7 kg. The wrench at 500 Hz has white noise of 0.1 N and 0.004 N m and offsets; the stamps of the
poses are 4 ms late. Cases have white or coloured (AR(1)) noise of the poses at several rates,
drifting offsets, or gain errors of the sensor. Baseline for the same record: the chain without
splines (zero-phase low-pass, sliding polynomials).

Columns: bias and root mean square of the mass's error [g]; the bias over the stated deviation; that
deviation [g]; the error of the centre of mass [mm]; the share of the ten parameters within 1.96
stated deviations. With splines also the errors of the pose frame.

    python benchmarks/pose_noise.py [--runs 6] [--seed 0] [--only NAME ...] [--no-present]
        [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from drake_teleop.common.rotations import rotation_matrices
from drake_teleop.load.batch.methods import identify_batch
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.pose_motion.estimate import estimate_from_poses
from drake_teleop.logs.pose_motion.poses import Poses
from drake_teleop.logs.read.alignment import (
    angular_motion,
    estimate_delay,
    low_pass_log,
    remove_delay,
    resample,
    smooth_derivatives,
)
from drake_teleop.logs.read.canonical import Log

Array = NDArray[np.float64]

GRAVITY_W = np.array([0.0, 0.0, -9.80665])
PHI = phi_from_mass_com_inertia(
    1.7,
    [0.004, -0.010, 0.062],
    [[0.0040, 0.0001, -0.0002], [0.0001, 0.0036, 0.0001], [-0.0002, 0.0001, 0.0018]],
)
OFFSETS = np.array([3.1, -1.4, 6.0, 0.13, -0.29, 0.06])
LATE = 0.004
# Denavit-Hartenberg parameters of a UR5e: a, alpha, d.
_LINKS = (
    *((0.0, np.pi / 2, 0.1625), (-0.425, 0.0, 0.0), (-0.3922, 0.0, 0.0)),
    *((0.0, np.pi / 2, 0.1333), (0.0, -np.pi / 2, 0.0997), (0.0, 0.0, 0.0996)),
)
_HOME = np.array([0.0, -1.6, 1.8, -1.8, -1.57, 0.0])


@dataclass(frozen=True)
class Case:
    """Kind of record.

    Attributes:
        place, turn: noise of position [m] and orientation [rad], of each pose and axis.
        rate: of the poses [Hz].
        colour: correlation of the poses' noise from one to the next.
        wrench_rate: [Hz].
        drift: drift of the offsets in 60 s [N]; that of torques is 0.04 m of it.
        gain: standard deviation of each entry of the sensor's matrix; it is stated.
        shift: p_SoPo_S [m].
    """

    place: float
    turn: float
    rate: float = 125.0
    colour: float = 0.0
    wrench_rate: float = 500.0
    drift: float = 0.0
    gain: float = 0.0
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)


CASES = {
    "0.05 mm, 0.1 mrad, 125 Hz": Case(5e-5, 1e-4),
    "0.2 mm, 0.2 mrad, 125 Hz": Case(2e-4, 2e-4),
    "1 mm, 1 mrad, 125 Hz": Case(1e-3, 1e-3),
    "0.2 mm, 0.4 mrad, 500 Hz": Case(2e-4, 4e-4, rate=500.0),
    "0.2 mm, 0.4 mrad, 1 kHz": Case(2e-4, 4e-4, rate=1000.0, wrench_rate=1000.0),
    "0.05 mm, 0.1 mrad, wrench 125 Hz": Case(5e-5, 1e-4, wrench_rate=125.0),
    "0.05 mm, 0.1 mrad, 500 Hz, AR 0.9": Case(5e-5, 1e-4, rate=500.0, colour=0.9),
    "0.2 mm, 0.4 mrad, 250 Hz, AR 0.9": Case(2e-4, 4e-4, rate=250.0, colour=0.9),
    "0.05 mm, 0.1 mrad, drift 0.5 N": Case(5e-5, 1e-4, drift=0.5),
    "0.05 mm, 0.1 mrad, gains 1 %": Case(5e-5, 1e-4, gain=0.01),
    "0.05 mm, 0.1 mrad, TCP 150 mm": Case(5e-5, 1e-4, shift=(0.0, 0.0, 0.15)),
}


def fourier(rng: np.random.Generator, t: Array) -> tuple[Array, Array, Array]:
    """Return q, v, vdot (N, 6): 6 s period, 5 harmonics."""
    w = 2 * np.pi / 6.0 * np.arange(1, 6)
    a, b = rng.normal(size=(2, 5, 6)) * np.array([0.5, 0.18, 0.22, 0.6, 0.6, 0.8]) / w[:, None]
    s, c = np.sin(np.outer(t, w)), np.cos(np.outer(t, w))
    return (
        _HOME + s @ a - c @ b,
        (c * w) @ a + (s * w) @ b,
        -(s * w**2) @ a + (c * w**2) @ b,
    )


def pick_and_place(rng: np.random.Generator, t: Array) -> tuple[Array, Array, Array]:
    """Return q, v, vdot (N, 6): minimum-jerk moves with rests between."""
    q, v, vdot = np.zeros((3, len(t), 6))
    now, start = _HOME, 0.3
    q[:] = now
    while start < t[-1]:
        span = rng.uniform(0.9, 1.8)
        goal = _HOME + rng.uniform(-1, 1, 6) * np.array([0.6, 0.3, 0.3, 0.45, 0.45, 1.0])
        part = (t >= start) & (t < start + span)
        x = (t[part, None] - start) / span
        step = goal - now
        q[part] = now + step * x**3 * (10 - 15 * x + 6 * x**2)
        v[part] = step * 30 * x**2 * (1 - x) ** 2 / span
        vdot[part] = step * 60 * x * (1 - x) * (1 - 2 * x) / span**2
        q[t >= start + span] = goal
        now, start = goal, start + span + rng.uniform(0.2, 0.8)
    return q, v, vdot


MOTIONS = {"F": fourier, "P": pick_and_place}


def kinematics(q: Array, v: Array, vdot: Array) -> tuple[Array, Array, Array, Array, Array]:
    """Return R_WS (N, 3, 3), p (N, 3), and in W omega, alpha and the acceleration of So."""
    n = len(q)
    R, p = np.broadcast_to(np.eye(3), (n, 3, 3)), np.zeros((n, 3))
    omega, alpha, a = np.zeros((3, n, 3))
    for k, (length, twist, offset) in enumerate(_LINKS):
        z = R[:, :, 2]
        alpha = alpha + vdot[:, k : k + 1] * z + np.cross(omega, v[:, k : k + 1] * z)
        omega = omega + v[:, k : k + 1] * z
        c, s = np.cos(q[:, k]), np.sin(q[:, k])
        ct, st = np.cos(twist), np.sin(twist)
        zero = np.zeros(n)
        turn = np.array([[c, -s * ct, s * st], [s, c * ct, -c * st], [zero, zero + st, zero + ct]])
        arm = np.einsum("nij,nj->ni", R, np.stack([length * c, length * s, zero + offset], 1))
        R = R @ turn.transpose(2, 0, 1)
        p = p + arm
        a = a + np.cross(alpha, arm) + np.cross(omega, np.cross(omega, arm))
    return R, p, omega, alpha, a


@lru_cache(maxsize=12)
def moved(motion: str, path: int, wrench_rate: float, rate: float) -> tuple[Array, ...]:
    """Return times of wrench and poses, and `kinematics` at all of them."""
    t, t_pose = np.arange(0.0, 60.0, 1 / wrench_rate), np.arange(0.0013, 60.0, 1 / rate)
    both = np.concatenate([t, t_pose])
    return t, t_pose, *kinematics(*MOTIONS[motion](np.random.default_rng([path, 7]), both))


def record(case: Case, motion: str, seed: int) -> tuple[Array, Array, Poses]:
    """Return times, wrench and poses of one record; there are 6 trajectories."""
    rng = np.random.default_rng([seed, len(motion)])
    t, t_pose, R, p, omega, alpha, a = moved(motion, seed % 6, case.wrench_rate, case.rate)
    n = len(t)
    in_S = [np.einsum("nji,nj->ni", R[:n], x[:n]) for x in (a - GRAVITY_W, omega, alpha)]
    wrench = non_contact_wrench(*in_S, PHI)
    unit = np.repeat([1.0, 0.06], 3)
    wrench = wrench @ (np.eye(6) + case.gain * rng.normal(size=(6, 6)) * np.outer(unit, 1 / unit)).T
    wrench = wrench + OFFSETS + np.repeat([0.1, 0.004], 3) * rng.normal(size=(n, 6))
    if case.drift:
        walk = np.cumsum(rng.normal(size=(n, 6)), axis=0) / np.sqrt(n)
        wrench += walk * case.drift * np.repeat([1.0, 0.04], 3)
    noise = rng.normal(size=(len(t_pose), 6))
    if case.colour:
        noise = np.sqrt(1 - case.colour**2) * lfilter([1.0], [1.0, -case.colour], noise, axis=0)
    turned = R[n:] @ rotation_matrices(case.turn * noise[:, 3:], "rotation_vector")
    q = Rotation.from_matrix(turned).as_quat()[:, [3, 0, 1, 2]]
    place = p[n:] + R[n:] @ np.array(case.shift) + case.place * noise[:, :3]
    return t, wrench, Poses(t_pose + LATE, place, q)


def present(t: Array, wrench: Array, poses: Poses, cutoff: float) -> tuple[Array, Array]:
    """Return theta and its deviations by the chain without splines, see `logs.read.reading`."""
    even = np.arange(poses.t[0], poses.t[-1], 1 / poses.rate)
    at, dt = resample(even, poses.t, poses.position), 1 / poses.rate
    R = resample(even, poses.t, rotation_matrices(poses.quaternion, "quaternion_wxyz"))
    a = smooth_derivatives(at, dt, cutoff)[2] - GRAVITY_W
    motion = np.einsum("nji,nj->ni", R, a), *angular_motion(R, dt, cutoff)
    inside = (t >= even[0]) & (t <= even[-1])
    log = Log(t[inside], wrench[inside], *(resample(t[inside], even, x) for x in motion))
    log = remove_delay(log, estimate_delay(log, cutoff) or 0.0)
    log = low_pass_log(log, cutoff)
    load = identify_batch(log.wrench, *log.motion).identification
    return np.concatenate([load.offsets, load.phi]), load.standard_deviations


def one(case: Case, motion: str, seed: int, chain: str) -> dict[str, Any]:
    """Return the errors of a record by a chain."""
    t, wrench, poses = record(case, motion, seed)
    truth = np.concatenate([OFFSETS, PHI])
    start = time.process_time()
    if chain == "new":
        found = estimate_from_poses(
            t, wrench, poses, GRAVITY_W, p_SoPo_S=case.shift, gain_std=case.gain
        )
        theta, deviations = found.theta, np.sqrt(np.diag(found.covariance))
        turn = Rotation.from_matrix(found.frame.R_SP).as_rotvec(degrees=True)
        frame = {
            "shift": (1e3 * (found.frame.p_SoPo_S - case.shift)).tolist(),
            "shift_std": (1e3 * found.frame.position_stds_m).tolist(),
            "turn": turn.tolist(),
            "turn_std": found.frame.rotation_stds_deg.tolist(),
            "named": found.frame.is_shifted or found.frame.is_rotated,
            "knots": found.splines.spacing,
            "misfit": found.fit.misfit,
            "delay": found.delay_s,
            "rejected": float(found.rejected.mean()),
        }
    else:
        theta, deviations = present(t, wrench, poses, 30.0)
        frame = {}
    cpu = time.process_time() - start
    error = theta - truth
    com = theta[7:10] / theta[6] - PHI[1:4] / PHI[0]
    return {
        "mass": 1e3 * error[6],
        "mass_std": 1e3 * deviations[6],
        "com": 1e3 * float(np.linalg.norm(com)),
        "z": (error / deviations).tolist(),
        "cpu": cpu,
        **frame,
    }


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the statistics of one case and chain."""
    mass, std = (np.array([r[k] for r in rows]) for k in ("mass", "mass_std"))
    z = np.array([r["z"] for r in rows])[:, 6:]
    out: dict[str, Any] = {
        "records": len(rows),
        "mass_bias_over_std": float(mass.mean() / std.mean()),
        "mass_bias_g": float(mass.mean()),
        "mass_rmse_g": float(np.sqrt((mass**2).mean())),
        "mass_std_g": float(std.mean()),
        "com_rmse_mm": float(np.sqrt(np.mean([r["com"] ** 2 for r in rows]))),
        "coverage_percent": float(100 * (np.abs(z) < 1.96).mean()),
        "coverage_each_percent": (100 * (np.abs(z) < 1.96).mean(axis=0)).tolist(),
        "cpu_s": float(np.median([r["cpu"] for r in rows])),
    }
    if "shift" in rows[0]:
        for name in ("shift", "turn"):
            x = np.array([r[name] for r in rows])
            out[f"{name}_rms"] = np.sqrt((x**2).mean(axis=0)).tolist()
            out[f"{name}_std"] = np.mean([r[f"{name}_std"] for r in rows], axis=0).tolist()
        out["named"] = int(sum(r["named"] for r in rows))
        out["knots_s"] = float(np.median([r["knots"] for r in rows]))
        out["misfit"] = float(np.median([r["misfit"] for r in rows]))
        out["rejected"] = float(np.mean([r["rejected"] for r in rows]))
        out["delay_rms_ms"] = float(
            1e3 * np.sqrt(np.mean([(r["delay"] - LATE) ** 2 for r in rows]))
        )
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0, help="seed of the first run (default: 0)")
    parser.add_argument("--only", nargs="*", default=[], help="parts of the names of cases")
    parser.add_argument("--motions", default="FP")
    parser.add_argument(
        "--no-present", action="store_true", help="run only the estimate by splines"
    )
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    report: dict[str, Any] = {"runs": arguments.runs, "seed": arguments.seed}
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    print(f"{'':46s}bias/sd  bias g  rmse g    sd g  com mm  cover  CPU s  knots misfit")
    for name, case in CASES.items():
        if arguments.only and not any(part in name for part in arguments.only):
            continue
        for motion in arguments.motions:
            for chain in ("new",) if arguments.no_present else ("present", "new"):
                rows = [one(case, motion, seed, chain) for seed in seeds]
                figures = summary(rows)
                report.setdefault(name, {}).setdefault(motion, {})[chain] = figures
                print(
                    f"{name:34s} {motion} {chain:8s}"
                    + " ".join(
                        f"{figures[k]:7.3g}"
                        for k in (
                            *("mass_bias_over_std", "mass_bias_g", "mass_rmse_g", "mass_std_g"),
                            *("com_rmse_mm", "coverage_percent", "cpu_s"),
                        )
                    )
                    + (
                        f" {figures['knots_s']:6.3g} {figures['misfit']:6.0f}"
                        if chain == "new"
                        else ""
                    ),
                    flush=True,
                )
                if arguments.json:  # after each line, because the whole run takes long
                    arguments.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
