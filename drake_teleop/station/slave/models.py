"""Parsing of arms, tools and surroundings; of arms only joints up to the sensor move."""

from __future__ import annotations

import logging
import os
import re
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from pydrake.math import RigidTransform
from pydrake.multibody import parsing
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, ModelInstanceIndex, RigidBody, WeldJoint

from drake_teleop.common.errors import MAX_ERROR_LINE_LENGTH, DrakeTeleopError, silent_stderr
from drake_teleop.common.texts import read_text, read_yaml
from drake_teleop.station.slave import chain_joints
from drake_teleop.station.slave.model.mjcf_repair import repair_mjcf
from drake_teleop.station.slave.model.model_references import ModelFiles
from drake_teleop.station.slave.model.model_repair import XACRO_REMEDY, ModelPurpose, ModelRepair
from drake_teleop.station.slave.model.urdf_and_sdf_repair import repair_sdf, repair_urdf

_XACRO_FAULT = "is a xacro file, not a model"
_UNUSED_XACRO_TAGS = ("xacro:property", "xacro:arg")  # of no effect without ${...} and $(...)
_REPAIR_FUNCTION_OF_SUFFIX = {".urdf": repair_urdf, ".sdf": repair_sdf, ".xml": repair_mjcf}
_ROBOT_PACKAGE_REMEDY = "with --package-path for package://"
_SCENE_PACKAGE_REMEDY = "its package:// addresses in folders around it"
# Places in Drake's source and in repaired texts, which the user does not have.
_DRAKE_SOURCE_PREFIX_PATTERN = re.compile(r"Failure at \S+ in \w+(\(\))?: ")
_REPAIRED_TEXT_LOCATION_PATTERN = re.compile(r"<(literal|data)-string>(\.\w+)?(:\d+)*:? ?")
_REPAIRED_FILE_PATTERN = r"(file://)?{folder}/\d+_([^\s:'\"]*)(:\d+)*"
_NUM_SEPARATOR_CHARACTERS = 30  # " ... " and separators of the error line


def repair_and_parse_model(
    plant: MultibodyPlant, path: Path, package_paths: tuple[Path, ...], purpose: ModelPurpose
) -> tuple[list[ModelInstanceIndex], ModelRepair]:
    if not os.path.isfile(path):
        raise DrakeTeleopError("file does not exist", where=str(path), remedy="correct the path")
    kind = path.suffix.lower()
    if kind == ".xacro":
        raise DrakeTeleopError(_XACRO_FAULT, where=str(path), remedy=XACRO_REMEDY)
    if kind == ".xml":
        read_text(path)  # raises an error for invalid encoding
    if kind == ".yaml":
        read_yaml(path, tagged=True)  # fails cleanly on deep nesting, unlike Drake's parser
    files = ModelFiles(path, package_paths)
    purpose = purpose._replace(plant_has_shapes=plant.geometry_source_is_registered())
    parser = parsing.Parser(plant)
    parser.SetAutoRenaming(True)
    files.merge_packages_with_map(parser.package_map())
    files.check_referenced_files(path)
    folder = TemporaryDirectory(prefix="drake_teleop_")
    weakref.finalize(plant, folder.cleanup)  # Drake reads converted meshes later
    forces = plant.num_force_elements()
    model = ModelRepair(path, files, purpose, Path(folder.name))
    with translate_drake_errors(path, folder.name, is_scene=purpose.is_scene):
        instances = (_add_directives if kind == ".yaml" else _add_model_file)(parser, model)
        chain_joints.check_joints_form_tree(plant, str(path))
    if not purpose.is_scene and plant.num_force_elements() > forces:
        what = "the model has springs or other force elements, which are not supported"
        remedy = "remove them; only motors, gravity and contact move the arm"
        raise DrakeTeleopError(what, where=str(path), remedy=remedy)
    if not os.listdir(folder.name):
        folder.cleanup()  # at once, because workers of a study end without clean-up
    return instances, model


def _add_model_file(parser: parsing.Parser, model: ModelRepair) -> list[ModelInstanceIndex]:
    _repair_model_text(model)
    with raise_logged_errors():
        if model.text:
            return parser.AddModelsFromString(model.text, model.path.suffix.lower()[1:])
        return parser.AddModels(str(model.path))


def _add_directives(parser: parsing.Parser, model: ModelRepair) -> list[ModelInstanceIndex]:
    with raise_logged_errors():
        loaded = parsing.LoadModelDirectives(str(model.path))
        directives = parsing.FlattenModelDirectives(loaded, parser.package_map())
    parts = dict[Path, ModelRepair]()
    for added in (each.add_model for each in directives.directives if each.add_model):
        file = model.files.find_file(added.file)
        if file is None:
            continue  # Drake reports it
        if file not in parts:
            parts[file] = model.repair_file(file, _repair_model_text)
        if parts[file].text:
            added.file = f"file://{model.write_file(file.name, parts[file].text)}"
        reasons = parts[file].dependence_reasons
        model.dependence_reasons |= {f"{added.name}::{k}": why for k, why in reasons.items()}
    with raise_logged_errors():
        return [x.model_instance for x in parsing.ProcessModelDirectives(directives, parser)]


def _repair_model_text(model: ModelRepair) -> None:
    if repair := _REPAIR_FUNCTION_OF_SUFFIX.get(model.path.suffix.lower()):
        _remove_unused_xacro_elements(model)
        repair(model)


def _remove_unused_xacro_elements(model: ModelRepair) -> None:
    elements = list(model.root.iter())
    found = {each.tag for each in elements if each.tag.startswith("xacro:")}
    values = [value for each in elements for value in (*each.attrib.values(), each.text or "")]
    uses = any("${" in value or "$(" in value for value in values)
    if found and (uses or found.difference(_UNUSED_XACRO_TAGS)):
        raise DrakeTeleopError(_XACRO_FAULT, where=str(model.path), remedy=XACRO_REMEDY)
    for parent in elements:
        for child in [each for each in parent if each.tag in found]:
            parent.remove(child)


class ParsedArm(NamedTuple):
    """Arm in a plant; `assumptions` are texts about assumed or repaired data."""

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

    S is `sensor_frame`. `X_WBase` places a free base, or all links welded to the world. Joints in
    `hold` are welded at these positions [rad, m], joints beside the chain at their defaults.
    Unreadable or contradictory models raise DrakeTeleopError.
    """
    before, hold, where = set(plant.GetJointIndices()), hold or {}, str(path)
    purpose = ModelPurpose(sensor_frame, hold)
    instances, model = repair_and_parse_model(plant, path, package_paths, purpose)
    frame = _find_sensor_frame(plant, instances, model)
    added = sorted(set(plant.GetJointIndices()) - before)
    held = chain_joints.weld_held_joints(plant, frame, hold, added)
    chain = chain_joints.weld_base_and_find_chain(plant, frame, X_WBase, where)
    chain_joints.check_chain(plant, chain, model.dependence_reasons, where)
    free = chain_joints.weld_free_bodies(plant, instances)
    moving = [joint for joint in chain if joint.num_velocities() > 0]
    with translate_drake_errors(path):
        held += chain_joints.weld_joints_outside_chain(plant, before, chain)
        is_on_world = chain and chain[0].parent_body().index() == plant.world_body().index()
        if is_on_world and X_WBase is not None and not X_WBase.IsExactlyIdentity():
            chain_joints.move_bodies_welded_to_world(plant, before, X_WBase)
            chain = chain_joints.chain_to_body(plant, frame.body())
        held += chain_joints.weld_load_of_link_to_sensor_frame(plant, frame, chain)
        chain_joints.set_one_actuator_per_joint(plant, moving)
        rotors = chain_joints.add_rotor_inertias(plant, chain, frame, model.auxiliary_bodies)
    of_chain = {joint.model_instance() for joint in moving}
    if len(of_chain) > 1:
        names = sorted(map(plant.GetModelInstanceName, of_chain))
        what = f"the joints up to the sensor belong to several models, {', '.join(names)}"
        remedy = 'make them one model, in SDF by <include merge="true">'
        raise DrakeTeleopError(what, where=where, remedy=remedy)
    instance = next(iter(of_chain), frame.model_instance())
    return ParsedArm(instance, frame, [*model.assumptions, *free, *held, *rotors])


def ParseTool(
    plant: MultibodyPlant, path: Path, sensor_frame: Frame, package_paths: tuple[Path, ...] = ()
) -> tuple[RigidBody, list[str]]:
    """Parse a tool, weld its root link to S by the joint "sensor_weld", and weld its own joints.

    Return the root link, and texts about assumed or repaired data.
    """
    before, purpose = set(plant.GetJointIndices()), ModelPurpose(is_tool=True)
    instances, model = repair_and_parse_model(plant, path, package_paths, purpose)
    held = chain_joints.joints_by_child(plant)
    bodies = [index for instance in instances for index in plant.GetBodyIndices(instance)]
    roots = [plant.get_body(index) for index in bodies if index not in held]
    if len(roots) != 1:
        names = ", ".join(body.name() for body in roots) or "none"
        what = f"the tool must have one root link, but has {len(roots)}: {names}"
        remedy = "give one tree of links; its root is welded to the sensor frame"
        raise DrakeTeleopError(what, where=str(path), remedy=remedy)
    with translate_drake_errors(path):
        held_joints = chain_joints.weld_joints_outside_chain(plant, before, [])
    weld = WeldJoint("sensor_weld", sensor_frame, roots[0].body_frame(), RigidTransform.Identity())
    plant.AddJoint(weld)
    return roots[0], [*model.assumptions, *held_joints]


def ParseScene(plant: MultibodyPlant, path: Path) -> list[str]:
    """Parse surroundings; return texts about assumed or ineffective data.

    Mimic joints and links that float on links raise DrakeTeleopError.
    """
    instances, model = repair_and_parse_model(plant, path, (), ModelPurpose(is_scene=True))
    for name, what in model.dependence_reasons.items():
        remedy = "make it independent, as all joints and links of surroundings must be"
        raise DrakeTeleopError(f"{name} {what}", where=str(path), remedy=remedy)
    for joint in (plant.get_joint(k) for each in instances for k in plant.GetJointIndices(each)):
        limits = *joint.position_lower_limits(), *joint.position_upper_limits()
        if any(abs(limit) < chain_joints.MAX_JOINT_POSITION_LIMIT_SI for limit in limits):
            model.add_assumption("no effect of the position limits in the file on", joint.name())
    return model.assumptions


def _find_sensor_frame(
    plant: MultibodyPlant, instances: list[ModelInstanceIndex], model: ModelRepair
) -> Frame:
    name = model.purpose.sensor_name
    with_frame = [index for index in instances if plant.HasFrameNamed(name, index)]
    if len(with_frame) == 1:
        return plant.GetFrameByName(name, with_frame[0])
    names = {plant.get_frame(k).name() for each in instances for k in plant.GetFrameIndices(each)}
    # Without names that Drake creates for joints.
    named = {each for each in names if not each.endswith(("_parent", "_child", "__model__"))}
    what, remedy = model.describe_frame_fault(len(with_frame), named)
    raise DrakeTeleopError(what, where=str(model.path), remedy=remedy)


@contextmanager
def translate_drake_errors(
    path: Path, folder: str = "", *, is_scene: bool = False
) -> Iterator[None]:
    """Convert Drake's exceptions in a with-block to a DrakeTeleopError that names the model file.

    Messages name the original files instead of repaired copies in `folder`.
    """
    try:
        yield
    except DrakeTeleopError:
        raise
    # SystemExit: failed condition in Drake; LookupError: from C++ containers.
    except (RuntimeError, SystemExit, ValueError, LookupError) as error:
        reason = _DRAKE_SOURCE_PREFIX_PATTERN.sub("", " ".join(str(error).split()))
        reason = _REPAIRED_TEXT_LOCATION_PATTERN.sub("", reason)
        if folder:
            reason = re.sub(_REPAIRED_FILE_PATTERN.format(folder=re.escape(folder)), r"\2", reason)
        what = f"cannot be read as a {'scene' if is_scene else 'robot'}"
        packages = _SCENE_PACKAGE_REMEDY if is_scene else _ROBOT_PACKAGE_REMEDY
        remedy = f"give a URDF, SDF, MJCF or .dmd.yaml model, {packages}"
        room = MAX_ERROR_LINE_LENGTH - _NUM_SEPARATOR_CHARACTERS - len(f"{path}{what}{remedy}")
        if len(reason) > room:
            reason = f"{reason[:room]} ..."
        raise DrakeTeleopError(what, where=str(path), remedy=f"{remedy} ({reason})") from None


@contextmanager
def raise_logged_errors() -> Iterator[None]:
    """Raise RuntimeError after the block if Drake logged an error or an inertia message."""
    errors: list[str] = []

    def collect_error_message(record: logging.LogRecord) -> bool:
        message = record.getMessage()
        if record.levelno >= logging.ERROR or "inertia" in message:
            errors.append(" ".join(message.split()))
        return False

    log = logging.getLogger("drake")
    log.addFilter(collect_error_message)
    try:
        with silent_stderr():  # the parsers below Drake write to stderr
            yield
    finally:
        log.removeFilter(collect_error_message)
    if errors:
        raise RuntimeError("; ".join(dict.fromkeys(errors)))
