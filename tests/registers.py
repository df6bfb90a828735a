"""Sampled one-axis station with its delay as registers: eigenvalues without the cut loop."""

from __future__ import annotations

import numpy as np

from drake_teleop.lab.analysis.one_axis import OneAxis
from drake_teleop.lab.analysis.period_map import Sampling, delay_steps, period_map


def multipliers(axis: OneAxis, sampling: Sampling) -> np.ndarray:
    """Return the eigenvalues of the closed loop over the common period of all rates."""
    M, _ = period_map(axis, sampling, delay_steps(axis, sampling), cut=False)
    n = M.shape[-1] - 3
    return np.linalg.eigvals(M[:n, :n])


def growth_rate(axis: OneAxis, sampling: Sampling) -> float:
    """Return the growth rate [1/s] of the slowest-decaying motion; negative: stable."""
    _, periods = period_map(axis, sampling, delay_steps(axis, sampling), cut=False)
    largest = np.abs(multipliers(axis, sampling)).max()
    return float(np.log(largest) * sampling.hand_hz / periods)
