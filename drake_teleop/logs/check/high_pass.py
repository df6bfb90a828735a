"""Test whether the sensor removes slow forces, as a piezoelectric sensor does."""

from __future__ import annotations

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.load.regressor import regressor
from drake_teleop.logs.causes.cause import Finding
from drake_teleop.logs.read.alignment import mean_time_step, remove_delay
from drake_teleop.logs.read.canonical import Log

_COMPARED_RATE_HZ, _MAX_MISFIT_RATIO_OF_HIGH_PASS = 50.0, 0.25
_CUTOFFS_HZ = np.geomspace(0.02, 2.0, 25)


def high_pass_finding(log: Log, delay_s: float) -> Finding | None:
    """Return a finding if a high-pass of first order on the load's wrench explains the wrench."""
    least, fitting = [np.inf, np.inf], 0.0
    for moved in (log, remove_delay(log, -delay_s)):  # a high-pass resembles a delay
        few = moved.select_rows(slice(None, None, max(1, int(1.0 / (_COMPARED_RATE_HZ * log.dt)))))
        t = few.t - few.t[0]
        scale = np.linalg.norm(few.wrench.std(axis=0).reshape(2, 3), axis=1).repeat(3) + 1e-12
        V, wrench = regressor(*few.motion) / scale[:, None], few.wrench / scale
        for cutoff in _CUTOFFS_HZ:
            decay = np.exp(-2.0 * np.pi * cutoff * t)  # of the start
            basis = np.linalg.qr(np.stack([np.ones(len(t)), t, decay], axis=1))[0]
            passed = _high_passed(V, cutoff, mean_time_step(t))
            for k, columns in enumerate((V, passed)):
                misfit = _sum_squared_residuals(columns, wrench, basis)
                fitting = cutoff if k and misfit < least[1] else fitting
                least[k] = min(least[k], misfit)
    if not least[1] < _MAX_MISFIT_RATIO_OF_HIGH_PASS * least[0]:
        return None
    text = (
        "payload not identifiable: the sensor removes slow forces (high-pass at about"
        f" {fitting:.2g} Hz, as of a piezoelectric sensor); use a sensor that measures constant"
        " forces, or set its amplifier to the longest time constant"
    )
    return Finding("high-pass", text, values={"cutoff_hz": float(fitting)})


def _high_passed(x: Array, cutoff_hz: float, dt: float) -> Array:
    from scipy.signal import lfilter  # slow to import

    a = np.exp(-2.0 * np.pi * cutoff_hz * dt)
    return np.asarray(lfilter([0.5 * (1.0 + a), -0.5 * (1.0 + a)], [1.0, -a], x - x[0], axis=0))


def _sum_squared_residuals(V: Array, wrench: Array, trend_basis: Array) -> float:
    A, b = V.reshape(len(V), -1), wrench
    A, b = A - trend_basis @ (trend_basis.T @ A), b - trend_basis @ (trend_basis.T @ b)
    A, b = A.reshape(-1, V.shape[2]), b.ravel()
    return float(np.sum((b - A @ np.linalg.lstsq(A, b, rcond=1e-9)[0]) ** 2))
