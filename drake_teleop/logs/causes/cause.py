"""Findings about a log, and texts of the causes of a misfit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.numeric import Array
from drake_teleop.common.rotations import axis_names_of_rows
from drake_teleop.load.batch.uncertainty import WRENCH_CHANNEL_NAMES
from drake_teleop.load.identification import is_precise_enough
from drake_teleop.load.inertia import mass_com_inertia
from drake_teleop.logs.causes import candidates
from drake_teleop.logs.causes.candidates import fits_with_other_torque_units
from drake_teleop.logs.causes.fitted_model import FittedModel
from drake_teleop.logs.causes.model import CLOCK_RATE_EXPONENTS

_MAX_HAND_CONTACT_TO_STEP_S, _MAX_HAND_CONTACT_DURATION_S = 0.8, 1.2
CHANGE_CAUSES = ("zero change", "load change")  # they divide a record into parts
CAUSES_WITHOUT_CORRECTION = (*CHANGE_CAUSES, "drift", "contact", "cable", "no load")
"""Causes that no line of a description corrects."""
CAUSES_DETERMINED_AT_REST = ("zero change", "drift", "contact")  # that a record at rest determines


@dataclass(frozen=True)
class Finding:
    """Suspicious property of a log, or reason why a rigid load does not explain its wrench.

    Attributes:
        name: category for programs, such as "units", "axes" or "load change".
        message: observation or cause, value with its interval, and remedy.
        start_s, stop_s: time span on the clock of the log [s]; None: unlimited.
        values: numbers by name, in SI; `angle_deg` in [deg].
        fields: corrected values of fields of the log description, as in YAML.
    """

    name: str
    message: str
    start_s: float | None = None
    stop_s: float | None = None
    values: dict[str, object] = field(default_factory=dict)
    fields: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class RecordPartWithLoad:
    """Part of a record with constant load phi (10,); `covariance` (16, 16) of [offsets; phi]."""

    start_s: float
    stop_s: float
    phi: Array
    covariance: Array

    @property
    def identifiable(self) -> NDArray[np.bool_]:
        """Flags (16,): True for sufficiently precise parameters of [offsets; phi]."""
        return is_precise_enough(np.sqrt(np.diag(self.covariance)), self.phi)


def list_misfit_causes(fit: FittedModel, always_fitted: tuple[str, ...] = ()) -> list[Finding]:
    model, out = fit.model, []
    if not (model.axes == np.eye(3)).all():
        out.append(_wrong_axes_cause(model.axes))
    named = [name for name in model.extensions if name not in ("torque factor", *always_fitted)]
    out += [_cause_of_extension(fit, name) for name in named]
    if model.torque_factor != 1.0:
        out.append(_torque_factor_cause(fit))
    out += [_gain_error_cause(fit, c) for c in model.gain_channels]
    changes = [_cause_of_ith_offset_or_load_step(fit, i) for i in range(len(model.steps))]
    changes += _contact_causes(fit)
    return out + sorted(changes, key=lambda x: x.start_s or 0.0)


def loads_between_changes(fit: FittedModel, covariance: Array) -> list[RecordPartWithLoad]:
    """Return the parts of a record between load changes; [] without a change."""
    loads = [(s.time, i) for i, s in enumerate(fit.model.steps) if s.kind == "load"]
    if not loads:
        return []
    ratio = np.sqrt(np.diag(covariance) / np.diag(fit.covariance)[:16])
    selection = np.eye(16, fit.model.size)
    out, start = [], float(fit.means.t[0])
    for time, i in [*sorted(loads), (float(fit.means.t[-1]), -1)]:
        spread = selection @ fit.covariance @ selection.T * np.outer(ratio, ratio)
        out.append(RecordPartWithLoad(start, time, (selection @ fit.x)[6:], spread))
        if i >= 0:
            selection[6:, fit.model.parameter_slices[f"step {i}"]] = np.eye(10)
        start = time
    return out


def _format_vector(x: Array, unit: str, digits: str = ".3g") -> str:
    return f"[{', '.join(format(float(v), digits) for v in x)}] {unit}"


def _wrong_axes_cause(axes: Array) -> Finding:
    rows = axis_names_of_rows(axes)
    what = f"the axes x, y, z of the wrench are {', '.join(rows)} of the motion"
    if (-np.eye(3) == axes).all():
        what = "the wrench has the opposite sign"
    return Finding("axes", what, values={"axes": rows, "matrix": axes.tolist()})


def _cause_of_extension(fit: FittedModel, extension: str) -> Finding:
    x, covariance = fit.parameters_of_extension(extension)
    wide = 1.96 * np.sqrt(np.diag(covariance))
    values: dict[str, object]
    match extension:
        case "gravity":
            true, angle, _ = candidates.compare_gravity_with_description(fit)
            name, values = "gravity direction", {"angle_deg": angle, "gravity": true.tolist()}
            text = (
                f"gravity is {angle:.2f} deg (+- {1.96 * direction_std_deg(true, covariance):.2g})"
                " off the described direction in the base of the arm"
            )
        case "weight":
            return _removed_weight_cause(fit)
        case _ if extension in CLOCK_RATE_EXPONENTS:
            return _clock_rate_cause(fit, extension)
        case "frame":
            name, values = "pose frame", {"position_in_sensor": (-x).tolist()}
            text = (
                f"the pose is that of a point at {_format_vector(-1e3 * x, 'mm in S')}"
                f" (+- {1e3 * wide.max():.2g} mm), not of the sensor"
            )
        case "rotation":
            name, values = "sensor rotation", {"rotation_vector": x.tolist()}
            angle = float(np.linalg.norm(x))
            text = (
                f"the sensor is rotated by {np.degrees(angle):.2f} deg"
                f" (+- {np.degrees(wide.max()):.2g}) relative to the motion's frame, about"
                f" {_format_vector(x / (angle + 1e-12), 'in S', '.2f')}"
            )
        case "cable":
            stiffness = candidates.fitted_max_cable_stiffness_n_m(fit)
            name, values = "cable", {"stiffness": stiffness}
            text = (
                "a force that depends on the position acts on the load (about"
                f" {stiffness:.2g} N/m), probably of a cable or hose; guide it so that it is slack"
            )
        case _:
            size = 2.0 * candidates.drift_amplitudes(fit)
            name, values = "drift", {"range": size.tolist()}
            text = (
                f"the offsets drift by up to {size[:3].max():.2g} N and {size[3:].max():.2g} N m"
                " within the record; the stated offsets are their means: let the sensor warm up"
            )
    return Finding(name, text, values=values)


def direction_std_deg(x: Array, covariance: Array) -> float:
    """Return the largest standard deviation [deg] of the direction of x (3,) with a covariance."""
    size = float(np.linalg.norm(x))
    across = np.eye(3) - np.outer(x, x) / size**2
    spread = float(np.linalg.eigvalsh(across @ covariance @ across)[-1])
    return float(np.degrees(np.sqrt(spread) / size))


def _removed_weight_cause(fit: FittedModel) -> Finding:
    removed, covariance = fit.parameters_of_extension("weight")
    deviation, own = float(np.sqrt(covariance[0, 0])), float(np.sqrt(fit.covariance[6, 6]))
    mass = float(fit.x[6])
    values = {"removed_mass": float(removed[0]), "removed_moment": removed[1:].tolist()}
    if abs(removed[0] - mass) < 0.02 * mass + 4.0 * np.hypot(deviation, own):
        text = (
            "the weight is already removed from the wrench, and the inertia of"
            f" {mass:.4g} kg (+- {1.96 * own:.2g}) remains"
        )
        return Finding("weight removed", text, values=values)
    com = removed[1:] / removed[0] if removed[0] else np.zeros(3)
    text = (
        f"the weight of a payload of {removed[0]:.4g} kg (+- {1.96 * deviation:.2g}) at"
        f" {_format_vector(1e3 * com, 'mm in S')} is already removed from the wrench, but the"
        f" inertia is that of {mass:.4g} kg: the payload in the robot's controller is not that of"
        " the load"
    )
    return Finding("payload configured", text, values=values)


def _clock_rate_cause(fit: FittedModel, extension: str) -> Finding:
    ratio, deviation = candidates.time_step_ratio_and_std(fit, extension)
    text = (
        f"the time steps of the record are {ratio:.4g} (+- {1.96 * deviation:.2g}) times those with"
        " which a rigid load explains the wrench: unit or rate of the clock is probably wrong"
    )
    if extension == "clock rate of poses" and ratio > 1.0:
        mass = ratio**2 * float(fit.x[6])
        text += (
            f"; just as possible: the inertia is that of {mass:.4g} kg, and the weight of a payload"
            f" of {mass - fit.x[6]:.4g} kg with the same centre of mass is already removed from"
            " the wrench (set wrench.weight: removed)"
        )
    return Finding("clock rate", text, values={"ratio": ratio})


def _torque_factor_cause(fit: FittedModel) -> Finding:
    factor = fit.model.torque_factor
    if factor == -1.0:
        what = "the torque has the opposite sign"
    else:
        what = f"the torque is {factor:.6g} times the value that fits the force"
        if others := [other.model.torque_factor for other in fits_with_other_torque_units(fit)]:
            listed = " or ".join(f"{x:.6g}" for x in others)
            what += f" (or {listed} times, which the record does not exclude)"
    return Finding("torque factor", f"{what}: a unit or sign is wrong", values={"factor": factor})


def _gain_error_cause(fit: FittedModel, channel_index: int) -> Finding:
    value, covariance = fit.parameters_of_extension(f"gain {channel_index}")
    channel, wide = WRENCH_CHANNEL_NAMES[channel_index], 1.96 * float(np.sqrt(covariance[0, 0]))
    text = (
        f"{channel} reads {100 * value[0]:.2f} % (+- {100 * wide:.2g}) more than expected from the"
        " other channels; calibrate the sensor"
    )
    return Finding("gain", text, values={"channel": channel, "gain": 1.0 + float(value[0])})


def _cause_of_ith_offset_or_load_step(fit: FittedModel, i: int) -> Finding:
    step, (x, covariance) = fit.model.steps[i], fit.parameters_of_extension(f"step {i}")
    when = f"from t = {step.time:.2f} s on"
    values: dict[str, object] = {"change": x.tolist()}
    if step.kind == "offsets":
        text = (
            f"{when} the sensor has another zero: {_format_vector(x[:3], 'N')},"
            f" {_format_vector(x[3:], 'N m')} are added (a tare in the record); the stated"
            " offsets are those before it; do not tare within a record"
        )
        return Finding("zero change", text, start_s=step.time, values=values)
    mass, com = float(x[0]), mass_com_inertia(x)[1] if x[0] else np.zeros(3)
    wide = 1.96 * float(np.sqrt(covariance[0, 0]))
    text = (
        f"{when} there is another load: {abs(mass):.4g} kg (+- {wide:.2g}) at"
        f" {_format_vector(1e3 * com, 'mm in S')} are {'added' if mass > 0.0 else 'removed'}; the"
        " load is given for each part"
    )
    values = {"mass_change": mass, "com_of_change": np.asarray(com).tolist()}
    return Finding("load change", text, start_s=step.time, values=values)


def _contact_causes(fit: FittedModel) -> Iterator[Finding]:
    dt = fit.means.dt  # one row more than the contact is omitted at both ends
    for a, b in fit.contact_spans:
        first, last = a - _MAX_HAND_CONTACT_TO_STEP_S, b + _MAX_HAND_CONTACT_TO_STEP_S
        changes_load = any(first < time < last for time in fit.model.step_times)
        if changes_load and b - a < _MAX_HAND_CONTACT_DURATION_S:
            continue  # the hand that changes the load
        start, stop = a + dt, b - dt
        text = (
            f"from t = {start:.2f} to {stop:.2f} s the load is in contact or the sensor is"
            " saturated; this part is not used"
        )
        yield Finding("contact", text, start_s=start, stop_s=stop)
