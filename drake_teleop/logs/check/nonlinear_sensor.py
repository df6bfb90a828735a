"""Test for a nonlinear sensor: dead band, curvature or hysteresis."""

from __future__ import annotations

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.load.identification import Identification, natural_scales
from drake_teleop.load.regressor import regressor
from drake_teleop.logs.causes.cause import Finding
from drake_teleop.logs.read.canonical import Log

_MAX_COMPARED_SAMPLES, _COMPARED_RATE_HZ = 2000, 50.0
_DEAD_BAND_OVER_LARGEST_WRENCH, _BACKLASH_OVER_RANGE = 0.05, 0.01
_LEAST_EXPLAINED_SHARE, _CERTAIN_EXPLAINED_SHARE, _LEAST_RELATIVE_ERROR = 0.12, 0.3, 0.01
_MAX_UNEXPLAINED_SHARE = 0.02
_MESSAGE_OF_NONLINEARITY = {
    "dead band": "the sensor shows too little near zero (dead band); turn that off",
    "curvature": "the gain of the sensor depends on the wrench; calibrate the sensor",
    "hysteresis": "the reading depends on the direction of its change (hysteresis); look for"
    " friction or play between sensor and load, and calibrate the sensor",
}


def error_of_load_by_nonlinear_sensor(
    log: Log, load: Identification
) -> tuple[Array, Finding | None]:
    """Return errors (10,) of phi due to a nonlinear sensor, and a finding if they are large.

    The errors are 0 if no tested nonlinearity explains the residual. The log is without delay.
    """
    step = max(1, round(1.0 / (_COMPARED_RATE_HZ * log.dt)), -(-len(log) // _MAX_COMPARED_SAMPLES))
    few = log.select_rows(slice(None, None, step))
    V = regressor(*few.motion)
    wrench = load.offsets + V @ load.phi
    scale = np.linalg.norm(few.wrench.std(axis=0).reshape(2, 3), axis=1).repeat(3) + 1e-12
    unit = (wrench - wrench.mean(axis=0)) / (np.ptp(wrench, axis=0) + 1e-12)
    dead_band = _DEAD_BAND_OVER_LARGEST_WRENCH * np.abs(wrench).max(axis=0) + 1e-12
    functions = {
        "dead band": [np.tanh(wrench / dead_band)],
        "curvature": [unit**2, unit**3],
        "hysteresis": [_backlash_error(unit)],
    }
    offsets = np.broadcast_to(np.eye(6), (len(V), 6, 6))
    load_columns = np.concatenate([offsets, V], axis=2) / scale[:, None]
    gains = _one_column_per_channel(unit)
    measured = few.wrench / scale
    residual = _fit_columns(measured, load_columns, gains)[1] + 1e-300
    own = {name: [*map(_one_column_per_channel, x)] for name, x in functions.items()}
    left = {name: _fit_columns(measured, load_columns, gains, *x)[1] for name, x in own.items()}
    name = min(left, key=lambda x: left[x])
    share = 1.0 - left[name] / residual
    total = float(np.sum((measured - measured.mean(axis=0)) ** 2))
    large = left[name] > _MAX_UNEXPLAINED_SHARE * total
    if share < _LEAST_EXPLAINED_SHARE or large or load.mass <= 0.0:
        return np.zeros(10), None
    scales = natural_scales(load.phi)[6:]
    if name == "hysteresis":  # its part in phase with the wrench, which no fit shows, is as large
        errors = np.sqrt(share * residual / total) * scales
    else:
        nonlinear, linear = (_fit_columns(measured, load_columns, *x)[0] for x in (own[name], []))
        errors = nonlinear[6:16] - linear[6:16]
    worst = float(np.max(np.abs(errors[:4]) / scales[:4]))
    if share < _CERTAIN_EXPLAINED_SHARE or worst < _LEAST_RELATIVE_ERROR:
        return errors, None
    text = f"payload not identifiable: {_MESSAGE_OF_NONLINEARITY[name]}"
    text = f"{text}; error of the load about {100.0 * worst:.2g} %"
    return errors, Finding(name, text, values={"relative_error": worst})


def _one_column_per_channel(x: Array) -> Array:
    return np.asarray(x[:, :, None] * np.eye(6))


def _fit_columns(wrench: Array, *columns: Array) -> tuple[Array, float]:
    """Return least-squares parameters (p,) of `columns` (N, 6, p), and the squared residual."""
    A, b = np.concatenate(columns, axis=2).reshape(wrench.size, -1), wrench.ravel()
    theta = np.linalg.lstsq(A, b, rcond=1e-9)[0]
    return np.asarray(theta), float(np.sum((b - A @ theta) ** 2))


def _backlash_error(x: Array) -> Array:
    """Return the error (N, 6) of a reading of x (N, 6) with backlash, in half backlash widths."""
    out, reading = np.zeros_like(x), x[0]
    for n in range(1, len(x)):
        reading = np.clip(reading, x[n] - _BACKLASH_OVER_RANGE, x[n] + _BACKLASH_OVER_RANGE)
        out[n] = (reading - x[n]) / _BACKLASH_OVER_RANGE
    return out
