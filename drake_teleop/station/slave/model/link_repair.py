"""Repair of masses and inertias of links in model files."""

from __future__ import annotations

from itertools import combinations_with_replacement
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.station.slave.model.model_numbers import MAX_MODEL_VALUE_SI, parse_number
from drake_teleop.station.slave.model.model_tree import WORLD_NAME
from drake_teleop.station.slave.model.repair_report import RepairReport

_INERTIA_ENTRIES = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_PLACE_OF_INERTIA_ENTRY = dict(
    zip(_INERTIA_ENTRIES, combinations_with_replacement(range(3), 2), strict=True)
)
# Relative changes of an inertia: rounding below the first, suspicious above the second.
_INERTIA_ROUNDING_SHARE, _SUSPICIOUS_INERTIA_CHANGE_SHARE = 1e-3, 0.05
_INERTIA_ROUNDING_KG_M2 = 1e-15  # changes below this are rounding
# Margin of corrected moments against rounding in Drake's check, relative to the largest one.
_TRIANGLE_INEQUALITY_MARGIN_SHARE = 1e-9


def repair_inertia(link: Element, report: RepairReport, *, is_sdf: bool, at_rest: bool) -> bool:
    """Replace physically impossible inertia of a link by the nearest possible one.

    `report` receives changes and faults. A link that no joint moves (`at_rest`) loses impossible
    values. Return True if a link that joints may move has no inertia.
    """
    name, inertial = link.get("name", ""), link.find("inertial")
    mass_element = link.find("inertial/mass")
    if inertial is None or mass_element is None:
        if is_sdf:
            report.state_assumption("1 kg, the default of SDF, for", name)
        elif inertial is not None:
            link.remove(inertial)
        return not is_sdf
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
    if at_rest and (fault or (no_mass and inertia.any()) or nearest_possible_inertia(inertia)[1]):
        link.remove(inertial)
        what = "an impossible inertia left out, as no joint of the arm moves the link, of"
        report.state_assumption(what, name)
    elif fault:
        report.add_fault(f"link {name}: {fault}")
    else:
        if no_mass and inertia.any():
            report.state_repair("an inertia without a mass left out of", name)
        nearest = np.zeros((3, 3)) if no_mass else correct_impossible_inertia(inertia, name, report)
        link.remove(inertial)
        _add_inertial_element(
            link, inertial.find("pose" if is_sdf else "origin"), mass, nearest, is_sdf=is_sdf
        )
    return not at_rest and not inertia.any()


def _inertia_tensor_of(inertial: Element, *, is_sdf: bool) -> Array:
    element, tensor = inertial.find("inertia"), np.zeros((3, 3))
    if element is None:
        return np.eye(3) if is_sdf else tensor
    for name, (row, column) in _PLACE_OF_INERTIA_ENTRY.items():
        default = "1" if is_sdf and row == column else "0"
        text = element.get(name) or element.findtext(name) or default
        tensor[row, column] = tensor[column, row] = parse_number(text)
    return tensor


def correct_impossible_inertia(inertia: Array, name: str, report: RepairReport) -> Array:
    """Return the nearest possible inertia tensor (3, 3); report a change for the link `name`."""
    nearest, change = nearest_possible_inertia(inertia)
    if (
        0.0 < change <= _INERTIA_ROUNDING_SHARE
        or 0.0 < change * np.abs(inertia).max() <= _INERTIA_ROUNDING_KG_M2
    ):
        report.state_assumption("an inertia corrected for rounding of", name)
    elif change:
        what = "inertia replaced by the nearest possible one (share of its largest moment) of link"
        warning = "warning: " if change > _SUSPICIOUS_INERTIA_CHANGE_SHARE else ""
        report.state_repair(f"{warning}{what}", f"{name} ({100 * change:.3g} %)")
    return nearest


def _add_inertial_element(
    link: Element, pose: Element | None, mass: float, inertia: Array, *, is_sdf: bool
) -> None:
    inertial = SubElement(link, "inertial")
    if pose is not None:
        inertial.append(pose)
    entries = {name: f"{inertia[place]:.17g}" for name, place in _PLACE_OF_INERTIA_ENTRY.items()}
    if is_sdf:
        SubElement(inertial, "mass").text = f"{mass:.17g}"
        element = SubElement(inertial, "inertia")
        for name, text in entries.items():
            SubElement(element, name).text = text
    else:
        SubElement(inertial, "mass", value=f"{mass:.17g}")
        SubElement(inertial, "inertia", entries)


def nearest_possible_inertia(inertia: Array) -> tuple[Array, float]:
    """Return the nearest possible inertia tensor (3, 3) about the centre of mass, and the change.

    Negative principal moments become 0. Then a deficit of p3 <= p1 + p2 is distributed in equal
    parts, which is nearest in the Frobenius norm. The change is the largest of a principal moment,
    relative to the largest moment; it is 0 for a possible tensor.
    """
    given, axes = np.linalg.eigh((inertia + inertia.T) / 2.0)
    moments = np.maximum(given, 0.0)
    deficit = moments[2] - moments[1] - moments[0]
    largest = float(np.abs(given).max())
    if given[0] >= 0.0 and deficit <= 0.0:
        return inertia, 0.0
    moments += max(deficit, 0.0) / 3.0 * np.array([1.0, 1.0, -1.0])
    moments[0] += _TRIANGLE_INEQUALITY_MARGIN_SHARE * largest
    distance = float(np.abs(moments - given).max()) / largest
    return (axes * moments) @ axes.T, distance
