"""Identified load of a sensor, and the load of a gripped object as a difference."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError, expect_type
from drake_teleop.common.files import write_json
from drake_teleop.common.numeric import Array, check_load_not_all_zero, finite_array
from drake_teleop.load.inertia import is_physically_consistent, mass_com_inertia, pseudo_inertia

VERDICT_NAMES = ("identified", "weakly", "not", "prior")
"""Values of `Identification.verdicts`."""

PARAMETER_NAMES = (
    *("f_ox", "f_oy", "f_oz", "tau_ox", "tau_oy", "tau_oz"),
    *("m", "m c_x", "m c_y", "m c_z", "I_xx", "I_xy", "I_xz", "I_yy", "I_yz", "I_zz"),
)
"""Names of the 16 parameters in the order of Eq. (7): [offsets; phi]."""
PARAMETER_UNITS = ("N",) * 3 + ("N m",) * 3 + ("kg",) + ("kg m",) * 3 + ("kg m^2",) * 6
"""Unit of each parameter."""

MAX_IDENTIFIED_RELATIVE_STD = 0.05
"""Largest standard deviation of an identified parameter, relative to its natural scale."""
# Limit of "weakly" relative to the natural scale, smallest size of a load [m], gravity [m/s^2].
_MAX_WEAKLY_IDENTIFIED_SCALED_STD, _MIN_LOAD_SIZE_M, _G_M_S2 = 0.5, 0.03, 9.81
_OPTIONAL_FILE_FIELDS = {"weight_removed", "degrees_of_freedom", "prior_dominated", "verdicts"}
# Names in the file that are computed from the fields.
_DERIVED_FILE_FIELDS = ("mass", "com", "inertia_com", "physically_consistent")
# Shapes of the numbers in the file, and those with a limit: fourth powers must not overflow.
_SCALAR_FILE_FIELDS = ("condition_number", "delay_s", "mass", "samples")
_FILE_FIELD_SHAPES = dict(phi=(10,), offsets=(6,), residual_rms=(6,), com=(3,), inertia_com=(3, 3))
_LIMITED_FILE_FIELDS, _MAX_FILE_VALUE = ("phi", "offsets", "residual_rms", "delay_s"), 1e9


@dataclass(frozen=True, eq=False, repr=False)
class Identification:
    """Load and sensor offsets with their uncertainty, as in identification.json.

    Attributes:
        phi: (10,) load about the sensor origin So in S [kg, kg m, kg m^2].
        offsets: (6,) sensor offsets [N, N m].
        covariance: (16, 16) of [offsets; phi] [SI]; undetermined: variance inf (null in the file).
        identifiable: (16,) True for identified parameters, see `verdicts`.
        condition_number: of the regressor [E V] with scaled columns, Eq. (8).
        delay_s: delay of the motion behind the wrench [s].
        residual_rms: (6,) RMS residual of the wrench channels [N, N m].
        method: name of the estimator.
        weight_removed: True if the robot had removed the load's weight from the wrench.
        degrees_of_freedom: (16,) of the estimated variances; inf (null) for specified noise.
        prior_dominated: (16,) True if the standard deviation is at least half that of the prior.
    """

    phi: Array
    offsets: Array
    covariance: Array
    identifiable: NDArray[np.bool_]
    condition_number: float
    delay_s: float
    residual_rms: Array
    method: str
    samples: int
    weight_removed: bool = False
    degrees_of_freedom: Array = field(default_factory=lambda: np.full(16, np.inf))
    prior_dominated: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(16, dtype=bool))

    def __post_init__(self) -> None:
        check_load_not_all_zero("phi", finite_array("phi", self.phi, 10))
        finite_array("offsets", self.offsets, 6)

    @property
    def mass(self) -> float:
        """Mass [kg]; negative if the sign of the wrench is opposite to Eq. (1)."""
        return float(self.phi[0])

    @property
    def com(self) -> Array:
        """Centre of mass p_SoBcm_S (3,) [m]."""
        return mass_com_inertia(self.phi)[1]

    @property
    def inertia_com(self) -> Array:
        """Inertia (3, 3) about the centre of mass, in the axes of S [kg m^2]."""
        return mass_com_inertia(self.phi)[2]

    @property
    def physically_consistent(self) -> bool:
        """Whether a rigid body can have these parameters, Eq. (T1)."""
        return is_physically_consistent(self.phi)

    @property
    def standard_deviations(self) -> Array:
        """Standard deviations (16,) of [offsets; phi] [SI]; inf for undetermined parameters."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def verdicts(self) -> tuple[str, ...]:
        """Verdicts (16,) on [offsets; phi]: "identified", "weakly", "not" or "prior".

        "identified": standard deviation up to 5 % of `natural_scales`; "weakly": up to 50 %;
        "prior": `prior_dominated`.
        """
        share = self.standard_deviations / natural_scales(self.phi)
        weakly = np.where(share <= _MAX_WEAKLY_IDENTIFIED_SCALED_STD, "weakly", "not")
        rest = np.where(self.prior_dominated, "prior", weakly)
        return tuple(np.where(self.identifiable, "identified", rest).tolist())

    def with_unidentified_load(self) -> Identification:
        """Return the result with all load parameters marked as not identified."""
        return replace(self, identifiable=self.identifiable & ~_LOAD_PARAMETER_MASK)

    def with_nothing_identified(self) -> Identification:
        """Return the result with infinite variances: all `verdicts` are "not"."""
        unknown = np.ones(16, dtype=bool)
        covariance = mark_undetermined(self.covariance, unknown)
        return replace(self, covariance=covariance, identifiable=~unknown, prior_dominated=~unknown)

    def __repr__(self) -> str:
        deviations = self.standard_deviations
        named = zip(PARAMETER_NAMES, self.verdicts, strict=True)
        mass, com, inertia = mass_com_inertia(self.phi)
        inertia = np.where(self.identifiable[10:], inertia[np.triu_indices(3)], np.nan)
        force, torque = (np.linalg.norm(part) for part in np.split(self.residual_rms, 2))
        com_deviations = com_standard_deviations(self.phi, self.covariance)
        unknown = [f"{name} {verdict}" for name, verdict in named if verdict != "identified"]
        known = ", ".join([f"{16 - len(unknown)} of 16 parameters identified", *unknown])
        return "\n".join(
            (
                f"{self.method}, {self.samples} samples: {known}",
                f"  mass              {_format_numbers([mass], deviations[6:7])} kg",
                f"  centre of mass    {_format_numbers(com, com_deviations)} m",
                f"  inertia xx yy zz  {_format_numbers(inertia[[0, 3, 5]])} kg m^2, about that"
                " centre",
                f"  inertia xy xz yz  {_format_numbers(inertia[[1, 2, 4]])} kg m^2",
                f"  offset of force   {_format_numbers(self.offsets[:3], deviations[:3])} N",
                f"  offset of torque  {_format_numbers(self.offsets[3:], deviations[3:6])} N m",
                f"  residual, rms     {force:.3g} N of |F|, {torque:.3g} N m of |tau|",
            )
        )

    def save(self, path: str | Path) -> None:
        """Write identification.json; refuse a non-finite delay, residual or condition number."""
        for name, shape in (("condition_number", ()), ("delay_s", ()), ("residual_rms", (6,))):
            finite_array(f"{path}:{name}", getattr(self, name), *shape)
        fields = list(self.__dataclass_fields__)
        names = *fields[:4], "verdicts", *_DERIVED_FILE_FIELDS, *fields[4:]
        # Infinity becomes null.
        write_json(Path(path), {name: getattr(self, name) for name in names})

    @classmethod
    def load(cls, path: str | Path) -> Identification:
        """Read identification.json; raise DrakeTeleopError, which names an invalid field."""
        expect_type((str, Path), path, "load")
        document = _read_identification_document(path)
        known = (*cls.__dataclass_fields__, *_DERIVED_FILE_FIELDS, "verdicts")
        for name in (*known, *document):
            if name not in known:
                raise _file_error("is not a field of identification.json", f"{path}:{name}")
            if name not in document and name not in _OPTIONAL_FILE_FIELDS:
                raise _file_error("is missing", f"{path}:{name}")
        names = [name for name in known if name in document]  # phi first
        fields = {name: _parse_file_field(f"{path}:{name}", name, document[name]) for name in names}
        result = cls(**{name: fields[name] for name in cls.__dataclass_fields__ if name in fields})
        if fields.get("verdicts", list(result.verdicts)) != list(result.verdicts):
            what = "contradicts phi, covariance, identifiable or prior_dominated"
            raise _file_error(what, f"{path}:verdicts")
        for name in _DERIVED_FILE_FIELDS:
            stated, value = fields[name], getattr(result, name)
            is_flag = isinstance(value, bool)
            if not (stated is value if is_flag else np.allclose(stated, value, 1e-6, 1e-9)):
                what, remedy = "contradicts phi", "edit phi, or run `identify` again"
                raise DrakeTeleopError(what, where=f"{path}:{name}", remedy=remedy)
        return result


def _format_numbers(values: Sequence[float] | Array, deviations: Array | None = None) -> str:
    text = ", ".join("?" if np.isnan(value) else f"{value:.4g}" for value in values)
    text = text if len(values) == 1 else f"[{text}]"
    if deviations is None:
        return text
    return f"{text} +- {deviations.max():.1g}" if np.isfinite(deviations).all() else f"{text} +- ?"


def com_standard_deviations(phi: Array, covariance: Array) -> Array:
    mass, com, _ = mass_com_inertia(phi)
    change = np.column_stack([-com, np.eye(3)]) / mass
    part = covariance[6:10, 6:10]
    unknown = np.isinf(np.diag(part))
    squares = np.diag(change @ np.where(np.isinf(part), 0.0, part) @ change.T)
    return np.where(unknown[0] | unknown[1:], np.inf, np.sqrt(np.maximum(squares, 0.0)))


def is_precise_enough(standard_deviations: Array, phi: Array) -> NDArray[np.bool_]:
    return standard_deviations <= MAX_IDENTIFIED_RELATIVE_STD * natural_scales(phi)


def mark_undetermined(covariance: Array, is_undetermined: NDArray[np.bool_]) -> Array:
    """Return the covariance (n, n) with variance inf and no correlation for flagged parameters."""
    out = np.where(is_undetermined[:, None] | is_undetermined, 0.0, covariance)
    out[is_undetermined, is_undetermined] = np.inf
    return out


def natural_scales(phi: Array) -> Array:
    """Return typical magnitudes (16,) of [offsets; phi] of a load with this mass and com."""
    m = abs(phi[0])
    L = max(float(np.linalg.norm(phi[1:4])) / m, _MIN_LOAD_SIZE_M)
    scale: Array = m * np.repeat([_G_M_S2, _G_M_S2 * L, 1.0, L, L * L / 3.0], [3, 3, 1, 3, 6])
    return scale


def _read_identification_document(path: str | Path) -> dict[str, Any]:
    from drake_teleop.common.texts import read_json  # the import of PyYAML is slow

    if not os.path.exists(path):
        what, remedy = "cannot be read (no such file)", "check the path, or run `identify` first"
        raise DrakeTeleopError(what, where=str(path), remedy=remedy)
    document = read_json(path)
    if not isinstance(document, dict):
        raise _file_error("is not a JSON object", str(path))
    return document


def _file_error(what: str, where: str) -> DrakeTeleopError:
    return DrakeTeleopError(what, where=where, remedy="run `identify` again")


def _parse_file_field(where: str, name: str, value: Any) -> Any:
    if name in _FILE_FIELD_SHAPES or name in _SCALAR_FILE_FIELDS:
        _require_numbers(where, value)
        array = finite_array(where, value, *_FILE_FIELD_SHAPES.get(name, ()))
        if name in _LIMITED_FILE_FIELDS and np.abs(array).max() > _MAX_FILE_VALUE:
            raise _file_error(f"has an absolute value above {_MAX_FILE_VALUE:g}", where)
        # The natural scale is proportional to the mass.
        if name == "phi" and check_load_not_all_zero(where, array)[0] == 0.0:
            raise _file_error("has the mass 0", where)
        return array if array.shape else (int if name == "samples" else float)(array)
    if name == "covariance":
        return _parse_covariance(where, value)
    if name in ("identifiable", "prior_dominated"):
        flags = value if isinstance(value, list) else []
        if len(flags) != 16 or not all(isinstance(flag, bool) for flag in flags):
            raise _file_error("is not a list of 16 true or false", where)
        return np.array(flags, dtype=bool)
    if name == "degrees_of_freedom":
        given = value if isinstance(value, list) else [""]
        what = "is not a list of 16 numbers or null"
        _require_numbers(where, [v for v in given if v is not None], what)
        degrees = finite_array(where, [1.0 if v is None else v for v in given], 16)
        if (degrees <= 0.0).any():
            raise _file_error(f"has a value that is not positive ({degrees.min():g})", where)
        return np.where([v is None for v in given], np.inf, degrees)
    kinds = {"method": (str, "is not a text"), "weight_removed": (bool, "is not true or false")}
    kind, what = kinds.get(name, (object, ""))
    if not isinstance(value, kind):
        raise _file_error(what, where)
    return value


def _parse_covariance(where: str, value: Any) -> Array:
    try:
        raw = np.array(value, dtype=object)
    except ValueError:
        raw = np.empty(0)
    if raw.shape != (16, 16):
        raise _file_error("is not a (16, 16) table of numbers", where)
    is_null = np.reshape([each is None for each in raw.flat], (16, 16))
    unknown = np.eye(16, dtype=bool) & is_null
    _require_numbers(where, raw[~unknown].tolist())
    covariance = finite_array(where, np.where(unknown, 0.0, raw), 16, 16)
    if (np.diag(covariance) < 0.0).any():
        raise _file_error(f"has a negative variance ({np.diag(covariance).min():g})", where)
    return np.where(unknown, np.inf, covariance)


def _require_numbers(where: str, value: Any, what: str = "has values that are not numbers") -> None:
    if isinstance(value, list):
        for each in value:
            _require_numbers(where, each, what)
    elif isinstance(value, bool) or not isinstance(value, (int, float)):
        raise _file_error(what, where)


MIN_SIGNIFICANT_STDS = 3.0
"""Distance from zero of a significant value [standard deviations]."""

_LOAD_PARAMETER_MASK = np.arange(16) >= 6


def load_of_object(total: Identification, gripper: Identification) -> Identification:
    """Return the object's load: that of gripper with object (`total`) minus that of `gripper`."""
    phi: Array = total.phi - gripper.phi
    covariance = total.covariance.copy()
    covariance[6:, 6:] += gripper.covariance[6:, 6:]
    undetermined = np.isinf(np.diag(covariance))
    covariance = mark_undetermined(covariance, undetermined)
    deviations = np.sqrt(np.diag(covariance))
    if phi[0] < -MIN_SIGNIFICANT_STDS * deviations[6] or phi[0] == 0.0:
        what = f"load minus gripper leaves {phi[0]:.4g} kg for the object (it must be positive)"
        remedy = "give the gripper alone as gripper, and the record with the object as the load"
        raise DrakeTeleopError(what, where="gripper", remedy=remedy)
    precise = is_precise_enough(gripper.standard_deviations, gripper.phi)
    withdrawn = precise & ~gripper.identifiable & ~gripper.prior_dominated
    identifiable = is_precise_enough(deviations, phi) & ~undetermined
    identifiable[6:] &= total.identifiable[6:] & ~withdrawn[6:].any()
    return replace(
        total,
        phi=phi,
        covariance=covariance,
        identifiable=identifiable,
        degrees_of_freedom=_statistical_dof_of_load_difference(total, gripper),
        prior_dominated=total.prior_dominated | gripper.prior_dominated & _LOAD_PARAMETER_MASK,
    )


def _statistical_dof_of_load_difference(total: Identification, gripper: Identification) -> Array:
    a, b = (np.diag(load.covariance) for load in (total, gripper))
    b = np.where(_LOAD_PARAMETER_MASK, b, 0.0)
    finite = np.isfinite(a + b) & (a + b > 0.0)
    a, b = np.where(finite, a, 1.0), np.where(finite, b, 0.0)
    with np.errstate(divide="ignore"):
        sums = (a + b) ** 2 / (a**2 / total.degrees_of_freedom + b**2 / gripper.degrees_of_freedom)
    return np.where(finite, sums, np.inf)


def consistency_margin(load: Identification) -> tuple[float, float]:
    """Return the smallest eigenvalue of the pseudo-inertia, Eq. (T1), and its standard deviation.

    Units are the mass, and the length sqrt(tr Sigma / m). Rigid bodies have no negative eigenvalue.
    """
    J = pseudo_inertia(load.phi)
    mass, spread = abs(J[3, 3]), abs(float(np.trace(J[:3, :3])))
    length = np.sqrt(spread / mass) if spread > 0.0 else 1.0
    scale: Array = np.sqrt(mass) * np.array([length, length, length, 1.0])
    eigenvalues, vectors = np.linalg.eigh(J / np.outer(scale, scale))
    v = vectors[:, 0] / scale
    gradient = np.array([float(v @ pseudo_inertia(unit) @ v) for unit in np.eye(10)])
    covariance = load.covariance[6:, 6:]
    if np.isinf(covariance).any():
        return float(eigenvalues[0]), float("inf")
    variance = max(0.0, float(gradient @ covariance @ gradient))
    return float(eigenvalues[0]), math.sqrt(variance)
