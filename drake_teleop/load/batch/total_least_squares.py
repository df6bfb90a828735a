"""Total least squares, which allows for noise of wrench and motion, Eq. (T4).

Source: Van Huffel, Vandewalle, The Total Least Squares Problem, 1991, chapters 3 and 8.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.numeric import Array
from drake_teleop.load.normal_equations import (
    NoiseStd,
    SecondMoments,
    excited_columns,
    normal_equations,
    residual_covariance,
    root_of_pseudo_inverse,
    unidentifiable_mass_error,
)
from drake_teleop.load.regressor import non_contact_wrench

# Largest number of weight updates, relative change of theta at convergence, smallest relative
# distance of a root from a pole, and standard deviations of noise that a signal must exceed.
_MAX_REWEIGHTINGS, _THETA_TOLERANCE, _MIN_POLE_DISTANCE, _MIN_SIGNAL_STDS = 10, 1e-8, 1e-12, 5.0
_MIN_WRENCH_MEAN_SQUARE = 1e-60  # mean square whose inverse overflows [N^2, N^2 m^2]


class SolvedNormalEquations(NamedTuple):
    """Normal equations gram theta = right, and their solution theta = [offsets; phi] (16,).

    Attributes:
        gram: (16, 16) Gram matrix per sample, without the part due to motion noise.
        weights: (6, 6) weighting matrix of the residual.
        noise_scale: ratio of observed to given noise variance.
        map_from_ordinary: (16, 16) matrix that maps the ordinary least squares theta to this one.
    """

    gram: Array
    right: Array
    theta: Array
    weights: Array
    noise_scale: float
    map_from_ordinary: Array
    is_undetermined: NDArray[np.bool_]


def total_least_squares(
    moments: SecondMoments, noise: NoiseStd, wrench_noise: Array, *, offsets: bool = True
) -> SolvedNormalEquations:
    """Return the total least squares fit of load and offsets to the moments of a record.

    `noise` is of the motion, `wrench_noise` (6,) of the wrench; `offsets` False: offsets are 0.
    """
    Z, Q = moments.mean_products, moments.mean_noise_covariance_of_z(noise, wrench_noise)
    if np.diag(Z)[1:7].max() <= _MIN_WRENCH_MEAN_SQUARE:
        raise unidentifiable_mass_error("the wrench is 0 throughout")
    W: Array = np.diag(wrench_noise**-2.0)
    excess = _MIN_SIGNAL_STDS * np.sqrt(2.0 / moments.num_samples)
    previous, min_remaining_share = np.zeros(16), excess / (1.0 + excess)
    for _ in range(_MAX_REWEIGHTINGS):
        solved = _solve_noise_compensated_equations(Z, Q, W, offsets, min_remaining_share)
        change = np.linalg.norm(solved.theta - previous)
        if not noise.motion.any() or change <= _THETA_TOLERANCE * np.linalg.norm(previous):
            break
        W = np.asarray(np.linalg.inv(residual_covariance(Q, solved.theta)), np.float64)
        previous = solved.theta
    return solved


def _solve_noise_compensated_equations(
    Z: Array, noise_covariance: Array, W: Array, offsets: bool, min_remaining_share: float
) -> SolvedNormalEquations:
    gram, right = normal_equations(Z, W)
    if not offsets:  # without correlation to other columns, their estimate is 0
        gram[:6, 6:] = gram[6:, :6] = 0.0
        right[:6] = 0.0
    compensation, _ = normal_equations(noise_covariance, W)
    root = root_of_pseudo_inverse(gram, excited_columns(Z))
    # In these coordinates G is the identity; shares are the noise shares of the directions.
    shares, vectors = np.linalg.eigh(root.T @ compensation @ root)
    basis = root @ vectors
    squares, noise = (float(np.sum(W * moments[1:7, 1:7])) for moments in (Z, noise_covariance))
    scale = _min_singular_noise_scale(basis.T @ right, shares, squares, noise)
    remaining = 1.0 - scale * shares
    kept = remaining > (min_remaining_share if shares[-1] > 0.0 else 0.0)
    inverse = (basis[:, kept] / remaining[kept]) @ basis[:, kept].T
    theta = inverse @ right
    if not offsets:
        theta[:6] = 0.0
    gram_basis = gram @ basis[:, kept]
    variance = np.sum(basis**2, axis=1)
    return SolvedNormalEquations(
        gram=(gram_basis * remaining[kept]) @ gram_basis.T,
        right=gram_basis @ (basis[:, kept].T @ right),
        theta=theta,
        weights=W,
        noise_scale=scale,
        map_from_ordinary=inverse @ gram,
        is_undetermined=np.sum(basis[:, ~kept] ** 2, axis=1) > 0.5 * variance,
    )


def _min_singular_noise_scale(right: Array, shares: Array, squares: float, noise: float) -> float:
    def schur_complement(scale: float) -> float:
        return float(squares - scale * noise - np.sum(right**2 / (1.0 - scale * shares)))

    highest = squares / noise
    if highest * shares[-1] >= 1.0:
        highest = (1.0 - _MIN_POLE_DISTANCE) / shares[-1]
    if schur_complement(0.0) <= 0.0:  # no residual
        return 0.0
    from scipy.optimize import brentq  # 0.2 s, which a study with known loads saves

    if schur_complement(highest) >= 0.0:
        return highest
    return float(brentq(schur_complement, 0.0, highest, rtol=1e-14))


@dataclass(frozen=True, eq=False)
class EstimatorOptions:
    """Options of a batch estimator."""

    noise: NoiseStd
    offsets: bool = True
    shared_noise: bool = False


@dataclass(frozen=True, eq=False)
class SampleRecord:
    """Validated samples of a record: wrench (N, 6), motion s, omega and alpha (N, 3)."""

    wrench: Array
    s: Array
    omega: Array
    alpha: Array

    @property
    def wrench_and_motion(self) -> tuple[Array, Array, Array, Array]:
        return self.wrench, self.s, self.omega, self.alpha

    @cached_property
    def moments(self) -> SecondMoments:
        moments = SecondMoments()
        moments.add_samples(*self.wrench_and_motion)
        return moments

    def with_row_step(self, step: int) -> SampleRecord:
        return SampleRecord(*(table[::step] for table in self.wrench_and_motion))

    def residual(self, theta: Array, rows: slice) -> Array:
        F, s, omega, alpha = (table[rows] for table in self.wrench_and_motion)
        return F - theta[:6] - non_contact_wrench(s, omega, alpha, theta[6:])


@dataclass(frozen=True, eq=False)
class EstimatorFit:
    """Fit of an estimator: solution, wrench noise (6,) [N, N m], rejected samples (N,), note."""

    solved: SolvedNormalEquations
    wrench_noise: Array
    moments: SecondMoments
    rejected: NDArray[np.bool_]
    note: str = ""
