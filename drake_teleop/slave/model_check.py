"""What cannot be true of a robot model, said before Drake reads it.

Drake follows a link with two parents or a circle of joints into an abort or for ever, and replaces
an inertia that no body has by another one without telling. Here each is one error with the name of
joint or link; what is merely missing is an assumption.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from xml.etree.ElementTree import Element

import numpy as np

from drake_teleop.errors import DrakeTeleopError

_INERTIAS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
# What places, shapes and masses are said with, in URDF and SDF.
_MEASURES = {"origin", "pose", "box", "cylinder", "sphere", "capsule", "ellipsoid", "size"}
_MEASURES |= {"radius", "radii", "length", "scale", "mass", "inertia", *_INERTIAS}
WORLD = "world"  # as URDF and SDF call it
_LARGEST = 1e6  # of these in SI; limits may be larger, where there is none
# How far principal moments may be from those of a body, for rounding in the file.
_ROUNDING = 1e-3


def check_model(root: Element, where: str) -> list[str]:
    """Checks tree, limits and masses of a URDF or SDF.

    Returns:
        Assumptions: which links have no mass or no inertia.

    Raises:
        DrakeTeleopError: for a link with two parents, a second root in a URDF, joints that form a
            circle, limits that are no numbers or the wrong way round, a negative mass, an inertia
            that no body has, a length or a mass that no arm has.
    """
    for scope in root.iter():
        _check_scope(scope, where)
    for element in root.iter():
        if element.tag in _MEASURES:
            _check_measure(element, where)
    for joint in root.iter("joint"):
        for limit in joint.iter("limit"):
            _check_limit(limit, f"{where}: joint {joint.get('name', '')}")
    without = [link.get("name", "") for link in root.iter("link") if _is_massless(link, where)]
    return [f"no inertia of {', '.join(without)}"] if without else []


def check_tree(joints: Iterable[tuple[str, str, str]], where: str) -> dict[str, tuple[str, str]]:
    """Checks that joints make a tree, or several.

    Args:
        joints: name, parent and child of each.
        where: for the message.

    Returns:
        Of each link that hangs on a joint, its parent and the joint's name.

    Raises:
        DrakeTeleopError: for a link with two parents, a world that hangs on something, a circle.
    """
    parents: dict[str, tuple[str, str]] = {}
    for name, parent, child in joints:
        if child in parents or child == WORLD:
            on = f"two joints, {parents[child][1]} and {name}" if child in parents else name
            raise DrakeTeleopError(
                f"{child} hangs on {on}",
                where=where,
                remedy="an arm is a tree: each link is the child of one joint, the world of none",
            )
        parents[child] = parent, name
    for start in parents:
        link, passed = start, {start}
        while link in parents:
            link = parents[link][0]
            if link in passed:
                raise DrakeTeleopError(
                    f"its joints form a circle through {link}",
                    where=where,
                    remedy="an arm is a tree: cut the loop, or model the chain to the sensor alone",
                )
            passed.add(link)
    return parents


def _check_scope(scope: Element, where: str) -> None:
    """Checks the tree of a robot or a model; models inside it have names of their own."""
    joints = [
        (joint.get("name", ""), parent, child)
        for joint in scope.findall("joint")
        for parent, child in [(_end(joint, "parent"), _end(joint, "child"))]
        if parent and child  # or Drake says what lacks
    ]
    parents = check_tree(joints, where)
    loose = [
        name for link in scope.findall("link") if (name := link.get("name", "")) not in parents
    ]
    if scope.tag == "robot" and len(loose) > 1:
        raise DrakeTeleopError(
            f"{loose[0]} and {loose[1]} are both the child of no joint",
            where=where,
            remedy="a URDF has one root: fasten the rest to it by joints, or take it out",
        )


def _end(joint: Element, name: str) -> str:
    element = joint.find(name)
    return "" if element is None else (element.get("link") or element.text or "").strip()


def _check_measure(element: Element, where: str) -> None:
    for text in (element.text or "", *element.attrib.values()):
        for word in text.split():
            try:
                value = float(word)
            except ValueError:  # a name; or Drake says that it wants a number
                continue
            if not abs(value) <= _LARGEST:
                raise DrakeTeleopError(
                    f"{element.tag} {word} is no finite number up to {_LARGEST:g}", where=where
                )


def _check_limit(limit: Element, where: str) -> None:
    def number(name: str) -> float | None:
        text = limit.get(name) or limit.findtext(name)
        return None if text is None else _number(text, name, where)

    lower, upper = number("lower"), number("upper")
    if lower is not None and upper is not None and lower > upper:
        raise DrakeTeleopError(f"lower limit {lower:g} is above upper limit {upper:g}", where=where)
    for name in ("velocity", "effort"):
        value = number(name)
        # Of SDF, -1 says that there is no limit.
        if value is not None and value < 0 and not (value == -1 and limit.get(name) is None):
            raise DrakeTeleopError(f"{name} limit {value:g} is negative", where=where)


def _is_massless(link: Element, where: str) -> bool:
    """Whether a link has shapes but no inertia; one that cannot be is an error.

    A link without shapes is a frame, such as tool0.
    """
    place = f"{where}: link {link.get('name', '')}"
    inertial = link.find("inertial")
    mass_element = None if inertial is None else inertial.find("mass")
    has_shape = link.find("collision") is not None or link.find("visual") is not None
    if inertial is None or mass_element is None:
        return has_shape
    mass = _number(mass_element.get("value") or mass_element.text or "", "mass", place)
    if mass < 0:
        raise DrakeTeleopError(f"mass {mass:g} kg is negative", where=place)
    element = inertial.find("inertia")
    if element is None:
        return has_shape
    texts = {name: element.get(name) or element.findtext(name) or "0" for name in _INERTIAS}
    xx, xy, xz, yy, yz, zz = (_number(texts[name], name, place) for name in _INERTIAS)
    moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    rounding = _ROUNDING * abs(moments[2])
    if moments[0] < -rounding or moments[0] + moments[1] < moments[2] - rounding:
        raise DrakeTeleopError(
            "no body has this inertia: its principal moments are "
            f"{moments[0]:.3g}, {moments[1]:.3g}, {moments[2]:.3g} kg m^2",
            where=place,
            remedy="all are positive, and none is more than the sum of the other two",
        )
    return has_shape and (mass == 0.0 or moments[2] == 0.0)


def _number(text: str, name: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if math.isnan(value):
        raise DrakeTeleopError(f"{name} {text.strip()!r} is not a number", where=where)
    return value
