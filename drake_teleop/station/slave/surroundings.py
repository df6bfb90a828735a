"""Environment in the slave's plant: its moving bodies, and the choice of the contact law."""

from __future__ import annotations

import re
from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.geometry import GeometryId, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody import tree
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_teleop.common.blocks import NO_EXTRA_SLOTS, weak_callback
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.station.environment import moving_bodies, point_contact
from drake_teleop.station.environment.environment import Environment, ToolShapes

_IDENTITY_TOLERANCE_RAD_OR_M = 1e-12  # rounding of frames
_MIN_MASS_MATRIX_EIGENVALUE_SI = 1e-12  # kg or kg m^2, smallest valid eigenvalue


class AddedEnvironment(NamedTuple):
    """Model instances of an environment; `leaf_instance` has its sprung body, if any."""

    instances: Collection[tree.ModelInstanceIndex]
    leaf_instance: tree.ModelInstanceIndex | None


class ToolContactModel(NamedTuple):
    """Model of the contact between tool and environment.

    Attributes:
        compiled_pairs: (k, 28) spheres and boxes (`ShapePairs`); empty with `drake_contact_reason`.
        monitored_pairs: (l, 40) other shapes (`ShapePairs`), computed by Drake at close range.
        joint_table: (m, 21) joints of moving boxes, from `MakeJointTableAndRowBodies`.
        plant_state_size: size of the plant's state, 0 without joints.
        drake_contact_reason: why Drake's contact results replace the compiled law, or empty.
        tool_bodies, tool_shapes: indices of the tool's bodies, identifiers of their shapes.
        leaf_parameters: (4,) mass [kg], stiffness [N/m], damping [N s/m], gravity [m/s^2].
        leaf_instance: model instance of the leaf or another `moving_part`, or None.
        moving_bodies: indices of other moving bodies, by name.
    """

    compiled_pairs: Array = np.zeros((0, point_contact.NUM_PAIR_COLUMNS))
    monitored_pairs: Array = np.zeros((0, point_contact.NUM_MONITORED_COLUMNS))
    joint_table: Array = np.zeros((0, moving_bodies.NUM_JOINT_TABLE_COLUMNS))
    plant_state_size: int = 0
    drake_contact_reason: str = ""
    tool_bodies: frozenset[int] = frozenset()
    tool_shapes: frozenset[int] = frozenset()
    leaf_parameters: Array = np.array([1.0, 0.0, 0.0, 0.0])
    leaf_instance: tree.ModelInstanceIndex | None = None
    moving_bodies: dict[str, tree.BodyIndex] = {}  # noqa: RUF012  (never changed)


def AddEnvironment(plant: MultibodyPlant, environment: Environment) -> AddedEnvironment:
    before, leaf_instance = plant.num_model_instances(), None
    for part in environment.parts:
        if part.moving_part is not None:
            leaf_instance = tree.ModelInstanceIndex(plant.num_model_instances())
        part.AddTo(plant)
    added = range(before, plant.num_model_instances())
    return AddedEnvironment([tree.ModelInstanceIndex(index) for index in added], leaf_instance)


def MakeToolContactModel(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    sensor_frame: tree.Frame,
    tool: tree.BodyIndex,
    environment: Environment,
    added: AddedEnvironment,
) -> ToolContactModel:
    """Return the contact model of tool and environment, in a finalized plant.

    `scene_graph` contains only shapes of tool and environment. A DrakeTeleopError is raised for
    hydroelastic contact without hydroelastic shapes, or moving bodies without mass.
    """
    environment.PrepareContact(plant, scene_graph, tool)
    shapes, context = ToolShapes(plant, scene_graph, tool), plant.CreateDefaultContext()
    contact = ToolContactModel(
        # Integers, because Drake's identifiers would keep the plant alive.
        tool_bodies=frozenset(int(index) for index in shapes),
        tool_shapes=frozenset(shape.get_value() for own in shapes.values() for shape in own),
        leaf_instance=added.leaf_instance,
        moving_bodies=MovingBodiesExceptLeaf(plant, added),
    )
    if contact.moving_bodies:
        inertia = np.linalg.eigvalsh(plant.CalcMassMatrix(context))
        if not inertia.min() > _MIN_MASS_MATRIX_EIGENVALUE_SI:
            bodies = {name: plant.get_body(k) for name, k in contact.moving_bodies.items()}
            names = [name for name, body in bodies.items() if not body.default_mass() > 0.0]
            what = f"the body {' or '.join(names or bodies)} can move, but has no mass or inertia"
            remedy = "give it mass and inertia, or weld it"
            raise DrakeTeleopError(what, where="environment", remedy=remedy)
    for part in environment.parts:
        if part.moving_part is not None:
            gravity = plant.gravity_field().gravity_vector()[2]
            contact = contact._replace(leaf_parameters=np.array([*part.moving_part, gravity]))
    if environment.hydroelastic:
        return contact._replace(drake_contact_reason="contact is hydroelastic")
    if contact.leaf_instance is not None and len(environment.parts) > 1:
        return contact._replace(drake_contact_reason="the sheet spring is not the only object")
    joints, order = contact.joint_table, list[int]()
    if contact.moving_bodies:
        moving = contact.moving_bodies.values()
        joints, order = moving_bodies.MakeJointTableAndRowBodies(plant, moving)
    from_S = dict[GeometryId, RigidTransform]()
    for index, own in shapes.items():
        frame = plant.get_body(index).body_frame()
        X_SBody = plant.CalcRelativeTransform(context, sensor_frame, frame)
        is_identity = X_SBody.IsNearlyIdentity(_IDENTITY_TOLERANCE_RAD_OR_M)
        from_S |= dict.fromkeys(own, RigidTransform() if is_identity else X_SBody)
    inspector, slip_speed = scene_graph.model_inspector(), environment.slip_speed
    touched = [*added.instances, tree.world_model_instance()]  # a link "world" may have shapes
    try:
        compiled, monitored, reason = point_contact.FindContactPairs(
            plant, inspector, from_S, touched, slip_speed, order
        )
    except DrakeTeleopError as error:
        return contact._replace(drake_contact_reason=str(error))
    if not len(compiled):
        return contact._replace(drake_contact_reason=reason or "no shapes can touch")
    return contact._replace(
        compiled_pairs=compiled,
        monitored_pairs=monitored,
        joint_table=joints,
        plant_state_size=plant.num_multibody_states() if len(joints) else 0,
    )


def MovingBodiesExceptLeaf(
    plant: MultibodyPlant, added: AddedEnvironment
) -> dict[str, tree.BodyIndex]:
    """Return indices of the environment's moving bodies, except the leaf, by unique name."""
    instances = [each for each in added.instances if each != added.leaf_instance]
    indices = [index for instance in instances for index in plant.GetBodyIndices(instance)]
    moving = [body for body in map(plant.get_body, indices) if not plant.IsAnchored(body)]
    short = [re.sub(r"\W+", "_", body.name()) for body in moving]
    full = [re.sub(r"\W+", "_", body.scoped_name().get_full()) for body in moving]
    names = [s if short.count(s) == 1 else f for s, f in zip(short, full, strict=True)]
    numbers = [int(body.index()) for body in moving]
    unique = [n if names.count(n) == 1 else f"{n}_{k}" for n, k in zip(names, numbers, strict=True)]
    return dict(zip(unique, map(tree.BodyIndex, numbers), strict=True))


def supports_pose_conversion(joint: tree.Joint) -> bool:
    """Return whether `joint_positions_of_pose` supports the joint."""
    kinds = (tree.RevoluteJoint, tree.PrismaticJoint, tree.QuaternionFloatingJoint)
    return joint.num_positions() == 0 or isinstance(joint, kinds)


def joint_positions_of_pose(joint: tree.Joint, X_FM: RigidTransform) -> Array:
    if isinstance(joint, tree.RevoluteJoint):
        turn = AngleAxis(X_FM.rotation().matrix())
        return np.array([turn.angle() * (turn.axis() @ joint.revolute_axis())])
    if isinstance(joint, tree.PrismaticJoint):
        return np.array([X_FM.translation() @ joint.translation_axis()])
    turned = X_FM.rotation().ToQuaternion().wxyz()
    return np.concatenate([turned, X_FM.translation()])[: joint.num_positions()]


class MovingBodyPose(LeafSystem):
    """Block that outputs the pose X_WB (7,) of a moving body from the whole plant's [q; v]."""

    __slots__ = NO_EXTRA_SLOTS

    def __init__(self, plant: MultibodyPlant, body: tree.BodyIndex) -> None:
        super().__init__()
        self._joints, order = moving_bodies.MakeJointTableAndRowBodies(plant, [body])
        self._bodies = np.empty((len(order), moving_bodies.BODY_STATE_SIZE))
        self._state = self.DeclareVectorInputPort("plant_state", plant.num_multibody_states())
        self.DeclareVectorOutputPort("pose", 7, weak_callback(self._calc_body_pose))

    def _calc_body_pose(self, context: Context, output: BasicVector) -> None:
        moving_bodies.poses_and_twists_into(self._joints, self._state.Eval(context), self._bodies)
        output.SetFromVector(self._bodies[-1, :7])  # the body is last in its chain
