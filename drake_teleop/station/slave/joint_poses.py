"""Pose of the wrist sensor from joint positions and a model file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.multibody.plant import MultibodyPlant

from drake_teleop.common.arrays import Array
from drake_teleop.logs.read.rotations import quaternions
from drake_teleop.station.slave.arm import forward_kinematics
from drake_teleop.station.slave.arm_from_plant import ArmModelFromPlant
from drake_teleop.station.slave.models import ParseModel, translate_drake_errors
from drake_teleop.station.slave.plant import finalize


@dataclass(frozen=True, eq=False)
class Arm:
    """Joint names from the base outwards, and `ArmModel.table`."""

    joint_names: tuple[str, ...]
    table: Array

    def pose(self, q: Array) -> Array:
        """Return X_WS (7,) [qw qx qy qz px py pz] [m] at q (n,) [rad, m]."""
        R_WS, p_WS = np.empty((3, 3)), np.empty(3)
        forward_kinematics(self.table, q, R_WS, p_WS)
        return np.concatenate([quaternions(R_WS[None])[0], p_WS])


def arm_of(model: Path, sensor_frame: str, package_paths: tuple[Path, ...] = ()) -> Arm:
    """Return the kinematics of the arm in a model file.

    Raises:
        DrakeTeleopError: if the model cannot be read or is no serial arm.
    """
    plant = MultibodyPlant(0.0)
    with translate_drake_errors(model):
        parsed = ParseModel(plant, model, sensor_frame, package_paths)
        finalize(plant)
        found = ArmModelFromPlant(plant, parsed.instance, parsed.sensor_frame.name())
    arm = Arm(found.joint_names, found.table)
    arm.pose(np.zeros(found.num_joints))  # Load the compiled function before the first reading.
    return arm
