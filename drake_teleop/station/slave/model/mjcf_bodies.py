"""Bodies, joints and shapes of an MJCF file in body axes and SI units, with reader and writer."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from itertools import count
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np
from pydrake.math import RigidTransform

from drake_teleop.common.numeric import Array
from drake_teleop.station.slave.model import mjcf_meshes, model_numbers
from drake_teleop.station.slave.model.mjcf_elements import (
    MIN_DIRECTION_LENGTH,
    Attributes,
    Mjcf,
    smallest_rotation_of_z_to,
)
from drake_teleop.station.slave.model.model_repair import MISSING_SHAPES_TEXT

_DEFAULT_DENSITY_KG_M3 = 1000.0  # kg/m^3, default of MuJoCo
# Numbers in size.
_NUM_SIZE_VALUES_OF_SHAPE = {"sphere": 1, "capsule": 2, "cylinder": 2, "ellipsoid": 3, "box": 3}
_ROUND_ROD_SHAPES = ("capsule", "cylinder")
_MAX_VISIBLE_GEOM_GROUP = 2  # as in MuJoCo and Drake


@dataclass(eq=False)
class Joint:
    """Joint of kind hinge, slide, ball or free; `anchor`, `axis` (3,) are in the body's axes."""

    name: str
    kind: str
    anchor: Array
    axis: Array
    attributes: Attributes
    limits: tuple[float, float] | None
    ref: float

    def transformed_by(self, X: RigidTransform) -> Joint:
        return replace(self, anchor=X @ self.anchor, axis=X.rotation() @ self.axis)


@dataclass(eq=False)
class Geom:
    """Shape of a body with pose X_BG; `mesh` is None unless the shape is of type mesh."""

    kind: str
    X_BG: RigidTransform
    size: list[float]
    attributes: Attributes
    mesh: mjcf_meshes.Mesh | None

    @property
    def is_visible(self) -> bool:
        return self.attributes.number("group", 0.0) <= _MAX_VISIBLE_GEOM_GROUP


@dataclass(eq=False)
class Body:
    """Body with pose X_PB in its parent; `generator_tags`: unsupported tags such as replicate."""

    name: str
    X_PB: RigidTransform
    joints: list[Joint] = field(default_factory=list)
    geoms: list[Geom] = field(default_factory=list)
    sites: dict[str, RigidTransform] = field(default_factory=dict)
    children: list[Body] = field(default_factory=list)
    inertial: mjcf_meshes.MassProperties | None = None
    generator_tags: list[str] = field(default_factory=list)
    is_auxiliary: bool = False  # a body that the file does not have

    def with_descendants(self) -> list[Body]:
        return [self, *(body for child in self.children for body in child.with_descendants())]


class BodyReader:
    """Reader of the bodies in an MJCF file; it names joints and bodies without names."""

    def __init__(self, mjcf: Mjcf) -> None:
        self._mjcf, self.meshes = mjcf, mjcf_meshes.MeshLibrary(mjcf)
        self._names = {e.get("name", "") for e in mjcf.root.iter() if e.tag in ("body", "joint")}
        self._counters: dict[str, count[int]] = {}
        self.lost: dict[str, list[tuple[Body, Attributes]]] = {}  # shapes by fault

    def read_world(self) -> Body:
        """Return the world body with its shapes, and with all bodies of the file as descendants."""
        world = Body("world", RigidTransform())
        for element in self._mjcf.root.findall("worldbody"):
            self._read_children(world, element, element.get("childclass", ""), RigidTransform())
        return world

    def _read_body(self, element: Element, childclass: str, X_PF: RigidTransform) -> Body:
        name = element.get("name") or self._make_unused_name("body")
        attributes = Attributes(element.attrib, f"body {name}", self._mjcf.model)
        body = Body(name, X_PF @ self._mjcf.read_pose(attributes))
        childclass = element.get("childclass") or childclass
        self._read_children(body, element, childclass, RigidTransform())
        return body

    def _make_unused_name(self, stem: str) -> str:
        numbers = self._counters.setdefault(stem, count(1))
        return next(name for k in numbers if (name := f"{stem}_{k}") not in self._names)

    def _read_children(
        self, body: Body, element: Element, childclass: str, X_BF: RigidTransform
    ) -> None:
        for child in element:
            attributes = self._mjcf.attributes_of(child, childclass, f"{child.tag} of {body.name}")
            if child.tag == "frame":
                inner = child.get("childclass") or childclass
                self._read_children(body, child, inner, X_BF @ self._mjcf.read_pose(attributes))
            elif child.tag == "body":
                body.children.append(self._read_body(child, childclass, X_BF))
            elif child.tag in ("joint", "freejoint"):
                joint = self._read_joint(body, attributes, child.tag)
                body.joints.append(joint.transformed_by(X_BF))
            elif child.tag == "geom":
                self._add_geom(body, attributes, X_BF)
            elif child.tag == "site":
                body.sites[child.get("name", "")] = X_BF @ self._mjcf.read_pose(attributes)
            elif child.tag == "inertial":
                body.inertial = self._read_inertial(body, attributes).in_frame(X_BF)
            elif child.tag in ("replicate", "attach", "composite", "flexcomp"):
                body.generator_tags.append(child.tag)

    def _read_joint(self, body: Body, given: Attributes, tag: str) -> Joint:
        name = given.get("name") or self._make_unused_name(f"{body.name}_joint")
        given.label = f"joint {name}"
        kind = "free" if tag == "freejoint" else given.get("type", "hinge")
        axis = given.vector("axis", (0.0, 0.0, 1.0))
        if np.linalg.norm(axis) < MIN_DIRECTION_LENGTH:
            self._mjcf.model.add_fault(f"joint {name}: axis has length 0; set a direction")
            axis = np.array([0.0, 0.0, 1.0])
        limits = given.read_range("range", "limited", autolimits=self._mjcf.autolimits)
        ref = given.number("ref", 0.0)
        if kind == "hinge":
            in_rad = self._mjcf.angle_in_rad
            limits, ref = limits and (in_rad(limits[0]), in_rad(limits[1])), in_rad(ref)
        anchor = given.vector("pos", (0.0, 0.0, 0.0))
        return Joint(name, kind, anchor, axis / np.linalg.norm(axis), given, limits, ref)

    def _add_geom(self, body: Body, given: Attributes, X_BF: RigidTransform) -> None:
        kind, name = given.get("type", "sphere"), given.get("mesh", "")
        X_FG = self._mjcf.read_pose(given)
        size = given.numbers("size", (0.0, 0.0, 0.0), model_numbers.MAX_MODEL_VALUE_SI)
        if "fromto" in given and kind in (*_ROUND_ROD_SHAPES, "box", "ellipsoid"):
            ends = given.vector("fromto", (0.0,) * 5 + (1.0,)).reshape(2, 3)
            X_FG = RigidTransform(smallest_rotation_of_z_to(ends[0] - ends[1]), ends.mean(axis=0))
            half = float(np.linalg.norm(ends[0] - ends[1])) / 2
            size = [size[0], half, 0.0] if kind in _ROUND_ROD_SHAPES else [size[0], size[0], half]
        found = self.meshes.find_mesh_or_fault(name) if name else None
        mesh, fault = (None, found) if isinstance(found, str) else (found, "")
        if kind in ("hfield", "sdf") or (kind == "mesh" and not name):
            fault = f"shapes of type {kind} are not supported"
        elif not name and min(size[: _NUM_SIZE_VALUES_OF_SHAPE.get(kind, 0)], default=1.0) <= 0.0:
            fault = "shapes need a size above 0"
        if mesh is not None and kind != "mesh" and not fault:
            by_box = self._mjcf.compiler.get("fitaabb") == "true"
            try:
                X_GP, size = mjcf_meshes.fit_shape_to_mesh(mesh, kind, by_box=by_box)
                X_FG, mesh = X_FG @ X_GP, None
            except ValueError as error:
                fault = str(error)
        if fault:
            self.lost.setdefault(fault, []).append((body, given))
            return
        if given.get("shellinertia") == "true":
            self._mjcf.model.add_assumption("solid shapes instead of hollow ones, of", body.name)
        body.geoms.append(Geom(kind, X_BF @ X_FG, size, given, mesh))

    def _read_inertial(self, body: Body, given: Attributes) -> mjcf_meshes.MassProperties:
        mass = float(given.vector("mass", (0.0,))[0])
        if mass < 0.0:
            self._mjcf.model.add_fault(f"body {body.name}: mass {mass:g} kg is negative")
        inertia = np.diag(given.vector("diaginertia", (0.0, 0.0, 0.0)))
        if "fullinertia" in given:
            xx, yy, zz, xy, xz, yz = given.vector("fullinertia", (0.0,) * 6)
            inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        about_centre = mjcf_meshes.MassProperties(mass, np.zeros(3), inertia)
        return about_centre.in_frame(self._mjcf.read_pose(given))

    def mass_properties_of_body(self, body: Body) -> mjcf_meshes.MassProperties:
        """Return a body's mass properties from its `inertial` element or shapes, as in MuJoCo."""
        compiler, given = self._mjcf.compiler, body.inertial
        source = compiler.get("inertiafromgeom", "auto")
        if source == "true" or (source == "auto" and given is None):
            parts = [self._mass_properties_of_geom(geom) for geom in body.geoms]
            given = mjcf_meshes.combine_mass_properties(parts)
        mass, centre, inertia = given or mjcf_meshes.ZERO_MASS_PROPERTIES
        bound = compiler.number("boundinertia", 0.0)
        if bound > 0.0:
            moments, axes = np.linalg.eigh(inertia)
            inertia = (axes * np.maximum(moments, bound)) @ axes.T
        is_impossible = model_numbers.nearest_possible_inertia(inertia)[1] > 0.0
        if compiler.get("balanceinertia") == "true" and is_impossible:
            inertia = np.eye(3) * np.trace(inertia) / 3
        mass = max(mass, compiler.number("boundmass", 0.0))
        return mjcf_meshes.MassProperties(mass, centre, inertia)

    def _mass_properties_of_geom(self, geom: Geom) -> mjcf_meshes.MassProperties:
        groups = self._mjcf.compiler.numbers("inertiagrouprange", (0.0, 5.0))
        if not groups[0] <= geom.attributes.number("group", 0.0) <= groups[1]:
            return mjcf_meshes.ZERO_MASS_PROPERTIES
        try:
            shape = mjcf_meshes.unit_density_properties_of_primitive(geom.kind, geom.size)
            if geom.mesh:
                shape = mjcf_meshes.unit_density_properties_of_mesh(geom.mesh)
        except ValueError as error:
            self._mjcf.model.add_repair(f"no mass, because {error}, of", geom.attributes.label)
            return mjcf_meshes.ZERO_MASS_PROPERTIES
        mass = geom.attributes.number("mass", -1.0)
        density = geom.attributes.number("density", _DEFAULT_DENSITY_KG_M3)
        return shape.with_mass(mass if mass >= 0.0 else density * shape.mass).in_frame(geom.X_BG)


class MjcfWriter:
    """Writer of MJCF text; root bodies of a tool get free joints, or Drake would fix them.

    Contact meshes become convex hulls, as in MuJoCo, except in a scene.
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

    def write(self, world: Body, effort_limits: dict[str, float]) -> str:
        """Return the MJCF text of a world body; joints in `effort_limits` get motors."""
        self._write_joints_geoms_and_children(SubElement(self._root, "worldbody"), world)
        names = {body.name for body in world.with_descendants()}
        contact = SubElement(self._root, "contact")
        for each in self._mjcf.elements_in("contact"):
            ends = {name: each.get(name, "") for name in ("body1", "body2")}
            if each.tag == "exclude" and names.issuperset(ends.values()):
                SubElement(contact, "exclude", ends)
        actuators = SubElement(self._root, "actuator")
        for name, effort in effort_limits.items():
            motor = SubElement(actuators, "motor", name=name, joint=name)
            if 0.0 < effort < float("inf"):
                motor.set("ctrllimited", "true")
                motor.set("ctrlrange", _format_numbers((-effort, effort)))
        return tostring(self._root, encoding="unicode")

    def _write_joints_geoms_and_children(self, element: Element, body: Body) -> None:
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
            self._write_joints_geoms_and_children(inner, child)

    def _write_joint(self, element: Element, joint: Joint) -> None:
        if joint.kind == "free":
            SubElement(element, "freejoint", name=joint.name)
            return
        values = {"name": joint.name, "type": joint.kind, "pos": _format_numbers(joint.anchor)}
        values |= {"axis": _format_numbers(joint.axis), "ref": repr(joint.ref), "limited": "false"}
        if joint.limits is not None:
            values |= {"limited": "true", "range": _format_numbers(joint.limits)}
        damping = joint.attributes.number("damping", 0.0)
        if damping < 0.0:
            self._model.add_assumption("damping is 0, not negative, of joint", joint.name)
        values["damping"] = repr(max(damping, 0.0))
        values["armature"] = repr(max(joint.attributes.number("armature", 0.0), 0.0))
        SubElement(element, "joint", values)

    def _write_geom(self, element: Element, geom: Geom, body: Body) -> None:
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
                self._model.add_repair(f"{error}; {MISSING_SHAPES_TEXT}", body.name)

    def _add_mesh_asset(self, mesh: mjcf_meshes.Mesh, *, hull: bool = False) -> dict[str, str]:
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
