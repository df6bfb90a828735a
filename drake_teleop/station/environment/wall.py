"""Flat wall or table."""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.fields import settings
from drake_teleop.common.quantities import quantity
from drake_teleop.station.environment.box import AddFixedBox
from drake_teleop.station.environment.surface import Surface

_THICKNESS = 0.1  # m; deep enough that a tool leaves through the face


@settings
@dataclass
class Wall(Surface):
    """Pose, size and surface of a flat wall."""

    position: list[float] = quantity(
        [0.55, 0.0, 0.15], "m", -2.0, 2.0, "p_WWall, the middle of its face, in W"
    )
    normal: list[float] = quantity(
        [0.0, 0.0, 1.0], "1", -1.0, 1.0, "out of the wall, in W; its length does not matter"
    )
    size: list[float] = quantity([0.4, 0.4], "m", 1e-3, 4.0, "of its face; it is 0.1 m thick")

    def check(self, where: str) -> None:
        """Check that the normal has a direction."""
        if np.linalg.norm(self.normal) < 1e-3:
            raise DrakeTeleopError(
                "has no direction",
                where=f"{where}.normal",
                remedy="point it to where the tool comes from, such as [0, 0, 1]",
            )

    def AddTo(self, plant: MultibodyPlant) -> None:
        """Add a box behind the face, with z along the normal."""
        R_WWall = RotationMatrix.MakeFromOneVector(np.array(self.normal), 2)
        X_WWall = RigidTransform(R_WWall, self.position)
        behind = RigidTransform([0.0, 0.0, -_THICKNESS / 2])
        AddFixedBox(plant, "wall", X_WWall @ behind, [*self.size, _THICKNESS], self)
