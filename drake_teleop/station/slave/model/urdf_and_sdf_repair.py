"""Repair of URDF and SDF texts, so that Drake reads the arm in them.

Faults of links and joints that the arm does not need are repaired. Every repair is reported.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.slave.model import model_numbers, model_tree
from drake_teleop.station.slave.model.meshes import remove_unusable_shapes
from drake_teleop.station.slave.model.model_references import PACKAGE_FOLDER_SETTINGS, read_xml
from drake_teleop.station.slave.model.model_repair import ModelRepair
from drake_teleop.station.slave.model.model_tree import joint_link, link_of_frame, list_joints

# Children that Drake reads; it also reads elements with its own prefix.
_CHILD_TAGS_READ_BY_DRAKE = {
    "robot": {"link", "joint", "material", "frame", "transmission"},
    "model": {"pose", "link", "joint", "frame", "model", "include", "static"},
    "link": {"pose", "inertial", "collision", "visual"},
    "collision": {"pose", "geometry", "surface"},
    "visual": {"pose", "geometry", "material"},
}
_ONE_AXIS_TYPES = ("revolute", "continuous", "prismatic")
_DRAKE_ROTOR_TAGS = ("drake:rotor_inertia", "drake:gear_ratio")


def repair_urdf(model: ModelRepair) -> None:
    """Set `model.text` to a URDF text that Drake reads, with converted meshes."""
    root = model.root
    root.set("name", root.get("name") or model.path.stem)
    if not model.purpose.is_scene:
        _remove_children_ignored_by_drake([root])
        _keep_one_material_per_name(root)
    _repair_links_and_joints(model, is_sdf=False)
    if not model.purpose.is_scene:
        _remove_references_to_missing_parts(root)
        _keep_one_transmission_per_joint(model)
    _convert_meshes_and_write_xml(model)


def repair_sdf(model: ModelRepair) -> None:
    """Set `model.text` to an SDF text that Drake reads; convert meshes, repair included files."""
    if not model.purpose.is_scene:
        _remove_models_without_sensor_frame(model)
        _remove_children_ignored_by_drake(list(model.root.iter()))
    _repair_links_and_joints(model, is_sdf=True)
    for named in model.root.findall("model"):
        named.set("name", named.get("name") or model.path.stem)
    model.raise_faults()
    for uri in model.root.iterfind(".//include/uri"):
        _repair_included_file(uri, model)
    _convert_meshes_and_write_xml(model)


def _remove_children_ignored_by_drake(elements: list[Element]) -> None:
    for element in elements:
        allowed = _CHILD_TAGS_READ_BY_DRAKE.get(element.tag, {child.tag for child in element})
        for child in list(element):
            if child.tag not in allowed and not child.tag.startswith("drake:"):
                element.remove(child)


def _repair_links_and_joints(model: ModelRepair, *, is_sdf: bool) -> None:
    model_numbers.replace_commas_by_blanks(model.root)
    scopes = [each for each in model.root.iter() if each.tag in ("robot", "model")]
    for scope in scopes:
        if is_sdf:
            _replace_frames_of_joints_by_links(scope)
        _make_joint_and_link_names_unique(scope, model, is_sdf=is_sdf)
    chain, num_joints_to_link = _reduce_model_to_arm(scopes, model) or (set(), {})
    for scope in scopes:
        links = {link.get("name", "") for link in scope.findall("link")}
        joints = list_joints(scope)
        for joint in joints:
            model_numbers.repair_joint(joint, links, model, in_chain=joint in chain)
        moving = {joint_link(each, "child") for each in joints if each.get("type") != "fixed"}
        for link in scope.findall("link"):
            name = link.get("name", "")
            for part in [link] if model.purpose.is_scene else link.findall("inertial"):
                model_numbers.check_lengths_and_inertias(part, f"link {name}", model)
            is_fixed = num_joints_to_link.get(name) == 0
            repair = model_numbers.repair_inertia_and_detect_missing
            if repair(link, model, is_sdf=is_sdf, is_fixed=is_fixed) and name in moving:
                model.add_assumption("no inertia of", name)


def _convert_meshes_and_write_xml(model: ModelRepair) -> None:
    model.raise_faults()
    remove_unusable_shapes(model)
    model.raise_faults()
    model.dependence_reasons = find_mimics_and_floating_links(model.root) | model.dependence_reasons
    model.text = ElementTree.tostring(model.root, encoding="unicode")


def find_mimics_and_floating_links(root: Element) -> dict[str, str]:
    """Return, by name of mimic joint or floating link, on which part it depends."""
    found: dict[str, str] = {}
    for joint in root.iter("joint"):
        parent = joint_link(joint, "parent")
        if joint.find("mimic") is not None or joint.find("axis/mimic") is not None:
            found[joint.get("name", "")] = "moves with another joint (mimic)"
        if joint.get("type") == "floating" and parent != model_tree.WORLD_NAME:
            found[joint_link(joint, "child")] = f"floats on {parent}"
    return found


def _reduce_model_to_arm(
    scopes: list[Element], model: ModelRepair
) -> tuple[set[Element], dict[str, int]] | None:
    purpose = model.purpose
    if purpose.is_tool:
        for joint in (joint for scope in scopes for joint in list_joints(scope)):
            model_tree.make_joint_fixed(joint, model)
        return None
    if len(scopes) != 1 or purpose.is_in_directives or scopes[0].find("include") is not None:
        return None
    link = link_of_frame(scopes[0], purpose.sensor_name) if purpose.sensor_name else ""
    return model_tree.reduce_to_chain(scopes[0], link, model) if link else None


def _replace_frames_of_joints_by_links(scope: Element) -> None:
    for joint in list_joints(scope):
        for element in (*joint.findall("parent"), *joint.findall("child")):
            name = (element.text or "").strip()
            link = link_of_frame(scope, name)
            if link and link != name:
                element.text = link
                if element.tag == "child":  # the frame in which the joint has its pose
                    poses = joint.findall("pose") or [SubElement(joint, "pose")]
                    poses[0].set("relative_to", poses[0].get("relative_to") or name)


def _make_joint_and_link_names_unique(scope: Element, model: ModelRepair, *, is_sdf: bool) -> None:
    joints = list_joints(scope)
    # In SDF, a joint must not have the name of a link either.
    names = {link.get("name", "") for link in scope.findall("link")} if is_sdf else set[str]()
    for number_of_joint, joint in enumerate(joints, start=1):
        name = joint.get("name", "")
        if not name or name in names:
            new = f"{name or 'joint'}_{number_of_joint}"
            model.add_repair("a unique name for joint", f"{name or 'without name'} ({new})")
            joint.set("name", new)
        names.add(joint.get("name", ""))
    links, children = set[str](), Counter(joint_link(joint, "child") for joint in joints)
    for link in scope.findall("link"):
        name = link.get("name", "")
        if name in links and children[name] > 1:
            model.add_fault(f"two links are named {name}; rename one of them")
        elif name in links:
            scope.remove(link)
            model.add_repair("a second link with the same name is left out:", name)
        links.add(name)


def _keep_one_material_per_name(root: Element) -> None:
    own = [each for each in root.iter("material") if _has_valid_colour(each) and each.get("name")]
    defined = {each.get("name", ""): each for each in reversed([*root.findall("material"), *own])}
    defined = {name: each for name, each in defined.items() if _has_valid_colour(each)}
    for material in root.findall("material"):
        root.remove(material)
    for visual in root.iterfind("link/visual"):
        for material in visual.findall("material"):
            name = material.get("name", "")
            if name in defined:
                visual.remove(material)
                SubElement(visual, "material", name=name)
            elif name or not _has_valid_colour(material):
                visual.remove(material)
    root.extend(defined.values())


def _has_valid_colour(material: Element) -> bool:
    for texture in material.findall("texture"):
        material.remove(texture)
    colour = material.find("color")
    values = model_numbers.parse_numbers(None if colour is None else colour.get("rgba"))
    return len(values) == 4 and all(0.0 <= value <= 1.0 for value in values)


def _remove_references_to_missing_parts(root: Element) -> None:
    links = {link.get("name", "") for link in root.findall("link")}
    for frame in root.findall("frame"):
        if frame.get("link") not in links:
            root.remove(frame)
    for group in root.findall("drake:collision_filter_group"):
        if any(member.get("link") not in links for member in group.findall("drake:member")):
            root.remove(group)


def _keep_one_transmission_per_joint(model: ModelRepair) -> None:
    root = model.root
    moving = {x.get("name", "") for x in list_joints(root) if x.get("type") in _ONE_AXIS_TYPES}
    for motor in root.findall("transmission"):
        names = [joint.get("name", "") for joint in motor.findall("joint")]
        has_data = any(inner.tag in _DRAKE_ROTOR_TAGS for inner in motor.iter())
        if len(names) != 1 or names[0] not in moving or not has_data:
            root.remove(motor)
            continue
        moving.discard(names[0])
        model_numbers.check_lengths_and_inertias(motor, f"motor of {names[0]}", model)
        for actuator in motor.findall("actuator"):
            actuator.set("name", names[0])
    for name in sorted(moving):  # Drake reads effort limits of joints with motors only
        motor = SubElement(root, "transmission", type="SimpleTransmission")
        SubElement(motor, "joint", name=name)
        SubElement(motor, "actuator", name=name)


def _repair_included_file(uri: Element, model: ModelRepair) -> None:
    """Replace the address in an include by the absolute path of the file or repaired copy."""
    address = (uri.text or "").strip()
    included = _find_included_model_file(address, model)
    if included is None:  # Drake searches in more places, and crashes on a circle through them
        what = f"includes {address!r}, which does not exist"
        remedy = f"correct the path, or name its package's folder: {PACKAGE_FOLDER_SETTINGS}"
        raise DrakeTeleopError(what, where=str(model.path), remedy=remedy)
    uri.text = f"file://{included.resolve()}"  # or Drake uses the working folder
    repair = {".urdf": repair_urdf, ".sdf": repair_sdf}.get(included.suffix.lower())
    if repair is not None and included.is_file():
        part = model.repair_file(included, repair)
        model.dependence_reasons |= part.dependence_reasons
        uri.text = f"file://{model.write_file(included.name, part.text)}"


def _find_included_model_file(address: str, model: ModelRepair) -> Path | None:
    find = model.files.find_file
    found = find(address, model.path.resolve().parent) or find(address)
    if found is not None and (found / "model.config").is_file():
        named = read_xml(found / "model.config").findall("sdf")
        inner = find((named[0].text or "").strip(), found) if len(named) == 1 else None
        return inner or found
    return found


def _remove_models_without_sensor_frame(model: ModelRepair) -> None:
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
            model.add_repair("models beside the arm are left out:", name)


def _has_sensor_frame(element: Element, model: ModelRepair) -> bool:
    if element.tag == "include":
        included = _find_included_model_file((element.findtext("uri") or "").strip(), model)
        if included is None or included.suffix.lower() not in (".urdf", ".sdf"):
            return False
        element = read_xml(included)
    scopes = [each for each in element.iter() if each.tag in ("robot", "model")]
    return any(link_of_frame(scope, model.purpose.sensor_name) for scope in scopes)
