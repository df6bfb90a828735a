"""Unit quaternions as tuples (w, x, y, z), compiled, without allocation."""

from __future__ import annotations

import math

from drake_teleop.common.compiled import njit
from drake_teleop.common.vectors import cross, plus, plus_cross, three, times


@njit(cache=True)
def multiply(a, b):
    """Return a b; R(a b) = R(a) R(b)."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@njit(cache=True)
def conjugate(a):
    """Return the inverse rotation."""
    return (a[0], -a[1], -a[2], -a[3])


@njit(cache=True)
def rotate(a, v):
    """Return R(a) v."""
    axis = three(a, 1)
    t = times(2.0, cross(axis, v))
    return plus_cross(plus(v, times(a[0], t)), axis, t)


@njit(cache=True)
def exponential(v):
    """Return the quaternion of a rotation vector [rad]."""
    angle = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    half = 0.5 * angle
    # Below 1e-4 rad the series is exact to rounding, without division by zero.
    scale = math.sin(half) / angle if angle > 1e-4 else 0.5 - half * half / 12.0
    return (math.cos(half), scale * v[0], scale * v[1], scale * v[2])


@njit(cache=True)
def logarithm(a):
    """Return the rotation vector [rad], |v| <= pi; a and -a give the same."""
    sine = math.sqrt(a[1] * a[1] + a[2] * a[2] + a[3] * a[3])
    scale = 2.0 * math.atan2(sine, abs(a[0])) / sine if sine > 1e-12 else 2.0
    if a[0] < 0.0:
        scale = -scale
    return (scale * a[1], scale * a[2], scale * a[3])


@njit(cache=True)
def normalized(a):
    """Return a / |a|."""
    scale = 1.0 / math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2] + a[3] * a[3])
    return (scale * a[0], scale * a[1], scale * a[2], scale * a[3])


@njit(cache=True)
def quaternion_of(R):
    """Return the unit quaternion of a rotation matrix (3, 3) (Shepperd 1978)."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    largest = max(trace, R[0, 0], R[1, 1], R[2, 2])
    if largest == trace:
        a = (1.0 + trace, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1])
    elif largest == R[0, 0]:
        a = (
            R[2, 1] - R[1, 2],
            1.0 + 2.0 * R[0, 0] - trace,
            R[0, 1] + R[1, 0],
            R[0, 2] + R[2, 0],
        )
    elif largest == R[1, 1]:
        a = (
            R[0, 2] - R[2, 0],
            R[0, 1] + R[1, 0],
            1.0 + 2.0 * R[1, 1] - trace,
            R[1, 2] + R[2, 1],
        )
    else:
        a = (
            R[1, 0] - R[0, 1],
            R[0, 2] + R[2, 0],
            R[1, 2] + R[2, 1],
            1.0 + 2.0 * R[2, 2] - trace,
        )
    return normalized(a)
