"""Vectors (3 numbers), rotation matrices (9, by rows) and unit quaternions for compiled code.

The functions allocate no memory. Quaternions are tuples (w, x, y, z).
"""

from __future__ import annotations

import math

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from drake_teleop.common.compiled import njit


@register_jitable
def vector_at(x, i):
    return x[i], x[i + 1], x[i + 2]


@register_jitable
def quaternion_at(x, i):
    return x[i], x[i + 1], x[i + 2], x[i + 3]


@register_jitable
def matrix_at(x, i):
    """Return the 9 numbers of x from index i as a tuple, a matrix row by row."""
    return x[i], x[i + 1], x[i + 2], x[i + 3], x[i + 4], x[i + 5], x[i + 6], x[i + 7], x[i + 8]


@register_jitable
def matrix_as_tuple(R):
    """Return a matrix (3, 3) as a tuple of 9 numbers, row by row."""
    return R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2], R[2, 0], R[2, 1], R[2, 2]


@register_jitable
def transposed(R):
    return R[0], R[3], R[6], R[1], R[4], R[7], R[2], R[5], R[8]


@register_jitable
def add_vector_into(x, i, a):
    """Add the vector a to 3 numbers of the array x, from index i."""
    x[i] += a[0]
    x[i + 1] += a[1]
    x[i + 2] += a[2]


@register_jitable
def copy_into(x, i, a, j, n):
    """Copy n numbers from index j of a to index i of x."""
    for k in range(n):
        x[i + k] = a[j + k]


@register_jitable
def plus(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@register_jitable
def minus(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@register_jitable
def scale_vector(k, a):
    return k * a[0], k * a[1], k * a[2]


@register_jitable
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@register_jitable
def cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@register_jitable
def add_cross_product(c, a, b):
    return (
        c[0] + a[1] * b[2] - a[2] * b[1],
        c[1] + a[2] * b[0] - a[0] * b[2],
        c[2] + a[0] * b[1] - a[1] * b[0],
    )


@register_jitable
def apply_matrix(R, a):
    return (
        R[0] * a[0] + R[1] * a[1] + R[2] * a[2],
        R[3] * a[0] + R[4] * a[1] + R[5] * a[2],
        R[6] * a[0] + R[7] * a[1] + R[8] * a[2],
    )


@register_jitable
def symmetric_matrix_at(x, i):
    """Return a symmetric matrix (9 numbers) from xx, xy, xz, yy, yz, zz at index i of x."""
    xx, xy, xz, yy, yz, zz = x[i], x[i + 1], x[i + 2], x[i + 3], x[i + 4], x[i + 5]
    return xx, xy, xz, xy, yy, yz, xz, yz, zz


@register_jitable(inline="always")
def cholesky(M, n):
    """Replace the lower triangle of positive definite M (n, n), only, by L of M = L L^T."""
    for i in range(n):
        for j in range(i + 1):
            value = M[i, j]
            for k in range(j):
                value -= M[i, k] * M[j, k]
            M[i, j] = value / M[j, j] if j < i else math.sqrt(value)


@register_jitable(inline="always")
def solve_by_cholesky(M, b, n):
    """Solve M x = b: replace b (n,) by x, and the lower triangle of M (n, n) as `cholesky` does."""
    cholesky(M, n)
    for i in range(n):
        for k in range(i):
            b[i] -= M[i, k] * b[k]
        b[i] /= M[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= M[k, i] * b[k]
        b[i] /= M[i, i]


def cross_matrix(a: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the skew-symmetric matrices (..., 3, 3) of the cross product with vectors a."""
    matrix = np.zeros((*a.shape, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        matrix[..., k, j], matrix[..., j, k] = a[..., i], -a[..., i]
    return matrix


@njit(cache=True)
def quaternion_product(a, b):
    """Return the quaternion product a b, with R(a b) = R(a) R(b)."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@njit(cache=True)
def conjugate_quaternion(a):
    return (a[0], -a[1], -a[2], -a[3])


@njit(cache=True)
def rotate_vector(quaternion, v):
    axis = vector_at(quaternion, 1)
    t = scale_vector(2.0, cross(axis, v))
    return add_cross_product(plus(v, scale_vector(quaternion[0], t)), axis, t)


@njit(cache=True)
def quaternion_exponential(v):
    """Return the quaternion of a rotation vector [rad]."""
    angle = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    half = 0.5 * angle
    # Below 1e-4 rad the series is exact to rounding, without division by zero.
    scale = math.sin(half) / angle if angle > 1e-4 else 0.5 - half * half / 12.0
    return (math.cos(half), scale * v[0], scale * v[1], scale * v[2])


@njit(cache=True)
def quaternion_logarithm(a):
    """Return the rotation vector [rad] of a quaternion, norm <= pi; a and -a have the same."""
    sine = math.sqrt(a[1] * a[1] + a[2] * a[2] + a[3] * a[3])
    scale = 2.0 * math.atan2(sine, abs(a[0])) / sine if sine > 1e-12 else 2.0
    if a[0] < 0.0:
        scale = -scale
    return (scale * a[1], scale * a[2], scale * a[3])


@njit(cache=True)
def normalized_quaternion(a):
    scale = 1.0 / math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2] + a[3] * a[3])
    return (scale * a[0], scale * a[1], scale * a[2], scale * a[3])


@njit(cache=True)
def quaternion_of_matrix(R):
    """Return the unit quaternion of a rotation matrix (3, 3) (Shepperd 1978)."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    largest = max(trace, R[0, 0], R[1, 1], R[2, 2])
    x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    xy, xz, yz = R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1]
    if largest == trace:
        a = (1.0 + trace, x, y, z)
    elif largest == R[0, 0]:
        a = (x, 1.0 + 2.0 * R[0, 0] - trace, xy, xz)
    elif largest == R[1, 1]:
        a = (y, xy, 1.0 + 2.0 * R[1, 1] - trace, yz)
    else:
        a = (z, xz, yz, 1.0 + 2.0 * R[2, 2] - trace)
    return normalized_quaternion(a)
