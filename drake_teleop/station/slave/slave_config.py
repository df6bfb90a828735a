"""Settings of the slave: arm, base pose, start, tool and payload."""

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydrake.geometry import Box, Cylinder, Shape, Sphere
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, RigidBody, SpatialInertia, UnitInertia, WeldJoint

from drake_teleop.common.config import choice, plain, quantity, settings
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import models_dir
from drake_teleop.station.environment.environment import ContactMaterial, NewInstance
from drake_teleop.station.slave.joint_commands import AUTOMATIC_IK_METHOD, IK_METHODS
from drake_teleop.station.slave.model.model_references import list_model_files
from drake_teleop.station.slave.models import ParseTool

_STEEL_DENSITY_KG_M3 = 7850.0
_TOOL_ROD_RADIUS_M = 0.005  # rods from S to the shapes in the 3D replay
_TOOL_COLOUR = np.array([0.42, 0.44, 0.47, 1.0])


@settings
@dataclass
class Ball:
    """Ball as collision shape of the tool."""

    radius: float = quantity(0.012, "m", 1e-4, 1.0, "radius")
    position: list[float] = quantity([0.0, 0.0, 0.1], "m", -2.0, 2.0, "p_S of the centre")

    @property
    def shape(self) -> Shape:
        return Sphere(self.radius)

    @property
    def pose(self) -> RigidTransform:
        return RigidTransform(self.position)


@settings
@dataclass
class Block:
    """Box as collision shape of the tool."""

    edges: list[float] = quantity([0.04, 0.04, 0.04], "m", 1e-4, 2.0, "lengths along x, y, z")
    position: list[float] = quantity([0.0, 0.0, 0.1], "m", -2.0, 2.0, "p_S of the centre")
    rpy: list[float] = quantity([0.0, 0.0, 0.0], "rad", -6.3, 6.3, "roll, pitch, yaw in S")

    @property
    def shape(self) -> Shape:
        return Box(*self.edges)

    @property
    def half_extent_along_z(self) -> float:
        """Distance along z_S from the box's centre to its farthest corner [m]."""
        return float(np.abs(self.pose.rotation().matrix()[2]) @ self.edges) / 2

    @property
    def pose(self) -> RigidTransform:
        return RigidTransform(RollPitchYaw(self.rpy), self.position)


@settings
@dataclass
class Tool:
    """Tool on the sensor: by default that of the paper, otherwise by `model` or `mass`."""

    model: str = plain("", "model file of the tool; its root is at S", is_path=True)
    mass: float = quantity(0.0, "kg", 0.0, 100.0, "mass of a tool without a model")
    com: list[float] = quantity([0.0, 0.0, 0.05], "m", -1.0, 1.0, "centre of mass, p_SoBcm_S")
    inertia: list[float] = quantity(
        [0.0] * 6, "kg m^2", -10.0, 10.0,
        "about com, in S: xx, xy, xz, yy, yz, zz; zeros: those of a steel ball with this mass",
    )  # fmt: skip
    shapes: list[Ball | Block] = plain([], "collision shapes: !Ball, !Block")

    @property
    def path(self) -> Path:
        return Path(self.model) if self.model else models_dir() / "tool.sdf"

    def check(self, where: str) -> None:
        if self.model and self.mass:
            what = "a model file and a mass both define the tool"
            raise DrakeTeleopError(what, where=f"{where}.mass", remedy="leave one of them out")
        if self.mass == 0.0 and (self.shapes or any(self.inertia) or self.com != Tool().com):
            what = "shapes, inertia and com require a mass"
            remedy = "remove them" if self.model else "give the mass, or remove them"
            raise DrakeTeleopError(what, where=f"{where}.mass", remedy=remedy)
        if not _tool_spatial_inertia(self).IsPhysicallyValid():
            what = "the inertia is impossible for a rigid body"
            remedy = "give entries of the tensor about the centre of mass, or leave it out"
            raise DrakeTeleopError(what, where=f"{where}.inertia", remedy=remedy)


@settings
@dataclass
class Payload:
    """Payload: a steel ball, welded to the tool, without collision shape; part of the load."""

    mass: float = quantity(0.0, "kg", 0.0, 10.0, "mass of the payload; 0: none")
    com: list[float] = quantity([0.0, 0.0, 0.15], "m", -0.5, 0.5, "centre of mass, p_SoBcm_S")


@settings
@dataclass
class Slave:
    """Slave: the arm, by default the paper's, with its tool."""

    position: list[float] = quantity(
        [0.55, 0.0, 0.45], "m", -5.0, 5.0, "p_WS at the start, with z_S down; unused if home is set"
    )
    payload: Payload = field(default_factory=Payload)
    inverse_kinematics: str = choice(
        AUTOMATIC_IK_METHOD,
        (AUTOMATIC_IK_METHOD,),
        "method: closed_form for arms with the geometry of the RX90, numeric for any arm, within"
        " joint speeds; automatic: closed_form where possible",
        IK_METHODS,
    )
    model: str = plain(
        "", "URDF, SDF, MJCF or .dmd.yaml in the scenario's folder; default: RX90", is_path=True
    )
    package_paths: list[str] = plain(
        [], "folders of package:// addresses, relative to the scenario's folder", is_path=True
    )
    base_pose: list[float] = quantity(
        [0.0] * 6, "m, rad", -10.0, 10.0, "base in W: x, y, z, and roll, pitch, yaw"
    )
    sensor_frame: str = plain(
        "sensor", "name of the model's frame or link where the sensor measures; z to the tool"
    )
    home: list[float] = quantity(
        [], "rad, m", -1e4, 1e4, "joint positions at the start; default: so that S is at position"
    )
    hold: dict[str, float] = quantity(
        {}, "rad, m", -1e4, 1e4, "positions of joints that are fixed, such as {torso_lift: 0.2}"
    )
    torque_limits: dict[str, float] = quantity(
        {}, "N m, N", 1e-6, math.inf, "torque limits by joint, not the model's; .inf: unlimited"
    )
    friction: list[float] = quantity(
        [], "N m, N", 0.0, 1e6, "dry friction of all joints or one each; not compensated by control"
    )
    tool: Tool | None = field(
        default_factory=Tool,
        metadata={"doc": "tool on the sensor; null: the model's bodies beyond its sensor frame"},
    )
    tip: list[float] = quantity(
        [], "m", -2.0, 2.0, "p_S of the tip; default: tool's frame `tip`, or farthest end in z_S"
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
        paths = [self.path] if self.tool is None else [self.path, self.tool.path]
        return [file for path in paths for file in list_model_files(path, self.package_folders)]

    def check(self, where: str) -> None:
        if len(self.tip) not in (0, 3):
            what = f"has {len(self.tip)} numbers"
            raise DrakeTeleopError(what, where=f"{where}.tip", remedy="give 3 numbers, or none")
        if self.tool is not None:
            self.tool.check(f"{where}.tool")


def AddPayload(plant: MultibodyPlant, holder: Frame, payload: Payload) -> None:
    """Weld a payload with mass to `holder`, a frame that coincides with S."""
    if payload.mass == 0.0:
        return
    inertia = SpatialInertia.SolidSphereWithMass(payload.mass, steel_ball_radius(payload.mass))
    body = plant.AddRigidBody("payload", NewInstance(plant, "payload"), inertia)
    weld = WeldJoint("payload_weld", holder, body.body_frame(), RigidTransform(payload.com))
    plant.AddJoint(weld)


def p_STip_of_shapes(tool: Tool) -> list[float] | None:
    """Return p_STip [m], the farthest shape's end along z_S; None without shapes."""
    halves = [x.radius if isinstance(x, Ball) else x.half_extent_along_z for x in tool.shapes]
    ends = [np.add(x.position, [0.0, 0.0, h]) for x, h in zip(tool.shapes, halves, strict=True)]
    return max(ends, key=lambda end: float(end[2])).tolist() if ends else None


def AddTool(
    plant: MultibodyPlant, tool: Tool, sensor_frame: Frame, package_paths: tuple[Path, ...]
) -> tuple[RigidBody, list[str]]:
    """Weld the tool to the sensor frame by the joint "sensor_weld".

    Return the body, and texts about assumed or repaired data.
    """
    if tool.mass == 0.0:
        return ParseTool(plant, tool.path, sensor_frame, package_paths)
    body = plant.AddRigidBody("tool", NewInstance(plant, "tool"), _tool_spatial_inertia(tool))
    weld = WeldJoint("sensor_weld", sensor_frame, body.body_frame(), RigidTransform.Identity())
    plant.AddJoint(weld)
    if plant.geometry_source_is_registered():
        _add_tool_shapes(plant, body, tool)
    return body, []


def _add_tool_shapes(plant: MultibodyPlant, body: RigidBody, tool: Tool) -> None:
    surface = ContactMaterial(stiffness=4e5, dissipation=1.0, friction=0.2)  # as in tool.sdf
    if not tool.shapes:  # a ball represents the tool in the 3D replay
        seen = RigidTransform(tool.com), Sphere(steel_ball_radius(tool.mass))
        plant.RegisterVisualGeometry(body, *seen, "tool", _TOOL_COLOUR)
    for k, each in enumerate(tool.shapes):
        name = f"tool_{k}"
        plant.RegisterCollisionGeometry(body, each.pose, each.shape, name, surface)
        plant.RegisterVisualGeometry(body, each.pose, each.shape, name, _TOOL_COLOUR)
        if (length := float(np.linalg.norm(each.position))) > 0.0:  # a rod from S, without contact
            along = RotationMatrix.MakeFromOneVector(np.array(each.position), 2)
            middle = RigidTransform(along, np.array(each.position) / 2)
            rod = Cylinder(_TOOL_ROD_RADIUS_M, length)
            plant.RegisterVisualGeometry(body, middle, rod, f"{name}_rod", _TOOL_COLOUR)


def _tool_spatial_inertia(tool: Tool) -> SpatialInertia:
    if tool.mass == 0.0:
        return SpatialInertia.Zero()
    if not any(tool.inertia):
        about_com = SpatialInertia.SolidSphereWithMass(tool.mass, steel_ball_radius(tool.mass))
        return about_com.Shift(np.negative(tool.com))
    xx, xy, xz, yy, yz, zz = np.array(tool.inertia) / tool.mass
    about_S = UnitInertia(xx, yy, zz, xy, xz, yz).ShiftFromCenterOfMass(np.negative(tool.com))
    return SpatialInertia(tool.mass, tool.com, about_S, skip_validity_check=True)


def steel_ball_radius(mass: float) -> float:
    return float((mass / _STEEL_DENSITY_KG_M3 * 3 / (4 * np.pi)) ** (1 / 3))
