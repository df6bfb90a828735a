"""Criteria of an excitation: condition numbers of the regressor V, A- and D-optimality (T45).

=========== ====================================================================================
kappa_w10   V, rows divided by noise, columns times 1, L, L^2 (`CriterionScales`). Default.
kappa10     V (10 columns) in SI units.
kappa16     [1 V] (16 columns) in SI units.
A16         rms of predicted over acceptable errors of phi, estimated with the offsets.
D16         geometric mean of the error ellipsoid's 16 semi-axes over acceptable errors.
=========== ====================================================================================
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.load.regressor import regressor

CRITERIA = ("kappa_w10", "kappa10", "kappa16", "A16", "D16")
ASSUMED_SENSOR_SAMPLE_RATE_HZ = 1000.0  #: sample rate of A16 and D16 [Hz]

# Acceptable errors: relative mass and mean moment of inertia, centre of mass [m], offsets [N, N m].
_MAX_RELATIVE_MASS_ERROR, _MAX_RELATIVE_INERTIA_ERROR = 0.01, 0.1
_MAX_COM_ERROR_M = 1e-3
_MAX_OFFSET_ERRORS_N_NM = (0.1, 0.005)
# Smallest eigenvalue of an excited parameter, over the largest.
_MIN_EIGENVALUE_RATIO = 1e-13


class CriterionScales(NamedTuple):
    """Noise, length and load that make the criteria dimensionless.

    Attributes:
        wrench_noise: standard deviations (sigma_f [N], sigma_tau [N m]), white at 1 kHz.
        length: characteristic length L [m] of kappa_w10.
        nominal_phi: (10,) nominal load about the origin of S, for A16 and D16.
    """

    wrench_noise: tuple[float, float]
    length: float
    nominal_phi: Array


def limited_gyration_radius(phi: Array) -> float:
    """Return the load's radius of gyration about So [m], limited to 0.1 m."""
    return float(min(0.1, np.sqrt((phi[4] + phi[7] + phi[9]) / (2 * phi[0]))))


class Criterion:
    """Criterion named in `CRITERIA`: exact value and smooth approximation; smaller is better."""

    def __init__(self, name: str, scales: CriterionScales) -> None:
        if name not in CRITERIA:
            what = f"there is no criterion '{name}'"
            remedy = f"choose one of {', '.join(CRITERIA)}"
            raise DrakeTeleopError(what, where="criterion", remedy=remedy)
        self.name = name
        self.with_offsets = name.endswith("16")
        whitened = name in ("kappa_w10", "A16", "D16")
        sigma = scales.wrench_noise if whitened else (1.0, 1.0)
        self._rows = np.repeat(1 / np.array(sigma), 3)
        columns = np.ones(16 if self.with_offsets else 10)
        if name == "kappa_w10":
            columns = np.array([1.0] + 3 * [scales.length] + 6 * [scales.length**2])
        elif whitened:
            columns = _acceptable_offset_and_phi_errors(scales.nominal_phi)
        self._columns = columns

    def rows_and_information(self, s: Array, omega: Array, alpha: Array) -> tuple[Array, Array]:
        """Return scaled regressor rows (6 T, columns) and mean information of one sample."""
        V = regressor(s, omega, alpha)
        if self.with_offsets:
            V = np.concatenate([np.broadcast_to(np.eye(6), (len(V), 6, 6)), V], axis=2)
        rows = (V * self._rows[:, np.newaxis] * self._columns).reshape(-1, len(self._columns))
        return rows, rows.T @ rows / len(V)

    def value(self, s: Array, omega: Array, alpha: Array, duration: float) -> float:
        """Return the exact criterion of motion samples over `duration` [s]; inf if singular."""
        _, gram = self.rows_and_information(s, omega, alpha)
        eigenvalues, vectors = np.linalg.eigh(gram)
        if eigenvalues[0] <= _MIN_EIGENVALUE_RATIO * eigenvalues[-1]:
            return float("inf")
        if self.name.startswith("kappa"):
            return float(np.sqrt(eigenvalues[-1] / eigenvalues[0]))
        log_value, _ = self._log_criterion_and_gradient(eigenvalues, vectors, 0.0)
        return float(np.exp(log_value) / np.sqrt(ASSUMED_SENSOR_SAMPLE_RATE_HZ * duration))

    def smooth_log_and_gradient(
        self, s: Array, omega: Array, alpha: Array, sharpness: float
    ) -> tuple[float, Array]:
        """Return log criterion, without the constant factor of duration, and its gradient by V.

        A larger `sharpness` brings smooth maxima closer to the exact ones.
        """
        rows, gram = self.rows_and_information(s, omega, alpha)
        eigenvalues, vectors = np.linalg.eigh(gram)
        eigenvalues = np.maximum(eigenvalues, _MIN_EIGENVALUE_RATIO * eigenvalues[-1])
        value, weights = self._log_criterion_and_gradient(eigenvalues, vectors, sharpness)
        g_gram = weights if self.name == "A16" else (vectors * weights) @ vectors.T
        g_rows = (2 / len(s)) * (rows @ g_gram).reshape(len(s), 6, -1)
        g_V = g_rows * self._rows[:, np.newaxis] * self._columns
        return value, np.ascontiguousarray(g_V[:, :, -10:])

    def _log_criterion_and_gradient(
        self, eigenvalues: Array, vectors: Array, sharpness: float
    ) -> tuple[float, Array]:
        if self.name == "D16":
            n = len(eigenvalues)
            return float(-0.5 * np.log(eigenvalues).mean()), -0.5 / (n * eigenvalues)
        if self.name == "A16":
            inverse = (vectors / eigenvalues) @ vectors.T
            block = inverse[:, 6:]
            trace = float(np.trace(block[6:]))
            return 0.5 * np.log(trace / 10), -(block @ block.T) / (2 * trace)
        logs = 0.5 * np.log(eigenvalues)
        top, top_weights = _smooth_maximum_and_weights(logs, sharpness)
        bottom, bottom_weights = _smooth_maximum_and_weights(-logs, sharpness)
        return top + bottom, 0.5 * (top_weights - bottom_weights) / eigenvalues


@njit(cache=True)
def write_gradients_by_motion(omega, g_V, g_s, g_omega, g_alpha):
    """Write dJ/ds, dJ/domega, dJ/dalpha (3,) into g_s, g_omega, g_alpha, from g_V = dJ/dV."""
    g_s[0] = g_V[0, 0] + g_V[4, 3] - g_V[5, 2]
    g_s[1] = g_V[1, 0] - g_V[3, 3] + g_V[5, 1]
    g_s[2] = g_V[2, 0] + g_V[3, 2] - g_V[4, 1]
    g_alpha[0] = -g_V[1, 3] + g_V[2, 2] + g_V[3, 4] + g_V[4, 5] + g_V[5, 6]
    g_alpha[1] = g_V[0, 3] - g_V[2, 1] + g_V[3, 5] + g_V[4, 7] + g_V[5, 8]
    g_alpha[2] = -g_V[0, 2] + g_V[1, 1] + g_V[3, 6] + g_V[4, 8] + g_V[5, 9]
    # Derivatives by the products omega_i omega_j.
    xx = -g_V[1, 2] - g_V[2, 3] - g_V[4, 6] + g_V[5, 5]
    yy = -g_V[0, 1] - g_V[2, 3] + g_V[3, 8] - g_V[5, 5]
    zz = -g_V[0, 1] - g_V[1, 2] - g_V[3, 8] + g_V[4, 6]
    xy = g_V[0, 2] + g_V[1, 1] + g_V[3, 6] - g_V[4, 8] - g_V[5, 4] + g_V[5, 7]
    xz = g_V[0, 3] + g_V[2, 1] - g_V[3, 5] + g_V[4, 4] - g_V[4, 9] + g_V[5, 8]
    yz = g_V[1, 3] + g_V[2, 2] - g_V[3, 7] + g_V[3, 9] + g_V[4, 5] - g_V[5, 6]
    x, y, z = omega[0], omega[1], omega[2]
    g_omega[0] = 2 * x * xx + y * xy + z * xz
    g_omega[1] = 2 * y * yy + x * xy + z * yz
    g_omega[2] = 2 * z * zz + x * xz + y * yz


def _acceptable_offset_and_phi_errors(phi: Array) -> Array:
    inertia = _MAX_RELATIVE_INERTIA_ERROR * (phi[4] + phi[7] + phi[9]) / 3
    mass, moment = _MAX_RELATIVE_MASS_ERROR * phi[0], _MAX_COM_ERROR_M * phi[0]
    return np.repeat([*_MAX_OFFSET_ERRORS_N_NM, mass, moment, inertia], [3, 3, 1, 3, 6])


def _smooth_maximum_and_weights(values: Array, sharpness: float) -> tuple[float, Array]:
    top = values.max()
    weights = np.exp(sharpness * (values - top))
    total = weights.sum()
    return float(top + np.log(total) / sharpness), weights / total
