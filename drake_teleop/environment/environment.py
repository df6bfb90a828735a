"""What every environment is asked: to be built, how it is touched, and what of it moves."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex


class Stand(NamedTuple):
    """A box on the floor that a replay shows below an environment; all in m, in W."""

    along_x: float
    along_y: float
    x: float
    y: float
    height: float


class Environment(ABC):
    """Something to touch. A scenario has a field for each kind, of which one may be used.

    A kind is a dataclass that derives from this. Its shapes are boxes, and no more of it moves than
    one body, along a prismatic joint whose position is 0 at rest.
    """

    @property
    @abstractmethod
    def slip(self) -> float:
        """At which friction is complete [m/s]."""

    @abstractmethod
    def AddTo(self, plant: MultibodyPlant) -> ModelInstanceIndex:
        """Adds it to a plant that has the tool and is not finalized."""

    def PrepareTool(self, plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
        """Changes the contact of the tool's shapes, once the plant is finalized."""
        return

    @property
    def moving_part(self) -> tuple[float, float, float] | None:
        """Mass [kg], stiffness [N/m] and damping [N s/m] of what moves; None if nothing does."""
        return None

    @property
    def stand(self) -> Stand | None:
        """What it stands on in a replay."""
        return None
