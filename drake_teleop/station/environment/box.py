"""Fixed box: a table, a bench, a part."""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
from dataclasses import dataclass

import numpy as np
from pydrake.geometry import Box as BoxShape
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia

from drake_teleop.common.fields import settings
from drake_teleop.common.quantities import quantity
from drake_teleop.station.environment.environment import NewInstance
from drake_teleop.station.environment.surface import Surface

_COLOUR = np.array([0.78, 0.66, 0.50, 1.0])


@settings
@dataclass
class Box(Surface):
    """Pose, size and surface of a fixed box."""

    position: list[float] = quantity(
        [0.55, 0.0, 0.1], "m", -2.0, 2.0, "p_WBox, the middle of the box, in W"
    )
    rotation: list[float] = quantity(
        [0.0, 0.0, 0.0], "rad", -3.15, 3.15, "roll, pitch and yaw of R_WBox"
    )
    size: list[float] = quantity([0.3, 0.3, 0.1], "m", 1e-3, 4.0, "lengths of its edges")

    def AddTo(self, plant: MultibodyPlant) -> None:
        X_WBox = RigidTransform(RollPitchYaw(self.rotation), self.position)
        AddFixedBox(plant, "box", X_WBox, self.size, self)


def AddFixedBox(
    plant: MultibodyPlant, name: str, X_WBox: RigidTransform, size: list[float], surface: Surface
) -> None:
    """Weld a box to the world; without a scene graph it has no shape.

    Args:
        plant: not finalized.
        name: of the body, and of the model instance (with a number if the name exists).
        X_WBox: pose of the box.
        size: (3,) lengths of its edges [m].
        surface: its surface.
    """
    body = plant.AddRigidBody(name, NewInstance(plant, name), SpatialInertia.Zero())
    plant.WeldFrames(plant.world_frame(), body.body_frame(), X_WBox)
    if plant.geometry_source_is_registered():
        shape, here = BoxShape(*size), RigidTransform()
        plant.RegisterCollisionGeometry(body, here, shape, name, surface.material())
        plant.RegisterVisualGeometry(body, here, shape, name, _COLOUR)
