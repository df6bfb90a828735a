"""Checks of numbers in the text of URDF and SDF models."""

from __future__ import annotations

import math
from xml.etree.ElementTree import Element

from drake_teleop.station.slave.model.model_tree import WORLD_NAME, joint_end
from drake_teleop.station.slave.model.repair_report import RepairReport

MAX_MODEL_VALUE_SI = 1e6  # largest length, mass or inertia, SI units; limits may be larger
_NUMBER_LIST_ATTRIBUTES = ("xyz", "rpy", "rgba", "size", "scale")
_NUMBER_LIST_TAGS = ("pose", "xyz", "size", "scale", "diffuse", "ambient", "specular", "emissive")
# Elements with lengths, inertias or rotor inertias in URDF and SDF.
_QUANTITY_TAGS = {"origin", "pose", "box", "cylinder", "sphere", "capsule", "ellipsoid", "size"}
_QUANTITY_TAGS |= {"radius", "radii", "length", "scale", "drake:rotor_inertia", "drake:gear_ratio"}
_MOVING_JOINT_TYPES = ("revolute", "continuous", "prismatic")


def parse_number(text: str | None) -> float:
    """Return the number in a text, or NaN if there is none."""
    try:
        return float(text or "")
    except ValueError:
        return math.nan


def replace_commas_by_blanks(root: Element) -> None:
    for element in root.iter():
        for name in _NUMBER_LIST_ATTRIBUTES:
            if "," in element.get(name, ""):
                element.set(name, element.get(name, "").replace(",", " "))
        if element.tag in _NUMBER_LIST_TAGS and "," in (element.text or ""):
            element.text = (element.text or "").replace(",", " ")


def check_lengths_and_inertias(element: Element, where: str, report: RepairReport) -> None:
    """Report lengths, inertias or rotor inertias in an element that are too large or no numbers."""
    for inner in element.iter():
        if inner.tag not in _QUANTITY_TAGS:
            continue
        if inner.tag == "origin":
            for name, text in inner.attrib.items():
                if len(text.split()) != 3 or any(math.isnan(parse_number(x)) for x in text.split()):
                    report.add_fault(f"{where}: origin {name}={text!r} is no list of three numbers")
        for word in " ".join([inner.text or "", *map(str, inner.attrib.values())]).split():
            value = parse_number(word)
            if math.isnan(value) and word.lower().strip("+-") != "nan":
                continue  # a name; Drake reports an invalid number
            if not abs(value) <= MAX_MODEL_VALUE_SI:
                report.add_fault(
                    f"{where}: {inner.tag} {word} is no finite number up to {MAX_MODEL_VALUE_SI:g}"
                )
            if inner.tag == "drake:rotor_inertia" and value < 0.0:
                report.add_fault(f"{where}: a rotor inertia of {word} kg m^2 is negative")


def repair_joint(joint: Element, links: set[str], report: RepairReport, *, in_chain: bool) -> None:
    """Correct limits, friction and damping of a joint; report changes and faults."""
    name = joint.get("name", "")
    where = f"joint {name}"
    for end in ("parent", "child"):
        link = joint_end(joint, end)
        if not link:
            report.add_fault(f"{where} has no {end} link")
        elif link not in links and link != WORLD_NAME and "::" not in link and in_chain:
            report.add_fault(f"{where}: its {end} link {link!r} does not exist")
    check_lengths_and_inertias(joint, where, report)
    if joint.get("type") == "fixed":
        for mimic in joint.findall("mimic"):
            joint.remove(mimic)
        return
    if in_chain:
        _check_joint_is_independent(joint, where, report)
    for limit in joint.iter("limit"):
        _check_joint_limit(limit, where, report)
    for dynamics in joint.iter("dynamics"):
        _check_joint_dynamics(dynamics, name, report)


def _check_joint_is_independent(joint: Element, where: str, report: RepairReport) -> None:
    kind, name = joint.get("type") or "typeless", joint.get("name", "")
    if kind not in _MOVING_JOINT_TYPES:
        between = f" on {joint_end(joint, 'parent')}" if kind == "floating" else ""
        report.add_fault(
            f"{name} is a {kind} joint{between}; up to the sensor, use joints that turn about one"
            " axis or slide along it"
        )
    elif joint.find("mimic") is not None or joint.find("axis/mimic") is not None:
        report.add_fault(
            f"{name} moves with another joint (mimic); remove the tag, or fix the joint by"
            " slave.hold"
        )
    axis = joint.find("axis")
    text = None if axis is None else axis.get("xyz") or axis.findtext("xyz")
    values = [parse_number(word) for word in (text or "1 0 0").split()]
    if len(values) != 3 or not all(map(math.isfinite, values)) or not any(values):
        report.add_fault(f"{where}: axis {text!r} is no direction; give three numbers")


def _check_joint_limit(limit: Element, where: str, report: RepairReport) -> None:
    values = dict[str, float]()
    for name in ("lower", "upper", "velocity", "effort"):
        text = limit.get(name) or limit.findtext(name)
        if not text:
            limit.attrib.pop(name, None)
            continue
        values[name] = parse_number(text)
        if math.isnan(values[name]):
            report.add_fault(f"{where}: {name} limit {text.strip()!r} is not a number")
        elif name in ("velocity", "effort") and values[name] < 0.0:
            # In SDF, -1 means no limit.
            if limit.get(name) is not None or values[name] != -1.0:
                report.add_fault(f"{where}: {name} limit {values[name]:g} is negative")
        elif math.isinf(values[name]) and limit.get(name) is not None:
            del limit.attrib[name]  # the missing limit is stated
    lower, upper = values.get("lower", -math.inf), values.get("upper", math.inf)
    if lower > upper:
        report.add_fault(f"{where}: lower limit {lower:g} is above upper limit {upper:g}")


def _check_joint_dynamics(dynamics: Element, name: str, report: RepairReport) -> None:
    damping, friction = (
        parse_number(dynamics.get(what) or dynamics.findtext(what) or "0")
        for what in ("damping", "friction")
    )
    if friction != 0.0:
        report.state_assumption("no dry friction, which the model has, of", name)
        dynamics.attrib.pop("friction", None)
    if not damping >= 0.0:
        report.state_repair("damping 0 in place of a negative or unreadable one for", name)
        dynamics.attrib.pop("damping", None)
        for inner in dynamics.findall("damping"):
            dynamics.remove(inner)
