"""Poses of the sensor from the joint positions that a source delivers (option `--model`)."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from drake_teleop.common.arrays import Array
from drake_teleop.robots.streams import JOINTS, POSE, Part, PartSource


class SensorPoseOfJoints(Protocol):
    """The kinematics of an arm, such as `drake_teleop.station.slave.plant.Arm`."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the joints, from the base outwards."""

    def pose(self, q: Array) -> Array:
        """Return the pose (7,) of S in the world at q (n,), as [w x y z, position]."""


class PosedByJoints:
    """A source whose joint positions are told as poses of S.

    Args:
        source: tells `JOINTS`, in the order of the arm's names.
        arm: whose joints they are.

    Attributes:
        dt, streams: see `PartSource`.
    """

    def __init__(self, source: PartSource, arm: SensorPoseOfJoints) -> None:
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
