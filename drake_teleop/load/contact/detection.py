"""Noticing contact in the eliminated wrench, sample by sample, without calling fast motion contact.

**Noise floor.** In free motion the contact wrench r = F - F_o - V phi of Eq. (13) is not zero. The
standard deviation of channel c is taken as

    sigma_c^2 = n_c^2 + (J P J^T)_cc + k_c^2 |a|^2 + l_c^2 |alpha|^2,    J = [E V]

with n the noise at rest, P the covariance of the estimated [offsets; phi], and |a|, |alpha| the
accelerations of S without gravity. What grows with them is what gains, alignment in time and
space, bandwidth and elasticity leave of the inertial wrench; n, k and l are fitted to free motion
(`fit_noise_floor`). The residual of a delay or a low-pass is largest when the acceleration
changes, not when it is large; so their squares are held at their peaks, from where they fade.

**Whitening.** r_c / sigma_c is decorrelated by the Cholesky factor of its correlation in free
motion: z, whose six components have unit variance. A low-pass leaves z correlated in time; the sums
below take its innovations e_k = (z_k - rho z_{k-1}) / sqrt(1 - rho^2), rho the lag-one correlation
of each component. For a sensor with white noise rho = 0 and e = z.

**Statistics**, each compared with a threshold:

    level    |z|, the plain threshold; its square is chi-squared of six degrees of freedom
    cusum    |S|, S = (S + e) max(0, 1 - slack / |S + e|): the cumulative sum for a shift of the
             mean in an unknown direction (Crosier, Technometrics 30, 1988). Shifts below the slack
             [standard deviations] are never noticed, and never add up
    glr      max over n of |e_k + ... + e_{k-n+1}| / (w_n sqrt(n)): the generalised likelihood ratio
             for a shift of unknown size, direction and onset (Lorden 1971; Willsky and Jones 1976),
             the root of twice its logarithm. n are the powers of two up to `WINDOW`, so that a
             sample costs little however long the window; one of them gives at least 2^(-1/4) of
             what the best n would

The w_n are 1 if e is white. What is left of the load's wrench changes as slowly as the motion, more
slowly than rho tells, and adds up over long sums: w_n is by how much such sums exceeded those of
white noise in free motion, or rare ones a rare e, whichever is more. Without it the errors of the
load would set the threshold for all n; with it all n reach about the same in free motion, n = 1 is
the plain threshold, and the others notice weaker contacts at the same rate of false alarms
(benchmarks/contact_detection.py).

**Drift.** Long sums notice half a standard deviation, and in minutes a force sensor drifts as far.
So r may be taken about a mean of its own past, which follows with a time constant of some seconds
while the level is low: a push that is so weak and lasts so long cannot be told from drift.

**Hysteresis.** Contact begins when the chosen statistic reaches the threshold. It ends when for a
while the level has stayed below a share of the level's own threshold, and the sum over that while
is as low; then the sums start anew, because after a long contact they would take as long to come
down.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_teleop._compiled import njit
from drake_teleop.errors import DrakeTeleopError
from drake_teleop.load.arrays import Array, checked, checked_rows
from drake_teleop.load.identification import natural_scale, positive
from drake_teleop.load.regressor import regressor_into

STATISTICS = ("level", "cusum", "glr")
"""Columns of `statistics`, and what `ContactDetector` may decide by."""
SLACK = 1.0
"""Of the cumulative sum [standard deviations]. Half of the shift to be noticed is best in white
noise; this much lets lasting errors of the load pass (benchmarks/contact_detection.py)."""
MARGIN = 1.25
"""Of a threshold over the largest value of free motion, which is reached about once in as long a
record of more of it. Normal noise reaches a quarter more hundreds of times less often."""
WINDOW = 128
"""Longest sum of the likelihood ratio [samples], a power of two."""
LEAVE = 0.7 * 6.2
"""Level below which contact may end; normal noise reaches 6.2 once in a million samples."""

_LENGTHS = WINDOW.bit_length()  # 1, 2, 4 ... WINDOW
# A noise floor below this counts as this [N, N m]: as in `logs.contact`.
_RESOLUTION = np.repeat([1e-3, 1e-4], 3)
_FITS, _HIGHEST_RHO, _NARROWEST, _RARE = 20, 0.999, 0.1, 1e-3

# Memory: samples so far, held |a|^2 and |alpha|^2, flag, samples of quiet; statistics (3); z of the
# sample before; mean of r; S; sum of all e; what it was after each of the last WINDOW samples, in a
# ring.
_COUNT, _HELD_A, _HELD_ALPHA, _FLAG, _QUIET_FOR, _STATISTICS = 0, 1, 2, 3, 4, 5
_Z, _MEAN, _S, _TOTAL, _RING = 8, 14, 20, 26, 32
SIZE = _RING + 6 * WINDOW
"""Of the memory of `detection_update`."""


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
    widths: Array = field(default_factory=lambda: np.ones(_LENGTHS))
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
        positive("widths", self.widths, _LENGTHS)
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
        rows = _rows(s=s, omega=omega, alpha=alpha, acceleration=acceleration)
        out = np.empty((len(rows[0]), 6))
        _sigmas(*rows, *self.parameters[:3], self.fade, out)
        return out


@njit(cache=True)
def _square(x):
    return x[0] * x[0] + x[1] * x[1] + x[2] * x[2]


@njit(cache=True)
def _hold(memory, acceleration, alpha, fade):
    memory[_HELD_A] = max(_square(acceleration), fade * memory[_HELD_A])
    memory[_HELD_ALPHA] = max(_square(alpha), fade * memory[_HELD_ALPHA])


@njit(cache=True)
def _parameter_variance(s, omega, alpha, P, V, out):
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
def _sigmas(s, omega, alpha, acceleration, variances, P, growth, fade, out):
    memory, V = np.zeros(3), np.empty((6, 10))
    for k in range(s.shape[0]):
        _hold(memory, acceleration[k], alpha[k], fade)
        _parameter_variance(s[k], omega[k], alpha[k], P, V, out[k])
        for c in range(6):
            moving = growth[c, 0] * memory[_HELD_A] + growth[c, 1] * memory[_HELD_ALPHA]
            out[k, c] = math.sqrt(variances[c] + max(out[k, c], 0.0) + moving)


@njit(cache=True)
def detection_update(
    memory,
    contact,
    s,
    omega,
    alpha,
    acceleration,
    variances,
    P,
    growth,
    root,
    rho,
    widths,
    fade,
    slack,
    following,
    quiet,
):
    """One sample, in place: memory[5:8] are then the three `STATISTICS`; compiled, checks nothing.

    Args:
        memory: (SIZE,), zeros before the first sample.
        contact: (6,) F_c of Eq. (13).
        s, omega, alpha, acceleration: (3,) as for `NoiseFloor.sigma`.
        variances, P, growth, root, rho, widths, fade: `NoiseFloor.parameters`.
        slack: of the cumulative sum.
        following: share by which the mean of F_c follows each sample while the level is below
            `quiet`; 0 for no mean.
        quiet: see there.
    """
    V, scaled = np.empty((6, 10)), np.empty(6)
    _hold(memory, acceleration, alpha, fade)
    _parameter_variance(s, omega, alpha, P, V, scaled)
    for c in range(6):
        moving = growth[c, 0] * memory[_HELD_A] + growth[c, 1] * memory[_HELD_ALPHA]
        variance = variances[c] + max(scaled[c], 0.0) + moving
        scaled[c] = (contact[c] - memory[_MEAN + c]) / math.sqrt(variance)
    count = int(memory[_COUNT])
    level, length = 0.0, 0.0
    for i in range(6):
        z = 0.0
        for j in range(i + 1):
            z += root[i, j] * scaled[j]
        # Nothing is known before the first sample: it stands by itself.
        e = z if count == 0 else (z - rho[i] * memory[_Z + i]) / math.sqrt(1.0 - rho[i] * rho[i])
        memory[_Z + i] = z
        level += z * z
        memory[_S + i] += e
        length += memory[_S + i] * memory[_S + i]
        memory[_TOTAL + i] += e
    level, length = math.sqrt(level), math.sqrt(length)
    if level < quiet:
        for c in range(6):
            memory[_MEAN + c] += following * (contact[c] - memory[_MEAN + c])
    shrink = max(0.0, 1.0 - slack / length) if length > 0.0 else 0.0
    for i in range(6):
        memory[_S + i] *= shrink
    # Before the first sample of all the sum is zero, as is what the ring holds then.
    here = _RING + 6 * (count % WINDOW)
    best, n = 0.0, 1
    for m in range(_LENGTHS):
        if n > count + 1:
            break
        before = _RING + 6 * ((count + WINDOW - n) % WINDOW)
        total = 0.0
        for i in range(6):
            difference = memory[_TOTAL + i] - memory[before + i]
            total += difference * difference
        best = max(best, total / (n * widths[m] * widths[m]))
        n *= 2
    for i in range(6):
        memory[here + i] = memory[_TOTAL + i]
    memory[_COUNT] += 1.0
    memory[_STATISTICS] = level
    memory[_STATISTICS + 1] = length * shrink
    memory[_STATISTICS + 2] = math.sqrt(best)


@njit(cache=True)
def _last_sum(memory, hold, widths):
    """The likelihood ratio of the longest window within `hold` samples, without a maximum."""
    m = 0
    while 2 << m <= min(hold, WINDOW // 2):
        m += 1
    # The sample before that window; what no sample has filled is zero.
    before = _RING + 6 * ((int(memory[_COUNT]) + WINDOW - 1 - (1 << m)) % WINDOW)
    total = 0.0
    for i in range(6):
        difference = memory[_TOTAL + i] - memory[before + i]
        total += difference * difference
    return math.sqrt(total / (1 << m)) / widths[m]


@njit(cache=True)
def hysteresis_update(memory, statistic, enter, leave, hold, widths):
    """Whether there is contact, after `detection_update`; compiled, checks nothing.

    Args:
        memory: the same, updated.
        statistic: index into `STATISTICS`.
        enter: threshold of that statistic.
        leave: level below which contact may end, and sum of the longest window within `hold`.
        hold: samples below it, after which it has ended.
        widths: of the sums.
    """
    if memory[_FLAG] == 0.0:
        if memory[_STATISTICS + statistic] >= enter:
            memory[_FLAG], memory[_QUIET_FOR] = 1.0, 0.0
    else:
        memory[_QUIET_FOR] = memory[_QUIET_FOR] + 1.0 if memory[_STATISTICS] < leave else 0.0
        if memory[_QUIET_FOR] > hold and _last_sum(memory, hold, widths) < leave:
            # The sums start anew, the noise goes on.
            memory[_FLAG] = 0.0
            memory[_S:] = 0.0
            memory[_COUNT] = 1.0
    return memory[_FLAG] != 0.0


@njit(cache=True)
def flag_update(
    memory,
    contact,
    s,
    omega,
    alpha,
    acceleration,
    parameters,
    slack,
    following,
    statistic,
    enter,
    leave,
    hold,
):
    """One sample, in place; whether there is contact. `ContactDetector.settings` are the last."""
    detection_update(
        memory, contact, s, omega, alpha, acceleration, *parameters, slack, following, leave
    )
    return hysteresis_update(memory, statistic, enter, leave, hold, parameters[5])


@njit(cache=True)
def _statistics(rows, parameters, slack, following, quiet, out):
    contact, s, omega, alpha, acceleration = rows
    memory = np.zeros(SIZE)
    for k in range(contact.shape[0]):
        detection_update(
            memory, contact[k], s[k], omega[k], alpha[k], acceleration[k], *parameters, slack,
            following, quiet,
        )  # fmt: skip
        out[k] = memory[_STATISTICS : _STATISTICS + 3]


@njit(cache=True)
def _flags(memory, rows, settings, out):
    contact, s, omega, alpha, acceleration = rows
    for k in range(contact.shape[0]):
        out[k] = flag_update(
            memory, contact[k], s[k], omega[k], alpha[k], acceleration[k], *settings
        )


def _rows(**arrays: ArrayLike) -> list[Array]:
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


def fit_noise_floor(
    contact: ArrayLike,
    s: ArrayLike,
    omega: ArrayLike,
    alpha: ArrayLike,
    acceleration: ArrayLike,
    covariance: ArrayLike,
    *,
    fade: float = 0.0,
) -> NoiseFloor:
    """The noise floor of a record of free motion, the faster the better.

    The squares of each channel are explained by 1, |a|^2 and |alpha|^2 with coefficients >= 0, on
    top of what the parameters' covariance explains; samples weigh by their own floor (as for normal
    noise, whose squares vary in proportion), so the fit is repeated until that settles.

    Args:
        contact: (N, 6) F_c where nothing is touched, N samples in order [N, N m].
        s, omega, alpha, acceleration: (N, 3) as for `NoiseFloor.sigma`.
        covariance: (16, 16) as of `finite_covariance`.
        fade: of `NoiseFloor`.

    Raises:
        DrakeTeleopError: for other shapes, numbers that are not finite, or fewer than 100 samples.
    """
    from scipy.optimize import nnls

    rows = _rows(contact=contact, s=s, omega=omega, alpha=alpha, acceleration=acceleration)
    if len(rows[0]) < 100:
        raise DrakeTeleopError(
            f"{len(rows[0])} samples say too little about noise",
            where="contact",
            remedy="give 100 samples of free motion or more",
        )
    P = checked("covariance", covariance, 16, 16)
    known, one = np.empty_like(rows[0]), np.zeros((6, 2))
    _sigmas(*rows[1:], np.zeros(6), P, one, fade, known)
    held = np.empty((2, *rows[0].shape))
    for unit, out in zip(np.eye(2), held, strict=True):
        growth = np.tile(unit, (6, 1))
        _sigmas(*rows[1:], np.zeros(6), np.zeros((16, 16)), growth, fade, out)
    found = np.empty((6, 3))
    for c in range(6):
        square, given = rows[0][:, c] ** 2, known[:, c] ** 2
        terms = np.stack([np.ones(len(square)), *held[:, :, c] ** 2], axis=1)
        variance = np.full(len(square), max(float(square.mean()), _RESOLUTION[c] ** 2))
        for _ in range(_FITS):
            found[c] = nnls(terms / variance[:, None], (square - given) / variance)[0]
            found[c, 0] = max(found[c, 0], _RESOLUTION[c] ** 2)
            variance = terms @ found[c] + given
    floor = NoiseFloor(
        np.sqrt(found[:, 0]), P, np.sqrt(found[:, 1:]), np.eye(6), np.zeros(6), fade=fade
    )
    scaled = rows[0] / floor.sigma(*rows[1:])
    deviations = np.sqrt(np.mean(scaled**2, axis=0))
    power = scaled.T @ scaled / len(scaled) / np.maximum(np.outer(deviations, deviations), 1e-12)
    # A channel without noise of its own is still one of six.
    correlation = 0.999 * power + 0.001 * np.eye(6)
    np.fill_diagonal(correlation, 1.0)
    z = scaled @ np.linalg.inv(np.linalg.cholesky(correlation)).T
    energy = np.maximum(np.sum(z**2, axis=0), 1e-12)
    rho = np.clip(np.sum(z[1:] * z[:-1], axis=0) / energy, 0.0, _HIGHEST_RHO)
    e = (z[1:] - rho * z[:-1]) / np.sqrt(1.0 - rho**2)
    sums = np.cumsum(np.vstack([np.zeros(6), e]), axis=0)
    lengths = [min(2**m, len(e)) for m in range(_LENGTHS)]
    squares = [np.sum((sums[n:] - sums[:-n]) ** 2, axis=1) / n for n in lengths]
    power = np.array([square.mean() for square in squares]) / 6.0
    rare = np.array([np.quantile(square, 1.0 - _RARE) for square in squares])
    # Among the few long sums of a short record rare ones may be small by chance, the power is not.
    rare /= max(rare[0], 1e-12)
    widths = np.sqrt(np.maximum(np.maximum(power, rare), _NARROWEST**2))
    floor = replace(floor, correlation=correlation, rho=rho, widths=widths)
    return replace(floor, reached=statistics(floor, *rows).max(axis=0))


def statistics(
    floor: NoiseFloor,
    contact: ArrayLike,
    s: ArrayLike,
    omega: ArrayLike,
    alpha: ArrayLike,
    acceleration: ArrayLike,
    *,
    slack: float = SLACK,
    following: float = 0.0,
) -> Array:
    """The three `STATISTICS` of each sample of a log, without hysteresis.

    Args:
        floor: of the free motion.
        contact: (N, 6) F_c of Eq. (13) [N, N m].
        s, omega, alpha, acceleration: (N, 3) as for `NoiseFloor.sigma`.
        slack: of the cumulative sum [standard deviations].
        following: share by which the mean of F_c follows each sample, see `ContactDetector`.

    Returns:
        (N, 3).

    Raises:
        DrakeTeleopError: for other shapes or numbers that are not finite.
    """
    rows = _rows(contact=contact, s=s, omega=omega, alpha=alpha, acceleration=acceleration)
    out = np.empty((len(rows[0]), 3))
    sums = float(positive("slack", slack)), float(following), LEAVE
    _statistics(tuple(rows), floor.parameters, *sums, out)
    return out


class ContactDetector:
    """Says at each sample whether something is touched (module docstring).

    What it knows is a `memory` (an array), which can be kept outside, as in the state of a Drake
    system: `initial_memory`, `flag_update(memory, ..., *settings)`.

    Args:
        floor: of the free motion.
        threshold: of the chosen statistic; see `free_threshold`.
        statistic: one of `STATISTICS`.
        leave: level below which contact may end.
        hold: samples of quiet after which it has ended.
        slack: of the cumulative sum.
        following: share by which the mean of F_c, which is taken away, follows each sample while
            the level is below `leave`: period over time constant, or 0 for no mean.

    Raises:
        DrakeTeleopError: for another statistic or values that are not positive.
    """

    def __init__(
        self,
        floor: NoiseFloor,
        threshold: float,
        *,
        statistic: str = "cusum",
        leave: float = LEAVE,
        hold: int = 20,
        slack: float = SLACK,
        following: float = 0.0,
    ) -> None:
        column = statistic_index(statistic)
        enter, low = float(positive("threshold", threshold)), float(positive("leave", leave))
        if not 0.0 <= following < 1.0:
            raise DrakeTeleopError(f"{following} is not within [0, 1)", where="following")
        sums = float(positive("slack", slack)), float(following)
        decision = column, enter, low, int(hold)
        #: The last arguments of `flag_update`, the kernel of this class.
        self.settings = (floor.parameters, *sums, *decision)
        self._memory = self.initial_memory()

    @staticmethod
    def initial_memory() -> Array:
        """The memory before the first sample, (n,)."""
        return np.zeros(SIZE)

    def update(
        self,
        contact: ArrayLike,
        s: ArrayLike,
        omega: ArrayLike,
        alpha: ArrayLike,
        acceleration: ArrayLike,
    ) -> bool:
        """Takes one sample, (6,) and (3,) each as for `statistics`; whether there is contact.

        Raises:
            DrakeTeleopError: for other shapes or numbers that are not finite.
        """
        parts = {"s": s, "omega": omega, "alpha": alpha, "acceleration": acceleration}
        motion = [checked(name, value, 3) for name, value in parts.items()]
        wrench = checked("contact", contact, 6)
        return bool(flag_update(self._memory, wrench, *motion, *self.settings))

    def detect(
        self,
        contact: ArrayLike,
        s: ArrayLike,
        omega: ArrayLike,
        alpha: ArrayLike,
        acceleration: ArrayLike,
    ) -> NDArray[np.bool_]:
        """`update` with each of N samples of a log, in a compiled loop; (N,) flags."""
        rows = _rows(contact=contact, s=s, omega=omega, alpha=alpha, acceleration=acceleration)
        out = np.empty(len(rows[0]), np.bool_)
        _flags(self._memory, tuple(rows), self.settings, out)
        return out


# How good a detector is


def free_threshold(free: ArrayLike, share: float = 0.0) -> float:
    """The least threshold that at most this share of the samples of free motion reach.

    Args:
        free: (N,) a statistic in free motion.
        share: of false alarms, 0 to 1.
    """
    ordered = np.sort(np.asarray(free, float))[::-1]
    allowed = math.floor(share * len(ordered))
    # An alarm is a statistic that reaches the threshold, so this is just above the next value.
    return float(np.nextafter(ordered[allowed], np.inf)) if allowed < len(ordered) else -math.inf


def roc(free: ArrayLike, touched: ArrayLike) -> tuple[Array, Array, Array]:
    """The receiver operating characteristic of a statistic.

    Args:
        free, touched: (N,), (M,) the statistic in free motion and in contact.

    Returns:
        false_alarms, detections: (K,) shares that reach each threshold, both from 0 to 1.
        thresholds: (K,) descending, the first inf.

    Raises:
        DrakeTeleopError: if either is empty or not finite.
    """
    a, b = _samples("free", free), _samples("touched", touched)
    thresholds = np.concatenate([[np.inf], np.unique(np.concatenate([a, b]))[::-1]])
    shares = [1.0 - np.searchsorted(x, thresholds, side="left") / len(x) for x in (a, b)]
    return shares[0], shares[1], thresholds


def auc(free: ArrayLike, touched: ArrayLike) -> float:
    """Area under `roc`: how often a sample in contact exceeds one in free motion, ties half."""
    false_alarms, detections, _ = roc(free, touched)
    return float(np.trapezoid(detections, false_alarms))


def _samples(name: str, value: ArrayLike) -> Array:
    array = np.sort(np.asarray(value, float).ravel())
    if len(array) == 0 or not np.isfinite(array).all():
        raise DrakeTeleopError("holds no samples, or some that are not finite", where=name)
    return array


def detection_delays(
    alarms: ArrayLike, starts: ArrayLike, stops: ArrayLike, period: float = 1.0
) -> Array:
    """How long after the beginning of each contact the alarm is first on.

    An alarm that is on at the beginning already is a false one that happens to last: it counts with
    delay 0 here, and as false where false alarms are counted.

    Args:
        alarms: (N,) flags.
        starts, stops: (K,) first sample of each contact, and the first after it.
        period: between samples [s].

    Returns:
        (K,) delays [s]; NaN for contacts that were missed.
    """
    on = np.asarray(alarms, bool)
    delays = np.full(len(np.atleast_1d(starts)), np.nan)
    for k, (a, b) in enumerate(zip(np.atleast_1d(starts), np.atleast_1d(stops), strict=True)):
        inside = np.flatnonzero(on[a:b])
        if len(inside):
            delays[k] = inside[0] * period
    return delays


# What a contact says about itself


def wrench_axis(wrench: ArrayLike) -> tuple[Array, Array, Array]:
    """The central axis of a wrench: f along it, and a moment parallel to f (Poinsot).

    With the contact wrench of Eq. (13), which is what the sensor exerts beyond the load's motion,
    the environment pushes the tool with -f along the same line.

    Args:
        wrench: (..., 6) about So in S [N, N m].

    Returns:
        direction: (..., 3) f / |f|; NaN where f = 0, as for the others.
        point: (..., 3) of the axis nearest to So [m].
        pitch: (...) f . tau / |f|^2 [m]; of a pure force 0, so it says how much of a couple is in
            the contact, or of the load's error.
    """
    w = checked("wrench", wrench, 6, leading=True)
    f, tau = w[..., :3], w[..., 3:]
    square = np.sum(f * f, axis=-1)
    square = np.where(square > 0.0, square, np.nan)
    direction = f / np.sqrt(square)[..., None]
    return direction, np.cross(f, tau) / square[..., None], np.sum(f * tau, axis=-1) / square


def point_on_tool(wrench: ArrayLike, origin: ArrayLike, axis: ArrayLike) -> tuple[Array, Array]:
    """Where along the tool a pure force must act to explain a wrench best.

    Least squares of the moments: the x in tau = (origin + x u) x f + rest with the least |rest|.

    Args:
        wrench: (..., 6) about So in S [N, N m].
        origin: (3,) a point of the tool's axis in S [m].
        axis: (3,) its direction u in S, of any length.

    Returns:
        x: (...) distance from `origin` along the axis [m]; NaN for a force along the axis, which
            acts at all of its points alike.
        rest: (...) |moment| that no point of the axis explains [N m].

    Raises:
        DrakeTeleopError: for other shapes, numbers that are not finite, or an axis of length 0.
    """
    w = checked("wrench", wrench, 6, leading=True)
    q, u = checked("origin", origin, 3), checked("axis", axis, 3)
    if not u.any():
        raise DrakeTeleopError("has no length", where="axis")
    f = w[..., :3]
    moment = w[..., 3:] - np.cross(q, f)
    lever = np.cross(u / np.linalg.norm(u), f)
    square = np.sum(lever * lever, axis=-1)
    known = square > 1e-12 * np.sum(f * f, axis=-1)
    x = np.where(known, np.sum(lever * moment, axis=-1) / np.where(known, square, 1.0), np.nan)
    rest = moment - np.where(known, x, 0.0)[..., None] * lever
    return x, np.linalg.norm(rest, axis=-1)
