"""Surface of an object: stiffness, dissipation and friction."""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
from dataclasses import dataclass

from pydrake.geometry import AddContactMaterial, ProximityProperties
from pydrake.multibody.plant import CoulombFriction

from drake_teleop.common.fields import settings
from drake_teleop.common.quantities import quantity
from drake_teleop.station.environment.environment import Environment


@settings
@dataclass
class Surface(Environment):
    """Surface of the object alone; Drake combines it with that of the other object.

    Stiffnesses are springs in series, k1 k2 / (k1 + k2). Friction is the harmonic mean,
    2 mu1 mu2 / (mu1 + mu2). The tool's ball has 4e5 N/m and 0.2.
    """

    stiffness: float = quantity(
        1e4, "N/m", 1e2, 1e7, "of its surface, in series with that of what touches it (E)"
    )
    dissipation: float = quantity(
        1.0, "s/m", 0.0, 100.0, "of its surface, by Hunt and Crossley: damping k x d (E)"
    )
    friction: float = quantity(
        0.2, "1", 0.0, 2.0, "of its surface, at rest and in motion; tool and surface average (E)"
    )

    @property
    def slip(self) -> float:
        """Slip at which friction is complete [m/s] (E)."""
        return 1e-3

    def material(self) -> ProximityProperties:
        """Return the properties for Drake's point contact."""
        properties = ProximityProperties()
        friction = CoulombFriction(self.friction, self.friction)
        AddContactMaterial(properties, self.dissipation, self.stiffness, friction)
        return properties
