"""What a robot model's files say beside what Drake reads of them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.slave.meshes import Packages
from drake_teleop.slave.model_check import WORLD
from drake_teleop.texts import read_yaml

XACRO = "run it through xacro first, and give the URDF that comes out"


def _read_xml(path: Path) -> Element:
    """The root of an XML file, with names as they stand there: Drake knows its own by `drake:`.

    Drake's parser reads what is no XML too. That would be checked by nobody, so it is an error.
    """
    builder, parser = ElementTree.TreeBuilder(), expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    parser.CharacterDataHandler = builder.data

    def unread(name: str | None, *_: object) -> NoReturn:
        raise ValueError(f"the entity {name} is not in this file")

    parser.SkippedEntityHandler = parser.ExternalEntityRefHandler = unread
    try:
        parser.Parse(path.read_bytes(), True)
        return builder.close()
    except (expat.ExpatError, ValueError, LookupError) as error:  # the last two of its encoding
        remedy = "give a URDF or SDF that other readers of XML take too"
        raise DrakeTeleopError(f"is not XML ({error})", where=str(path), remedy=remedy) from None


def read_roots(path: Path, packages: Packages) -> dict[Path, Element]:
    """Roots of the XML that is a model, by file: of itself, or of what model directives add.

    Raises:
        DrakeTeleopError: for what is no XML, no YAML, or still a macro.
    """
    kind = path.suffix.lower()
    if kind == ".yaml":
        data = read_yaml(path, tagged=True)  # Drake's parser overflows its stack over many brackets
        files = [file for address in _added(data) if (file := packages.file(address))]
        # What is not there, and what they include, is said by Drake, or not at all.
        roots = {file: _read_xml(file) for file in files if file.suffix in (".urdf", ".sdf")}
    else:
        roots = {path: _read_xml(path)} if kind in (".urdf", ".sdf", ".xml") else {}
    for file, root in roots.items():
        if any(element.tag.startswith("xacro:") for element in root.iter()):
            raise DrakeTeleopError("is a macro", where=str(file), remedy=XACRO)
    return roots


def _added(data: Any) -> Iterator[str]:
    """Addresses of the models that directives add."""
    directives = data.get("directives") if isinstance(data, dict) else None
    for each in directives if isinstance(directives, list) else []:
        model = each.get("add_model") if isinstance(each, dict) else None
        if isinstance(model, dict) and isinstance(model.get("file"), str):
            yield model["file"]


def peculiar_joints(root: Element) -> dict[str, str]:
    """Joints that do not move by themselves, and links that float on another link.

    Drake ignores both. By the name of joint or link, what it does.
    """
    found: dict[str, str] = {}
    for joint in root.iter("joint"):
        if joint.find("mimic") is not None or joint.find("axis/mimic") is not None:
            found[joint.get("name", "")] = "moves with another joint (mimic)"
        if joint.get("stiffness", "0").strip("0. "):  # of MJCF
            found[joint.get("name", "")] = "has a spring (stiffness)"
        for parent, child in zip(joint.findall("parent"), joint.findall("child"), strict=False):
            if joint.get("type") == "floating" and parent.get("link") != WORLD:
                found[child.get("link", "")] = f"floats on {parent.get('link')}"
    for joint in root.findall("equality/joint"):
        for end in ("joint1", "joint2"):
            found[joint.get(end, "")] = "moves with another joint (equality)"
    for joint in root.findall("tendon/*/joint"):
        found[joint.get("joint", "")] = "is pulled by a tendon"
    return found


def floating_links(root: Element) -> list[str]:
    """Links that the file lets float in the world."""
    joints = [joint for joint in root.iter("joint") if joint.get("type") == "floating"]
    ends = [(joint.find("parent"), joint.find("child")) for joint in joints]
    urdf = [c.get("link", "") for p, c in ends if p is not None and c is not None]
    bodies = root.findall("worldbody/body")
    free = [b for b in bodies if b.find("freejoint") is not None or _is_free(b.find("joint"))]
    return urdf + [body.get("name", "") for body in free]


def _is_free(joint: Element | None) -> bool:
    return joint is not None and joint.get("type") == "free"


def efforts(root: Element) -> dict[str, float]:
    """Torque limits of URDF joints, which Drake drops where there is no transmission."""
    limits = ((joint.get("name"), joint.find("limit")) for joint in root.findall("joint"))
    return {
        name: float(limit.get("effort", "0"))
        for name, limit in limits
        if name is not None and limit is not None
    }


def without_idle(root: Element) -> list[str]:
    """Takes out what moves nothing, which Drake takes for an error; says so of motors.

    A joint that is fixed moves with none, and a joint that is not there has no motor.
    """
    for joint in root.iter("joint"):
        for mimic in joint.findall("mimic") if joint.get("type") == "fixed" else ():
            joint.remove(mimic)
    joints, idle = {joint.get("name") for joint in root.findall("joint")}, []
    for motor in root.findall("transmission"):
        names = [joint.get("name", "") for joint in motor.findall("joint")]
        if names and not joints.intersection(names):
            root.remove(motor)
            idle += names
    return [f"no motor for joints that are not there: {', '.join(idle)}"] if idle else []
