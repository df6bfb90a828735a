"""Writing of MJCF text for Drake, with explicit poses, masses and limits."""

from __future__ import annotations

from collections.abc import Iterable
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np
from pydrake.math import RigidTransform

from drake_teleop.station.slave.model import mjcf_bodies
from drake_teleop.station.slave.model.mjcf_elements import Mjcf
from drake_teleop.station.slave.model.mjcf_meshes import Mesh


class MjcfText:
    """Writer of MJCF text; in the text of a tool the top bodies float.

    Contact shapes are convex hulls, as in MuJoCo, except in a scene.
    """

    def __init__(self, mjcf: Mjcf) -> None:
        self._mjcf, self._model, self._purpose = mjcf, mjcf.model, mjcf.model.purpose
        self._root = Element("mujoco", model=mjcf.root.get("model") or mjcf.model.path.stem)
        SubElement(self._root, "compiler", angle="radian", autolimits="false")
        self._assets = SubElement(self._root, "asset")
        self._meshes: dict[tuple[int, bool], str] = {}
        read = mjcf.attributes_of
        materials = [each for each in mjcf.elements_in("asset") if each.tag == "material"]
        self._colours = {e.get("name"): read(e, "", "material").get("rgba") for e in materials}

    def write(self, world: mjcf_bodies.Body, moving: list[mjcf_bodies.Joint]) -> str:
        """Return the MJCF text of a world; the joints `moving` get actuators."""
        top = SubElement(self._root, "worldbody")
        self._write_body_content(top, world)
        names = {body.name for body in world.with_descendants()}
        contact = SubElement(self._root, "contact")
        for each in self._mjcf.elements_in("contact"):
            ends = {name: each.get(name, "") for name in ("body1", "body2")}
            if each.tag == "exclude" and names.issuperset(ends.values()):
                SubElement(contact, "exclude", ends)
        actuators = SubElement(self._root, "actuator")
        for joint in moving:
            SubElement(actuators, "motor", name=joint.name, joint=joint.name)
        return tostring(self._root, encoding="unicode")

    def _write_body_content(self, element: Element, body: mjcf_bodies.Body) -> None:
        for joint in body.joints:
            self._write_joint(element, joint)
        for geom in body.geoms if self._purpose.plant_has_shapes else ():
            if geom.attributes.has_contact or geom.is_visible:
                self._write_geom(element, geom, body)
        for child in body.children:
            inner = SubElement(element, "body", {"name": child.name, **_format_pose(child.X_PB)})
            if child.inertial is not None and child.inertial.mass > 0.0:
                mass, centre, inertia = child.inertial
                entries = [*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]]
                values = {"mass": repr(mass), "fullinertia": _format_numbers(entries)}
                SubElement(inner, "inertial", {"pos": _format_numbers(centre), **values})
            if self._purpose.is_tool and body.name == "world":
                SubElement(inner, "freejoint")
            self._write_body_content(inner, child)

    def _write_joint(self, element: Element, joint: mjcf_bodies.Joint) -> None:
        if joint.kind == "free":
            SubElement(element, "freejoint", name=joint.name)
            return
        values = {"name": joint.name, "type": joint.kind, "pos": _format_numbers(joint.anchor)}
        values |= {"axis": _format_numbers(joint.axis), "ref": repr(joint.ref), "limited": "false"}
        if joint.limits is not None:
            values |= {"limited": "true", "range": _format_numbers(joint.limits)}
        damping = joint.attributes.number("damping", 0.0)
        if damping < 0.0:
            self._model.state_assumption("no damping, instead of a negative one, of", joint.name)
        values["damping"] = repr(max(damping, 0.0))
        values["armature"] = repr(max(joint.attributes.number("armature", 0.0), 0.0))
        SubElement(element, "joint", values)

    def _write_geom(self, element: Element, geom: mjcf_bodies.Geom, body: mjcf_bodies.Body) -> None:
        given, values = geom.attributes, {"type": geom.kind, "mass": "0", **_format_pose(geom.X_BG)}
        if "friction" in given:
            values["friction"] = repr(given.numbers("friction", (1.0,))[0])
        if rgba := given.get("rgba") or self._colours.get(given.get("material", "")):
            values["rgba"] = rgba
        without_contact, invisible = {"contype": "0", "conaffinity": "0"}, {"group": "3"}
        contact_mesh = geom.mesh if given.has_contact and not self._purpose.is_scene else None
        if geom.is_visible or contact_mesh is None:
            size = {"size": _format_numbers(geom.size)}
            shape = size if geom.mesh is None else self._add_mesh_asset(geom.mesh)
            shape |= without_contact if contact_mesh or not given.has_contact else {}
            shape |= {} if geom.is_visible else invisible
            SubElement(element, "geom", values | shape)
        if contact_mesh is not None:
            try:
                hull = self._add_mesh_asset(contact_mesh, hull=True)
                SubElement(element, "geom", values | invisible | hull)
            except ValueError as error:
                self._model.state_repair(f"{error}; shapes are missing of", body.name)

    def _add_mesh_asset(self, mesh: Mesh, *, hull: bool = False) -> dict[str, str]:
        key = id(mesh), hull
        if key not in self._meshes:
            file = mesh.write_hull() if hull else mesh.find_or_write_obj()
            self._meshes[key] = f"mesh_{len(self._meshes)}"
            SubElement(self._assets, "mesh", name=self._meshes[key], file=str(file))
        return {"mesh": self._meshes[key]}


def _format_numbers(values: Iterable[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


def _format_pose(X: RigidTransform) -> dict[str, str]:
    quaternion = X.rotation().ToQuaternion().wxyz()
    return {"pos": _format_numbers(X.translation()), "quat": _format_numbers(quaternion)}
