"""Repair of URDF and SDF texts, so that Drake reads the arm in them.

Faults of links and joints that the arm does not need are repaired. Every repair is reported.
"""

from __future__ import annotations

from collections import Counter
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from drake_teleop.station.slave.model import model_numbers, model_tree
from drake_teleop.station.slave.model.meshes import remove_unusable_shapes
from drake_teleop.station.slave.model.model_repair import ModelRepair
from drake_teleop.station.slave.model.model_tree import joint_end, list_joints

_URDF_TAGS_READ_BY_DRAKE = {"link", "joint", "drake:joint", "material", "frame", "transmission"}
_URDF_TAGS_READ_BY_DRAKE |= {"drake:collision_filter_group"}
_DRAKE_ROTOR_TAGS = ("drake:rotor_inertia", "drake:gear_ratio")


def repair_urdf(model: ModelRepair) -> None:
    """Write a URDF text that Drake reads, with converted meshes."""
    root = model.root
    root.set("name", root.get("name") or model.path.stem)
    if not model.purpose.is_scene:
        for child in [child for child in root if child.tag not in _URDF_TAGS_READ_BY_DRAKE]:
            if not child.tag.endswith(("_constraint", "_bushing_rpy")):
                root.remove(child)
        _keep_one_material_per_name(root)
    repair_links_and_joints(model, is_sdf=False)
    if not model.purpose.is_scene:
        _remove_references_to_missing_parts(model)
    convert_meshes_and_write_text(model)


def repair_links_and_joints(model: ModelRepair, *, is_sdf: bool) -> None:
    """Repair links and joints of a robot, or of a model and its nested models."""
    model_numbers.replace_commas_by_blanks(model.root)
    scopes = [each for each in model.root.iter() if each.tag in ("robot", "model")]
    for scope in scopes:
        _make_names_unique(scope, model)
    chain, num_joints_to_link = _reduce_model_to_arm(scopes, model) or (set(), {})
    for scope in scopes:
        links = {link.get("name", "") for link in scope.findall("link")}
        joints = list_joints(scope)
        for joint in joints:
            model_numbers.repair_joint(joint, links, model, in_chain=joint in chain)
        moving = {joint_end(each, "child") for each in joints if each.get("type") != "fixed"}
        for link in scope.findall("link"):
            name = link.get("name", "")
            for part in [link] if model.purpose.is_scene else link.findall("inertial"):
                model_numbers.check_lengths_and_inertias(part, f"link {name}", model)
            at_rest = num_joints_to_link.get(name) == 0
            repair = model_numbers.repair_inertia_and_detect_missing
            if repair(link, model, is_sdf=is_sdf, at_rest=at_rest) and name in moving:
                model.state_assumption("no inertia of", name)


def convert_meshes_and_write_text(model: ModelRepair) -> None:
    """Convert meshes and write the text, or raise one DrakeTeleopError about all faults."""
    model.raise_faults()
    remove_unusable_shapes(model)
    model.raise_faults()
    limits = dict[str, float]()
    for joint in model.root.iter("joint"):
        for limit in joint.iter("limit"):
            effort = limit.get("effort") or limit.findtext("effort")
            limits[joint.get("name", "")] = model_numbers.parse_number(effort or "0")
    limits = {name: limit for name, limit in limits.items() if 0.0 < limit < float("inf")}
    model.effort_limits = limits | model.effort_limits
    model.dependence_reasons = find_dependence_reasons(model.root) | model.dependence_reasons
    model.text = ElementTree.tostring(model.root, encoding="unicode")


def find_dependence_reasons(root: Element) -> dict[str, str]:
    """Return, by name, why joints (mimic) or links (floating) do not move independently."""
    found: dict[str, str] = {}
    for joint in root.iter("joint"):
        parent = joint_end(joint, "parent")
        if joint.find("mimic") is not None or joint.find("axis/mimic") is not None:
            found[joint.get("name", "")] = "moves with another joint (mimic)"
        if joint.get("type") == "floating" and parent != model_tree.WORLD_NAME:
            found[joint_end(joint, "child")] = f"floats on {parent}"
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
    link = model_tree.link_of_frame(scopes[0], purpose.sensor_name) if purpose.sensor_name else ""
    return model_tree.reduce_to_chain(scopes[0], link, model) if link else None


def _make_names_unique(scope: Element, model: ModelRepair) -> None:
    joints, names = list_joints(scope), set[str]()
    for number_of_joint, joint in enumerate(joints, start=1):
        name = joint.get("name", "")
        if not name or name in names:
            new = f"{name or 'joint'}_{number_of_joint}"
            model.state_repair("a new name for the joint", f"{name or 'without name'} ({new})")
            joint.set("name", new)
        names.add(joint.get("name", ""))
    links, children = set[str](), Counter(joint_end(joint, "child") for joint in joints)
    for link in scope.findall("link"):
        name = link.get("name", "")
        if name in links and children[name] > 1:
            model.add_fault(f"two links are named {name}; rename one of them")
        elif name in links:
            scope.remove(link)
            model.state_repair("a second link of the same name left out:", name)
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


def _remove_references_to_missing_parts(model: ModelRepair) -> None:
    root = model.root
    links = {link.get("name", "") for link in root.findall("link")}
    moving = {joint.get("name", "") for joint in list_joints(root) if joint.get("type") != "fixed"}
    for frame in root.findall("frame"):
        if frame.get("link") not in links:
            root.remove(frame)
    for group in root.findall("drake:collision_filter_group"):
        if any(member.get("link") not in links for member in group.findall("drake:member")):
            root.remove(group)
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
