"""Second moments of a record, from which all least squares estimates follow, Eq. (T4).

They are the mean of z z^T, where row c of the regressor [E V] is T_c z, constant T_c, w = omega:

    z = [1, F (6), s (3), alpha (3), w_x w_x, w_y w_y, w_z w_z, w_x w_y, w_x w_z, w_y w_z]   (19)
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import (
    Array,
    broadcast_to_rows,
    finite_array,
    nonnegative_array,
    positive_array,
)
from drake_teleop.load.regressor import regressor

_MAX_MOMENT_BLOCKS = 1024
SAMPLES_PER_CHUNK = 2**15
"""Samples per pass over a long record."""
# Limits of singular directions of the scaled Gram and of excitation [m/s^2, rad/s^2], as in
# `normal_equations`.
_MIN_RELATIVE_GRAM_EIGENVALUE, _MIN_RMS_EXCITATION = 1e-12, 1e-9
OMEGA_PRODUCT_INDICES = np.array([[13, 16, 17], [16, 14, 18], [17, 18, 15]])
"""Indices of the products w_i w_j in z."""


@dataclass(frozen=True, eq=False)
class NoiseStd:
    """Standard deviations of white measurement noise, independent between channels.

    Attributes:
        wrench: (6,) [N, N m]; None to estimate it from the residual.
        s, omega, alpha: (3,), or a number for all axes [m/s^2, rad/s, rad/s^2].
        walk: (12,), or 0: step per sample of random walks of [wrench, s, alpha].
    """

    wrench: ArrayLike | None = None
    s: ArrayLike = 0.0
    omega: ArrayLike = 0.0
    alpha: ArrayLike = 0.0
    walk: ArrayLike = 0.0
    motion: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        nonnegative_array("noise.walk", np.broadcast_to(self.walk, 12), 12)
        rows = [
            nonnegative_array(f"noise.{name}", np.broadcast_to(getattr(self, name), 3), 3)
            for name in ("s", "omega", "alpha")
        ]
        object.__setattr__(self, "motion", np.stack(rows))
        if self.wrench is not None:
            positive_array("noise.wrench", self.wrench, 6)


class SecondMoments:
    """Sum of z z^T (19, 19) over the samples of a record, z as in the module docstring."""

    def __init__(self) -> None:
        self._sums, self._blocks = np.zeros((19, 19)), np.zeros((_MAX_MOMENT_BLOCKS, 19))
        # Index of the open block, samples of a full block, samples of the open block.
        self._state = np.array([0, 1, 0])

    @property
    def num_samples(self) -> float:
        """Number of samples, or the sum of their weights."""
        return float(self._sums[0, 0])

    @property
    def mean_products(self) -> Array:
        if self.num_samples < 3:
            raise DrakeTeleopError(
                f"{self.num_samples:.3g} samples cannot determine a load",
                remedy="give at least 3, in different orientations",
            )
        return self._sums / self.num_samples

    def add_samples(
        self,
        wrench: ArrayLike,
        s: ArrayLike,
        omega: ArrayLike,
        alpha: ArrayLike,
        weights: ArrayLike | None = None,
    ) -> None:
        """Add N samples, or a single one, with arguments as for `identify` and `weights` (N,)."""
        _, rows = broadcast_to_rows(
            wrench=(wrench, 6), s=(s, 3), omega=(omega, 3), alpha=(alpha, 3)
        )
        n = rows[0].shape[0]
        weight = np.ones(n) if weights is None else finite_array("weights", weights, n)
        for start in range(0, n, SAMPLES_PER_CHUNK):
            part = np.zeros((19, 19))
            chunk = (table[start : start + SAMPLES_PER_CHUNK] for table in (*rows, weight))
            _add_sample_products(*chunk, part, self._blocks, self._state)
            self._sums += part + np.triu(part, 1).T

    def noise_covariance(self, noise: NoiseStd, wrench: Array) -> Array:
        """Return the mean covariance (19, 19) of z by noise, with wrench noise (6,) [N, N m]."""
        Q = np.zeros((19, 19))
        std = np.concatenate([wrench, noise.motion[0], noise.motion[2]])
        Q[np.arange(1, 13), np.arange(1, 13)] = std**2
        products = self.mean_products[0, OMEGA_PRODUCT_INDICES]
        for std, J in zip(
            noise.motion[1], omega_product_jacobians(OMEGA_PRODUCT_INDICES, 19), strict=True
        ):
            Q += std**2 * J.T @ products @ J
        return Q


@cache
def regressor_coefficients() -> Array:
    """Return the constant T (6, 16, 19) with regressor [E V] = T z, Eq. (T4)."""
    T, unit, zero = np.zeros((6, 16, 19)), np.eye(3), np.zeros(3)
    T[np.arange(6), np.arange(6), 0] = 1.0
    T[:, 6:, 7:10] = np.moveaxis(regressor(unit, zero, zero), 0, -1)
    T[:, 6:, 10:13] = np.moveaxis(regressor(zero, zero, unit), 0, -1)
    T[:, 6:, 13:16] = np.moveaxis(regressor(zero, unit, zero), 0, -1)
    for k, (i, j) in enumerate([(0, 1), (0, 2), (1, 2)]):
        both = regressor(zero, unit[i] + unit[j], zero)
        T[:, 6:, 16 + k] = both - regressor(zero, unit[[i, j]], zero).sum(axis=0)
    T.flags.writeable = False
    return T


def omega_product_jacobians(indices: NDArray[np.intp], size: int) -> Array:
    """Return derivatives (3, 3, size) of products w_i w_j by w_k, as coefficients of w_i.

    `indices` (3, 3) are the positions of the products in a vector of this size.
    """
    jacobians = np.zeros((3, 3, size))
    for i in range(3):
        for j in range(3):
            jacobians[j, i, indices[i, j]] += 1.0 + (i == j)
    return jacobians


def centripetal_matrix(r: Array) -> Array:
    """Return C (..., 3, 6) with omega x (omega x r) = C z[13:19], the products w_i w_j of omega."""
    x, y, z = np.moveaxis(r, -1, 0)
    o = np.zeros_like(x)
    rows = [[o, -x, -x, y, z, o], [-y, o, -y, x, o, z], [-z, -z, o, o, x, y]]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def normal_equations(Z: Array, W: Array) -> tuple[Array, Array]:
    """Return Gram matrix (16, 16) and right-hand side (16,) for [offsets; phi], from moments Z."""
    T = regressor_coefficients()
    TZ = (T.reshape(96, 19) @ Z).reshape(6, 16, 19)
    WT = (W @ T.reshape(6, -1)).reshape(6, 16, 19)
    gram = TZ.transpose(1, 0, 2).reshape(16, -1) @ WT.transpose(1, 0, 2).reshape(16, -1).T
    right = np.einsum("cjd,cd->j", TZ[:, :, 1:7], W)
    return 0.5 * (gram + gram.T), right


def residual_covariance(Z: Array, theta: Array) -> Array:
    """Return the mean (6, 6) of r r^T, residual r = F - [E V] theta, from moments Z."""
    L = -np.einsum("cjk,j->ck", regressor_coefficients(), theta)
    L[np.arange(6), np.arange(1, 7)] += 1.0
    S = L @ Z @ L.T
    return 0.5 * (S + S.T)


def excited_columns(Z: Array) -> NDArray[np.bool_]:
    """Return (16,) True for parameters whose influence on the wrench exceeds rounding errors."""
    return np.diag(normal_equations(Z, np.eye(6))[0]) > _MIN_RMS_EXCITATION**2


def root_of_pseudo_inverse(gram: Array, used: NDArray[np.bool_]) -> Array:
    """Return R (n, rank) such that R R^T is the pseudo-inverse of the Gram matrix."""
    scale = np.where(used, 1.0 / np.sqrt(np.where(used, np.diag(gram), 1.0)), 0.0)
    eigenvalues, vectors = np.linalg.eigh(gram * np.outer(scale, scale))
    kept = eigenvalues > _MIN_RELATIVE_GRAM_EIGENVALUE * eigenvalues[-1]
    return np.asarray(scale[:, None] * vectors[:, kept] / np.sqrt(eigenvalues[kept]), np.float64)


@njit(cache=True)
def _add_sample_products(wrench, s, omega, alpha, weights, sums, blocks, state):
    z = np.empty(19)
    last, length, filled = state
    for i in range(wrench.shape[0]):
        if filled == length:
            last, filled = last + 1, 0
        if last == blocks.shape[0]:
            last, length = last // 2, 2 * length
            for b in range(last):
                blocks[b] = blocks[2 * b] + blocks[2 * b + 1]
            blocks[last:] = 0.0
        filled += 1
        z[0] = 1.0
        for k in range(6):
            z[1 + k] = wrench[i, k]
        for k in range(3):
            z[7 + k] = s[i, k]
            z[10 + k] = alpha[i, k]
            z[13 + k] = omega[i, k] * omega[i, k]
        z[16] = omega[i, 0] * omega[i, 1]
        z[17] = omega[i, 0] * omega[i, 2]
        z[18] = omega[i, 1] * omega[i, 2]
        for j in range(19):
            weighted = weights[i] * z[j]
            blocks[last, j] += weighted
            for k in range(j, 19):
                sums[j, k] += weighted * z[k]
    state[0], state[1], state[2] = last, length, filled
