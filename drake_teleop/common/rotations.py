"""Conversions between rotation matrices, quaternions, rotation vectors and Euler angles."""

from __future__ import annotations

from itertools import permutations, product

import numpy as np

from drake_teleop.common.numeric import Array

NUM_COLUMNS_BY_ROTATION_FORM = {
    "matrix": 9,
    "quaternion_wxyz": 4,
    "quaternion_xyzw": 4,
    "rotation_vector": 3,
    "euler": 3,
}
"""Number of columns of each form."""

EULER_AXIS_SEQUENCES = tuple(
    axes
    for letters in ("xyz", "XYZ")
    for axes in map("".join, product(letters, repeat=3))
    if axes[0] != axes[1] != axes[2]
)
"""Orders of Euler angles as in SciPy: small letters for fixed axes, capitals for moving ones."""


def rotation_matrices(columns: Array, form: str, axes: str | None = None) -> Array:
    """Return rotation matrices (N, 3, 3) of table columns (N, k), without normalization.

    `form` is a key of `NUM_COLUMNS_BY_ROTATION_FORM`: matrices row by row, angles in rad. The form
    "euler" needs `axes`, such as "xyz" (fixed) or "XYZ" (moving).
    """
    if form == "euler":
        from scipy.spatial.transform import Rotation

        assert axes is not None
        return np.asarray(Rotation.from_euler(axes, columns).as_matrix())
    if form == "matrix":
        return columns.reshape(-1, 3, 3)
    if form == "rotation_vector":
        half = np.linalg.norm(columns, axis=1, keepdims=True) / 2
        # np.sinc(x) = sin(pi x) / (pi x) avoids a division by zero at angle 0.
        vectors = 0.5 * np.sinc(half / np.pi) * columns
        return _matrices_from_quaternions(np.hstack([np.cos(half), vectors]))
    q = columns if form == "quaternion_wxyz" else np.roll(columns, 1, axis=1)
    return _matrices_from_quaternions(q)


def orthogonality_error(R: Array) -> Array:
    """Return max |R^T R - I| of matrices (..., 3, 3); at least 2 for reflections."""
    error = np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max(axis=(-1, -2))
    return np.where(np.linalg.det(R) < 0, np.maximum(error, 2.0), error)


def nearest_rotation(R: Array) -> Array:
    """Return the rotation closest to each nearly orthogonal matrix (..., 3, 3)."""
    # Newton-Schulz iteration for the polar factor; 4 steps reduce an error of 0.3 below 1e-15.
    for _ in range(4):
        R = R @ (1.5 * np.eye(3) - 0.5 * np.swapaxes(R, -1, -2) @ R)
    return R


def quaternions_from_matrices(R: Array) -> Array:
    """Return quaternions (N, 4) [w, x, y, z] of rotations (N, 3, 3); their signs are arbitrary."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(R).as_quat()[:, [3, 0, 1, 2]])


def _matrices_from_quaternions(q: Array) -> Array:
    w, x, y, z = q.T
    return np.stack(
        [
            *(w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z),
        ],
        axis=-1,
    ).reshape(-1, 3, 3)


def signed_permutations() -> list[Array]:
    """Return the 48 matrices (3, 3) that map axes to axes or their opposites, identity first."""
    return [
        np.diag(signs) @ np.eye(3)[list(order)]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]


def axis_names_of_rows(P: Array) -> list[str]:
    """Return the axis in each row of a signed permutation P (3, 3), such as ["-y", "x", "z"]."""
    return [f"{'-' if row.sum() < 0 else ''}{'xyz'[int(np.abs(row).argmax())]}" for row in P]


def right_angled_rotations() -> list[Array]:
    """Return the 24 rotations (3, 3) that map axes to axes, identity first."""
    return [R for R in signed_permutations() if np.linalg.det(R) > 0]
