"""Bounding capsules of collision shapes, for fast conservative distances with gradients."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.geometry import (
    Box,
    Cylinder,
    Ellipsoid,
    Shape,
    Sphere,
)
from pydrake.geometry import (
    Capsule as CapsuleShape,
)
from pydrake.math import RigidTransform

from drake_teleop.common.arrays import Array

# Vertices of the circumscribed polygon of a cylinder.
_RIM = 24


@dataclass(frozen=True, eq=False)
class Capsule:
    """All points within `radius` [m] of a segment with `ends` (2, 3) [m]."""

    ends: Array
    radius: float

    def moved(self, X: RigidTransform) -> Capsule:
        """Return the capsule transformed by X."""
        return Capsule(X.multiply(self.ends.T).T, self.radius)

    def holds(self, other: Capsule) -> bool:
        """Return whether this capsule contains another one."""
        distances = _distances(self.ends, other.ends)
        return bool(np.all(distances + other.radius <= self.radius + 1e-9))


def bounding_capsule(shape: Shape) -> Capsule:
    """Return a small capsule around a shape, in its frame."""
    if isinstance(shape, Sphere):
        return Capsule(np.zeros((2, 3)), shape.radius())
    if isinstance(shape, CapsuleShape):
        end = np.array([0.0, 0.0, shape.length() / 2])
        return Capsule(np.array([-end, end]), shape.radius())
    points = _hull(shape)
    middle = (points.max(axis=0) + points.min(axis=0)) / 2
    half = (points.max(axis=0) - points.min(axis=0)) / 2
    candidates = []
    for axis in np.eye(3):
        for share in (0.0, 0.4, 0.6, 0.8, 0.9, 1.0):
            end = share * axis * half
            ends = np.array([middle - end, middle + end])
            radius = float(_distances(ends, points).max())
            length = 2 * share * float(axis @ half)
            candidates.append((np.pi * radius**2 * (length + 4 / 3 * radius), ends, radius))
    _, ends, radius = min(candidates, key=lambda candidate: candidate[0])
    return Capsule(ends, radius)


def _hull(shape: Shape) -> Array:
    if isinstance(shape, Box):
        corners = np.array(np.meshgrid(*3 * [[-0.5, 0.5]])).reshape(3, 8).T
        return corners * shape.size()
    if isinstance(shape, Ellipsoid):
        corners = np.array(np.meshgrid(*3 * [[-1.0, 1.0]])).reshape(3, 8).T
        return corners * [shape.a(), shape.b(), shape.c()]
    if isinstance(shape, Cylinder):
        angle = 2 * np.pi * np.arange(_RIM) / _RIM
        radius = shape.radius() / np.cos(np.pi / _RIM)
        rim = radius * np.column_stack([np.cos(angle), np.sin(angle)])
        half = shape.length() / 2
        ends = [np.column_stack([rim, np.full(_RIM, z)]) for z in (-half, half)]
        return np.concatenate(ends)
    hull = shape.GetConvexHull()
    return np.array([hull.vertex(i) for i in range(hull.num_vertices())])


def _distances(ends: Array, points: Array) -> Array:
    along = ends[1] - ends[0]
    length = float(along @ along)
    share = np.clip((points - ends[0]) @ along / length, 0, 1) if length > 0 else 0 * points[:, 0]
    return np.linalg.norm(points - ends[0] - np.multiply.outer(share, along), axis=1)
