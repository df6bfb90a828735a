"""Vectors of three numbers and rotations of nine, for compiled code: nothing allocated.

Arguments are whatever takes an index, results are tuples; a rotation is given by rows. Compiled
code takes these functions into itself and is as fast as with the numbers spelled out; to Python
they are plain functions, of any scalar that Drake has. Sums are taken term by term from the left:
that order is kept, so that the last digit is.
"""

from __future__ import annotations

import math

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray


@register_jitable
def three(x, i):
    """The vector that begins at place i of x."""
    return x[i], x[i + 1], x[i + 2]


@register_jitable
def nine(x, i):
    """The rotation that begins at place i of x."""
    return x[i], x[i + 1], x[i + 2], x[i + 3], x[i + 4], x[i + 5], x[i + 6], x[i + 7], x[i + 8]


@register_jitable
def rows(R):
    """The rotation that a (3, 3) array is."""
    return R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2], R[2, 0], R[2, 1], R[2, 2]


@register_jitable
def transposed(R):
    """R^T."""
    return R[0], R[3], R[6], R[1], R[4], R[7], R[2], R[5], R[8]


@register_jitable
def add_into(x, i, a):
    """Adds a to the vector that begins at place i of x."""
    x[i] += a[0]
    x[i + 1] += a[1]
    x[i + 2] += a[2]


@register_jitable
def put(x, i, a, j, n):
    """Copies n numbers from place j of a to place i of x.

    For so few the check of shapes that a slice's assignment brings costs more than the copy.
    """
    for k in range(n):
        x[i + k] = a[j + k]


@register_jitable
def plus(a, b):
    """a + b."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@register_jitable
def minus(a, b):
    """a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@register_jitable
def times(k, a):
    """k a, of a number and a vector."""
    return k * a[0], k * a[1], k * a[2]


@register_jitable
def dot(a, b):
    """a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@register_jitable
def cross(a, b):
    """a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@register_jitable
def plus_cross(c, a, b):
    """c + a x b, in this order."""
    return (
        c[0] + a[1] * b[2] - a[2] * b[1],
        c[1] + a[2] * b[0] - a[0] * b[2],
        c[2] + a[0] * b[1] - a[1] * b[0],
    )


@register_jitable
def apply(R, a):
    """R a, also for any other matrix of nine numbers."""
    return (
        R[0] * a[0] + R[1] * a[1] + R[2] * a[2],
        R[3] * a[0] + R[4] * a[1] + R[5] * a[2],
        R[6] * a[0] + R[7] * a[1] + R[8] * a[2],
    )


@register_jitable
def symmetric(x, i):
    """The matrix of xx, xy, xz, yy, yz, zz, which begin at place i of x, as inertias do in phi."""
    xx, xy, xz, yy, yz, zz = x[i], x[i + 1], x[i + 2], x[i + 3], x[i + 4], x[i + 5]
    return xx, xy, xz, xy, yy, yz, xz, yz, zz


@register_jitable(inline="always")
def cholesky(M, n):
    """Turns the lower half of M (n, n), symmetric and positive definite, into L of M = L L^T.

    So small that LAPACK's calls would cost more. With n a number in the caller's code, the compiler
    unrolls the loops.
    """
    for i in range(n):
        for j in range(i + 1):
            value = M[i, j]
            for k in range(j):
                value -= M[i, k] * M[j, k]
            M[i, j] = value / M[j, j] if j < i else math.sqrt(value)


@register_jitable(inline="always")
def solve(M, b, n):
    """b := M^-1 b (n,), M as for `cholesky`, of which it becomes the result."""
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
    """(..., 3, 3) [a x] of vectors (..., 3): [a x] b = a x b."""
    matrix = np.zeros((*a.shape, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        matrix[..., k, j], matrix[..., j, k] = a[..., i], -a[..., i]
    return matrix
