"""Repair of SDF texts: only the model with the sensor, without elements that Drake ignores."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.slave.model import repair_report, urdf_repair
from drake_teleop.station.slave.model.model_references import (
    PACKAGE_FOLDER_SETTINGS,
    ModelFiles,
    read_xml,
)
from drake_teleop.station.slave.model.model_tree import link_of_frame

# Children that Drake reads; it also reads elements with its own prefix.
_CHILD_TAGS_READ_BY_DRAKE = {
    "model": {"pose", "link", "joint", "frame", "model", "include", "static"},
    "link": {"pose", "inertial", "collision", "visual"},
    "collision": {"pose", "geometry", "surface"},
    "visual": {"pose", "geometry", "material"},
}


def repair_sdf(
    root: Element, file: Path, files: ModelFiles, purpose: urdf_repair.ModelPurpose, folder: Path
) -> repair_report.RepairedModel:
    """Return an SDF text that Drake reads, with converted meshes and includes in `folder`."""
    report = repair_report.RepairReport(strict=purpose.is_scene)
    if not purpose.is_scene:
        _keep_model_with_sensor(root, file, files, purpose.sensor_name, report)
        for element in list(root.iter()):
            allowed = _CHILD_TAGS_READ_BY_DRAKE.get(element.tag)
            for child in list(element) if allowed else ():
                if child.tag not in (allowed or ()) and not child.tag.startswith("drake:"):
                    element.remove(child)
    urdf_repair.repair_links_and_joints(root, purpose, report, is_sdf=True)
    for model in root.findall("model"):
        model.set("name", model.get("name") or file.stem)
    report.raise_faults(file)
    uris = root.iterfind(".//include/uri")
    inner = [_repair_included_file(uri, file, files, purpose, folder) for uri in uris]
    mesh_folder = folder if purpose.plant_has_shapes else None
    own = urdf_repair.convert_meshes_and_write_text(root, file, files, report, mesh_folder)
    return repair_report.merge_repaired_models(own.text, [own, *filter(None, inner)])


def _repair_included_file(
    uri: Element, file: Path, files: ModelFiles, purpose: urdf_repair.ModelPurpose, folder: Path
) -> repair_report.RepairedModel | None:
    """Let an include refer to a repaired copy of its file; return it, or None for a folder."""
    address = (uri.text or "").strip()
    included = _find_included_model_file(address, file, files)
    if included is None:  # Drake searches in more places, and crashes on a circle through them
        what = f"includes {address!r}, which does not exist"
        remedy = f"correct the path, or name its package's folder: {PACKAGE_FOLDER_SETTINGS}"
        raise DrakeTeleopError(what, where=str(file), remedy=remedy)
    uri.text = f"file://{included.resolve()}"  # or Drake uses the working folder
    repair = {".urdf": urdf_repair.repair_urdf, ".sdf": repair_sdf}.get(included.suffix.lower())
    if repair is None or not included.is_file():
        return None
    part = purpose._replace(is_in_directives=True)
    repaired = repair(read_xml(included), included, files, part, folder)
    target = folder / f"{len(list(folder.iterdir()))}_{included.name}"
    target.write_text(repaired.text, encoding="utf-8")
    uri.text = f"file://{target}"
    return repaired


def _find_included_model_file(address: str, file: Path, files: ModelFiles) -> Path | None:
    found = files.find_file(address, file.resolve().parent) or files.find_file(address)
    if found is not None and (found / "model.config").is_file():
        named = read_xml(found / "model.config").findall("sdf")
        inner = files.find_file((named[0].text or "").strip(), found) if len(named) == 1 else None
        return inner or found
    return found


def _keep_model_with_sensor(
    root: Element, file: Path, files: ModelFiles, sensor: str, report: repair_report.RepairReport
) -> None:
    worlds = root.findall("world")
    children = [child for scope in (root, *worlds) for child in scope]
    models = [child for child in children if child.tag in ("model", "include")]
    if not worlds and len(models) <= 1:
        return
    with_sensor = [each for each in models if _has_sensor_frame(each, file, files, sensor)]
    if len(with_sensor) != 1:
        return  # Drake or the search for the frame reports it
    (kept,) = with_sensor
    for child in [child for child in root if child.tag in ("world", "model", "include")]:
        root.remove(child)
    if kept.tag == "include":
        around = SubElement(root, "model", name="model_of_world")
        around.append(kept)
    else:
        root.append(kept)
    for other in models:
        if other is not kept:
            name = other.get("name") or other.findtext("name") or other.findtext("uri") or ""
            report.state_repair("models beside the arm left out:", name)


def _has_sensor_frame(model: Element, file: Path, files: ModelFiles, sensor: str) -> bool:
    if model.tag == "model":
        inner = [each for each in model.iter() if each.tag == "model"]
        return any(link_of_frame(scope, sensor) for scope in inner)
    included = _find_included_model_file((model.findtext("uri") or "").strip(), file, files)
    if included is None or included.suffix.lower() not in (".urdf", ".sdf"):
        return False
    scopes = [each for each in read_xml(included).iter() if each.tag in ("robot", "model")]
    return any(link_of_frame(scope, sensor) for scope in scopes)
