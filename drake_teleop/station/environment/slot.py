r"""Chamfered slot for the tool as a peg; all parts are fixed.

Section across the slot, M is the middle of its mouth, z up::

    top                       top        At +y_M and -y_M 3 boxes each, and the floor. A ball
    ------.       M       .------        on an edge of two boxes touches both, so an edge is up to
           \.     |     ./  chamfer      twice as stiff as a face. The slot is open at its ends.
             |    |    |
             |  width  |  wall
             |_________|
                floor
"""

from dataclasses import dataclass
from itertools import chain

import numpy as np
from pydrake.geometry import Box, ProximityProperties, RoleAssign, SceneGraph, Sphere
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, SpatialInertia

from drake_teleop.common.config import quantity, settings
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.environment.environment import (
    ContactMaterial,
    Environment,
    FloorStand,
    NewInstance,
    ToolShapes,
)

#: Balls of the peg [m]: radius, and z_S of the centres. The first is that of tool.sdf. The second
#: (estimate) is as high as the nut above it permits in the deepest slot.
PEG_RADIUS_M, TIP_BALL_CENTRE_Z_S_M, UPPER_BALL_CENTRE_Z_S_M = 0.012, 0.188, 0.158
#: Blocks on both sides [m]: length along the slot, width beyond the mouth's edge (estimate).
SLOT_LENGTH_M, _SIDE_BLOCK_WIDTH_M = 0.10, 0.04
_SLOT_FLOOR_THICKNESS_M = 0.02
_SLOT_COLOUR_RGBA = np.array([0.30, 0.42, 0.58, 0.55])  # transparent, so that the peg is visible
_PEG_BALL_COLOUR_RGBA = np.array([0.86, 0.20, 0.12, 1.0])


@settings
@dataclass
class Slot(Environment):
    """Settings of the slot; the peg's collision shapes are balls."""

    position: list[float] = quantity([0.55, 0.0, 0.15], "m", -2.0, 2.0, "p_W, middle of its mouth")
    yaw: float = quantity(0.0, "rad", -3.15, 3.15, "slot direction about z_W from x_W")
    clearance: float = quantity(1e-3, "m", 1e-6, 0.05, "slot width minus peg diameter")
    depth: float = quantity(0.040, "m", 0.02, 0.05, "distance from mouth to floor")
    chamfer: float = quantity(
        3e-3, "m", 5e-4, 0.015, "depth and width of each of the two chamfers of 45 degrees"
    )
    stiffness: float = quantity(
        1e4, "N/m", 1e2, 1e6, "stiffness of peg and slot with their supports, in series (estimate)"
    )
    dissipation: float = quantity(1.0, "s/m", 0.0, 100.0, "Hunt-Crossley dissipation (estimate)")
    friction: float = quantity(
        0.2, "1", 0.0, 2.0, "static and dynamic friction coefficient of peg on slot (estimate)"
    )

    @property
    def width(self) -> float:
        """Distance between the slot's walls [m]."""
        return 2 * PEG_RADIUS_M + self.clearance

    @property
    def slip_speed(self) -> float:
        return 1e-3

    @property
    def floor_bottom_height(self) -> float:
        """Height z_W of the lower face of the slot's floor [m]."""
        return self.position[2] - self.depth - _SLOT_FLOOR_THICKNESS_M

    @property
    def X_WM(self) -> RigidTransform:
        """Pose of the middle of the slot's mouth in W; x is along the slot, z is up."""
        return RigidTransform(RollPitchYaw(0.0, 0.0, self.yaw), self.position)

    @property
    def floor_stand(self) -> FloorStand:
        return FloorStand(0.16, 0.16, self.position[0], self.position[1], self.floor_bottom_height)

    def AddTo(self, plant: MultibodyPlant) -> None:
        body = plant.AddRigidBody("slot", NewInstance(plant, "slot"), SpatialInertia.Zero())
        plant.WeldFrames(plant.world_frame(), body.body_frame(), self.X_WM)
        if not plant.geometry_source_is_registered():
            return
        if (count := plant.NumBodiesWithName("tool")) != 1:
            what = f"a slot requires one body named tool, found {count}"
            remedy = "give this name to one link of the tool, and to no link of the arm"
            raise DrakeTeleopError(what, where="slave.tool", remedy=remedy)
        tool = plant.GetBodyByName("tool")
        if plant.HasJointNamed("sensor_weld"):  # to the tool's root link, whose body frame is S
            tool = plant.GetJointByName("sensor_weld").child_body()
        above = RigidTransform([0.0, 0.0, UPPER_BALL_CENTRE_Z_S_M])
        ball, properties = Sphere(PEG_RADIUS_M), _slot_material(self)
        plant.RegisterCollisionGeometry(tool, above, ball, "upper_ball", properties)
        plant.RegisterVisualGeometry(tool, above, ball, "upper_ball", _PEG_BALL_COLOUR_RGBA)
        for name, (X_MBox, box) in _boxes_of_slot(self).items():
            plant.RegisterCollisionGeometry(body, X_MBox, box, name, properties)
            plant.RegisterVisualGeometry(body, X_MBox, box, name, _SLOT_COLOUR_RGBA)

    def PrepareContact(
        self, plant: MultibodyPlant, scene_graph: SceneGraph, tool: BodyIndex
    ) -> None:
        source, inspector = plant.get_source_id(), scene_graph.model_inspector()
        for ball in chain.from_iterable(ToolShapes(plant, scene_graph, tool).values()):
            material = _slot_material(self, inspector.GetProximityProperties(ball))
            scene_graph.AssignRole(source, ball, material, RoleAssign.kReplace)


def _slot_material(slot: Slot, former: ProximityProperties | None = None) -> ProximityProperties:
    return ContactMaterial(2 * slot.stiffness, slot.dissipation, slot.friction, former)


def _boxes_of_slot(slot: Slot) -> dict[str, tuple[RigidTransform, Box]]:
    edge, c, depth = slot.width / 2, slot.chamfer, slot.depth
    boxes = {}
    for name, side in (("left", 1.0), ("right", -1.0)):

        def block(inner: float, top: float, side: float = side) -> tuple[RigidTransform, Box]:
            """Return a box at y side * `inner` [m] and beyond, from z = `top` down to the floor."""
            across, height = edge + c + _SIDE_BLOCK_WIDTH_M - inner, depth + top
            middle = RigidTransform([0.0, side * (inner + across / 2), top - height / 2])
            return middle, Box(SLOT_LENGTH_M, across, height)

        # The upper face of this box is the chamfer; its thickness fills the gap of wall and top.
        tilt, thick = RotationMatrix.MakeXRotation(side * np.pi / 4), c / np.sqrt(2)
        face = np.array([0.0, side * (edge + c / 2), -c / 2])
        into = RigidTransform(tilt, face - tilt.matrix()[:, 2] * thick / 2)
        boxes[f"{name}_wall"] = block(edge, -c)
        boxes[f"{name}_top"] = block(edge + c, 0.0)
        boxes[f"{name}_chamfer"] = into, Box(SLOT_LENGTH_M, c * np.sqrt(2), thick)
    across = slot.width + 2 * (c + _SIDE_BLOCK_WIDTH_M)
    below = RigidTransform([0.0, 0.0, -depth - _SLOT_FLOOR_THICKNESS_M / 2])
    boxes["floor"] = below, Box(SLOT_LENGTH_M, across, _SLOT_FLOOR_THICKNESS_M)
    return boxes
