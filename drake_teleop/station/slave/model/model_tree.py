"""Tree of links and joints of a URDF robot or SDF model, reduced to the arm with the sensor."""

from __future__ import annotations

from xml.etree.ElementTree import Element

from drake_teleop.station.slave.model.repair_report import RepairReport

WORLD_NAME = "world"  # name in URDF and SDF
_CONSTRAINT_TAGS = ("drake:ball_constraint", "drake:linear_bushing_rpy", "drake:tendon_constraint")


def list_joints(scope: Element) -> list[Element]:
    """Return the joints of a robot or model element, without those of nested models."""
    return [child for child in scope if child.tag in ("joint", "drake:joint")]


def joint_end(joint: Element, name: str) -> str:
    """Return the name of a joint's `parent` or `child` link, or an empty text."""
    element = joint.find(name)
    return "" if element is None else (element.get("link") or element.text or "").strip()


def link_of_frame(scope: Element, frame: str) -> str:
    """Return the link that carries the frame, link or joint `frame`, or an empty text."""
    links = [link.get("name", "") for link in scope.findall("link")]
    frames = scope.findall("frame")
    carriers = {x.get("name", ""): x.get("link") or x.get("attached_to") or "" for x in frames}
    carriers |= {each.get("name", ""): joint_end(each, "child") for each in list_joints(scope)}
    passed = set[str]()
    while frame not in links and frame in carriers and frame not in passed:
        passed.add(frame)
        frame = carriers[frame] or (links[0] if scope.tag == "model" and links else "")
    return frame if frame in links else ""


def reduce_to_chain(
    scope: Element, sensor_link: str, hold: set[str], report: RepairReport
) -> tuple[list[Element], dict[str, int]] | None:
    """Keep the tree of links with the sensor; fix joints that are not between root and sensor.

    Other trees and joints that close a loop are removed. The joints `hold` count as fixed. Return
    the joints from the root to the sensor's link, also fixed ones, and the number of moving ones
    between the root and each link; or None, with a fault in `report`, if they are ambiguous.
    """
    chain = _joint_chain_to_link(scope, sensor_link, report)
    if chain is None:
        return None
    chain = _remove_free_base(scope, chain, report)
    root = joint_end(chain[0], "parent") if chain else sensor_link
    num_joints_to_link = _remove_unconnected_links(scope, root, chain, hold, report)
    in_chain = set(map(id, chain))
    for joint in list_joints(scope):
        if id(joint) not in in_chain and joint.get("name") not in hold:
            make_joint_fixed(joint, report)
    _remove_loop_constraints(scope, num_joints_to_link, report)
    return chain, num_joints_to_link


def make_joint_fixed(joint: Element, report: RepairReport) -> None:
    if joint.get("type") == "fixed":
        return
    report.state_assumption("held:", joint.get("name", ""))
    joint.tag = "joint"
    joint.set("type", "fixed")
    for child in list(joint):
        if child.tag not in ("parent", "child", "origin", "pose"):
            joint.remove(child)


def _joint_chain_to_link(scope: Element, link: str, report: RepairReport) -> list[Element] | None:
    parents: dict[str, list[Element]] = {}
    for joint in list_joints(scope):
        parents.setdefault(joint_end(joint, "child"), []).append(joint)
    chain, passed = list[Element](), set[str]()
    while link in parents:
        if link in passed:
            report.add_fault(f"its joints form a loop through {link}; cut the loop")
            return None
        passed.add(link)
        if link == WORLD_NAME:
            report.add_fault(f"world is the child of {parents[link][0].get('name', '')}")
            return None
        if len(parents[link]) > 1:
            names = " and ".join(joint.get("name", "") for joint in parents[link])
            report.add_fault(f"{link} is the child of two joints, {names}; remove one of them")
            return None
        chain.append(parents[link][0])
        link = joint_end(chain[-1], "parent")
    return chain[::-1]


def _remove_free_base(scope: Element, chain: list[Element], report: RepairReport) -> list[Element]:
    moving = [k for k, joint in enumerate(chain) if joint.get("type") != "fixed"]
    if not moving or chain[moving[0]].get("type") not in ("floating", "planar"):
        return chain
    free = chain[moving[0]]
    report.state_assumption("welded to the world, where it may float:", joint_end(free, "child"))
    scope.remove(free)
    for link in scope.findall("link"):
        if link.get("name") == WORLD_NAME:
            scope.remove(link)
    return chain[moving[0] + 1 :]


def _remove_unconnected_links(
    scope: Element, root: str, chain: list[Element], hold: set[str], report: RepairReport
) -> dict[str, int]:
    links = {link.get("name", ""): link for link in scope.findall("link")}
    number_of, count = dict[int, int](), 0
    for joint in chain:
        count += joint.get("type") != "fixed" and joint.get("name", "") not in hold
        number_of[id(joint)] = count
    outboard: dict[str, list[Element]] = {}
    for joint in sorted(list_joints(scope), key=lambda joint: id(joint) not in number_of):
        outboard.setdefault(joint_end(joint, "parent"), []).append(joint)
    num_joints_to_link, ahead, kept = {root: 0}, [root], set[int]()
    while ahead:
        parent = ahead.pop()
        for joint in outboard.get(parent, []):
            child = joint_end(joint, "child")
            exists = child in links or id(joint) in number_of
            if exists and child not in num_joints_to_link and child != WORLD_NAME:
                num_joints_to_link[child] = number_of.get(id(joint), num_joints_to_link[parent])
                kept.add(id(joint))
                ahead.append(child)
    for name in links.keys() - num_joints_to_link.keys():
        scope.remove(links[name])
    for name in [name for name in links if name not in num_joints_to_link and name != WORLD_NAME]:
        report.state_repair("not connected to the arm and left out:", name or "a link without name")
    for joint in list_joints(scope):
        if id(joint) not in kept:
            scope.remove(joint)
            if joint_end(joint, "parent") in num_joints_to_link:
                what = "left out, as it closes a loop or has no child:"
                report.state_repair(what, joint.get("name", ""))
    return num_joints_to_link


def _remove_loop_constraints(
    scope: Element, num_joints_to_link: dict[str, int], report: RepairReport
) -> None:
    for element in [child for child in scope if child.tag in _CONSTRAINT_TAGS]:
        names = [inner.get("name", "") for inner in element.iter() if inner.get("name")]
        groups = {num_joints_to_link.get(link_of_frame(scope, name), -1) for name in names}
        scope.remove(element)
        if len(names) < 2 or len(groups) > 1:
            what = f"its links form a loop, by {element.tag}"
            report.add_fault(f"{what}; model the chain to the sensor alone")
