"""Export of an identified load to formats of robots, compensations and models."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.html import render_page
from drake_teleop.common.numeric import Array
from drake_teleop.common.registry import Registry
from drake_teleop.common.rotations import rotation_matrices
from drake_teleop.common.texts import format_yaml_value
from drake_teleop.load.identification import PARAMETER_NAMES, Identification
from drake_teleop.load.inertia import is_physically_consistent, mass_com_inertia, transform_phi

STANDARD_GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True)
class ExportedLoad:
    """Load parameters to export, in SI units.

    Args:
        com: (3,) centre of mass in the frame F of the export [m].
        inertia: (3, 3) about the centre of mass, in F [kg m^2].
        offsets: (6,) sensor offsets, in the sensor's frame and sign [N, N m].
    """

    mass: float
    com: Array
    inertia: Array
    offsets: Array

    @property
    def inertia_entries(self) -> tuple[float, ...]:
        """Inertia xx, yy, zz, xy, xz, yz [kg m^2]."""
        i = self.inertia
        return i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]


@dataclass(frozen=True)
class Format:
    """Format of an exported load.

    Args:
        of_sensor: the values are in the sensor's frame.
        inertia, offsets: whether the format contains them.
        body: the format requires a physically consistent body.
        comment: prefix of a comment line; "" for none.
    """

    write: Callable[[ExportedLoad], str]
    of_sensor: bool = False
    inertia: bool = True
    offsets: bool = False
    body: bool = False
    comment: str = ""
    note: str = ""


def export_load(
    found: Identification, to: str, *, sensor_pose: Sequence[float] | None = None, sign: int = -1
) -> tuple[str, list[str]]:
    """Return the text in the format `to`, and warnings.

    `sensor_pose` is x, y, z [m], roll, pitch, yaw [deg] of the sensor in the frame of the export;
    `sign` is -1 if the sensor reports the wrench of load on sensor (usual), else 1.
    """
    format = FORMATS[FORMATS.check(to, "export")]
    if format.of_sensor:
        refuse_removed_weight(found, to)
    if sensor_pose is not None and format.of_sensor:
        raise unused_sensor_pose_error(to)
    x, y, z, *angles = [0.0] * 6 if sensor_pose is None else sensor_pose
    R_FS = rotation_matrices(np.radians([angles]), "euler", "xyz")[0]
    phi = transform_phi(found.phi, R_FS, [x, y, z])
    if found.mass <= 0.0 or (format.body and not is_physically_consistent(phi)):
        what = f"the load of {found.mass:.4g} kg is not physically consistent, but {to} requires it"
        remedy = "use `identify --method consistent`; a negative mass means"
        remedy += " that the sign of the wrench is wrong"
        raise DrakeTeleopError(what, where="export", remedy=remedy)
    load = ExportedLoad(*mass_com_inertia(phi), sign * found.offsets)
    warnings = _export_warnings(found, to, format)
    notes = "".join(f"{format.comment} {text}\n" for text in warnings if format.comment)
    return notes + format.write(load), warnings


def unused_sensor_pose_error(to: str) -> DrakeTeleopError:
    what = f"{to} takes its values in the sensor's frame"
    return DrakeTeleopError(what, where="--sensor-pose", remedy="remove the option")


def refuse_removed_weight(found: Identification, to: str) -> None:
    if found.weight_removed:
        removed = "the robot has removed the load's weight from the wrench"
        what = f"{removed}, and {to} would subtract it once more"
        remedy = "identify without payload compensation, or use `drake-teleop compensate` instead"
        raise DrakeTeleopError(what, where="export", remedy=remedy)


def _export_warnings(found: Identification, to: str, format: Format) -> list[str]:
    written = [format.offsets] * 6 + [True] * 4 + [format.inertia] * 6
    warnings = [
        f"{name} is not identified ({verdict}): do not use values that depend on it"
        for name, verdict, is_written in zip(PARAMETER_NAMES, found.verdicts, written, strict=True)
        if is_written and verdict != "identified"
    ]
    if not format.inertia:
        warnings.append(
            f"{to} has no field for the inertia, so inertial wrenches of fast motion remain;"
            " move slowly"
        )
    if not found.physically_consistent:
        remedy = "`identify --method consistent` corrects it"
        warnings.append(f"the load is not physically consistent; {remedy}")
    return [*warnings, format.note] if format.note else warnings


def _make_template_renderer(name: str) -> Callable[[ExportedLoad], str]:
    def join_numbers(values: Iterable[float], separator: str = ", ") -> str:
        return separator.join(repr(float(value) + 0.0) for value in values)

    def join_yaml_numbers(values: Iterable[float]) -> str:
        return format_yaml_value([float(value) + 0.0 for value in values])[1:-1]

    def render_load(load: ExportedLoad) -> str:
        names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
        entries = dict(zip(names, load.inertia_entries, strict=True))
        values = {**vars(load), "numbers": join_numbers, "yaml": join_yaml_numbers}
        values |= {"entries": entries, "weight": load.mass * STANDARD_GRAVITY_M_S2}
        return render_page("drake_teleop.robots", f"formats/{name}.j2", **values) + "\n"

    return render_load


_RENAME_FRAME_NOTE = "replace ft_sensor by the name of your sensor's frame"
_SENSOR_FORMAT_PROPERTIES: dict[str, Any] = {"of_sensor": True, "inertia": False, "comment": "#"}
_FORMAT_PROPERTIES: dict[str, dict[str, Any]] = {
    "ur": {"comment": "#"},
    "franka": {"note": "transformation is the identity: use that of your end effector"},
    "xarm": {"inertia": False, "comment": "#"},
    "kth": {
        **_SENSOR_FORMAT_PROPERTIES,
        "offsets": True,
        "note": f"{_RENAME_FRAME_NOTE}; the weight is the mass times the reading of an IMU: if the"
        " compensated force is twice the weight, change the sign of the mass",
    },
    "ft_tools": _SENSOR_FORMAT_PROPERTIES | {"offsets": True},
    "ros2-admittance": _SENSOR_FORMAT_PROPERTIES | {"note": _RENAME_FRAME_NOTE},
    "bota": {
        "of_sensor": True,
        "offsets": True,
        "note": "the inertia is about the centre of mass; Bota does not document the point",
    },
    "urdf": {"body": True},
    "sdf": {"body": True},
    "mjcf": {"body": True},
}
FORMATS = Registry(
    "export format",
    {key: Format(_make_template_renderer(key), **own) for key, own in _FORMAT_PROPERTIES.items()},
    Format,
)
"""Export formats by name."""
