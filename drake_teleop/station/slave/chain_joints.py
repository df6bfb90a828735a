"""Edits of a parsed plant: welds of base and held joints, motors of the joints up to the sensor."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    BodyIndex,
    Frame,
    Joint,
    JointIndex,
    ModelInstanceIndex,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
    WeldJoint,
)

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.slave.model.model_tree import WORLD_NAME
from drake_teleop.station.slave.model.repair_report import join_names

# Rotor inertia, seen at the joint, of an arm of length L [m]: this mass [kg] times L^2. It gives
# 0.1 kg m^2 at 0.85 m, as common models of such arms have, and 0.02 kg m^2 at 0.4 m.
_ROTOR_INERTIA_PER_LENGTH_SQUARED_KG = 0.14
_SLIDER_DRIVE_MASS_KG = 5.0  # mass that moves with a prismatic joint instead


def is_joint_moving(plant: MultibodyPlant, index: JointIndex) -> bool:
    return plant.get_joint(index).num_velocities() > 0


def check_joints_form_tree(plant: MultibodyPlant, where: str) -> None:
    """Raise DrakeTeleopError unless the joints form a tree; Drake aborts on loops."""
    parents: dict[BodyIndex, Joint] = {}
    world = plant.world_body().index()
    for joint in map(plant.get_joint, plant.GetJointIndices()):
        child = joint.child_body()
        if child.index() in parents or child.index() == world:
            other, name = parents.get(child.index()), joint.name()
            parent = name if other is None else f"two joints, {other.name()} and {name}"
            what = f"link {child.name()} is the child of {parent}"
            remedy = "an arm is a tree: make each link the child of one joint, the world of none"
            raise DrakeTeleopError(what, where=where, remedy=remedy)
        parents[child.index()] = joint
    for start in parents:
        index, passed = start, {start}
        while index in parents:
            index = parents[index].parent_body().index()
            if index in passed:
                what = f"its joints form a loop through {plant.get_body(index).name()}"
                remedy = "an arm is a tree: cut the loop, or model the chain to the sensor alone"
                raise DrakeTeleopError(what, where=where, remedy=remedy)
            passed.add(index)


def weld_base_and_find_chain(
    plant: MultibodyPlant, frame: Frame, X_WBase: RigidTransform | None, where: str
) -> list[JointIndex]:
    """Weld a free base to the world at `X_WBase`; return the joints from the base to `frame`.

    A DrakeTeleopError is raised if the model fixes its base and `X_WBase` is not the identity.
    """
    inboard = {j.child_body().index(): j for j in map(plant.get_joint, plant.GetJointIndices())}
    body, chain = frame.body(), list[Joint]()
    while body.index() in inboard:
        chain.append(inboard[body.index()])
        body = inboard[body.index()].parent_body()
    if body.index() != plant.world_body().index():
        X_WB = RigidTransform() if X_WBase is None else X_WBase
        plant.WeldFrames(plant.world_frame(), body.body_frame(), X_WB)
    elif X_WBase is not None and not X_WBase.IsExactlyIdentity():
        what = f"the model already welds its base {chain[-1].child_body().name()} to the world"
        remedy = "leave slave.base_pose out, or remove that joint from the model"
        raise DrakeTeleopError(what, where=where, remedy=remedy)
    return [joint.index() for joint in reversed(chain)]


def weld_free_bodies(plant: MultibodyPlant, instances: Iterable[ModelInstanceIndex]) -> list[str]:
    """Weld bodies without a joint to the world; return a list with at most one note on them."""
    held = {plant.get_joint(k).child_body().index() for k in plant.GetJointIndices()}
    bodies = [plant.get_body(k) for each in instances for k in plant.GetBodyIndices(each)]
    free = [body for body in bodies if body.index() not in held]
    for body in free:
        plant.WeldFrames(plant.world_frame(), body.body_frame())
    names = [body.name() for body in free if body.name() != WORLD_NAME]
    note = f"not connected to the arm and welded to the world: {join_names(names)}"
    return [note] if names else []


def check_chain(
    plant: MultibodyPlant, chain: list[JointIndex], dependence_reasons: dict[str, str], where: str
) -> None:
    """Raise DrakeTeleopError if a joint of the chain has several axes or moves with another."""
    for joint in (plant.get_joint(index) for index in chain):
        for name in (joint.name(), joint.child_body().name(), joint.parent_body().name()):
            if name in dependence_reasons:
                what = f"{name} {dependence_reasons[name]}"
                remedy = "the arm up to the sensor has to be a chain of independent joints"
                raise DrakeTeleopError(what, where=where, remedy=remedy)
        one_axis = isinstance(joint, (RevoluteJoint, PrismaticJoint))
        if joint.num_velocities() > 0 and not one_axis:
            what = f"{joint.name()} is a {joint.type_name()} joint, which has several axes"
            remedy = "up to the sensor, use joints that turn about one axis or slide along it"
            raise DrakeTeleopError(what, where=where, remedy=remedy)


def weld_held_joints(
    plant: MultibodyPlant, hold: dict[str, float], joints: Iterable[JointIndex]
) -> list[str]:
    """Weld the joints named in `hold` at its positions [rad, m]; return notes for the user."""
    moving = [plant.get_joint(k) for k in joints if is_joint_moving(plant, k)]
    known = {joint.name(): joint for joint in moving}
    for name, position in hold.items():
        joint = known.get(name)
        if joint is None:
            what = f"the model has no moving joint {name!r}"
            remedy = f"name one of {', '.join(sorted(known))}"
            raise DrakeTeleopError(what, where="slave.hold", remedy=remedy)
        if joint.num_velocities() != 1:
            what = f"{name} is a {joint.type_name()} joint, which has no single position"
            raise DrakeTeleopError(what, where="slave.hold", remedy="leave it out")
        lower, upper = joint.position_lower_limits()[0], joint.position_upper_limits()[0]
        if lower < upper and not lower <= position <= upper:
            what = f"{name} at {position:g} is outside its limits, {lower:g} to {upper:g}"
            raise DrakeTeleopError(what, where="slave.hold", remedy="check the value and its unit")
        joint.set_default_positions(np.array([position]))
        _replace_joint_by_weld(plant, joint)
    return [f"held at {position:g}: {name}" for name, position in hold.items()]


def weld_joints_outside_chain(
    plant: MultibodyPlant, joints_before: set[JointIndex], chain: list[JointIndex]
) -> list[str]:
    """Weld moving joints in neither `joints_before` nor `chain`; return notes for the user."""
    for constraint in plant.GetConstraintIds():  # for example of coupled fingers
        plant.RemoveConstraint(constraint)
    added = set(plant.GetJointIndices()) - joints_before - set(chain)
    joints = [plant.get_joint(index) for index in added if is_joint_moving(plant, index)]
    names = sorted(joint.name() for joint in joints)
    for joint in joints:
        _replace_joint_by_weld(plant, joint)
    return [f"held: {join_names(names)}"] if names else []


def _replace_joint_by_weld(plant: MultibodyPlant, joint: Joint) -> None:
    name, ends = joint.name(), (joint.frame_on_parent(), joint.frame_on_child())
    X_FM = _default_joint_pose(joint)
    for k in plant.GetJointActuatorIndices():
        if plant.get_joint_actuator(k).joint().index() == joint.index():
            plant.RemoveJointActuator(plant.get_joint_actuator(k))
    plant.RemoveJoint(joint)
    plant.AddJoint(WeldJoint(f"{name}_held", *ends, X_FM))


def _default_joint_pose(joint: Joint) -> RigidTransform:
    # Drake's `GetDefaultPose` covers few kinds of joints.
    q = joint.default_positions()
    if isinstance(joint, RevoluteJoint):
        return RigidTransform(AngleAxis(q[0], joint.revolute_axis()), np.zeros(3))
    if isinstance(joint, PrismaticJoint):
        return RigidTransform(q[0] * joint.translation_axis())
    return joint.GetDefaultPose() if np.any(q) else RigidTransform()


def set_one_actuator_per_joint(
    plant: MultibodyPlant, chain: list[JointIndex], limits: dict[str, float] | None
) -> None:
    """Give each moving joint of the chain one actuator, in the order of the chain.

    `limits` contains effort limits by joint; joints without an entry are unlimited. None keeps
    the limits of existing actuators.
    """
    moving = [index for index in chain if is_joint_moving(plant, index)]
    data = dict[JointIndex, tuple[float, float, float]]()
    for motor in list(map(plant.get_joint_actuator, plant.GetJointActuatorIndices())):
        if motor.joint().index() in moving:
            drive = motor.default_rotor_inertia(), motor.default_gear_ratio()
            data[motor.joint().index()] = motor.effort_limit(), *drive
            plant.RemoveJointActuator(motor)
    for index in moving:
        joint = plant.get_joint(index)
        effort, rotor, gear = data.get(index, (np.inf, 0.0, 1.0))
        if limits is not None:
            effort = limits.get(joint.name(), np.inf)
        actuator = plant.AddJointActuator(joint.name(), joint, effort)
        actuator.set_default_rotor_inertia(rotor)
        actuator.set_default_gear_ratio(gear)


def set_torque_limits(
    plant: MultibodyPlant, arm: ModelInstanceIndex, limits: dict[str, float]
) -> None:
    """Replace the effort limits of the named joints; raise DrakeTeleopError for an unknown one."""
    motors = map(plant.get_joint_actuator, plant.GetJointActuatorIndices())
    known = {each.joint().name(): each for each in motors if each.model_instance() == arm}
    for name, limit in limits.items():
        if name not in known:
            what = f"the arm has no joint {name!r}"
            remedy = f"name one of {', '.join(known)}"
            raise DrakeTeleopError(what, where="slave.torque_limits", remedy=remedy)
        known[name].set_effort_limit(limit)


def assume_rotor_inertias(
    plant: MultibodyPlant, chain: list[JointIndex], frame: Frame, auxiliary_bodies: frozenset[str]
) -> list[str]:
    """Give a joint a rotor inertia if its links have no inertia; return notes for the user.

    Links beyond the next joint count too if only `auxiliary_bodies`, not of the model, are between.
    """
    joints = [plant.get_joint(index) for index in chain]
    inertia = _ROTOR_INERTIA_PER_LENGTH_SQUARED_KG * _length_of_moving_chain_m(joints, frame) ** 2
    actuators = map(plant.get_joint_actuator, plant.GetJointActuatorIndices())
    motor = {each.joint().index(): each for each in actuators}
    turning, sliding = list[str](), list[str]()
    for joint in (joint for joint in joints if joint.index() in motor):
        has_rotor = motor[joint.index()].default_reflected_inertia() > 0.0
        if has_rotor or _carries_inertia(plant, joint, auxiliary_bodies):
            continue
        slides = isinstance(joint, PrismaticJoint)
        (sliding if slides else turning).append(joint.name())
        motor[joint.index()].set_default_rotor_inertia(_SLIDER_DRIVE_MASS_KG if slides else inertia)
        motor[joint.index()].set_default_gear_ratio(1.0)
    notes = {
        f"a rotor inertia of {inertia:.3g} kg m^2": turning,
        f"a moved mass of {_SLIDER_DRIVE_MASS_KG:g} kg": sliding,
    }
    reason = "as the model has no inertia there"
    return [f"{what}, {reason}, for {join_names(names)}" for what, names in notes.items() if names]


def _carries_inertia(plant: MultibodyPlant, joint: Joint, auxiliary_bodies: frozenset[str]) -> bool:
    ahead, joints = [joint.child_body()], [plant.get_joint(k) for k in plant.GetJointIndices()]
    while ahead:
        body: RigidBody = ahead.pop()
        moments = body.default_rotational_inertia().get_moments()
        if body.default_mass() > 0.0 and (isinstance(joint, PrismaticJoint) or moments.any()):
            return True
        outboard = [each for each in joints if each.parent_body().index() == body.index()]
        through = body.name() in auxiliary_bodies
        ahead += [e.child_body() for e in outboard if through or isinstance(e, WeldJoint)]
    return False


def _length_of_moving_chain_m(chain: list[Joint], frame: Frame) -> float:
    while chain and chain[0].num_velocities() == 0:
        chain = chain[1:]
    ends = [*(joint.frame_on_parent() for joint in chain[1:]), frame][: len(chain)]
    way = 0.0
    for joint, end in zip(chain, ends, strict=True):
        start = joint.frame_on_child().GetFixedPoseInBodyFrame().translation()
        way += float(np.linalg.norm(end.GetFixedPoseInBodyFrame().translation() - start))
        if isinstance(joint, WeldJoint):
            way += float(np.linalg.norm(joint.X_FM().translation()))
    return way
