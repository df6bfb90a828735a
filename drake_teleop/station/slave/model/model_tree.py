"""Tree of links and joints of a URDF robot or SDF model, reduced to the arm with the sensor."""

from __future__ import annotations

from xml.etree.ElementTree import Element

from drake_teleop.station.slave.model.model_repair import ModelRepair

WORLD_NAME = "world"  # name in URDF and SDF
_DRAKE_CONSTRAINT_NAMES = "ball_constraint", "linear_bushing_rpy", "tendon_constraint"
_DRAKE_CONSTRAINT_TAGS = tuple(f"drake:{name}" for name in _DRAKE_CONSTRAINT_NAMES)


def list_joints(scope: Element) -> list[Element]:
    """Return the joints of a robot or model element, without those of nested models."""
    return [child for child in scope if child.tag in ("joint", "drake:joint")]


def joint_link(joint: Element, end: str) -> str:
    """Return the name of a joint's `parent` or `child` link, or an empty text."""
    element = joint.find(end)
    return "" if element is None else (element.get("link") or element.text or "").strip()


def link_of_frame(scope: Element, frame: str) -> str:
    """Return the name of the link that carries `frame` (frame, link or joint), or an empty text."""
    links = [link.get("name", "") for link in scope.findall("link")]
    frames = scope.findall("frame")
    carriers = {x.get("name", ""): x.get("link") or x.get("attached_to") or "" for x in frames}
    carriers |= {each.get("name", ""): joint_link(each, "child") for each in list_joints(scope)}
    passed = set[str]()
    while frame not in links and frame in carriers and frame not in passed:
        passed.add(frame)
        frame = carriers[frame] or (links[0] if scope.tag == "model" and links else "")
    return frame if frame in links else ""


def reduce_to_chain(
    scope: Element, sensor_link: str, model: ModelRepair
) -> tuple[set[Element], dict[str, int]] | None:
    """Keep only the tree of links with the sensor; fix joints that are not between root and sensor.

    Joints that close a loop are removed. Held joints count as fixed. Return the joints from root to
    sensor link, fixed ones included, and by link the number of moving joints to it; or None, with a
    fault, if a link has two parents.
    """
    joints = _joint_chain_to_link(scope, sensor_link, model)
    if joints is None:
        return None
    joints = _weld_floating_base(scope, joints, model)
    root, chain = joint_link(joints[0], "parent") if joints else sensor_link, set(joints)
    num_joints_to_link = _remove_unconnected_and_count_joints(scope, root, chain, model)
    names = {joint.get("name") for joint in joints} | model.purpose.held_positions.keys()
    for joint in joints:
        for element in (joint, *joint.findall("axis")):
            for mimic in element.findall("mimic"):
                if joint.get("type") != "fixed" and mimic.get("joint") not in names:
                    element.remove(mimic)
                    what = "joint moves alone, as the joint that it mimics does not move S:"
                    model.add_assumption(what, joint.get("name", ""))
    for joint in list_joints(scope):
        if joint not in chain and joint.get("name") not in model.purpose.held_positions:
            make_joint_fixed(joint, model)
    for element in [child for child in scope if child.tag in _DRAKE_CONSTRAINT_TAGS]:
        ends = [inner.get("name", "") for inner in element.iter() if inner.get("name")]
        groups = {num_joints_to_link.get(link_of_frame(scope, name), -1) for name in ends}
        scope.remove(element)
        if len(ends) < 2 or len(groups) > 1:
            model.add_fault(f"{element.tag} closes a loop of links; remove this element")
    return chain, num_joints_to_link


def make_joint_fixed(joint: Element, model: ModelRepair) -> None:
    if joint.get("type") == "fixed":
        return
    model.add_assumption("held:", joint.get("name", ""))
    joint.tag = "joint"
    joint.set("type", "fixed")
    for child in list(joint):
        if child.tag not in ("parent", "child", "origin", "pose"):
            joint.remove(child)


def _joint_chain_to_link(scope: Element, link: str, model: ModelRepair) -> list[Element] | None:
    inboard: dict[str, list[Element]] = {}
    for joint in list_joints(scope):
        inboard.setdefault(joint_link(joint, "child"), []).append(joint)
    chain, passed = list[Element](), set[str]()
    while joints := inboard.get(link):
        names = [joint.get("name", "") for joint in joints]
        fault = ""
        if link in passed:
            fault = f"its joints form a loop through {link}; cut the loop"
        elif link == WORLD_NAME:
            fault = f"world is the child of {names[0]}"
        elif len(joints) > 1:
            fault = f"{link} is the child of two joints, {' and '.join(names)}; remove one of them"
        if fault:
            model.add_fault(fault)
            return None
        passed.add(link)
        chain.append(joints[0])
        link = joint_link(joints[0], "parent")
    return chain[::-1]


def _weld_floating_base(scope: Element, chain: list[Element], model: ModelRepair) -> list[Element]:
    first = next((k for k, each in enumerate(chain) if each.get("type") != "fixed"), None)
    if first is None or chain[first].get("type") not in ("floating", "planar"):
        return chain
    base = joint_link(chain[first], "child")
    model.add_assumption("welded to the world instead of floating:", base)
    scope.remove(chain[first])
    for link in scope.findall("link"):
        if link.get("name") == WORLD_NAME:
            scope.remove(link)
    return chain[first + 1 :]


def _remove_unconnected_and_count_joints(
    scope: Element, root: str, chain: set[Element], model: ModelRepair
) -> dict[str, int]:
    links = {link.get("name", ""): link for link in scope.findall("link")}
    held, outboard = model.purpose.held_positions, dict[str, list[Element]]()
    for joint in sorted(list_joints(scope), key=lambda joint: joint not in chain):
        outboard.setdefault(joint_link(joint, "parent"), []).append(joint)
    num_joints_to_link, ahead, kept = {root: 0}, [root], set[Element]()
    while ahead:
        parent = ahead.pop()
        for joint in outboard.get(parent, []):
            child, in_chain = joint_link(joint, "child"), joint in chain
            is_new = child not in num_joints_to_link and child != WORLD_NAME
            if is_new and (child in links or in_chain):
                moves = in_chain and joint.get("type") != "fixed" and joint.get("name") not in held
                num_joints_to_link[child] = num_joints_to_link[parent] + moves
                kept.add(joint)
                ahead.append(child)
    for name in [name for name in links if name not in num_joints_to_link]:
        scope.remove(links[name])
        if name != WORLD_NAME:
            what = "not connected to the arm and left out:"
            model.add_repair(what, name or "a link without name")
    for joint in list_joints(scope):
        if joint not in kept:
            scope.remove(joint)
            if joint_link(joint, "parent") in num_joints_to_link:
                what = "left out, as it closes a loop or has no child:"
                model.add_repair(what, joint.get("name", ""))
    return num_joints_to_link
