"""Triangle meshes of models, and removal of unusable shapes from URDF and SDF texts."""

from __future__ import annotations

import re
from contextlib import suppress
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Mesh

from drake_teleop.common.errors import silent_stderr
from drake_teleop.common.numeric import Array
from drake_teleop.station.slave.model import model_references, model_repair
from drake_teleop.station.slave.model.model_numbers import MAX_MODEL_VALUE_SI, parse_numbers

_NUM_SIZE_VALUES_OF_SHAPE = {
    "box": {"size": 3},
    "sphere": {"radius": 1},
    "cylinder": {"radius": 1, "length": 1},
    "capsule": {"radius": 1, "length": 1},
    "ellipsoid": {"a": 1, "b": 1, "c": 1},
    "mesh": {},
    "plane": {},
}
# Triangle of a binary STL file.
_STL_TRIANGLE_DTYPE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("flags", "<u2")])


def remove_unusable_shapes(model: model_repair.ModelRepair) -> None:
    """Remove shapes that Drake cannot read, or all shapes if the plant has no SceneGraph.

    Relative mesh addresses become absolute. STL meshes, which Drake does not read, become convex
    hulls. Reported are removed shapes of links that keep none, and removed collision shapes of
    tools, scenes and links that keep other ones.
    """
    lost, purpose = dict[str, list[str]](), model.purpose
    for link in model.root.iter("link"):
        faults = {"collision": set[str](), "visual": set[str]()}
        for kind, removed in faults.items():
            for shape in link.findall(kind):
                if fault := _unusable_shape_reason(shape) or _resolve_mesh_file(shape, model):
                    link.remove(shape)
                    removed.add(fault)
        reported = faults["collision"]
        if link.find("visual") is None and link.find("collision") is None:
            reported |= faults["visual"]
        elif link.find("collision") is None and not (purpose.is_tool or purpose.is_scene):
            reported = set()
        for fault in sorted(reported):
            lost.setdefault(fault, []).append(link.get("name", ""))
        if not purpose.plant_has_shapes:
            for shape in [*link.findall("collision"), *link.findall("visual")]:
                link.remove(shape)
    for fault, links in lost.items():
        names = model_repair.join_names(links)
        model.add_repair(model_repair.MISSING_SHAPES_TEXT, f"{names}: {fault}")


def _unusable_shape_reason(shape: ElementTree.Element) -> str | None:
    inner = shape.find("geometry/*")
    kind = "" if inner is None else inner.tag.removeprefix("drake:")
    if inner is None or kind not in _NUM_SIZE_VALUES_OF_SHAPE:
        return f"{kind or 'empty'} shapes cannot be read"
    sizes = {"radii": 3} if inner.find("radii") is not None else _NUM_SIZE_VALUES_OF_SHAPE[kind]
    for name, count in sizes.items():
        values = parse_numbers(inner.get(name) or inner.findtext(name))
        if len(values) != count or not all(0.0 < value <= MAX_MODEL_VALUE_SI for value in values):
            limits = f"not between 0 and {MAX_MODEL_VALUE_SI:g} m"
            return f"the {name} of a {kind} is incomplete or {limits}"
    scale = parse_numbers(inner.get("scale") or inner.findtext("scale"))
    valid = len(scale) in (0, 1, 3) and all(0.0 < abs(x) <= MAX_MODEL_VALUE_SI for x in scale)
    for place in (*shape.findall("origin"), *shape.findall("pose")):
        texts = place.get("xyz", "0 0 0"), place.get("rpy", "0 0 0"), place.text
        for text, counts in zip(texts, ((3,), (3,), (0, 6, 7)), strict=True):
            values = parse_numbers(text)
            valid &= len(values) in counts and all(abs(x) <= MAX_MODEL_VALUE_SI for x in values)
    return None if valid else "a pose or scale is no list of finite numbers"


def _resolve_mesh_file(shape: ElementTree.Element, model: model_repair.ModelRepair) -> str | None:
    mesh = shape.find("geometry/mesh")
    if mesh is None:
        return None
    address = (mesh.get("filename") or mesh.findtext("uri") or "").strip()
    file = model.files.find_file(address, model.path.resolve().parent)
    if file is None or not file.is_file():
        return model_references.MESHES_NOT_FOUND_FAULT
    if fault := model.files.file_access_fault(file, "meshes"):
        return fault
    suffix, written = file.suffix.lower(), file.stat().st_mtime_ns
    if suffix not in (".stl", ".obj", ".gltf", ".vtk"):
        return f"{Path(address).suffix} {model_references.MESHES_UNREADABLE_FAULT}"
    if (suffix == ".stl" or shape.tag == "collision") and not _is_mesh_readable(file, written):
        return f"{Path(address).suffix} meshes are empty or damaged"
    if suffix == ".stl" and model.purpose.plant_has_shapes:
        file = model.write_file(f"{file.stem}.obj", _convex_hull_obj_text_of_stl(file, written))
    resolved = f"file://{file.resolve()}"  # Drake does not decode %20
    if mesh.get("filename"):
        mesh.set("filename", resolved)
    else:
        mesh.find("uri").text = resolved  # type: ignore[union-attr]
    return None


@lru_cache(maxsize=1024)
def _is_mesh_readable(path: Path, _mtime_ns: int) -> bool:  # the time: an edited file is read again
    try:
        if path.suffix.lower() not in (".gltf", ".vtk"):
            return len(read_triangles(path).faces) > 0
        with silent_stderr():
            return Mesh(str(path)).GetConvexHull().num_vertices() >= 3
    except (RuntimeError, ValueError):
        return False


@lru_cache(maxsize=1024)
def _convex_hull_obj_text_of_stl(path: Path, _mtime_ns: int) -> str:
    triangles = read_triangles(path)
    with suppress(ValueError):
        triangles = convex_hull(triangles.vertices)
    return obj_text(triangles)


class Triangles(NamedTuple):
    """Triangle mesh: vertices (n, 3) [m] and rows (m, 3) of vertex indices."""

    vertices: Array
    faces: NDArray[np.intp]


def read_triangles(file: Path) -> Triangles:
    """Return the triangles of an STL, OBJ or MSH file; raise ValueError if it is unreadable."""
    read = {".stl": _read_stl, ".obj": _read_obj, ".msh": _read_msh}
    try:
        return check_triangle_vertices(read[file.suffix.lower()](file.read_bytes()))
    except (KeyError, IndexError, OSError) as error:  # another kind, or too short
        raise ValueError(str(error)) from None


def check_triangle_vertices(triangles: Triangles) -> Triangles:
    vertices, faces = triangles
    if not faces.size:
        raise ValueError("a mesh has no triangles")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError("triangles of a mesh have missing vertices")
    if not np.isfinite(vertices).all():
        raise ValueError("vertices of a mesh are not finite")
    return triangles


def obj_text(triangles: Triangles) -> str:
    vertices, faces = triangles.vertices, triangles.faces + 1
    text = "v %.9g %.9g %.9g\n" * len(vertices) % tuple(vertices.ravel())
    return text + "f %d %d %d\n" * len(faces) % tuple(faces.ravel())


def convex_hull(vertices: Array) -> Triangles:
    """Return the convex hull of vertices (n, 3), with outward triangles, or raise ValueError."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        hull = ConvexHull(vertices)
    except QhullError as error:
        raise ValueError("a mesh has no volume") from error
    faces = hull.simplices.astype(np.intp)
    inwards = np.linalg.det(vertices[faces] - vertices[hull.vertices].mean(axis=0)) < 0.0
    faces[inwards] = faces[inwards, ::-1]
    return _merge_equal_vertices(vertices[faces])


def _merge_equal_vertices(corners: Array) -> Triangles:
    points = corners.reshape(-1, 3).astype(float)
    order = np.lexsort(points.T)
    is_new = np.ones(len(points), bool)
    is_new[1:] = (np.diff(points[order], axis=0) != 0.0).any(axis=1)
    number = np.empty(len(points), np.intp)
    number[order] = np.cumsum(is_new) - 1
    return Triangles(points[order][is_new], number.reshape(-1, 3))


def _read_stl(data: bytes) -> Triangles:
    count = int.from_bytes(data[80:84], "little")
    if len(data) == 84 + count * _STL_TRIANGLE_DTYPE.itemsize:
        return _merge_equal_vertices(np.frombuffer(data, _STL_TRIANGLE_DTYPE, count, 84)["corners"])
    lines = re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", data)
    return _merge_equal_vertices(np.array(lines, dtype=float).reshape(-1, 3))


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
    n, normals, texture, count = (int(k) for k in np.frombuffer(data, "<i4", 4))
    if min(n, normals, texture, count) < 0:
        raise ValueError("a mesh file has a negative number of elements")
    vertices = np.frombuffer(data, "<f4", 3 * n, 16).reshape(-1, 3)
    start = 16 + 4 * (3 * n + 3 * normals + 2 * texture)
    faces = np.frombuffer(data, "<i4", 3 * count, start).reshape(-1, 3)
    return Triangles(vertices.astype(float), faces.astype(np.intp))
