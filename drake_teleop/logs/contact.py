"""Contact detection in a log (docs/detection.md), for the commands `detect` and `eliminate`."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, find_runs_of_true, width_and_centre_of_narrowest_half
from drake_teleop.load.contact import detection
from drake_teleop.load.contact.detection import MIN_NOISE_FLOOR_SAMPLES, MIN_WRENCH_NOISE_STD
from drake_teleop.load.contact.noise_floor import (
    THRESHOLD_MARGIN,
    DetectorSamples,
    NoiseFloor,
    statistic_index,
)
from drake_teleop.logs.read.alignment import low_pass
from drake_teleop.logs.read.canonical import Log

_MAX_SAMPLE_RATE_RATIO = 1.25  # of log and free motion, for statistics of several samples
# Without orientation, gravity is the specific force below this frequency.
_GRAVITY_LOW_PASS_CUTOFF_HZ = 0.5
_MAX_QUIET_WRENCH_OVER_NOISE = 4.0
_ASSUMED_CUTOFF_WITHOUT_FILTER_HZ = 30.0  # assumed cut-off without a low-pass
_MIN_FLOOR_BLOCK_DURATION_S, _MIN_FLOOR_BLOCKS = 0.1, 20
_QUIET_HALF_ITERATIONS, _NUM_CONTACT_REMOVAL_ROUNDS = 4, 3
# The least expected maximum times 1.25 is about `NOISE_LEVEL_ONCE_PER_MILLION_SAMPLES`.
_FINAL_THRESHOLD_OVER_EXPECTED_MAX, _MIN_EXPECTED_MAX = 1.6, 5.0
_MAX_SAMPLES_FOR_NOISE_FLOOR = 30_000  # in spans of ten blocks
_GUMBEL_QUARTILE, _GUMBEL_MEDIAN = (-math.log(-math.log(share)) for share in (0.25, 0.5))
_MAX_CONTACT_SHARE, _MAX_NOISE_FLOOR_OVER_FIT_RESIDUAL = 0.4, 10.0
# Share of contact above which different offsets are not attributed to drift.
_MIN_CONTACT_SHARE_FOR_OFFSET_NOTE = 0.2


@dataclass(frozen=True)
class Detection:
    """Contact in a log of N samples.

    Attributes:
        noise_floor: noise of the contact wrench in free motion.
        statistic, threshold: name of the used statistic, and its limit.
        statistics: (N, 3) level, cusum, glr; 0 in samples near ends and edges.
        touched: (N,) True for contact, with hysteresis.
        free_duration_s: duration of the free motion that determined the noise floor [s].
        force_threshold: 1.25 times the largest |F_c| of the free motion [N].
    """

    noise_floor: NoiseFloor
    statistic: str
    threshold: float
    statistics: Array
    touched: NDArray[np.bool_]
    free_duration_s: float
    force_threshold: float
    notes: tuple[str, ...] = ()

    @property
    def is_above_threshold(self) -> NDArray[np.bool_]:
        """Flags (N,): True where the statistic reaches the threshold, without hysteresis."""
        return self.statistics[:, statistic_index(self.statistic)] >= self.threshold


def samples_for_detector(log: Log, contact: Array, cutoff_hz: float | None) -> DetectorSamples:
    s, omega, alpha = (low_pass(x, log.dt, cutoff_hz) for x in log.motion)
    if log.gravity is not None:
        gravity = low_pass(log.gravity, log.dt, cutoff_hz)
    else:
        gravity = -low_pass(log.specific_force, log.dt, _GRAVITY_LOW_PASS_CUTOFF_HZ)
    return DetectorSamples(contact, s, omega, alpha, s + gravity)


def detect_contact(
    samples: DetectorSamples,
    dt: float,
    cutoff_hz: float | None,
    covariance: Array,
    residual_rms: Array,
    *,
    edge: NDArray[np.bool_] | None = None,
    free: tuple[DetectorSamples, float] | None = None,
    statistic: str = "level",
) -> Detection | None:
    """Find contact in samples of a log; return None if too few are away from ends and edges.

    Samples with `edge` True, or within a period of the low-pass from the ends, are not judged.
    `covariance` (16, 16) is that of [offsets; phi], `residual_rms` (6,) that of the identification
    [N, N m]. `free` contains samples of another log in free motion, and their sample time [s].
    """
    period = 1.0 / (cutoff_hz or _ASSUMED_CUTOFF_WITHOUT_FILTER_HZ)
    inner = _rows_far_from_ends_and_edges(samples, dt, period, edge)
    judged = samples.select_rows(inner)
    if len(judged.contact) < MIN_NOISE_FLOOR_SAMPLES:
        return None
    hold, column = round(period / dt), statistic_index(statistic)
    fade = math.exp(-dt / period)  # a held value decays by the factor e within a period
    if free is None:
        floor, threshold, train = _fit_noise_floor_and_threshold(
            judged, dt, hold, fade, covariance, statistic
        )
    else:
        ratio = max(dt, free[1]) / min(dt, free[1])
        if column > 0 and ratio > _MAX_SAMPLE_RATE_RATIO:
            what = f"{1.0 / free[1]:.4g} Hz is not the rate of the log, {1.0 / dt:.4g} Hz, as the"
            what += f" sums of statistic {statistic!r} require"
            remedy = "use statistic `level`, or free motion with the rate of the log"
            raise DrakeTeleopError(what, where="free", remedy=remedy)
        train = free[0].select_rows(_rows_far_from_ends_and_edges(free[0], free[1], period))
        if len(train.contact) < MIN_NOISE_FLOOR_SAMPLES:
            what = f"{len(train.contact)} samples are too few for a noise floor"
            raise DrakeTeleopError(what, where="free", remedy="give a longer record")
        floor = detection.fit_noise_floor(*train, covariance, fade=math.exp(-free[1] / period))
        threshold = max(detection.NOISE_LEVEL_ONCE_PER_MILLION_SAMPLES, floor.threshold(statistic))
        floor = replace(floor, fade=fade)
    values, touched = np.zeros((len(samples.contact), 3)), np.zeros(len(samples.contact), bool)
    detector = detection.ContactDetector(floor, threshold, statistic=statistic, hold=hold)
    values[inner] = detection.statistics_of_log(floor, *judged)
    touched[inner] = _remove_hold_time_after_contact(detector.detect(*judged), hold)
    if free is None:
        _remove_brief_weak_contacts(touched, values[:, column], threshold, hold)
    return Detection(
        noise_floor=floor,
        statistic=statistic,
        threshold=threshold,
        statistics=values,
        touched=touched,
        free_duration_s=len(train.contact) * (dt if free is None else free[1]),
        force_threshold=THRESHOLD_MARGIN
        * float(np.linalg.norm(train.contact[:, :3], axis=1).max()),
        notes=() if free is not None else _notes_if_mostly_contact(floor, touched, residual_rms),
    )


def _rows_far_from_ends_and_edges(
    samples: DetectorSamples, dt: float, period: float, edge: NDArray[np.bool_] | None = None
) -> slice | NDArray[np.bool_]:
    ends, judged = max(1, round(period / dt)), np.zeros(len(samples.contact), bool)
    judged[ends : len(judged) - ends] = True
    if edge is not None:
        judged &= ~edge
    at = np.flatnonzero(judged)
    one_piece = len(at) > 0 and len(at) == at[-1] + 1 - at[0]
    return slice(int(at[0]), int(at[-1]) + 1) if one_piece else judged


def _fit_noise_floor_and_threshold(
    samples: DetectorSamples, dt: float, hold: int, fade: float, covariance: Array, statistic: str
) -> tuple[NoiseFloor, float, DetectorSamples]:
    from scipy.ndimage import maximum_filter1d

    n = len(samples.contact)
    block = max(hold, round(_MIN_FLOOR_BLOCK_DURATION_S / dt))
    selected = np.arange(n) // (10 * block) % math.ceil(n / _MAX_SAMPLES_FOR_NOISE_FLOOR) == 0
    quiet = _find_quiet_samples(samples.contact, noise_floor(samples.contact))
    if (quiet & selected).sum() < MIN_NOISE_FLOOR_SAMPLES:
        quiet = selected = np.ones(n, bool)
    block_of_row = np.minimum(np.arange(n) // block, n // block - 1)
    for _ in range(_QUIET_HALF_ITERATIONS if n >= _MIN_FLOOR_BLOCKS * block else 0):
        floor = detection.fit_noise_floor(
            *samples.select_rows(quiet & selected), covariance, fade=fade
        )
        level = detection.statistics_of_log(floor, *samples)[:, 0]
        power = np.bincount(block_of_row, level**2) / np.bincount(block_of_row)
        half = (power <= np.median(power))[block_of_row]
        if (half & selected).sum() < MIN_NOISE_FLOOR_SAMPLES:
            break
        quiet = half
    for attempt in range(_NUM_CONTACT_REMOVAL_ROUNDS):
        train = samples.select_rows(quiet & selected)
        floor = detection.fit_noise_floor(*train, covariance, fade=fade)
        values = detection.statistics_of_log(floor, *train)[:, statistic_index(statistic)]
        reached = _expected_maximum_in_free_motion(values, block, n)
        if attempt > 0:
            reached = min(reached, float(values.max()))
        reached = max(_MIN_EXPECTED_MAX, reached)
        threshold = THRESHOLD_MARGIN * reached
        detector = detection.ContactDetector(floor, threshold, statistic=statistic, hold=hold)
        without_contact = maximum_filter1d(detector.detect(*samples), 2 * block + 1) == 0
        too_few = (selected & without_contact).sum() < MIN_NOISE_FLOOR_SAMPLES
        if too_few or attempt == _NUM_CONTACT_REMOVAL_ROUNDS - 1:
            break
        quiet = without_contact
    return floor, _FINAL_THRESHOLD_OVER_EXPECTED_MAX * reached, samples.select_rows(quiet)


def _expected_maximum_in_free_motion(values: Array, block_size: int, num_samples: int) -> float:
    """Return the expected maximum of a statistic in `num_samples` of free motion, Eq. (T13)."""
    block_size = min(block_size, len(values) // 4)
    count = len(values) // block_size
    largest = values[: count * block_size].reshape(count, block_size).max(axis=1)
    lower, middle = np.log(np.quantile(np.maximum(largest, 1.0), [0.25, 0.5]))
    scale = (middle - lower) / (_GUMBEL_MEDIAN - _GUMBEL_QUARTILE)
    rare = -math.log(-math.log(1.0 - 1.0 / max(3, num_samples // block_size)))
    return math.exp(lower + scale * (rare - _GUMBEL_QUARTILE))


def _remove_hold_time_after_contact(touched: NDArray[np.bool_], hold: int) -> NDArray[np.bool_]:
    for _, stop in find_runs_of_true(touched):
        if stop < len(touched):
            touched[stop - hold : stop] = False
    return touched


def _remove_brief_weak_contacts(
    touched: NDArray[np.bool_], values: Array, threshold: float, hold: int
) -> None:
    for start, stop in find_runs_of_true(touched):
        if 2 * (stop - start) < hold and values[start:stop].max() < THRESHOLD_MARGIN * threshold:
            touched[start:stop] = False


def _notes_if_mostly_contact(
    floor: NoiseFloor, touched: NDArray[np.bool_], residual_rms: Array
) -> tuple[str, ...]:
    remedy = "; give a log of free motion with --free"
    if touched.mean() > _MAX_CONTACT_SHARE:
        return (
            f"{100 * touched.mean():.0f} % of the record are contact: the rest is too short to"
            f" determine the noise floor{remedy}",
        )
    noise_ratio = float((floor.noise / np.maximum(residual_rms, MIN_WRENCH_NOISE_STD)).max())
    if noise_ratio > _MAX_NOISE_FLOOR_OVER_FIT_RESIDUAL:
        return (
            f"the noise floor at rest is {noise_ratio:.0f} times the residual of the"
            " identification: most of the record may be in contact, which is not detected"
            f"{remedy}",
        )
    return ()


def note_on_drift_or_much_contact(shift: Array, found: Detection) -> tuple[str, ...]:
    """Return a note if contact is frequent and the `shift` (6,) of offsets is large, else ()."""
    force = float(np.linalg.norm(shift[:3]))
    if force <= found.force_threshold or found.touched.mean() < _MIN_CONTACT_SHARE_FOR_OFFSET_NOTE:
        return ()
    return (
        f"the offsets of the record differ by {force:.2g} N from those of the free motion: either"
        " the sensor drifted, or most of the record is contact, which changes the offsets; tare the"
        " sensor before recording, or record less contact",
    )


def robust_offsets(residual: Array) -> tuple[Array, float]:
    """Return offsets (6,) of a residual (N, 6), and the share of samples near them, Eq. (T12)."""
    offsets = width_and_centre_of_narrowest_half(residual)[1]
    agrees: NDArray[np.bool_] = np.zeros(len(residual), bool)
    for _ in range(50):
        distance = np.abs(residual - offsets)
        # 1.4826 * median |x| is the standard deviation of a normal x.
        spread = 1.4826 * np.median(distance, axis=0) + 1e-12
        before, agrees = agrees, np.asarray((distance <= 4 * spread).all(axis=1))
        if np.array_equal(before, agrees) or not agrees.any():
            break
        offsets = residual[agrees].mean(axis=0)
    return offsets, float(agrees.mean())


def noise_floor(contact: Array) -> Array:
    """Return the RMS noise (6,) of a contact wrench (N, 6) that is mostly noise, Eq. (T12)."""
    floor = width_and_centre_of_narrowest_half(contact)[0] / 1.349
    quiet: NDArray[np.bool_] = np.zeros(len(contact), bool)
    for _ in range(50):
        floor = np.maximum(floor, MIN_WRENCH_NOISE_STD)
        before, quiet = quiet, _find_quiet_samples(contact, floor)
        if np.array_equal(before, quiet) or not quiet.any():
            break
        floor = np.sqrt(np.mean(contact[quiet] ** 2, axis=0))
    return np.maximum(floor, MIN_WRENCH_NOISE_STD)


def _find_quiet_samples(contact: Array, floor: Array) -> NDArray[np.bool_]:
    return np.asarray((np.abs(contact) <= _MAX_QUIET_WRENCH_OVER_NOISE * floor).all(axis=1))


def summarize_contacts(
    t: Array, contact: Array, touched: NDArray[np.bool_]
) -> list[dict[str, Any]]:
    """Return times [s], peaks [N, N m], direction of the push and point (in S) of each contact."""
    rows = []
    for start, stop in find_runs_of_true(touched):
        wrench = contact[start:stop]
        forces = np.linalg.norm(wrench[:, :3], axis=1)
        direction, point, _ = detection.central_axis_of_wrenches(wrench[np.argmax(forces)])
        known = bool(np.isfinite(direction).all())
        row = {
            "start_s": float(t[start]),
            "stop_s": float(t[stop - 1]),
            "peak_N": float(forces.max()),
            "peak_Nm": float(np.linalg.norm(wrench[:, 3:], axis=1).max()),
            # Eq. (13) is the wrench of the sensor on the load.
            "push": -direction if known else None,
            "point_m": point if known else None,
        }
        rows.append(row)
    return rows
