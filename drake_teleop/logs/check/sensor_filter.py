"""Test whether the sensor removes slow forces (piezoelectric) or fast forces (strong filter)."""

from __future__ import annotations

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.load.regressor import regressor
from drake_teleop.logs.causes.cause import Finding
from drake_teleop.logs.read.alignment import mean_time_step, remove_delay
from drake_teleop.logs.read.canonical import Log

_COMPARED_RATE_HZ, _MAX_MISFIT_RATIO_OF_FILTER = 50.0, 0.25
_SEARCHED_CUTOFFS_HZ = np.geomspace(0.02, 2.0, 25)
_RATIOS_TO_BEST_CUTOFF = np.geomspace(0.84, 1.2, 9)


def sensor_filter_finding(log: Log, delay_s: float) -> Finding | None:
    """Return a finding if the load's wrench, high- or low-passed, explains the reading."""
    from scipy.signal import butter, lfilter  # slow to import

    least, fitting = dict.fromkeys(("none", "high-pass", "low-pass"), np.inf), {"none": 1.0}
    for moved in (log, remove_delay(log, -delay_s)):  # a filter resembles a delay
        few = moved.select_rows(slice(None, None, max(1, int(1.0 / (_COMPARED_RATE_HZ * log.dt)))))
        t, dt = few.t - few.t[0], mean_time_step(few.t)
        scale = np.linalg.norm(few.wrench.std(axis=0).reshape(2, 3), axis=1).repeat(3) + 1e-12
        V, wrench = regressor(*few.motion) / scale[:, None], few.wrench / scale
        for is_fine in (False, True):
            best = fitting[min(fitting, key=lambda x: least[x])] if is_fine else 1.0
            for cutoff in best * (_RATIOS_TO_BEST_CUTOFF if is_fine else _SEARCHED_CUTOFFS_HZ):
                decay = np.exp(-2.0 * np.pi * cutoff * t)  # of the start
                basis = np.linalg.qr(np.stack([np.ones(len(t)), t, decay, t * decay], axis=1))[0]
                high = _high_pass(V, cutoff, dt)
                second = lfilter(*butter(2, 2.0 * cutoff * dt), V - V[0], axis=0) + V[0]
                models = [("none", V), ("high-pass", high), ("low-pass", V - high)]
                for name, columns in [*models, ("low-pass", second)]:
                    misfit = _sum_squared_residuals(columns, wrench, basis)
                    if misfit < least[name]:
                        least[name], fitting[name] = misfit, float(cutoff)
    name = min(least, key=lambda x: least[x])
    if name == "none" or not least[name] < _MAX_MISFIT_RATIO_OF_FILTER * least["none"]:
        return None
    text = f"fast forces (low-pass at about {fitting[name]:.2g} Hz); widen its filter"
    if name == "high-pass":
        text = f"slow forces (high-pass at about {fitting[name]:.2g} Hz, as of a piezoelectric"
        text += " sensor); use a sensor for constant forces, or its longest time constant"
    message = f"payload not identifiable: the sensor removes {text}"
    return Finding(name, message, values={"cutoff_hz": fitting[name]})


def _high_pass(x: Array, cutoff_hz: float, dt: float) -> Array:
    from scipy.signal import lfilter

    a = np.exp(-2.0 * np.pi * cutoff_hz * dt)
    return np.asarray(lfilter([0.5 * (1.0 + a), -0.5 * (1.0 + a)], [1.0, -a], x - x[0], axis=0))


def _sum_squared_residuals(V: Array, wrench: Array, trend_basis: Array) -> float:
    A, b = V.reshape(len(V), -1), wrench
    A, b = A - trend_basis @ (trend_basis.T @ A), b - trend_basis @ (trend_basis.T @ b)
    A, b = A.reshape(-1, V.shape[2]), b.ravel()
    return float(np.sum((b - A @ np.linalg.lstsq(A, b, rcond=1e-9)[0]) ** 2))
