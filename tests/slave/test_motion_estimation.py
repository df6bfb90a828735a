"""Motion of S from encoders and accelerometer: exactness, delays, gains, what elimination leaves."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit
from numpy.typing import NDArray
from pydrake.systems.framework import DiagramBuilder
from scipy.interpolate import make_interp_spline
from scipy.linalg import solve_discrete_are

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.regressor import non_contact_wrench_into
from drake_teleop.slave.arm import sensor_motion
from drake_teleop.slave.inverse_kinematics import nearest_branch
from drake_teleop.slave.motion_estimation import (
    MotionEstimationConfig,
    _track,
    estimate_into,
    motion_estimator,
    motion_gains,
    path_delays,
    steady_state,
)
from drake_teleop.slave.plant import R_WS_HOME, AddSlavePlant, home_position
from drake_teleop.slave.sensor_chain import (
    NOISE_SIZE,
    PRESETS,
    WristSensorConfig,
    read_into,
    sensor_chain,
    without,
)

Array = NDArray[np.float64]

T = 1 / 8000
SOURCES = ("encoders", "accelerometer", "fused")
ARM = AddSlavePlant(DiagramBuilder(), [0.55, 0.0, 0.45], None).arm
HOME = home_position(ARM, [0.55, 0.0, 0.45])
JR3 = PRESETS["jr3_85m35a3"]
#: Nothing but its low-pass, and an accelerometer that is somewhere and looks somewhere else.
QUIET = dataclasses.replace(
    without(JR3, "noise", "random_walk", "offset", "drift", "quantisation"),
    p_SoAo_S=[0.02, -0.03, 0.05],
    R_SA=[0.0, -1.0, 0.0, 0.0, 0.0, 1.0, -1.0, 0.0, 0.0],
)


@njit
def _true(table, phi, q, v, vdot, truth):
    motion = np.empty(21)
    for k in range(q.shape[0]):
        sensor_motion(table, q[k], v[k], vdot[k], motion)
        truth[k, 6:15] = motion[:9]
        truth[k, 15:] = q[k]
        non_contact_wrench_into(motion[:3], motion[3:6], motion[6:9], phi, truth[k, :6])


@njit
def _sampled(table, truth, chain, chain_memory, noise, constants, memory, samples):
    reading = np.empty(truth.shape[1] - 2)
    for k in range(truth.shape[0]):
        read_into(chain, chain_memory, noise[k // 32], truth[k], reading)
        estimate_into(constants, memory, table, reading, samples[k])


def truth_of(motion, arm=ARM) -> Array:
    q, v, vdot = motion
    truth = np.empty((len(q), 15 + q.shape[1]))
    _true(arm.table, ARM.phi_load, q, v, vdot, truth)
    return truth


def sampled(
    truth: Array,
    sensor: WristSensorConfig,
    config: MotionEstimationConfig,
    believed: WristSensorConfig | None = None,
    table: Array = ARM.table,
    seed: int = 0,
) -> Array:
    """Truth through sensor and estimation; `believed` is what the estimation takes it for."""
    n = truth.shape[1] - 15
    noise = np.random.default_rng(seed).standard_normal((len(truth) // 32 + 1, NOISE_SIZE))
    samples = np.empty((len(truth), 16 + n))
    constants, memory = motion_estimator(config, believed or sensor, n, T)
    _sampled(table, truth, *sensor_chain(sensor, n, T), noise, constants, memory, samples)
    return samples


def eliminated(samples: Array, offset=(0.0,) * 6) -> Array:
    return contact_wrench(
        samples[:, :6],
        offset,
        samples[:, 6:9],
        samples[:, 9:12],
        samples[:, 12:15],
        ARM.phi_load,
    )


def rms(rows: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(rows**2, axis=1))))


def swinging(t: Array, frequencies=(1.3, 2.1, 0.7, 2.6, 1.9, 3.1), start=HOME, acceleration=5.0):
    """Every joint on its own sine; exact derivatives."""
    w = 2 * np.pi * np.array(frequencies)
    phase = np.outer(t, w) + np.arange(len(w))
    amplitude = acceleration / w**2
    return (
        start + amplitude * np.sin(phase),
        amplitude * w * np.cos(phase),
        -amplitude * w**2 * np.sin(phase),
    )


def papers_motion(seconds: float):
    """About 100 N: the scenario `free_motion_force`, up and down at 2.63 Hz without turning."""
    coarse = np.arange(0.0, seconds + 0.01, 0.004)
    x = np.clip(coarse / 0.6, 0.0, 1.0)
    height = 0.45 + 0.078 * x**3 * (10 - 15 * x + 6 * x**2) * np.sin(2 * np.pi * 2.63 * coarse)
    path, q = [], HOME
    for z in height:
        q, _ = nearest_branch(R_WS_HOME.matrix(), np.array([0.55, 0.0, z]), q, ARM.lower, ARM.upper)
        path.append(q)
    spline = make_interp_spline(coarse, np.array(path), k=5)
    t = np.arange(round(seconds / T)) * T
    return spline(t), spline(t, 1), spline(t, 2)


@pytest.fixture(scope="module")
def fast() -> Array:
    return truth_of(papers_motion(2.5))


SETTLED = 8000


# What comes out without errors of the sensor


@pytest.mark.parametrize(
    ("source", "tolerance"), [("encoders", 2e-3), ("accelerometer", 1e-4), ("fused", 1e-4)]
)
@pytest.mark.parametrize("latencies", [(0.0, 0.0, 0.0), (1e-3, 6e-3, 5e-4), (3e-3, 0.0, 2e-2)])
def test_a_quiet_sensor_gives_the_truth_of_one_earlier_instant(source, tolerance, latencies):
    force, acceleration, encoders = latencies
    sensor = dataclasses.replace(
        QUIET,
        force_latency=force,
        acceleration_latency=acceleration,
        encoder_latency=encoders,
    )
    config = MotionEstimationConfig(source=source)
    t = np.arange(12000) * T
    samples = sampled(truth_of(swinging(t)), sensor, config)[SETTLED:]
    delay = path_delays(config, sensor, T).sample
    earlier = truth_of(swinging(t[SETTLED:] - delay))
    got = np.hstack([samples[:, :15], samples[:, 16:]])
    error = np.abs(got - earlier).max(axis=0) / np.abs(earlier).max(axis=0)
    assert error.max() < tolerance
