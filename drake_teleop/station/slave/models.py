"""Parsing of arms, tools and surroundings; only the arm's joints up to the sensor move."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, ModelInstanceIndex, RigidBody, WeldJoint

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.slave.chain_joints import (
    assume_rotor_inertias,
    check_chain,
    is_joint_moving,
    set_one_actuator_per_joint,
    weld_base_and_find_chain,
    weld_free_bodies,
    weld_held_joints,
    weld_joints_outside_chain,
)
from drake_teleop.station.slave.drake_errors import translate_drake_errors
from drake_teleop.station.slave.model.repair_report import describe_frame_fault
from drake_teleop.station.slave.model.urdf_repair import ModelPurpose
from drake_teleop.station.slave.model_files import repair_and_parse_model


@dataclass(frozen=True)
class ParsedModel:
    """Arm that was parsed into a plant."""

    instance: ModelInstanceIndex
    sensor_frame: Frame
    assumptions: list[str]


def ParseModel(
    plant: MultibodyPlant,
    path: Path,
    sensor_frame: str,
    package_paths: tuple[Path, ...] = (),
    X_WBase: RigidTransform | None = None,
    hold: dict[str, float] | None = None,
) -> ParsedModel:
    """Parse an arm into a plant; only the joints up to S move, each with one actuator.

    A free base is welded to the world at `X_WBase`, the joints `hold` at the given positions
    [rad, m], and other joints, such as a gripper's, at their defaults. Unreadable or contradictory
    models raise DrakeTeleopError.
    """
    before, hold, where = set(plant.GetJointIndices()), hold or {}, str(path)
    purpose = ModelPurpose(sensor_frame, hold)
    added_instances, repaired = repair_and_parse_model(plant, path, package_paths, purpose)
    frame = _find_sensor_frame(plant, added_instances, sensor_frame, where)
    added = set(plant.GetJointIndices()) - before
    held = weld_held_joints(plant, hold, added)
    chain = weld_base_and_find_chain(plant, frame, X_WBase, where)
    check_chain(plant, chain, repaired.dependence_reasons, where)
    free = weld_free_bodies(plant, added_instances)
    with translate_drake_errors(path):
        held += weld_joints_outside_chain(plant, before, chain)
        limits = repaired.effort_limits if repaired.text else None
        set_one_actuator_per_joint(plant, chain, limits)
        rotors = assume_rotor_inertias(plant, chain, frame, repaired.auxiliary_bodies)
    instances = {plant.get_joint(k).model_instance() for k in chain if is_joint_moving(plant, k)}
    if len(instances) > 1:
        names = sorted(map(plant.GetModelInstanceName, instances))
        what = f"the joints up to the sensor belong to several models, {', '.join(names)}"
        remedy = "write the chain up to the sensor as one model"
        raise DrakeTeleopError(what, where=where, remedy=remedy)
    instance = next(iter(instances), frame.model_instance())
    return ParsedModel(instance, frame, [*repaired.assumptions, *free, *held, *rotors])


def ParseTool(
    plant: MultibodyPlant, path: Path, sensor_frame: Frame, package_paths: tuple[Path, ...] = ()
) -> tuple[RigidBody, list[str]]:
    """Parse a tool, weld its root link to S by the joint "sensor_weld", and weld its own joints.

    Return the root link, and the assumptions.
    """
    before, purpose = set(plant.GetJointIndices()), ModelPurpose(is_tool=True)
    instances, repaired = repair_and_parse_model(plant, path, package_paths, purpose)
    held = {plant.get_joint(k).child_body().index() for k in plant.GetJointIndices()}
    bodies = [index for instance in instances for index in plant.GetBodyIndices(instance)]
    roots = [plant.get_body(index) for index in bodies if index not in held]
    if len(roots) != 1:
        names = ", ".join(body.name() for body in roots) or "none"
        what = f"the tool must have one root link, but has {len(roots)}: {names}"
        remedy = "give one tree of links; its root is welded to the sensor frame"
        raise DrakeTeleopError(what, where=str(path), remedy=remedy)
    with translate_drake_errors(path):
        assumptions = [*repaired.assumptions, *weld_joints_outside_chain(plant, before, [])]
    weld = WeldJoint("sensor_weld", sensor_frame, roots[0].body_frame(), RigidTransform.Identity())
    plant.AddJoint(weld)
    return roots[0], assumptions


def ParseScene(plant: MultibodyPlant, path: Path) -> None:
    """Parse the surroundings of an arm."""
    _, repaired = repair_and_parse_model(plant, path, (), ModelPurpose(is_scene=True))
    for name, what in repaired.dependence_reasons.items():
        remedy = "correct it; every object that the tool could touch must be readable"
        raise DrakeTeleopError(f"{name} {what}", where=str(path), remedy=remedy)


def _find_sensor_frame(
    plant: MultibodyPlant, instances: list[ModelInstanceIndex], name: str, where: str
) -> Frame:
    with_frame = [index for index in instances if plant.HasFrameNamed(name, index)]
    if len(with_frame) == 1:
        return plant.GetFrameByName(name, with_frame[0])
    names = {plant.get_frame(k).name() for each in instances for k in plant.GetFrameIndices(each)}
    # Without names that Drake creates for joints.
    ends = ("_parent", "_child", "__model__")
    named = {each for each in names if not each.endswith(ends)}
    what, remedy = describe_frame_fault(len(with_frame), name, named)
    raise DrakeTeleopError(what, where=where, remedy=remedy)
