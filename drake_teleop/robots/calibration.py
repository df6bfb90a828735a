"""Load identification from a stream until the tolerances are met."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import move_earlier_recordings
from drake_teleop.common.interruption import INTERRUPTED_EVENT
from drake_teleop.common.numeric import Array
from drake_teleop.load import tolerance as tolerances
from drake_teleop.load.normal_equations import SecondMoments
from drake_teleop.load.regressor import regressor
from drake_teleop.logs.causes.cause import CHANGE_CAUSES
from drake_teleop.logs.processing import IdentifiedLog, identify_log
from drake_teleop.logs.read.alignment import low_pass_log
from drake_teleop.logs.read.reading import read_log
from drake_teleop.robots.recording import Recorder
from drake_teleop.robots.streams import Source

TOLERANCE_CONFIDENCE = 0.9998
"""Level of the interval that must be within the tolerance."""
RECORD_GROWTH_FACTOR = 1.12
"""Growth factor of the record from one result to the next."""
MIN_EVALUATED_RECORD_S = 1.0
"""Length of the record at the first result [s]."""
MIN_DEGREES_OF_FREEDOM = 20.0
"""Minimum degrees of freedom of the variance of a known parameter."""
_RESTART_ADVICE = "start again: the sensor's zero or the load changes at t = {t:.2f} s"
_GRAVITY_M_S2 = 9.81
# Load and noise [N, N m] for the advice before the first identification.
_ASSUMED_PHI = np.array([1.0, 0.0, 0.0, 0.05, 0.004, 0.0, 0.0, 0.004, 0.0, 0.004])
_ASSUMED_WRENCH_NOISE = np.repeat([0.25, 0.012], 3)
_RELATIVE_GRAM_REGULARIZATION = 1e-12  # relative information that keeps matrices regular
# Motions: words, angle [rad], rate [Hz]; duration [s] and samples of each.
_ADVISED_MOTIONS = (
    ("rotate the wrist about {axis}, slowly, by 60 deg and back", np.radians(60.0), 0.25),
    ("swing the wrist about {axis}, briskly, by 20 deg back and forth", np.radians(20.0), 1.5),
)
_ADVISED_MOTION_S, _ADVISED_MOTION_SAMPLES = 4.0, 80
# Independent samples per second and hertz of the low-pass.
_INDEPENDENT_SAMPLES_PER_CUTOFF_PERIOD = 2.2


@dataclass(frozen=True, eq=False)
class RecordEvaluation:
    """Intermediate result of a calibration, for the k parameters with a tolerance.

    Attributes:
        identified_log: load and findings of the record; None if this failed for reason `failure`.
        relative_half_widths: (k,) of the 95 % intervals, divided by the tolerances.
        is_within_tolerance: (k,) True if the 99.98 % interval is, and there are no `doubts`.
        is_known: (k,) True if the previous result was within the tolerance, too.
        doubts: problems of the record; no parameter is known then.
    """

    record_length_s: float
    identified_log: IdentifiedLog | None
    failure: str
    relative_half_widths: Array
    is_within_tolerance: NDArray[np.bool_]
    is_known: NDArray[np.bool_]
    doubts: tuple[str, ...]
    advice: str


def evaluate_record(
    path: Path,
    tolerance: tolerances.Tolerance,
    previous: RecordEvaluation | None,
    *,
    cutoff_hz: float | None,
    delay: str | float,
) -> RecordEvaluation:
    """Return load, accuracy and advice for a record; `previous`: evaluation before, or None."""
    count, found, why = len(tolerance.required_entry_names), None, ""
    try:
        found = identify_log(path, cutoff_hz=cutoff_hz, delay=delay)
    except DrakeTeleopError as error:
        why = str(error)
    half, sure = np.full(count, np.inf), np.zeros(count, bool)
    doubts: tuple[str, ...] = ()
    phi, noise, log = _ASSUMED_PHI, _ASSUMED_WRENCH_NOISE, None
    if found is not None:
        load, log = found.identification, found.log
        half, wider, degrees = half_widths_and_dof_over_tolerances(found, tolerance)
        doubts = doubts_about_record(found)
        sure = (wider <= 1.0) & (degrees >= MIN_DEGREES_OF_FREEDOM) & (not doubts)
        if load.mass > 0.0:
            phi, noise = load.phi, np.maximum(load.residual_rms, 1e-3 * _ASSUMED_WRENCH_NOISE)
    known = sure & (previous is not None and previous.is_within_tolerance)
    changes = [x.start_s or 0.0 for x in found.causes if x.name in CHANGE_CAUSES] if found else []
    with suppress(DrakeTeleopError):  # too few samples
        log = log or low_pass_log(read_log(path, bandwidth_hz=cutoff_hz), cutoff_hz)
    if log is None:
        advice = _ADVISED_MOTIONS[0][0].format(axis="x")
    elif sure.all():
        advice = ""
    elif changes:
        advice = _RESTART_ADVICE.format(t=min(changes))
    else:
        errors = tolerances.derivatives_over_tolerances(tolerance, phi)
        advice = advise_motion(log.motion, log.dt, cutoff_hz, errors, noise)
    t = 0.0 if log is None else float(log.t[-1])
    return RecordEvaluation(t, found, why, half, sure, known, doubts, advice)


def half_widths_and_dof_over_tolerances(
    found: IdentifiedLog, tolerance: tolerances.Tolerance
) -> tuple[Array, Array, Array]:
    """Return half widths over tolerances, at 95 % and 99.98 %, and degrees of freedom (k,)."""
    load = found.identification
    errors = tolerances.derivatives_over_tolerances(tolerance, load.phi)
    deviations = tolerances.deviations_over_tolerances(errors, load.covariance)
    depends = np.where(errors != 0.0, load.degrees_of_freedom, np.inf)
    degrees = np.minimum(depends.min(axis=1), 1e6)
    levels = 0.95, TOLERANCE_CONFIDENCE
    half, sure = (stdtrit(degrees, 0.5 + 0.5 * level) * deviations for level in levels)
    return half, sure, degrees


def doubts_about_record(found: IdentifiedLog) -> tuple[str, ...]:
    doubts = [finding.message for finding in found.findings if finding.name != "contact"]
    if found.log.static:
        doubts.append("all poses are at rest")
    if found.identification.mass <= 0.0:
        doubts.append("the mass is negative: the wrench has the opposite sign")
    return tuple(doubts)


def advise_motion(
    motion: tuple[Array, Array, Array],
    dt: float,
    cutoff_hz: float | None,
    derivatives: Array,
    noise: Array,
) -> str:
    """Return the next motion that reduces the uncertainty most, in words.

    `motion`: recorded s, omega, alpha, (N, 3) each; `derivatives` (k, 16): of mass, com x ... by
    [offsets; phi], divided by tolerances; `noise` (6,) [N, N m].
    """
    rate = 1.0 / dt
    if cutoff_hz is not None:
        rate = min(rate, _INDEPENDENT_SAMPLES_PER_CUTOFF_PERIOD * cutoff_hz)
    equations = SecondMoments(noise)
    equations.add_samples(np.zeros((len(motion[0]), 6)), *motion)
    gram = rate * dt * equations.normal_equations()[0]
    size = np.sqrt(np.diag(gram).max()) + 1.0
    gram = gram + _RELATIVE_GRAM_REGULARIZATION * size**2 * np.eye(16)
    last = motion[0][-max(1, round(0.2 / dt)) :].mean(axis=0)
    best, least = "", np.inf
    for words, of_motion in _information_of_advised_motions(last, noise, rate):
        left = tolerances.deviations_over_tolerances(derivatives, np.linalg.inv(gram + of_motion))
        cost = float(np.log(np.maximum(left, 1.0)).sum()) + 1e-6 * float(left.sum())
        if cost < least:
            best, least = words, cost
    return best


def _information_of_advised_motions(
    up_S: Array, noise_std: Array, rate_hz: float
) -> Iterator[tuple[str, Array]]:
    s0 = _GRAVITY_M_S2 * up_S / max(float(np.linalg.norm(up_S)), 1e-9)
    t = np.arange(_ADVISED_MOTION_SAMPLES) * (_ADVISED_MOTION_S / _ADVISED_MOTION_SAMPLES)
    for words, size, hertz in _ADVISED_MOTIONS:
        w = 2.0 * np.pi * hertz
        angle, speed = 0.5 * size * (1.0 - np.cos(w * t)), 0.5 * size * w * np.sin(w * t)
        change = 0.5 * size * w * w * np.cos(w * t)
        for k, axis in enumerate("xyz"):
            e = np.eye(3)[k]
            # Vectors fixed in W rotate about -e in S (Rodrigues).
            s = (
                np.outer(np.cos(angle), s0)
                - np.outer(np.sin(angle), np.cross(e, s0))
                + np.outer(1.0 - np.cos(angle), e * (e @ s0))
            )
            V = regressor(s, np.outer(speed, e), np.outer(change, e))
            rows = np.concatenate([np.tile(np.eye(6), (_ADVISED_MOTION_SAMPLES, 1, 1)), V], axis=2)
            rows = (rows / noise_std[:, np.newaxis]).reshape(-1, 16)
            share = rate_hz * _ADVISED_MOTION_S / _ADVISED_MOTION_SAMPLES
            yield words.format(axis=axis), share * (rows.T @ rows)


DEFAULT_TOLERANCES_TEXT = "mass 0.5 %, com 0.5 mm, inertia 5 %"
"""Default tolerances."""
_STREAM_READ_TIMEOUT_S = 0.05
_MIN_SILENCE_S = 10.0  # peers of ROS 2 are found within seconds


def calibrate(
    source: Source,
    recorder: Recorder,
    path: Path,
    tolerance: tolerances.Tolerance,
    *,
    cutoff_hz: float | None = 30.0,
    delay: str | float = "auto",
    seconds: float = 120.0,
    show: Callable[[RecordEvaluation], None] = lambda _: None,
) -> list[RecordEvaluation]:
    """Record a stream into `path` until the tolerance is met or it ends; return evaluations.

    Record at most `seconds`; end if a live stream stalls for max(`seconds`, 10 s).
    """
    results: list[RecordEvaluation] = []
    next_length_s = MIN_EVALUATED_RECORD_S
    earlier = [path.with_name(name) for name in recorder.file_names] if source.live else []
    pending: Future[RecordEvaluation] | None = None

    def evaluate() -> RecordEvaluation:
        previous = results[-1] if results else None
        return evaluate_record(path, tolerance, previous, cutoff_hz=cutoff_hz, delay=delay)

    def store_evaluation_and_test_end(result: RecordEvaluation) -> bool:
        results.append(result)
        show(result)
        return bool(result.is_known.all())

    def write_record() -> None:
        if recorder.longest_record_s:
            move_earlier_recordings(*earlier)
            earlier.clear()
        recorder.write(path)

    done, grown_s, grown_at = False, 0.0, time.monotonic()
    max_silence_s = max(seconds, _MIN_SILENCE_S)
    try:
        with ThreadPoolExecutor(1) as executor, suppress(KeyboardInterrupt):
            while not (done or INTERRUPTED_EVENT.is_set()):
                if (readings := source.read(_STREAM_READ_TIMEOUT_S)) is None:
                    break
                for reading in readings:
                    recorder.add(reading)
                    if pending is None and recorder.longest_record_s >= next_length_s:
                        next_length_s = RECORD_GROWTH_FACTOR * recorder.longest_record_s
                        write_record()
                        pending = executor.submit(evaluate)
                    if pending is not None and (not source.live or pending.done()):
                        done, pending = store_evaluation_and_test_end(pending.result()), None
                    done = done or recorder.longest_record_s >= seconds
                    if done:
                        break
                if recorder.longest_record_s > grown_s:
                    grown_s, grown_at = recorder.longest_record_s, time.monotonic()
                done = done or (source.live and time.monotonic() - grown_at > max_silence_s)
    except Exception:  # raised again: the record is kept whatever ended the loop
        if recorder.longest_record_s:
            write_record()
        raise
    if pending is not None:
        store_evaluation_and_test_end(pending.result())
    if not results or not results[-1].is_known.all():
        write_record()
        store_evaluation_and_test_end(evaluate())
    return results
