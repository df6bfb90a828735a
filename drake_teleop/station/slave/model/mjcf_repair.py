"""Repair of an MJCF text, so that Drake reads the arm in it as MuJoCo does.

The text is written anew: poses as quaternions, angles in rad, masses as explicit inertias, one
joint per body, and only the bodies that the arm carries.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from drake_teleop.station.slave.model import mjcf_chain
from drake_teleop.station.slave.model.link_repair import (
    correct_impossible_inertia,
    nearest_possible_inertia,
)
from drake_teleop.station.slave.model.mjcf_bodies import Body, BodyReader, takes_part_in_contacts
from drake_teleop.station.slave.model.mjcf_elements import Attributes, Mjcf
from drake_teleop.station.slave.model.mjcf_masses import ZERO_MASS_PROPERTIES
from drake_teleop.station.slave.model.mjcf_text import MjcfText
from drake_teleop.station.slave.model.model_references import ModelFiles, read_xml
from drake_teleop.station.slave.model.repair_report import RepairedModel, RepairReport, join_names
from drake_teleop.station.slave.model.urdf_repair import ModelPurpose

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
        world = mjcf_chain.read_whole_world(reader)
        chain = world.with_descendants() if is_complete else []
    else:
        world = mjcf_chain.read_world_with_arm(mjcf, reader, purpose.sensor_name)
        chain = world.bodies_on_path_to(purpose.sensor_name)
    if is_complete:
        moving = [(body, joint) for body in chain for joint in body.joints]
        mjcf_chain.report_lost_couplings([joint for _, joint in moving], mjcf)
    else:
        moving = mjcf_chain.weld_joints_outside_chain(world, chain, purpose.held_positions, mjcf)
        mjcf_chain.check_joint_couplings(world, chain, [joint for _, joint in moving], mjcf)
    if purpose.is_tool and world.geoms:
        world.geoms.clear()
        report.state_assumption(
            "left out, because the tool does not carry them: shapes of", "the world"
        )
    joints = [joint for _, joint in moving if joint.kind in ("hinge", "slide")]
    _check_names_and_generators(world, report)
    _set_body_masses(world, reader, {id(body) for body, _ in moving}, mjcf)
    limits = mjcf_chain.effort_limits(mjcf, joints)
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


def _set_body_masses(world: Body, reader: BodyReader, moving: set[int], mjcf: Mjcf) -> None:
    total = mjcf.compiler.number("settotalmass", -1.0)
    factor = total / _sum_of_masses_in_file(mjcf) if total > 0.0 else 1.0

    def set_masses_of_subtree(body: Body, is_moved: bool) -> None:
        is_moved |= id(body) in moving
        _set_mass_of_body(body, reader, factor, mjcf.report, is_moved=is_moved)
        if id(body) in moving and body.inertial is ZERO_MASS_PROPERTIES and not body.is_auxiliary:
            mjcf.report.state_assumption("no inertia of", body.name)
        for child in body.children:
            set_masses_of_subtree(child, is_moved)

    for body in world.children:
        set_masses_of_subtree(body, is_moved=False)


def _set_mass_of_body(
    body: Body, reader: BodyReader, factor: float, report: RepairReport, *, is_moved: bool
) -> None:
    if body.is_auxiliary:
        return
    properties = reader.mass_properties_of_body(body)
    if properties.mass <= 0.0:
        if is_moved and properties.inertia.any():
            report.state_repair("an inertia without a mass left out of", body.name)
        body.inertial = ZERO_MASS_PROPERTIES
        return
    properties = properties.with_mass(factor * properties.mass)
    inertia = nearest_possible_inertia(properties.inertia)[0]
    if is_moved:
        inertia = correct_impossible_inertia(properties.inertia, body.name, report)
    body.inertial = properties._replace(inertia=inertia)


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
