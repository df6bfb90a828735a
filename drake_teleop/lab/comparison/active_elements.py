"""How much energy the elimination and the delay put into the loop, and the damping that covers it.

In front of an ideal network without a method, the hand feels along one axis

    Z(s) = k_f [gamma k_e / s + sigma m_t s] G(s) e^(-s RTT)

with the slave's closed loop G. The device with damping b is passive with it if and only if the
damping covers the most negative resistance, b >= -min_w Re Z(j w) (Colgate and Schenkel 1994, for
the continuous case). Elimination, sigma < 1, takes the second term away, which without delay is
lossless and with delay is active at high frequency; it cannot change the first one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drake_teleop.lab.comparison.one_dof import PERIOD, OneDof

_FREQUENCIES = np.geomspace(0.01, 0.5 / PERIOD, 20000) * 2 * np.pi


def covering_damping(model: OneDof, round_trip: float) -> float:
    """The least damping of the device that covers what delay and slave put in [N s/m].

    Args:
        model: masses, servo, wall, scales.
        round_trip: of the network; the command's interpolation and the held force add 1.5 periods.
    """
    return max(0.0, -float(_resistance(model, round_trip).min()))


def worst_frequency(model: OneDof, round_trip: float) -> float:
    """The frequency at which the most damping is needed [Hz]."""
    worst = np.argmin(_resistance(model, round_trip))
    return float(_FREQUENCIES[worst] / (2 * np.pi))


def _resistance(model: OneDof, round_trip: float) -> NDArray[np.float64]:
    """Re Z at `_FREQUENCIES` [N s/m]."""
    s = 1j * _FREQUENCIES
    D, K = model.servo_damping, model.servo_stiffness
    slave = model.slave_mass * s**2 + D * s + K + model.wall_stiffness
    closed_loop = 1.0 if model.ideal_servo else K / slave
    late = np.exp(-s * (round_trip + 1.5 * PERIOD))
    contact = model.gamma * model.wall_stiffness / s
    felt = model.force_scale * (contact + model.sigma * model.tool_mass * s) * closed_loop * late
    return np.asarray(felt.real)
