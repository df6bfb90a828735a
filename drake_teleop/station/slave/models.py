"""Parsing of arms, tools and surroundings; only the arm's joints up to the sensor move."""

from __future__ import annotations

import os
import weakref
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from pydrake.math import RigidTransform
from pydrake.multibody.parsing import (
    FlattenModelDirectives,
    LoadModelDirectives,
    Parser,
    ProcessModelDirectives,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, ModelInstanceIndex, RigidBody, WeldJoint

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.texts import read_text, read_yaml
from drake_teleop.station.slave.chain_joints import (
    assume_rotor_inertias,
    check_chain,
    check_joints_form_tree,
    is_joint_moving,
    set_one_actuator_per_joint,
    weld_base_and_find_chain,
    weld_free_bodies,
    weld_held_joints,
    weld_joints_outside_chain,
)
from drake_teleop.station.slave.drake_errors import (
    ROBOT_ERROR_TEXTS,
    SCENE_ERROR_TEXTS,
    raise_logged_errors,
    translate_drake_errors,
)
from drake_teleop.station.slave.model.mjcf_repair import repair_mjcf
from drake_teleop.station.slave.model.model_references import ModelFiles, read_xml
from drake_teleop.station.slave.model.repair_report import (
    RepairedModel,
    describe_frame_fault,
    merge_repaired_models,
)
from drake_teleop.station.slave.model.sdf_repair import repair_sdf
from drake_teleop.station.slave.model.urdf_repair import ModelPurpose, repair_urdf

_XACRO_FAULT = "is a xacro file, not a model"
_XACRO_REMEDY = "run it through xacro first, and give the URDF that comes out"
_REPAIR_FUNCTION_OF_SUFFIX = {".urdf": repair_urdf, ".sdf": repair_sdf, ".xml": repair_mjcf}


def repair_and_parse_model(
    plant: MultibodyPlant, path: Path, package_paths: tuple[Path, ...], purpose: ModelPurpose
) -> tuple[list[ModelInstanceIndex], RepairedModel]:
    """Repair the text of a model file, and parse it into a plant.

    Return the added instances, and the repair, with text "" if a part was not repaired.
    """
    if not os.path.isfile(path):
        raise DrakeTeleopError("there is no such file", where=str(path), remedy="correct the path")
    kind = path.suffix.lower()
    if kind == ".xacro":
        raise DrakeTeleopError(_XACRO_FAULT, where=str(path), remedy=_XACRO_REMEDY)
    if kind == ".xml":
        read_text(path)  # raises an error for invalid encoding
    if kind == ".yaml":
        read_yaml(path, tagged=True)  # fails cleanly on deep nesting, unlike Drake's parser
    files = ModelFiles(path, package_paths)
    purpose = purpose._replace(plant_has_shapes=plant.geometry_source_is_registered())
    parser = Parser(plant)
    parser.SetAutoRenaming(True)
    files.merge_packages_with_map(parser.package_map())
    files.check_referenced_files(path)
    folder = TemporaryDirectory(prefix="drake_teleop_")
    weakref.finalize(plant, folder.cleanup)  # Drake reads converted meshes later
    forces = plant.num_force_elements()
    expected = SCENE_ERROR_TEXTS if purpose.is_scene else ROBOT_ERROR_TEXTS
    with translate_drake_errors(path, expected, folder.name):
        read = _add_files_of_directives if kind == ".yaml" else _add_repaired_file
        instances, repaired = read(parser, path, files, purpose, Path(folder.name))
        check_joints_form_tree(plant, str(path))
    if not purpose.is_scene and plant.num_force_elements() > forces:
        what = "the model has springs or other force elements, which are not supported"
        remedy = "remove them; only motors, gravity and contact move the arm"
        raise DrakeTeleopError(what, where=str(path), remedy=remedy)
    text = "".join(each.text for each in repaired) if all(e.text for e in repaired) else ""
    return instances, merge_repaired_models(text, repaired)


def _add_repaired_file(
    parser: Parser, path: Path, files: ModelFiles, purpose: ModelPurpose, folder: Path
) -> tuple[list[ModelInstanceIndex], list[RepairedModel]]:
    repaired = _repair_file(path, files, purpose, folder)
    with raise_logged_errors():
        if repaired.text:
            kind = path.suffix.lower().removeprefix(".")
            instances = parser.AddModelsFromString(repaired.text, kind)
        else:
            instances = parser.AddModels(str(path))
    return instances, [repaired]


def _add_files_of_directives(
    parser: Parser, path: Path, files: ModelFiles, purpose: ModelPurpose, folder: Path
) -> tuple[list[ModelInstanceIndex], list[RepairedModel]]:
    with raise_logged_errors():
        directives = FlattenModelDirectives(LoadModelDirectives(str(path)), parser.package_map())
    repaired, purpose = dict[Path, RepairedModel](), purpose._replace(is_in_directives=True)
    for added in (each.add_model for each in directives.directives if each.add_model):
        file = files.find_file(added.file)
        if file is None:
            continue  # Drake reports it
        if file not in repaired:
            repaired[file] = _repair_file(file, files, purpose, folder)
        if repaired[file].text:
            copy = folder / f"{len(repaired)}_{file.name}"
            copy.write_text(repaired[file].text, encoding="utf-8")
            added.file = f"file://{copy}"
    with raise_logged_errors():
        models = ProcessModelDirectives(directives, parser)
    return [each.model_instance for each in models], list(repaired.values())


def _repair_file(
    path: Path, files: ModelFiles, purpose: ModelPurpose, folder: Path
) -> RepairedModel:
    kind = path.suffix.lower()
    if kind not in _REPAIR_FUNCTION_OF_SUFFIX:
        return RepairedModel("", [], {})
    root = read_xml(path)
    if any(element.tag.startswith("xacro:") for element in root.iter()):
        raise DrakeTeleopError(_XACRO_FAULT, where=str(path), remedy=_XACRO_REMEDY)
    return _REPAIR_FUNCTION_OF_SUFFIX[kind](root, path, files, purpose, folder)


class ParsedArm(NamedTuple):
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
) -> ParsedArm:
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
    return ParsedArm(instance, frame, [*repaired.assumptions, *free, *held, *rotors])


def ParseTool(
    plant: MultibodyPlant, path: Path, sensor_frame: Frame, package_paths: tuple[Path, ...] = ()
) -> tuple[RigidBody, list[str]]:
    """Parse a tool, weld its root link to S by the joint "sensor_weld", and weld its own joints.

    Return the root link, and texts about assumed or repaired data.
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
