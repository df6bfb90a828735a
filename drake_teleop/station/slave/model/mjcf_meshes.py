"""Meshes of an MJCF file, as triangles for masses and as .obj files for Drake."""

from __future__ import annotations

import re
from functools import cached_property
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from drake_teleop.common.numeric import Array
from drake_teleop.station.slave.model import meshes, model_references
from drake_teleop.station.slave.model.mjcf_elements import Attributes, Mjcf


class MassProperties(NamedTuple):
    """Mass [kg], centre (3,) [m] and inertia (3, 3) about the centre [kg m^2]."""

    mass: float
    centre: Array
    inertia: Array

    def in_frame(self, X_BG: RigidTransform) -> MassProperties:
        """Return the properties in frame B, from those in frame G."""
        R = X_BG.rotation().matrix()
        return MassProperties(self.mass, X_BG @ self.centre, R @ self.inertia @ R.T)

    def with_mass(self, mass: float) -> MassProperties:
        ratio = mass / self.mass if self.mass else 0.0
        return MassProperties(mass, self.centre, self.inertia * ratio)


ZERO_MASS_PROPERTIES = MassProperties(0.0, np.zeros(3), np.zeros((3, 3)))


def combine_mass_properties(parts: list[MassProperties]) -> MassProperties:
    mass = sum(part.mass for part in parts)
    if mass <= 0.0:
        return ZERO_MASS_PROPERTIES
    centre = sum((part.mass * part.centre for part in parts), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for part in parts:
        p = part.centre - centre
        inertia += part.inertia + part.mass * (p @ p * np.eye(3) - np.outer(p, p))
    return MassProperties(mass, centre, inertia)


def unit_density_properties_of_primitive(kind: str, size: list[float]) -> MassProperties:
    """Return the mass properties of a shape such as a box, of density 1 kg/m^3, in its own axes."""
    a, b, c = size
    if kind == "sphere":
        b = c = a
    if kind in ("box", "ellipsoid", "sphere"):
        factor, divisor = (8, 3) if kind == "box" else (4 / 3 * np.pi, 5)
        volume = factor * a * b * c
        moments = np.array([b**2 + c**2, a**2 + c**2, a**2 + b**2]) / divisor
    elif kind in ("cylinder", "capsule"):
        middle = 2 * np.pi * a**2 * b
        ends = 4 / 3 * np.pi * a**3 if kind == "capsule" else 0.0
        across = middle * (a**2 / 4 + b**2 / 3) + ends * (0.4 * a**2 + b**2 + 0.75 * a * b)
        along = middle * a**2 / 2 + ends * 0.4 * a**2
        volume, moments = middle + ends, np.array([across, across, along]) / (middle + ends)
    else:  # plane, hfield
        return ZERO_MASS_PROPERTIES
    return MassProperties(volume, np.zeros(3), np.diag(volume * moments))


def unit_density_properties_of_mesh(mesh: Mesh) -> MassProperties:
    """Return mass properties of a mesh of density 1 kg/m^3, by MuJoCo's rule `mesh.inertia`.

    The rule "legacy" adds the absolute volumes of tetrahedra between the centre and each triangle.
    """
    triangles = mesh.triangles
    if mesh.inertia == "convex":
        triangles = meshes.convex_hull(triangles.vertices)
    corners = triangles.vertices[triangles.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1) / 2
    centre = area @ corners.mean(axis=1) / max(float(area.sum()), 1e-300)
    if mesh.inertia == "shell":
        return _mass_properties_of_simplices(corners - centre, area, centre)
    volume = _tetrahedron_volumes(corners - centre, mesh.inertia)
    if volume.sum() <= 0.0:
        return ZERO_MASS_PROPERTIES
    centre = centre + volume @ (corners - centre).sum(axis=1) / 4 / volume.sum()
    # As in MuJoCo, the volumes are computed again about the centre of mass.
    volume = _tetrahedron_volumes(corners - centre, mesh.inertia)
    return _mass_properties_of_simplices(corners - centre, volume, centre, 4)


def fit_shape_to_mesh(mesh: Mesh, kind: str, *, by_box: bool) -> tuple[RigidTransform, list[float]]:
    """Return pose X_GP in mesh axes G, and size, of the primitive P that MuJoCo fits to a mesh.

    The size fits the inertia of the mesh, or with `by_box` its bounding box (`fitaabb`).
    """
    mass, centre, inertia = unit_density_properties_of_mesh(mesh)
    moments, axes = np.linalg.eigh(inertia)
    moments, axes = moments[::-1], axes[:, ::-1]  # the longest axis becomes z
    axes[:, 2] *= np.linalg.det(axes)
    if by_box:
        inside = (mesh.triangles.vertices - centre) @ axes
        half = (inside.max(axis=0) - inside.min(axis=0)) / 2
        centre = centre + axes @ (inside.max(axis=0) + inside.min(axis=0)) / 2
        radius, width = float(half.max()), float(half[:2].max())
    else:
        half = np.sqrt(np.maximum(6 * (moments.sum() - 2 * moments) / max(mass, 1e-300), 0.0)) / 2
        radius, width = float(half.mean()), float(half[:2].mean())
    size = [float(value) for value in half]
    if kind == "sphere":
        size = [radius, 0.0, 0.0]
    elif kind == "capsule":
        size = [width, max(0.0, size[2] - (width if by_box else width / 2)), 0.0]
    elif kind == "cylinder":
        size = [width, size[2], 0.0]
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(axes), centre), size


def _mass_properties_of_simplices(
    corners: Array, masses: Array, centre: Array, num_vertices: int = 3
) -> MassProperties:
    """Return mass properties of a shell (triangles), or solid of 4-vertex tetrahedra to `centre`.

    `corners` (m, 3, 3) are relative to `centre`; `masses` (m,) belong to the parts.
    """
    total = corners.sum(axis=1)
    second = np.einsum("nai,naj->nij", corners, corners) + np.einsum("ni,nj->nij", total, total)
    products = np.einsum("n,nij->ij", masses, second) / (num_vertices * (num_vertices + 1))
    inertia = np.trace(products) * np.eye(3) - products
    return MassProperties(float(masses.sum()), centre, inertia)


def _tetrahedron_volumes(corners: Array, inertia_rule: str) -> Array:
    volume = np.linalg.det(corners) / 6
    return np.abs(volume) if inertia_rule == "legacy" else volume


class Mesh:
    """Mesh of an `asset` section, with its scale and reference pose applied."""

    def __init__(self, mjcf: Mjcf, attributes: Attributes, file: Path | None) -> None:
        self.name = attributes.get("name") or Path(attributes.get("file", "")).stem
        self.file, self.inertia = file, attributes.get("inertia", "legacy")
        self._attributes, self._model = attributes, mjcf.model
        self._scale = attributes.vector("scale", (1.0, 1.0, 1.0))
        reference = {"pos": attributes.get("refpos", "0 0 0")}
        reference["quat"] = attributes.get("refquat", "1 0 0 0")
        self._X_FM = mjcf.read_pose(Attributes(reference, attributes.label, mjcf.model))

    @property
    def is_readable_by_drake(self) -> bool:
        unmoved = self._X_FM.IsExactlyIdentity() and bool((self._scale == 1.0).all())
        return unmoved and self.file is not None and self.file.suffix.lower() == ".obj"

    @cached_property
    def triangles(self) -> meshes.Triangles:
        if self.file is not None:
            vertices, faces = meshes.read_triangles(self.file)
        else:
            vertices, faces = meshes.check_triangle_vertices(_read_inline_mesh(self._attributes))
        moved = self._X_FM.inverse().multiply(vertices.T).T * self._scale
        if np.prod(self._scale) < 0.0:  # a mirror image turns the triangles inside out
            faces = faces[:, ::-1]
        return meshes.Triangles(moved, faces)

    def find_or_write_obj(self) -> Path:
        """Return the path of an .obj file of the mesh for Drake; write it if necessary."""
        if self.file is not None and self.is_readable_by_drake:
            return self.file.resolve()
        return self._write_obj_file(self.triangles)

    def write_hull(self) -> Path:
        return self._write_obj_file(meshes.convex_hull(self.triangles.vertices))

    def _write_obj_file(self, triangles: meshes.Triangles) -> Path:
        name = re.sub(r"[^A-Za-z0-9_-]", "_", self.name)[:40]
        return self._model.write_file(f"{name}.obj", meshes.obj_text(triangles))


class MeshLibrary:
    """Meshes of an MJCF file by name, read only if they are used."""

    def __init__(self, mjcf: Mjcf) -> None:
        self._mjcf = mjcf
        self._meshes: dict[str, Mesh | str] = {}
        self.inaccessible: list[str] = []  # faults of files that may not be read
        for element in mjcf.elements_in("asset"):
            label = f"{element.tag} {element.get('name') or element.get('file', '')}"
            attributes = mjcf.attributes_of(element, "", label)
            file, fault = self._find_mesh_file(element, attributes)
            if element.tag == "mesh":
                mesh = Mesh(mjcf, attributes, file)
                self._meshes[mesh.name] = fault or mesh

    def find_mesh_or_fault(self, name: str) -> Mesh | str:
        """Return the mesh with this name, or a text about its fault."""
        mesh = self._meshes.get(name, model_references.MESHES_NOT_FOUND_FAULT)
        if isinstance(mesh, Mesh) and not mesh.is_readable_by_drake:
            try:
                _ = mesh.triangles
            except ValueError:
                suffix = f"{mesh.file.suffix} " if mesh.file is not None else ""
                self._meshes[name] = mesh = f"{suffix}{model_references.MESHES_UNREADABLE_FAULT}"
        return mesh

    def _find_mesh_file(self, element: Element, attributes: Attributes) -> tuple[Path | None, str]:
        name = attributes.get("file", "")
        if not name:
            return None, "" if "vertex" in attributes else model_references.MESHES_UNREADABLE_FAULT
        compiler = self._mjcf.compiler
        if compiler.get("strippath") == "true":
            name = re.split(r"[/\\]", name)[-1]
        own = "meshdir" if element.tag == "mesh" else "texturedir"
        file = self._mjcf.find_file(element, name, compiler.get(own, compiler.get("assetdir", "")))
        if file is None:
            return None, model_references.MESHES_NOT_FOUND_FAULT
        if fault := self._mjcf.model.files.file_access_fault(file, f"{element.tag} files"):
            self.inaccessible.append(fault)
            return None, fault
        return file, ""


def _read_inline_mesh(attributes: Attributes) -> meshes.Triangles:
    vertices = np.array(attributes["vertex"].split(), dtype=float).reshape(-1, 3)
    if "face" not in attributes:
        return meshes.convex_hull(vertices)
    return meshes.Triangles(vertices, np.array(attributes["face"].split(), np.intp).reshape(-1, 3))
