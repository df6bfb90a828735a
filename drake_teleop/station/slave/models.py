"""Reading of robot models, with remedies for missing meshes, free bases and external packages."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple, TypeAlias, TypeVar
from xml.etree import ElementTree

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    Frame,
    Joint,
    JointIndex,
    ModelInstanceIndex,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
    WeldJoint,
)

from drake_teleop.common.errors import DrakeTeleopError, silent_stderr
from drake_teleop.common.texts import read_text
from drake_teleop.station.slave.meshes import remove_unusable_meshes
from drake_teleop.station.slave.mjcf_repair import repair_mjcf
from drake_teleop.station.slave.model_check import WORLD, check_model, check_tree
from drake_teleop.station.slave.model_files import (
    XACRO,
    effort_limits,
    floating_links,
    read_roots,
    remove_idle_elements,
    unsupported_joints,
)
from drake_teleop.station.slave.model_references import ModelFiles

# Elements that close kinematic loops in URDF and SDF.
_LOOP = re.compile(rb"<(drake:ball_constraint|drake:linear_bushing_rpy)\b")
# Prefix of assumptions about removed shapes.
_REMOVED_SHAPES = "shapes are missing of"
# Expected kind of file, and the remedy for missing packages.
_Description: TypeAlias = tuple[str, str]
_Found = TypeVar("_Found")
_ROBOT = ("robot", "with --package-path for package://")
_SCENE = ("scene", "its package:// addresses in folders around it")


@dataclass(frozen=True)
class ParsedModel:
    """Arm from `ParseModel`; `folder` contains converted meshes, which Drake reads later."""

    instance: ModelInstanceIndex
    sensor_frame: Frame
    assumptions: list[str]
    folder: TemporaryDirectory[str]


@dataclass(frozen=True)
class ParsedTool:
    """Tool from `ParseTool`; `body` is the body welded to the sensor frame."""

    body: RigidBody
    assumptions: list[str]
    folder: TemporaryDirectory[str] | None = None


def ParseModel(
    plant: MultibodyPlant,
    path: Path,
    sensor_frame: str,
    package_paths: tuple[Path, ...] = (),
    X_WBase: RigidTransform | None = None,
) -> ParsedModel:
    """Parse an arm into a plant; only the joints up to S move, each with one actuator.

    A free base is welded to the world at `X_WBase`. Other joints, such as a gripper's, are welded
    at their default positions. `package_paths` are folders of `package://` addresses.

    Raises:
        DrakeTeleopError: if the file cannot be read, has no frame `sensor_frame`, fails
            `check_model`, or fixes the base although `X_WBase` is not the identity.
    """
    before = set(plant.GetJointIndices())
    read = _parse(plant, path, package_paths, sensor=sensor_frame)
    with_frame = [i for i in read.instances if plant.HasFrameNamed(sensor_frame, i)]
    if len(with_frame) != 1:
        frames = [
            plant.get_frame(index).name()
            for instance in read.instances
            for index in plant.GetFrameIndices(instance)
        ]
        # Names that Drake creates for joints.
        frames = [name for name in frames if not name.endswith(("_parent", "_child", "__model__"))]
        known = ", ".join(sorted(set(frames)))
        raise DrakeTeleopError(
            f"{len(with_frame) or 'no'} frames are named {sensor_frame!r}",
            where=str(path),
            remedy=f"name one of {known}" if known else "give a model that has links",
        )
    frame = plant.GetFrameByName(sensor_frame, with_frame[0])
    chain = _weld_base(plant, frame, read.collect(unsupported_joints), X_WBase, str(path))
    _check_free_bodies(plant, read.instances, str(path))
    _check_chain(plant, chain, str(path))
    with translate_drake_errors(path):
        held = _weld_other_joints(plant, before, chain)
        _actuate(plant, chain, read.collect(effort_limits))
    instances = {plant.get_joint(k).model_instance() for k in chain if _moves(plant, k)}
    if len(instances) > 1:
        names = sorted(map(plant.GetModelInstanceName, instances))
        raise DrakeTeleopError(
            f"its joints belong to several models, {', '.join(names)}",
            where=str(path),
            remedy="write the chain up to the sensor as one model",
        )
    instance = next(iter(instances), with_frame[0])
    floating = [name for root in read.roots for name in floating_links(root)]
    welded = [f"welded to the world, where it may float: {', '.join(floating)}"] if floating else []
    return ParsedModel(instance, frame, [*read.assumptions, *welded, *held], read.folder)


def ParseTool(
    plant: MultibodyPlant, path: Path, sensor_frame: Frame, package_paths: tuple[Path, ...] = ()
) -> ParsedTool:
    """Parse a tool with one root link, weld the root to S ("sensor_weld"), and weld other joints.

    Raises:
        DrakeTeleopError: if the file cannot be read or has another number of roots.
    """
    before = set(plant.GetJointIndices())
    read = _parse(plant, path, package_paths)
    held = {plant.get_joint(k).child_body().index() for k in plant.GetJointIndices()}
    bodies = [index for instance in read.instances for index in plant.GetBodyIndices(instance)]
    roots = [plant.get_body(index) for index in bodies if index not in held]
    if len(roots) != 1:
        names = ", ".join(body.name() for body in roots) or "none"
        raise DrakeTeleopError(
            f"the tool has {len(roots)} roots: {names}",
            where=str(path),
            remedy="give one tree of links; its root is welded to the sensor frame",
        )
    with translate_drake_errors(path):
        assumptions = [*read.assumptions, *_weld_other_joints(plant, before, [])]
    weld = WeldJoint("sensor_weld", sensor_frame, roots[0].body_frame(), RigidTransform.Identity())
    plant.AddJoint(weld)
    return ParsedTool(roots[0], assumptions, read.folder)


def ParseScene(plant: MultibodyPlant, path: Path) -> TemporaryDirectory[str]:
    """Parse the surroundings of an arm; return the folder of their converted meshes.

    Raises:
        DrakeTeleopError: if the file cannot be read, or contains elements that Drake ignores.
    """
    read = _parse(plant, path, (), _SCENE)
    missing = [text for text in read.assumptions if text.startswith(_REMOVED_SHAPES)]
    missing += [f"{name} {what}" for name, what in read.collect(unsupported_joints).items()]
    if missing:
        raise DrakeTeleopError(
            missing[0],
            where=str(path),
            remedy="correct it; every object that the tool could touch must be readable",
        )
    return read.folder


class _ModelContent(NamedTuple):
    """Parsed content of a model file."""

    instances: list[ModelInstanceIndex]
    roots: list[ElementTree.Element]
    assumptions: list[str]
    folder: TemporaryDirectory[str]

    def collect(
        self, find: Callable[[ElementTree.Element], dict[str, _Found]]
    ) -> dict[str, _Found]:
        return {name: what for root in self.roots for name, what in find(root).items()}


def _parse(
    plant: MultibodyPlant,
    path: Path,
    package_paths: tuple[Path, ...],
    expected: _Description = _ROBOT,
    sensor: str = "",
) -> _ModelContent:
    if not os.path.isfile(path):
        raise DrakeTeleopError("there is no such file", where=str(path))
    if path.suffix.lower() == ".xacro":
        raise DrakeTeleopError("is a xacro file", where=str(path), remedy=XACRO)
    kind = path.suffix.lower().removeprefix(".")
    if kind == "xml":
        read_text(path)  # raises an error for invalid encoding
    files = ModelFiles(path, package_paths)
    parser = Parser(plant)
    parser.SetAutoRenaming(True)
    files.share_packages(parser.package_map())
    files.check(path)
    assumptions: list[str] = []
    converted = TemporaryDirectory(prefix="drake_teleop_")
    forces = plant.num_force_elements()
    roots = read_roots(path, files)
    if kind != "xml":
        _check_no_loop(path, kind)
    with translate_drake_errors(path, expected):
        for file, root in roots.items():
            assumptions += check_model(root, str(file), sensor)
        if kind in ("urdf", "sdf"):
            root = roots[path]
            assumptions += remove_idle_elements(root)
            lost = remove_unusable_meshes(root, files, Path(converted.name))
            assumptions += [
                f"{_REMOVED_SHAPES} {', '.join(ls)}: {what}" for what, ls in lost.items()
            ]
            for uri in root.iterfind(".//include/uri"):  # or Drake uses the working folder
                if (included := files.file((uri.text or "").strip())) is not None:
                    uri.text = f"file://{included.resolve()}"
            text = ElementTree.tostring(root, encoding="unicode")
            with _raise_logged_errors():
                instances = parser.AddModelsFromString(text, kind)
        elif kind == "xml":
            read = repair_mjcf(
                path, files, sensor, {}, Path(converted.name), is_scene=expected is _SCENE
            )
            assumptions += read.assumptions
            with _raise_logged_errors():
                instances = parser.AddModelsFromString(read.text, kind)
        else:
            with _raise_logged_errors():
                instances = parser.AddModels(str(path))
    if expected is _ROBOT and plant.num_force_elements() > forces:
        raise DrakeTeleopError(
            "has springs or other force elements",
            where=str(path),
            remedy="remove them; only motors, gravity and contact move the arm",
        )
    return _ModelContent(instances, list(roots.values()), assumptions, converted)


def _check_chain(plant: MultibodyPlant, chain: list[JointIndex], where: str) -> None:
    """Raise an error for joints that are neither revolute nor prismatic."""
    for joint in (plant.get_joint(index) for index in chain if _moves(plant, index)):
        if not isinstance(joint, (RevoluteJoint, PrismaticJoint)):
            raise DrakeTeleopError(
                f"{joint.name()} is a {joint.type_name()} joint",
                where=where,
                remedy="up to the sensor, use joints that turn about one axis or slide along it",
            )


def _check_free_bodies(
    plant: MultibodyPlant, instances: list[ModelInstanceIndex], where: str
) -> None:
    held = {plant.get_joint(k).child_body().index() for k in plant.GetJointIndices()}
    for index in (k for instance in instances for k in plant.GetBodyIndices(instance)):
        if index not in held:
            raise DrakeTeleopError(
                f"{plant.get_body(index).name()} is not connected to the arm",
                where=where,
                remedy="remove it; list objects that the tool touches in environment",
            )


def _check_no_loop(path: Path, kind: str) -> None:
    """Raise an error for loop constraints (`unsupported_joints` finds dependent joints)."""
    found = None if kind == "yaml" else _LOOP.search(path.read_bytes())
    if found:
        raise DrakeTeleopError(
            f"its links form a loop, by {found[1].decode()}",
            where=str(path),
            remedy="cut the loop, or model the chain to the sensor alone",
        )


def _moves(plant: MultibodyPlant, index: JointIndex) -> bool:
    return plant.get_joint(index).num_velocities() > 0


def _weld_other_joints(
    plant: MultibodyPlant, before: set[JointIndex], chain: list[JointIndex]
) -> list[str]:
    """Weld moving joints outside the chain at their default positions; return a note."""
    for constraint in plant.GetConstraintIds():  # for example of coupled fingers
        plant.RemoveConstraint(constraint)
    names = []
    for index in set(plant.GetJointIndices()) - before - set(chain):
        if not _moves(plant, index):
            continue
        joint = plant.get_joint(index)
        name, ends = joint.name(), (joint.frame_on_parent(), joint.frame_on_child())
        X_FM = _default_pose(joint)
        for k in plant.GetJointActuatorIndices():
            if plant.get_joint_actuator(k).joint().index() == index:
                plant.RemoveJointActuator(plant.get_joint_actuator(k))
        plant.RemoveJoint(joint)
        plant.AddJoint(WeldJoint(f"{name}_held", *ends, X_FM))
        names.append(name)
    return [f"held: {', '.join(sorted(names))}"] if names else []


def _default_pose(joint: Joint) -> RigidTransform:
    # Drake's `GetDefaultPose` covers few kinds of joints.
    q = joint.default_positions()
    if isinstance(joint, RevoluteJoint):
        return RigidTransform(AngleAxis(q[0], joint.revolute_axis()), np.zeros(3))
    if isinstance(joint, PrismaticJoint):
        return RigidTransform(q[0] * joint.translation_axis())
    return joint.GetDefaultPose() if np.any(q) else RigidTransform()


def _actuate(plant: MultibodyPlant, chain: list[JointIndex], limits: dict[str, float]) -> None:
    """Give each moving joint of the chain one actuator, in the order of the chain."""
    moving = [index for index in chain if _moves(plant, index)]
    actuators = [plant.get_joint_actuator(k) for k in plant.GetJointActuatorIndices()]
    own = [each for each in actuators if each.joint().index() in chain]
    if [each.joint().index() for each in own] == moving:
        return
    known = {
        each.joint().index(): (
            each.effort_limit(),
            each.default_rotor_inertia(),
            each.default_gear_ratio(),
        )
        for each in own
    }
    for each in own:
        plant.RemoveJointActuator(each)
    for index in moving:
        joint = plant.get_joint(index)
        effort, rotor, gear = known.get(index, (limits.get(joint.name(), 0.0), 0.0, 1.0))
        effort = effort if effort > 0.0 else np.inf
        actuator = plant.AddJointActuator(joint.name(), joint, effort)
        actuator.set_default_rotor_inertia(rotor)
        actuator.set_default_gear_ratio(gear)


@contextmanager
def translate_drake_errors(path: Path, expected: _Description = _ROBOT) -> Iterator[None]:
    """Convert Drake's exceptions about a model to a DrakeTeleopError with the model's file."""
    try:
        yield
    except DrakeTeleopError:
        raise
    # SystemExit: failed condition in Drake; LookupError: from C++ containers.
    except (RuntimeError, SystemExit, ValueError, LookupError) as error:
        reason = str(error).replace("<literal-string>", "").replace(f"{path.parent}/", "")
        raise DrakeTeleopError(
            f"cannot be read as a {expected[0]} ({reason.strip()})",
            where=str(path),
            remedy=f"give a URDF, SDF, MJCF or .dmd.yaml model, {expected[1]}",
        ) from None


@contextmanager
def _raise_logged_errors() -> Iterator[None]:
    """Raise RuntimeError for errors that Drake only logs, and for replaced inertias."""
    errors: list[str] = []

    def keep(record: logging.LogRecord) -> bool:
        message = record.getMessage()
        if record.levelno >= logging.ERROR or "inertia" in message:
            errors.append(" ".join(message.split()))
        return False

    log = logging.getLogger("drake")
    log.addFilter(keep)
    try:
        with silent_stderr():  # the parsers below Drake write to stderr
            yield
    finally:
        log.removeFilter(keep)
    if errors:
        raise RuntimeError(errors[0])


def _weld_base(
    plant: MultibodyPlant,
    frame: Frame,
    peculiar: dict[str, str],
    X_WBase: RigidTransform | None,
    where: str,
) -> list[JointIndex]:
    """Weld a free base to the world; return the joints up to S, from the base outwards."""

    def name_of(body: RigidBody) -> str:
        is_world = body.index() == plant.world_body().index()
        return WORLD if is_world else body.scoped_name().get_full()

    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    # `check_model` covers neither included files nor other formats than URDF and SDF.
    check_tree(
        ((each.name(), name_of(each.parent_body()), name_of(each.child_body())) for each in joints),
        where,
    )
    inboard = {joint.child_body().index(): joint for joint in joints}
    body, chain = frame.body(), list[Joint]()
    while body.index() in inboard:
        chain.append(inboard[body.index()])
        body = inboard[body.index()].parent_body()
    for name in (*(joint.name() for joint in chain), body.name()):
        if name in peculiar:
            raise DrakeTeleopError(
                f"{name} {peculiar[name]}",
                where=where,
                remedy="the arm up to the sensor has to be a chain of independent joints",
            )
    if body.index() != plant.world_body().index():
        X_WB = RigidTransform() if X_WBase is None else X_WBase
        plant.WeldFrames(plant.world_frame(), body.body_frame(), X_WB)
    elif X_WBase is not None and not X_WBase.IsExactlyIdentity():
        raise DrakeTeleopError(
            f"the model welds {chain[-1].child_body().name()} to the world itself",
            where=where,
            remedy="leave slave.base_pose out, or remove that joint from the model",
        )
    return [joint.index() for joint in reversed(chain)]
