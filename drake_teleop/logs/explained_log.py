"""Causes of a misfit in a log, corrected lines of its description, and the resulting load."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from drake_teleop.common.numeric import Array, find_runs_of_true
from drake_teleop.common.rotations import rotation_matrices
from drake_teleop.common.texts import parse_yaml
from drake_teleop.load.batch.uncertainty import WRENCH_CHANNEL_NAMES
from drake_teleop.load.identification import Identification, is_precise_enough
from drake_teleop.logs.causes.candidates import MAX_PLAUSIBLE_MASS_KG, has_negative_mass
from drake_teleop.logs.causes.cause import Finding
from drake_teleop.logs.causes.explain import (
    MisfitExplanation,
    explain_misfit,
    fit_with_missing_acceleration,
)
from drake_teleop.logs.causes.instants import AR_ORDER, BlockMeans, block_means_of_record
from drake_teleop.logs.causes.intervals import bias_of_load_by_alpha_noise
from drake_teleop.logs.pose_motion.estimate import PoseEstimate
from drake_teleop.logs.pose_motion.splines import PoseSplines, noise_share_passed_by_splines
from drake_teleop.logs.read.alignment import remove_delay
from drake_teleop.logs.read.auto_frames import block_means_of_log
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.description import Description
from drake_teleop.logs.read.description_fields import SI_VALUE_OF_UNIT
from drake_teleop.logs.read.table_files import note_that_table_needs_description

DescriptionFields = dict[str, Any]
"""Values of the correctable fields, by their names in a description."""
_UNIT_RATIO_TOLERANCE = 1e-3
# Not units such as daN, whose ratio to another unit is a power of ten, as that of raw counts.
_TRIED_FORCE_UNITS = ("N", "kgf", "lbf")
_TRIED_TORQUE_UNITS = ("N m", "N cm", "N mm", "kgf cm", "lbf in", "lbf ft")
_POSITION_FIELDS = ("pose.position_in_sensor", "imu.position")
_ROTATION_FIELDS = ("pose.rotation_in_sensor", "pose.frame", "imu.frame")
_DECIMALS_OF_FIELD = {"gravity": 4, _POSITION_FIELDS[0]: 5, _POSITION_FIELDS[1]: 5}
_REMEDY_OF_CAUSE_WITHOUT_FIELD = {
    "axes": "correct the columns of wrench.force and wrench.torque",
    "sensor rotation": "correct the mounting or the frame of the pose",
    "pose frame": "add the position to pose, or an accelerometer",
}


def add_corrected_fields(
    causes: Sequence[Finding], log: Log, *, by_pose: bool
) -> tuple[Finding, ...]:
    """Return causes with corrected YAML fields; `by_pose`: poses, not an IMU, give the motion."""
    fields, changed_names = _corrected_fields_and_changed_names(causes, log, by_pose)
    note, out = note_that_table_needs_description(log.source), []
    for cause, names in zip(causes, changed_names, strict=True):
        lines = {name: _yaml_value(name, fields[name]) for name in names}
        text = f"set {' and '.join(f'{k}: {x}' for k, x in lines.items())}{note}"
        text = text if lines else _REMEDY_OF_CAUSE_WITHOUT_FIELD.get(cause.name, "")
        message = f"{cause.message}; {text}" if text else cause.message
        corrected = {name: parse_yaml(line, name) for name, line in lines.items()}
        out.append(replace(cause, message=message, fields=corrected))
    return tuple(out)


def implausible_mass_message(mass: float, causes: Sequence[Finding], log: Log) -> str | None:
    """Return a message on units for a described log and a mass of 1000 kg or more, else None."""
    if abs(mass) < MAX_PLAUSIBLE_MASS_KG or log.described is None or log.described.wrench is None:
        return None
    fields = _corrected_fields_and_changed_names(causes, log, by_pose=True)[0]
    force, torque = fields["wrench.force.scale"], fields["wrench.torque.scale"]
    likely = force * 10.0 ** -round(np.log10(abs(mass)))
    return (
        f"a mass of {mass:.3g} kg is implausible: the force is probably not in"
        f" {log.described.wrench.force.unit}; set wrench.force.scale to the value of one unit of"
        f" the file (a load of a few kg is given by {_yaml_value('wrench.force.scale', likely)})"
        f" and wrench.torque.scale to {_yaml_value('wrench.torque.scale', torque / force)} times"
        " that"
        f"{note_that_table_needs_description(log.source)}"
    )


def _corrected_fields_and_changed_names(
    causes: Sequence[Finding], log: Log, by_pose: bool
) -> tuple[DescriptionFields, list[list[str]]]:
    assert log.described is not None
    fields = _correctable_fields(log.described, by_pose)
    column = _wrench_column_of_each_axis(fields["wrench.frame"])
    changed_names: list[list[str]] = []
    for cause in causes:
        before = {name: _yaml_value(name, value) for name, value in fields.items()}
        _correct_fields_by_cause(fields, cause.name, cause.values, column)
        changed_names.append([k for k, x in before.items() if _yaml_value(k, fields[k]) != x])
    return fields, changed_names


def _correctable_fields(description: Description, by_pose: bool) -> DescriptionFields:
    wrench, imu, pose = description.wrench, description.imu, description.pose
    assert wrench is not None
    frame: Any = np.eye(3) if wrench.frame == "sensor" else wrench.frame
    weight: Any = (0.0, 0.0, 0.0, 0.0) if wrench.weight is None else wrench.weight
    out: DescriptionFields = {
        "wrench.sign": wrench.sign,
        "wrench.frame": frame if isinstance(frame, str) else np.array(frame),
        "wrench.force.scale": np.array(wrench.force.scale),
        "wrench.torque.scale": np.array(wrench.torque.scale),
        "wrench.force.unit": wrench.force.unit,
        "wrench.torque.unit": wrench.torque.unit,
        "wrench.weight": weight if isinstance(weight, str) else np.array(weight),
        "gravity": description.gravity_W,
    }
    for name in ("wrench", "imu", "pose"):
        if (stream := getattr(description, name)) is not None:
            out[f"{name}.time.scale"] = np.array(stream.time.scale)
    if imu is not None and imu.specific_force is not None and not by_pose:
        out["imu.position"] = np.array(imu.position)
    elif pose is not None and pose.position is not None:
        out["pose.position_in_sensor"] = np.array(pose.position_in_sensor)
    if wrench.frame == "base":
        return out
    if pose is not None:
        name = "rotation_in_sensor" if pose.frame == "sensor" else "frame"
        out[f"pose.{name}"] = np.eye(3) if pose.R_SP is None else pose.R_SP
    if imu is not None and imu.frame != "base":
        out["imu.frame"] = np.eye(3) if imu.frame == "sensor" else np.array(imu.frame)
    return out


def _wrench_column_of_each_axis(frame: Any) -> list[int] | None:
    if isinstance(frame, str) or (np.abs(frame).max(axis=1) < 1.0 - 1e-6).any():
        return None
    return [int(j) for j in np.abs(frame).argmax(axis=1)]


def _yaml_value(name: str, value: Any) -> str:
    if isinstance(value, (str, int)):
        return str(value)
    if name in ("wrench.frame", "imu.frame") and np.allclose(value, np.eye(3), atol=1e-6):
        return "sensor"
    if name.endswith(".scale"):
        factors = [f"{x:.6g}" for x in np.atleast_1d(value)]
        return factors[0] if len(set(factors)) == 1 else f"[{', '.join(factors)}]"
    exact = np.round(value, _DECIMALS_OF_FIELD.get(name, 6)) + 0.0
    return str((exact.astype(int) if (exact == np.round(exact)).all() else exact).tolist())


def _correct_fields_by_cause(
    fields: DescriptionFields, cause: str, values: dict[str, Any], column: list[int] | None
) -> None:
    match cause:
        case "axes":
            _correct_wrench_sign_and_frame(fields, np.array(values["matrix"]))
        case "sensor rotation":
            R = Rotation.from_rotvec(values["rotation_vector"]).as_matrix()
            for name in {*_ROTATION_FIELDS, *_POSITION_FIELDS} & set(fields):
                fields[name] = R @ fields[name]
        case "gravity direction":
            true = np.array(values["gravity"])
            fields["gravity"] = true * np.linalg.norm(fields["gravity"]) / np.linalg.norm(true)
        case "weight removed" | "payload configured":  # an estimated payload would count as exact
            fields["wrench.weight"] = "removed"
        case "clock rate":
            for name in [x for x in fields if x.endswith(".time.scale")]:
                fields[name] = fields[name] / values["ratio"]
        case "torque factor":
            _correct_wrench_unit_or_torque_scale(fields, values["factor"])
        case "pose frame":
            for name in set(_POSITION_FIELDS) & set(fields):
                fields[name] = fields[name] + values["position_in_sensor"]
        case "gain" if column is not None:
            c = WRENCH_CHANNEL_NAMES.index(values["channel"])
            name = "wrench.force.scale" if c < 3 else "wrench.torque.scale"
            fields[name] = fields[name].copy()
            fields[name][column[c % 3]] /= values["gain"]


def _correct_wrench_sign_and_frame(fields: DescriptionFields, axes: Array) -> None:
    sign = 1 if np.linalg.det(axes) > 0.0 else -1
    base = isinstance(fields["wrench.frame"], str)
    if base and not (sign * np.eye(3) == axes).all():
        return
    fields["wrench.sign"] = sign * fields["wrench.sign"]
    if not base:
        fields["wrench.frame"] = sign * axes.T @ fields["wrench.frame"]


def _correct_wrench_unit_or_torque_scale(fields: DescriptionFields, torque_factor: float) -> None:
    force = SI_VALUE_OF_UNIT[fields["wrench.force.unit"]]
    torque = SI_VALUE_OF_UNIT[fields["wrench.torque.unit"]]
    ratios = [(torque / SI_VALUE_OF_UNIT[u], "wrench.torque.unit", u) for u in _TRIED_TORQUE_UNITS]
    ratios += [(SI_VALUE_OF_UNIT[u] / force, "wrench.force.unit", u) for u in _TRIED_FORCE_UNITS]
    for ratio, name, unit in ratios:
        if unit != fields[name] and abs(torque_factor / ratio - 1.0) < _UNIT_RATIO_TOLERANCE:
            fields[name] = unit
            return
    fields["wrench.torque.scale"] = fields["wrench.torque.scale"] / torque_factor


_SPLINE_END_MARGIN_OVER_KNOT_SPACING = 2.0  # knots, at either end
_MIN_BLOCK_MEANS_TO_EXPLAIN, _BLOCK_MEAN_BANDWIDTH_HZ = 50, 25.0
_MAX_GYROSCOPE_GAIN_ERROR = 0.005
_MIN_STD_RATIO_TO_WIDEN = 1.5  # ratio of block to stated deviations that widens the intervals


def explain_log(log: Log, delay_s: float, motion: PoseEstimate | None) -> MisfitExplanation | None:
    """Return causes why a rigid load does not explain the wrench of a log; None for a short log.

    The motion, without its delay `delay_s` [s], is from the splines of `motion`, else the log.
    """

    clock_rate: str | None = "clock rate of poses"
    if log.has_calendar_time or (motion and _does_gyroscope_agree_with_poses(log, motion.splines)):
        clock_rate = None

    def means_at_additional_delay(more_s: float) -> BlockMeans:
        if motion is not None:
            means = _block_means_of_splines(log, motion, delay_s + more_s)
            return replace(means, clock_rate=clock_rate)
        return block_means_of_log(remove_delay(log, delay_s + more_s))

    data = means_at_additional_delay(0.0)
    lengths = np.diff(find_runs_of_true(data.used)) - AR_ORDER  # rows with predecessors
    if lengths[lengths > 0].sum() < _MIN_BLOCK_MEANS_TO_EXPLAIN:
        return None
    misfit = explain_misfit(data, means_at_additional_delay, log.estimated)
    misfit = fit_with_missing_acceleration(misfit) if misfit.is_acceleration_missing else misfit
    if log.described is None:
        return misfit
    return replace(misfit, causes=add_corrected_fields(misfit.causes, log, by_pose=bool(motion)))


def _block_means_of_splines(log: Log, motion: PoseEstimate, delay_s: float) -> BlockMeans:
    assert log.posed is not None
    splines, gravity = motion.splines, log.posed.gravity_W
    middle = np.mean(log.posed.poses.position, axis=0)

    def motion_at(t: Array) -> tuple[Array, ...]:
        q = splines.quaternion(t + delay_s)
        q /= np.linalg.norm(q, axis=1, keepdims=True)
        p = splines.position(t + delay_s) - middle
        return *splines.motion(t + delay_s, gravity)[:3], rotation_matrices(q, "quaternion_wxyz"), p

    stamps, margin = splines.poses.t, _SPLINE_END_MARGIN_OVER_KNOT_SPACING * splines.spacing
    at = log.t + delay_s
    lost = (at < stamps[0] + margin) | (at > stamps[-1] - margin)
    lost |= (log.t < log.t[0] + margin) | (log.t > log.t[-1] - margin)
    if log.bridged is not None:
        lost |= log.bridged
    noise = _acceleration_noise_of_splines_m_s2(splines)
    return block_means_of_record(log.t, log.wrench, motion_at, gravity, lost, noise)


def _does_gyroscope_agree_with_poses(log: Log, splines: PoseSplines) -> bool:
    imu = None if log.posed is None else log.posed.imu
    if imu is None or imu.angular_velocity is None:
        return False
    omega = splines.motion(imu.t, np.zeros(3))[1]
    ratio = np.sqrt(imu.angular_velocity.var(axis=0).sum() / (omega.var(axis=0).sum() + 1e-30))
    return bool(abs(ratio - 1.0) < _MAX_GYROSCOPE_GAIN_ERROR)


def _acceleration_noise_of_splines_m_s2(splines: PoseSplines) -> float:
    f = np.linspace(0.0, _BLOCK_MEAN_BANDWIDTH_HZ, 500)
    share = noise_share_passed_by_splines(f, splines.spacing)
    if splines.imu_rows is not None:
        share = share * splines.imu_rows.pose_noise_shares_left_by_imu(f)[0]
    density = 2.0 * splines.estimate_pose_noise()[0] ** 2 / splines.rate
    return float(np.sqrt(np.trapezoid(density * share * (2.0 * np.pi * f) ** 4, f)))


def apply_explanation_to_load(load: Identification, misfit: MisfitExplanation) -> Identification:
    """Return the load fitted with the causes, or `load`, with wider intervals for a misfit."""
    if misfit.causes or misfit.always_fitted or misfit.is_acceleration_missing:
        load = _replace_load_by_causes_fit(load, misfit)
    elif not misfit.explained and load.identifiable.any():
        stated = np.sqrt(np.diag(load.covariance))
        ratio = np.maximum(1.0, misfit.misfit_deviations / np.maximum(stated, 1e-300))
        ratio = np.where(load.identifiable, ratio, 1.0)
        if np.sqrt(np.mean(ratio[load.identifiable] ** 2)) >= _MIN_STD_RATIO_TO_WIDEN:
            factors = np.where(np.eye(16) > 0, ratio**2, np.outer(ratio, ratio))
            load = _replace_covariance_of_load(load, load.covariance * factors)
    if misfit.fit.means.gravity_W is not None:
        return load
    extra = bias_of_load_by_alpha_noise(misfit.fit)
    share = misfit.fit.means.alpha_noise_share
    extra[10:] = np.hypot(extra[10:], share * np.abs(load.phi[[4, 7, 9]]).max())
    return _replace_covariance_of_load(load, load.covariance + np.diag(extra**2))


def add_errors_of_load(load: Identification, errors: Array) -> Identification:
    """Return `load` with the squares of `errors` (10,) added to the variances of phi."""
    variances = np.append(np.zeros(6), errors**2)
    return _replace_covariance_of_load(load, load.covariance + np.diag(variances))


def _replace_covariance_of_load(load: Identification, covariance: Array) -> Identification:
    known = load.identifiable & is_precise_enough(np.sqrt(np.diag(covariance)), load.phi)
    return replace(load, covariance=covariance, identifiable=known)


def _replace_load_by_causes_fit(load: Identification, misfit: MisfitExplanation) -> Identification:
    identifiable = is_precise_enough(np.sqrt(np.diag(misfit.covariance)), misfit.theta[6:])
    no_load = bool(misfit.causes) and misfit.causes[0].name == "no load"
    if no_load or has_negative_mass(misfit.fit):
        identifiable = np.repeat([True, False], [6, 10])
    if misfit.needs_crosstalk_calibration:
        identifiable = np.zeros(16, bool)
    return replace(
        load,
        phi=misfit.theta[6:],
        offsets=misfit.theta[:6],
        covariance=misfit.covariance,
        identifiable=identifiable,
        residual_rms=misfit.fit.rows.residual_rms(misfit.fit.residual),
        weight_removed=any(cause.name == "weight removed" for cause in misfit.causes)
        or "weight" in misfit.always_fitted,
        prior_dominated=np.zeros(16, bool),
        degrees_of_freedom=np.full(16, np.inf),
        method="least squares without acceleration"
        if misfit.is_acceleration_missing
        else "generalised least squares with named causes",
    )


def use_pose_frame_finding(misfit: MisfitExplanation, finding: Finding) -> tuple[Finding, ...]:
    """Return the causes; `finding` on the pose frame replaces them if no other term is fitted."""
    if misfit.fit.model.extensions and set(misfit.fit.model.extensions) <= {"frame", "rotation"}:
        kept = [x for x in misfit.causes if x.name not in ("pose frame", "sensor rotation")]
        return (finding, *kept)
    return misfit.causes


def misfit_finding(misfit: MisfitExplanation, corrections: Sequence[Finding]) -> Finding:
    """Return the finding of a misfit that none of the fitted `corrections` explains."""
    ratio = misfit.fit.residual_ratio
    text = f"the residual is up to {ratio:.0f} times the sensor's noise"
    remedy = "record without contact, with the same load throughout and with loose cables"
    if corrections:
        return Finding("misfit", f"{text}, and {check_request(corrections[0])}; or {remedy}")
    return Finding("misfit", f"{text}, and no known cause explains it; {remedy}")


def check_request(correction: Finding) -> str:
    """Return a text that requests a check of a correction that explains a part."""
    text = correction.message.partition("; set ")[0].partition("; correct ")[0]
    return f"no single correction explains the record; check whether {text}"


def missing_acceleration_finding(misfit: MisfitExplanation) -> Finding:
    ratio = misfit.fit.residual_ratio
    text = (
        f"the residual is up to {ratio:.0f} times the sensor's noise, and without accelerometer or"
        " position the acceleration of S may cause it: the delay, the unit of the torque and the"
        " pose frame cannot be checked"
    )
    return Finding("acceleration", f"{text}; add the position to pose, or an accelerometer")


def removed_weight_note(misfit: MisfitExplanation) -> str:
    if "weight" not in misfit.always_fitted:
        return ""
    (mass, *moment), covariance = misfit.fit.parameters_of_extension("weight")
    deviation = float(np.sqrt(covariance[0, 0]))
    com = ", ".join(f"{1e3 * x / mass:.3g}" for x in moment) if mass else "0, 0, 0"
    return (
        f"the weight that is removed from the wrench is that of {mass:.4g} kg"
        f" (+- {1.96 * deviation:.2g}) at [{com}] mm in S"
    )
