"""Settings of a leader arm from a model file."""

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant

from drake_teleop.common.config import choice, plain, quantity, settings
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.load.inertia import inertia_about_origin
from drake_teleop.station.master.device_parameters import pack_device_parameters
from drake_teleop.station.master.leader import LeaderDevice, make_leader_joint_table
from drake_teleop.station.slave import arm as serial_arm
from drake_teleop.station.slave.arm import ArmModel
from drake_teleop.station.slave.arm_from_plant import ArmModelFromPlant, values_per_joint
from drake_teleop.station.slave.models import ParsedArm, ParseModel, translate_drake_errors

LEADER_JOINT_MODE = "joints"


@settings
@dataclass
class Leader:
    """Settings of a leader arm; its base is placed so that E is at `master.position` at home."""

    file: str = plain("", "URDF, SDF, MJCF or .dmd.yaml in the scenario's folder", is_path=True)
    package_paths: list[str] = plain(
        [], "folders of package:// in the file, relative to the scenario's folder", is_path=True
    )
    hand_frame: str = plain("", "name of the frame or link at the grip")
    home: list[float] = quantity([], "rad, m", -1e4, 1e4, "start; default: 0, if outside: middle")
    base_rotation: list[float] = quantity(
        [0.0, 0.0, 0.0], "rad", -2 * math.pi, 2 * math.pi, "arm base in B (z up): roll, pitch, yaw"
    )
    weight_carried: float = quantity(1.0, "1", 0.0, 1.0, "share of arm weight that motors carry")
    friction: list[float] = quantity(
        [], "N m", 0.0, 1e6, "Coulomb friction, one for all joints or one each; default: none"
    )
    damping: list[float] = quantity(
        [], "N m s/rad", 0.0, 1e6, "damping added to the model's, one for all joints or one each"
    )
    torque_limit: list[float] = quantity(
        [], "N m", 0.0, 1e6, "motor limits, one for all joints or one each; default: model's"
    )
    peak_force: float = quantity(30.0, "N", 0.0, 500.0, "largest displayed force")
    peak_torque: float = quantity(3.0, "N m", 0.0, 50.0, "largest displayed torque about each axis")
    leads: str = choice(
        "pose",
        ("pose", LEADER_JOINT_MODE),
        "pose: the hand commands X_WS; joints: joint k commands the slave's joint k",
    )

    def check(self, where: str) -> None:
        for name in ("file", "hand_frame"):
            if not getattr(self, name):
                what = f"a leader arm requires a {name.replace('_', ' ')}"
                raise DrakeTeleopError(what, where=f"{where}.{name}", remedy="set this field")

    def add_to_plant(self, plant: MultibodyPlant, X_WB: RigidTransform | None = None) -> ParsedArm:
        """Add the leader arm to a plant; X_WB is the pose of its base frame B in the world."""
        X_BBase = RigidTransform(RollPitchYaw(self.base_rotation), np.zeros(3))
        X_WBase = X_BBase if X_WB is None else X_WB @ X_BBase
        packages = tuple(map(Path, self.package_paths))
        return ParseModel(plant, Path(self.file), self.hand_frame, packages, X_WBase)

    def device(self, position: list[float], hand_mass: float, hand_inertia: float) -> LeaderDevice:
        """Return the arm's dynamics with the hand's mass [kg] and inertia about E [kg m^2].

        At home the hand's point E is at `position` (3,) [m] in the base frame B.
        """
        plant = MultibodyPlant(0.0)
        parsed = self.add_to_plant(plant)
        with translate_drake_errors(Path(self.file)):
            plant.Finalize()
        frame = parsed.sensor_frame
        arm = ArmModelFromPlant(plant, frame.model_instance(), frame.name())
        home = self._home_joint_positions(arm)
        arm_without_hand = _place_end_frame_E_at_home(arm, home, np.array(position))
        phi = arm_without_hand.phi_load
        phi[0] += hand_mass
        phi[[4, 7, 9]] += hand_inertia
        held = arm_without_hand.with_load(phi)
        coulomb = values_per_joint(arm, self.friction, "master.leader.friction", 0.0)
        viscous = values_per_joint(arm, self.damping, "master.leader.damping", 0.0)
        limits = self.torque_limit, "master.leader.torque_limit", arm.effort_limit
        rows = coulomb, viscous, values_per_joint(arm, *limits)
        joint_table = make_leader_joint_table(held, home, *rows, self.weight_carried)
        parameters = pack_device_parameters(
            hand_mass=hand_mass,
            hand_inertia=hand_inertia,
            peak_force=self.peak_force,
            peak_torque=self.peak_torque,
            in_task_space=True,
        )
        return LeaderDevice(held, arm_without_hand, joint_table, home, parameters)

    def _home_joint_positions(self, arm: ArmModel) -> Array:
        if self.home:
            return values_per_joint(arm, self.home, "master.leader.home")
        within = (arm.lower <= 0.0) & (arm.upper >= 0.0)
        return np.where(within, 0.0, arm.middle_positions)


def _place_end_frame_E_at_home(arm: ArmModel, home: Array, p_BE: Array) -> ArmModel:
    # The base moves so that E is at p_BE (3,) at home.
    R, p = np.empty((3, 3)), np.empty(3)
    serial_arm.forward_kinematics(arm.table, home, R, p)
    table, n = arm.table.copy(), arm.num_joints
    table[0, serial_arm.TRANSLATION_COLUMN : serial_arm.PHI_COLUMN] += p_BE - p
    # R rotates the hand's frame S into B, so that E has B's axes at home. L is the last link.
    R_LS = table[n, serial_arm.ROTATION_COLUMN : serial_arm.TRANSLATION_COLUMN].reshape(3, 3)
    table[n, serial_arm.ROTATION_COLUMN : serial_arm.TRANSLATION_COLUMN] = (R_LS @ R.T).ravel()
    phi = table[n, serial_arm.PHI_COLUMN : serial_arm.ROTOR_COLUMN]
    inertia = inertia_about_origin(phi)
    phi[1:4], phi[4:] = R @ phi[1:4], (R @ inertia @ R.T)[np.triu_indices(3)]
    return dataclasses.replace(arm, table=table)
