"""How much of the paper's 100 N remains after elimination, by source of the motion?

The tool moves up and down at 2.63 Hz without rotation, as in the scenario free_motion_force. The
chain is truth -> sensor -> estimation of the motion -> F - F_o - V phi with the true phi. The
baseline is the same record without elimination, or with the weight alone eliminated. Then the load
is identified by least squares from 6 s in which all joints rotate.

    python benchmarks/motion_estimation.py [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydrake.systems.framework import DiagramBuilder
from rich.console import Console
from rich.table import Table
from scipy.interpolate import make_interp_spline

from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.normal_equations import identify
from drake_teleop.load.regressor import non_contact_wrench_into
from drake_teleop.station.sensor.motion_estimation import (
    MotionEstimationConfig,
    estimate_sample_into,
    initialize_motion_estimator,
    path_delays,
)
from drake_teleop.station.sensor.presets import PRESETS
from drake_teleop.station.sensor.sensor_chain import (
    NOISE_BLOCK_SIZE,
    WristSensorConfig,
    initialize_sensor_chain,
    read_sensor_into,
    without_parts,
)
from drake_teleop.station.slave.arm import sensor_motion
from drake_teleop.station.slave.home import R_WS_HOME, home_posture
from drake_teleop.station.slave.inverse_kinematics import nearest_branch
from drake_teleop.station.slave.plant import AddSlavePlant
from drake_teleop.station.slave.slave_config import Slave

Array = NDArray[np.float64]

T = 1 / 8000
SECONDS, SETTLED = 5.0, 8000
SOURCES = ("encoders", "accelerometer", "fused")
MISMATCHES = (0.0, 0.125e-3, 0.5e-3, 1e-3, 2e-3, 6e-3)
START = (0.55, 0.0, 0.45)
AMPLITUDE = 0.078


def motion(arm: Any, frequency: float, amplitude: float) -> tuple[Array, Array, Array]:
    """Return q, v, vdot (N, n) of the vertical sine, which grows for 0.6 s."""
    coarse = np.arange(0.0, SECONDS + 0.02, min(4e-3, 0.02 / frequency))
    x = np.clip(coarse / 0.6, 0.0, 1.0)
    swing = x**3 * (10 - 15 * x + 6 * x**2) * np.sin(2 * np.pi * frequency * coarse)
    path, q = [], home_posture(arm, list(START))
    for z in START[2] + amplitude * swing:
        place = np.array([START[0], START[1], z])
        q, _ = nearest_branch(R_WS_HOME.matrix(), place, q, arm.lower, arm.upper)
        path.append(q)
    spline = make_interp_spline(coarse, np.array(path), k=5)
    t = np.arange(round(SECONDS / T)) * T
    return spline(t), spline(t, 1), spline(t, 2)


@njit
def true_samples(table, phi, q, v, vdot, truth):  # type: ignore[no-untyped-def]
    x = np.empty(21)
    for k in range(q.shape[0]):
        sensor_motion(table, q[k], v[k], vdot[k], x)
        truth[k, 6:15] = x[:9]
        truth[k, 15:] = q[k]
        non_contact_wrench_into(x[:3], x[3:6], x[6:9], phi, truth[k, :6])


@njit
def read(chain, memory, noise, truth, readings):  # type: ignore[no-untyped-def]
    for k in range(truth.shape[0]):
        read_sensor_into(chain, memory, noise[k // 32], truth[k], readings[k])


@njit
def estimate(constants, memory, table, readings, samples):  # type: ignore[no-untyped-def]
    for k in range(readings.shape[0]):
        estimate_sample_into(constants, memory, table, readings[k], samples[k])


def turning(arm: Any, seed: int) -> tuple[Array, Array, Array]:
    """Return q, v, vdot (N, n): four sines in each joint, 8 rad/s^2 at most."""
    random, n = np.random.default_rng(seed), arm.num_joints
    w, phase = 2 * np.pi * random.uniform(0.5, 3.0, (4, n)), random.uniform(0, 2 * np.pi, (4, n))
    angle = w * (np.arange(round(7.0 / T)) * T)[:, None, None] + phase
    q = home_posture(arm, list(START)) + np.sum(2.0 / w**2 * np.sin(angle), axis=1)
    return q, np.sum(2.0 / w * np.cos(angle), axis=1), -np.sum(2.0 * np.sin(angle), axis=1)


class Record:
    """True motion, and the residual of its wrench after a sensor and an estimation."""

    def __init__(self, arm: Any, moved: tuple[Array, Array, Array]) -> None:
        self.arm = arm
        q, v, vdot = moved
        self.truth, still = np.empty((len(q), 15 + q.shape[1])), np.empty((len(q), 15 + q.shape[1]))
        true_samples(self.arm.table, self.arm.phi_load, q, v, vdot, self.truth)
        true_samples(self.arm.table, self.arm.phi_load, q, 0.0 * v, 0.0 * v, still)
        self.nothing = rms(self.truth[SETTLED:, :3])
        self.weight = rms((self.truth - still)[SETTLED:, :3])

    def samples(
        self,
        sensor: WristSensorConfig,
        config: MotionEstimationConfig,
        believed: WristSensorConfig | None = None,
    ) -> tuple[Array, float]:
        """Return the samples (N, 16 + n) after the start, and the microseconds per sample."""
        n = self.truth.shape[1] - 15
        noise = np.random.default_rng(0).standard_normal(
            (len(self.truth) // 32 + 1, NOISE_BLOCK_SIZE)
        )
        readings = np.empty((len(self.truth), 13 + n))
        samples = np.empty((len(self.truth), 16 + n))
        read(*initialize_sensor_chain(sensor, n, T), noise, self.truth, readings)
        constants, memory = initialize_motion_estimator(config, believed or sensor, n, T)
        begin = time.thread_time()
        estimate(constants, memory, self.arm.table, readings, samples)
        return samples[SETTLED:], (time.thread_time() - begin) / len(samples) * 1e6

    def left(
        self,
        sensor: WristSensorConfig,
        config: MotionEstimationConfig,
        believed: WristSensorConfig | None = None,
    ) -> dict[str, float]:
        """Return the residual force [N] and torque [N m], delay, and microseconds."""
        samples, microseconds = self.samples(sensor, config, believed)
        s, omega, alpha = samples[:, 6:9], samples[:, 9:12], samples[:, 12:15]
        wrench = contact_wrench(samples[:, :6], sensor.offset, s, omega, alpha, self.arm.phi_load)
        return {
            "rms": rms(wrench[:, :3]),
            "peak": float(np.linalg.norm(wrench[:, :3], axis=1).max()),
            "torque_rms": rms(wrench[:, 3:]),
            "delay_ms": 1e3 * path_delays(config, sensor, T).sample_s,
            "microseconds": microseconds,
        }

    def identified(
        self, sensor: WristSensorConfig, config: MotionEstimationConfig
    ) -> dict[str, float]:
        """Return the errors of the load by least squares at 1 kHz."""
        samples = self.samples(sensor, config)[0][::8]
        wrench, s, omega, alpha = np.split(samples[:, :15], [6, 9, 12], axis=1)
        found = identify(wrench, s, omega, alpha, noise=sensor.wrench_std())
        true = self.arm.phi_load
        (m, c, J), (m_true, c_true, J_true) = principal(found.phi), principal(true)
        return {
            "mass %": 100 * abs(m / m_true - 1),
            "com mm": 1e3 * float(np.linalg.norm(c - c_true)),
            "inertia %": 100 * float(np.abs(J / J_true - 1).max()),
            "force offset N": float(np.abs(found.offsets - sensor.offset)[:3].max()),
            "torque offset N m": float(np.abs(found.offsets - sensor.offset)[3:].max()),
        }


def principal(phi: Array) -> tuple[float, Array, Array]:
    """Return mass, centre of mass, and principal inertias about it."""
    m, c = float(phi[0]), phi[1:4] / phi[0]
    inertia = phi[[4, 5, 6, 5, 7, 8, 6, 8, 9]].reshape(3, 3)
    return m, c, np.linalg.eigvalsh(inertia - m * (c @ c * np.eye(3) - np.outer(c, c)))


def rms(rows: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(rows**2, axis=1))))


def sensors() -> dict[str, WristSensorConfig]:
    jr3, ati = (without_parts(PRESETS[name], "drift") for name in ("jr3_85m35a3", "ati_gamma_imu"))
    wrong = replace(jr3, acceleration_gain_error=0.01, acceleration_misalignment=0.01)
    return {"JR3": jr3, "JR3, accelerometer 1 % wrong": wrong, "ATI with IMU": ati}


def by_source(record: Record) -> dict[str, dict[str, float]]:
    record.left(sensors()["JR3"], MotionEstimationConfig())  # compiles
    return {
        f"{name}: {source}": record.left(sensor, MotionEstimationConfig(source=source))
        for name, sensor in sensors().items()
        for source in SOURCES
    }


def identified(arm: Any) -> dict[str, dict[str, float]]:
    """Return medians over six motions."""
    records, rows = [Record(arm, turning(arm, seed)) for seed in range(6)], {}
    for name, sensor in sensors().items():
        for source in SOURCES:
            config = MotionEstimationConfig(source=source)
            runs = [record.identified(sensor, config) for record in records]
            rows[f"{name}: {source}"] = {
                error: float(np.median([run[error] for run in runs])) for error in runs[0]
            }
    return rows


def by_mismatch(record: Record) -> dict[str, dict[str, float]]:
    """Return the residual if the accelerometer is later than the estimation assumes."""
    jr3 = without_parts(PRESETS["jr3_85m35a3"], "drift")
    return {
        source: {
            f"{1e3 * late:g} ms": record.left(
                replace(jr3, acceleration_latency=late), MotionEstimationConfig(source=source), jr3
            )["rms"]
            for late in MISMATCHES
        }
        for source in ("accelerometer", "fused")
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    arm = AddSlavePlant(DiagramBuilder(), Slave(), None).arm
    sources = by_source(Record(arm, motion(arm, 2.63, AMPLITUDE)))
    mismatches = {}
    for frequency in (2.63, 10.0, 20.0, 40.0):
        # The acceleration is the same at every frequency.
        amplitude = AMPLITUDE * (2.63 / frequency) ** 2
        record = Record(arm, motion(arm, frequency, amplitude))
        for source, row in by_mismatch(record).items():
            baseline = {"nothing": record.nothing, "weight": record.weight}
            mismatches[f"{frequency:g} Hz: {source}"] = baseline | row
    loads, console = identified(arm), Console()
    for title, rows in (
        ("by source", sources),
        ("force [N rms] by mismatch", mismatches),
        ("the load's errors", loads),
    ):
        table = Table("", *next(iter(rows.values())), title=title)
        for name, row in rows.items():
            table.add_row(name, *(f"{value:.3f}" for value in row.values()))
        console.print(table)
    if arguments.json:
        figures = {"by_source": sources, "by_mismatch": mismatches, "load": loads}
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
