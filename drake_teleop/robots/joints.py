"""Poses of the sensor from joint positions (option `--model`)."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from drake_teleop.common.arrays import Array
from drake_teleop.robots.streams import JOINTS, POSE, Part, PartSource


class SensorPoseOfJoints(Protocol):
    """Kinematics of an arm, such as `station.slave.joint_poses.Arm`."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names from the base outwards."""

    def pose(self, q: Array) -> Array:
        """Return the pose X_WS (7,) at q (n,), as [w x y z, position]."""


class PosedByJoints:
    """Source that converts joint positions to poses of S."""

    def __init__(self, source: PartSource, arm: SensorPoseOfJoints) -> None:
        self._source, self._arm, self.dt = source, arm, source.dt
        others = (stream for stream in source.streams if stream not in (JOINTS, POSE))
        self.streams: tuple[str, ...] = (*others, POSE)

    def read(self, timeout_s: float) -> list[Part] | None:
        """See `PartSource`."""
        parts = self._source.read(timeout_s)
        if parts is None:
            return None
        return [self._converted(part) for part in parts if part.stream != POSE]

    def _converted(self, part: Part) -> Part:
        if part.stream != JOINTS:
            return part
        values = np.full(7, np.nan)  # an invalid pose, rejected later
        if part.values.shape == (len(self._arm.joint_names),):
            values = self._arm.pose(part.values)
        return part._replace(stream=POSE, values=values)

    def close(self) -> None:
        """See `PartSource`."""
        self._source.close()
