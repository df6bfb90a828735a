"""Meshes of an MJCF file: triangles for masses, and .obj files for Drake."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.slave.mjcf_elements import Attributes, Mjcf

# Triangle of a binary STL file.
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])
_NOT_FOUND = "meshes were not found (--package-path, slave.package_paths)"
_OUTSIDE = (
    "{kind} files in {folder} are outside the model's folder and its packages"
    " (name their folder: --package-path, slave.package_paths)"
)
_UNREADABLE = "meshes cannot be read (convert them to .obj or .stl)"
_Array = NDArray[np.float64]


class Triangles(NamedTuple):
    """Triangle mesh: vertices (n, 3) [m] and rows (m, 3) of vertex indices."""

    vertices: _Array
    faces: NDArray[np.intp]


class Mesh:
    """Mesh of an `asset` section, with its own scale and reference pose applied."""

    def __init__(self, mjcf: Mjcf, attributes: Attributes, file: Path | None) -> None:
        self.name = attributes.get("name") or Path(attributes.get("file", "")).stem
        self.file, self.inertia = file, attributes.get("inertia", "legacy")
        self._attributes = attributes
        self._scale = attributes.vector("scale", (1.0, 1.0, 1.0))
        reference = {"pos": attributes.get("refpos", "0 0 0")}
        reference["quat"] = attributes.get("refquat", "1 0 0 0")
        self._X_FM = mjcf.pose(Attributes(reference, attributes.label, mjcf.report))
        self._triangles: Triangles | None = None

    @property
    def is_plain(self) -> bool:
        """Whether Drake can read the file itself."""
        unmoved = self._X_FM.IsExactlyIdentity() and bool((self._scale == 1.0).all())
        return unmoved and self.file is not None and self.file.suffix.lower() == ".obj"

    def triangles(self) -> Triangles:
        """Return the transformed triangles.

        Raises:
            ValueError: if the file is damaged or of another kind.
        """
        if self._triangles is None:
            try:
                vertices, faces = self._read()
            except (KeyError, IndexError, OSError) as error:  # another kind, or too short
                raise ValueError(str(error)) from None
            if not faces.size or faces.min() < 0 or faces.max() >= len(vertices):
                raise ValueError("no triangles")
            if not np.isfinite(vertices).all():
                raise ValueError("vertices that are not finite")
            moved = self._X_FM.inverse().multiply(vertices.T).T * self._scale
            if np.prod(self._scale) < 0.0:  # a mirror image turns the triangles inside out
                faces = faces[:, ::-1]
            self._triangles = Triangles(moved, faces)
        return self._triangles

    def obj(self, folder: Path) -> Path:
        """Return an .obj file for Drake, converted into `folder` if necessary."""
        if self.file is not None and self.is_plain:
            return self.file.resolve()
        return self._write(self.triangles(), folder)

    def hull(self, folder: Path) -> Path:
        """Return an .obj file in `folder` with the convex hull, which is what touches."""
        return self._write(convex_hull(self.triangles().vertices), folder)

    def _write(self, triangles: Triangles, folder: Path) -> Path:
        number = len(list(folder.iterdir()))
        path = folder / f"{number}_{re.sub(r'[^A-Za-z0-9_-]', '_', self.name)[:40]}.obj"
        vertices, faces = triangles.vertices, triangles.faces + 1
        text = "v %.9g %.9g %.9g\n" * len(vertices) % tuple(vertices.ravel())
        path.write_text(text + "f %d %d %d\n" * len(faces) % tuple(faces.ravel()))
        return path

    def _read(self) -> Triangles:
        if self.file is None:
            return _read_inline(self._attributes)
        data = self.file.read_bytes()
        suffix = self.file.suffix.lower()
        return {".stl": _read_stl, ".obj": _read_obj, ".msh": _read_msh}[suffix](data)


class MeshLibrary:
    """Meshes of a file by name; unused ones are never read."""

    def __init__(self, mjcf: Mjcf) -> None:
        self._mjcf = mjcf
        self._meshes: dict[str, Mesh | str] = {}
        self.inaccessible: list[str] = []  # faults of files that may not be read
        for element in mjcf.children("asset"):
            label = f"{element.tag} {element.get('name') or element.get('file', '')}"
            attributes = mjcf.attributes(element, "", label)
            file, fault = self._find(element, attributes)
            if element.tag == "mesh":
                mesh = Mesh(mjcf, attributes, file)
                self._meshes[mesh.name] = fault or mesh

    def find(self, name: str) -> Mesh | str:
        """Return a mesh, or its fault as text."""
        mesh = self._meshes.get(name, _NOT_FOUND)
        if isinstance(mesh, Mesh) and not mesh.is_plain:
            try:
                mesh.triangles()
            except ValueError:
                self._meshes[name] = mesh = f"{_suffix(mesh.file)}{_UNREADABLE}"
        return mesh

    def _find(self, element: Element, attributes: Attributes) -> tuple[Path | None, str]:
        """Return the file of an asset, and its fault as text."""
        name = attributes.get("file", "")
        if not name:
            return None, "" if "vertex" in attributes else _UNREADABLE
        compiler = self._mjcf.compiler
        if compiler.get("strippath") == "true":
            name = re.split(r"[/\\]", name)[-1]
        own = "meshdir" if element.tag == "mesh" else "texturedir"
        folder = compiler.get(own, compiler.get("assetdir", ""))
        file = self._mjcf.file(element, name, folder)
        if file is None:
            return None, _NOT_FOUND
        if self._mjcf.files.may_read(file):
            try:
                self._mjcf.files.check(file)
            except DrakeTeleopError as error:
                self.inaccessible.append(str(error))
                return None, str(error)
        else:
            fault = _OUTSIDE.format(kind=element.tag, folder=file.resolve().parent)
            self.inaccessible.append(fault)
            return None, fault
        return file, ""


def _suffix(file: Path | None) -> str:
    return f"{file.suffix} " if file is not None else ""


def _merged(corners: _Array) -> Triangles:
    """Return triangles (m, 3, 3) with each vertex once."""
    points = corners.reshape(-1, 3).astype(float)
    order = np.lexsort(points.T)
    is_new = np.ones(len(points), bool)
    is_new[1:] = (np.diff(points[order], axis=0) != 0.0).any(axis=1)
    number = np.empty(len(points), np.intp)
    number[order] = np.cumsum(is_new) - 1
    return Triangles(points[order][is_new], number.reshape(-1, 3))


def _read_stl(data: bytes) -> Triangles:
    count = int.from_bytes(data[80:84], "little")
    if len(data) == 84 + count * _TRIANGLE.itemsize:
        return _merged(np.frombuffer(data, _TRIANGLE, count, 84)["corners"])
    lines = re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", data)
    return _merged(np.array(lines, dtype=float).reshape(-1, 3))


def _read_obj(data: bytes) -> Triangles:
    vertices, faces = list[list[float]](), list[tuple[int, int, int]]()
    for line in data.splitlines():
        words = line.split()
        if words[:1] == [b"v"]:
            vertices.append([float(word) for word in words[1:4]])
        elif words[:1] == [b"f"]:
            corners = [int(word.split(b"/")[0]) for word in words[1:]]
            corners = [k - 1 if k > 0 else len(vertices) + k for k in corners]
            faces += [(corners[0], *pair) for pair in pairwise(corners[1:])]
    return Triangles(np.array(vertices).reshape(-1, 3), np.array(faces, np.intp).reshape(-1, 3))


def _read_msh(data: bytes) -> Triangles:
    """Read MuJoCo's binary format: four counts, then vertices, normals, texture and faces."""
    n, normals, texture, count = (int(k) for k in np.frombuffer(data, "<i4", 4))
    if min(n, normals, texture, count) < 0:
        raise ValueError("a negative count")
    vertices = np.frombuffer(data, "<f4", 3 * n, 16).reshape(-1, 3)
    start = 16 + 4 * (3 * n + 3 * normals + 2 * texture)
    faces = np.frombuffer(data, "<i4", 3 * count, start).reshape(-1, 3)
    return Triangles(vertices.astype(float), faces.astype(np.intp))


def _read_inline(attributes: Attributes) -> Triangles:
    vertices = np.array(attributes["vertex"].split(), dtype=float).reshape(-1, 3)
    if "face" not in attributes:
        return convex_hull(vertices)
    return Triangles(vertices, np.array(attributes["face"].split(), np.intp).reshape(-1, 3))


def convex_hull(vertices: _Array) -> Triangles:
    """Return the convex hull with triangles that face outwards.

    Raises:
        ValueError: if the points have no volume.
    """
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(vertices)
    except QhullError as error:
        raise ValueError("no volume") from error
    faces = hull.simplices.astype(np.intp)
    inwards = np.linalg.det(vertices[faces] - vertices[hull.vertices].mean(axis=0)) < 0.0
    faces[inwards] = faces[inwards, ::-1]
    return _merged(vertices[faces])
