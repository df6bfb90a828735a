"""Noise floor: standard deviation sigma of the contact wrench in free motion, per channel c.

    sigma_c^2 = n_c^2 + (J P J^T)_cc + k_c^2 |a|^2 + l_c^2 |alpha|^2,    J = [E V]

n is the noise at rest, J the regressor of [offsets; phi], P their covariance; a and alpha are
accelerations of S, k and l fitted factors.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, broadcast_to_rows, finite_array, positive_array
from drake_teleop.common.vectors import dot
from drake_teleop.load.identification import natural_scales
from drake_teleop.load.regressor import regressor_into

MAX_GLR_WINDOW_SAMPLES = 128
"""Longest window of the likelihood ratio (GLR) [samples], a power of two."""
NUM_GLR_WINDOWS = MAX_GLR_WINDOW_SAMPLES.bit_length()
"""Number of windows: 1, 2, 4 ... MAX_GLR_WINDOW_SAMPLES samples."""

STATISTIC_NAMES = ("level", "cusum", "glr")
"""Names of the statistics: columns of `statistics_of_log`, and choices of `ContactDetector`."""
THRESHOLD_MARGIN = 1.25
"""Ratio of threshold to the largest value in free motion. Normal noise exceeds it hundreds of times
less often than that value, which is reached about once in a record of the same length."""


def statistic_index(statistic: str) -> int:
    if statistic not in STATISTIC_NAMES:
        what = f"{statistic!r} is not a statistic"
        remedy = f"give one of {', '.join(STATISTIC_NAMES)}"
        raise DrakeTeleopError(what, where="statistic", remedy=remedy)
    return STATISTIC_NAMES.index(statistic)


class DetectorSamples(NamedTuple):
    """Contact wrench and motion of N consecutive samples.

    Attributes:
        contact: (N, 6) contact wrench F_c, Eq. (13) [N, N m].
        s, omega, alpha: (N, 3) specific force, angular velocity and acceleration of S, in S [SI].
        acceleration: (N, 3) acceleration of So without gravity, in any axes [m/s^2].
    """

    contact: Array
    s: Array
    omega: Array
    alpha: Array
    acceleration: Array

    def select_rows(self, rows: slice | NDArray[np.bool_]) -> DetectorSamples:
        return DetectorSamples(*(x[rows] for x in self))


@dataclass(frozen=True, eq=False)
class NoiseFloor:
    """Noise of the contact wrench in free motion.

    Attributes:
        noise: (6,) noise n at rest [N, N m].
        covariance: (16, 16) finite covariance P of [offsets; phi].
        per_acceleration: (6, 2) factors k [N, N m per m/s^2] and l [per rad/s^2].
        correlation: (6, 6) correlation between channels.
        rho: (6,) correlation of successive samples of the whitened wrench.
        sum_widths: (8,) std of sums of n = 1, 2 ... 128 innovations over sqrt(n); 1 if white.
        fade: factor per sample on held maxima of |a|^2 and |alpha|^2; 0: no hold.
        free_maxima: (3,) largest value of each statistic in the fitted motion.
    """

    noise: Array
    covariance: Array
    per_acceleration: Array
    correlation: Array
    rho: Array
    sum_widths: Array = field(default_factory=lambda: np.ones(NUM_GLR_WINDOWS))
    fade: float = 0.0
    free_maxima: Array = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        positive_array("noise", self.noise, 6)
        finite_array("covariance", self.covariance, 16, 16)
        finite_array("per_acceleration", self.per_acceleration, 6, 2)
        correlation = finite_array("correlation", self.correlation, 6, 6)
        rho = finite_array("rho", self.rho, 6)
        positive_array("sum_widths", self.sum_widths, NUM_GLR_WINDOWS)
        finite_array("free_maxima", self.free_maxima, 3)
        indefinite = np.linalg.eigvalsh(correlation).min() <= 0.0
        worst = rho[np.abs(rho).argmax()]
        for is_wrong, where, what in (
            (abs(worst) >= 1.0, "rho", f"{worst:g} is not between -1 and 1"),
            (not 0.0 <= self.fade < 1.0, "fade", f"{self.fade} is outside the range 0 <= fade < 1"),
            (indefinite, "correlation", "the matrix is not positive definite"),
        ):
            if is_wrong:
                raise DrakeTeleopError(what, where=where, remedy="use fit_noise_floor")

    def threshold(self, statistic: str, margin: float = THRESHOLD_MARGIN) -> float:
        """Return a contact threshold: `margin` times the largest statistic in free motion."""
        maxima = positive_array("free_maxima", self.free_maxima, 3)
        return margin * float(maxima[statistic_index(statistic)])

    @property
    def compiled_parameters(self) -> tuple[Array, Array, Array, Array, Array, Array, float]:
        """Arguments of compiled functions: n^2, P, [k^2 l^2], whitening, rho, widths, fade."""
        root = np.linalg.inv(np.linalg.cholesky(self.correlation))
        variances, factors = self.noise**2, self.per_acceleration**2
        return variances, self.covariance, factors, root, self.rho, self.sum_widths, self.fade

    def noise_std_along(self, *motion: ArrayLike) -> Array:
        """Return sigma (N, 6) [N, N m] for a motion: s, omega, alpha, acceleration (N, 3)."""
        rows = validate_detector_samples(*motion)
        out = np.empty((len(rows[0]), 6))
        noise_std_into(*rows, *self.compiled_parameters[:3], self.fade, out)
        return out


@njit(cache=True)
def noise_variances_into(peaks, s, omega, alpha, acceleration, variances, P, factors, fade, V, out):
    """Write the noise variances (6,) of a sample's contact wrench to `out`; `V` (6, 10): scratch.

    `peaks` (2,), held |acceleration|^2 and |alpha|^2, decay by `fade`. `variances` (6,): n^2, `P`
    (16, 16): covariance of [offsets; phi], `factors` (6, 2): k^2, l^2.
    """
    peaks[0] = max(dot(acceleration, acceleration), fade * peaks[0])
    peaks[1] = max(dot(alpha, alpha), fade * peaks[1])
    regressor_into(s, omega, alpha, V)
    for c in range(6):
        value = P[c, c]
        for i in range(10):
            if V[c, i] == 0.0:
                continue
            row = 2.0 * P[c, 6 + i]
            for j in range(10):
                row += V[c, j] * P[6 + i, 6 + j]
            value += V[c, i] * row
        moving = factors[c, 0] * peaks[0] + factors[c, 1] * peaks[1]
        out[c] = variances[c] + max(value, 0.0) + moving


@njit(cache=True)
def noise_std_into(s, omega, alpha, acceleration, variances, P, factors, fade, out):
    """Write the noise sigma (N, 6) of the contact wrench of N samples to `out`."""
    peaks, V, noise = np.zeros(2), np.empty((6, 10)), (variances, P, factors, fade)
    for k in range(s.shape[0]):
        noise_variances_into(peaks, s[k], omega[k], alpha[k], acceleration[k], *noise, V, out[k])
        out[k] = np.sqrt(out[k])


def validate_detector_samples(*arrays: ArrayLike) -> list[Array]:
    named = zip(DetectorSamples._fields[-len(arrays) :], arrays, strict=True)
    return broadcast_to_rows(**{name: (x, 6 if name == "contact" else 3) for name, x in named})[1]


def limit_covariance_to_scales(phi: Array, covariance: Array, *, tared: bool = False) -> Array:
    """Return the covariance (16, 16) with standard deviations of at most `natural_scales`.

    `tared`: the offsets are from the same record; their variance is 0.
    """
    P, natural = covariance.copy(), natural_scales(phi)
    # Undetermined offsets must have been tared; otherwise the elimination is useless.
    undetermined = ~(np.diag(P) <= natural**2)
    P[undetermined, :] = P[:, undetermined] = 0.0
    P[undetermined, undetermined] = natural[undetermined] ** 2
    if tared:
        P[:6, :] = P[:, :6] = 0.0
    return P
