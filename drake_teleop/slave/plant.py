"""The slave's rigid bodies: arm, tool and what the scenario has to touch."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, ContactModel, MultibodyPlant
from pydrake.multibody.tree import BodyIndex, ModelInstanceIndex, WeldJoint
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.environment.environment import Environment
from drake_teleop.environment.point_contact import WIDTH, ContactPairs
from drake_teleop.errors import DrakeTeleopError
from drake_teleop.resources import models_dir
from drake_teleop.slave.arm import ArmModel
from drake_teleop.slave.arm_from_plant import ArmModelFromPlant
from drake_teleop.slave.inverse_kinematics import IkStatus, nearest_branch
from drake_teleop.slave.payload import AddPayload, Payload

#: S at home: the tool points down, x_S along x_W.
R_WS_HOME = RotationMatrix(np.diag([1.0, -1.0, -1.0]))
#: Elbow up, reaching forward (negative q2 and q3 lean to +x); home is the branch nearest to it.
_Q_NEAR_HOME = np.array([0.0, -0.5, -1.8, 0.0, -0.9, np.pi])


@dataclass(frozen=True)
class SlavePlant:
    """The plant and what the blocks around it need to know.

    Args:
        plant: continuous MultibodyPlant, finalized.
        instance: the arm with its tool.
        tool: the tool's body.
        arm: kinematics and dynamics up to S, with the tool as its load.
        sheet: model instance of what moves when it is touched, such as the leaf, if anything does.
        contact_pairs: (k, 27) what may touch, see `ContactPairs`; none without an environment.
        leaf: (4,) mass [kg], stiffness [N/m], damping [N s/m] of the leaf, and its acceleration by
            gravity [m/s^2]; without one, a mass that nothing moves.
    """

    plant: MultibodyPlant
    instance: ModelInstanceIndex
    tool: BodyIndex
    arm: ArmModel
    sheet: ModelInstanceIndex | None
    contact_pairs: NDArray[np.float64]
    leaf: NDArray[np.float64]

    @property
    def can_touch(self) -> bool:
        """Whether there is something to touch."""
        return len(self.contact_pairs) > 0

    @property
    def tip(self) -> NDArray[np.float64]:
        """(3,) p_STip, where the tool makes contact [m]."""
        return self.plant.GetFrameByName("tip").GetFixedPoseInBodyFrame().translation()


def NominalSlave(payload: Payload) -> SlavePlant:
    """The slave by itself, with nothing to touch, for its numbers: arm and tip."""
    return _nominal_slave(payload.mass, *payload.com)


@lru_cache(maxsize=4)  # to parse the models takes longer than to build a station of them
def _nominal_slave(mass: float, *com: float) -> SlavePlant:
    payload = Payload(mass=mass, com=list(com))
    return AddSlavePlant(DiagramBuilder(), [], None, np.zeros(6), payload)


def AddSlavePlant(
    builder: DiagramBuilder,
    position: list[float],
    environment: Environment | None,
    q_start: NDArray[np.float64] | None = None,
    payload: Payload | None = None,
) -> SlavePlant:
    """Adds the slave's plant, at rest.

    A scene graph, which costs time at every step, comes only with something to touch.

    Args:
        builder: the diagram.
        position: (3,) p_WS at the start [m]; the tool points down.
        environment: what there is to touch, or None.
        q_start: (6,) joint angles to start at instead [rad].
        payload: what the tool holds, if anything.

    Raises:
        DrakeTeleopError: if the arm cannot reach the start.
    """
    if environment is None:
        plant = builder.AddNamedSystem("slave_plant", MultibodyPlant(time_step=0.0))
    else:
        plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
        plant.set_name("slave_plant")
        plant.set_contact_model(ContactModel.kPoint)
        plant.set_stiction_tolerance(environment.slip)
    instance, tool = ParseSlave(plant)
    if payload is not None:
        AddPayload(plant, tool, payload)
    touched = None if environment is None else AddEnvironment(plant, environment)
    finalize(plant)
    pairs, leaf = np.zeros((0, WIDTH)), np.array([1.0, 0.0, 0.0, 0.0])
    if environment is not None and touched is not None:
        _remove_visuals(plant, scene_graph)
        environment.PrepareTool(plant, scene_graph)
        inspector = scene_graph.model_inspector()
        pairs = ContactPairs(plant, inspector, tool, touched, environment.slip)
    sheet = None
    if environment is not None and environment.moving_part is not None:
        sheet = touched
        leaf = np.array([*environment.moving_part, plant.gravity_field().gravity_vector()[2]])
    arm = ArmModelFromPlant(plant, instance, "sensor")
    start = home_position(arm, position) if q_start is None else q_start
    plant.SetDefaultPositions(instance, start)
    return SlavePlant(plant, instance, tool, arm, sheet, pairs, leaf)


def AddEnvironment(plant: MultibodyPlant, environment: Environment) -> ModelInstanceIndex:
    """Adds what there is to touch to a plant that has the tool and is not finalized."""
    return environment.AddTo(plant)


def ParseSlave(plant: MultibodyPlant) -> tuple[ModelInstanceIndex, BodyIndex]:
    """Parses arm and tool; the tool hangs on the wrist sensor through the joint "sensor_weld".

    Returns:
        The arm's model instance and the tool's body.
    """
    parser = Parser(plant)
    parser.package_map().AddPackageXml(str(models_dir() / "package.xml"))
    (arm,) = parser.AddModelsFromUrl("package://drake_teleop/rx90.sdf")
    parser.AddModelsFromUrl("package://drake_teleop/tool.sdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base", arm))
    tool = plant.GetBodyByName("tool")
    sensor = plant.GetFrameByName("sensor", arm)
    plant.AddJoint(WeldJoint("sensor_weld", sensor, tool.body_frame(), RigidTransform.Identity()))
    return arm, tool.index()


def finalize(plant: MultibodyPlant) -> None:
    """Finalizes a continuous plant whose joint limits somebody else watches.

    Continuous plants ignore limits, and Drake warns of it, even in the middle of a run. It does
    not for limits that are given after finalizing; the station's monitor and the inverse
    kinematics keep them.
    """
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    limits = [(joint.position_lower_limits(), joint.position_upper_limits()) for joint in joints]
    for joint, (lower, upper) in zip(joints, limits, strict=True):
        joint.set_position_limits(np.full_like(lower, -np.inf), np.full_like(upper, np.inf))
    plant.Finalize()
    for joint, (lower, upper) in zip(joints, limits, strict=True):
        joint.set_position_limits(lower, upper)


def _remove_visuals(plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
    """Every shape costs time at every step, and nobody looks at these: a replay has its own."""
    for index in range(plant.num_bodies()):
        for shape in plant.GetVisualGeometriesForBody(plant.get_body(BodyIndex(index))):
            scene_graph.RemoveGeometry(plant.get_source_id(), shape)


def home_position(arm: ArmModel, position: list[float]) -> NDArray[np.float64]:
    """Joint angles [rad] with S at `position` [m, in W], tool down, elbow bent upwards.

    Raises:
        DrakeTeleopError: if the arm cannot reach it.
    """
    q, status = nearest_branch(
        R_WS_HOME.matrix(), np.array(position), _Q_NEAR_HOME, arm.lower, arm.upper
    )
    if status != IkStatus.OK:
        raise DrakeTeleopError(
            f"the arm cannot reach {position} with the tool down ({IkStatus(status).name})",
            where="slave.position",
            remedy="move it nearer to (0.55, 0, 0.45)",
        )
    return q
