"""Checks and repair of inertias, lengths and joint limits in the text of URDF and SDF models."""

from __future__ import annotations

import math
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.station.slave.model.model_repair import ModelRepair
from drake_teleop.station.slave.model.model_tree import WORLD_NAME, joint_link

# Row and column: ixx: (0, 0), ixy: (0, 1) and so on.
_INERTIA_ENTRY_INDICES = {f"i{'xyz'[i]}{'xyz'[k]}": (i, k) for i in range(3) for k in range(i, 3)}
# Relative changes of an inertia: rounding below the first, suspicious above the second.
_INERTIA_ROUNDING_RATIO, _SUSPICIOUS_INERTIA_CHANGE_RATIO = 1e-3, 0.05
_INERTIA_ROUNDING_KG_M2 = 1e-15  # changes below this are rounding
# Margin of corrected moments against rounding in Drake's check, relative to the largest one.
_PRINCIPAL_MOMENT_MARGIN_RATIO = 1e-9


def repair_inertia_and_detect_missing(
    link: Element, model: ModelRepair, *, is_sdf: bool, is_fixed: bool
) -> bool:
    """Replace impossible inertia of a link by the nearest possible; return True if none is given.

    Changes and faults are reported. If no joint of the arm moves the link (`is_fixed`), impossible
    inertia is removed, and the result is False.
    """
    name, inertial = link.get("name", ""), link.find("inertial")
    mass_element = link.find("inertial/mass")
    if inertial is None or mass_element is None:
        if is_sdf:
            model.add_assumption("the mass is 1 kg, the default of SDF, of link", name)
        elif inertial is not None:
            link.remove(inertial)
        return not (is_sdf or is_fixed)
    if name == WORLD_NAME:
        link.remove(inertial)
        return False
    text = (mass_element.get("value") or mass_element.text or "").strip()
    mass, inertia = parse_number(text), _inertia_tensor_of(inertial, is_sdf=is_sdf)
    fault = ""
    if not 0.0 <= mass <= MAX_MODEL_VALUE_SI:
        fault = f"mass {text} kg is not between 0 and {MAX_MODEL_VALUE_SI:g} kg"
    elif not (np.abs(inertia) <= MAX_MODEL_VALUE_SI).all():
        fault = f"an entry of its inertia is no number up to {MAX_MODEL_VALUE_SI:g} kg m^2"
    no_mass = not fault and mass == 0.0
    if is_fixed and (fault or (no_mass and inertia.any()) or nearest_possible_inertia(inertia)[1]):
        link.remove(inertial)
        what = "an impossible inertia left out, as no joint of the arm moves the link, of"
        model.add_assumption(what, name)
    elif fault:
        model.add_fault(f"link {name}: {fault}")
    else:
        if no_mass and inertia.any():
            model.add_repair("inertia is left out, because the mass is 0, of link", name)
        nearest = np.zeros((3, 3)) if no_mass else correct_impossible_inertia(inertia, name, model)
        entries = {entry: f"{nearest[at]:.17g}" for entry, at in _INERTIA_ENTRY_INDICES.items()}
        pose = inertial.findall("pose" if is_sdf else "origin")[:1]
        inertial.clear()
        inertial.extend(pose)
        if is_sdf:
            SubElement(inertial, "mass").text = f"{mass:.17g}"
            element = SubElement(inertial, "inertia")
            for entry, value in entries.items():
                SubElement(element, entry).text = value
        else:
            SubElement(inertial, "mass", value=f"{mass:.17g}")
            SubElement(inertial, "inertia", entries)
    return not is_fixed and not inertia.any()


def _inertia_tensor_of(inertial: Element, *, is_sdf: bool) -> Array:
    element, tensor = inertial.find("inertia"), np.zeros((3, 3))
    if element is None:
        return np.eye(3) if is_sdf else tensor
    for name, (row, column) in _INERTIA_ENTRY_INDICES.items():
        default = "1" if is_sdf and row == column else "0"
        text = element.get(name) or element.findtext(name) or default
        tensor[row, column] = tensor[column, row] = parse_number(text)
    return tensor


def correct_impossible_inertia(inertia: Array, name: str, model: ModelRepair) -> Array:
    """Return the nearest possible inertia tensor (3, 3); report a change for the link `name`."""
    nearest, change = nearest_possible_inertia(inertia)
    largest_change = change * np.abs(inertia).max()
    if 0.0 < change <= _INERTIA_ROUNDING_RATIO or 0.0 < largest_change <= _INERTIA_ROUNDING_KG_M2:
        model.add_assumption("rounding errors in the inertia are corrected, of link", name)
    elif change:
        what = "inertia replaced by the nearest possible one (share of its largest moment) of link"
        warning = "warning: " if change > _SUSPICIOUS_INERTIA_CHANGE_RATIO else ""
        model.add_repair(f"{warning}{what}", f"{name} ({100 * change:.3g} %)")
    return nearest


def nearest_possible_inertia(inertia: Array) -> tuple[Array, float]:
    """Return the nearest possible inertia tensor (3, 3) about the centre of mass, and the change.

    Negative principal moments become 0. Then an excess of p3 over p1 + p2 is distributed equally,
    which is nearest in the Frobenius norm. The change is the largest difference of a principal
    moment, divided by the largest moment.
    """
    given, axes = np.linalg.eigh((inertia + inertia.T) / 2.0)
    moments = np.maximum(given, 0.0)
    deficit = moments[2] - moments[1] - moments[0]
    largest = float(np.abs(given).max())
    if given[0] >= 0.0 and deficit <= 0.0:
        return inertia, 0.0
    moments += max(deficit, 0.0) / 3.0 * np.array([1.0, 1.0, -1.0])
    moments[0] += _PRINCIPAL_MOMENT_MARGIN_RATIO * largest
    return (axes * moments) @ axes.T, float(np.abs(moments - given).max()) / largest


MAX_MODEL_VALUE_SI = 1e6  # largest length, mass or inertia, SI units; limits may be larger
_NUMBER_LIST_ATTRIBUTES = {"xyz", "rpy", "rgba", "size", "scale"}
_NUMBER_LIST_TAGS = ("pose", "xyz", "size", "scale", "diffuse", "ambient", "specular", "emissive")
# Elements with lengths, inertias or rotor inertias in URDF and SDF.
_DIMENSION_TAGS = {"origin", "pose", "box", "cylinder", "sphere", "capsule", "ellipsoid", "size"}
_DIMENSION_TAGS |= {"radius", "radii", "length", "scale", "drake:rotor_inertia", "drake:gear_ratio"}


def parse_number(text: str | None) -> float:
    """Return the number in a text, or NaN if there is none."""
    try:
        return float(text or "")
    except ValueError:
        return math.nan


def parse_numbers(text: str | None) -> list[float]:
    return [parse_number(word) for word in (text or "").split()]


def replace_commas_by_blanks(root: Element) -> None:
    for element in root.iter():
        for name in _NUMBER_LIST_ATTRIBUTES & element.attrib.keys():
            element.set(name, element.attrib[name].replace(",", " "))
        if element.tag in _NUMBER_LIST_TAGS and element.text:
            element.text = element.text.replace(",", " ")


def check_lengths_and_inertias(element: Element, where: str, model: ModelRepair) -> None:
    """Report lengths and inertias in an element that are not finite or above 1e6 (SI) as faults."""
    for inner in element.iter():
        if inner.tag not in _DIMENSION_TAGS:
            continue
        if inner.tag == "origin":
            for name, text in inner.attrib.items():
                values = parse_numbers(text)
                if len(values) != 3 or any(map(math.isnan, values)):
                    model.add_fault(f"{where}: {name} of origin is {text!r}, not three numbers")
        for word in " ".join([inner.text or "", *map(str, inner.attrib.values())]).split():
            value = parse_number(word)
            if math.isnan(value) and word.lower().strip("+-") != "nan":
                continue  # a name; Drake reports an invalid number
            if not abs(value) <= MAX_MODEL_VALUE_SI:
                what = f"is no finite number up to {MAX_MODEL_VALUE_SI:g}"
                model.add_fault(f"{where}: {inner.tag} {word} {what}")
            if inner.tag == "drake:rotor_inertia" and value < 0.0:
                model.add_fault(f"{where}: a rotor inertia of {word} kg m^2 is negative")


def repair_joint(joint: Element, links: set[str], model: ModelRepair, *, in_chain: bool) -> None:
    name = joint.get("name", "")
    where, is_held = f"joint {name}", name in model.purpose.held_positions
    in_chain &= not is_held
    for end in ("parent", "child"):
        link = joint_link(joint, end)
        if not link:
            model.add_fault(f"{where} has no {end} link")
        elif link not in links and link != WORLD_NAME and "::" not in link and in_chain:
            model.add_fault(f"{where}: the {end} link {link!r} does not exist")
    check_lengths_and_inertias(joint, where, model)
    is_fixed = joint.get("type") == "fixed"
    for mimic in joint.findall("mimic") if is_fixed or is_held else ():
        joint.remove(mimic)
    if is_fixed:
        return
    if in_chain:
        _check_joint_type_mimic_and_axis(joint, where, model)
    for limit in joint.iter("limit"):
        _check_joint_limit(limit, where, model)
    for dynamics in joint.iter("dynamics"):
        _check_joint_dynamics(dynamics, name, model)


def _check_joint_type_mimic_and_axis(joint: Element, where: str, model: ModelRepair) -> None:
    kind, name = joint.get("type") or "typeless", joint.get("name", "")
    if kind not in ("revolute", "continuous", "prismatic"):
        between = f" on {joint_link(joint, 'parent')}" if kind == "floating" else ""
        remedy = "up to the sensor, use joints that turn about one axis or slide along it"
        model.add_fault(f"joint {name} is a {kind} joint{between}, which is unsupported; {remedy}")
    elif joint.find("mimic") is not None or joint.find("axis/mimic") is not None:
        remedy = "add it to slave.hold, or remove the tag"
        model.add_fault(f"joint {name} moves with another joint (mimic); {remedy}")
    axis = joint.find("axis")
    text = None if axis is None else axis.get("xyz") or axis.findtext("xyz")
    values = parse_numbers(text or "1 0 0")
    if len(values) != 3 or not all(map(math.isfinite, values)) or not any(values):
        model.add_fault(f"{where}: axis {text!r} is no direction; give 3 numbers, not all 0")


def _check_joint_limit(limit: Element, where: str, model: ModelRepair) -> None:
    values = dict[str, float]()
    for name in ("lower", "upper", "velocity", "effort"):
        text = limit.get(name) or limit.findtext(name)
        is_motor = name == "effort" and not model.purpose.is_scene
        if not text or (is_motor and parse_number(text) == 0):  # Drake omits motors of effort 0
            limit.attrib.pop(name, None)
            for inner in limit.findall(name):
                limit.remove(inner)
            continue
        values[name] = parse_number(text)
        if math.isnan(values[name]):
            model.add_fault(f"{where}: {name} limit {text.strip()!r} is not a number")
        elif name in ("velocity", "effort") and values[name] < 0.0:
            # In SDF, -1 means no limit.
            if limit.get(name) is not None or values[name] != -1.0:
                model.add_fault(f"{where}: {name} limit {values[name]:g} is negative")
        elif math.isinf(values[name]) and limit.get(name) is not None:
            del limit.attrib[name]  # the missing limit is stated
    lower, upper = values.get("lower", -math.inf), values.get("upper", math.inf)
    if lower > upper:
        model.add_fault(f"{where}: lower limit {lower:g} is above upper limit {upper:g}")


def _check_joint_dynamics(dynamics: Element, name: str, model: ModelRepair) -> None:
    texts = [dynamics.get(tag) or dynamics.findtext(tag) for tag in ("damping", "friction")]
    damping, friction = (parse_number(text or "0") for text in texts)
    if friction != 0.0:
        model.add_assumption("no effect of the dry friction in the file on", name)
        dynamics.attrib.pop("friction", None)
    if not damping >= 0.0:
        model.add_repair("damping is 0, not negative or unreadable, of joint", name)
        dynamics.attrib.pop("damping", None)
        for inner in dynamics.findall("damping"):
            dynamics.remove(inner)
