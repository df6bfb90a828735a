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

Where the motion is no more than its noise, as the angular acceleration in static poses, there is
nothing to learn, and dividing by the difference of G and lambda C would sell noise for inertias.
Directions v in which v^T G v exceeds lambda v^T C v by less than the fraction 5 sqrt(2 / N), five
standard deviations of a sum of squares of N samples of noise, are therefore left out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from drake_teleop.common.arrays import Array
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.batch.moments import (
    Moments,
    Noise,
    excited_columns,
    inverse_root,
    normal_equations,
    residual_covariance,
)

# At most so many weights, until theta changes by less; how near to a pole a root may be; and
# standard deviations of noise that a signal must exceed.
_ITERATIONS, _CONVERGED, _ROUNDING, _SIGNIFICANT = 10, 1e-8, 1e-12, 5.0
_NOTHING = 1e-60  # N^2, N^2 m^2: mean squares whose inverse is beyond all use


class NormalForm(NamedTuple):
    """gram theta = right of an estimator, divided by the number of samples, with its solution.

    Attributes:
        gram: (16, 16), compensated for the noise in it.
        right: (16,).
        theta: (16,) [offsets; phi] [SI].
        weights: (6, 6) W between the channels, the inverse of the residual's covariance.
        scale: lambda, residual variance over what the noise predicts.
        transfer: (16, 16) from the solution of plain least squares with these weights to theta.
        undetermined: (16,) bools, parameters whose variance in plain least squares comes for the
            most part from directions that were left out.
    """

    gram: Array
    right: Array
    theta: Array
    weights: Array
    scale: float
    transfer: Array
    undetermined: NDArray[np.bool_]


def total_least_squares(
    moments: Moments,
    noise: Noise,
    wrench_noise: Array,
    *,
    offsets: bool = True,
) -> NormalForm:
    """Offsets and load where wrench and motion are noisy.

    Args:
        moments: of the record.
        noise: of the motion.
        wrench_noise: (6,) standard deviations of the wrench channels [N, N m].
        offsets: whether to estimate them; otherwise they are 0, subtracted already.

    Raises:
        DrakeTeleopError: for fewer than 3 samples, or if the wrench is zero throughout.
    """
    Z, Q = moments.mean, moments.noise_covariance(noise, wrench_noise)
    if np.diag(Z)[1:7].max() <= _NOTHING:
        raise DrakeTeleopError(
            "no mass can be told from this wrench",
            where="wrench",
            remedy="is the sensor connected, and does its orientation change?",
        )
    W: Array = np.diag(wrench_noise**-2.0)
    excess = _SIGNIFICANT * np.sqrt(2.0 / moments.samples)
    before, least = np.zeros(16), excess / (1.0 + excess)
    for _ in range(_ITERATIONS):
        form = _step(Z, Q, W, offsets, least)
        change = np.linalg.norm(form.theta - before)
        if not noise.motion.any() or change <= _CONVERGED * np.linalg.norm(before):
            break
        W = np.asarray(np.linalg.inv(residual_covariance(Q, form.theta)), np.float64)
        before = form.theta
    return form


def _step(Z: Array, Q: Array, W: Array, offsets: bool, least: float) -> NormalForm:
    """Mixed TLS with the weight W, without directions of which less than `least` is signal."""
    gram, right = normal_equations(Z, W)
    if not offsets:  # uncorrelated with all else, their estimate is 0
        gram[:6, 6:] = gram[6:, :6] = 0.0
        right[:6] = 0.0
    compensation, _ = normal_equations(Q, W)
    root = inverse_root(gram, excited_columns(Z))
    # In these coordinates G is the identity: nu is the share of noise in each direction.
    nu, vectors = np.linalg.eigh(root.T @ compensation @ root)
    basis = root @ vectors
    scale = _ratio(basis.T @ right, nu, float(np.sum(W * Z[1:7, 1:7])), np.sum(W * Q[1:7, 1:7]))
    gain = 1.0 - scale * nu
    kept = gain > (least if nu[-1] > 0.0 else 0.0)
    inverse = (basis[:, kept] / gain[kept]) @ basis[:, kept].T
    theta = inverse @ right
    if not offsets:
        theta[:6] = 0.0
    along = gram @ basis[:, kept]
    variance = np.sum(basis**2, axis=1)
    return NormalForm(
        gram=(along * gain[kept]) @ along.T,
        right=along @ (basis[:, kept].T @ right),
        theta=theta,
        weights=W,
        scale=scale,
        transfer=inverse @ gram,
        undetermined=np.sum(basis[:, ~kept] ** 2, axis=1) > 0.5 * variance,
    )


def _ratio(right: Array, nu: Array, squares: float, noise: float) -> float:
    """The smallest lambda with [I, -b; -b^T, squares] - lambda [diag(nu), 0; 0, noise] singular.

    It is the one root below 1 / max nu of the secular equation.
    """

    def excess(ratio: float) -> float:
        return float(squares - ratio * noise - np.sum(right**2 / (1.0 - ratio * nu)))

    highest = squares / noise
    if highest * nu[-1] >= 1.0:
        highest = (1.0 - _ROUNDING) / nu[-1]
    if excess(0.0) <= 0.0:  # no residual
        return 0.0
    return highest if excess(highest) >= 0.0 else float(brentq(excess, 0.0, highest, rtol=1e-14))
