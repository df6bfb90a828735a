"""When was something touched? One detector, which `detect` and `eliminate` share.

It is that of `drake_teleop.load.contact`: a statistic of the contact wrench over a noise floor that
rises with the motion, and a threshold a quarter above what free motion reaches, but not below what
normal noise reaches once in a million samples. Where there is no log of free motion, the record
itself has to say what free motion is, though there are contacts in it. That is found in rounds:

1. Quiet is at first what lies within four standard deviations of each channel (`noise_floor`), the
   same for all motions; contact in less than half of the record does not raise those.
2. The noise floor is fitted to what is quiet, and quiet is then the half of the blocks of 0.1 s
   with the least mean square over that floor: four times (Rousseeuw and Van Driessen, Technometrics
   41, 1999, call these concentration steps). In less than 2 s of record, and if the half has fewer
   than 100 samples, this is left out.
3. Noise floor and statistic are fitted to what is quiet. What they would reach in as long a record
   without contact is extrapolated: the largest values of the quiet blocks are taken to have a
   Fréchet distribution (the logarithm a Gumbel one) through their lower quartile and their median.
   The second time and the third it is not more than the quiet part has reached.
4. Quiet is then what is no contact a quarter above that, and further than a block from all that is.
   Back to 3, three times in all. The threshold is 1.6 times what is reached: what most of a record
   says of the rest of it is less certain than what free motion says of the next.

This holds as long as less than 40 % of the record are contact. In simulated records of 20 s with
one, five or twenty contacts, steps or slow rises, in up to 40 % of the time, the threshold on the
level was 8.0 to 8.9, as without any; no contact was missed and none was reported that was not
there. In half of the record and more, contact passes for the noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_teleop.load.contact.detection import RARE, ContactDetector, statistics, wrench_axis
from drake_teleop.load.contact.noise_floor import MARGIN, NoiseFloor, statistic_index
from drake_teleop.load.contact.noise_floor_fit import fit_noise_floor
from drake_teleop.logs.read.alignment import low_pass
from drake_teleop.logs.read.canonical import Log

FEWEST = 100
"""Samples that a noise floor can be fitted to."""

# A noise floor below this counts as this [N, N m]: residuals of a simulation without noise are
# rounding, and so are contacts of their size.
_RESOLUTION = np.repeat([1e-3, 1e-4], 3)
# Where the orientation is not known, gravity is what is slower than this in the specific force.
_GRAVITY_HZ = 0.5
_QUIET = 4.0
_PERIOD_HZ = 30.0  # what is not low-passed swings as if it were
_BLOCK_S, _BLOCKS = 0.1, 20
_STEPS, _ROUNDS = 4, 3
_OWN_MARGIN, _LEAST = 1.6, 5.0  # 1.25 times which is about `RARE`
_MOST = 30_000  # samples of a long record that a floor is fitted to, in spans of ten blocks
_LOWER, _MIDDLE = (-math.log(-math.log(share)) for share in (0.25, 0.5))
_MUCH, _LOUD = 0.4, 10.0
# Share of a record in contact, above which offsets that differ are no drift of the sensor alone.
_SOME = 0.2


class Samples(NamedTuple):
    """What the detector takes, N samples each: F_c (N, 6); s, omega, alpha and a, (N, 3)."""

    contact: NDArray[np.float64]
    s: NDArray[np.float64]
    omega: NDArray[np.float64]
    alpha: NDArray[np.float64]
    acceleration: NDArray[np.float64]

    def at(self, rows: slice | NDArray[np.bool_]) -> Samples:
        """Some of them."""
        return Samples(*(x[rows] for x in self))


@dataclass(frozen=True)
class Detection:
    """Where a log is in contact, N samples.

    Args:
        floor: of the free motion.
        statistic: one of `drake_teleop.load.contact.noise_floor.STATISTICS`.
        threshold: of it.
        statistics: (N, 3); 0 at the ends, which are not judged.
        touched: (N,) contact, with hysteresis.
        free_s: length of the free motion [s].
        force_threshold: a quarter above the largest |F_c| of the free motion [N].
        notes: why not to trust it, in words.
    """

    floor: NoiseFloor
    statistic: str
    threshold: float
    statistics: NDArray[np.float64]
    touched: NDArray[np.bool_]
    free_s: float
    force_threshold: float
    notes: tuple[str, ...] = ()

    @property
    def above(self) -> NDArray[np.bool_]:
        """(N,) where the statistic reaches the threshold."""
        return self.statistics[:, statistic_index(self.statistic)] >= self.threshold


def samples_of(log: Log, contact: NDArray[np.float64], cutoff_hz: float | None) -> Samples:
    """What the detector takes of a log and its (N, 6) low-passed contact wrench."""
    s, omega, alpha = (low_pass(x, log.dt, cutoff_hz) for x in log.motion)
    if log.gravity is not None:
        gravity = low_pass(log.gravity, log.dt, cutoff_hz)
    else:
        gravity = -low_pass(log.specific_force, log.dt, _GRAVITY_HZ)
    return Samples(contact, s, omega, alpha, s + gravity)


def detect_contact(
    rows: Samples,
    dt: float,
    cutoff_hz: float | None,
    covariance: NDArray[np.float64],
    usual: NDArray[np.float64],
    *,
    edge: NDArray[np.bool_] | None = None,
    free: tuple[Samples, float] | None = None,
    statistic: str = "level",
) -> Detection | None:
    """Finds contact.

    Without a log of free motion, what reaches the threshold for less than half a period of the low-
    pass, and by less than a quarter, is no contact: the threshold is less certain than that.

    A contact lasts from where the statistic reaches the threshold to the last sample that is
    followed by a period of the low-pass in which it is low, and may swing. What rises slowly has
    its start where it is noticed, not where it left the floor; what rises at once has it up to a
    period early, because the low-pass looks ahead. A period at both ends, where the low-pass passes
    the noise as it is, is not judged.

    Args:
        rows: of the whole log, low-passed.
        dt: between them [s].
        cutoff_hz: of the low-pass; None for none.
        covariance: (16, 16) of [offsets; phi], as of `finite_covariance`.
        usual: (6,) what the identification of the load left of the wrench, rms [N, N m].
        edge: (N,) samples that are not judged either; None for none.
        free: the same of a log of free motion, and its dt; None takes free motion from `rows`, see
            the top of this module.
        statistic: one of `STATISTICS`.

    Returns:
        None if there are fewer than `FEWEST` samples to judge.

    Raises:
        DrakeTeleopError: for another statistic, or too little free motion.
    """
    period = 1.0 / (cutoff_hz or _PERIOD_HZ)
    inner = _judged(rows, dt, period, edge)
    judged = rows.at(inner)
    if len(judged.contact) < FEWEST:
        return None
    hold = round(period / dt)
    # What was held fades by e within a period.
    if free is None:
        fade = math.exp(-dt / period)
        floor, threshold, train = _own_floor(judged, dt, hold, fade, covariance, statistic)
    else:
        train = free[0].at(_judged(free[0], free[1], period))
        floor = fit_noise_floor(*train, covariance, fade=math.exp(-free[1] / period))
        threshold = max(RARE, floor.threshold(statistic))
    values, touched = np.zeros((len(rows.contact), 3)), np.zeros(len(rows.contact), bool)
    detector = ContactDetector(floor, threshold, statistic=statistic, hold=hold)
    values[inner] = statistics(floor, *judged)
    touched[inner] = _without_hold(detector.detect(*judged), hold)
    if free is None:
        _remove_marginal(touched, values[:, statistic_index(statistic)], threshold, hold)
    return Detection(
        floor=floor,
        statistic=statistic,
        threshold=threshold,
        statistics=values,
        touched=touched,
        free_s=len(train.contact) * (dt if free is None else free[1]),
        force_threshold=MARGIN * float(np.linalg.norm(train.contact[:, :3], axis=1).max()),
        notes=() if free is not None else _doubts(floor, touched, usual),
    )


def _judged(
    rows: Samples, dt: float, period: float, edge: NDArray[np.bool_] | None = None
) -> slice | NDArray[np.bool_]:
    """The samples that are judged; a slice if they are in one piece, which needs no copies."""
    ends, judged = max(1, round(period / dt)), np.zeros(len(rows.contact), bool)
    judged[ends : len(judged) - ends] = True
    if edge is not None:
        judged &= ~edge
    at = np.flatnonzero(judged)
    one_piece = len(at) > 0 and len(at) == at[-1] + 1 - at[0]
    return slice(int(at[0]), int(at[-1]) + 1) if one_piece else judged


def _own_floor(
    rows: Samples,
    dt: float,
    hold: int,
    fade: float,
    covariance: NDArray[np.float64],
    statistic: str,
) -> tuple[NoiseFloor, float, Samples]:
    """Floor, threshold and free motion of a record with contacts in it (module docstring)."""
    from scipy.ndimage import maximum_filter1d

    n = len(rows.contact)
    block = max(hold, round(_BLOCK_S / dt))
    some = np.arange(n) // (10 * block) % math.ceil(n / _MOST) == 0
    quiet = _quiet(rows.contact, noise_floor(rows.contact))
    if (quiet & some).sum() < FEWEST:
        quiet = some = np.ones(n, bool)
    for _ in range(_STEPS if n >= _BLOCKS * block else 0):
        floor = fit_noise_floor(*rows.at(quiet & some), covariance, fade=fade)
        half = _quieter_half(statistics(floor, *rows)[:, 0], block)
        if (half & some).sum() < FEWEST:
            break
        quiet = half
    for attempt in range(_ROUNDS):
        train = rows.at(quiet & some)
        floor = fit_noise_floor(*train, covariance, fade=fade)
        values = statistics(floor, *train)[:, statistic_index(statistic)]
        reached = _extrapolated(values, block, n)
        if attempt > 0:
            reached = min(reached, float(values.max()))
        reached = max(_LEAST, reached)
        detector = ContactDetector(floor, MARGIN * reached, statistic=statistic, hold=hold)
        far = maximum_filter1d(detector.detect(*rows), 2 * block + 1) == 0
        if (some & far).sum() < FEWEST or attempt == _ROUNDS - 1:
            break
        quiet = far
    return floor, _OWN_MARGIN * reached, rows.at(quiet)


def _quieter_half(level: NDArray[np.float64], block: int) -> NDArray[np.bool_]:
    """(N,) the blocks whose mean square of the level is below the median of the blocks."""
    of = np.minimum(np.arange(len(level)) // block, len(level) // block - 1)
    power = np.bincount(of, level**2) / np.bincount(of)
    return np.asarray((power <= np.median(power))[of])


def _extrapolated(values: NDArray[np.float64], block: int, samples: int) -> float:
    """What blocks as those of the quieter half would reach in so many samples."""
    block = min(block, len(values) // 4)
    count = len(values) // block
    largest = values[: count * block].reshape(count, block).max(axis=1)
    lower, middle = np.log(np.quantile(np.maximum(largest, 1.0), [0.25, 0.5]))
    scale = (middle - lower) / (_MIDDLE - _LOWER)
    rare = -math.log(-math.log(1.0 - 1.0 / max(3, samples // block)))
    return math.exp(lower + scale * (rare - _LOWER))


def _without_hold(touched: NDArray[np.bool_], hold: int) -> NDArray[np.bool_]:
    """Contacts without the quiet that ended them; the last of the record may not have ended."""
    for _, stop in _spans(touched):
        if stop < len(touched):
            touched[stop - hold : stop] = False
    return touched


def _remove_marginal(
    touched: NDArray[np.bool_], values: NDArray[np.float64], threshold: float, hold: int
) -> None:
    """Clear contacts shorter than half a period whose statistic hardly exceeds the threshold."""
    for start, stop in _spans(touched):
        if 2 * (stop - start) < hold and values[start:stop].max() < MARGIN * threshold:
            touched[start:stop] = False


def _spans(touched: NDArray[np.bool_]) -> NDArray[np.intp]:
    """(K, 2) first index of each contact, and the one after its last."""
    return np.flatnonzero(np.diff(np.concatenate([[False], touched, [False]]))).reshape(-1, 2)


def _doubts(
    floor: NoiseFloor, touched: NDArray[np.bool_], usual: NDArray[np.float64]
) -> tuple[str, ...]:
    remedy = "; give a log of free motion with --free"
    if touched.mean() > _MUCH:
        share = f"{100 * touched.mean():.0f} % of the record are taken for contact"
        return (f"{share}: what free motion is cannot be told from so little of it{remedy}",)
    louder = float((floor.noise / np.maximum(usual, _RESOLUTION)).max())
    if louder > _LOUD:
        return (
            f"what is left of the wrench at rest is {louder:.0f} times what the identification of"
            " the load left: most of the record may be in contact, and that is not found"
            f"{remedy}",
        )
    return ()


def shifted(shift: NDArray[np.float64], found: Detection) -> tuple[str, ...]:
    """A note if offsets and contact are as of a record that is mostly contact.

    Args:
        shift: (6,) offsets of the record less those of the free motion [N, N m].
        found: in the record.
    """
    force = float(np.linalg.norm(shift[:3]))
    if force <= found.force_threshold or found.touched.mean() < _SOME:
        return ()
    return (
        f"the constant that most of the record agrees on is {force:.2g} N from that of the free"
        " motion: either the sensor drifted, or most of the record is contact, which is then taken"
        " for an offset and the rest for contact",
    )


def robust_offsets(residual: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """The constant that most samples agree on, untouched by contact in the rest of them.

    Starts from the middle of the shortest interval that holds half of the samples in each channel
    (Rousseeuw's shorth), then takes the mean of all samples within 4 robust standard deviations of
    it in every channel, until that no longer changes.

    Args:
        residual: (N, 6) wrench minus non-contact wrench.

    Returns:
        offsets (6,), and the share of the samples that they are the mean of.
    """
    ordered = np.sort(residual, axis=0)
    half = len(ordered) // 2
    widths = ordered[half:] - ordered[: len(ordered) - half]
    start, channels = np.argmin(widths, axis=0), np.arange(6)
    offsets = (ordered[start, channels] + ordered[start + half, channels]) / 2
    agrees = np.zeros(len(residual), bool)
    for _ in range(50):
        distance = np.abs(residual - offsets)
        # 1.4826 * median |x| is the standard deviation of a normal x.
        spread = 1.4826 * np.median(distance, axis=0) + 1e-12
        before, agrees = agrees, (distance <= 4 * spread).all(axis=1)
        if np.array_equal(before, agrees) or not agrees.any():
            break
        offsets = residual[agrees].mean(axis=0)
    return offsets, float(agrees.mean())


def noise_floor(contact: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviation of the contact wrench where nothing is touched, one for all motions.

    Starts from the width of the shortest interval that holds half of a channel's samples (for
    normal noise 1.349 standard deviations), so that contact in less than half of a record does
    not raise it, then takes the root mean square of the quiet samples, those within 4 of it in
    every channel, until that no longer changes.

    Args:
        contact: (N, 6) contact wrench with its offsets removed [N, N m].

    Returns:
        (6,) [N, N m].
    """
    ordered = np.sort(contact, axis=0)
    half = len(ordered) // 2
    floor = (ordered[half:] - ordered[: len(ordered) - half]).min(axis=0) / 1.349
    quiet: NDArray[np.bool_] = np.zeros(len(contact), bool)
    for _ in range(50):
        before = quiet
        quiet = _quiet(contact, np.maximum(floor, _RESOLUTION))
        if np.array_equal(before, quiet) or not quiet.any():
            break
        floor = np.sqrt(np.mean(contact[quiet] ** 2, axis=0))
    return np.maximum(floor, _RESOLUTION)


def _quiet(contact: NDArray[np.float64], floor: NDArray[np.float64]) -> NDArray[np.bool_]:
    return np.asarray((np.abs(contact) <= _QUIET * floor).all(axis=1))


def contacts_of(
    t: NDArray[np.float64], contact: NDArray[np.float64], touched: NDArray[np.bool_]
) -> list[dict[str, Any]]:
    """The touches, as summaries list them.

    Args:
        t: (N,) times [s].
        contact: (N, 6) F_c [N, N m].
        touched: (N,) as of `Detection`.

    Returns:
        of each start_s and stop_s, its first and last instant [s]; peak_N and peak_Nm, the largest
        |F_c| and |tau_c| in between; and at the peak of the force push (3), the direction in which
        the environment pushes, and point_m (3), of its line the point nearest to the origin of S;
        None if there is no force.
    """
    rows = []
    for start, stop in _spans(touched):
        wrench = contact[start:stop]
        forces = np.linalg.norm(wrench[:, :3], axis=1)
        direction, point, _ = wrench_axis(wrench[np.argmax(forces)])
        known = bool(np.isfinite(direction).all())
        rows.append(
            {
                "start_s": float(t[start]),
                "stop_s": float(t[stop - 1]),
                "peak_N": float(forces.max()),
                "peak_Nm": float(np.linalg.norm(wrench[:, 3:], axis=1).max()),
                # Eq. (13) is what the sensor exerts on the load.
                "push": -direction if known else None,
                "point_m": point if known else None,
            }
        )
    return rows
