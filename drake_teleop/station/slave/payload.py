"""Payload that the tool holds from the start."""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
import math
from dataclasses import dataclass

from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, SpatialInertia, WeldJoint

from drake_teleop.common.fields import settings
from drake_teleop.common.quantities import quantity

_STEEL_DENSITY = 7850.0  # kg/m^3


@settings
@dataclass
class Payload:
    """A ball of steel, welded to the tool, without a collision shape; part of the load."""

    mass: float = quantity(0.0, "kg", 0.0, 10.0, "mass of the payload; 0: none")
    com: list[float] = quantity([0.0, 0.0, 0.15], "m", -0.5, 0.5, "centre of mass, p_SoBcm_S")


def AddPayload(plant: MultibodyPlant, holder: Frame, payload: Payload) -> None:
    """Weld the payload to a frame that coincides with S, if it has mass."""
    if payload.mass == 0.0:
        return
    radius = (payload.mass / _STEEL_DENSITY * 3 / (4 * math.pi)) ** (1 / 3)
    inertia = SpatialInertia.SolidSphereWithMass(payload.mass, radius)
    body = plant.AddRigidBody("payload", holder.model_instance(), inertia)
    weld = WeldJoint("payload_weld", holder, body.body_frame(), RigidTransform(payload.com))
    plant.AddJoint(weld)
