"""What a robot model's files say beside what Drake reads of them."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.texts import read_yaml
from drake_teleop.station.slave.model_check import WORLD
from drake_teleop.station.slave.model_references import ModelFiles, added_models, read_xml

XACRO = "run it through xacro first, and give the URDF that comes out"


def read_roots(path: Path, files: ModelFiles) -> dict[Path, Element]:
    """Roots of the XML that is a model, by file: of itself, or of what model directives add.

    Raises:
        DrakeTeleopError: for what is no XML, no YAML, or still a macro.
    """
    kind = path.suffix.lower()
    if kind == ".yaml":
        data = read_yaml(path, tagged=True)  # Drake's parser overflows its stack over many brackets
        added = [file for address in added_models(data) if (file := files.file(address))]
        # What is not there, and what they include, is said by Drake, or not at all.
        roots = {file: read_xml(file) for file in added if file.suffix in (".urdf", ".sdf")}
    else:
        roots = {path: read_xml(path)} if kind in (".urdf", ".sdf", ".xml") else {}
    for file, root in roots.items():
        if any(element.tag.startswith("xacro:") for element in root.iter()):
            raise DrakeTeleopError("is a macro", where=str(file), remedy=XACRO)
    return roots


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
