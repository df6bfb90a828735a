"""Wrong units, signs, axes and clocks in a log description, found in the data by laws of motion."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, one_blas_thread, white_noise_deviations
from drake_teleop.load.identification import Identification
from drake_teleop.logs.causes.cause import Finding
from drake_teleop.logs.check import against_load, edits
from drake_teleop.logs.check.against_load import MAX_GOOD_RESIDUAL_SHARE, LoadFitQuality
from drake_teleop.logs.check.edits import LogTables
from drake_teleop.logs.check.motion_checks import (
    check_imu_against_pose,
    check_imu_signals,
    position_unit_or_origin_findings,
)
from drake_teleop.logs.check.motion_size import MORE_MOTION_REMEDY, explain_lack_of_motion
from drake_teleop.logs.read import table_files
from drake_teleop.logs.read.canonical import Log, describe_canonical
from drake_teleop.logs.read.description import Description, load_description
from drake_teleop.logs.read.mounting import Mounting
from drake_teleop.logs.read.table_files import TABLE_READERS
from drake_teleop.logs.read.tables import Table

_MIN_STATIC_POSES_FOR_CHECK = 6
_MIN_GRAVITY_DIRECTION_STD_RAD = 0.15  # that separates offsets from a load
_MIN_WRENCH_RANGE_OVER_MAGNITUDE = 1e-6  # of a live wrench, over the largest reading


@dataclass(frozen=True)
class ConventionCheckResult:
    """Findings on a log description, with fit, IMU mounting, motion delay behind the wrench [s]."""

    findings: tuple[Finding, ...]
    fit: LoadFitQuality
    mounting: Mounting | None
    delay_s: float | None


def check_conventions_of_file(path: Path) -> ConventionCheckResult:
    if path.suffix.lower() in TABLE_READERS:
        table = table_files.read_table(path)
        return check_conventions(describe_canonical(path, table), str(path), {path: table})
    return check_conventions(load_description(path), str(path))


def findings_if_load_is_suspicious(
    log: Log,
    load: Identification,
    predicted: Array,
    delay: float | None,
    check: Callable[[], ConventionCheckResult],
) -> tuple[Finding, ...]:
    """Return findings, except "lag", if mass, fit, delay [s], gravity or a signal is implausible.

    `predicted` (N, 6) is the wrench of offsets and load; `check` runs the checks. Raise
    DrakeTeleopError if the load is useless and a remedy is known.
    """
    if _is_wrench_constant(log):
        what = "the wrench is the same in all samples: no load can be identified"
        remedy = "check the sensor's cable; a driver may repeat its last value"
        raise DrakeTeleopError(what, where=log.source, remedy=remedy)
    unexplained = against_load.unexplained_share(log.wrench, log.wrench - predicted)
    weight = float(np.median(np.linalg.norm(log.specific_force, axis=1)))
    clocks = log.static or (delay is not None and abs(delay) < edits.MIN_LAG_OF_WRONG_CLOCK_S)
    if load.mass > 0 and unexplained < MAX_GOOD_RESIDUAL_SHARE and clocks and 5.0 < weight < 20.0:
        # A good fit may hide errors of the IMU, but `check` takes longer than the fit.
        return tuple(_findings_except_lag(check)) if _has_dead_channel_or_imu_finding(log) else ()
    found = _findings_except_lag(check)
    negative = load.mass < 0 and bool(load.identifiable[6])
    if any(finding.name == "payload" for finding in found):
        own = against_load.undetermined_payload_finding(load, unexplained)
        found = [own if own and f.name == "payload" else f for f in found]
        if negative:
            raise DrakeTeleopError(found[-1].message, where=log.source)
        return tuple(found)
    worthless = negative or unexplained > 0.5 or any(f.name == "units" for f in found)
    if worthless and (why := explain_lack_of_motion(log)) is not None:
        raise DrakeTeleopError(why, where=log.source, remedy=MORE_MOTION_REMEDY)
    if found and worthless:
        what = f"the fitted mass is {load.mass:.4g} kg"
        if not negative:
            what += f", and {100 * unexplained:.0f} % of the wrench's variance are left"
        raise DrakeTeleopError(f"{what}: {found[0].message}", where=log.source)
    if negative:
        sensor = "static" if log.static else "wrench"
        what = f"the fitted mass is {load.mass:.4g} kg: the sign of the wrench is probably inverted"
        remedy = "set `sign: -1` in the log description (or remove it if it is there)"
        raise DrakeTeleopError(what, where=f"{log.source}:{sensor}.sign", remedy=remedy)
    return tuple(found)


def motion_findings(check: Callable[[], ConventionCheckResult]) -> tuple[Finding, ...]:
    """Run the checks and return the findings on the described motion, not on the wrench."""
    return tuple(x for x in _findings_except_lag(check) if x.name in edits.MOTION_FINDINGS)


def _findings_except_lag(check: Callable[[], ConventionCheckResult]) -> list[Finding]:
    with suppress(ValueError, ArithmeticError):  # the log itself was readable
        return [finding for finding in check().findings if finding.name != "lag"]
    return []


def _has_dead_channel_or_imu_finding(log: Log) -> bool:
    if log.static or log.described is None or Path(log.source).suffix.lower() in TABLE_READERS:
        return False
    few = log.select_rows(slice(None, None, max(1, int(0.01 / log.dt))))
    if (np.ptp(few.wrench, axis=0) < 1e-9 * np.abs(few.wrench).max()).any():
        return True
    with suppress(ValueError, ArithmeticError):
        return bool(check_imu_signals(log.described, few)[0])
    return False


def check_conventions(
    description: Description, source: str, tables: dict[Path, Table] | None = None
) -> ConventionCheckResult:
    with one_blas_thread():
        found = _check_description(LogTables(description, source, dict(tables or {})), description)
    note = table_files.note_that_table_needs_description(source)
    findings = tuple(replace(f, message=f"{f.message}{note}") for f in found.findings)
    return replace(found, findings=findings)


def _is_wrench_constant(log: Log) -> bool:
    limit = _MIN_WRENCH_RANGE_OVER_MAGNITUDE * np.abs(log.wrench).max()
    return bool((np.ptp(log.wrench, axis=0) <= limit).all())


def _check_description(data: LogTables, description: Description) -> ConventionCheckResult:
    log = data.read_whole_log(description)
    if _is_wrench_constant(log):
        message = "the wrench is the same in all samples; check the sensor's cable and its driver"
        dead_wrench = Finding("dead channel", message)
        return ConventionCheckResult((dead_wrench,), LoadFitQuality(1.0, 0.0), None, None)
    # Determine gravity once, not for each edit.
    if "gravity" in log.estimated and log.described is not None:
        description = description.model_copy(update={"gravity": log.described.gravity})
    dead = _dead_or_repeated_channel_findings("imu", description, data.tables)
    broken = _dead_or_repeated_channel_findings("wrench", description, data.tables)
    if dead:  # A dead channel would cause wrong findings about motion and load.
        fit = against_load.fit_load(data.read_thinned_log(description))
        return ConventionCheckResult((*dead, *broken), fit, None, None)
    findings, description = edits.correct_accelerometer_unit(description, log)
    more, description = check_imu_signals(description, data.read_thinned_log(description))
    findings += more
    mounting = None
    moves = explain_lack_of_motion(data.read_thinned_log(description)) is None
    if description.imu and description.pose and moves:
        more, mounting, description = check_imu_against_pose(description, data)
        findings += more
    fit = against_load.fit_load(data.read_thinned_log(description))
    # The checks below require the weight of the load in the wrench.
    weightless = "weight" in log.estimated
    if broken or weightless or (mounting is not None and mounting.is_mirrored):
        return ConventionCheckResult((*broken, *findings), fit, mounting, None)
    if not findings and moves:
        more, description = against_load.clock_drift_finding_and_correction(description, data)
        findings += more
        lag = 0.0 if mounting is None else mounting.lag_s
        findings += position_unit_or_origin_findings(description, data, lag)
    more, delay = against_load.check_wrench_and_estimate_delay(description, data)
    findings = _merge_clock_findings(description, [*findings, *more], mounting, delay)
    findings += _static_pose_findings(log)
    return ConventionCheckResult(tuple(findings), fit, mounting, delay)


def _merge_clock_findings(
    description: Description, found: list[Finding], mounting: Mounting | None, delay: float | None
) -> list[Finding]:
    num_clocks = sum(finding.name == "clock" for finding in found)
    if num_clocks < 2 or mounting is None or mounting.clock_drift or delay is None:
        return found
    if abs(mounting.lag_s + delay) > edits.MIN_LAG_OF_WRONG_CLOCK_S:
        return found
    assert description.pose is not None
    text = f"the clock of the pose is {delay:.3f} s ahead of those of IMU and wrench"
    offset = description.pose.time.offset - delay
    finding = Finding("clock", f"{text}; set pose.time.offset: {offset:.3f}")
    return [finding, *(other for other in found if other.name != "clock")]


def _static_pose_findings(log: Log) -> list[Finding]:
    if not log.static:
        return []
    if len(log) < _MIN_STATIC_POSES_FOR_CHECK:
        remedy = "record 12 poses, rotated about two horizontal axes"
        text = f"{len(log)} poses at rest are too few to check the fit; {remedy}"
        return [Finding("static poses", text)]
    size = np.linalg.norm(log.specific_force, axis=1, keepdims=True)
    up = log.specific_force / np.maximum(size, 1e-9)
    least = float(np.linalg.svd(up - up.mean(axis=0), compute_uv=False)[-1]) / np.sqrt(len(up))
    if least >= _MIN_GRAVITY_DIRECTION_STD_RAD:
        return []
    text = (
        "the poses are too alike: along one direction gravity in S varies by only"
        f" {np.degrees(np.arcsin(least)):.2g} deg, which does not separate offsets from the load;"
        " add poses that are rotated by 45 deg or more about two horizontal axes"
    )
    return [Finding("static poses", text)]


_WRENCH_QUANTITIES = ("force", "torque")
_IMU_QUANTITIES = ("specific_force", "angular_velocity", "angular_acceleration")
_MIN_LIVE_CHANNEL_NOISE_OVER_RANGE = 1e-6


def _dead_or_repeated_channel_findings(
    stream: str, description: Description, tables: dict[Path, Table]
) -> list[Finding]:
    described = getattr(description, stream)
    found: list[Finding] = []
    used_by: dict[str, str] = {}
    if described is None:
        return found
    table = tables[described.source].rows_with_any_number(described.columns)
    for field in _WRENCH_QUANTITIES if stream == "wrench" else _IMU_QUANTITIES:
        quantity = getattr(described, field, None)
        if quantity is None:
            continue
        where = f"{stream}.{field}"
        if twice := _repeated_column_findings(where, quantity.columns, used_by):
            found += twice
            continue
        numbers: dict[str, Array] = {}
        for column in quantity.columns:
            x = table.numbers_with_nan(column, where).T
            parts = [f"{column}[{i}]" for i in range(len(x))] if len(x) > 1 else [str(column)]
            numbers |= zip(parts, x, strict=True)
        remedy = f"name another column in {where}.columns, or record again"
        text = "in all rows, but other channels vary: the channel is dead or not connected"
        for name in _dead_channels(numbers):
            value = f"{name!r} is {numbers[name][0]:.4g}"
            found.append(Finding("dead channel", f"{value} {text}; {remedy}"))
        text = "are the same in all rows: one was recorded twice"
        for (a, x), (b, y) in combinations(numbers.items(), 2):
            if np.ptp(x) > 0.0 and np.array_equal(x, y):
                found.append(Finding("repeated channel", f"{a!r} and {b!r} {text}; {remedy}"))
    return found


def _repeated_column_findings(where: str, columns: Any, used_by: dict[str, str]) -> list[Finding]:
    found = []
    for column, times in Counter(map(str, columns)).items():
        before = where if times > 1 else used_by.get(column)
        used_by[column] = where
        if before is not None:
            both = "twice" if before == where else f"in {before}.columns too"
            text = f"{where}.columns names {column!r} {both}: one number cannot be two channels"
            remedy = f"set {where}.columns to three different columns"
            found.append(Finding("repeated channel", f"{text}; {remedy}"))
    return found


def _dead_channels(numbers: dict[str, Array]) -> list[str]:
    x = np.stack(list(numbers.values()), axis=1)
    spread, noise = np.ptp(x, axis=0), white_noise_deviations(x)
    if not (noise > _MIN_LIVE_CHANNEL_NOISE_OVER_RANGE * spread).any():
        return []
    return [name for name, width in zip(numbers, spread, strict=True) if width == 0.0]
