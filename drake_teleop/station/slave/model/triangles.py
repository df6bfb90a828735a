"""Triangle meshes of STL, OBJ and MSH files, their convex hulls, and OBJ text for Drake."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.numeric import Array

# Triangle of a binary STL file.
_STL_TRIANGLE_FIELDS = [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")]
_STL_TRIANGLE_DTYPE = np.dtype(_STL_TRIANGLE_FIELDS)


class Triangles(NamedTuple):
    """Triangle mesh: vertices (n, 3) [m] and rows (m, 3) of vertex indices."""

    vertices: Array
    faces: NDArray[np.intp]


def read_triangles(file: Path) -> Triangles:
    """Return the triangles of an STL, OBJ or MSH file, or raise ValueError."""
    read = {".stl": _read_stl, ".obj": _read_obj, ".msh": _read_msh}
    try:
        return check_triangle_vertices(read[file.suffix.lower()](file.read_bytes()))
    except (KeyError, IndexError, OSError) as error:  # another kind, or too short
        raise ValueError(str(error)) from None


def check_triangle_vertices(triangles: Triangles) -> Triangles:
    """Return `triangles`; raise ValueError unless all their vertices exist and are finite."""
    vertices, faces = triangles
    if not faces.size:
        raise ValueError("a mesh has no triangles")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ValueError("a mesh has triangles with missing vertices")
    if not np.isfinite(vertices).all():
        raise ValueError("a mesh has vertices that are not finite")
    return triangles


def obj_text(triangles: Triangles) -> str:
    vertices, faces = triangles.vertices, triangles.faces + 1
    text = "v %.9g %.9g %.9g\n" * len(vertices) % tuple(vertices.ravel())
    return text + "f %d %d %d\n" * len(faces) % tuple(faces.ravel())


def convex_hull(vertices: Array) -> Triangles:
    """Return the convex hull, with triangles that face outwards, or raise ValueError."""
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
        raise ValueError("a mesh file has a negative count")
    vertices = np.frombuffer(data, "<f4", 3 * n, 16).reshape(-1, 3)
    start = 16 + 4 * (3 * n + 3 * normals + 2 * texture)
    faces = np.frombuffer(data, "<i4", 3 * count, start).reshape(-1, 3)
    return Triangles(vertices.astype(float), faces.astype(np.intp))
