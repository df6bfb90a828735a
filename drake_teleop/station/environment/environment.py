"""Base class of objects that the tool can touch, and helpers for their bodies and contacts."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from pydrake import geometry
from pydrake.geometry import ProximityProperties
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import BodyIndex, ModelInstanceIndex, QuaternionFloatingJoint, RigidBody


class FloorStand(NamedTuple):
    """Box on the floor that 3D replays show below an object: sizes along, and centre in, W [m]."""

    size_x: float
    size_y: float
    centre_x: float
    centre_y: float
    height: float


class Environment(ABC):
    """Object that the tool can touch; subclasses are dataclasses.

    Its bodies may be fixed or move, with any shape that Drake supports. For boxes and one
    `moving_part`, the station uses a faster, compiled contact law (`point_contact`).
    """

    @property
    @abstractmethod
    def slip_speed(self) -> float:
        """Sliding speed from which friction is full [m/s]; the lowest of all objects applies."""

    @abstractmethod
    def AddTo(self, plant: MultibodyPlant) -> None:
        """Add the object's bodies to a plant, as new model instances, before Finalize."""

    def PrepareContact(
        self, plant: MultibodyPlant, scene_graph: geometry.SceneGraph, tool: BodyIndex
    ) -> None:
        """Exclude pairs from contact, or replace the tool's contact materials, after Finalize."""
        return

    def check(self, where: str) -> None:
        return

    @property
    def parts(self) -> tuple[Environment, ...]:
        """Objects that a `SeveralObjects` consists of; for any other class, only this object."""
        return (self,)

    @property
    def hydroelastic(self) -> bool:
        """Whether contacts use Drake's hydroelastic model if both shapes support it."""
        return False

    @property
    def moving_part(self) -> tuple[float, float, float] | None:
        """Mass [kg], stiffness [N/m], damping [N s/m] of the body on a sprung prismatic joint.

        Its joint position is 0 without load. None: no such body.
        """
        return None

    @property
    def floor_stand(self) -> FloorStand | None:
        return None


class SeveralObjects(Environment):
    """Several objects as one `Environment`."""

    def __init__(self, parts: Iterable[Environment]) -> None:
        self._parts = tuple(parts)

    @property
    def parts(self) -> tuple[Environment, ...]:
        return self._parts

    @property
    def slip_speed(self) -> float:
        return min(part.slip_speed for part in self._parts)

    @property
    def hydroelastic(self) -> bool:
        return any(part.hydroelastic for part in self._parts)

    def AddTo(self, plant: MultibodyPlant) -> None:
        for part in self._parts:
            part.AddTo(plant)

    def PrepareContact(
        self, plant: MultibodyPlant, scene_graph: geometry.SceneGraph, tool: BodyIndex
    ) -> None:
        for part in self._parts:
            part.PrepareContact(plant, scene_graph, tool)


def NewInstance(plant: MultibodyPlant, name: str) -> ModelInstanceIndex:
    number, free = 2, name
    while plant.HasModelInstanceNamed(free):
        free, number = f"{name}_{number}", number + 1
    return plant.AddModelInstance(free)


def AddFreeJoint(plant: MultibodyPlant, body: RigidBody, X_WBody: RigidTransform) -> None:
    """Add a 6-DOF joint between world and body, with default pose X_WBody, before Finalize."""
    name, world = f"{body.name()}_floats", plant.world_frame()
    joint = plant.AddJoint(QuaternionFloatingJoint(name, world, body.body_frame()))
    turn = X_WBody.rotation().ToQuaternion().wxyz()
    joint.set_default_positions(np.concatenate([turn, X_WBody.translation()]))


def BodiesWeldedToTool(plant: MultibodyPlant, tool: BodyIndex) -> list[BodyIndex]:
    return [body.index() for body in plant.GetBodiesWeldedTo(plant.get_body(tool))]


def ToolShapes(
    plant: MultibodyPlant, scene_graph: geometry.SceneGraph, tool: BodyIndex
) -> dict[BodyIndex, list[geometry.GeometryId]]:
    """Return the shapes with contact material, by body, of `tool` and the bodies welded to it."""
    inspector, shapes = scene_graph.model_inspector(), dict[BodyIndex, list[geometry.GeometryId]]()
    for index in BodiesWeldedToTool(plant, tool):
        own = plant.GetCollisionGeometriesForBody(plant.get_body(index))
        shapes[index] = [x for x in own if inspector.GetProximityProperties(x) is not None]
    return shapes


def ExcludeContact(
    plant: MultibodyPlant,
    scene_graph: geometry.SceneGraph,
    shapes: Iterable[geometry.GeometryId],
    bodies: Iterable[BodyIndex],
) -> None:
    shapes_of = plant.GetCollisionGeometriesForBody
    others = [shape for body in bodies for shape in shapes_of(plant.get_body(body))]
    if others:
        sets = geometry.GeometrySet(list(shapes)), geometry.GeometrySet(others)
        between = geometry.CollisionFilterDeclaration().ExcludeBetween(*sets)
        scene_graph.collision_filter_manager().Apply(between)


def ContactMaterial(
    stiffness: float, dissipation: float, friction: float, former: ProximityProperties | None = None
) -> ProximityProperties:
    """Return properties for point contact; hydroelastic ones are copied from `former`.

    Units: stiffness [N/m], Hunt-Crossley dissipation [s/m], friction coefficient [1].
    """
    properties = ProximityProperties(former or ProximityProperties())
    for name in ("point_contact_stiffness", "hunt_crossley_dissipation", "coulomb_friction"):
        properties.RemoveProperty("material", name)
    law = CoulombFriction(friction, friction)
    geometry.AddContactMaterial(properties, dissipation, stiffness, law)
    return properties
