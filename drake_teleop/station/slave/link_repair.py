"""Repair of masses and inertias of links in URDF and SDF."""

from __future__ import annotations

from xml.etree.ElementTree import Element, SubElement

import numpy as np
from numpy.typing import NDArray

from drake_teleop.station.slave.model_numbers import MAX_VALUE, number
from drake_teleop.station.slave.model_tree import WORLD
from drake_teleop.station.slave.possible_inertia import nearest_possible_inertia
from drake_teleop.station.slave.repair_report import RepairReport

_ENTRIES = {
    "ixx": (0, 0),
    "ixy": (0, 1),
    "ixz": (0, 2),
    "iyy": (1, 1),
    "iyz": (1, 2),
    "izz": (2, 2),
}
# Relative changes of an inertia: rounding below the first, suspicious above the second.
_ROUNDING, _SUSPICIOUS = 1e-3, 0.05
_NEGLIGIBLE_KG_M2 = 1e-15  # changes below this are rounding


def repair_inertia(link: Element, report: RepairReport, *, is_sdf: bool, at_rest: bool) -> bool:
    """Give a link a mass and an inertia that a body can have; state what changed.

    Nothing depends on those of links at rest: they are removed if impossible. Return whether the
    file gives the link neither.
    """
    name, inertial = link.get("name", ""), link.find("inertial")
    if inertial is None or inertial.find("mass") is None:
        if is_sdf:
            report.state("1 kg, the default of SDF, for", name)
        elif inertial is not None:
            link.remove(inertial)
        return not is_sdf
    if name == WORLD:
        link.remove(inertial)
        return False
    if not is_sdf:
        inertial.find("mass").set("value", _text(inertial.find("mass")))  # type: ignore[union-attr]
    mass, inertia = _mass(inertial), _inertia(inertial, is_sdf=is_sdf)
    invalid = _fault(inertial, mass, inertia)
    if at_rest:
        if invalid or (mass == 0.0) != (not inertia.any()) or nearest_possible_inertia(inertia)[1]:
            link.remove(inertial)
            report.state(
                "an impossible inertia left out, as no joint of the arm moves the link, of", name
            )
    elif invalid:
        report.refuse(f"link {name}: {invalid}")
    elif mass == 0.0:
        if inertia.any():
            report.repair("an inertia without a mass left out of", name)
        _remove_mass(link, inertial, is_sdf=is_sdf)
    elif inertia.any():
        _correct(inertial, inertia, name, report)
    return not at_rest and not inertia.any()


def _mass(inertial: Element) -> float:
    return number(_text(inertial.find("mass")))


def _text(mass: Element | None) -> str:
    return "" if mass is None else (mass.get("value") or mass.text or "").strip()


def _inertia(inertial: Element, *, is_sdf: bool) -> NDArray[np.float64]:
    element, tensor = inertial.find("inertia"), np.zeros((3, 3))
    if element is None:
        return np.eye(3) if is_sdf else tensor
    for name, (row, column) in _ENTRIES.items():
        default = "1" if is_sdf and row == column else "0"
        text = element.get(name) or element.findtext(name) or default
        tensor[row, column] = tensor[column, row] = number(text)
    return tensor


def _fault(inertial: Element, mass: float, inertia: NDArray[np.float64]) -> str:
    if not 0.0 <= mass <= MAX_VALUE:
        text = _text(inertial.find("mass"))
        return f"mass {text} kg is not between 0 and {MAX_VALUE:g} kg"
    if not (np.abs(inertia) <= MAX_VALUE).all():
        return f"an entry of its inertia is no number up to {MAX_VALUE:g} kg m^2"
    return ""


def _remove_mass(link: Element, inertial: Element, *, is_sdf: bool) -> None:
    link.remove(inertial)
    if is_sdf:  # without the element, the mass is 1 kg
        inertial = SubElement(link, "inertial")
        SubElement(inertial, "mass").text = "0"
        _write(SubElement(inertial, "inertia"), np.zeros((3, 3)), is_sdf=True)


def _correct(
    inertial: Element, inertia: NDArray[np.float64], name: str, report: RepairReport
) -> None:
    nearest, change = nearest_possible_inertia(inertia)
    if change == 0.0:
        return
    if change <= _ROUNDING or change * np.abs(inertia).max() <= _NEGLIGIBLE_KG_M2:
        report.state("an inertia corrected for rounding of", name)
    else:
        what = "inertia replaced by the nearest possible one (share of its largest moment) of link"
        warning = "warning: " if change > _SUSPICIOUS else ""
        report.repair(f"{warning}{what}", f"{name} ({100 * change:.3g} %)")
    element = inertial.find("inertia")
    if element is not None:
        _write(element, nearest, is_sdf=element.get("ixx") is None)


def _write(element: Element, inertia: NDArray[np.float64], *, is_sdf: bool) -> None:
    for name, place in _ENTRIES.items():
        text = f"{inertia[place]:.17g}"
        if not is_sdf:
            element.set(name, text)
            continue
        child = element.find(name)
        (SubElement(element, name) if child is None else child).text = text
