"""Poses of the sensor from the positions of an arm's joints, by a model of the arm: `--model`.

What the joints are at is turned into the pose of the sensor's frame as it comes, so that all that
can be done with poses can be done with joint states. Drake is imported to read the model, and not
where there is none.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.load.arrays import Array
from drake_teleop.logs.read.rotations import quaternions
from drake_teleop.robots.streams import JOINTS, POSE, Part, PartSource


@dataclass(frozen=True, eq=False)
class Arm:
    """The kinematics of an arm.

    Args:
        joint_names: from the base outwards.
        table: `ArmModel.table`.
    """

    joint_names: tuple[str, ...]
    table: Array

    def pose(self, q: Array) -> Array:
        """(7,) quaternion w x y z, and position [m], of S in the world at q (n,) [rad, m]."""
        from drake_teleop.slave.arm import forward_kinematics

        R_WS, p_WS = np.empty((3, 3)), np.empty(3)
        forward_kinematics(self.table, q, R_WS, p_WS)
        return np.concatenate([quaternions(R_WS[None])[0], p_WS])


def arm_of(
    model: Path | None, sensor_frame: str | None, package_paths: tuple[Path, ...] = ()
) -> Arm | None:
    """The arm of a model, as `excite` reads it; None without.

    Args:
        model: its path.
        sensor_frame: name of the frame or link at which the sensor measures.
        package_paths: folders in which `package://` addresses are looked up.

    Raises:
        DrakeTeleopError: if it cannot be read, one is given without the other, or it is no arm.
    """
    if model is None:
        if sensor_frame is not None or package_paths:
            name = "--package-path" if sensor_frame is None else "--sensor-frame"
            raise DrakeTeleopError("needs --model", where=name)
        return None
    if sensor_frame is None:
        raise DrakeTeleopError(
            "the model does not say where the sensor is",
            where="--sensor-frame",
            remedy="name the frame or link at which it measures",
        )
    from pydrake.multibody.plant import MultibodyPlant

    from drake_teleop.slave.arm_from_plant import ArmModelFromPlant
    from drake_teleop.slave.models import ParseModel, drakes_errors_said
    from drake_teleop.slave.plant import finalize

    plant = MultibodyPlant(0.0)
    with drakes_errors_said(model):
        parsed = ParseModel(plant, model, sensor_frame, package_paths)
        finalize(plant)
        found = ArmModelFromPlant(plant, parsed.instance, parsed.sensor_frame.name())
    arm = Arm(found.joint_names, found.table)
    arm.pose(np.zeros(found.num_joints))  # what is compiled is loaded now
    return arm


class PosedByJoints:
    """A source whose joint positions are told as poses of S.

    Args:
        source: tells `JOINTS`, in the order of the arm's names.
        arm: whose joints they are.

    Attributes:
        dt, streams: see `PartSource`.
    """

    def __init__(self, source: PartSource, arm: Arm) -> None:
        self._source, self._arm, self.dt = source, arm, source.dt
        others = (stream for stream in source.streams if stream not in (JOINTS, POSE))
        self.streams: tuple[str, ...] = (*others, POSE)

    def read(self, timeout_s: float) -> list[Part] | None:
        """See `PartSource`."""
        parts = self._source.read(timeout_s)
        if parts is None:
            return None
        return [self._told(part) for part in parts if part.stream != POSE]

    def _told(self, part: Part) -> Part:
        if part.stream != JOINTS:
            return part
        values = np.full(7, np.nan)  # no pose, which nobody takes for one
        if part.values.shape == (len(self._arm.joint_names),):
            values = self._arm.pose(part.values)
        return part._replace(stream=POSE, values=values)

    def close(self) -> None:
        """See `Source`."""
        self._source.close()
