"""Mixed least squares and total least squares: noise in the measured motion too, Eq. (T4).

The estimate minimises lambda = tr(W S(theta)) / tr(W R(theta)), the ratio of the residual
covariance S to the covariance R that the specified noise causes (Van Huffel, Vandewalle, The Total
Least Squares Problem, 1991, chapters 3 and 8). W = R(theta)^-1 is updated until convergence
(Kukush, Van Huffel, Metrika 59, 2004).

A direction v is omitted if its signal v^T G v exceeds its noise n = lambda v^T C v by less than
5 sqrt(2 / N) n: the motion along v is not distinguishable from noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.load.batch.consistent import Ellipsoid, Prior
from drake_teleop.load.batch.moments import (
    Moments,
    Noise,
    excited_columns,
    inverse_root,
    normal_equations,
    residual_covariance,
)
from drake_teleop.load.regressor import non_contact_wrench

# Largest number of weight updates, relative change of theta at convergence, smallest relative
# distance of a root from a pole, and standard deviations of noise that a signal must exceed.
_MAX_ITERATIONS, _THETA_TOLERANCE, _POLE_DISTANCE, _NOISE_DEVIATIONS = 10, 1e-8, 1e-12, 5.0
_MIN_MEAN_SQUARE = 1e-60  # mean square whose inverse overflows [N^2, N^2 m^2]


class NormalForm(NamedTuple):
    """Equations gram theta = right, divided by the number of samples, and their solution.

    Attributes:
        gram: (16, 16) Gram matrix, compensated for noise.
        right: (16,) right-hand side.
        theta: (16,) solution [offsets; phi] [SI].
        weights: (6, 6) weights W between channels.
        scale: lambda.
        transfer: (16, 16) matrix from the ordinary least squares solution to theta.
        undetermined: (16,) True for parameters whose variance is mostly in omitted directions.
    """

    gram: Array
    right: Array
    theta: Array
    weights: Array
    scale: float
    transfer: Array
    undetermined: NDArray[np.bool_]


def total_least_squares(
    moments: Moments, noise: Noise, wrench_noise: Array, *, offsets: bool = True
) -> NormalForm:
    """Return offsets and load, allowing for noise of the wrench (6,) [N, N m] and of the motion.

    `offsets=False` fixes the offsets at 0.

    Raises:
        DrakeTeleopError: for fewer than 3 samples, or if the wrench is zero throughout.
    """
    Z, Q = moments.mean, moments.noise_covariance(noise, wrench_noise)
    if np.diag(Z)[1:7].max() <= _MIN_MEAN_SQUARE:
        raise DrakeTeleopError(
            "the mass cannot be identified from this wrench",
            where="wrench",
            remedy="check that the sensor is connected and that its orientation changes",
        )
    W: Array = np.diag(wrench_noise**-2.0)
    excess = _NOISE_DEVIATIONS * np.sqrt(2.0 / moments.samples)
    previous, min_gain = np.zeros(16), excess / (1.0 + excess)
    for _ in range(_MAX_ITERATIONS):
        form = _solve(Z, Q, W, offsets, min_gain)
        change = np.linalg.norm(form.theta - previous)
        if not noise.motion.any() or change <= _THETA_TOLERANCE * np.linalg.norm(previous):
            break
        W = np.asarray(np.linalg.inv(residual_covariance(Q, form.theta)), np.float64)
        previous = form.theta
    return form


def _solve(Z: Array, Q: Array, W: Array, offsets: bool, min_gain: float) -> NormalForm:
    """Return mixed TLS for weights W, without directions whose gain is below `min_gain`."""
    gram, right = normal_equations(Z, W)
    if not offsets:  # without correlation to other columns, their estimate is 0
        gram[:6, 6:] = gram[6:, :6] = 0.0
        right[:6] = 0.0
    compensation, _ = normal_equations(Q, W)
    root = inverse_root(gram, excited_columns(Z))
    # In these coordinates G is the identity; nu is the noise share of each direction.
    nu, vectors = np.linalg.eigh(root.T @ compensation @ root)
    basis = root @ vectors
    scale = _min_root(basis.T @ right, nu, float(np.sum(W * Z[1:7, 1:7])), np.sum(W * Q[1:7, 1:7]))
    gain = 1.0 - scale * nu
    kept = gain > (min_gain if nu[-1] > 0.0 else 0.0)
    inverse = (basis[:, kept] / gain[kept]) @ basis[:, kept].T
    theta = inverse @ right
    if not offsets:
        theta[:6] = 0.0
    gram_basis = gram @ basis[:, kept]
    variance = np.sum(basis**2, axis=1)
    return NormalForm(
        gram=(gram_basis * gain[kept]) @ gram_basis.T,
        right=gram_basis @ (basis[:, kept].T @ right),
        theta=theta,
        weights=W,
        scale=scale,
        transfer=inverse @ gram,
        undetermined=np.sum(basis[:, ~kept] ** 2, axis=1) > 0.5 * variance,
    )


def _min_root(right: Array, nu: Array, squares: float, noise: float) -> float:
    """Return the smallest lambda for which the matrix
    [I, -b; -b^T, squares] - lambda [diag(nu), 0; 0, noise] is singular.

    This is the only root below 1 / max(nu) of the secular equation; b is `right`.
    """

    def excess(ratio: float) -> float:
        return float(squares - ratio * noise - np.sum(right**2 / (1.0 - ratio * nu)))

    highest = squares / noise
    if highest * nu[-1] >= 1.0:
        highest = (1.0 - _POLE_DISTANCE) / nu[-1]
    if excess(0.0) <= 0.0:  # no residual
        return 0.0
    return highest if excess(highest) >= 0.0 else float(brentq(excess, 0.0, highest, rtol=1e-14))


@dataclass(frozen=True, eq=False)
class Options:
    """Options of a batch estimator, as for `identify_batch`."""

    noise: Noise
    offsets: bool = True
    shared_noise: bool = False
    prior: Prior | None = None
    ellipsoid: Ellipsoid | None = None


@dataclass(frozen=True, eq=False)
class Record:
    """Checked samples: wrench (N, 6), motion s, omega and alpha (N, 3)."""

    wrench: Array
    s: Array
    omega: Array
    alpha: Array

    @property
    def arrays(self) -> tuple[Array, Array, Array, Array]:
        """Tables wrench (N, 6), s, omega and alpha (N, 3)."""
        return self.wrench, self.s, self.omega, self.alpha

    @cached_property
    def moments(self) -> Moments:
        """Second moments of the record."""
        moments = Moments()
        moments.add(*self.arrays)
        return moments

    def every(self, step: int) -> Record:
        """Return a record with every `step`-th sample."""
        return Record(*(table[::step] for table in self.arrays))

    def residual(self, theta: Array, part: slice) -> Array:
        """Return the residuals F - [E V] theta (n, 6) of the samples in `part`."""
        F, s, omega, alpha = (table[part] for table in self.arrays)
        return F - theta[:6] - non_contact_wrench(s, omega, alpha, theta[6:])


@dataclass(frozen=True, eq=False)
class Fit:
    """Result: normal form, wrench noise (6,), moments, rejected samples (N,), note for the user."""

    form: NormalForm
    wrench_noise: Array
    moments: Moments
    rejected: NDArray[np.bool_]
    note: str = ""
