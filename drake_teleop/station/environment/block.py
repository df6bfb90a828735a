"""Movable block on a table, a rigid body that slides, turns, tips and falls.

Drake's point contact reduces the contact of two boxes to one point, which cannot carry a box. So
the block stands on balls of 2 mm radius in its corners; the tool touches the box.
"""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
from dataclasses import dataclass
from itertools import product

import numpy as np
from pydrake.geometry import Box as BoxShape
from pydrake.geometry import SceneGraph, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, SpatialInertia

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.fields import settings
from drake_teleop.common.quantities import quantity
from drake_teleop.station.environment.box import AddFixedBox
from drake_teleop.station.environment.environment import (
    BodiesOfTool,
    ExcludeContact,
    LetFloat,
    NewInstance,
    Stand,
)
from drake_teleop.station.environment.surface import Surface

_FOOT_RADIUS, _TABLE_THICKNESS = 0.002, 0.05  # m: radius of the balls, thickness of the table
_NAME, _FOOT_NAME = "block", "foot_of_block_"
_COLOUR = np.array([0.30, 0.42, 0.58, 1.0])


@settings
@dataclass
class Block(Surface):
    """Initial pose, size, mass and surface of a block, and the table below it."""

    position: list[float] = quantity(
        [0.6, 0.0, 0.2], "m", -2.0, 2.0, "the middle of its underside at the start, in W"
    )
    yaw: float = quantity(0.0, "rad", -3.15, 3.15, "of the block about z_W at the start")
    size: list[float] = quantity([0.1, 0.1, 0.1], "m", 0.01, 1.0, "lengths of its edges")
    mass: float = quantity(0.5, "kg", 0.01, 100.0, "of the block, evenly distributed")
    table: list[float] = quantity(
        [0.5, 0.5], "m", 0.0, 4.0, "size of the table below it, of the same surface; 0: none"
    )

    def check(self, where: str) -> None:
        """Check that the table carries the block."""
        if 0.0 < min(self.table) < max(self.size[:2]):
            raise DrakeTeleopError(
                "the table is smaller than the block",
                where=f"{where}.table",
                remedy="give a larger one, or [0, 0] for none, and a !Box to stand on",
            )

    @property
    def stand(self) -> Stand | None:
        x, y, top = self.position
        across = 0.6 * min(self.table)
        return Stand(across, across, x, y, top - _TABLE_THICKNESS) if across > 0.0 else None

    def AddTo(self, plant: MultibodyPlant) -> None:
        """Add the block at rest on its table; without a scene graph they have no shapes."""
        if min(self.table) > 0.0:
            below = np.array(self.position) - [0.0, 0.0, _TABLE_THICKNESS / 2]
            AddFixedBox(
                plant, "table", RigidTransform(below), [*self.table, _TABLE_THICKNESS], self
            )
        inertia = SpatialInertia.SolidBoxWithMass(self.mass, *self.size)
        body = plant.AddRigidBody(_NAME, NewInstance(plant, _NAME), inertia)
        x, y, foot = self.position
        turned = RollPitchYaw(0.0, 0.0, self.yaw)
        X_WBlock = RigidTransform(turned, [x, y, foot + self.size[2] / 2])
        LetFloat(plant, body, X_WBlock)
        if not plant.geometry_source_is_registered():
            return
        here, box = RigidTransform(), BoxShape(*self.size)
        plant.RegisterCollisionGeometry(body, here, box, _NAME, self.material())
        plant.RegisterVisualGeometry(body, here, box, _NAME, _COLOUR)
        for k, corner in enumerate(product((-1.0, 1.0), repeat=3)):
            place = RigidTransform(np.array(corner) * (np.array(self.size) / 2 - _FOOT_RADIUS))
            ball = Sphere(_FOOT_RADIUS)
            plant.RegisterCollisionGeometry(body, place, ball, f"{_FOOT_NAME}{k}", self.material())

    def PrepareContact(
        self, plant: MultibodyPlant, scene_graph: SceneGraph, tool: BodyIndex
    ) -> None:
        """Let the tool touch only the box, and all other bodies only the balls."""
        bodies = [BodyIndex(index) for index in range(plant.num_bodies())]
        blocks = [body for body in map(plant.get_body, bodies) if body.name() == _NAME]
        shapes = [shape for body in blocks for shape in plant.GetCollisionGeometriesForBody(body)]
        name = scene_graph.model_inspector().GetName
        feet = [shape for shape in shapes if _FOOT_NAME in name(shape)]
        boxes = [shape for shape in shapes if shape not in feet]
        tool_bodies = BodiesOfTool(plant, tool)
        ExcludeContact(plant, scene_graph, feet, tool_bodies)
        others = {*tool_bodies, *(body.index() for body in blocks)}
        ExcludeContact(plant, scene_graph, boxes, [k for k in bodies if k not in others])
