"""Meshes of an MJCF file, as triangles for masses and as .obj files for Drake."""

from __future__ import annotations

import re
from functools import cached_property
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from drake_teleop.station.slave.model.mjcf_elements import Attributes, Mjcf
from drake_teleop.station.slave.model.model_references import PACKAGE_FOLDER_SETTINGS
from drake_teleop.station.slave.model.triangles import (
    Triangles,
    check_triangle_vertices,
    convex_hull,
    obj_text,
    read_triangles,
)

_MESHES_NOT_FOUND_FAULT = f"meshes were not found ({PACKAGE_FOLDER_SETTINGS})"
_MESHES_UNREADABLE_FAULT = "meshes cannot be read (convert them to .obj or .stl)"


class Mesh:
    """Mesh of an `asset` section, with its own scale and reference pose applied."""

    def __init__(self, mjcf: Mjcf, attributes: Attributes, file: Path | None) -> None:
        self.name = attributes.get("name") or Path(attributes.get("file", "")).stem
        self.file, self.inertia = file, attributes.get("inertia", "legacy")
        self._attributes = attributes
        self._scale = attributes.vector("scale", (1.0, 1.0, 1.0))
        reference = {"pos": attributes.get("refpos", "0 0 0")}
        reference["quat"] = attributes.get("refquat", "1 0 0 0")
        self._X_FM = mjcf.read_pose(Attributes(reference, attributes.label, mjcf.report))

    @property
    def is_readable_by_drake(self) -> bool:
        """Whether Drake reads the file without conversion."""
        unmoved = self._X_FM.IsExactlyIdentity() and bool((self._scale == 1.0).all())
        return unmoved and self.file is not None and self.file.suffix.lower() == ".obj"

    @cached_property
    def triangles(self) -> Triangles:
        """The triangles with scale and reference pose applied."""
        if self.file is not None:
            vertices, faces = read_triangles(self.file)
        else:
            vertices, faces = check_triangle_vertices(_read_inline_mesh(self._attributes))
        moved = self._X_FM.inverse().multiply(vertices.T).T * self._scale
        if np.prod(self._scale) < 0.0:  # a mirror image turns the triangles inside out
            faces = faces[:, ::-1]
        return Triangles(moved, faces)

    def write_obj(self, folder: Path) -> Path:
        """Return an .obj file for Drake, written to `folder` if conversion is necessary."""
        if self.file is not None and self.is_readable_by_drake:
            return self.file.resolve()
        return self._write_triangles(self.triangles, folder)

    def write_hull(self, folder: Path) -> Path:
        """Write the convex hull, for contact, to an .obj file in `folder`; return its path."""
        return self._write_triangles(convex_hull(self.triangles.vertices), folder)

    def _write_triangles(self, triangles: Triangles, folder: Path) -> Path:
        number = len(list(folder.iterdir()))
        path = folder / f"{number}_{re.sub(r'[^A-Za-z0-9_-]', '_', self.name)[:40]}.obj"
        path.write_text(obj_text(triangles))
        return path


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

    def find(self, name: str) -> Mesh | str:
        """Return a mesh, or a text about its fault."""
        mesh = self._meshes.get(name, _MESHES_NOT_FOUND_FAULT)
        if isinstance(mesh, Mesh) and not mesh.is_readable_by_drake:
            try:
                _ = mesh.triangles
            except ValueError:
                suffix = f"{mesh.file.suffix} " if mesh.file is not None else ""
                self._meshes[name] = mesh = f"{suffix}{_MESHES_UNREADABLE_FAULT}"
        return mesh

    def _find_mesh_file(self, element: Element, attributes: Attributes) -> tuple[Path | None, str]:
        name = attributes.get("file", "")
        if not name:
            return None, "" if "vertex" in attributes else _MESHES_UNREADABLE_FAULT
        compiler = self._mjcf.compiler
        if compiler.get("strippath") == "true":
            name = re.split(r"[/\\]", name)[-1]
        own = "meshdir" if element.tag == "mesh" else "texturedir"
        folder = compiler.get(own, compiler.get("assetdir", ""))
        file = self._mjcf.find_file(element, name, folder)
        if file is None:
            return None, _MESHES_NOT_FOUND_FAULT
        if fault := self._mjcf.files.file_access_fault(file, f"{element.tag} files"):
            self.inaccessible.append(fault)
            return None, fault
        return file, ""


def _read_inline_mesh(attributes: Attributes) -> Triangles:
    vertices = np.array(attributes["vertex"].split(), dtype=float).reshape(-1, 3)
    if "face" not in attributes:
        return convex_hull(vertices)
    return Triangles(vertices, np.array(attributes["face"].split(), np.intp).reshape(-1, 3))
