"""Tool on the wrist sensor: the paper's, from a model file, or from mass, inertia and shapes."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.geometry import Box, Cylinder, Shape, Sphere
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, RigidBody, SpatialInertia, UnitInertia, WeldJoint

from drake_teleop.common.config import plain, quantity, settings
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import models_dir
from drake_teleop.station.environment.environment import ContactMaterial
from drake_teleop.station.slave.models import ParseTool

_STEEL_DENSITY_KG_M3 = 7850.0  # kg/m^3
_REPLAY_ROD_RADIUS_M = 0.005  # rods from S to the shapes in the 3D replay
_TOOL_COLOUR = np.array([0.42, 0.44, 0.47, 1.0])


@settings
@dataclass
class Ball:
    """Ball of the tool, with contact."""

    radius: float = quantity(0.012, "m", 1e-4, 1.0, "radius")
    position: list[float] = quantity([0.0, 0.0, 0.1], "m", -2.0, 2.0, "centre of the shape, in S")

    @property
    def shape(self) -> Shape:
        return Sphere(self.radius)

    @property
    def pose(self) -> RigidTransform:
        return RigidTransform(self.position)


@settings
@dataclass
class Block:
    """Box of the tool, with contact."""

    edges: list[float] = quantity([0.04, 0.04, 0.04], "m", 1e-4, 2.0, "lengths along x, y, z")
    position: list[float] = quantity([0.0, 0.0, 0.1], "m", -2.0, 2.0, "centre of the shape, in S")
    rpy: list[float] = quantity([0.0, 0.0, 0.0], "rad", -6.3, 6.3, "roll, pitch, yaw in S")

    @property
    def shape(self) -> Shape:
        return Box(*self.edges)

    @property
    def half_extent_along_z(self) -> float:
        """Distance along z_S from the centre to the farthest corner [m]."""
        return float(np.abs(self.pose.rotation().matrix()[2]) @ self.edges) / 2

    @property
    def pose(self) -> RigidTransform:
        return RigidTransform(RollPitchYaw(self.rpy), self.position)


@settings
@dataclass
class Tool:
    """Tool, by default the paper's; a model file or a mass replaces it."""

    model: str = plain("", "file of a tool: its root link is put on S", is_path=True)
    mass: float = quantity(0.0, "kg", 0.0, 100.0, "mass of a tool without a file")
    com: list[float] = quantity([0.0, 0.0, 0.05], "m", -1.0, 1.0, "centre of mass, p_SoBcm_S")
    inertia: list[float] = quantity(
        [0.0] * 6, "kg m^2", -10.0, 10.0, "about com: xx, xy, xz, yy, yz, zz; zeros: steel ball"
    )
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
            remedy = "give the mass, or remove them"
            raise DrakeTeleopError(what, where=f"{where}.mass", remedy=remedy)
        if not _tool_spatial_inertia(self).IsPhysicallyValid():
            what = "the inertia is impossible for a rigid body"
            remedy = "give entries of the tensor about the centre of mass, or leave it out"
            raise DrakeTeleopError(what, where=f"{where}.inertia", remedy=remedy)


def end_of_tool_shapes(tool: Tool) -> list[float] | None:
    """Return the end p_STip [m] of the shape that reaches farthest along z_S, if there are any."""
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
    body = plant.AddRigidBody("tool", plant.AddModelInstance("tool"), _tool_spatial_inertia(tool))
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
            rod = Cylinder(_REPLAY_ROD_RADIUS_M, length)
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
