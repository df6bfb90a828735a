"""Fit of the noise floor to a record of free motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import checked
from drake_teleop.load.contact.detection import statistics
from drake_teleop.load.contact.noise_floor import LENGTHS, NoiseFloor, checked_motion, write_sigmas

# Lower limit of a noise floor [N, N m], as in `logs.contact`.
_RESOLUTION = np.repeat([1e-3, 1e-4], 3)
_MAX_FITS, _FIT_TOLERANCE = 20, 1e-4
_MAX_RHO, _MIN_WIDTH, _RARE_SHARE = 0.999, 0.1, 1e-3


def fit_noise_floor(
    contact: ArrayLike,
    s: ArrayLike,
    omega: ArrayLike,
    alpha: ArrayLike,
    acceleration: ArrayLike,
    covariance: ArrayLike,
    *,
    fade: float = 0.0,
) -> NoiseFloor:
    """Return the noise floor of a record of free motion; fast motion gives the best estimate.

    Args:
        contact: (N, 6) contact wrench of a motion without contact [N, N m].
        s, omega, alpha, acceleration: (N, 3) as for `NoiseFloor.sigma`.
        covariance: (16, 16) from `finite_covariance`.
        fade: as in `NoiseFloor`.

    Raises:
        DrakeTeleopError: for fewer than 100 samples.
    """
    from scipy.optimize import nnls

    rows = checked_motion(contact=contact, s=s, omega=omega, alpha=alpha, acceleration=acceleration)
    if len(rows[0]) < 100:
        raise DrakeTeleopError(
            f"{len(rows[0])} samples are too few for a noise floor",
            where="contact",
            remedy="give 100 samples of free motion or more",
        )
    P = checked("covariance", covariance, 16, 16)
    parameter_std, no_growth = np.empty_like(rows[0]), np.zeros((6, 2))
    write_sigmas(*rows[1:], np.zeros(6), P, no_growth, fade, parameter_std)
    held = np.empty((2, *rows[0].shape))
    for unit, out in zip(np.eye(2), held, strict=True):
        growth = np.tile(unit, (6, 1))
        write_sigmas(*rows[1:], np.zeros(6), np.zeros((16, 16)), growth, fade, out)
    fitted = np.zeros((6, 3))
    for c in range(6):
        square, explained = rows[0][:, c] ** 2, parameter_std[:, c] ** 2
        terms = np.stack([np.ones(len(square)), *held[:, :, c] ** 2], axis=1)
        variance = np.full(len(square), max(float(square.mean()), _RESOLUTION[c] ** 2))
        for _ in range(_MAX_FITS):
            previous = fitted[c].copy()
            weighted = np.column_stack([terms, square - explained]) / variance[:, None]
            R = np.asarray(np.linalg.qr(weighted, mode="r"))  # the same problem with four rows
            fitted[c] = nnls(R[:, :3], R[:, 3])[0]
            fitted[c, 0] = max(fitted[c, 0], _RESOLUTION[c] ** 2)
            variance = terms @ fitted[c] + explained
            if np.allclose(fitted[c], previous, rtol=_FIT_TOLERANCE, atol=0.0):
                break
    floor = NoiseFloor(
        np.sqrt(fitted[:, 0]), P, np.sqrt(fitted[:, 1:]), np.eye(6), np.zeros(6), fade=fade
    )
    scaled = rows[0] / floor.sigma(*rows[1:])
    deviations = np.sqrt(np.mean(scaled**2, axis=0))
    scales = np.maximum(deviations, 1e-6)
    power = scaled.T @ scaled / len(scaled) / np.outer(scales, scales)
    # Keeps the correlation positive definite if a channel has no independent noise.
    correlation = 0.999 * power + 0.001 * np.eye(6)
    np.fill_diagonal(correlation, 1.0)
    z = scaled @ np.linalg.inv(np.linalg.cholesky(correlation)).T
    energy = np.maximum(np.sum(z**2, axis=0), 1e-12)
    rho = np.clip(np.sum(z[1:] * z[:-1], axis=0) / energy, 0.0, _MAX_RHO)
    e = (z[1:] - rho * z[:-1]) / np.sqrt(1.0 - rho**2)
    sums = np.cumsum(np.vstack([np.zeros(6), e]), axis=0)
    lengths = [min(2**m, len(e)) for m in range(LENGTHS)]
    squares = [np.sum((sums[n:] - sums[:-n]) ** 2, axis=1) / n for n in lengths]
    power = np.array([square.mean() for square in squares]) / 6.0
    rare = np.array([np.quantile(square, 1.0 - _RARE_SHARE) for square in squares])
    # A short record has few long sums: their quantile can be small by chance, their power is not.
    rare /= max(rare[0], 1e-12)
    widths = np.sqrt(np.maximum(np.maximum(power, rare), _MIN_WIDTH**2))
    floor = replace(floor, correlation=correlation, rho=rho, widths=widths)
    return replace(floor, reached=statistics(floor, *rows).max(axis=0))
