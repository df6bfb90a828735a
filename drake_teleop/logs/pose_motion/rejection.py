"""Detection of disturbances: contacts, impacts and saturation (docs/theory.md)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.arrays import Array
from drake_teleop.logs.pose_motion.saturated import ROUNDING, Spectra
from drake_teleop.logs.pose_motion.spectra import Grid, distance
from drake_teleop.logs.pose_motion.splines import ACCELERATED

NOTHING_REJECTED = (
    "the residual is large where the load moves and small where it rests, so that disturbances"
    " cannot be told from errors of the motion: no sample was rejected"
)
_HUBER, _REJECT, _FITS = 3.0, 4.5, 30
_NORMAL_MAD = 1.4826
_MOST_LOSS = 2.5
_PASSED = 0.3
_MARGIN = 0.1
"""Least margin of a rejected stretch [s]."""


def disturbed(
    spectra: Spectra, grid: Grid, taper: Array, spacing: float
) -> tuple[NDArray[np.bool_], str]:
    """Return (M,) flags of disturbed instants, and a note for the user.

    For an identified load only the offsets are fitted.
    """
    # A Gaussian gain, one half at `_PASSED` / h, does not ring.
    gain = 0.5 ** ((spectra.of.frequency * spacing / _PASSED) ** 2)
    x, y = (_in_time(s * gain[:, None], grid) for s in (spectra.signals, spectra.wrench))
    inside = taper > 0.5
    size = np.sqrt(np.mean(x**2, axis=0))
    used = size > 1e-9 * size[0]
    if grid.load is None:
        x = moving = x[:, used] / size[used]
    else:
        y, moving = y - x @ grid.load.T, x[:, ACCELERATED] @ grid.load[:3, ACCELERATED].T
        x, moving = x[:, :1] / size[0], np.linalg.norm(moving, axis=1, keepdims=True)
    weights = inside.astype(float)
    for _ in range(_FITS):
        before = weights
        distances = _distances(x, y, weights, inside)
        weights = inside * np.minimum(1.0, _HUBER / np.maximum(distances, _HUBER))
        if np.abs(weights - before).max() < 0.01:
            break
    rejected = np.zeros(len(x), bool)
    for _ in range(_FITS):
        last, rejected = rejected, _distances(x, y, weights, inside) > _REJECT
        weights = (inside & ~rejected).astype(float)
        if (rejected == last).all() or weights.sum() < 2 * x.shape[1]:
            break
    if not rejected.any():
        return rejected, ""
    rejected = distance(rejected) * grid.dt <= max(_MARGIN, spacing)
    if _loss(moving, inside, inside & ~rejected) > _MOST_LOSS:
        return np.zeros(len(x), bool), NOTHING_REJECTED
    return rejected, ""


def _in_time(spectrum: NDArray[np.complex128], grid: Grid) -> Array:
    full = np.zeros((grid.length // 2 + 1, spectrum.shape[1]), np.complex128)
    full[: len(spectrum)] = spectrum
    return np.asarray(np.fft.irfft(full, grid.length, axis=0)[: len(grid.t)])


def _distances(x: Array, y: Array, weights: Array, inside: NDArray[np.bool_]) -> Array:
    """Return (M,) largest ratio of residual to robust deviation over the channels."""
    weighted = x * weights[:, None]
    C = np.linalg.lstsq(weighted.T @ x, weighted.T @ y, rcond=1e-12)[0]
    residual = np.abs(y - x @ C)
    scale = _NORMAL_MAD * np.median(residual[inside], axis=0)
    rms = np.sqrt(np.mean(y**2, axis=0).reshape(2, 3).sum(axis=1)).repeat(3)
    return np.asarray((residual / np.maximum(scale, ROUNDING * rms + 1e-30)).max(axis=1))


def _loss(x: Array, inside: NDArray[np.bool_], kept: NDArray[np.bool_]) -> float:
    """Return the largest growth of a deviation, relative to random loss of as many samples."""
    if kept.sum() < 2 * x.shape[1]:
        return np.inf
    every, some = (
        np.diag(np.linalg.pinv(x[rows].T @ x[rows], rcond=1e-12, hermitian=True))
        for rows in (inside, kept)
    )
    return float(np.sqrt(np.max(some / every) * kept.sum() / inside.sum()))
