"""Torque and force limits of joints, by the actuators of an MJCF file."""

from __future__ import annotations

from drake_teleop.station.slave.mjcf_bodies import Joint
from drake_teleop.station.slave.mjcf_elements import Attributes, Mjcf

_INTEGRATORS = ("integrator", "muscle", "user", "dcmotor")  # dynamics whose output has no range


def effort_limits(mjcf: Mjcf, joints: list[Joint]) -> dict[str, float]:
    """Return the limits [N m, N] of joints by name; joints without a limit have no entry.

    Several actuators of a joint add up. The joint's own `actuatorfrcrange` limits their sum.
    """
    by_joint: dict[str, float] = {}
    for element in mjcf.children("actuator"):
        given = mjcf.attributes(element, "", f"actuator {element.get('name', '')}")
        name = given.get("joint") or given.get("jointinparent")
        if name:
            by_joint[name] = by_joint.get(name, 0.0) + _limit(mjcf, given, element.tag)
    limits = {}
    for joint in joints:
        own = joint.attributes.limits(
            "actuatorfrcrange", "actuatorfrclimited", automatic=mjcf.autolimits
        )
        limit = min(by_joint.get(joint.name, float("inf")), _largest(own))
        if 0.0 < limit < float("inf"):
            limits[joint.name] = limit
    return limits


def _limit(mjcf: Mjcf, given: Attributes, tag: str) -> float:
    gear = abs(given.numbers("gear", (1.0,))[0])
    force = _largest(given.limits("forcerange", "forcelimited", automatic=mjcf.autolimits))
    if (gain := _gain(given, tag)) > 0.0:
        control = given.limits("ctrlrange", "ctrllimited", automatic=mjcf.autolimits)
        force = min(force, gain * _largest(control))
    return gear * force


def _gain(given: Attributes, tag: str) -> float:
    """Return force by control signal; 0 if the signal is no force (position servo)."""
    if tag == "motor":
        return 1.0
    if tag != "general" or given.get("kind", "general") not in ("general", "motor"):
        return 0.0
    biased = given.get("biastype", "none") != "none" and any(given.numbers("biasprm", (0.0,) * 3))
    if biased or given.get("gaintype", "fixed") != "fixed" or given.get("dyntype") in _INTEGRATORS:
        return 0.0
    return abs(given.numbers("gainprm", (1.0,))[0])


def _largest(limits: tuple[float, float] | None) -> float:
    """Return the effort that is available in both directions, or in the only one."""
    if limits is None:
        return float("inf")
    smaller, larger = sorted(map(abs, limits))
    return smaller if limits[0] < 0.0 < limits[1] else larger
