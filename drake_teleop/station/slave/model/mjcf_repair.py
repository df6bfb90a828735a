"""Repair of an MJCF text, so that Drake reads the arm in it as MuJoCo does.

The text is written anew: poses as quaternions, angles in rad, masses as explicit inertias, one
joint per body, and only the bodies that the arm carries.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np
from pydrake.math import RigidTransform

from drake_teleop.station.slave.model import model_numbers
from drake_teleop.station.slave.model.mjcf_bodies import (
    Body,
    BodyReader,
    Joint,
    takes_part_in_contacts,
)
from drake_teleop.station.slave.model.mjcf_elements import Attributes, Mjcf
from drake_teleop.station.slave.model.mjcf_meshes import ZERO_MASS_PROPERTIES, MassProperties
from drake_teleop.station.slave.model.mjcf_text import MjcfText
from drake_teleop.station.slave.model.model_references import ModelFiles, read_xml
from drake_teleop.station.slave.model.repair_report import (
    RepairedModel,
    RepairReport,
    describe_frame_fault,
    join_names,
)
from drake_teleop.station.slave.model.urdf_repair import ModelPurpose

# Dynamics whose output has no range.
_DYNTYPES_WITH_UNBOUNDED_OUTPUT = ("integrator", "muscle", "user", "dcmotor")


def read_world_with_arm(mjcf: Mjcf, reader: BodyReader, sensor: str) -> Body:
    """Return the world with only the tree of bodies that carries the sensor; report the others."""
    tops = reader.remove_top_bodies()
    kind = "body" if any(sensor in _names_of_elements(top, "body") for top, *_ in tops) else "site"
    carriers = [top for top in tops if sensor in _names_of_elements(top[0], kind)]
    if len(carriers) != 1:
        names = [_names_of_elements(top, tag) for tag in ("body", "site") for top, *_ in tops]
        known = set[str]().union(*names) - {""}
        what = "; ".join(describe_frame_fault(len(carriers), sensor, known))
        for fault in (what, *reader.meshes.inaccessible):
            mjcf.report.add_fault(fault)
        mjcf.report.raise_faults(mjcf.path)
    world = reader.read_world()
    others = [top for top, *_ in tops if top not in carriers[0]]
    names_of_others = [other.get("name") or "a body without name" for other in others]
    for name in (*names_of_others, *world.generator_tags):
        mjcf.report.state_assumption("left out, because the arm does not carry it:", name)
    world.generator_tags.clear()
    arm = _split_into_one_joint_bodies(reader.read_body(*carriers[0]))
    if kind == "site":
        sensors = [each for each in mjcf.elements_in("sensor") if each.tag in ("force", "torque")]
        measured = {each.get("site", "") for each in sensors}
        arm = _insert_sensor_frame_at_site(arm, sensor, is_force_sensor_site=sensor in measured)
        mjcf.report.state_assumption("a frame of the model in place of the site", sensor)
    world.children = [arm]
    return world


def weld_other_joints_and_list_moving(
    world: Body, chain: list[Body], hold: dict[str, float], mjcf: Mjcf
) -> list[tuple[Body, Joint]]:
    """Weld free bodies and joints outside the chain; return the moving joints with their bodies.

    The joints of `hold` remain in the file, because they are welded after the parsing.
    """
    report, moving = mjcf.report, list[tuple[Body, Joint]]()
    for body in world.with_descendants():
        joints, body.joints = body.joints, []
        for joint in joints:
            if joint.kind == "free":
                if chain:  # a tool is welded to the sensor
                    report.state_assumption("welded to the world, where it may float:", body.name)
            elif joint.name in hold:
                body.joints.append(joint)
            elif body not in chain:
                report.state_assumption("held:", joint.name)
            elif joint.kind not in ("hinge", "slide"):
                report.add_fault(f"{joint.name} is a {joint.kind} joint; use hinges and slides")
            else:
                body.joints.append(joint)
                moving.append((body, joint))
    return moving


def check_joint_couplings(arm: Body, chain: list[Body], joints: list[Joint], mjcf: Mjcf) -> None:
    """Report couplings between `joints` as faults; report other couplings as left out."""
    report, moving = mjcf.report, {joint.name for joint in joints}
    carriers = _moving_body_of_each_body(arm, {id(body) for body in chain})
    for element in mjcf.elements_in("equality"):
        given = mjcf.attributes_of(element, "", element.tag)
        ends = [given.get(name, "") for name in ("joint1", "joint2")]
        if given.get("active") == "false":
            continue
        if element.tag == "joint" and moving.issuperset(filter(None, ends)):
            report.add_fault(f"{ends[0]} moves with another joint (equality); hold one of them")
        elif element.tag in ("connect", "weld", "distance") and _closes_loop(given, carriers):
            report.add_fault(f"its links form a loop, by {element.tag}; cut it")
        else:
            name = given.get("name") or " and ".join(filter(None, ends)) or element.tag
            report.state_assumption("no effect on the arm of the equality", name)
    for element in mjcf.elements_in("tendon"):
        for name in (each.get("joint", "") for each in element.iter("joint")):
            if name in moving:
                report.state_assumption("no tendon, which the model has, of", name)
    for joint in joints:
        if joint.attributes.number("stiffness", 0.0) != 0.0:
            report.state_assumption("no spring, which the model has, of", joint.name)
        if joint.attributes.number("frictionloss", 0.0) != 0.0:
            report.state_assumption("no dry friction, which the model has, of", joint.name)


def report_lost_couplings(joints: list[Joint], mjcf: Mjcf) -> None:
    """Report all couplings and springs, which Drake does not read from MJCF."""
    for element in (*mjcf.elements_in("equality"), *mjcf.elements_in("tendon")):
        if element.get("active") != "false":
            name = f"{element.tag} {element.get('name', '')}".rstrip()
            mjcf.report.state_repair("no coupling, which Drake does not read from MJCF, by", name)
    for joint in joints:
        if joint.attributes.number("stiffness", 0.0) != 0.0:
            what = "no spring, which Drake does not read from MJCF, of"
            mjcf.report.state_repair(what, joint.name)


def _names_of_elements(top: Element, tag: str) -> set[str]:
    return {each.get("name", "") for each in top.iter(tag)}


def _split_into_one_joint_bodies(body: Body) -> Body:
    body.children = [_split_into_one_joint_bodies(child) for child in body.children]
    outer, innermost = None, body
    for joint in body.joints[:-1]:
        part = Body(f"{body.name}_{joint.name}", body.X_PB, [joint], is_auxiliary=True)
        if outer is None:
            outer = part
        else:
            innermost.children.append(part)
        innermost, body.X_PB = part, RigidTransform()
    if outer is None:
        return body
    innermost.children.append(body)
    body.joints = body.joints[-1:]
    return outer


def _insert_sensor_frame_at_site(body: Body, site: str, *, is_force_sensor_site: bool) -> Body:
    """Add a massless body at the pose of a site, as sensor frame.

    The new body carries the site's body if a `force` or `torque` sensor measures there
    (`is_force_sensor_site`). Otherwise the site's body carries it.
    """
    if site not in body.sites:
        body.children = [
            _insert_sensor_frame_at_site(child, site, is_force_sensor_site=is_force_sensor_site)
            for child in body.children
        ]
        return body
    X_BS = body.sites.pop(site)
    if not is_force_sensor_site:
        body.children.append(Body(site, X_BS, is_auxiliary=True))
        return body
    X_SB = X_BS.inverse()
    joints = [joint.transformed_by(X_SB) for joint in body.joints]
    inner = replace(body, X_PB=X_SB, joints=[])
    return Body(site, body.X_PB @ X_BS, joints, children=[inner], is_auxiliary=True)


def _moving_body_of_each_body(arm: Body, chain: set[int]) -> dict[str, str]:
    def pair_with_moving_body(body: Body, carrier: str) -> Iterator[tuple[str, str]]:
        carrier = body.name if id(body) in chain and body.joints else carrier
        yield body.name, carrier
        for child in body.children:
            yield from pair_with_moving_body(child, carrier)

    return dict(pair_with_moving_body(arm, "world"))


def _closes_loop(given: dict[str, str], carriers: dict[str, str]) -> bool:
    ends = [given.get("body1", "world"), given.get("body2", "world")]
    if "site1" in given or not all(end == "world" or end in carriers for end in ends):
        return False  # a free or mocap body, another arm
    first, second = (carriers.get(end, "world") for end in ends)
    return first != second


def effort_limits(mjcf: Mjcf, joints: list[Joint]) -> dict[str, float]:
    """Return the effort limits [N m, N] of joints by name; joints without a limit have no entry.

    Limits of several actuators add up. The joint's own `actuatorfrcrange` limits their sum.
    """
    by_joint: dict[str, float] = {}
    for element in mjcf.elements_in("actuator"):
        given = mjcf.attributes_of(element, "", f"actuator {element.get('name', '')}")
        name = given.get("joint") or given.get("jointinparent")
        if name:
            limit = _effort_limit_of_actuator(mjcf, given, element.tag)
            by_joint[name] = by_joint.get(name, 0.0) + limit
    limits = {}
    for joint in joints:
        names = "actuatorfrcrange", "actuatorfrclimited"
        own = joint.attributes.read_range(*names, automatic=mjcf.autolimits)
        limit = min(by_joint.get(joint.name, float("inf")), _effort_limit_in_both_directions(own))
        if 0.0 < limit < float("inf"):
            limits[joint.name] = limit
    return limits


def _effort_limit_of_actuator(mjcf: Mjcf, given: Attributes, tag: str) -> float:
    gear = abs(given.numbers("gear", (1.0,))[0])
    limits = given.read_range("forcerange", "forcelimited", automatic=mjcf.autolimits)
    force = _effort_limit_in_both_directions(limits)
    if (gain := _effort_per_control_unit(given, tag)) > 0.0:
        control = given.read_range("ctrlrange", "ctrllimited", automatic=mjcf.autolimits)
        force = min(force, gain * _effort_limit_in_both_directions(control))
    return gear * force


def _effort_per_control_unit(given: Attributes, tag: str) -> float:
    if tag == "motor":
        return 1.0
    if tag != "general" or given.get("kind", "general") not in ("general", "motor"):
        return 0.0
    biased = given.get("biastype", "none") != "none" and any(given.numbers("biasprm", (0.0,) * 3))
    is_unbounded = given.get("dyntype") in _DYNTYPES_WITH_UNBOUNDED_OUTPUT
    if biased or given.get("gaintype", "fixed") != "fixed" or is_unbounded:
        return 0.0
    return abs(given.numbers("gainprm", (1.0,))[0])


def _effort_limit_in_both_directions(limits: tuple[float, float] | None) -> float:
    if limits is None:
        return float("inf")
    smaller, larger = sorted(map(abs, limits))
    return smaller if limits[0] < 0.0 < limits[1] else larger


_DRAKE_GRAVITY_M_S2, _GRAVITY_TOLERANCE_M_S2 = (0.0, 0.0, -9.81), 0.02  # [m/s^2]


def repair_mjcf(
    root: Element, path: Path, files: ModelFiles, purpose: ModelPurpose, folder: Path
) -> RepairedModel:
    """Return an MJCF text that Drake reads, with meshes converted in `folder`.

    A scene, or a file that model directives add, keeps all bodies and joints.
    """
    report = RepairReport(strict=purpose.is_scene)
    mjcf = Mjcf(root, path, files, report)
    reader = BodyReader(mjcf)
    if not root.get("model"):
        report.state_assumption("the model is named after its file:", path.stem)
    for option in root.findall("option"):
        gravity = Attributes(option.attrib, "option", report).vector("gravity", _DRAKE_GRAVITY_M_S2)
        if np.abs(np.subtract(gravity, _DRAKE_GRAVITY_M_S2)).max() > _GRAVITY_TOLERANCE_M_S2:
            report.state_assumption("gravity of 9.81 m/s^2 instead of", option.get("gravity", ""))
    is_complete = purpose.is_scene or purpose.is_in_directives
    if is_complete or not purpose.sensor_name:
        world = _split_into_one_joint_bodies(reader.read_world())
        chain = world.with_descendants() if is_complete else []
    else:
        world = read_world_with_arm(mjcf, reader, purpose.sensor_name)
        chain = world.bodies_on_path_to(purpose.sensor_name)
    if is_complete:
        moving = [(body, joint) for body in chain for joint in body.joints]
        report_lost_couplings([joint for _, joint in moving], mjcf)
    else:
        moving = weld_other_joints_and_list_moving(world, chain, purpose.held_positions, mjcf)
        check_joint_couplings(world, chain, [joint for _, joint in moving], mjcf)
    if purpose.is_tool and world.geoms:
        world.geoms.clear()
        what = "left out, because the tool does not carry them: shapes of"
        report.state_assumption(what, "the world")
    joints = [joint for _, joint in moving if joint.kind in ("hinge", "slide")]
    _check_names_and_generators(world, report)
    _set_mass_properties_of_bodies(world, reader, {id(body) for body, _ in moving}, mjcf)
    limits = effort_limits(mjcf, joints)
    _report_lost_shapes(reader, report)
    report.raise_faults(path)
    text = MjcfText(mjcf, purpose, folder).write(world, [] if purpose.is_scene else joints)
    report.raise_faults(path)
    added = frozenset(body.name for body in world.with_descendants() if body.is_auxiliary)
    return RepairedModel(text, report.assumptions, limits, auxiliary_bodies=added)


def _check_names_and_generators(world: Body, report: RepairReport) -> None:
    bodies = world.with_descendants()
    for body in bodies:
        for tag in body.generator_tags:
            report.add_fault(f"{body.name} contains <{tag}>, which is not supported; expand it")
    for kind, names in (
        ("bodies", [body.name for body in bodies]),
        ("joints", [joint.name for body in bodies for joint in body.joints]),
    ):
        twice = sorted(name for name, number in Counter(names).items() if number > 1)
        if twice:
            report.add_fault(f"several {kind} are named {join_names(twice)}")


def _set_mass_properties_of_bodies(
    world: Body, reader: BodyReader, ids_of_moving_bodies: set[int], mjcf: Mjcf
) -> None:
    report, total = mjcf.report, mjcf.compiler.number("settotalmass", -1.0)
    factor = total / _sum_of_masses_in_file(mjcf) if total > 0.0 else 1.0

    def set_masses_of_subtree(body: Body, is_moved: bool) -> None:
        is_moved |= id(body) in ids_of_moving_bodies
        if not body.is_auxiliary:
            given = reader.mass_properties_of_body(body)
            body.inertial = _valid_properties(given, factor, body.name, report, is_moved=is_moved)
            if id(body) in ids_of_moving_bodies and body.inertial is ZERO_MASS_PROPERTIES:
                report.state_assumption("no inertia of", body.name)
        for child in body.children:
            set_masses_of_subtree(child, is_moved)

    for body in world.children:
        set_masses_of_subtree(body, is_moved=False)


def _valid_properties(
    given: MassProperties, factor: float, name: str, report: RepairReport, *, is_moved: bool
) -> MassProperties:
    if given.mass <= 0.0:
        if is_moved and given.inertia.any():
            report.state_repair("an inertia without a mass left out of", name)
        return ZERO_MASS_PROPERTIES
    scaled = given.with_mass(factor * given.mass)
    inertia = model_numbers.nearest_possible_inertia(scaled.inertia)[0]
    if is_moved:
        inertia = model_numbers.correct_impossible_inertia(scaled.inertia, name, report)
    return scaled._replace(inertia=inertia)


def _sum_of_masses_in_file(mjcf: Mjcf) -> float:
    reader = BodyReader(Mjcf(read_xml(mjcf.path), mjcf.path, mjcf.files, RepairReport()))
    bodies = reader.read_world().with_descendants()[1:]
    mass = sum(reader.mass_properties_of_body(body).mass for body in bodies)
    return mass if mass > 0.0 else np.inf


def _report_lost_shapes(reader: BodyReader, report: RepairReport) -> None:
    for fault, shapes in reader.lost.items():
        for body, shape in shapes:
            if takes_part_in_contacts(shape) or not body.geoms:
                report.state_repair(f"{fault}; shapes are missing of", body.name)
