"""Search for signs, axes, units and clocks of a log description with which a rigid load fits."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.special import fdtri

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, white_noise_deviations
from drake_teleop.load.batch.methods import identify_batch
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.identification import Identification
from drake_teleop.load.regressor import regressor
from drake_teleop.logs.causes.candidates import MAX_PLAUSIBLE_MASS_KG
from drake_teleop.logs.causes.cause import Finding
from drake_teleop.logs.check import edits
from drake_teleop.logs.check.edits import LogTables
from drake_teleop.logs.check.motion_size import (
    MORE_MOTION_REMEDY,
    explain_lack_of_motion,
    max_cutoff_by_pose_noise,
)
from drake_teleop.logs.read.alignment import (
    MAX_SEARCHED_DELAY_S,
    estimate_delay,
    is_far_from_gaps,
    low_pass_log,
    remove_delay,
    resample,
)
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.description import Description

MAX_GOOD_RESIDUAL_SHARE = 0.02
"""Largest unexplained share of the variance, without white noise, of a good fit."""
MAX_VALID_RESIDUAL_SHARE = 0.05
"""Largest unexplained share of the variance, without white noise, of a valid description."""
MIN_MISFIT_REDUCTION_FACTOR = 4.0  # least factor on the unexplained share
_FALSE_ALARM_RATE, _NUM_TESTED_EDITS = 1e-6, 50
_FINDINGS_WITHOUT_WRENCH_SIGN_EDIT = ("sign", "swapped axes")
"""Sign, and axes: with the opposite sign they are mirrored, a cause that `identify` reports."""
_KEPT_SHARE_WITHOUT_CONTACT = 0.75  # of a record with contact
_LOAD_FIT_CUTOFF_HZ, _MAX_FITTED_SAMPLES = 15.0, 1500


@dataclass(frozen=True)
class LoadFitQuality:
    """Quality of a load's fit: mass [kg], residual and noise as shares of the wrench's variance."""

    unexplained: float
    mass: float
    noise_share: float = 0.0
    independent_samples: float = 1e9

    @property
    def is_good(self) -> bool:
        limit = self.max_residual_share_including_noise(MAX_GOOD_RESIDUAL_SHARE)
        return self.mass > 0 and self.unexplained < limit

    def max_residual_share_including_noise(self, limit_without_noise: float) -> float:
        """Return the limit of the unexplained share: `limit_without_noise` + noise, at most 0.9."""
        return min(limit_without_noise + self.noise_share, MIN_RESIDUAL_SHARE_OF_UNKNOWN_LOAD)


def fit_load(log: Log, kept_share: float = 1.0) -> LoadFitQuality:
    """Fit a load to the best `kept_share` of samples of a low-passed log; return the quality."""
    return _fit_load_to_samples(_low_pass_and_decimate_log(log), kept_share)


class _LowPassedSamples(NamedTuple):
    wrench: Array
    motion: tuple[Array, Array, Array]
    gravity: Array | None  # only if the weight is estimated
    cutoff_hz: float | None
    dt: float
    duration_s: float
    wrench_noise: Array


def _low_pass_and_decimate_log(log: Log) -> _LowPassedSamples:
    limit = max_cutoff_by_pose_noise(log)
    cutoff = None if log.static else min(_LOAD_FIT_CUTOFF_HZ, 0.2 / log.dt, limit)
    smooth = low_pass_log(log, cutoff).select_rows(is_far_from_gaps(log, cutoff))
    rows = slice(None, None, max(1, len(log) // _MAX_FITTED_SAMPLES))
    s, omega, alpha = (x[rows].copy() for x in smooth.motion)
    gravity = smooth.gravity[rows].copy() if smooth.gravity is not None else None
    return _LowPassedSamples(
        smooth.wrench[rows].copy(),
        (s, omega, alpha),
        gravity if "weight" in log.estimated else None,
        cutoff,
        log.dt,
        float(log.t[-1] - log.t[0]),
        white_noise_deviations(log.wrench),
    )


def _fit_load_to_samples(samples: _LowPassedSamples, kept_share: float) -> LoadFitQuality:
    wrench, cutoff = samples.wrench, samples.cutoff_hz
    scale = _wrench_channel_scales(wrench)
    V = regressor(*samples.motion)
    if samples.gravity is not None:
        rest = np.zeros_like(samples.gravity)
        V = np.dstack([V, regressor(-samples.gravity, rest, rest)[..., :4]])
    V, w = V / scale[:, None], wrench / scale
    theta = _fit_load_parameters(V, w)
    if kept_share < 1.0:
        errors = w - V @ theta
        errors = np.linalg.norm(errors - np.median(errors, axis=0), axis=1)
        best = errors <= np.quantile(errors, kept_share)
        V, w = V[best], w[best]
        theta = _fit_load_parameters(V, w)
    total = float(w.var(axis=0).sum()) + 1e-30
    unexplained = float((w - V @ theta).var(axis=0).sum()) / total
    if cutoff is None:
        return LoadFitQuality(unexplained, float(theta[0]), 0.0, max(1.0, len(w) - 8.0))
    # The low-pass passes the share 0.83 * 2 * cut-off * dt of white noise.
    passed = min(1.0, 1.67 * cutoff * samples.dt)
    noise_share = passed * float(((samples.wrench_noise / scale) ** 2).sum()) / total
    independent_samples = 2 * cutoff * kept_share * samples.duration_s
    return LoadFitQuality(unexplained, float(theta[0]), noise_share, independent_samples)


def _fit_load_parameters(V: Array, w: Array) -> Array:
    V = V - V.mean(axis=0)
    matrix = V.reshape(-1, V.shape[2])
    size = np.linalg.norm(matrix, axis=0) + 1e-12
    right = (w - w.mean(axis=0)).ravel()
    return np.asarray(np.linalg.lstsq(matrix / size, right, rcond=1e-6)[0] / size)


def unexplained_share(wrench: Array, residual: Array) -> float:
    """Return the residual's variance over the wrench's; force and torque have equal weights."""
    scale = _wrench_channel_scales(wrench)
    total = float((wrench / scale).var(axis=0).sum()) + 1e-30
    return float((residual / scale).var(axis=0).sum()) / total


def _wrench_channel_scales(wrench: Array) -> Array:
    force, torque = np.sqrt(wrench.var(axis=0).reshape(2, 3).sum(axis=1))
    least = 1e-9 * float(np.abs(wrench).max()) + 1e-15
    return np.repeat([force + least, max(torque, 0.03 * force) + least], 3)


MIN_RESIDUAL_SHARE_OF_UNKNOWN_LOAD = 0.9  # share of the variance
MIN_REPORTED_LAG_S = 0.002
_NUM_DELAY_PARTS, _MIN_DELAY_PARTS = 8, 4
_MIN_DELAY_DRIFT_S, _MAX_DELAY_DEVIATION_OVER_DRIFT = 0.03, 0.15
"""Smallest change of the delay [s]; largest deviation from a line, as a share of it."""
_MAX_RESIDUAL_RATIO_AFTER_CORRECTION = 0.5


def check_wrench_and_estimate_delay(
    description: Description, data: LogTables
) -> tuple[list[Finding], float | None]:
    """Return findings on wrench, orientation, clocks; delay of motion behind wrench [s] or None."""
    log = data.read_whole_log(description)
    delay = None if log.static else estimate_delay(log, 30.0)
    thin = data.read_thinned_log(description)
    too_still = explain_lack_of_motion(thin)
    samples_of_edits: dict[int, list[_LowPassedSamples]] = {}  # by identity of the description

    def fit_edited_description(edited: Description, kept_share: float = 1.0) -> LoadFitQuality:
        if id(edited) not in samples_of_edits:
            # A wrong description may cause a wrong delay.
            log = _log_with_edited_wrench(thin, description, edited)
            why = too_still
            if log is None:
                log = data.read_thinned_log(edited)
                why = explain_lack_of_motion(log)
            if edited is not description and why is not None:
                raise DrakeTeleopError(why)
            aligned = [remove_delay(log, shift) for shift in {0.0, delay or 0.0}]
            samples_of_edits[id(edited)] = [_low_pass_and_decimate_log(each) for each in aligned]
        fits = [_fit_load_to_samples(each, kept_share) for each in samples_of_edits[id(edited)]]
        return min(fits, key=lambda fit: fit.unexplained)

    given = fit_edited_description(description)
    # Slow motion fits well with a wrong clock, but then the delay is at the limit of its range.
    inside = delay is not None and abs(delay) < 0.9 * MAX_SEARCHED_DELAY_S
    candidates: list[tuple[Finding | None, Description]] = []
    if too_still is None and not (given.is_good and inside):
        candidates += _clock_offset_edits(description, thin)
    if not given.is_good:
        candidates = [*edits.wrench_and_motion_edits(description), *candidates]
    found = _select_far_better_edits(fit_edited_description, given, candidates)
    if not found and not given.is_good and not log.static:  # contact may hide what fits
        without_contact = partial(fit_edited_description, kept_share=_KEPT_SHARE_WITHOUT_CONTACT)
        found = _select_far_better_edits(without_contact, without_contact(description), candidates)
    if not found and given.is_good:
        return lag_findings(description, delay) if _is_delay_significant(thin, delay) else [], delay
    if not found:
        return _payload_or_lag_findings_and_delay(description, log, given, delay)
    least = 1.2 * min(fit.unexplained for fit, *_ in found) + 1e-9
    equals = [(finding, edited) for fit, finding, edited in found if fit.unexplained <= least]
    finding, edited = equals[0]
    delay = None if log.static else estimate_delay(data.read_whole_log(edited), 30.0)
    if description.wrench is not None and edited.wrench is not None:
        shift = edited.wrench.time.offset - description.wrench.time.offset
        if shift:  # of the clock of the wrench, to the nearest 20 ms
            delay = shift + (delay or 0.0)
    if finding is None:
        return lag_findings(description, delay), delay
    others = {f.name: f.message for f, _ in reversed(equals[1:]) if f and f.name != finding.name}
    message = "; just as possible: ".join([finding.message, *others.values()])
    return [replace(finding, message=message), *lag_findings(description, delay)], delay


def _select_far_better_edits(
    fit_description: Callable[[Description], LoadFitQuality],
    given: LoadFitQuality,
    candidates: list[tuple[Finding | None, Description]],
) -> list[tuple[LoadFitQuality, Finding | None, Description]]:
    positive, negative = [], []
    for finding, edited in candidates:
        fit = edits.call_or_none_if_unreadable(fit_description, edited)
        if fit is None or abs(fit.mass) > max(MAX_PLAUSIBLE_MASS_KG, 2.0 * abs(given.mass)):
            continue
        if fit.mass > 0:
            positive.append((fit, finding, edited))
        elif finding is not None and finding.name not in _FINDINGS_WITHOUT_WRENCH_SIGN_EDIT:
            negative.append((fit, *edits.edit_with_opposite_wrench_sign(finding, edited)))
        elif finding is None:  # a clock and the sign
            negative.append((fit, *next(edits.wrench_and_motion_edits(edited))))
    # A negative mass is impossible: an equally good fit with a positive one suffices.
    valid = given.max_residual_share_including_noise(MAX_VALID_RESIDUAL_SHARE)
    n = max(1.0, given.independent_samples)
    least_factor = float(fdtri(n, n, 1 - _FALSE_ALARM_RATE / _NUM_TESTED_EDITS))
    decisive = given.unexplained / max(MIN_MISFIT_REDUCTION_FACTOR, least_factor)
    limit = min(1.01 * given.unexplained if given.mass < 0 else decisive, valid)
    found = [entry for entry in positive if entry[0].unexplained < limit]
    return found or [entry for entry in negative if entry[0].unexplained < min(decisive, valid)]


def _is_delay_significant(log: Log, delay: float | None) -> bool:
    if delay is None:
        return False
    none, aligned = fit_load(log), fit_load(remove_delay(log, delay))
    gain = none.independent_samples * np.log(none.unexplained / (aligned.unexplained + 1e-30))
    return bool(gain > 25.0)


def _log_with_edited_wrench(log: Log, old: Description, new: Description) -> Log | None:
    a, b = old.wrench, new.wrench
    if a is None or b is None or "base" in (a.frame, b.frame) or isinstance(a.weight, tuple):
        return None
    changes = {"sign": a.sign, "frame": a.frame, "force": a.force, "torque": a.torque}
    if new.model_copy(update={"wrench": b.model_copy(update=changes)}) != old:
        return None
    R_old, R_new = (np.array(w.frame) if w.frame != "sensor" else np.eye(3) for w in (a, b))
    parts = []
    pairs = (log.wrench[:, :3], a.force, b.force), (log.wrench[:, 3:], a.torque, b.torque)
    for x, given, other in pairs:
        if set(given.columns) != set(other.columns) or len(given.columns) != 3:
            return None
        values = x @ R_old / given.scale  # in the axes of the file
        values = values[:, [given.columns.index(column) for column in other.columns]]
        parts.append((values * other.scale) @ R_new.T)
    return replace(log, wrench=a.sign * b.sign * np.hstack(parts))


def _payload_or_lag_findings_and_delay(
    description: Description, log: Log, given: LoadFitQuality, delay: float | None
) -> tuple[list[Finding], float | None]:
    smooth = low_pass_log(log, 30.0)
    fit = identify_batch(smooth.wrench, *smooth.motion, shared_noise=log.static)
    load = fit.identification
    finding = undetermined_payload_finding(load, given.unexplained - given.noise_share)
    fitted = np.isfinite(load.standard_deviations[6])
    if finding and fitted and (why := explain_lack_of_motion(log)) is not None:
        finding = replace(finding, message=f"payload not identifiable: {why}; {MORE_MOTION_REMEDY}")
    if finding:
        return [finding], None
    kept = ~fit.rejected
    wrench, (s, omega, alpha) = smooth.wrench[kept], (x[kept] for x in smooth.motion)
    residual = contact_wrench(wrench, load.offsets, s, omega, alpha, load.phi)
    limit = MAX_VALID_RESIDUAL_SHARE + given.noise_share
    if delay is None or unexplained_share(wrench, residual) > limit:
        return [], None
    if fit.rejected.any():
        # Contacts bias the delay.
        lost = fit.rejected if log.bridged is None else fit.rejected | log.bridged
        delay = estimate_delay(replace(log, bridged=lost), 30.0)
    return lag_findings(description, delay), delay


def undetermined_payload_finding(load: Identification, unexplained: float) -> Finding | None:
    """Return a finding if the mass of the load is undetermined; `unexplained` share of variance."""
    if load.verdicts[6] != "not" and unexplained < MIN_RESIDUAL_SHARE_OF_UNKNOWN_LOAD:
        return None
    deviation = float(load.standard_deviations[6])
    fitted = "no signal of the record depends on its mass"
    if np.isfinite(deviation):
        share = max(0.0, 100 * (1 - unexplained))
        fitted = f"{load.mass:.2g} ± {deviation:.2g} kg in the fit, which explains {share:.0f} % of"
        fitted += " the wrench's variance"
    remedy = "record slow rotations about two horizontal axes, without contact"
    return Finding("payload", f"payload not identifiable: {fitted}; {remedy}")


def _clock_offset_edits(description: Description, log: Log) -> Iterator[tuple[None, Description]]:
    if description.wrench is None:
        return
    reach = min(2.0, 0.25 * float(log.t[-1] - log.t[0]))
    smooth = low_pass_log(log, min(5.0, 0.2 / log.dt))
    t = np.linspace(log.t[0] + reach, log.t[-1] - reach, 300)
    wrench = resample(t, smooth.t, smooth.wrench)

    def unexplained_at_shift(shift: float) -> float:
        s, omega, alpha = (resample(t + shift, smooth.t, x) for x in smooth.motion)
        return fit_load(Log(t, wrench, s, omega, alpha)).unexplained

    shifts = np.arange(-reach, reach + 1e-9, 0.02)
    best = float(shifts[int(np.argmin([unexplained_at_shift(x) for x in shifts]))])
    if abs(best) < reach - 0.03:
        offset = description.wrench.time.offset + best
        yield None, edits.edit_field(description, "wrench.time.offset", offset)


def lag_findings(description: Description, delay: float | None) -> list[Finding]:
    if delay is None or abs(delay) <= MIN_REPORTED_LAG_S or description.wrench is None:
        return []
    side = "behind" if delay > 0 else "ahead of"
    if abs(delay) > edits.MIN_LAG_OF_WRONG_CLOCK_S:
        offset = description.wrench.time.offset + delay
        text = f"the motion is {abs(delay):.3f} s {side} the wrench: a clock is wrong; set"
        text += f" wrench.time.offset: {offset:.3f} (or shift the other streams by the opposite)"
        return [Finding("clock", text)]
    text = f"the motion is {abs(delay) * 1e3:.1f} ms {side} the wrench; identify corrects"
    text += f" this. To state it in the description, add {delay:.4f} to wrench.time.offset"
    return [Finding("lag", text)]


def clock_drift_finding_and_correction(
    description: Description, data: LogTables
) -> tuple[list[Finding], Description]:
    """Return a finding if the delay of the motion grows steadily, and the corrected description."""
    name = "imu" if description.pose is None else "pose"
    stream = getattr(description, name)
    if stream is None or description.wrench is None or (description.imu and description.pose):
        return [], description
    log = data.read_thinned_log(description)
    line = _fit_start_delay_and_clock_drift(log)
    if line is None:
        return [], description
    late, slope = line
    _, lines, edited = data.correction_of_lag_and_clock_drift(name, description, late, slope)
    limit = _MAX_RESIDUAL_RATIO_AFTER_CORRECTION * _unexplained_share_after_delay_removal(log)
    if _unexplained_share_after_delay_removal(data.read_thinned_log(edited)) > limit:
        return [], description
    text = f"the clock of the {name} drifts by {1e3 * slope:.3g} ms per second against the wrench's"
    return [Finding("clock", f"{text}; set {lines}")], edited


def _fit_start_delay_and_clock_drift(log: Log) -> tuple[float, float] | None:
    span = float(log.t[-1] - log.t[0])
    edges = np.linspace(0, len(log), _NUM_DELAY_PARTS + 1).astype(int)
    found = []
    for a, b in pairwise(edges):
        part = log.select_rows(slice(int(a), int(b)))
        delay = estimate_delay(part, 15.0)
        if delay is not None:
            found.append((0.5 * float(part.t[0] + part.t[-1]), delay))
    if len(found) < _MIN_DELAY_PARTS:
        return None
    t, delays = np.array(found).T
    slope, late = np.polyfit(t, delays, 1)
    change = abs(slope) * span
    uneven = np.std(delays - late - slope * t) > _MAX_DELAY_DEVIATION_OVER_DRIFT * change
    if change < _MIN_DELAY_DRIFT_S or uneven or abs(slope) > 0.2:
        return None
    return float(late), float(slope)


def _unexplained_share_after_delay_removal(log: Log) -> float:
    try:
        return fit_load(remove_delay(log, estimate_delay(log, 15.0) or 0.0)).unexplained
    except DrakeTeleopError:
        return np.inf
