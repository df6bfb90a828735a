"""Something heavy that the tool holds from the start, for studies over the mass of the load."""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
import math
from dataclasses import dataclass

from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, SpatialInertia, WeldJoint

from drake_teleop.common.fields import settings
from drake_teleop.common.quantities import quantity

_STEEL = 7850.0  # kg/m^3


@settings
@dataclass
class Payload:
    """A ball of steel, welded to the tool: without shape, so that it touches nothing.

    It is part of the load: the wrist sensor feels it, the identification finds it, and the joint
    control counts with it, as that of a robot does which has been told what it carries.
    """

    mass: float = quantity(0.0, "kg", 0.0, 10.0, "0: the tool holds nothing")
    com: list[float] = quantity([0.0, 0.0, 0.15], "m", -0.5, 0.5, "its centre, p_SoBcm_S")


def AddPayload(plant: MultibodyPlant, holder: Frame, payload: Payload) -> None:
    """Welds it to a frame that coincides with S; nothing if it has no mass.

    The plant is not finalized.
    """
    if payload.mass == 0.0:
        return
    radius = (payload.mass / _STEEL * 3 / (4 * math.pi)) ** (1 / 3)
    inertia = SpatialInertia.SolidSphereWithMass(payload.mass, radius)
    body = plant.AddRigidBody("payload", holder.model_instance(), inertia)
    weld = WeldJoint("payload_weld", holder, body.body_frame(), RigidTransform(payload.com))
    plant.AddJoint(weld)
