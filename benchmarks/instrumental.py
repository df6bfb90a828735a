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
from drake_teleop.load.normal_equations import regressor_coefficients
from drake_teleop.load.online.recursive_tls import (
    MomentEstimator,
    forget_samples,
    products_vector,
    residual_products,
    solve_with_ridge,
    weighted_normal_equations,
)
from drake_teleop.load.regressor import SAMPLE_MOTION, SAMPLE_WRENCH

INSTRUMENTS = slice(15, 24)  # motion from a second source, after the sample


# Relative increase of M's diagonal against rounding.
_RIDGE = 1e-9
# Number of samples with the specified wrench noise: first residuals are too small.
_NOISE_SAMPLES = 20.0
# Squared residual over squared wrench that counts as rounding.
_ROUNDING_SQUARE = 1e-13


@njit(cache=True)
def riv_normal_equations(memory, theta, noise_std, information, T):
    """Return R^T M^-1 R + prior (16, 16) and R^T M^-1 g + prior theta_0 (16,).

    Args:
        memory: (58, 19) sums of z z^T, y z^T, y y^T (y of the instruments), and the prior's part.
        theta: (16,) estimate, for the weights.
        noise_std: (6,) of the wrench [N, N m].
        information: (16,) of the prior.
        T: `regressor_coefficients`.
    """
    measured, mixed, instruments = memory[:19], memory[19:38], memory[38:57]
    S = residual_products(measured, theta, T)
    for c in range(6):
        S[c, c] += _NOISE_SAMPLES * noise_std[c] ** 2 + _ROUNDING_SQUARE * measured[1 + c, 1 + c]
    W = np.linalg.inv(S / (measured[0, 0] + _NOISE_SAMPLES))
    M, _ = weighted_normal_equations(instruments, W, T)
    R, g = weighted_normal_equations(mixed, W, T)
    M += np.diag(_RIDGE * np.diag(M) + information)
    projected = np.linalg.solve(M, R).T
    return np.dot(projected, R) + np.diag(information), np.dot(projected, g) + memory[57, :16]


@njit(cache=True)
def riv_update(theta, memory, samples, noise_std, forgetting, information, T):
    """Update the estimate by each sample; compiled, without checks.

    Args:
        theta: (16,) [offsets; phi], updated.
        memory: (58, 19), updated.
        samples: (N, 24) [wrench, s, omega, alpha, instruments (s, omega, alpha)].
        forgetting: factor per sample on the weight of the past.
    """
    for n in range(len(samples)):
        if forgetting < 1.0:
            forget_samples(memory, theta, information, forgetting)
        z = products_vector(samples[n, SAMPLE_WRENCH], samples[n, SAMPLE_MOTION])
        y = products_vector(samples[n, SAMPLE_WRENCH], samples[n, INSTRUMENTS])
        memory[:19] += np.outer(z, z)
        memory[19:38] += np.outer(y, z)
        memory[38:57] += np.outer(y, y)
        A, b = riv_normal_equations(memory, theta, noise_std, information, T)
        theta[:] = solve_with_ridge(A, b)


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
        options = (self._noise_std, 1.0 / self._prior, regressor_coefficients())
        A, _ = riv_normal_equations(memory, theta, *options)
        return self._limit_variances_to_prior(np.linalg.inv(0.5 * (A + A.T)))

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
        options = (self._noise_std, self._forgetting, 1.0 / self._prior, regressor_coefficients())
        riv_update(theta, memory, samples, *options)
