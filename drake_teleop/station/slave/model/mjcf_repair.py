"""Repair of an MJCF text, so that Drake reads the arm in it as MuJoCo does.

The new text has poses as quaternions, angles in rad, masses as explicit inertias, one joint per
body, and only bodies that the arm carries.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from xml.etree.ElementTree import Element

import numpy as np
from pydrake.math import RigidTransform

from drake_teleop.station.slave.model import model_numbers, model_repair
from drake_teleop.station.slave.model.mjcf_bodies import Body, BodyReader, Joint, MjcfWriter
from drake_teleop.station.slave.model.mjcf_elements import Attributes, Mjcf
from drake_teleop.station.slave.model.mjcf_meshes import ZERO_MASS_PROPERTIES

_DRAKE_GRAVITY_M_S2, _GRAVITY_TOLERANCE_M_S2 = (0.0, 0.0, -9.81), 0.02  # [m/s^2]
# Dynamics whose output has no range.
_ACTUATOR_DYNTYPES_WITHOUT_LIMIT = ("integrator", "muscle", "user", "dcmotor")


def repair_mjcf(model: model_repair.ModelRepair) -> None:
    """Set `model.text` to an MJCF text that Drake reads, with converted meshes.

    Only scenes, and files that model directives add, keep all bodies and joints.
    """
    purpose, mjcf = model.purpose, Mjcf(model)
    reader = BodyReader(mjcf)
    if not mjcf.root.get("model"):
        model.add_assumption("the model has no name and gets that of its file:", model.path.stem)
    for option in mjcf.root.findall("option"):
        gravity = Attributes(option.attrib, "option", model).vector("gravity", _DRAKE_GRAVITY_M_S2)
        if np.abs(np.subtract(gravity, _DRAKE_GRAVITY_M_S2)).max() > _GRAVITY_TOLERANCE_M_S2:
            model.add_assumption("gravity is 9.81 m/s^2, not the file's", option.get("gravity", ""))
    is_complete = purpose.is_scene or purpose.is_in_directives
    if is_complete or not purpose.sensor_name:
        world = _split_into_one_joint_bodies(reader.read_world())
        if purpose.is_tool and all(body.name != "tip" for body in world.with_descendants()):
            _insert_sensor_frame_at_site(world, "tip", is_force_sensor_site=False)
    else:
        world = _read_world_with_only_arm(mjcf, reader)
    bodies, sensor = world.with_descendants(), purpose.sensor_name
    if is_complete:
        moving = [joint for body in bodies for joint in body.joints]
        _report_unread_couplings_and_springs(moving, mjcf)
    else:
        chain = [body for body in bodies if sensor in {x.name for x in body.with_descendants()}]
        moving = _weld_other_joints_and_list_moving(world, chain, model)
        _check_joint_couplings(world, chain, moving, mjcf)
    if purpose.is_tool and world.geoms:
        world.geoms.clear()
        what = "shapes are left out, because the tool does not carry them, of"
        model.add_assumption(what, "the world")
    _report_equal_names_and_generators(bodies, model)
    _set_mass_properties(world, reader, set(moving), mjcf)
    with_motor = [joint for joint in moving if joint.kind in ("hinge", "slide")]
    efforts = {} if purpose.is_scene else _effort_limits(mjcf, with_motor)
    for fault, shapes in reader.lost.items():
        for body, shape in shapes:
            if shape.has_contact or not body.geoms:
                model.add_repair(f"{fault}; {model_repair.MISSING_SHAPES_TEXT}", body.name)
    model.auxiliary_bodies = {body.name for body in bodies if body.is_auxiliary}
    model.raise_faults()
    model.text = MjcfWriter(mjcf).write(world, efforts)
    model.raise_faults()


def _read_world_with_only_arm(mjcf: Mjcf, reader: BodyReader) -> Body:
    model, sensor = mjcf.model, mjcf.model.purpose.sensor_name
    worlds = mjcf.root.findall("worldbody")
    tops = [pair for element in worlds for pair in _iterate_top_bodies_with_parents(element)]
    kind = "body" if any(sensor in _names_of_elements(top, "body") for _, top in tops) else "site"
    carriers = [top for _, top in tops if sensor in _names_of_elements(top, kind)]
    if len(carriers) != 1:
        names = [_names_of_elements(top, tag) for tag in ("body", "site") for _, top in tops]
        known = set[str]().union(*names) - {""}
        what = "; ".join(model.describe_frame_fault(len(carriers), known))
        for fault in (what, *reader.meshes.inaccessible):
            model.add_fault(fault)
        model.raise_faults()
    others = [(parent, top) for parent, top in tops if top is not carriers[0]]
    for parent, other in others:
        parent.remove(other)
    world = reader.read_world()
    names_of_others = [other.get("name") or "a body without name" for _, other in others]
    for name in (*names_of_others, *world.generator_tags):
        model.add_assumption("elements beside the arm are left out:", name)
    world.generator_tags.clear()
    world = _split_into_one_joint_bodies(world)
    if kind == "site":
        sensors = [each for each in mjcf.elements_in("sensor") if each.tag in ("force", "torque")]
        is_measured = any(each.get("site") == sensor for each in sensors)
        _insert_sensor_frame_at_site(world, sensor, is_force_sensor_site=is_measured)
        model.add_assumption(model_repair.FRAME_REPLACES_SITE_TEXT, sensor)
    return world


def _iterate_top_bodies_with_parents(parent: Element) -> Iterator[tuple[Element, Element]]:
    for child in parent:
        if child.tag == "body":
            yield parent, child
        elif child.tag == "frame":
            yield from _iterate_top_bodies_with_parents(child)


def _names_of_elements(top: Element, tag: str) -> set[str]:
    return {each.get("name", "") for each in top.iter(tag)}


def _split_into_one_joint_bodies(body: Body) -> Body:
    body.children = [_split_into_one_joint_bodies(child) for child in body.children]
    outer_joints, body.joints = body.joints[:-1], body.joints[-1:]
    X_PB, name = body.X_PB, body.name
    for joint in reversed(outer_joints):
        body.X_PB, inner = RigidTransform(), body
        body = Body(f"{name}_{joint.name}", X_PB, [joint], children=[inner], is_auxiliary=True)
    return body


def _insert_sensor_frame_at_site(body: Body, site: str, *, is_force_sensor_site: bool) -> None:
    """Add a massless body as sensor frame, at the pose of a site on a descendant of `body`.

    If a force or torque sensor is at the site (`is_force_sensor_site`), the new body becomes the
    parent of the site's body, otherwise its child.
    """
    for k, child in enumerate(body.children):
        X_BS = child.sites.pop(site, None)
        if X_BS is None:
            _insert_sensor_frame_at_site(child, site, is_force_sensor_site=is_force_sensor_site)
        elif is_force_sensor_site:
            X_SB = X_BS.inverse()
            joints = [joint.transformed_by(X_SB) for joint in child.joints]
            inner, X_PS = replace(child, X_PB=X_SB, joints=[]), child.X_PB @ X_BS
            body.children[k] = Body(site, X_PS, joints, children=[inner], is_auxiliary=True)
        else:
            child.children.append(Body(site, X_BS, is_auxiliary=True))


def _weld_other_joints_and_list_moving(
    world: Body, chain: list[Body], model: model_repair.ModelRepair
) -> list[Joint]:
    """Weld free bodies and joints outside the chain; return joints that still move."""
    moving = list[Joint]()
    for body in world.with_descendants():
        joints, body.joints = body.joints, []
        for joint in joints:
            is_held = joint.kind != "free" and joint.name in model.purpose.held_positions
            if joint.kind == "free":
                if chain:  # a tool is welded to the sensor
                    model.add_assumption("welded to the world instead of floating:", body.name)
            elif not is_held and body not in chain:
                model.add_assumption("held:", joint.name)
            elif not is_held and joint.kind not in ("hinge", "slide"):
                model.add_fault(f"joint {joint.name} is a {joint.kind} joint; use hinge or slide")
            else:
                body.joints.append(joint)
                moving += [] if is_held else [joint]
    return moving


def _check_joint_couplings(arm: Body, chain: list[Body], joints: list[Joint], mjcf: Mjcf) -> None:
    model, moving = mjcf.model, {joint.name for joint in joints}
    # Moving body of the chain that carries each body.
    carriers = dict.fromkeys((body.name for body in arm.with_descendants()), "world")
    for moved in (body for body in chain if body.joints):
        carriers |= dict.fromkeys((body.name for body in moved.with_descendants()), moved.name)
    for element in mjcf.elements_in("equality"):
        given = mjcf.attributes_of(element, "", element.tag)
        ends = [given.get(name, "") for name in ("joint1", "joint2")]
        bodies = [given.get(name, "world") for name in ("body1", "body2")]
        is_of_arm = "site1" not in given and carriers.keys() >= set(bodies)
        closes_loop = is_of_arm and carriers[bodies[0]] != carriers[bodies[1]]
        if given.get("active") == "false":
            continue
        if element.tag == "joint" and moving.issuperset(filter(None, ends)):
            model.add_fault(f"{ends[0]} moves with another joint (equality); add it to slave.hold")
        elif element.tag in ("connect", "weld", "distance") and closes_loop:
            model.add_fault(f"the {element.tag} equality closes a loop of links; remove it")
        else:
            name = given.get("name") or " and ".join(filter(None, ends)) or element.tag
            model.add_assumption("no effect on the arm of the equality constraint", name)
    for element in mjcf.elements_in("tendon"):
        for name in (each.get("joint", "") for each in element.iter("joint")):
            if name in moving:
                model.add_assumption("no effect of the tendons in the file on", name)
    for joint in joints:
        for attribute, what in (("stiffness", "spring"), ("frictionloss", "dry friction")):
            if joint.attributes.number(attribute, 0.0) != 0.0:
                model.add_assumption(f"no effect of the {what} in the file on", joint.name)


def _report_unread_couplings_and_springs(joints: list[Joint], mjcf: Mjcf) -> None:
    for element in (*mjcf.elements_in("equality"), *mjcf.elements_in("tendon")):
        if element.get("active") != "false":
            name = f"{element.tag} {element.get('name', '')}".rstrip()
            mjcf.model.add_repair("couplings that Drake does not read from MJCF are lost:", name)
    for joint in joints:
        if joint.attributes.number("stiffness", 0.0) != 0.0:
            mjcf.model.add_repair("springs, which Drake does not read, are lost:", joint.name)
        if joint.attributes.number("frictionloss", 0.0) != 0.0:
            mjcf.model.add_assumption("no effect of the dry friction in the file on", joint.name)


def _effort_limits(mjcf: Mjcf, joints: list[Joint]) -> dict[str, float]:
    """Return the effort limits [N m, N] of joints by name; 0 and inf mean no limit.

    Limits of several actuators add up. The joint's own `actuatorfrcrange` limits their sum.
    """
    limits: dict[str, float] = {}
    for element in mjcf.elements_in("actuator"):
        given = mjcf.attributes_of(element, "", f"actuator {element.get('name', '')}")
        if name := given.get("joint") or given.get("jointinparent"):
            limits[name] = limits.get(name, 0.0) + _actuator_effort_limit(mjcf, given, element.tag)
    for joint in joints:
        names = "actuatorfrcrange", "actuatorfrclimited"
        own = _symmetric_limit_from_range(mjcf, joint.attributes, *names)
        limits[joint.name] = min(limits.get(joint.name, float("inf")), own)
    return {joint.name: limits[joint.name] for joint in joints}


def _actuator_effort_limit(mjcf: Mjcf, given: Attributes, tag: str) -> float:
    force = _symmetric_limit_from_range(mjcf, given, "forcerange", "forcelimited")
    if (gain := _effort_per_control_unit(given, tag)) > 0.0:
        limit = gain * _symmetric_limit_from_range(mjcf, given, "ctrlrange", "ctrllimited")
        force = min(force, limit)
    return abs(given.numbers("gear", (1.0,))[0]) * force


def _effort_per_control_unit(given: Attributes, tag: str) -> float:
    if tag == "motor":
        return 1.0
    if tag != "general" or given.get("kind", "general") not in ("general", "motor"):
        return 0.0
    biased = given.get("biastype", "none") != "none" and any(given.numbers("biasprm", (0.0,) * 3))
    is_unbounded = given.get("dyntype") in _ACTUATOR_DYNTYPES_WITHOUT_LIMIT
    if biased or given.get("gaintype", "fixed") != "fixed" or is_unbounded:
        return 0.0
    return abs(given.numbers("gainprm", (1.0,))[0])


def _symmetric_limit_from_range(mjcf: Mjcf, given: Attributes, name: str, flag: str) -> float:
    limits = given.read_range(name, flag, autolimits=mjcf.autolimits)
    if limits is None:
        return float("inf")
    smaller, larger = sorted(map(abs, limits))
    return smaller if limits[0] < 0.0 < limits[1] else larger


def _report_equal_names_and_generators(bodies: list[Body], model: model_repair.ModelRepair) -> None:
    for body in bodies:
        for tag in body.generator_tags:
            model.add_fault(f"{body.name} contains the unsupported <{tag}>; save it from MuJoCo")
    for kind, names in (
        ("bodies", [body.name for body in bodies]),
        ("joints", [joint.name for body in bodies for joint in body.joints]),
    ):
        twice = sorted(name for name, number in Counter(names).items() if number > 1)
        if twice:
            model.add_fault(f"several {kind} are named {model_repair.join_names(twice)}")


def _set_mass_properties(world: Body, reader: BodyReader, moving: set[Joint], mjcf: Mjcf) -> None:
    model, total = mjcf.model, mjcf.compiler.number("settotalmass", -1.0)
    factor = total / _sum_of_masses_in_file(model) if total > 0.0 else 1.0

    bodies = world.with_descendants()[1:]
    driven = {body for body in bodies if not moving.isdisjoint(body.joints)}
    moved = {each for body in driven for each in body.with_descendants()}
    for body in (body for body in bodies if not body.is_auxiliary):
        given = reader.mass_properties_of_body(body)
        body.inertial = ZERO_MASS_PROPERTIES
        if given.mass > 0.0:
            scaled = given.with_mass(factor * given.mass)
            inertia = model_numbers.nearest_possible_inertia(scaled.inertia)[0]
            if body in moved:
                inertia = model_numbers.correct_impossible_inertia(scaled.inertia, body.name, model)
            body.inertial = scaled._replace(inertia=inertia)
        elif body in moved and given.inertia.any():
            model.add_repair("inertia is left out, because the mass is 0, of link", body.name)
        if body in driven and body.inertial is ZERO_MASS_PROPERTIES:
            model.add_assumption("no inertia of", body.name)


def _sum_of_masses_in_file(model: model_repair.ModelRepair) -> float:
    unchanged = model_repair.ModelRepair(model.path, model.files, model.purpose, model.folder)
    reader = BodyReader(Mjcf(unchanged))
    bodies = reader.read_world().with_descendants()[1:]
    mass = sum(reader.mass_properties_of_body(body).mass for body in bodies)
    return mass or np.inf
