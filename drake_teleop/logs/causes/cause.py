"""Causes of a misfit in words: name, time span, and value with its interval."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.numeric import Array
from drake_teleop.common.rotations import axis_names_of_rows
from drake_teleop.load.batch.uncertainty import CHANNEL_NAMES
from drake_teleop.load.identification import is_precise_enough
from drake_teleop.load.inertia import mass_com_inertia
from drake_teleop.logs.causes import candidates
from drake_teleop.logs.causes.candidates import fits_with_other_torque_units
from drake_teleop.logs.causes.state import FittedModel

_MAX_HAND_CONTACT_TO_STEP_S, _MAX_HAND_CONTACT_DURATION_S = 0.8, 1.2
CHANGE_CAUSES = ("zero change", "load change")  # they divide a record into parts
CAUSES_WITHOUT_CORRECTION = (*CHANGE_CAUSES, "drift", "contact", "cable", "no load")
"""Causes that no line of a description corrects."""


@dataclass(frozen=True)
class Cause:
    """Reason why a rigid load with constant offsets does not explain a wrench.

    Attributes:
        name: such as "axes", "gravity direction", "load change" or "cable".
        message: cause, value with its interval, and remedy.
        start_s, stop_s: time span on the clock of the log [s]; None: unlimited.
        values: figures by name, in SI; `angle_deg` in [deg].
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
        return is_precise_enough(np.sqrt(np.diag(self.covariance)), self.phi)


def causes_of_fit(state: FittedModel, always_fitted: tuple[str, ...] = ()) -> list[Cause]:
    model, out = state.model, []
    if not (model.axes == np.eye(3)).all():
        out.append(_wrong_axes_cause(model.axes))
    makers = {
        "gravity": _gravity_direction_cause,
        "weight": _removed_weight_cause,
        "frame": _pose_frame_cause,
        "rotation": _sensor_rotation_cause,
        "cable": _cable_cause,
        "linear drift": _drift_cause,
        "drift": _drift_cause,
    }
    named = [name for name in model.extensions if name in makers and name not in always_fitted]
    out += [makers[name](state) for name in named]
    if model.torque_factor != 1.0:
        out.append(_torque_factor_cause(state))
    out += [_gain_error_cause(state, c) for c in model.gain_channels]
    changes = [_offset_or_load_step_cause(state, i) for i in range(len(model.steps))]
    margin = state.data.dt  # one row more than the contact is omitted at both ends
    changes += [
        _contact_cause(start + margin, stop - margin)
        for start, stop in state.contact_spans
        if not _is_hand_contact((start, stop), model.step_times)
    ]
    return out + sorted(changes, key=lambda x: x.start_s or 0.0)


def loads_between_changes(state: FittedModel, covariance: Array) -> list[RecordPartWithLoad]:
    """Return the parts of a record between load changes, with their loads; [] without a change."""
    loads = [(s.time, i) for i, s in enumerate(state.model.steps) if s.kind == "load"]
    if not loads:
        return []
    ratio = np.sqrt(np.diag(covariance) / np.diag(state.covariance)[:16])
    selection = np.eye(16, state.model.size)
    out, start = [], float(state.data.t[0])
    for time, i in [*sorted(loads), (float(state.data.t[-1]), -1)]:
        spread = selection @ state.covariance @ selection.T * np.outer(ratio, ratio)
        out.append(RecordPartWithLoad(start, time, (selection @ state.x)[6:], spread))
        if i >= 0:
            selection[6:, state.model.parameter_slices[f"step {i}"]] = np.eye(10)
        start = time
    return out


def _format_vector(x: Array, unit: str, digits: str = ".3g") -> str:
    return f"[{', '.join(format(float(v), digits) for v in x)}] {unit}"


def _wrong_axes_cause(Q: Array) -> Cause:
    rows = axis_names_of_rows(Q)
    what = f"x, y, z of the wrench are {', '.join(rows)} of the motion"
    if (-np.eye(3) == Q).all():
        what = "the wrench has the opposite sign"
    return Cause("axes", what, values={"axes": rows, "matrix": Q.tolist()})


def _gravity_direction_cause(state: FittedModel) -> Cause:
    true, angle, _ = candidates.estimated_gravity_tilt_deg_and_size_ratio(state)
    wide = direction_std_deg(true, state.parameters_of_extension("gravity")[1])
    text = (
        f"gravity is {angle:.2f} deg (+- {1.96 * wide:.2g}) off the described direction in the base"
        " of the arm"
    )
    return Cause("gravity direction", text, values={"angle_deg": angle, "gravity": true.tolist()})


def direction_std_deg(x: Array, covariance: Array) -> float:
    """Return the largest standard deviation of the direction of a vector x (3,) [deg]."""
    size = float(np.linalg.norm(x))
    across = np.eye(3) - np.outer(x, x) / size**2
    spread = float(np.linalg.eigvalsh(across @ covariance @ across)[-1])
    return float(np.degrees(np.sqrt(spread) / size))


def _removed_weight_cause(state: FittedModel) -> Cause:
    removed, covariance = state.parameters_of_extension("weight")
    deviation = float(np.sqrt(covariance[0, 0]))
    mass = float(state.x[6])
    own = float(np.sqrt(state.covariance[6, 6]))
    values = {"removed_mass": float(removed[0]), "removed_moment": removed[1:].tolist()}
    if abs(removed[0] - mass) < 0.02 * mass + 4.0 * np.hypot(deviation, own):
        text = (
            "the weight is already removed from the wrench, and the inertia of"
            f" {mass:.4g} kg (+- {1.96 * own:.2g}) remains"
        )
        return Cause("weight removed", text, values=values)
    com = removed[1:] / removed[0] if removed[0] else np.zeros(3)
    text = (
        f"the weight of a payload of {removed[0]:.4g} kg (+- {1.96 * deviation:.2g}) at"
        f" {_format_vector(1e3 * com, 'mm in S')} is already removed from the wrench, but the"
        f" inertia is that of {mass:.4g} kg: the payload in the robot's controller is not that of"
        " the load"
    )
    return Cause("payload configured", text, values=values)


def _torque_factor_cause(state: FittedModel) -> Cause:
    factor = state.model.torque_factor
    if factor == -1.0:
        what = "the torque has the opposite sign"
    else:
        what = f"the torque is {factor:.6g} times the value that fits the force"
        if others := [other.model.torque_factor for other in fits_with_other_torque_units(state)]:
            listed = " or ".join(f"{x:.6g}" for x in others)
            what += f" (or {listed} times, which the record does not exclude)"
    return Cause("torque factor", f"{what}: its unit or sign is wrong", values={"factor": factor})


def _gain_error_cause(state: FittedModel, c: int) -> Cause:
    value, covariance = state.parameters_of_extension(f"gain {c}")
    wide = 1.96 * float(np.sqrt(covariance[0, 0]))
    text = (
        f"{CHANNEL_NAMES[c]} reads {100 * value[0]:.2f} % (+- {100 * wide:.2g}) more than the other"
        " channels allow; calibrate the sensor"
    )
    return Cause("gain", text, values={"channel": CHANNEL_NAMES[c], "gain": 1.0 + float(value[0])})


def _pose_frame_cause(state: FittedModel) -> Cause:
    r, covariance = state.parameters_of_extension("frame")
    wide = 1e3 * 1.96 * np.sqrt(np.diag(covariance))
    text = (
        f"the pose is that of a point at {_format_vector(-1e3 * r, 'mm in S')}"
        f" (+- {wide.max():.2g} mm), not of the sensor"
    )
    return Cause("pose frame", text, values={"position_in_sensor": (-r).tolist()})


def _sensor_rotation_cause(state: FittedModel) -> Cause:
    rho, covariance = state.parameters_of_extension("rotation")
    angle = float(np.degrees(np.linalg.norm(rho)))
    wide = float(np.degrees(np.sqrt(np.diag(covariance).max())))
    text = (
        f"the sensor is rotated by {angle:.2f} deg (+- {1.96 * wide:.2g}) against the motion, about"
        f" {_format_vector(rho / (np.linalg.norm(rho) + 1e-12), 'in S', '.2f')}"
    )
    return Cause("sensor rotation", text, values={"rotation_vector": rho.tolist()})


def _drift_cause(state: FittedModel) -> Cause:
    size = 2.0 * candidates.drift_amplitudes(state)
    text = (
        f"the offsets drift by up to {size[:3].max():.2g} N and {size[3:].max():.2g} N m within the"
        " record; the stated offsets are their means: let the sensor warm up"
    )
    return Cause("drift", text, values={"range": size.tolist()})


def _cable_cause(state: FittedModel) -> Cause:
    stiffness = candidates.max_cable_stiffness_n_m(state)
    text = (
        f"a force that depends on the position acts on the load (about {stiffness:.2g} N/m),"
        " probably of a cable or hose; guide it so that it is slack"
    )
    return Cause("cable", text, values={"stiffness": stiffness})


def _offset_or_load_step_cause(state: FittedModel, i: int) -> Cause:
    step, (values, covariance) = state.model.steps[i], state.parameters_of_extension(f"step {i}")
    when = f"from t = {step.time:.2f} s on"
    if step.kind == "offsets":
        text = (
            f"{when} the sensor has another zero: {_format_vector(values[:3], 'N')},"
            f" {_format_vector(values[3:], 'N m')} are added (a tare in the record); the stated"
            " offsets are those before it; do not tare within a record"
        )
        return Cause("zero change", text, start_s=step.time, values={"change": values.tolist()})
    mass, com = float(values[0]), mass_com_inertia(values)[1] if values[0] else np.zeros(3)
    wide = 1.96 * float(np.sqrt(covariance[0, 0]))
    what = "added" if mass > 0.0 else "removed"
    text = (
        f"{when} there is another load: {abs(mass):.4g} kg (+- {wide:.2g}) at"
        f" {_format_vector(1e3 * com, 'mm in S')} are {what}; the load is given for each part"
    )
    change = {"mass_change": mass, "com_of_change": np.asarray(com).tolist()}
    return Cause("load change", text, start_s=step.time, values=change)


def _is_hand_contact(span: tuple[float, float], times: tuple[float, ...]) -> bool:
    start, stop = span[0] - _MAX_HAND_CONTACT_TO_STEP_S, span[1] + _MAX_HAND_CONTACT_TO_STEP_S
    near = any(start < time < stop for time in times)
    return near and span[1] - span[0] < _MAX_HAND_CONTACT_DURATION_S


def _contact_cause(start: float, stop: float) -> Cause:
    text = (
        f"from t = {start:.2f} to {stop:.2f} s the load is in contact or the sensor is saturated;"
        " this part is not used"
    )
    return Cause("contact", text, start_s=start, stop_s=stop)
