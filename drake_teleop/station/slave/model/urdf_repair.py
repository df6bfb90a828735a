"""Repair of URDF and SDF texts, so that Drake reads the arm in them.

Faults of links and joints that the arm does not need are repaired. Every repair is reported.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from drake_teleop.station.slave.model.meshes import remove_unusable_shapes
from drake_teleop.station.slave.model.model_numbers import (
    check_lengths_and_inertias,
    parse_number,
    repair_inertia_and_detect_missing,
    repair_joint,
    replace_commas_by_blanks,
)
from drake_teleop.station.slave.model.model_references import ModelFiles
from drake_teleop.station.slave.model.model_tree import (
    WORLD_NAME,
    joint_end,
    link_of_frame,
    list_joints,
    make_joint_fixed,
    reduce_to_chain,
)
from drake_teleop.station.slave.model.repair_report import RepairedModel, RepairReport, join_names

_URDF_TAGS_READ_BY_DRAKE = {"link", "joint", "drake:joint", "material", "frame", "transmission"}
_URDF_TAGS_READ_BY_DRAKE |= {"drake:collision_filter_group"}
_DRAKE_ROTOR_TAGS = ("drake:rotor_inertia", "drake:gear_ratio")


class ModelPurpose(NamedTuple):
    """Use of a model: as arm, tool or surroundings.

    Attributes:
        sensor_name: frame, link or site of the sensor; empty for tools and surroundings.
        held_positions: angles or positions [rad, m] of joints that do not move.
        is_tool: whether the model is a tool, whose joints are all fixed.
        is_scene: whether the model is surroundings: all its shapes must be readable.
        is_in_directives: whether model directives add the model, so that every link is kept.
        plant_has_shapes: whether the plant has shapes.
    """

    sensor_name: str = ""
    held_positions: dict[str, float] = {}  # noqa: RUF012  (never changed)
    is_tool: bool = False
    is_scene: bool = False
    is_in_directives: bool = False
    plant_has_shapes: bool = True


def repair_urdf(
    root: Element, file: Path, files: ModelFiles, purpose: ModelPurpose, folder: Path
) -> RepairedModel:
    """Return a URDF text that Drake reads, with meshes converted in `folder`."""
    report = RepairReport(strict=purpose.is_scene)
    root.set("name", root.get("name") or file.stem)
    if not purpose.is_scene:
        for child in [child for child in root if child.tag not in _URDF_TAGS_READ_BY_DRAKE]:
            if not child.tag.endswith(("_constraint", "_bushing_rpy")):
                root.remove(child)
        _keep_one_material_per_name(root)
    repair_links_and_joints(root, purpose, report, is_sdf=False)
    if not purpose.is_scene:
        _remove_references_to_missing_parts(root, report)
    mesh_folder = folder if purpose.plant_has_shapes else None
    return convert_meshes_and_write_text(root, file, files, report, mesh_folder)


def repair_links_and_joints(
    root: Element, purpose: ModelPurpose, report: RepairReport, *, is_sdf: bool
) -> None:
    """Repair links and joints of a robot, or of a model and its nested models."""
    replace_commas_by_blanks(root)
    scopes = [each for each in root.iter() if each.tag in ("robot", "model")]
    for scope in scopes:
        _make_names_unique(scope, report)
    chain, num_joints_to_link = _reduce_model_to_arm(scopes, purpose, report) or ([], {})
    in_chain_ids = set(map(id, chain))
    for scope in scopes:
        links = {link.get("name", "") for link in scope.findall("link")}
        joints = list_joints(scope)
        for joint in joints:
            if joint.get("name") in purpose.held_positions:
                for mimic in joint.findall("mimic"):
                    joint.remove(mimic)
            in_chain = id(joint) in in_chain_ids and joint.get("name") not in purpose.held_positions
            repair_joint(joint, links, report, in_chain=in_chain)
        moving = {joint_end(each, "child") for each in joints if each.get("type") != "fixed"}
        for link in scope.findall("link"):
            name = link.get("name", "")
            for part in [link] if purpose.is_scene else link.findall("inertial"):
                check_lengths_and_inertias(part, f"link {name}", report)
            at_rest = num_joints_to_link.get(name) == 0
            is_massless = repair_inertia_and_detect_missing(
                link, report, is_sdf=is_sdf, at_rest=at_rest
            )
            if is_massless and name in moving:
                report.state_assumption("no inertia of", name)


def convert_meshes_and_write_text(
    root: Element, file: Path, files: ModelFiles, report: RepairReport, folder: Path | None
) -> RepairedModel:
    """Convert meshes and return the text, or raise one DrakeTeleopError about all faults.

    Without a folder for converted meshes the text has no shapes.
    """
    report.raise_faults(file)
    lost = remove_unusable_shapes(root, file, files, folder)
    for fault, links in lost.items():
        report.state_repair("shapes are missing of", f"{join_names(links)}: {fault}")
    report.raise_faults(file)
    limits = {
        joint.get("name", ""): parse_number(limit.get("effort") or limit.findtext("effort") or "0")
        for joint in root.iter("joint")
        for limit in joint.iter("limit")
    }
    text = ElementTree.tostring(root, encoding="unicode")
    limits = {name: limit for name, limit in limits.items() if 0.0 < limit < float("inf")}
    return RepairedModel(text, report.assumptions, limits, find_dependence_reasons(root))


def find_dependence_reasons(root: Element) -> dict[str, str]:
    """Return, by name, why joints (mimic) or links (floating) do not move independently."""
    found: dict[str, str] = {}
    for joint in root.iter("joint"):
        parent = joint_end(joint, "parent")
        if joint.find("mimic") is not None or joint.find("axis/mimic") is not None:
            found[joint.get("name", "")] = "moves with another joint (mimic)"
        if joint.get("type") == "floating" and parent != WORLD_NAME:
            found[joint_end(joint, "child")] = f"floats on {parent}"
    return found


def _reduce_model_to_arm(
    scopes: list[Element], purpose: ModelPurpose, report: RepairReport
) -> tuple[list[Element], dict[str, int]] | None:
    if purpose.is_tool:
        for joint in (joint for scope in scopes for joint in list_joints(scope)):
            make_joint_fixed(joint, report)
        return None
    if len(scopes) != 1 or purpose.is_in_directives or scopes[0].find("include") is not None:
        return None
    link = link_of_frame(scopes[0], purpose.sensor_name) if purpose.sensor_name else ""
    return reduce_to_chain(scopes[0], link, set(purpose.held_positions), report) if link else None


def _make_names_unique(scope: Element, report: RepairReport) -> None:
    names = set[str]()
    for number_of_joint, joint in enumerate(list_joints(scope), start=1):
        name = joint.get("name", "")
        if not name or name in names:
            new = f"{name or 'joint'}_{number_of_joint}"
            report.state_repair("a new name for the joint", f"{name or 'without name'} ({new})")
            joint.set("name", new)
        names.add(joint.get("name", ""))
    links, children = set[str](), Counter(joint_end(joint, "child") for joint in list_joints(scope))
    for link in scope.findall("link"):
        name = link.get("name", "")
        if name in links and children[name] > 1:
            report.add_fault(f"two links are named {name}; rename one of them")
        elif name in links:
            scope.remove(link)
            report.state_repair("a second link of the same name left out:", name)
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
    words = [] if colour is None else colour.get("rgba", "").split()
    values = [parse_number(word) for word in words]
    return len(values) == 4 and all(0.0 <= value <= 1.0 for value in values)


def _remove_references_to_missing_parts(root: Element, report: RepairReport) -> None:
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
        check_lengths_and_inertias(motor, f"motor of {names[0]}", report)
        for actuator in motor.findall("actuator"):
            actuator.set("name", names[0])
