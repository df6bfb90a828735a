from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from known_motion import GRAVITY_W, motion_at
from scipy.signal import savgol_filter

from drake_teleop.common.numeric import white_noise_deviations
from drake_teleop.logs.read.alignment import (
    angular_motion,
    low_pass,
    noise_gain_of_derivatives,
    remove_delay,
    resample,
    smooth_derivatives,
    uniform_times,
)
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.streams import Stream, resample_to_clock


def make_log(t: np.ndarray) -> Log:
    motion = motion_at(t)
    wrench = np.hstack([motion.specific_force, motion.omega])
    return Log(t, wrench, motion.specific_force, motion.omega, motion.alpha)


def test_low_pass_halves_the_amplitude_at_the_cutoff_without_phase_shift() -> None:
    t = np.arange(4000) * 1e-3
    for f, gain in ((3.0, 1 / (1 + 1e-4)), (30.0, 0.5), (90.0, 1 / 82)):
        x = np.sin(2 * np.pi * f * t)[:, None]
        middle = slice(1000, 3000)
        np.testing.assert_allclose(low_pass(x, 1e-3, 30.0)[middle], gain * x[middle], atol=2e-6)


def test_low_pass_keeps_straight_lines_to_the_ends() -> None:
    t = np.arange(500) * 1e-3
    x = np.stack([np.ones_like(t), 3 - 2 * t], axis=1)
    np.testing.assert_allclose(low_pass(x, 1e-3, 20.0), x, atol=2e-3)
    np.testing.assert_allclose(low_pass(x, 1e-3, 20.0)[:, 0], 1, atol=1e-12)


def test_low_pass_above_nyquist_has_no_effect() -> None:
    x = np.random.default_rng(1).normal(size=(50, 2))
    assert low_pass(x, 0.1, 30.0) is x
    assert low_pass(x, 0.1, None) is x


@pytest.mark.parametrize("bandwidth", [None, 10.0, 1e-3])
def test_smoother_is_exact_on_quintics_even_at_the_ends(bandwidth: float | None) -> None:
    t = np.linspace(-1, 1, 101)
    x = np.stack([1 + t - 2 * t**2 + 3 * t**3 - t**5, np.ones_like(t)], axis=1)
    smooth, first, second = smooth_derivatives(x, t[1] - t[0], bandwidth)
    np.testing.assert_allclose(smooth, x, atol=1e-11)
    np.testing.assert_allclose(first[:, 0], 1 - 4 * t + 9 * t**2 - 5 * t**4, atol=1e-8)
    np.testing.assert_allclose(second[:, 0], -4 + 18 * t - 20 * t**3, atol=1e-5)


def test_smoother_equals_savgol_filter() -> None:
    x = np.random.default_rng(2).normal(size=(200, 2))
    for order, ours in enumerate(smooth_derivatives(x, 0.01, 10.0)):  # a window of 19 samples
        scipys = savgol_filter(x, 19, 5, deriv=order, delta=0.01, axis=0)
        np.testing.assert_allclose(ours, scipys, atol=1e-10 * np.abs(scipys).max())


def test_smoother_is_accurate_in_long_windows() -> None:
    t = np.arange(4000) / 8e3
    x = t**5 - t**3 + 1.0
    _, first, second = smooth_derivatives(x, t[1], 10.0)  # a window of 1441 samples
    np.testing.assert_allclose(first, 5 * t**4 - 3 * t**2, atol=1e-9)
    np.testing.assert_allclose(second, 20 * t**3 - 6 * t, atol=1e-6)


def test_noise_gain_predicts_the_output_noise() -> None:
    noise = np.random.default_rng(2).normal(size=(200_000, 1))
    measured = [part[500:-500].std() for part in smooth_derivatives(noise, 1e-3, 30.0)]
    np.testing.assert_allclose(measured, noise_gain_of_derivatives(1e-3, 30.0), rtol=0.02)


def test_angular_motion_from_orientations() -> None:
    t = np.arange(0, 4, 0.002)
    motion = motion_at(t)
    omega, alpha = angular_motion(motion.R_WS, 0.002, None)
    np.testing.assert_allclose(omega, motion.omega, atol=1e-4)
    np.testing.assert_allclose(alpha, motion.alpha, atol=2e-2)
    np.testing.assert_allclose(alpha[4:-4], motion.alpha[4:-4], atol=1e-3)


def test_undelayed_shifts_motion_but_not_wrench() -> None:
    t = np.arange(0, 2, 0.001)
    late = motion_at(t - 0.0123)
    log = Log(t, make_log(t).wrench, late.specific_force, late.omega, late.alpha)
    back = remove_delay(log, 0.0123)
    now = motion_at(back.t)
    assert len(back) == len(t) - 13
    np.testing.assert_array_equal(back.wrench, log.wrench[: len(back)])
    np.testing.assert_allclose(back.specific_force, now.specific_force, atol=1e-3)
    np.testing.assert_allclose(back.angular_velocity, now.omega, atol=1e-3)
    np.testing.assert_allclose(back.angular_acceleration, now.alpha, atol=1e-2)


@pytest.mark.parametrize("delay_s", [0.0123, -0.02])
def test_orientation_and_gravity_are_shifted_with_the_motion(delay_s: float) -> None:
    t = np.arange(0, 2, 0.001)
    R_WS = motion_at(t - delay_s).R_WS
    log = replace(make_log(t), R_WS=R_WS, gravity=GRAVITY_W @ R_WS)
    back = remove_delay(log, delay_s)
    now = motion_at(back.t)
    np.testing.assert_allclose(back.R_WS, now.R_WS, atol=1e-4)
    np.testing.assert_allclose(back.gravity, GRAVITY_W @ now.R_WS, atol=1e-3)


def test_gaps_of_wrench_and_motion_are_both_flagged_after_a_delay() -> None:
    log = make_log(np.arange(0, 2, 0.001))
    flags = np.arange(len(log)) == 500
    back = remove_delay(replace(log, bridged=flags), 0.0123)
    np.testing.assert_array_equal(np.flatnonzero(back.bridged), [487, 488, 500])
    ahead = remove_delay(replace(log, bridged=flags), -0.0123)
    np.testing.assert_array_equal(ahead.t[ahead.bridged], log.t[[500, 512, 513]])


def test_uniform_times_removes_only_jitter() -> None:
    even = 5.0 + np.arange(100) * 0.01
    assert uniform_times(even) is even
    jitter = even + np.random.default_rng(3).uniform(-2e-3, 2e-3, 100)
    found = uniform_times(jitter)
    np.testing.assert_allclose(np.diff(found), np.median(np.diff(jitter)))
    assert found[0] == jitter[0]
    assert jitter[-1] - 0.02 < found[-1] <= jitter[-1]


def test_resample_interpolates_matrices() -> None:
    x = np.arange(12.0).reshape(3, 2, 2)
    found = resample(np.array([0.5, 1.0]), np.arange(3.0), x)
    np.testing.assert_allclose(found, [x[:2].mean(axis=0), x[1]])


@pytest.mark.parametrize("ratio", [1.5, 4.0])
def test_resampling_to_a_slower_clock_does_not_alias(ratio):
    """A tone above half the clock's rate, in streams slightly and much faster than it."""
    t, rate = np.arange(0, 4, 0.01), 100.0 * ratio
    fast = np.arange(0, 4, 1 / rate)
    tone, slow = np.sin(2 * np.pi * 61.0 * fast), np.sin(2 * np.pi * 3.0 * fast)
    stream = Stream("wrench", fast)
    seen = resample_to_clock(t, stream, np.stack([tone, slow], axis=1))[50:-50]
    # Second-order Butterworth at 0.4 of the rate, forward and backward.
    assert np.abs(seen[:, 0]).max() < 1.02 / (1 + (61 / 40) ** 4)
    np.testing.assert_allclose(seen[:, 1], np.sin(2 * np.pi * 3.0 * t)[50:-50], atol=0.01)


def test_white_noise_is_estimated_beside_a_smooth_motion() -> None:
    rng, sigma = np.random.default_rng(4), np.array([0.02, 0.3, 1.5])
    t = np.arange(0, 20, 1e-3)[:, None]
    motion = 20 * np.sin(2 * np.pi * np.array([0.5, 1.0, 2.0]) * t)
    found = white_noise_deviations(motion + sigma * rng.normal(size=(len(t), 3)))
    np.testing.assert_allclose(found, sigma, rtol=0.05)
    assert not white_noise_deviations(motion[:3]).any()
