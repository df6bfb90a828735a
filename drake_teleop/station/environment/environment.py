"""What every environment is asked: to be built, how it is touched, and what of it moves."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from pydrake.geometry import (
    CollisionFilterDeclaration,
    GeometryId,
    GeometrySet,
    SceneGraph,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    ModelInstanceIndex,
    QuaternionFloatingJoint,
    RigidBody,
)


class Stand(NamedTuple):
    """A box on the floor that a replay shows below an environment; all in m, in W."""

    along_x: float
    along_y: float
    x: float
    y: float
    height: float


class Environment(ABC):
    """Something to touch: a dataclass that derives from this, of which a scenario may have several.

    Its bodies may stand still or move, and have any shape that Drake knows. The wrist sensor's own
    contact law is the faster one; it knows boxes that stand or move, and a `moving_part` by itself.
    """

    @property
    @abstractmethod
    def slip(self) -> float:
        """At which friction is complete [m/s]; of several environments the least counts."""

    @abstractmethod
    def AddTo(self, plant: MultibodyPlant) -> None:
        """Adds it, as model instances of its own, to a plant with the tool, not yet finalized."""

    def PrepareContact(
        self, plant: MultibodyPlant, scene_graph: SceneGraph, tool: BodyIndex
    ) -> None:
        """Changes what touches what and how, of the tool's shapes too, once the plant is final."""
        return

    def check(self, where: str) -> None:
        """Checks what no range of one field can say.

        Raises:
            DrakeTeleopError: naming `where` and the field.
        """
        return

    @property
    def parts(self) -> tuple[Environment, ...]:
        """Itself, or what it is made of."""
        return (self,)

    @property
    def hydroelastic(self) -> bool:
        """Whether contacts have a pressure over an area, where both shapes allow for it."""
        return False

    @property
    def moving_part(self) -> tuple[float, float, float] | None:
        """Mass [kg], stiffness [N/m] and damping [N s/m] of what moves along a prismatic joint.

        Its position is 0 at rest. None if nothing does, or otherwise.
        """
        return None

    @property
    def stand(self) -> Stand | None:
        """What it stands on in a replay."""
        return None


class Several(Environment):
    """Several things to touch at once."""

    def __init__(self, parts: Iterable[Environment]) -> None:
        self._parts = tuple(parts)

    @property
    def parts(self) -> tuple[Environment, ...]:
        """See `Environment`."""
        return self._parts

    @property
    def slip(self) -> float:
        """The least of all: the plant knows but one."""
        return min(part.slip for part in self._parts)

    @property
    def hydroelastic(self) -> bool:
        """Of any."""
        return any(part.hydroelastic for part in self._parts)

    def AddTo(self, plant: MultibodyPlant) -> None:
        """Adds all of them."""
        for part in self._parts:
            part.AddTo(plant)

    def PrepareContact(
        self, plant: MultibodyPlant, scene_graph: SceneGraph, tool: BodyIndex
    ) -> None:
        """Of all of them."""
        for part in self._parts:
            part.PrepareContact(plant, scene_graph, tool)


def NewInstance(plant: MultibodyPlant, name: str) -> ModelInstanceIndex:
    """A model instance of that name, or with a number behind it if there is one."""
    number, free = 2, name
    while plant.HasModelInstanceNamed(free):
        free, number = f"{name}_{number}", number + 1
    return plant.AddModelInstance(free)


def LetFloat(plant: MultibodyPlant, body: RigidBody, X_WBody: RigidTransform) -> None:
    """Lets a body fall and be pushed, from that pose on; the plant is not yet finalized."""
    name, world = f"{body.name()}_floats", plant.world_frame()
    joint = plant.AddJoint(QuaternionFloatingJoint(name, world, body.body_frame()))
    turn = X_WBody.rotation().ToQuaternion().wxyz()
    joint.set_default_positions(np.concatenate([turn, X_WBody.translation()]))


def OnSensor(plant: MultibodyPlant, tool: BodyIndex) -> list[BodyIndex]:
    """The tool and what is welded to it, in a finalized plant."""
    return [body.index() for body in plant.GetBodiesWeldedTo(plant.get_body(tool))]


def ToolShapes(
    plant: MultibodyPlant, scene_graph: SceneGraph, tool: BodyIndex
) -> dict[BodyIndex, list[GeometryId]]:
    """What of it may touch, by body; shapes of the arm are no longer for contact."""
    properties = scene_graph.model_inspector().GetProximityProperties
    return {
        index: [
            shape
            for shape in plant.GetCollisionGeometriesForBody(plant.get_body(index))
            if properties(shape) is not None
        ]
        for index in OnSensor(plant, tool)
    }


def ExcludeContact(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    shapes: Iterable[GeometryId],
    bodies: Iterable[BodyIndex],
) -> None:
    """Lets some shapes and those of some bodies go through each other."""
    others = [
        shape
        for body in bodies
        for shape in plant.GetCollisionGeometriesForBody(plant.get_body(body))
    ]
    if not others:
        return
    between = CollisionFilterDeclaration().ExcludeBetween(
        GeometrySet(list(shapes)), GeometrySet(others)
    )
    scene_graph.collision_filter_manager().Apply(between)
