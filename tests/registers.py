"""Eigenvalues of the sampled one-axis station with its delay as registers."""

from __future__ import annotations

import numpy as np

from drake_teleop.lab.analysis.one_axis import OneAxis
from drake_teleop.lab.analysis.period_map import Sampling, closed_axis_model


def closed_map(axis: OneAxis, sampling: Sampling) -> np.ndarray:
    """Return the matrix of the closed loop over a hand period; registers delay the force."""
    return closed_axis_model(axis, sampling).with_delays_as_states().A


def multipliers(axis: OneAxis, sampling: Sampling) -> np.ndarray:
    """Return the eigenvalues of the closed loop over a hand period."""
    return np.linalg.eigvals(closed_map(axis, sampling))


def growth_rate(axis: OneAxis, sampling: Sampling) -> float:
    """Return the growth rate [1/s] of the slowest-decaying motion; negative: stable."""
    return float(np.log(np.abs(multipliers(axis, sampling)).max()) * sampling.hand_hz)
