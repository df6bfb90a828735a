"""Repair of SDF texts: only the model with the sensor, without elements that Drake ignores."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.slave.model import urdf_repair
from drake_teleop.station.slave.model.model_references import PACKAGE_FOLDER_SETTINGS, read_xml
from drake_teleop.station.slave.model.model_repair import ModelRepair
from drake_teleop.station.slave.model.model_tree import link_of_frame

# Children that Drake reads; it also reads elements with its own prefix.
_CHILD_TAGS_READ_BY_DRAKE = {
    "model": {"pose", "link", "joint", "frame", "model", "include", "static"},
    "link": {"pose", "inertial", "collision", "visual"},
    "collision": {"pose", "geometry", "surface"},
    "visual": {"pose", "geometry", "material"},
}


def repair_sdf(model: ModelRepair) -> None:
    """Write an SDF text that Drake reads, with converted meshes and repaired included files."""
    if not model.purpose.is_scene:
        _keep_model_with_sensor(model)
        for element in list(model.root.iter()):
            allowed = _CHILD_TAGS_READ_BY_DRAKE.get(element.tag)
            for child in list(element) if allowed else ():
                if child.tag not in (allowed or ()) and not child.tag.startswith("drake:"):
                    element.remove(child)
    urdf_repair.repair_links_and_joints(model, is_sdf=True)
    for named in model.root.findall("model"):
        named.set("name", named.get("name") or model.path.stem)
    model.raise_faults()
    for uri in model.root.iterfind(".//include/uri"):
        _repair_included_file(uri, model)
    urdf_repair.convert_meshes_and_write_text(model)


def _repair_included_file(uri: Element, model: ModelRepair) -> None:
    """Let an include refer to a repaired copy of its file, if that is one file."""
    address = (uri.text or "").strip()
    included = _find_included_model_file(address, model)
    if included is None:  # Drake searches in more places, and crashes on a circle through them
        what = f"includes {address!r}, which does not exist"
        remedy = f"correct the path, or name its package's folder: {PACKAGE_FOLDER_SETTINGS}"
        raise DrakeTeleopError(what, where=str(model.path), remedy=remedy)
    uri.text = f"file://{included.resolve()}"  # or Drake uses the working folder
    repair = {".urdf": urdf_repair.repair_urdf, ".sdf": repair_sdf}.get(included.suffix.lower())
    if repair is not None and included.is_file():
        part = model.make_part(included)
        repair(part)
        model.add_results_of(part)
        uri.text = f"file://{model.write_file(included.name, part.text)}"


def _find_included_model_file(address: str, model: ModelRepair) -> Path | None:
    find = model.files.find_file
    found = find(address, model.path.resolve().parent) or find(address)
    if found is not None and (found / "model.config").is_file():
        named = read_xml(found / "model.config").findall("sdf")
        inner = find((named[0].text or "").strip(), found) if len(named) == 1 else None
        return inner or found
    return found


def _keep_model_with_sensor(model: ModelRepair) -> None:
    root = model.root
    worlds = root.findall("world")
    children = [child for scope in (root, *worlds) for child in scope]
    named = [child for child in children if child.tag in ("model", "include")]
    if not worlds and len(named) <= 1:
        return
    with_sensor = [each for each in named if _has_sensor_frame(each, model)]
    if len(with_sensor) != 1:
        return  # Drake or the search for the frame reports it
    (kept,) = with_sensor
    for child in [child for child in root if child.tag in ("world", "model", "include")]:
        root.remove(child)
    around = root if kept.tag == "model" else SubElement(root, "model", name="model_of_world")
    around.append(kept)
    for other in named:
        if other is not kept:
            name = other.get("name") or other.findtext("name") or other.findtext("uri") or ""
            model.state_repair("models beside the arm left out:", name)


def _has_sensor_frame(element: Element, model: ModelRepair) -> bool:
    if element.tag == "include":
        included = _find_included_model_file((element.findtext("uri") or "").strip(), model)
        if included is None or included.suffix.lower() not in (".urdf", ".sdf"):
            return False
        element = read_xml(included)
    scopes = [each for each in element.iter() if each.tag in ("robot", "model")]
    return any(link_of_frame(scope, model.purpose.sensor_name) for scope in scopes)
