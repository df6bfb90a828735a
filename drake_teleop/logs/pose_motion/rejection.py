"""Detection of disturbances: contacts, impacts and saturation (docs/theory.md)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.numeric import Array
from drake_teleop.logs.pose_motion.linear_model import MIN_NOISE_STD_OVER_WRENCH_RMS
from drake_teleop.logs.pose_motion.spectra import Spectra, WrenchGrid, instants_to_nearest_flag
from drake_teleop.logs.pose_motion.splines import SIGNALS_ZERO_AT_REST

NOTHING_REJECTED_NOTE = (
    "the residual is large where the load moves and small where it rests, so disturbances"
    " cannot be distinguished from errors of the motion: no sample was rejected; check delay,"
    " scale and mounting"
)
_HUBER_STDS, _REJECTION_STDS, _MAX_ROBUST_FITS = 3.0, 4.5, 30
_STD_PER_NORMAL_MAD, _MAX_FIT_STD_GROWTH = 1.4826, 2.5
_HALF_GAIN_FREQUENCY_OVER_KNOT_RATE = 0.3
_MIN_REJECTION_MARGIN_S = 0.1  # least margin on both sides of a rejected time span [s]


def find_disturbances(spectra: Spectra, spacing: float) -> tuple[NDArray[np.bool_], str]:
    """Return True for instants (M,) with contact, impact or saturation, and a note or "".

    `spacing` is that of the splines' knots [s]. The note says that nothing could be rejected.
    """
    # A Gaussian gain, one half at `_HALF_GAIN_FREQUENCY_OVER_KNOT_RATE` / h, does not ring.
    window, grid = spectra.window, spectra.window.grid
    gain = 0.5 ** ((window.bands.frequency * spacing / _HALF_GAIN_FREQUENCY_OVER_KNOT_RATE) ** 2)
    filtered = (x * gain[:, None] for x in (spectra.signals, window.wrench_spectrum))
    x, y = (_spectrum_to_time_signal(spectrum, grid) for spectrum in filtered)
    inside = window.taper > 0.5
    size = np.sqrt(np.mean(x**2, axis=0))
    used = size > 1e-9 * size[0]
    if grid.known_load is None:
        x = test_signals = x[:, used] / size[used]
    else:
        y = y - x @ grid.known_load.T
        test_signals = x[:, SIGNALS_ZERO_AT_REST] @ grid.known_load[:3, SIGNALS_ZERO_AT_REST].T
        x, test_signals = x[:, :1] / size[0], np.linalg.norm(test_signals, axis=1, keepdims=True)
    weights = inside.astype(float)
    for _ in range(_MAX_ROBUST_FITS):
        before = weights
        distances = _max_residuals_over_std(x, y, weights, inside)
        weights = inside * np.minimum(1.0, _HUBER_STDS / np.maximum(distances, _HUBER_STDS))
        if np.abs(weights - before).max() < 0.01:
            break
    rejected = np.zeros(len(x), bool)
    for _ in range(_MAX_ROBUST_FITS):
        last = rejected
        rejected = _max_residuals_over_std(x, y, weights, inside) > _REJECTION_STDS
        weights = (inside & ~rejected).astype(float)
        if (rejected == last).all() or weights.sum() < 2 * x.shape[1]:
            break
    if not rejected.any():
        return rejected, ""
    rejected = instants_to_nearest_flag(rejected) * grid.dt <= max(_MIN_REJECTION_MARGIN_S, spacing)
    if _std_growth_by_rejection(test_signals, inside, inside & ~rejected) > _MAX_FIT_STD_GROWTH:
        return np.zeros(len(x), bool), NOTHING_REJECTED_NOTE
    return rejected, ""


def _spectrum_to_time_signal(spectrum: NDArray[np.complex128], grid: WrenchGrid) -> Array:
    full = np.zeros((grid.transform_length // 2 + 1, spectrum.shape[1]), np.complex128)
    full[: len(spectrum)] = spectrum
    return np.asarray(np.fft.irfft(full, grid.transform_length, axis=0)[: len(grid.t)])


def _max_residuals_over_std(x: Array, y: Array, weights: Array, inside: NDArray[np.bool_]) -> Array:
    weighted = x * weights[:, None]
    C = np.linalg.lstsq(weighted.T @ x, weighted.T @ y, rcond=1e-12)[0]
    residual = np.abs(y - x @ C)
    scale = _STD_PER_NORMAL_MAD * np.median(residual[inside], axis=0)
    rms = np.sqrt(np.mean(y**2, axis=0).reshape(2, 3).sum(axis=1)).repeat(3)
    scale = np.maximum(scale, MIN_NOISE_STD_OVER_WRENCH_RMS * rms + 1e-30)
    return np.asarray((residual / scale).max(axis=1))


def _std_growth_by_rejection(x: Array, inside: NDArray[np.bool_], kept: NDArray[np.bool_]) -> float:
    if kept.sum() < 2 * x.shape[1]:
        return np.inf
    whole, left = (x[rows].T @ x[rows] for rows in (inside, kept))
    # pinv returns zeros for motions that no kept sample contains, hence the share of the whole.
    grams = np.array([whole, left + 1e-6 * whole])
    inverses = np.linalg.pinv(grams, rcond=1e-12, hermitian=True)
    every, some = np.diagonal(inverses, axis1=1, axis2=2)
    return float(np.sqrt(np.max(some / every) * kept.sum() / inside.sum()))
