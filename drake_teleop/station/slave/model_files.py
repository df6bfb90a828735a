"""Parsing of model files and model directives into Drake's plant, after repairs."""

from __future__ import annotations

import os
import weakref
from pathlib import Path
from tempfile import TemporaryDirectory

from pydrake.multibody.parsing import (
    FlattenModelDirectives,
    LoadModelDirectives,
    Parser,
    ProcessModelDirectives,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.texts import read_text, read_yaml
from drake_teleop.station.slave.chain_joints import check_joints_form_tree
from drake_teleop.station.slave.drake_errors import (
    ROBOT_ERROR_TEXTS,
    SCENE_ERROR_TEXTS,
    raise_logged_errors,
    translate_drake_errors,
)
from drake_teleop.station.slave.model.mjcf_repair import repair_mjcf
from drake_teleop.station.slave.model.model_references import ModelFiles, read_xml
from drake_teleop.station.slave.model.repair_report import RepairedModel, merge_repaired_models
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
    files.add_packages_to_map(parser.package_map())
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
