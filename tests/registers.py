"""Sampled one-axis station with its delay as registers: eigenvalues without the cut loop."""

from __future__ import annotations

import numpy as np

from drake_teleop.lab.analysis.one_axis import OneAxis
from drake_teleop.lab.analysis.period_map import (
    RECEIVED_FORCE,
    SAMPLED_FORCE,
    Sampling,
    delay_in_hand_periods,
    period_map_of_cut_loop,
)


def closed_map(axis: OneAxis, sampling: Sampling) -> np.ndarray:
    """Return the matrix of the closed loop over a hand period; registers delay the force."""
    M, registers = period_map_of_cut_loop(axis, sampling), 2 * delay_in_hand_periods(axis, sampling)
    n = len(M) - 3
    closed = np.zeros((n + registers, n + registers))
    closed[:n, :n] = M[:n, :n]
    source = n + registers - 1 if registers else SAMPLED_FORCE
    closed[:n, source] += M[:n, RECEIVED_FORCE]
    for k in range(registers):
        closed[n + k, n + k - 1 if k else SAMPLED_FORCE] = 1.0
    return closed


def multipliers(axis: OneAxis, sampling: Sampling) -> np.ndarray:
    """Return the eigenvalues of the closed loop over a hand period."""
    return np.linalg.eigvals(closed_map(axis, sampling))


def growth_rate(axis: OneAxis, sampling: Sampling) -> float:
    """Return the growth rate [1/s] of the slowest-decaying motion; negative: stable."""
    return float(np.log(np.abs(multipliers(axis, sampling)).max()) * sampling.hand_hz)
