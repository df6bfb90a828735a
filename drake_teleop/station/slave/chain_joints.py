"""Search and edits of joints in a parsed plant: welds, motors, visual sticks for missing shapes.

The chain is the list of joints from the base outwards to the sensor, welds included.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import dropwhile, product

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.geometry import Capsule
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody import tree
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, Joint, PrismaticJoint, RevoluteJoint, RigidBody, WeldJoint

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.station.slave.model.model_repair import join_names
from drake_teleop.station.slave.model.model_tree import WORLD_NAME

# Rotor inertia, seen at the joint, of an arm of length L [m]: this mass [kg] times L^2. It gives
# 0.1 kg m^2 at 0.85 m, as common models of such arms have, and 0.02 kg m^2 at 0.4 m.
_ROTOR_INERTIA_PER_LENGTH_SQUARED_KG = 0.14
_PRISMATIC_DRIVE_MASS_KG = 5.0  # mass that moves with a prismatic joint instead
# Largest mass of a sensor body that is only a frame, and its largest distance to the origin of the
# link that it shares.
_MAX_FRAME_MASS_KG, _MAX_FRAME_OFFSET_M = 1e-6, 1e-6
MAX_JOINT_POSITION_LIMIT_SI = 1e4  # larger: no limit; SDF specifies 1e16
_SKELETON_CAPSULE_RADIUS_M = 0.035
_SKELETON_COLOUR = np.array([0.62, 0.64, 0.67, 1.0])


def joints_by_child(plant: MultibodyPlant) -> dict[tree.BodyIndex, Joint]:
    return {j.child_body().index(): j for j in map(plant.get_joint, plant.GetJointIndices())}


def chain_to_body(plant: MultibodyPlant, body: RigidBody) -> list[Joint]:
    """Return the joints from the base outwards to a body, welds included."""
    inboard, chain = joints_by_child(plant), list[Joint]()
    while body.index() in inboard:
        chain.append(inboard[body.index()])
        body = chain[-1].parent_body()
    return chain[::-1]


def bodies_carried_by(plant: MultibodyPlant, body: RigidBody) -> list[RigidBody]:
    """Return all bodies outboard of a body in the tree of joints, the nearest first."""
    joints = joints_by_child(plant).values()
    near = [j.child_body() for j in joints if j.parent_body().index() == body.index()]
    return near + [far for each in near for far in bodies_carried_by(plant, each)]


def check_joints_form_tree(plant: MultibodyPlant, where: str) -> None:
    parents: dict[tree.BodyIndex, Joint] = {}
    world = plant.world_body().index()
    for joint in map(plant.get_joint, plant.GetJointIndices()):
        child = joint.child_body()
        if child.index() in parents or child.index() == world:
            other, name = parents.get(child.index()), joint.name()
            parent = name if other is None else f"two joints, {other.name()} and {name}"
            what = f"link {child.name()} is the child of {parent}"
            remedy = "make each link the child of one joint, and the world the child of none"
            raise DrakeTeleopError(what, where=where, remedy=remedy)
        parents[child.index()] = joint
    for start in parents:
        index, passed = start, {start}
        while index in parents:
            index = parents[index].parent_body().index()
            if index in passed:
                what = f"its joints form a loop through {plant.get_body(index).name()}"
                remedy = "remove a joint of the loop, or model only the chain to the sensor"
                raise DrakeTeleopError(what, where=where, remedy=remedy)
            passed.add(index)


def weld_base_and_find_chain(
    plant: MultibodyPlant, frame: Frame, X_WBase: RigidTransform | None, where: str
) -> list[Joint]:
    """Weld a free base to the world at `X_WBase` (None: identity); return the chain to `frame`.

    A DrakeTeleopError is raised if the base moves, as on a rail, and X_WBase is not identity.
    """
    chain, X_WB = chain_to_body(plant, frame.body()), X_WBase or RigidTransform()
    base = chain[0].parent_body() if chain else frame.body()
    if base.index() != plant.world_body().index():
        plant.WeldFrames(plant.world_frame(), base.body_frame(), X_WB)
    elif not X_WB.IsExactlyIdentity() and not isinstance(chain[0], WeldJoint):
        what = f"slave.base_pose cannot move {chain[0].name()}, which moves on the world"
        remedy = "leave it out, or attach the joint to a link that is free or fixed to the world"
        raise DrakeTeleopError(what, where=where, remedy=remedy)
    return chain


def move_bodies_welded_to_world(
    plant: MultibodyPlant, joints_before: set[tree.JointIndex], X_WFile: RigidTransform
) -> None:
    world = plant.world_body().index()
    for joint in map(plant.get_joint, sorted(set(plant.GetJointIndices()) - joints_before)):
        if isinstance(joint, WeldJoint) and joint.parent_body().index() == world:
            name, frame_M = joint.name(), joint.frame_on_child()
            X_WM = X_WFile @ joint.frame_on_parent().GetFixedPoseInBodyFrame() @ joint.X_FM()
            plant.RemoveJoint(joint)
            plant.AddJoint(WeldJoint(name, plant.world_frame(), frame_M, X_WM))


def weld_free_bodies(
    plant: MultibodyPlant, instances: Iterable[tree.ModelInstanceIndex]
) -> list[str]:
    """Weld bodies without a joint to the world; return a text on them."""
    held = joints_by_child(plant)
    bodies = [plant.get_body(k) for each in instances for k in plant.GetBodyIndices(each)]
    free = [body for body in bodies if body.index() not in held]
    for body in free:
        plant.WeldFrames(plant.world_frame(), body.body_frame())
    names = [body.name() for body in free if body.name() != WORLD_NAME]
    note = f"not connected to the arm and welded to the world: {join_names(names)}"
    return [note] if names else []


def check_chain(
    plant: MultibodyPlant, chain: list[Joint], dependence_reasons: dict[str, str], where: str
) -> None:
    """Raise DrakeTeleopError if a joint of the chain has several axes or depends on another."""
    for joint in chain:
        models = plant.GetModelInstanceName(joint.model_instance()).split("::")
        scopes = ["", *(f"{'::'.join(models[: k + 1])}::" for k in range(len(models)))]
        names = joint.name(), joint.child_body().name(), joint.parent_body().name()
        for scope, name in product(scopes, names):
            if reason := dependence_reasons.get(f"{scope}{name}"):
                what = f"{name} {reason}"
                remedy = "make the joints up to the sensor independent of each other"
                raise DrakeTeleopError(what, where=where, remedy=remedy)
        if not isinstance(joint, (RevoluteJoint, PrismaticJoint)) and joint.num_velocities() > 0:
            what = f"{joint.name()} is a {joint.type_name()} joint, which has several axes"
            remedy = "up to the sensor, use joints that turn about one axis or slide along it"
            raise DrakeTeleopError(what, where=where, remedy=remedy)


def weld_held_joints(
    plant: MultibodyPlant, frame: Frame, hold: dict[str, float], joints: Iterable[tree.JointIndex]
) -> list[str]:
    """Weld the joints in `hold` at the given positions [rad, m]; return a text per joint.

    Of joints with one name, that inboard of `frame` is welded.
    """
    ordered = *map(plant.get_joint, joints), *chain_to_body(plant, frame.body())
    known = {joint.name(): joint for joint in ordered if joint.num_velocities() > 0}
    for name, position in hold.items():
        joint = known.get(name)
        if joint is None:
            what = f"the model has no moving joint {name!r}"
            remedy = f"name one of {', '.join(sorted(known))}"
            raise DrakeTeleopError(what, where="slave.hold", remedy=remedy)
        if joint.num_velocities() != 1:
            what = f"{name} is a {joint.type_name()} joint, which has no single position"
            raise DrakeTeleopError(what, where="slave.hold", remedy="remove it from hold")
        lower, upper = joint.position_lower_limits()[0], joint.position_upper_limits()[0]
        if lower < upper and not lower <= position <= upper:
            what = f"{name} at {position:g} is outside its limits, {lower:g} to {upper:g}"
            raise DrakeTeleopError(what, where="slave.hold", remedy="check its value and unit")
        joint.set_default_positions(np.array([position]))
        _replace_joint_by_weld(plant, joint)
    return [f"held at {position:g}: {name}" for name, position in hold.items()]


def weld_joints_outside_chain(
    plant: MultibodyPlant, joints_before: set[tree.JointIndex], chain: list[Joint]
) -> list[str]:
    """Remove constraints, and weld moving joints outside `chain`; return a text.

    `joints_before`, which the plant had before the model, remain.
    """
    for constraint in plant.GetConstraintIds():  # for example of coupled fingers
        plant.RemoveConstraint(constraint)
    kept, names = joints_before | {joint.index() for joint in chain}, list[str]()
    for joint in map(plant.get_joint, set(plant.GetJointIndices()) - kept):
        if joint.num_velocities() > 0:
            names.append(joint.name())
            _replace_joint_by_weld(plant, joint)
    return [f"held: {join_names(sorted(names))}"] if names else []


def weld_load_of_link_to_sensor_frame(
    plant: MultibodyPlant, frame: Frame, chain: list[Joint]
) -> list[str]:
    """Weld bodies beside a massless sensor body, on the same link, to it: they become load.

    If the sensor's origin is not that of the link, the bodies remain part of the arm, and a text
    on them is returned.
    """
    X_LS = frame.GetFixedPoseInBodyFrame()
    for inboard in reversed(chain):
        body, link = inboard.child_body(), inboard.parent_body()
        if not isinstance(inboard, WeldJoint) or _carried_mass(plant, body) > _MAX_FRAME_MASS_KG:
            break
        X_LS = _pose_of_welded_child_in_parent(inboard) @ X_LS
        others = [
            joint
            for joint in joints_by_child(plant).values()
            if isinstance(joint, WeldJoint)
            and joint.parent_body().index() == link.index()
            and joint.child_body().index() != body.index()
            and _carried_mass(plant, joint.child_body()) > _MAX_FRAME_MASS_KG
        ]
        if others and np.linalg.norm(X_LS.translation()) > _MAX_FRAME_OFFSET_M:
            names = join_names(sorted(joint.child_body().name() for joint in others))
            mass = sum(_carried_mass(plant, joint.child_body()) for joint in others)
            what = f"not part of the load at {frame.name()}: {names} of the model, {mass:.4g} kg"
            return [f"{what} (part of the load with sensor_frame {link.name()})"]
        for joint in others:
            name, frame_M = joint.name(), joint.frame_on_child()
            X_SM = X_LS.inverse() @ joint.frame_on_parent().GetFixedPoseInBodyFrame() @ joint.X_FM()
            plant.RemoveJoint(joint)
            plant.AddJoint(WeldJoint(name, frame, frame_M, X_SM))
        if others:
            break
    return []


def _carried_mass(plant: MultibodyPlant, body: RigidBody) -> float:
    return sum(each.default_mass() for each in [body, *bodies_carried_by(plant, body)])


def _pose_of_welded_child_in_parent(weld: WeldJoint) -> RigidTransform:
    X_MB = weld.frame_on_child().GetFixedPoseInBodyFrame().inverse()
    return weld.frame_on_parent().GetFixedPoseInBodyFrame() @ weld.X_FM() @ X_MB


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


def set_one_actuator_per_joint(plant: MultibodyPlant, moving: list[Joint]) -> None:
    """Give each of the joints `moving` exactly one actuator, in this order.

    Limits of existing actuators, and actuators of other joints, remain.
    """
    data = {joint.index(): (np.inf, 0.0, 1.0) for joint in moving}
    for motor in list(map(plant.get_joint_actuator, plant.GetJointActuatorIndices())):
        if (index := motor.joint().index()) in data:
            drive = motor.default_rotor_inertia(), motor.default_gear_ratio()
            data[index] = motor.effort_limit(), *drive
            plant.RemoveJointActuator(motor)
    for joint in moving:
        effort, rotor, gear = data[joint.index()]
        actuator = plant.AddJointActuator(joint.name(), joint, effort)
        actuator.set_default_rotor_inertia(rotor)
        actuator.set_default_gear_ratio(gear)


def set_torque_limits(
    plant: MultibodyPlant, arm: tree.ModelInstanceIndex, limits: dict[str, float]
) -> None:
    motors = map(plant.get_joint_actuator, plant.GetJointActuatorIndices())
    known = {each.joint().name(): each for each in motors if each.model_instance() == arm}
    for name, limit in limits.items():
        if name not in known:
            what = f"the arm has no joint {name!r}"
            remedy = f"name one of {', '.join(known)}"
            raise DrakeTeleopError(what, where="slave.torque_limits", remedy=remedy)
        known[name].set_effort_limit(limit)


def add_rotor_inertias(
    plant: MultibodyPlant, chain: list[Joint], frame: Frame, auxiliary_bodies: set[str]
) -> list[str]:
    """Add a rotor inertia to each joint that moves no inertia up to the next joint; return texts.

    Joints beyond `auxiliary_bodies`, which the repair of the model added, do not count.
    """
    inertia = _ROTOR_INERTIA_PER_LENGTH_SQUARED_KG * _length_of_moving_chain_m(chain, frame) ** 2
    actuators = map(plant.get_joint_actuator, plant.GetJointActuatorIndices())
    motors = {each.joint().index(): each for each in actuators}
    turning, sliding = list[str](), list[str]()
    for joint in (joint for joint in chain if joint.index() in motors):
        motor, slides = motors[joint.index()], isinstance(joint, PrismaticJoint)
        has_rotor = motor.default_reflected_inertia() > 0.0
        if not has_rotor and not _joint_moves_inertia(plant, joint, auxiliary_bodies):
            (sliding if slides else turning).append(joint.name())
            motor.set_default_rotor_inertia(_PRISMATIC_DRIVE_MASS_KG if slides else inertia)
            motor.set_default_gear_ratio(1.0)
    notes = {
        f"a rotor inertia of {inertia:.3g} kg m^2": turning,
        f"a moved mass of {_PRISMATIC_DRIVE_MASS_KG:g} kg": sliding,
    }
    reason = "as the model has no inertia there"
    return [f"{what}, {reason}, for {join_names(names)}" for what, names in notes.items() if names]


def _joint_moves_inertia(plant: MultibodyPlant, joint: Joint, auxiliary_bodies: set[str]) -> bool:
    ahead, joints = [joint.child_body()], joints_by_child(plant).values()
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
    joints = list(dropwhile(lambda joint: joint.num_velocities() == 0, chain))
    length, ends = 0.0, [*(joint.frame_on_parent() for joint in joints[1:]), frame]
    for joint, end in zip(joints, ends, strict=False):
        segment = _frame_origin_in_body(end) - _frame_origin_in_body(joint.frame_on_child())
        length += float(np.linalg.norm(segment))
        if isinstance(joint, WeldJoint):
            length += float(np.linalg.norm(joint.X_FM().translation()))
    return length


def _frame_origin_in_body(frame: Frame) -> Array:
    return frame.GetFixedPoseInBodyFrame().translation()


def AddSkeleton(plant: MultibodyPlant, sensor_frame: Frame) -> None:
    """Add a visual stick to each arm link without visuals, from its joint to the next or to S."""
    p_BEnd = _frame_origin_in_body(sensor_frame)
    for joint in reversed(chain_to_body(plant, sensor_frame.body())):
        start, frame = _frame_origin_in_body(joint.frame_on_child()), joint.frame_on_parent()
        if not isinstance(joint, WeldJoint):
            _add_visual_capsule(plant, joint.child_body(), start, p_BEnd)
            p_BEnd = _frame_origin_in_body(frame)
            continue
        if joint.parent_body().index() == plant.world_body().index():
            _add_visual_capsule(plant, joint.child_body(), np.zeros(3), p_BEnd)
        p_BEnd = _pose_of_welded_child_in_parent(joint) @ p_BEnd


def _add_visual_capsule(plant: MultibodyPlant, body: RigidBody, start: Array, end: Array) -> None:
    if plant.GetVisualGeometriesForBody(body):
        return
    length = float(np.linalg.norm(end - start))
    is_long = length > _SKELETON_CAPSULE_RADIUS_M
    along = (end - start) / length if is_long else np.array([0.0, 0.0, 1.0])
    pose = RigidTransform(RotationMatrix.MakeFromOneVector(along, 2), (start + end) / 2)
    stick = Capsule(_SKELETON_CAPSULE_RADIUS_M, max(length, 1e-3))
    plant.RegisterVisualGeometry(body, pose, stick, f"stick_of_{body.name()}", _SKELETON_COLOUR)
