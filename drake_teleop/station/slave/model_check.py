"""Checks of a robot model before Drake parses it.

Drake aborts on, or never finishes, joint loops, and silently replaces invalid inertias. Here each
fault is one error that names the joint or link. Missing values become assumptions. Inertias with
rounding errors, or of links that no joint moves, are corrected.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.slave.arm import PHI, TRANSLATION, ArmModel

_INERTIAS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
# Elements with lengths, masses or inertias in URDF and SDF.
_QUANTITY_TAGS = {"origin", "pose", "box", "cylinder", "sphere", "capsule", "ellipsoid", "size"}
_QUANTITY_TAGS |= {"radius", "radii", "length", "scale", "mass", "inertia", *_INERTIAS}
_QUANTITY_TAGS |= {"drake:rotor_inertia", "drake:gear_ratio"}
WORLD = "world"  # name in URDF and SDF
_JOINTS = ("joint", "drake:joint")
_MIN_LENGTH_M, _MAX_LENGTH_M = 0.01, 50.0  # lengths of an arm [m]
_MAX_VALUE = 1e6  # largest number in `_QUANTITY_TAGS`, SI units; limits may be larger
# Accepted violation of the triangle inequality, as a share of the largest moment.
_INERTIA_TOLERANCE = 1e-3
_NEGLIGIBLE_INERTIA = 1e-15  # kg m^2, accepted violation: less than a grain of dust


def check_model(root: Element, where: str, sensor: str = "") -> list[str]:
    """Check tree, limits and masses of a URDF or SDF; correct inertias in place.

    For an arm, `sensor` names the last link, or a link fixed to it.

    Returns:
        Assumptions: links without mass or inertia, corrections, and elements that Drake ignores.

    Raises:
        DrakeTeleopError: for an invalid tree, duplicate names, invalid limits, or an implausible
            mass, inertia or length.
    """
    for scope in root.iter():
        _check_scope(scope, where)
    for element in root.iter():
        if element.tag in _QUANTITY_TAGS:
            _check_measure(element, where)
    for joint in root.iter("joint"):
        for limit in joint.iter("limit"):
            _check_limit(limit, f"{where}: joint {joint.get('name', '')}")
    moved = {
        _joint_end(joint, "child")
        for joint in (each for tag in _JOINTS for each in root.iter(tag))
        if joint.get("type") != "fixed"
    }
    unmoved = _links_at_rest(root, sensor)
    massless, rounded, one_kg, corrected = list[str](), list[str](), list[str](), list[str]()
    for link in root.iter("link"):
        name = link.get("name", "")
        if root.tag == "sdf" and link.find("inertial") is None:
            one_kg.append(name)
        elif _is_massless(link, where, name in moved):
            massless.append(name)
        if _correct_inertia(link, f"{where}: link {name}", refused=name not in unmoved):
            (corrected if name in unmoved else rounded).append(name)
    with_friction = [
        joint.get("name", "")
        for joint in root.iter("joint")
        for dynamics in joint.iter("dynamics")
        if float(dynamics.get("friction") or dynamics.findtext("friction") or 0.0) != 0.0
    ]
    return [
        f"{what} {', '.join(names)}"
        for what, names in (
            ("no inertia of", massless),
            ("1 kg, the default of SDF, for", one_kg),
            ("an inertia corrected for rounding of", rounded),
            ("an inertia corrected, which no joint of the arm moves, of", corrected),
            ("no dry friction, which the model has, of", with_friction),
        )
        if names
    ]


def check_tree(joints: Iterable[tuple[str, str, str]], where: str) -> dict[str, tuple[str, str]]:
    """Check that joints (name, parent, child) form a tree; return each child's parent and joint.

    Raises:
        DrakeTeleopError: for a link with two parents, a world with a parent, or a loop.
    """
    parents: dict[str, tuple[str, str]] = {}
    for name, parent, child in joints:
        if child in parents or child == WORLD:
            on = f"two joints, {parents[child][1]} and {name}" if child in parents else name
            raise DrakeTeleopError(
                f"{child} is the child of {on}",
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
    """Check the tree of a robot or a model; nested models have separate names."""
    joints = [
        (joint.get("name", ""), parent, child)
        for joint in (each for tag in _JOINTS for each in scope.findall(tag))
        for parent, child in [(_joint_end(joint, "parent"), _joint_end(joint, "child"))]
        if parent and child  # otherwise Drake reports the missing element
    ]
    links = [link.get("name", "") for link in scope.findall("link")]
    for kind, names in (("links", links), ("joints", [name for name, _, _ in joints])):
        for name in names:
            if name and names.count(name) > 1:
                raise DrakeTeleopError(f"two {kind} are named {name}", where=where)
    parents = check_tree(joints, where)
    roots = [name or "a link without name" for name in links if name not in parents]
    if scope.tag == "robot" and len(roots) > 1:
        raise DrakeTeleopError(
            f"{roots[0]} and {roots[1]} are both the child of no joint",
            where=where,
            remedy="a URDF has one root: connect the other links by joints, or remove them",
        )


def _joint_end(joint: Element, name: str) -> str:
    element = joint.find(name)
    return "" if element is None else (element.get("link") or element.text or "").strip()


def _check_measure(element: Element, where: str) -> None:
    for text in (element.text or "", *element.attrib.values()):
        for word in text.split():
            try:
                value = float(word)
            except ValueError:  # a name; Drake reports an invalid number
                continue
            if not abs(value) <= _MAX_VALUE:
                raise DrakeTeleopError(
                    f"{element.tag} {word} is no finite number up to {_MAX_VALUE:g}", where=where
                )
            if element.tag == "drake:rotor_inertia" and value < 0.0:
                raise DrakeTeleopError(f"a rotor inertia of {word} kg m^2", where=where)


def _check_limit(limit: Element, where: str) -> None:
    def number(name: str) -> float | None:
        text = limit.get(name) or limit.findtext(name)
        return None if text is None else _number(text, name, where)

    lower, upper = number("lower"), number("upper")
    if lower is not None and upper is not None and lower > upper:
        raise DrakeTeleopError(f"lower limit {lower:g} is above upper limit {upper:g}", where=where)
    for name in ("velocity", "effort"):
        value = number(name)
        # In SDF, -1 means no limit.
        if value is not None and value < 0 and not (value == -1 and limit.get(name) is None):
            raise DrakeTeleopError(f"{name} limit {value:g} is negative", where=where)
    for name, text in limit.attrib.items():  # URDF only
        if math.isinf(_number(text, name, where)):
            raise DrakeTeleopError(
                f"{name} {text} is not finite",
                where=where,
                remedy="leave the limit out; the assumed limit is reported",
            )


def _is_massless(link: Element, where: str, moves: bool) -> bool:
    """Return whether a link that has shapes, or is moved by a joint, has no mass or inertia."""
    place = f"{where}: link {link.get('name', '')}"
    inertial = link.find("inertial")
    mass_element = None if inertial is None else inertial.find("mass")
    counts = moves or link.find("collision") is not None or link.find("visual") is not None
    if inertial is None or mass_element is None:
        return counts
    mass = _number(mass_element.get("value") or mass_element.text or "", "mass", place)
    if mass < 0:
        raise DrakeTeleopError(f"mass {mass:g} kg is negative", where=place)
    element = inertial.find("inertia")
    if element is None:
        has_inertia = mass_element.get("value") is None  # the default of SDF is 1 kg m^2
    else:
        has_inertia = bool(_moments(element, place)[2] > 0.0)
    if mass == 0.0 and has_inertia:
        raise DrakeTeleopError("an inertia, but no mass", where=place, remedy="give both or none")
    return counts and not has_inertia


def _links_at_rest(root: Element, sensor: str) -> set[str]:
    """Return the names of the links that no joint up to the sensor moves."""
    joints = {
        _joint_end(joint, "child"): (_joint_end(joint, "parent"), joint.get("type") != "fixed")
        for joint in (each for tag in _JOINTS for each in root.iter(tag))
    }
    links = [link.get("name", "") for link in root.iter("link")]
    if sensor not in links or len(set(links)) < len(links):
        return set()

    def path(link: str) -> list[str]:
        passed = [link]
        while passed[-1] in joints and joints[passed[-1]][0] not in passed:  # stop in a loop
            passed.append(joints[passed[-1]][0])
        return passed

    moved = [link for link in path(sensor) if joints.get(link, ("", False))[1]]
    return {link for link in links if moved and moved[-1] not in path(link)}


def _correct_inertia(link: Element, where: str, *, refused: bool) -> bool:
    """Correct an invalid inertia by equal additions to its diagonal; return True if changed.

    If `refused`, a correction larger than rounding raises a DrakeTeleopError.
    """
    element = link.find("inertial/inertia")
    if element is None:
        return False
    moments = _moments(element, where)
    violation = max(-moments[0], moments[2] - moments[1] - moments[0])
    if violation <= 0.0:
        return False
    if refused and violation > max(_INERTIA_TOLERANCE * abs(moments[2]), _NEGLIGIBLE_INERTIA):
        raise DrakeTeleopError(
            "no body has this inertia: its principal moments are "
            f"{moments[0]:.3g}, {moments[1]:.3g}, {moments[2]:.3g} kg m^2",
            where=where,
            remedy="all are positive, and none is more than the sum of the other two",
        )
    for name in ("ixx", "iyy", "izz"):
        value = f"{float(_entry(element, name)) + 1.001 * violation:.17g}"
        child = element.find(name)
        if child is None:
            element.set(name, value)
        else:
            child.text = value
    return True


def _entry(inertia: Element, name: str) -> str:
    return inertia.get(name) or inertia.findtext(name) or "0"


def _moments(inertia: Element, where: str) -> NDArray[np.float64]:
    """Return the principal moments of inertia (3,), ascending."""
    xx, xy, xz, yy, yz, zz = (_number(_entry(inertia, name), name, where) for name in _INERTIAS)
    tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return np.asarray(np.linalg.eigvalsh(tensor), dtype=np.float64)


def _number(text: str, name: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if math.isnan(value):
        raise DrakeTeleopError(f"{name} {text.strip()!r} is not a number", where=where)
    return value


def check_size(arm: ArmModel, where: str) -> None:
    """Raise DrakeTeleopError for an implausible arm length, or a mass far from its joint."""
    length = float(np.linalg.norm(arm.table[1:, TRANSLATION:PHI], axis=1).sum())
    remedy = "give lengths in m, and inertias in kg m^2"
    if 0.0 < length < _MIN_LENGTH_M or length > _MAX_LENGTH_M:
        what = f"from its first joint to the sensor it is {length:.3g} m long"
        raise DrakeTeleopError(what, where=where, remedy=remedy)
    for name, phi in zip((*arm.joint_names, "the sensor"), arm.table[:, PHI:], strict=True):
        # Root mean square distance of the mass from the joint's origin.
        distance = np.sqrt((phi[4] + phi[7] + phi[9]) / (2.0 * phi[0])) if phi[0] > 0.0 else 0.0
        if distance > _MAX_LENGTH_M:
            what = f"the mass moved by {name} is {distance:.3g} m away from it"
            raise DrakeTeleopError(what, where=where, remedy=remedy)
