"""Settings of the slave in a scenario: arm, base pose, start, tool and payload."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, SpatialInertia, WeldJoint

from drake_teleop.common.config import choice, plain, quantity, settings
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import models_dir
from drake_teleop.station.slave.joint_commands import AUTOMATIC_IK_METHOD, IK_METHODS
from drake_teleop.station.slave.model.model_references import list_model_files
from drake_teleop.station.slave.tool import Tool, steel_ball_radius

_MAX_TIP_M = 2.0  # m, as of the tool's shapes


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
        "",
        "file of an arm: URDF, SDF, MJCF or .dmd.yaml, from the scenario's folder; default: RX90",
    )
    package_paths: list[str] = plain(
        [], "folders for package:// addresses in model and tool, from the scenario's folder"
    )
    base_pose: list[float] = quantity(
        [0.0] * 6, "m, rad", -10.0, 10.0, "X_WBase of the arm: position; roll, pitch, yaw"
    )
    sensor_frame: str = plain(
        "sensor", "frame or link of the model at which the sensor measures: S; z_S towards the tool"
    )
    home: list[float] = plain(
        [], "joint positions at the start [rad, m]; default: computed from position"
    )
    hold: dict[str, float] = plain(
        {}, "joints that are fixed, with their positions [rad, m], such as {torso_lift: 0.2}"
    )
    torque_limits: dict[str, float] = plain(
        {}, "torque limits by joint instead of the model's [N m, N]; .inf: no limit"
    )
    friction: list[float] = plain(
        [],
        "dry friction of the joints [N m, N], one for all or each, not compensated by joint"
        " control; default: none",
    )
    tool: Tool | None = field(
        default_factory=Tool,
        metadata={"doc": "tool on the sensor; null: the model's bodies beyond its sensor frame"},
    )

    tip: list[float] = plain(
        [],
        "contact point p_STip [m]; default: the tool's frame `tip`, or the end of its shapes along"
        " z_S",
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
        if not np.isfinite(self.friction).all() or min(self.friction, default=0.0) < 0.0:
            raise DrakeTeleopError(
                "contains a number that is negative or not finite",
                where=f"{where}.friction",
                remedy="give finite numbers of 0 or more",
            )
        if not np.isfinite(self.home).all():
            raise DrakeTeleopError("must be a list of finite numbers", where=f"{where}.home")
        if self.tip and not (len(self.tip) == 3 and all(abs(x) <= _MAX_TIP_M for x in self.tip)):
            raise DrakeTeleopError(
                f"{self.tip} is no position of three numbers within {_MAX_TIP_M:g} m",
                where=f"{where}.tip",
                remedy="give x, y and z in S [m]",
            )
        for joint, position in self.hold.items():
            if not np.isfinite(position):
                raise DrakeTeleopError(
                    f"{position:g} is not a finite position",
                    where=f"{where}.hold.{joint}",
                    remedy="give an angle [rad] or a distance [m]",
                )
        for joint, limit in self.torque_limits.items():
            if not limit > 0.0:
                raise DrakeTeleopError(
                    f"{limit:g} is not a valid limit (it must be above 0)",
                    where=f"{where}.torque_limits.{joint}",
                    remedy="give a torque [N m] or force [N] above 0, or .inf",
                )
        if self.tool is not None:
            self.tool.check(f"{where}.tool")

    def with_absolute_paths(self, folder: Path) -> "Slave":
        """Return a copy with absolute paths; relative ones are relative to `folder`."""

        def resolved_path(name: str) -> str:
            return str((folder / name).resolve()) if name else ""

        tool = self.tool
        if tool is not None and tool.model:
            tool = dataclasses.replace(tool, model=resolved_path(tool.model))
        return dataclasses.replace(
            self,
            model=resolved_path(self.model),
            package_paths=[resolved_path(path) for path in self.package_paths],
            tool=tool,
        )


def AddPayload(plant: MultibodyPlant, holder: Frame, payload: Payload) -> None:
    """Weld the payload, if it has mass, to `holder`, a frame that coincides with S."""
    if payload.mass == 0.0:
        return
    inertia = SpatialInertia.SolidSphereWithMass(payload.mass, steel_ball_radius(payload.mass))
    body = plant.AddRigidBody("payload", holder.model_instance(), inertia)
    weld = WeldJoint("payload_weld", holder, body.body_frame(), RigidTransform(payload.com))
    plant.AddJoint(weld)
