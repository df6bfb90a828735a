"""Settings of the slave in a scenario: arm, base pose, start, tool and payload."""

import math
from dataclasses import dataclass, field
from pathlib import Path

from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, SpatialInertia, WeldJoint

from drake_teleop.common.config import choice, plain, quantity, settings
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import models_dir
from drake_teleop.station.slave.joint_commands import AUTOMATIC_IK_METHOD, IK_METHODS
from drake_teleop.station.slave.model.model_references import list_model_files
from drake_teleop.station.slave.tool import Tool, steel_ball_radius


@settings
@dataclass
class Payload:
    """Payload: a ball of steel, welded to the tool, without a collision shape; part of the load."""

    mass: float = quantity(0.0, "kg", 0.0, 10.0, "mass of the payload; 0: none")
    com: list[float] = quantity([0.0, 0.0, 0.15], "m", -0.5, 0.5, "centre of mass, p_SoBcm_S")


@settings
@dataclass
class Slave:
    """Slave: the arm, by default the paper's, with its tool."""

    position: list[float] = quantity(
        [0.55, 0.0, 0.45], "m", -5.0, 5.0, "p_WS at the start, with z_S down; unless home is given"
    )
    payload: Payload = field(default_factory=Payload)
    inverse_kinematics: str = choice(
        AUTOMATIC_IK_METHOD,
        (AUTOMATIC_IK_METHOD,),
        "closed_form: for arms with the geometry of the RX90; numeric: for any arm, within joint"
        " speeds; automatic: closed_form where possible",
        IK_METHODS,
    )
    model: str = plain(
        "", "URDF, SDF, MJCF or .dmd.yaml, from the scenario's folder; default: RX90", is_path=True
    )
    package_paths: list[str] = plain(
        [], "folders of package:// addresses, from the scenario's folder", is_path=True
    )
    base_pose: list[float] = quantity(
        [0.0] * 6, "m, rad", -10.0, 10.0, "X_WBase of the arm: position; roll, pitch, yaw"
    )
    sensor_frame: str = plain(
        "sensor", "frame or link of the model at which the sensor measures: S; z_S towards the tool"
    )
    home: list[float] = quantity(
        [], "rad, m", -1e4, 1e4, "joint positions at the start; default: computed from position"
    )
    hold: dict[str, float] = quantity(
        {}, "rad, m", -1e4, 1e4, "positions of joints that are fixed, such as {torso_lift: 0.2}"
    )
    torque_limits: dict[str, float] = quantity(
        {}, "N m, N", 1e-6, math.inf, "limits by joint instead of the model's; .inf: no limit"
    )
    friction: list[float] = quantity(
        [], "N m, N", 0.0, 1e6, "dry friction, one for all joints or each; control ignores it"
    )
    tool: Tool | None = field(
        default_factory=Tool,
        metadata={"doc": "tool on the sensor; null: the model's bodies beyond its sensor frame"},
    )
    tip: list[float] = quantity(
        [], "m", -2.0, 2.0, "p_STip; default: the frame `tip` or the end of the shapes along z_S"
    )

    @property
    def path(self) -> Path:
        return Path(self.model) if self.model else models_dir() / "rx90.sdf"

    @property
    def package_folders(self) -> tuple[Path, ...]:
        return tuple(Path(folder) for folder in self.package_paths)

    @property
    def X_WBase(self) -> RigidTransform:
        return RigidTransform(RollPitchYaw(self.base_pose[3:]), self.base_pose[:3])

    def model_files(self) -> list[Path]:
        """Return the existing files of arm and tool, with those that they include."""
        paths = [self.path] if self.tool is None else [self.path, self.tool.path]
        folders = self.package_folders
        return [file for path in paths for file in list_model_files(path, folders)]

    def check(self, where: str) -> None:
        if len(self.tip) not in (0, 3):
            what = f"has {len(self.tip)} numbers"
            raise DrakeTeleopError(what, where=f"{where}.tip", remedy="give 3 numbers, or none")
        if self.tool is not None:
            self.tool.check(f"{where}.tool")


def AddPayload(plant: MultibodyPlant, holder: Frame, payload: Payload) -> None:
    """Weld the payload, if it has mass, to `holder`, a frame that coincides with S."""
    if payload.mass == 0.0:
        return
    inertia = SpatialInertia.SolidSphereWithMass(payload.mass, steel_ball_radius(payload.mass))
    body = plant.AddRigidBody("payload", holder.model_instance(), inertia)
    weld = WeldJoint("payload_weld", holder, body.body_frame(), RigidTransform(payload.com))
    plant.AddJoint(weld)
