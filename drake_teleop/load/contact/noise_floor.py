"""How large the eliminated wrench is in free motion.

In free motion the contact wrench r = F - F_o - V phi of Eq. (13) is not zero. The standard
deviation of channel c is taken as

    sigma_c^2 = n_c^2 + (J P J^T)_cc + k_c^2 |a|^2 + l_c^2 |alpha|^2,    J = [E V]

with n the noise at rest, P the covariance of the estimated [offsets; phi], and |a|, |alpha| the
accelerations of S without gravity. What grows with them is what gains, alignment in time and
space, bandwidth and elasticity leave of the inertial wrench; n, k and l are fitted to free motion
(`noise_floor_fit`). The residual of a delay or a low-pass is largest when the acceleration
changes, not when it is large; so their squares are held at their peaks, from where they fade.

**Whitening.** r_c / sigma_c is decorrelated by the Cholesky factor of its correlation in free
motion: z, whose six components have unit variance. A low-pass leaves z correlated in time; sums of
z (`statistics`) take its innovations e_k = (z_k - rho z_{k-1}) / sqrt(1 - rho^2), rho the lag-one
correlation of each component. For a sensor with white noise rho = 0 and e = z.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.common.arrays import Array, checked, checked_rows, positive
from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.contact.memory import HELD_A, HELD_ALPHA, LENGTHS
from drake_teleop.load.identification import natural_scale
from drake_teleop.load.regressor import regressor_into

STATISTICS = ("level", "cusum", "glr")
"""Columns of `statistics`, and what `ContactDetector` may decide by."""
MARGIN = 1.25
"""Of a threshold over the largest value of free motion, which is reached about once in as long a
record of more of it. Normal noise reaches a quarter more hundreds of times less often."""


def statistic_index(statistic: str) -> int:
    """The column of a statistic in `statistics`.

    Raises:
        DrakeTeleopError: for a name that is not one of `STATISTICS`.
    """
    if statistic not in STATISTICS:
        raise DrakeTeleopError(
            f"{statistic!r} is not a statistic",
            where="statistic",
            remedy=f"give one of {', '.join(STATISTICS)}",
        )
    return STATISTICS.index(statistic)


@dataclass(frozen=True, eq=False)
class NoiseFloor:
    """How large the eliminated wrench is in free motion (module docstring).

    Attributes:
        noise: (6,) standard deviation n at rest [N, N m].
        covariance: (16, 16) P of [offsets; phi]; finite, see `finite_covariance`.
        per_acceleration: (6, 2) k [N, N m per m/s^2] and l [per rad/s^2].
        correlation: (6, 6) of the wrench over its floor, in free motion.
        rho: (6,) lag-one correlation of the decorrelated components, of the log's rate.
        widths: (8,) w_n of sums of 1, 2, 4 ... `WINDOW` innovations; 1 for white ones.
        fade: factor by which held squares of the acceleration fade each sample, 0 for no hold.
        reached: (3,) the largest of each of the `STATISTICS` in the motion that this was fitted to.
    """

    noise: Array
    covariance: Array
    per_acceleration: Array
    correlation: Array
    rho: Array
    widths: Array = field(default_factory=lambda: np.ones(LENGTHS))
    fade: float = 0.0
    reached: Array = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        positive("noise", self.noise, 6)
        checked("covariance", self.covariance, 16, 16)
        checked("per_acceleration", self.per_acceleration, 6, 2)
        correlation, rho = (
            checked("correlation", self.correlation, 6, 6),
            checked("rho", self.rho, 6),
        )
        if (np.abs(rho) >= 1.0).any():
            raise DrakeTeleopError("is not within -1 to 1", where="rho")
        positive("widths", self.widths, LENGTHS)
        checked("reached", self.reached, 3)
        if not 0.0 <= self.fade < 1.0:
            raise DrakeTeleopError(f"{self.fade} is not within [0, 1)", where="fade")
        if np.linalg.eigvalsh(correlation).min() <= 0.0:
            raise DrakeTeleopError("is not positive definite", where="correlation")

    def threshold(self, statistic: str, margin: float = MARGIN) -> float:
        """What the statistic reached in free motion, times a margin.

        It is worth as much as that motion, which should be as fast as what is judged by it.

        Raises:
            DrakeTeleopError: for another statistic, or if this was not fitted to a motion.
        """
        return margin * float(positive("reached", self.reached, 3)[statistic_index(statistic)])

    @property
    def parameters(self) -> tuple[Array, Array, Array, Array, Array, Array, float]:
        """For the kernels: variances, P, squares of k and l, whitening, rho, widths, fade."""
        root = np.linalg.inv(np.linalg.cholesky(self.correlation))
        variances, growth = self.noise**2, self.per_acceleration**2
        return variances, self.covariance, growth, root, self.rho, self.widths, self.fade

    def sigma(
        self, s: ArrayLike, omega: ArrayLike, alpha: ArrayLike, acceleration: ArrayLike
    ) -> Array:
        """(N, 6) standard deviation of each channel along a free motion, N samples in order.

        Args:
            s, omega, alpha: (N, 3) motion of S, as for `regressor`.
            acceleration: (N, 3) a of So, without gravity, in any axes [m/s^2].
        """
        rows = checked_motion(s=s, omega=omega, alpha=alpha, acceleration=acceleration)
        out = np.empty((len(rows[0]), 6))
        write_sigmas(*rows, *self.parameters[:3], self.fade, out)
        return out


@njit(cache=True)
def _square(x):
    return x[0] * x[0] + x[1] * x[1] + x[2] * x[2]


@njit(cache=True)
def hold_peaks(memory, acceleration, alpha, fade):
    """Updates the largest squares of acceleration and alpha so far, which fade at each sample."""
    memory[HELD_A] = max(_square(acceleration), fade * memory[HELD_A])
    memory[HELD_ALPHA] = max(_square(alpha), fade * memory[HELD_ALPHA])


@njit(cache=True)
def parameter_variance(s, omega, alpha, P, V, out):
    """Writes the diagonal of J P J^T into out (6,); V (6, 10) is working space."""
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
        out[c] = value


@njit(cache=True)
def write_sigmas(s, omega, alpha, acceleration, variances, P, growth, fade, out):
    """Writes the (N, 6) deviations of a record's contact wrench: noise, load, motion."""
    memory, V = np.zeros(3), np.empty((6, 10))
    for k in range(s.shape[0]):
        hold_peaks(memory, acceleration[k], alpha[k], fade)
        parameter_variance(s[k], omega[k], alpha[k], P, V, out[k])
        for c in range(6):
            moving = growth[c, 0] * memory[HELD_A] + growth[c, 1] * memory[HELD_ALPHA]
            out[k, c] = math.sqrt(variances[c] + max(out[k, c], 0.0) + moving)


def checked_motion(**arrays: ArrayLike) -> list[Array]:
    """The arrays by name as (N, 3), `contact` as (N, 6), of one length and finite."""
    sizes = {name: (value, 6 if name == "contact" else 3) for name, value in arrays.items()}
    return checked_rows(**sizes)[1]


def finite_covariance(phi: Array, covariance: Array, *, tared: bool = False) -> Array:
    """The covariance of an identification, with what the record left open made finite.

    Undetermined parameters (infinite variance, or more than is natural) are replaced by what is
    natural for a load of this mass and size (`identification.natural_scale`): the elimination uses
    values of that order for them.

    Args:
        phi: (10,) the load that is eliminated.
        covariance: (16, 16) of [offsets; phi], as of `Identification`.
        tared: the offsets are not of the identification but of the very record.

    Returns:
        (16, 16).
    """
    P, natural = covariance.copy(), natural_scale(phi)
    # Offsets that are not determined have been tared, or the elimination is worth nothing.
    unknown = ~(np.diag(P) <= natural**2)
    P[unknown, :] = P[:, unknown] = 0.0
    P[unknown, unknown] = natural[unknown] ** 2
    if tared:
        P[:6, :] = P[:, :6] = 0.0
    return P
