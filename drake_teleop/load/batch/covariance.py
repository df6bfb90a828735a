"""Covariance of the batch estimators (docs/theory.md, "Details of the estimators").

It ignores the physical constraint of `consistent`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.numeric import Array
from drake_teleop.load.batch.moments import (
    CHUNK,
    coefficients,
    excited_columns,
    inverse_root,
    normal_equations,
)
from drake_teleop.load.batch.total_least_squares import Fit, NormalForm, Record
from drake_teleop.load.batch.uncertainty import prior_dominated
from drake_teleop.load.normal_equations import NormalEquations
from drake_teleop.load.regressor import regressor

ARM = 0.06
"""Length that relates gain errors of forces to those of torques [m]."""


def with_prior(covariance: Array, information: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return the covariance (16, 16) of data and prior, and (16,) True if the prior dominates.

    Args:
        covariance: (16, 16) of [offsets; phi] from the data.
        information: (10, 10) inverse covariance of phi from the prior.
    """
    determined = np.isfinite(np.diag(covariance)) & (np.diag(covariance) > 0.0)
    used = determined | (np.arange(16) >= 6)
    # Scaled so that all entries have similar size.
    scale = np.sqrt(np.where(determined, np.diag(covariance), 1.0))
    scale[6:] = np.diag(information) ** -0.5
    data, total = np.zeros((2, 16, 16))
    block, used_block = np.ix_(determined, determined), np.ix_(used, used)
    data[block] = np.linalg.inv(covariance[block] / np.outer(scale, scale)[block])
    total[6:, 6:] = information * np.outer(scale, scale)[6:, 6:]
    total += data
    posterior = np.where(np.diag(~used & np.isinf(np.diag(covariance))), np.inf, 0.0)
    inverse = np.linalg.inv(total[used_block])
    posterior[used_block] = inverse * np.outer(scale, scale)[used_block]
    prior_share = np.zeros(16)
    prior_share[used] = 1.0 - np.diag(inverse @ data[used_block])
    return posterior, prior_dominated(np.sqrt(prior_share.clip(0.0)), np.ones(16))


def white_covariance(plain: Array, equations: NormalEquations, fit: Fit) -> Array:
    """Return the covariance (16, 16) of a fit with weights W between channels and noise W^-1.

    `plain` is that for uncorrelated channels.
    """
    W, Z = fit.form.weights, fit.moments.mean
    predicted = np.linalg.inv(W)
    if np.array_equal(W, np.diag(np.diag(W))):
        return plain
    scale = np.sqrt(equations.long_run_variances(fit.form.theta)[0] / np.diag(predicted))
    of_sums = W @ (predicted * np.outer(scale, scale)) @ W
    inverse = _inverse_gram(fit)
    covariance = inverse @ (fit.moments.samples * normal_equations(Z, of_sums)[0]) @ inverse
    unknown = np.isinf(np.diag(plain))
    covariance[unknown], covariance[:, unknown] = 0.0, 0.0
    covariance[unknown, unknown] = np.inf
    return covariance


def _inverse_gram(fit: Fit) -> Array:
    Z = fit.moments.mean
    root = inverse_root(normal_equations(Z, fit.form.weights)[0], excited_columns(Z))
    return np.asarray(root @ root.T / fit.moments.samples)


def walk_covariance(record: Record, kept: NDArray[np.bool_], fit: Fit, steps: Array) -> Array:
    """Return the covariance (16, 16) of [offsets; phi] due to random walks of offsets and motion.

    `kept` (N,) marks used samples; `steps` (6, 6) is the covariance of a step, as wrenches.
    """
    covariance = np.zeros((16, 16))
    if not steps.any():
        return covariance
    backwards, used = record.every(-1), kept[::-1]
    after = np.zeros((6, 16))
    for start in range(0, len(used), CHUNK):
        part = slice(start, start + CHUNK)
        rows = np.zeros((len(used[part]), 6, 16))
        rows[:, np.arange(6), np.arange(6)] = 1.0
        rows[:, :, 6:] = regressor(*(table[part] for table in backwards.arrays[1:]))
        rows = fit.form.weights @ (rows * used[part, None, None])
        sums = after + np.cumsum(rows, axis=0)
        after = sums[-1]
        sums -= rows
        covariance += np.einsum("nci,cd,ndj->ij", sums, steps, sums, optimize=True)
    inverse = _inverse_gram(fit)
    return inverse @ covariance @ inverse


def gain_effects(products: Array, W: Array, inverse: Array) -> Array:
    """Return the errors (n, 36) of n parameters for a unit error of each of the 36 sensor gains.

    Args:
        products: (bands, 6, n, 6) moments of column j in channel c with channel k of the wrench.
        W: (bands, 6, 6) weights between the channels.
        inverse: (n, n) inverse Gram matrix.
    """
    right = np.einsum("bcd,bcjk->jdk", W, products, optimize=True)  # per gain (d, k)
    length = np.repeat([1.0, ARM], 3)
    effect = np.einsum("ij,jdk->idk", inverse, right) * (length[:, None] / length)
    return np.asarray(effect.reshape(len(inverse), 36))


def gain_covariance(fit: Fit, offsets: bool) -> Array:
    """Return the covariance (16, 16) of [offsets; phi] for gain errors of deviation 1."""
    Z, W = fit.moments.mean, fit.form.weights
    used = excited_columns(Z) & (offsets | (np.arange(16) >= 6))
    root = inverse_root(normal_equations(Z, W)[0], used)
    products = (coefficients() @ Z)[:, :, 1:7]
    effects = fit.form.transfer @ gain_effects(products[None], W[None], root @ root.T)
    return np.asarray(effects @ effects.T)


def covariance_of(plain: Array, form: NormalForm, offsets: bool) -> Array:
    """Return the covariance (16, 16) of the solution `form`; `plain` is that of least squares."""
    unknown = np.isinf(np.diag(plain))
    covariance = np.where(unknown[:, None] | unknown, 0.0, plain)
    if not offsets:  # covariance for known offsets
        inner = np.linalg.pinv(covariance[:6, :6], hermitian=True)
        covariance = covariance - covariance[:, :6] @ inner @ covariance[:6]
        covariance[:6], covariance[:, :6] = 0.0, 0.0
    covariance = form.transfer @ covariance @ form.transfer.T
    unknown = unknown | form.undetermined
    covariance[unknown], covariance[:, unknown] = 0.0, 0.0
    covariance[unknown, unknown] = np.inf
    return covariance
