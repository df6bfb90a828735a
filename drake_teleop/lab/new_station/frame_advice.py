"""Axis of the sensor frame along which the tool points, and the frame that makes it z_S."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydrake.math import RollPitchYaw

from drake_teleop.common.numeric import Array
from drake_teleop.lab.new_station.place import TOOL_AXES
from drake_teleop.station.slave.arm import ROTATION, TRANSLATION, ArmModel

_MIN_COS = 0.75  # smallest cosine of the angle between tool and axis
#: Opposite of each axis.
OPPOSITE = {axis: axis[1:] if axis.startswith("-") else f"-{axis}" for axis in TOOL_AXES}
_ROUNDING_M = 1e-9
_MIN_OFFSET_M = 0.02  # smallest distance of a centre of mass that has a direction


def nearest_axis(direction: Array) -> str:
    """Return the axis of S nearest to a direction (3,) in S; empty if none is near."""
    size = np.linalg.norm(direction)
    k = int(np.argmax(np.abs(direction)))
    if size < _MIN_OFFSET_M or abs(direction[k]) < _MIN_COS * size:
        return ""
    return ("-" if direction[k] < 0.0 else "") + "xyz"[k]


def last_joint_axis(arm: ArmModel) -> str:
    """Return the axis of S along the last joint, directed away from the joint; empty if none is."""
    row = arm.table[arm.num_joints]
    along = row[ROTATION:TRANSLATION].reshape(3, 3)[2]
    return nearest_axis(-along if row[TRANSLATION + 2] < -_ROUNDING_M else along)


def tool_frame_advice(arm: ArmModel, model: Path, sensor_frame: str, axis: str) -> str:
    """Return the lines of the model that make the tool axis z_S; empty if it is z_S."""
    if axis == "z":
        return ""
    R_SA = TOOL_AXES[axis]
    rpy = " ".join(f"{angle + 0.0:.5g}" for angle in RollPitchYaw(R_SA).vector())
    quaternion = " ".join(f"{part + 0.0:.5g}" for part in R_SA.ToQuaternion().wxyz())
    lines = {
        ".xml": f'<body name="ft" quat="{quaternion}"/> in the body {sensor_frame}',
        ".sdf": f'<frame name="ft" attached_to="{sensor_frame}"><pose>0 0 0 {rpy}</pose></frame>',
    }
    urdf = (
        f'<link name="ft"/><joint name="ft_joint" type="fixed"><parent link="{sensor_frame}"/>'
        f'<child link="ft"/><origin rpy="{rpy}"/></joint>'
    )
    return (
        f"the tool points along {axis}_S, so the start is in slave.home and the contact point in"
        f" slave.tip; to use position, or another direction, add to {model.name}"
        f" {lines.get(model.suffix.lower(), urdf)} and give --sensor-frame ft"
    )
