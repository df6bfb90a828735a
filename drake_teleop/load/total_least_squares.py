"""Errors in variables: the motion is measured with noise too, so V is not what it should be.

Noise of s, alpha and omega enters many entries of V at once, in force and torque rows together,
and least squares takes the excess of V^T V for excitation: it makes inertias too small. With the
mean covariance Q of the noise of z (`moments`) the residual r = F - [E V] theta has the covariance
R(theta) = L(theta) Q L(theta)^T, L the coefficients of r in z. Offsets and structural zeros have no
noise in Q and so stay exact.

`total_least_squares` is mixed LS-TLS (Van Huffel, Vandewalle, The Total Least Squares Problem,
1991, chapters 3 and 8) for a given weight W between the channels: it minimises the ratio

    lambda = tr(W S(theta)) / tr(W R(theta)),   S the mean of r r^T,

a generalised eigenvalue problem of (17, 17) matrices, whose solution is that of the compensated
normal equations (G - lambda C) theta = b: C is the Gram of the noise alone. lambda is the factor by
which the variances were stated too small; only their ratios matter. W = R(theta)^-1 is then taken
from the solution and the step repeated, which is the element-wise weighted TLS estimator for noise
whose covariance is the same in every sample (Kukush, Van Huffel, Metrika 59, 2004); omega's noise
has another in every sample, of which this uses the mean. Without noise in the motion C = 0, and it
is weighted least squares.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.linalg import eigh

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.load.arrays import Array
from drake_teleop.load.moments import (
    Moments,
    Noise,
    excited_columns,
    minimum_norm,
    normal_equations,
    residual_covariance,
)

# At most so many weights, until theta changes by less; and what keeps a singular matrix definite.
_ITERATIONS, _CONVERGED, _ROUNDING = 10, 1e-8, 1e-14


class NormalForm(NamedTuple):
    """gram theta = right of an estimator, divided by the number of samples, with its solution.

    Attributes:
        gram: (16, 16), compensated for the noise in it.
        right: (16,).
        theta: (16,) [offsets; phi] [SI].
        weights: (6, 6) W between the channels, the inverse of the residual's covariance.
        scale: lambda, residual variance over what the noise predicts.
    """

    gram: Array
    right: Array
    theta: Array
    weights: Array
    scale: float


def total_least_squares(
    moments: Moments,
    noise: Noise,
    wrench_noise: Array,
    *,
    offsets: bool = True,
    refine: Callable[[NormalForm], Array] | None = None,
) -> NormalForm:
    """Offsets and load where wrench and motion are noisy.

    Args:
        moments: of the record.
        noise: of the motion.
        wrench_noise: (6,) standard deviations of the wrench channels [N, N m].
        offsets: whether to estimate them; otherwise they are 0, subtracted already.
        refine: what becomes of each step's solution, such as the nearest consistent load: form ->
            theta (16,). It is then that from which the next weights are made.

    Raises:
        DrakeTeleopError: for fewer than 3 samples, or if the wrench is zero throughout.
    """
    Z, Q = moments.mean, moments.noise_covariance(noise, wrench_noise)
    if not Z[1:7, 1:7].any():
        raise DrakeTeleopError(
            "no mass can be told from this wrench",
            where="wrench",
            remedy="is the sensor connected, and does its orientation change?",
        )
    W: Array = np.diag(wrench_noise**-2.0)
    before = np.zeros(16)
    for _ in range(_ITERATIONS):
        form = _step(Z, Q, W, offsets)
        if refine is not None:
            form = form._replace(theta=refine(form))
        change = np.linalg.norm(form.theta - before)
        if not noise.motion.any() or change <= _CONVERGED * np.linalg.norm(before):
            break
        W = np.asarray(np.linalg.inv(residual_covariance(Q, form.theta)), np.float64)
        before = form.theta
    return form


def _step(Z: Array, Q: Array, W: Array, offsets: bool) -> NormalForm:
    """Mixed TLS with the weight W."""
    gram, right = normal_equations(Z, W)
    if not offsets:  # uncorrelated with all else, their estimate is 0
        gram[:6, 6:] = gram[6:, :6] = 0.0
        right[:6] = 0.0
    compensation, _ = normal_equations(Q, W)
    # The smallest lambda with [gram, -right; -right^T, tr(W Z_F)] - lambda [C, 0; 0, tr(W Q_F)]
    # singular is the largest reciprocal of the pencil turned round.
    whole, noise = np.zeros((17, 17)), np.zeros((17, 17))
    whole[:16, :16], whole[16, 16] = gram, np.sum(W * Z[1:7, 1:7])
    whole[16, :16] = whole[:16, 16] = -right
    noise[:16, :16], noise[16, 16] = compensation, np.sum(W * Q[1:7, 1:7])
    used = excited_columns(Z)
    kept = np.append(used, True)
    unit = 1.0 / np.sqrt(np.diag(whole)[kept])
    whole = whole[np.ix_(kept, kept)] * np.outer(unit, unit)
    whole += _ROUNDING * np.eye(len(whole))  # a record without noise is singular
    noise = noise[np.ix_(kept, kept)] * np.outer(unit, unit)
    scale = 1.0 / float(eigh(noise, whole, eigvals_only=True)[-1])
    gram = gram - scale * compensation
    return NormalForm(gram, right, minimum_norm(gram, right, used), W, scale)
