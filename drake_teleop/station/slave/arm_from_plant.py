"""Conversion of a finalized MultibodyPlant to an `ArmModel`, and defaults for joint limits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydrake.math import RotationMatrix
from pydrake.multibody import tree
from pydrake.multibody.plant import MultibodyPlant

from drake_teleop.common.errors import DrakeTeleopError, suggest_name
from drake_teleop.common.numeric import Array
from drake_teleop.station.slave import chain_joints
from drake_teleop.station.slave.arm import (
    DAMPING_COLUMN,
    IS_PRISMATIC_COLUMN,
    LAST_ROW_GRAVITY_COLUMN,
    NUM_ARM_TABLE_COLUMNS,
    PHI_COLUMN,
    ROTATION_COLUMN,
    ROTOR_COLUMN,
    TRANSLATION_COLUMN,
    ArmModel,
)

OneAxisJoint: TypeAlias = tree.RevoluteJoint | tree.PrismaticJoint
_DEFAULT_SPEED_LIMIT_RAD_S = np.pi
_DEFAULT_JOINT_HALF_RANGE_M, _DEFAULT_SPEED_LIMIT_M_S = 1.0, 1.0  # of a prismatic joint
_MAX_PLAUSIBLE_JOINT_RANGE_RAD = 8 * np.pi  # larger ranges may be in degrees
_TIME_TO_SPEED_LIMIT_S = 0.4  # to the speed limit


def ArmModelFromPlant(
    plant: MultibodyPlant,
    model_instance: tree.ModelInstanceIndex,
    sensor_frame_name: str = "sensor",
) -> ArmModel:
    """Return the arm between the world and the sensor frame of a finalized plant.

    A DrakeTeleopError is raised if a joint between them is not revolute, prismatic or a weld, or a
    further joint moves a body on these links. Joints beyond S are at their default positions.
    """
    if not plant.HasFrameNamed(sensor_frame_name, model_instance):
        what = f"{plant.GetModelInstanceName(model_instance)} has no frame {sensor_frame_name!r}"
        known = sorted(plant.get_frame(k).name() for k in plant.GetFrameIndices(model_instance))
        remedy = suggest_name(sensor_frame_name, known, f"name one of {', '.join(known)}")
        raise DrakeTeleopError(what, where="sensor_frame_name", remedy=remedy)
    frame_S = plant.GetFrameByName(sensor_frame_name, model_instance)
    joints = _moving_joints_to_sensor(plant, frame_S)
    actuators = [plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()]
    motors = [[a for a in actuators if a.joint().index() == j.index()] for j in joints]
    efforts = [min((motor.effort_limit() for motor in each), default=np.inf) for each in motors]
    n = len(joints)
    table = np.zeros((n + 1, NUM_ARM_TABLE_COLUMNS))
    for row, joint in enumerate(joints):
        table[row, ROTOR_COLUMN] = sum(motor.default_reflected_inertia() for motor in motors[row])
        table[row, DAMPING_COLUMN] = joint.default_damping()
        table[row, IS_PRISMATIC_COLUMN] = isinstance(joint, tree.PrismaticJoint)
    field = plant.gravity_field()
    gravity = field.gravity_vector() * field.is_enabled(model_instance)
    table[n, LAST_ROW_GRAVITY_COLUMN:IS_PRISMATIC_COLUMN] = gravity

    context = plant.CreateDefaultContext()
    sliding = tree.PrismaticJoint
    axes = [j.translation_axis() if isinstance(j, sliding) else j.revolute_axis() for j in joints]
    # Frame L of a link is frame M of its joint, rotated so that the joint's axis becomes z.
    R_ML = [*(RotationMatrix.MakeFromOneVector(axis, 2) for axis in axes), RotationMatrix()]
    frames_M = [*(joint.frame_on_child() for joint in joints), frame_S]
    frames_F = [*(joint.frame_on_parent() for joint in joints), frame_S]
    bodies_of_rows = _bodies_moved_by_joints(plant, joints, frame_S.body())
    frame_P, R_MP = plant.world_frame(), RotationMatrix()
    for row, (frame_M, frame_F) in enumerate(zip(frames_M, frames_F, strict=True)):
        X_MpF, R = plant.CalcRelativeTransform(context, frame_P, frame_F), R_ML[row]
        rotation = R_MP.inverse() @ X_MpF.rotation() @ R
        table[row, ROTATION_COLUMN:TRANSLATION_COLUMN] = rotation.matrix().ravel()
        table[row, TRANSLATION_COLUMN:PHI_COLUMN] = R_MP.inverse() @ X_MpF.translation()
        M_LMo_M = plant.CalcSpatialInertia(context, frame_M, bodies_of_rows[row])
        M_LLo_L = M_LMo_M.ReExpress(R.inverse())
        I_LLo_L = M_LLo_L.CalcRotationalInertia().CopyToFullMatrix3()[np.triu_indices(3)]
        table[row, PHI_COLUMN:ROTOR_COLUMN] = M_LLo_L.get_mass(), *M_LLo_L.CalcComMoment(), *I_LLo_L
        frame_P, R_MP = frame_M, R
    limits = np.array([_joint_limits(joint) for joint in joints]).T.copy()
    lower, upper, speed, acceleration = limits
    rates = speed, acceleration, np.array(efforts)
    q_index = np.array([j.position_start() for j in joints], dtype=np.intp)
    v_index = np.array([j.velocity_start() for j in joints], dtype=np.intp)
    names = tuple(joint.name() for joint in joints)
    return ArmModel(names, table, lower, upper, *rates, q_index, v_index)


def _joint_limits(joint: OneAxisJoint) -> tuple[float, float, float, float]:
    """Return lower, upper, speed and acceleration limit of a joint; infinite for no limit."""
    lower, upper = joint.position_lower_limits()[0], joint.position_upper_limits()[0]
    limit = chain_joints.MAX_JOINT_POSITION_LIMIT_SI
    # Exporters write 0 to 0 for unknown limits.
    is_unknown = isinstance(joint, tree.RevoluteJoint) and lower == upper == 0.0
    lower = -np.inf if is_unknown or lower < -limit else lower
    upper = np.inf if is_unknown or upper > limit else upper
    return lower, upper, joint.velocity_upper_limits()[0], joint.acceleration_upper_limits()[0]


def _moving_joints_to_sensor(plant: MultibodyPlant, frame_S: tree.Frame) -> list[OneAxisJoint]:
    joints = list[OneAxisJoint]()
    for joint in chain_joints.chain_to_body(plant, frame_S.body()):
        if isinstance(joint, (tree.RevoluteJoint, tree.PrismaticJoint)):
            joints.append(joint)
        elif not isinstance(joint, tree.WeldJoint):
            what = f"the arm up to the sensor contains an unsupported {joint.type_name()} joint"
            remedy = "weld the arm's base to the world; up to the sensor, use joints of one axis"
            raise DrakeTeleopError(what, where=joint.name(), remedy=remedy)
    if not joints:
        what = f"no joint moves {frame_S.name()}: all joints between it and the world are fixed"
        remedy = "name a frame or link that the arm moves"
        raise DrakeTeleopError(what, where="sensor_frame", remedy=remedy)
    return joints


def _bodies_moved_by_joints(
    plant: MultibodyPlant, joints: list[tree.Joint], sensor_body: tree.RigidBody
) -> list[list[tree.BodyIndex]]:
    """Return, by joint, the bodies that it moves but the next does not; the load is last."""
    outboard = [set(plant.GetBodiesKinematicallyAffectedBy([j.index()])) for j in joints]
    load = {body.index() for body in chain_joints.bodies_carried_by(plant, sensor_body)}
    rows = [inner - outer - load for inner, outer in pairwise([*outboard, set()])]
    inboard = chain_joints.joints_by_child(plant)
    for link, bodies in zip((joint.child_body() for joint in joints), rows, strict=True):
        loose = bodies - {body.index() for body in plant.GetBodiesWeldedTo(link)}
        moving = [inboard[k] for k in loose if inboard[k].parent_body().index() not in loose]
        if moving:
            where, name = moving[0].name(), link.name()
            what = f"moves on link {name}, but is not a joint between the world and the sensor"
            raise DrakeTeleopError(what, where=f"joint {where}", remedy="weld this joint")
    return [*map(list, rows), list(load)]


def values_per_joint(
    arm: ArmModel, values: Sequence[float], where: str, default: float | Array | None = None
) -> Array:
    """Return values (n,); with a `default`, `values` may be empty, or one number for all joints."""
    n = arm.num_joints
    if len(values) not in ((n,) if default is None else (0, 1, n)):
        one = "" if default is None else "one for all, or "
        what = f"has {len(values)} numbers, but the arm has {n} joints"
        remedy = f"give {one}{n}, for {', '.join(arm.joint_names)}"
        raise DrakeTeleopError(what, where=where, remedy=remedy)
    return np.broadcast_to(np.array(values if len(values) else default, float), (n,)).copy()


def fill_missing_joint_limits(
    arm: ArmModel, where: str, acceleration: tuple[float, ...] = (), hint: str = ""
) -> tuple[ArmModel, list[str]]:
    """Return the arm with defaults for missing joint limits, and one text per assumed default.

    `acceleration` contains 0, 1 or n limits [rad/s^2] that replace the model's; `hint` ends the
    text about accelerations.
    """
    assumptions = []
    slides = arm.table[:-1, IS_PRISMATIC_COLUMN] != 0.0
    unlimited = (arm.lower == -np.inf) & (arm.upper == np.inf)
    unlimited |= slides & (arm.lower == 0.0) & (arm.upper == 0.0)  # as in `_joint_limits`
    immovable = ~unlimited & (arm.lower == arm.upper)
    if immovable.any():
        unit = "m" if slides[immovable][0] else "rad"
        name, limit = np.array(arm.joint_names)[immovable][0], arm.lower[immovable][0]
        what = f"{name} cannot move: both of its limits are {limit:g} {unit}"
        remedy = "correct the limits, or make the joint fixed"
        raise DrakeTeleopError(what, where=where, remedy=remedy)
    reach = np.where(slides, _DEFAULT_JOINT_HALF_RANGE_M, np.pi)
    lower = np.where(unlimited & slides, -reach, arm.lower)
    upper = np.where(unlimited & slides, reach, arm.upper)
    half_limited = np.isinf(lower) != np.isinf(upper)
    lowest = np.where(half_limited & np.isinf(lower), upper - 2 * reach, lower)
    lower, upper = lowest, np.where(half_limited & np.isinf(upper), lower + 2 * reach, upper)
    speed = np.where(slides, _DEFAULT_SPEED_LIMIT_M_S, _DEFAULT_SPEED_LIMIT_RAD_S)
    velocity = np.where(_is_positive_and_finite(arm.velocity_limit), arm.velocity_limit, speed)
    effort = np.where(_is_positive_and_finite(arm.effort_limit), arm.effort_limit, np.inf)
    place = f"{where}: acceleration"
    specified = values_per_joint(arm, acceleration, place, arm.acceleration_limit)
    default = velocity / _TIME_TO_SPEED_LIMIT_S
    limit = np.where(_is_positive_and_finite(specified), specified, default)
    limits: Any = {"velocity_limit": velocity, "acceleration_limit": limit, "effort_limit": effort}
    completed = replace(arm, lower=lower, upper=upper, **limits)
    plausible = slides | unlimited | (upper - lower < _MAX_PLAUSIBLE_JOINT_RANGE_RAD)
    only_limit = "a range of 360 degrees from the only limit"
    turning_speed = f"a speed limit of {_DEFAULT_SPEED_LIMIT_RAD_S:.4g} rad/s"
    sliding_speed = f"a speed limit of {_DEFAULT_SPEED_LIMIT_M_S:g} m/s"
    in_rad = f"limits in rad, though more than {_MAX_PLAUSIBLE_JOINT_RANGE_RAD:.4g} apart,"
    rate_text = f"acceleration limits that reach full speed in {_TIME_TO_SPEED_LIMIT_S:g} s{hint}"
    for missing, revolute_text, prismatic_text in (
        (unlimited, "unlimited rotation", f"a range of +-{_DEFAULT_JOINT_HALF_RANGE_M:g} m"),
        (half_limited, only_limit, f"a range of {2 * _DEFAULT_JOINT_HALF_RANGE_M:g} m"),
        (~_is_positive_and_finite(arm.velocity_limit), turning_speed, sliding_speed),
        (~_is_positive_and_finite(specified), rate_text, rate_text),
        (~np.isfinite(effort), "no torque limit", "no force limit"),
        (~plausible, in_rad, ""),
    ):
        for text, kind in ((revolute_text, ~slides), (prismatic_text, slides)):
            assumed = missing & kind
            if assumed.any():
                names = ", ".join(np.array(arm.joint_names)[assumed])
                assumptions.append(f"{text} for {'all joints' if assumed.all() else names}")
    return completed, assumptions


def _is_positive_and_finite(limits: Array) -> NDArray[np.bool_]:
    return np.isfinite(limits) & (limits > 0)


_MIN_ARM_LENGTH_M, _MAX_ARM_LENGTH_M = 0.01, 50.0


def check_arm_lengths(arm: ArmModel, where: str) -> None:
    """Raise DrakeTeleopError for implausible arm length, or distance of a mass from its joint."""
    length = float(np.linalg.norm(arm.table[1:, TRANSLATION_COLUMN:PHI_COLUMN], axis=1).sum())
    rule = f"{_MIN_ARM_LENGTH_M:g} to {_MAX_ARM_LENGTH_M:g} m are plausible"
    remedy = f"give lengths in m ({rule}), and inertias in kg m^2"
    if 0.0 < length < _MIN_ARM_LENGTH_M or length > _MAX_ARM_LENGTH_M:
        what = f"from its first joint to the sensor the arm is {length:.3g} m long"
        raise DrakeTeleopError(what, where=where, remedy=remedy)
    for name, phi in zip((*arm.joint_names, "the sensor"), arm.table[:, PHI_COLUMN:], strict=True):
        # Root mean square distance of the mass from the joint's origin.
        distance = np.sqrt((phi[4] + phi[7] + phi[9]) / (2.0 * phi[0])) if phi[0] > 0.0 else 0.0
        if distance > _MAX_ARM_LENGTH_M:
            what = f"the mass that {name} moves is {distance:.3g} m away from {name}"
            raise DrakeTeleopError(what, where=where, remedy=remedy)
