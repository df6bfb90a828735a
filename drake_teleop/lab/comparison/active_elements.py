"""Energy that elimination and delay add to the loop, and the damping that compensates it (T43).

Without elimination the inertia is lossless without delay, and active at high frequency with delay.
Elimination (sigma < 1) removes it; the contact term remains.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drake_teleop.lab.comparison.one_dof import PERIOD, OneDof

_FREQUENCIES = np.geomspace(0.01, 0.5 / PERIOD, 20000) * 2 * np.pi


def covering_damping(model: OneDof, round_trip: float) -> float:
    """Return the least damping of the device that makes it passive with delay and slave [N s/m].

    The command's interpolation and the held force add 1.5 periods to `round_trip`.
    """
    return max(0.0, -float(_resistance(model, round_trip).min()))


def worst_frequency(model: OneDof, round_trip: float) -> float:
    """Return the frequency at which the most damping is needed [Hz]."""
    worst = np.argmin(_resistance(model, round_trip))
    return float(_FREQUENCIES[worst] / (2 * np.pi))


def _resistance(model: OneDof, round_trip: float) -> NDArray[np.float64]:
    s = 1j * _FREQUENCIES
    D, K = model.servo_damping, model.servo_stiffness
    slave = model.slave_mass * s**2 + D * s + K + model.wall_stiffness
    closed_loop = 1.0 if model.ideal_servo else K / slave
    late = np.exp(-s * (round_trip + 1.5 * PERIOD))
    contact = model.gamma * model.wall_stiffness / s
    felt = model.force_scale * (contact + model.sigma * model.tool_mass * s) * closed_loop * late
    return np.asarray(felt.real)
