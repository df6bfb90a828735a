"""Delay of a motion behind a wrench, independent of load, axes, units and weight."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from drake_teleop.logs.causes.instants import FORCES, Instants

_REACH, _STEP = 0.25, 0.01
_SIGNALS = slice(0, 16)


def free_delay(data: Instants) -> float:
    """Return the delay [s] of the smallest residual, within 0.25 s or a tenth of the record.

    Each channel is fitted with the 16 signals of the motion, because a wrong load model would bias
    it.
    """
    reach = min(_REACH, 0.1 * float(data.t[-1] - data.t[0]))
    rows = data.used & (data.t > data.t[0] + reach) & (data.t < data.t[-1] - reach)
    spline = CubicSpline(data.t, data.y[:, _SIGNALS])
    forces = data.y[rows][:, FORCES]
    total = (forces * forces).sum(axis=0)

    def cost(shift: float) -> float:
        x = spline(data.t[rows] + shift)
        size = np.sqrt((x * x).mean(axis=0))
        x = x[:, size > 1e-9 * size.max()]
        x /= np.sqrt((x * x).mean(axis=0))
        found = np.linalg.lstsq(x.T @ x, x.T @ forces, rcond=1e-10)[0]
        left = total - ((x.T @ forces) * found).sum(axis=0)
        return float(np.log(np.maximum(left, 1e-12 * total + 1e-30)).sum())

    shifts = np.arange(-round(reach / _STEP), round(reach / _STEP) + 1) * _STEP
    costs = np.array([cost(x) for x in shifts])
    best = int(np.argmin(costs))
    if best in (0, len(shifts) - 1):
        return 0.0
    left, middle, right = costs[best - 1 : best + 2]
    bend = left - 2.0 * middle + right
    move = 0.5 * (left - right) / bend if bend > 0.0 else 0.0
    return float(shifts[best] + _STEP * np.clip(move, -1.0, 1.0))
