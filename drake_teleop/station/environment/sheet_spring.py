"""Sheet spring (paper, Fig. 5): a leaf, clamped at one end, that the tool touches."""

from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, PrismaticSpring

from drake_teleop.common.config import quantity, settings
from drake_teleop.common.files import models_dir
from drake_teleop.station.environment import environment

_LEAF_HEIGHT_ABOVE_BENCH_M = 0.15  # from the lower face of the model's bench to the leaf [m]


@settings
@dataclass
class SheetSpring(environment.Environment):
    """Settings of the sheet spring: position, size and material of its leaf."""

    position: list[float] = quantity(
        [0.55, 0.0, 0.15], "m", -2.0, 2.0, "point on leaf's upper face at rest, 25 mm from its end"
    )
    length: float = quantity(0.170, "m", 0.02, 1.0, "free length of the leaf")
    width: float = quantity(
        0.060, "m", 0.005, 0.5, "leaf width, for stiffness and mass; contact face: 170 x 60 mm"
    )
    thickness: float = quantity(0.002, "m", 0.0002, 0.02, "thickness of the leaf")
    youngs_modulus: float = quantity(210e9, "Pa", 1e9, 500e9, "Young's modulus, spring steel")
    density: float = quantity(7850.0, "kg/m^3", 500.0, 20000.0, "density, spring steel")
    damping_ratio: float = quantity(
        0.03, "1", 0.0, 100.0, "damping ratio of the first bending mode; above 1: overdamped"
    )
    slip_speed: float = quantity(
        1e-4, "m/s", 1e-6, 1.0, "sliding speed from which friction has its full value (estimate)"
    )

    @property
    def stiffness(self) -> float:
        """Stiffness at the free end, 3 E I / L^3 [N/m]; I = width thickness^3 / 12."""
        second_moment = self.width * self.thickness**3 / 12
        return 3 * self.youngs_modulus * second_moment / self.length**3

    @property
    def effective_mass(self) -> float:
        """Effective mass of the first bending mode, 33/140 of the leaf's mass [kg] (Rayleigh)."""
        return 33 / 140 * self.density * self.length * self.width * self.thickness

    @property
    def damping(self) -> float:
        return 2 * self.damping_ratio * np.sqrt(self.stiffness * self.effective_mass)

    @property
    def max_deflection_of_linear_model(self) -> float:
        """Largest deflection for which the linear model is valid, 10 % of the length [m]."""
        return 0.1 * self.length

    @property
    def moving_part(self) -> tuple[float, float, float]:
        return self.effective_mass, self.stiffness, self.damping

    @property
    def floor_stand(self) -> environment.FloorStand:
        x, y, z = self.position
        return environment.FloorStand(0.34, 0.24, x + 0.065, y, z - _LEAF_HEIGHT_ABOVE_BENCH_M)

    def AddTo(self, plant: MultibodyPlant) -> None:
        """Add the leaf to a plant; its joint "bending" deflects the free end along z_W [m]."""
        tree = ElementTree.parse(models_dir() / "sheet_spring.sdf")
        # Drake fixes a body's mass when it parses it, so the mass is written into the text.
        tree.find(".//link[@name='leaf']/inertial/mass").text = repr(self.effective_mass)  # type: ignore[union-attr]
        # Otherwise the prefix becomes ns0 and Drake drops the leaf's contact properties.
        ElementTree.register_namespace("drake", "drake.mit.edu")
        text = ElementTree.tostring(tree.getroot(), encoding="unicode")
        (instance,) = Parser(plant).AddModelsFromString(text, "sdf")
        base = plant.GetFrameByName("base", instance)
        plant.WeldFrames(plant.world_frame(), base, RigidTransform(self.position))
        bending = plant.GetJointByName("bending", instance)
        bending.set_default_damping(self.damping)
        plant.AddForceElement(PrismaticSpring(bending, 0.0, self.stiffness))

    def PrepareContact(
        self, plant: MultibodyPlant, scene_graph: SceneGraph, tool: BodyIndex
    ) -> None:
        tool_bodies = environment.BodiesWeldedToTool(plant, tool)
        others = [k for k in map(BodyIndex, range(plant.num_bodies())) if k not in tool_bodies]
        leaf = plant.GetBodyByName("leaf", plant.GetModelInstanceByName("sheet_spring"))
        shapes = plant.GetCollisionGeometriesForBody(leaf)
        environment.ExcludeContact(plant, scene_graph, shapes, others)
