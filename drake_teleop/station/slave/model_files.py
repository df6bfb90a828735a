"""Information in model files that Drake's parser does not return."""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.texts import read_yaml
from drake_teleop.station.slave.model_check import WORLD
from drake_teleop.station.slave.model_references import ModelFiles, added_models, read_xml

XACRO = "run it through xacro first, and give the URDF that comes out"


def read_roots(path: Path, files: ModelFiles) -> dict[Path, Element]:
    """Return the XML root by file: of the model, or of the models that its directives add."""
    kind = path.suffix.lower()
    if kind == ".yaml":
        data = read_yaml(path, tagged=True)  # fails cleanly on deep nesting, unlike Drake's parser
        added = [file for address in added_models(data) if (file := files.file(address))]
        # Drake reports missing files and reads nested includes.
        roots = {file: read_xml(file) for file in added if file.suffix in (".urdf", ".sdf")}
    else:
        roots = {path: read_xml(path)} if kind in (".urdf", ".sdf") else {}
    for file, root in roots.items():
        if any(element.tag.startswith("xacro:") for element in root.iter()):
            raise DrakeTeleopError("is a xacro file", where=str(file), remedy=XACRO)
    return roots


def unsupported_joints(root: Element) -> dict[str, str]:
    """Return, by joint or link, a property that Drake ignores: coupling, spring or free joint."""
    found: dict[str, str] = {}
    for joint in root.iter("joint"):
        if joint.find("mimic") is not None or joint.find("axis/mimic") is not None:
            found[joint.get("name", "")] = "moves with another joint (mimic)"
        if joint.get("stiffness", "0").strip("0. "):  # MJCF
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
    """Return the names of links that float freely in the world."""
    joints = [joint for joint in root.iter("joint") if joint.get("type") == "floating"]
    ends = [(joint.find("parent"), joint.find("child")) for joint in joints]
    urdf = [c.get("link", "") for p, c in ends if p is not None and c is not None]
    bodies = root.findall("worldbody/body")
    free = [b for b in bodies if b.find("freejoint") is not None or _is_free(b.find("joint"))]
    return urdf + [body.get("name", "") for body in free]


def _is_free(joint: Element | None) -> bool:
    return joint is not None and joint.get("type") == "free"


def effort_limits(root: Element) -> dict[str, float]:
    """Return torque limits by name of URDF joint; Drake drops limits without a transmission."""
    limits = ((joint.get("name"), joint.find("limit")) for joint in root.findall("joint"))
    return {
        name: float(limit.get("effort", "0"))
        for name, limit in limits
        if name is not None and limit is not None
    }


def remove_idle_elements(root: Element) -> list[str]:
    """Remove `mimic` tags of fixed joints and transmissions of missing joints; return notes."""
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
