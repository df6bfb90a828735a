"""Aliasing in resampling, and the first estimate of a lag."""

from __future__ import annotations

import numpy as np
import pytest

from drake_teleop.logs.read.mounting import lag_of_imu_clock
from drake_teleop.logs.read.streams import Stream, resample_to_clock


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


@pytest.mark.parametrize("lag", [-0.173, 0.0, 0.062])
def test_best_shift_is_the_lag_for_rotated_axes(lag):
    rng = np.random.default_rng(2)
    clock = np.arange(0, 12, 0.005)
    kernel = np.exp(-0.5 * (np.arange(-40, 41) / 12) ** 2)
    noise = rng.normal(size=(3, len(clock)))
    signal = np.array([np.convolve(row, kernel, mode="same") for row in noise]).T
    t = np.arange(1, 11, 0.01)
    shown = np.stack([np.interp(t, clock - lag, column) for column in signal.T], axis=1)
    turned = signal[:, [1, 2, 0]] * [1.0, -1.0, 1.0]
    found = lag_of_imu_clock(t, [(shown, turned)], clock, 0.5, np.zeros((len(t), 1)))
    assert found == pytest.approx(lag, abs=2e-3)
