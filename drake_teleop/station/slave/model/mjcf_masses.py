"""Mass, centre and inertia of MJCF shapes, as MuJoCo computes them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from drake_teleop.common.numeric import Array
from drake_teleop.station.slave.model.mjcf_meshes import Mesh
from drake_teleop.station.slave.model.triangles import convex_hull


class MassProperties(NamedTuple):
    """Mass [kg], centre (3,) [m] and inertia (3, 3) about the centre [kg m^2]."""

    mass: float
    centre: Array
    inertia: Array

    def in_frame(self, X_BG: RigidTransform) -> MassProperties:
        """Return properties that are given in G, in the frame B."""
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


def mass_properties_of_primitive(kind: str, size: list[float]) -> MassProperties:
    """Return the mass properties of a shape of density 1 in its own axes."""
    a, b, c = size
    if kind == "box":
        volume, moments = 8 * a * b * c, np.array([b**2 + c**2, a**2 + c**2, a**2 + b**2]) / 3
    elif kind == "ellipsoid":
        volume = 4 / 3 * np.pi * a * b * c
        moments = np.array([b**2 + c**2, a**2 + c**2, a**2 + b**2]) / 5
    elif kind == "sphere":
        volume, moments = 4 / 3 * np.pi * a**3, np.full(3, 0.4 * a**2)
    elif kind in ("cylinder", "capsule"):
        middle = 2 * np.pi * a**2 * b
        ends = 4 / 3 * np.pi * a**3 if kind == "capsule" else 0.0
        across = middle * (a**2 / 4 + b**2 / 3) + ends * (0.4 * a**2 + b**2 + 0.75 * a * b)
        along = middle * a**2 / 2 + ends * 0.4 * a**2
        volume, moments = middle + ends, np.array([across, across, along]) / (middle + ends)
    else:  # plane, hfield
        return ZERO_MASS_PROPERTIES
    return MassProperties(volume, np.zeros(3), np.diag(volume * moments))


def mass_properties_of_mesh(mesh: Mesh) -> MassProperties:
    """Return the mass properties of a mesh of density 1, by MuJoCo's rule in `mesh.inertia`.

    The rule "legacy" counts all tetrahedra between triangles and centre as positive.
    """
    triangles = mesh.triangles
    if mesh.inertia == "convex":
        triangles = convex_hull(triangles.vertices)
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
    return _mass_properties_of_simplices(
        corners - centre, _tetrahedron_volumes(corners - centre, mesh.inertia), centre, 4
    )


def fit_shape_to_mesh(mesh: Mesh, kind: str, *, by_box: bool) -> tuple[RigidTransform, list[float]]:
    """Return pose and size of the primitive, such as a box, that MuJoCo fits to a mesh.

    Its size follows from the mesh's inertia, or with `by_box` from its bounding box (`fitaabb`).
    """
    mass, centre, inertia = mass_properties_of_mesh(mesh)
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
    corners: Array, weight: Array, centre: Array, count: int = 3
) -> MassProperties:
    """Return mass properties of m triangles (count 3) or tetrahedra with the centre (count 4)."""
    total = corners.sum(axis=1)
    second = np.einsum("nai,naj->nij", corners, corners) + np.einsum("ni,nj->nij", total, total)
    products = np.einsum("n,nij->ij", weight, second) / (count * (count + 1))
    mass = float(weight.sum())
    inertia = np.trace(products) * np.eye(3) - products
    return MassProperties(mass, centre, inertia)


def _tetrahedron_volumes(corners: Array, mode: str) -> Array:
    volume = np.linalg.det(corners) / 6
    return np.abs(volume) if mode == "legacy" else volume
