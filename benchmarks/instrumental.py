"""Recursive instrumental variables for load and offsets, Eq. (T19).

Least squares is biased because noise of the motion is in V and in the equation errors. Instruments
are V of a second source with independent noise, such as the commanded motion or derivatives of
encoder readings (Kubus, Kroeger, Wahl, IROS 2007; Ljung, System Identification, section 7.6). The
noise level of the motion is not needed. With M = Y^T W Y, R = Y^T W X, g = Y^T W F, X = [E V] and
Y = [E V(instruments)]:

    (R^T M^-1 R + prior) theta = R^T M^-1 g + prior theta_0

W (6, 6) is the inverse covariance of the residuals: three-stage least squares (Zellner, Theil,
Econometrica 30, 1962).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Array, broadcast_to_rows
from drake_teleop.common.vectors import copy_into
from drake_teleop.load.online.recursive_tls import (
    MomentEstimator,
    add_outer_product,
    allocate_work_arrays,
    discount_samples_and_set_prior_to_theta,
    eliminate_below_diagonal,
    nonzero_regressor_terms,
    solve_augmented_system_in_place,
    write_inverse_6x6,
    write_moment_vector,
    write_residual_products,
    write_weighted_gram,
    write_weighted_right_side,
)
from drake_teleop.load.regressor import MOTION_SLICE, WRENCH_SLICE

INSTRUMENTS = slice(15, 24)  # motion from a second source, after the sample


# Relative increase of M's diagonal against rounding.
_RIDGE = 1e-9
# Number of samples with the specified wrench noise: first residuals are too small.
_NOISE_SAMPLES = 20.0
# Squared residual over squared wrench that counts as rounding.
_ROUNDING_SQUARE = 1e-13


@njit(cache=True)
def riv_normal_equations(memory, theta, noise_std, information, index, factors, space, MRg, A):
    """Write R^T M^-1 R + prior and R^T M^-1 g + prior theta_0 into A (16, 17).

    Args:
        memory: (58, 19) sums of z z^T, y z^T, y y^T (y of the instruments), and the prior's part.
        theta: (16,) estimate, for the weights.
        noise_std: (6,) of the wrench [N, N m].
        information: (16,) of the prior.
        index, factors: from `terms`, space: from `scratch`, MRg: (16, 33) scratch.
    """
    E, g, L, LZ, inverse, S, W = space
    measured, mixed, instruments = memory[:19], memory[19:38], memory[38:57]
    write_residual_products(measured, theta, index, factors, L, LZ, S)
    for c in range(6):
        S[c, c] += _NOISE_SAMPLES * noise_std[c] ** 2 + _ROUNDING_SQUARE * measured[13 + c, 13 + c]
        for d in range(6):
            S[c, d] /= measured[0, 0] + _NOISE_SAMPLES
    write_inverse_6x6(S, inverse, W)
    write_weighted_gram(instruments, W, index, factors, E, MRg, 0)
    write_weighted_gram(mixed, W, index, factors, E, MRg, 16)
    write_weighted_right_side(mixed[:, 13:].T, W, index, factors, g)
    for i in range(16):
        MRg[i, 32] = g[i]
        MRg[i, i] += _RIDGE * MRg[i, i] + information[i]
        for j in range(17):
            A[i, j] = 0.0
        A[i, i] = information[i]
        A[i, 16] = memory[57, i]
    eliminate_below_diagonal(MRg)
    for k in range(16):
        pivot = 1.0 / MRg[k, k]
        for i in range(16):
            factor = pivot * MRg[k, 16 + i]
            for j in range(17):
                A[i, j] += factor * MRg[k, 16 + j]


@njit(cache=True)
def riv_update(theta, memory, samples, noise_std, forgetting, information, index, factors):
    """Update the estimate by each sample; compiled, without checks.

    Args:
        theta: (16,) [offsets; phi], updated.
        memory: (58, 19), updated.
        samples: (N, 24) [wrench, s, omega, alpha, instruments (s, omega, alpha)].
        forgetting: factor per sample on the weight of the past.
    """
    space, MRg, A = allocate_work_arrays(), np.empty((16, 33)), np.empty((16, 17))
    y, z = np.empty(19), np.empty(19)
    for n in range(len(samples)):
        if forgetting < 1.0:
            discount_samples_and_set_prior_to_theta(memory, theta, information, forgetting)
        wrench = samples[n, WRENCH_SLICE]
        write_moment_vector(wrench, samples[n, MOTION_SLICE], z)
        write_moment_vector(wrench, samples[n, INSTRUMENTS], y)
        add_outer_product(z, z, memory[:19])
        add_outer_product(y, z, memory[19:38])
        add_outer_product(y, y, memory[38:57])
        riv_normal_equations(memory, theta, noise_std, information, index, factors, space, MRg, A)
        solve_augmented_system_in_place(A)
        copy_into(theta, 0, A[:, 16], 0, 16)


class RecursiveInstrumentalVariables(MomentEstimator):
    """Recursive instrumental variables; `update_samples` requires instruments."""

    method = "recursive instrumental variables"

    def initial_memory(self, theta: Array) -> Array:
        """Return the memory (58, 19): three sums, and the prior's information times theta."""
        memory = np.zeros((58, 19))
        memory[-1, :16] = theta / self._prior
        return memory

    def covariance_of(self, theta: Array, memory: Array) -> Array:
        """Return the covariance (16, 16), (R^T M^-1 R + prior)^-1."""
        A, MRg = np.empty((16, 17)), np.empty((16, 33))
        options = (self._noise_std, 1.0 / self._prior, *nonzero_regressor_terms())
        riv_normal_equations(memory, theta, *options, allocate_work_arrays(), MRg, A)
        return self._limit_variances_to_prior(np.linalg.inv(0.5 * (A[:, :16] + A[:, :16].T)))

    def update_samples(
        self,
        wrench: ArrayLike,
        s: ArrayLike,
        omega: ArrayLike,
        alpha: ArrayLike,
        instruments: ArrayLike,
    ) -> None:
        """Update by N samples; instruments (N, 9) are [s; omega; alpha] from a second source."""
        motion = {"s": (s, 3), "omega": (omega, 3), "alpha": (alpha, 3)}
        _, rows = broadcast_to_rows(wrench=(wrench, 6), **motion, instruments=(instruments, 9))
        self._update_state(self._theta, self._memory, np.concatenate(rows, axis=1))
        self._samples += len(rows[0])

    def _update_state(self, theta: Array, memory: Array, samples: Array) -> None:
        options = (self._noise_std, self._forgetting, 1.0 / self._prior, *nonzero_regressor_terms())
        riv_update(theta, memory, samples, *options)
