"""Solids with Drake's point contact: fixed wall and box, movable block on a table."""

from dataclasses import dataclass
from itertools import product

import numpy as np
from pydrake.geometry import Box as BoxShape
from pydrake.geometry import ProximityProperties, SceneGraph, Sphere
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, SpatialInertia

from drake_teleop.common.config import quantity, settings
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.environment.environment import (
    AddFreeJoint,
    BodiesWeldedToTool,
    ContactMaterial,
    Environment,
    ExcludeContact,
    FloorStand,
    NewInstance,
)

_BOX_COLOUR_RGBA = np.array([0.78, 0.66, 0.50, 1.0])
_WALL_THICKNESS_M = 0.1  # deep enough that a tool leaves through the face
_FOOT_RADIUS_M, _TABLE_THICKNESS_M = 0.002, 0.05
_BLOCK_BODY_NAME, _FOOT_NAME_PREFIX = "block", "foot_of_block_"
_BLOCK_COLOUR_RGBA = np.array([0.30, 0.42, 0.58, 1.0])


@settings
@dataclass
class Surface(Environment):
    """Base class of objects with contact stiffness, dissipation and friction of their surface.

    Contact has the stiffnesses of surface and tool in series, and the harmonic mean of their
    frictions. The tool's ball has stiffness 4e5 N/m and friction 0.2.
    """

    stiffness: float = quantity(
        1e4, "N/m", 1e2, 1e7, "contact stiffness, in series with that of the tool (estimate)"
    )
    dissipation: float = quantity(1.0, "s/m", 0.0, 100.0, "Hunt-Crossley dissipation (estimate)")
    friction: float = quantity(
        0.2, "1", 0.0, 2.0, "friction coefficient; with the tool's, their harmonic mean (estimate)"
    )

    @property
    def slip_speed(self) -> float:
        return 1e-3

    def material(self) -> ProximityProperties:
        return ContactMaterial(self.stiffness, self.dissipation, self.friction)


@settings
@dataclass
class Box(Surface):
    """Fixed box with pose, size and surface."""

    position: list[float] = quantity([0.55, 0.0, 0.1], "m", -2.0, 2.0, "p_WBox, its middle, in W")
    rotation: list[float] = quantity([0.0, 0.0, 0.0], "rad", -3.15, 3.15, "roll, pitch, yaw in W")
    size: list[float] = quantity([0.3, 0.3, 0.1], "m", 1e-3, 4.0, "lengths of its edges")

    def AddTo(self, plant: MultibodyPlant) -> None:
        X_WBox = RigidTransform(RollPitchYaw(self.rotation), self.position)
        AddFixedBox(plant, "box", X_WBox, self.size, self)


def AddFixedBox(
    plant: MultibodyPlant, name: str, X_WBox: RigidTransform, size: list[float], surface: Surface
) -> None:
    """Weld a box with edges `size` (3,) [m] to the world, without shape if no scene graph."""
    body = plant.AddRigidBody(name, NewInstance(plant, name), SpatialInertia.Zero())
    plant.WeldFrames(plant.world_frame(), body.body_frame(), X_WBox)
    if plant.geometry_source_is_registered():
        shape, here = BoxShape(*size), RigidTransform()
        plant.RegisterCollisionGeometry(body, here, shape, name, surface.material())
        plant.RegisterVisualGeometry(body, here, shape, name, _BOX_COLOUR_RGBA)


@settings
@dataclass
class Wall(Surface):
    """Fixed flat wall with position, normal, size and surface."""

    position: list[float] = quantity([0.55, 0.0, 0.15], "m", -2.0, 2.0, "p_W, middle of its face")
    normal: list[float] = quantity([0.0, 0.0, 1.0], "1", -1.0, 1.0, "outward normal in W, any norm")
    size: list[float] = quantity(
        [0.4, 0.4], "m", 1e-3, 4.0, "edge lengths of the face; edge 2 is along the world axis that"
        " is nearest to the face's plane (the first of equal ones); the wall is 0.1 m thick",
    )  # fmt: skip

    def check(self, where: str) -> None:
        if np.linalg.norm(self.normal) < 1e-3:
            what = f"the normal {self.normal} has no direction (its length is below 0.001)"
            remedy = "set the direction out of the wall, towards the tool, such as [0, 0, 1]"
            raise DrakeTeleopError(what, where=f"{where}.normal", remedy=remedy)

    def AddTo(self, plant: MultibodyPlant) -> None:
        R_WWall = RotationMatrix.MakeFromOneVector(np.array(self.normal), 2)
        X_WWall = RigidTransform(R_WWall, self.position)
        behind = RigidTransform([0.0, 0.0, -_WALL_THICKNESS_M / 2])
        AddFixedBox(plant, "wall", X_WWall @ behind, [*self.size, _WALL_THICKNESS_M], self)


@settings
@dataclass
class Block(Surface):
    """Movable block with initial pose, size, mass and surface, and a table below it."""

    position: list[float] = quantity(
        [0.6, 0.0, 0.2], "m", -2.0, 2.0, "p_W of the middle of the block's underside at the start"
    )
    yaw: float = quantity(0.0, "rad", -3.15, 3.15, "start yaw of the block about z_W")
    size: list[float] = quantity([0.1, 0.1, 0.1], "m", 0.01, 1.0, "lengths of its edges")
    mass: float = quantity(0.5, "kg", 0.01, 100.0, "mass of the block, evenly distributed")
    table: list[float] = quantity(
        [0.5, 0.5], "m", 0.0, 4.0, "edges x, y of a table with the block's contact law; 0: none"
    )

    def check(self, where: str) -> None:
        if 0.0 < min(self.table) < max(self.size[:2]):
            what = f"the table, {self.table} m, is smaller than the block, {self.size[:2]} m"
            remedy = "give a larger table; or give [0, 0] and add a !Box that carries the block"
            raise DrakeTeleopError(what, where=f"{where}.table", remedy=remedy)

    @property
    def floor_stand(self) -> FloorStand | None:
        x, y, top = self.position
        across = 0.6 * min(self.table)
        return FloorStand(across, across, x, y, top - _TABLE_THICKNESS_M) if across > 0.0 else None

    def AddTo(self, plant: MultibodyPlant) -> None:
        if min(self.table) > 0.0:
            below = np.array(self.position) - [0.0, 0.0, _TABLE_THICKNESS_M / 2]
            size = [*self.table, _TABLE_THICKNESS_M]
            AddFixedBox(plant, "table", RigidTransform(below), size, self)
        inertia = SpatialInertia.SolidBoxWithMass(self.mass, *self.size)
        body = plant.AddRigidBody(_BLOCK_BODY_NAME, NewInstance(plant, _BLOCK_BODY_NAME), inertia)
        x, y, foot = self.position
        turned, centre = RollPitchYaw(0.0, 0.0, self.yaw), [x, y, foot + self.size[2] / 2]
        AddFreeJoint(plant, body, RigidTransform(turned, centre))
        if not plant.geometry_source_is_registered():
            return
        here, box = RigidTransform(), BoxShape(*self.size)
        plant.RegisterCollisionGeometry(body, here, box, _BLOCK_BODY_NAME, self.material())
        plant.RegisterVisualGeometry(body, here, box, _BLOCK_BODY_NAME, _BLOCK_COLOUR_RGBA)
        for k, corner in enumerate(product((-1.0, 1.0), repeat=3)):
            place = RigidTransform(np.array(corner) * (np.array(self.size) / 2 - _FOOT_RADIUS_M))
            ball, name = Sphere(_FOOT_RADIUS_M), f"{_FOOT_NAME_PREFIX}{k}"
            plant.RegisterCollisionGeometry(body, place, ball, name, self.material())

    def PrepareContact(
        self, plant: MultibodyPlant, scene_graph: SceneGraph, tool: BodyIndex
    ) -> None:
        """Let the tool touch only the box of the block, other bodies only its corner balls."""
        bodies = [BodyIndex(index) for index in range(plant.num_bodies())]
        tool_bodies = BodiesWeldedToTool(plant, tool)
        around = [plant.get_body(index) for index in bodies if index not in tool_bodies]
        blocks = [body for body in around if body.name() == _BLOCK_BODY_NAME]
        shapes = [shape for body in blocks for shape in plant.GetCollisionGeometriesForBody(body)]
        name = scene_graph.model_inspector().GetName
        feet = [shape for shape in shapes if _FOOT_NAME_PREFIX in name(shape)]
        boxes = [shape for shape in shapes if shape not in feet]
        ExcludeContact(plant, scene_graph, feet, tool_bodies)
        others = {*tool_bodies, *(body.index() for body in blocks)}
        ExcludeContact(plant, scene_graph, boxes, [k for k in bodies if k not in others])
