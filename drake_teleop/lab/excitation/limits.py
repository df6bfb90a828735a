"""Limits of arm, sensor and workspace, and their use by a motion, with gradients (T47)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Array
from drake_teleop.lab.excitation.criteria import write_gradients_by_motion
from drake_teleop.lab.excitation.link_gradients import (
    SEED_SIZE,
    add_point_to_seed,
    add_torque_to_seeds,
    add_vector_to_seed,
    add_wrench_to_seed,
    pull_back_seeds,
    rotate_to_link,
    rotate_to_world,
)
from drake_teleop.load.regressor import non_contact_wrench_into
from drake_teleop.station.slave.arm import SENSOR_MOTION_SIZE, inverse_dynamics, link_motions

LIMIT_NAMES = ("position", "velocity", "acceleration", "torque", "sensor", "workspace", "clearance")

#: Distance beyond the clearance at which the use of the clearance is 0 [m].
ZERO_USE_CLEARANCE_MARGIN_M = 0.1
# Smallest weight in the gradient of a smooth maximum.
_MIN_SMOOTH_MAXIMUM_WEIGHT = 1e-7
# Value that replaces all distances above clearance plus scale [m].
_DISTANCE_OF_FAR_CAPSULES_M = 1.0


class Limits(NamedTuple):
    """Limits of an excitation; a use of 1 reaches a limit.

    Attributes:
        q_middle, q_half: (n,) middle and half of the joint ranges [rad]; half may be inf.
        velocity, acceleration, max_torques: (n,) of joints [rad/s, rad/s^2, N m]; may be inf.
        heaviest_phi: (10,) heaviest expected load about the origin of S.
        max_sensor_norms: (4,) of force [N], torque [N m], s [m/s^2], alpha [rad/s^2] at S.
        points_S: (P, 3) points in S that remain in the box [m].
        box_middle, box_half: (3,) middle and half size of the box in W [m]; half may be inf.
        capsule_links: (C,) link of each capsule, a row of `link_motions`; -1 is the world.
        capsule_ends, capsule_radius: (C, 2, 3) end points in the link's frame, (C,) radii [m].
        capsule_pairs, min_pair_distances: (K, 2), and (K,) distances [m], possibly negative.
        clearance: minimum distance of the true shapes [m].
    """

    q_middle: Array
    q_half: Array
    velocity: Array
    acceleration: Array
    max_torques: Array
    heaviest_phi: Array
    max_sensor_norms: Array
    points_S: Array
    box_middle: Array
    box_half: Array
    capsule_links: NDArray[np.int64]
    capsule_ends: Array
    capsule_radius: Array
    capsule_pairs: NDArray[np.int64]
    min_pair_distances: Array
    clearance: float


def finite_half_ranges(q_half: Array) -> Array:
    """Return the half ranges (n,) for random postures [rad]: pi without limits."""
    return np.where(np.isfinite(q_half), q_half, np.pi)


@njit(cache=True)
def write_link_motions(table, q, qd, qdd, motions):
    """Write all links' motions at T samples q, qd, qdd (T, n) into `motions` (T, n+1, 21)."""
    for t in range(len(q)):
        link_motions(table, q[t], qd[t], qdd[t], motions[t])


@njit(cache=True)
def write_sensor_motion(motions, out):
    """Write specific force, omega, alpha of the sensor, in S, into `out` (3, T, 3)."""
    for t in range(len(motions)):
        motion = motions[t, -1]
        for k in range(3):
            x = rotate_to_link(motion, (motion[3 * k], motion[3 * k + 1], motion[3 * k + 2]))
            out[k, t, 0], out[k, t, 1], out[k, t, 2] = x


@njit(cache=True)
def add_gradient_by_joints(table, motions, qd, qdd, g_V, gradient):
    """Add a scalar's gradient by q, qd, qdd to `gradient` (3, T, n), from that by V (T, 6, 10)."""
    rows = motions.shape[1]
    seeds, g = np.zeros((rows, SEED_SIZE)), np.empty((3, 3))
    work = seeds, np.zeros(rows - 1), np.zeros((rows, 6))
    for t in range(len(motions)):
        motion = motions[t, -1]
        omega = rotate_to_link(motion, (motion[3], motion[4], motion[5]))
        write_gradients_by_motion(omega, g_V[t], g[0], g[1], g[2])
        seeds[-1] = 0.0
        for k in range(3):
            add_vector_to_seed(motion, 3 * k, (g[k, 0], g[k, 1], g[k, 2]), seeds[-1])
        _pull_back_seeds_of_sample(table, motions, qd, qdd, t, gradient, work)


@njit(cache=True)
def write_limit_uses(table, q, qd, qdd, motions, limits, sharpness, smooth, largest, gradient):
    """Write the largest use of each of `LIMIT_NAMES` over all samples, with gradients (T47).

    Outputs: `smooth` and exact maximum (7,), and the gradient (7, 3, T, n) of the smooth one by
    joint positions, velocities and accelerations.
    """
    gradient[:] = 0.0
    T, n = q.shape
    use, sign = np.empty((T, n)), np.empty((T, n))
    for k in range(3):
        values = (q, qd, qdd)[k]
        scale = (limits.q_half, limits.velocity, limits.acceleration)[k]
        for t in range(T):
            for j in range(n):
                x = values[t, j] - limits.q_middle[j] if k == 0 else values[t, j]
                use[t, j], sign[t, j] = abs(x) / scale[j], np.sign(x) / scale[j]
        largest[k], smooth[k] = _exact_and_smooth_maximum(use, sharpness)
        for t in range(T):
            for j in range(n):
                gradient[k, k, t, j] = use[t, j] * sign[t, j]
    work = np.zeros((n + 1, SEED_SIZE)), np.zeros(n), np.zeros((n + 1, 6))
    _write_torque_use(
        table, q, qd, qdd, motions, limits, sharpness, smooth, largest, gradient[3], work
    )
    work[1][:] = 0.0
    work[2][:] = 0.0
    _write_sensor_use(
        table, qd, qdd, motions, limits, sharpness, smooth, largest, gradient[4], work
    )
    _write_workspace_use(
        table, qd, qdd, motions, limits, sharpness, smooth, largest, gradient[5], work
    )
    _write_clearance_use(
        table, qd, qdd, motions, limits, sharpness, smooth, largest, gradient[6], work
    )


@njit(cache=True)
def _exact_and_smooth_maximum(use, sharpness):
    # `use` (T, m) becomes the gradient of the smooth maximum.
    top = use.max()
    total = 0.0
    for t in range(use.shape[0]):
        for k in range(use.shape[1]):
            below = sharpness * (use[t, k] - top)
            use[t, k] = np.exp(below) if below > -40.0 else 0.0
            total += use[t, k]
    for t in range(use.shape[0]):
        for k in range(use.shape[1]):
            use[t, k] /= total
    return top, top + np.log(total) / sharpness


@njit(cache=True, inline="always")
def _write_torque_use(
    table, q, qd, qdd, motions, limits, sharpness, smooth, largest, gradient, work
):
    seeds, c, virtual = work
    T, n = q.shape
    tau = np.empty((T, n))
    use = np.empty((T, n))
    for t in range(T):
        inverse_dynamics(table, q[t], qd[t], qdd[t], tau[t])
        for j in range(n):
            use[t, j] = abs(tau[t, j]) / limits.max_torques[j]
    largest[3], smooth[3] = _exact_and_smooth_maximum(use, sharpness)
    for t in range(T):
        if use[t].max() < _MIN_SMOOTH_MAXIMUM_WEIGHT:
            continue
        seeds[:] = 0.0
        for j in range(n):
            c[j] = use[t, j] * np.sign(tau[t, j]) / limits.max_torques[j]
            # Table columns 22 and 23: rotor inertia and joint damping.
            gradient[2, t, j] += c[j] * table[j, 22]
            gradient[1, t, j] += c[j] * table[j, 23]
        add_torque_to_seeds(table, motions[t], c, virtual, seeds)
        _pull_back_seeds_of_sample(table, motions, qd, qdd, t, gradient, work)


@njit(cache=True)
def _pull_back_seeds_of_sample(table, motions, qd, qdd, t, gradient, work):
    seeds, c, virtual = work
    pull_back_seeds(
        table, motions[t], qd[t], qdd[t], c, virtual, seeds,
        gradient[0, t], gradient[1, t], gradient[2, t],
    )  # fmt: skip


@njit(cache=True, inline="always")
def _write_sensor_use(table, qd, qdd, motions, limits, sharpness, smooth, largest, gradient, work):
    seeds = work[0]
    T = len(motions)
    use, size = np.empty((T, 4)), np.empty((T, 4))
    x = np.empty((T, 12))  # force, torque, s, alpha in S
    omega = np.empty(3)
    for t in range(T):
        motion = motions[t, -1]
        x[t, 6], x[t, 7], x[t, 8] = rotate_to_link(motion, (motion[0], motion[1], motion[2]))
        x[t, 9], x[t, 10], x[t, 11] = rotate_to_link(motion, (motion[6], motion[7], motion[8]))
        omega[0], omega[1], omega[2] = rotate_to_link(motion, (motion[3], motion[4], motion[5]))
        non_contact_wrench_into(x[t, 6:9], omega, x[t, 9:12], limits.heaviest_phi, x[t, :6])
        for k in range(4):
            a, b, c = x[t, 3 * k], x[t, 3 * k + 1], x[t, 3 * k + 2]
            size[t, k] = np.sqrt(a * a + b * b + c * c)
            use[t, k] = size[t, k] / limits.max_sensor_norms[k]
    largest[4], smooth[4] = _exact_and_smooth_maximum(use, sharpness)
    g = np.empty((4, 3))
    for t in range(T):
        if use[t].max() < _MIN_SMOOTH_MAXIMUM_WEIGHT:
            continue
        seeds[:] = 0.0
        for k in range(4):
            factor = use[t, k] / (limits.max_sensor_norms[k] * max(size[t, k], 1e-12))
            for i in range(3):
                g[k, i] = factor * x[t, 3 * k + i]
        motion = motions[t, -1]
        force, torque = (g[0, 0], g[0, 1], g[0, 2]), (g[1, 0], g[1, 1], g[1, 2])
        add_wrench_to_seed(motion, limits.heaviest_phi, force, torque, seeds[-1])
        add_vector_to_seed(motion, 0, (g[2, 0], g[2, 1], g[2, 2]), seeds[-1])
        add_vector_to_seed(motion, 6, (g[3, 0], g[3, 1], g[3, 2]), seeds[-1])
        _pull_back_seeds_of_sample(table, motions, qd, qdd, t, gradient, work)


@njit(cache=True, inline="always")
def _write_workspace_use(
    table, qd, qdd, motions, limits, sharpness, smooth, largest, gradient, work
):
    seeds = work[0]
    T, P = len(motions), len(limits.points_S)
    use, sign = np.empty((T, 3 * P)), np.empty((T, 3 * P))
    for t in range(T):
        motion = motions[t, -1]
        for k in range(P):
            p = rotate_to_world(motion, limits.points_S[k])
            for i in range(3):
                x = motion[9 + i] + p[i] - limits.box_middle[i]
                use[t, 3 * k + i] = abs(x) / limits.box_half[i]
                sign[t, 3 * k + i] = np.sign(x) / limits.box_half[i]
    largest[5], smooth[5] = _exact_and_smooth_maximum(use, sharpness)
    for t in range(T):
        if use[t].max() < _MIN_SMOOTH_MAXIMUM_WEIGHT:
            continue
        seeds[:] = 0.0
        by_x = use[t] * sign[t]
        for k in range(P):
            g = (by_x[3 * k], by_x[3 * k + 1], by_x[3 * k + 2])
            add_point_to_seed(motions[t, -1], limits.points_S[k], g, seeds[-1])
        _pull_back_seeds_of_sample(table, motions, qd, qdd, t, gradient, work)


@njit(cache=True, inline="always")
def _write_clearance_use(
    table, qd, qdd, motions, limits, sharpness, smooth, largest, gradient, work
):
    seeds = work[0]
    T, K = len(motions), len(limits.capsule_pairs)
    if K == 0:
        largest[6] = smooth[6] = 0.0
        return
    use, nearest, point = np.empty((T, K)), np.empty(5), np.empty(3)
    ends = np.empty((T, *limits.capsule_ends.shape))
    for t in range(T):
        _transform_capsules(motions[t], limits.capsule_links, limits.capsule_ends, ends[t])
        for k in range(K):
            a, b = limits.capsule_pairs[k]
            reach = limits.capsule_radius[a] + limits.capsule_radius[b]
            distance, far = _DISTANCE_OF_FAR_CAPSULES_M, reach + ZERO_USE_CLEARANCE_MARGIN_M
            if not _are_segments_surely_apart(ends[t, a], ends[t, b], far):
                distance = _segment_distance_and_nearest_into(ends[t, a], ends[t, b], nearest)
                distance -= reach
            excess = distance - limits.min_pair_distances[k]
            use[t, k] = 1.0 - excess / ZERO_USE_CLEARANCE_MARGIN_M
    largest[6], smooth[6] = _exact_and_smooth_maximum(use, sharpness)
    for t in range(T):
        if use[t].max() < _MIN_SMOOTH_MAXIMUM_WEIGHT:
            continue
        seeds[:] = 0.0
        for k in range(K):
            if use[t, k] < _MIN_SMOOTH_MAXIMUM_WEIGHT:
                continue
            a, b = limits.capsule_pairs[k]
            _segment_distance_and_nearest_into(ends[t, a], ends[t, b], nearest)
            for side in range(2):
                capsule = limits.capsule_pairs[k, side]
                row = limits.capsule_links[capsule]
                if row < 0:
                    continue
                along, towards = nearest[side], (1.0 if side == 0 else -1.0)
                factor = -use[t, k] / ZERO_USE_CLEARANCE_MARGIN_M * towards
                start, end = limits.capsule_ends[capsule, 0], limits.capsule_ends[capsule, 1]
                for i in range(3):
                    point[i] = start[i] + along * (end[i] - start[i])
                g = (factor * nearest[2], factor * nearest[3], factor * nearest[4])
                add_point_to_seed(motions[t, row], point, g, seeds[row])
        _pull_back_seeds_of_sample(table, motions, qd, qdd, t, gradient, work)


@njit(cache=True)
def capsule_distances(motions, capsule_links, capsule_ends, capsule_radius, capsule_pairs):
    """Return the distances (T, K) of K capsule pairs [m], negative for overlaps.

    `motions` are from `write_link_motions`, others of `Limits`.
    """
    distances = np.empty((len(motions), len(capsule_pairs)))
    placed, nearest = np.empty(capsule_ends.shape), np.empty(5)
    for t in range(len(motions)):
        _transform_capsules(motions[t], capsule_links, capsule_ends, placed)
        for k in range(len(capsule_pairs)):
            a, b = capsule_pairs[k]
            distance = _segment_distance_and_nearest_into(placed[a], placed[b], nearest)
            distances[t, k] = distance - capsule_radius[a] - capsule_radius[b]
    return distances


@njit(cache=True)
def _transform_capsules(motions, rows, ends, placed):
    for k in range(len(rows)):
        row = rows[k]
        for e in range(2):
            if row < 0:
                placed[k, e] = ends[k, e]
                continue
            p = rotate_to_world(motions[row], ends[k, e])
            for i in range(3):
                placed[k, e, i] = motions[row, 9 + i] + p[i]


@njit(cache=True)
def _are_segments_surely_apart(first, second, distance):
    # Sufficient condition for two segments (2, 3).
    between = length_a = length_b = 0.0
    for i in range(3):
        d = 0.5 * (first[0, i] + first[1, i] - second[0, i] - second[1, i])
        a, b = 0.5 * (first[1, i] - first[0, i]), 0.5 * (second[1, i] - second[0, i])
        between, length_a, length_b = between + d * d, length_a + a * a, length_b + b * b
    # (a + b + c)^2 <= 3 (a^2 + b^2 + c^2)
    return between > 3 * (length_a + length_b + distance * distance)


@njit(cache=True)
def _segment_distance_and_nearest_into(first, second, nearest):
    # Distance of two segments (2, 3) [m] (Ericson, Real-Time Collision Detection). `nearest` (5,):
    # positions on both segments (0 to 1), unit vector to the first.
    dd = ee = de = dr = er = 0.0
    for i in range(3):
        d, e = first[1, i] - first[0, i], second[1, i] - second[0, i]
        r = first[0, i] - second[0, i]
        dd, ee, de = dd + d * d, ee + e * e, de + d * e
        dr, er = dr + d * r, er + e * r
    tiny = 1e-14
    denominator = dd * ee - de * de
    s = t = 0.0
    if denominator > tiny * max(dd * ee, tiny):
        s = min(max((de * er - dr * ee) / denominator, 0.0), 1.0)
    if ee > tiny:
        t = (de * s + er) / ee
    if t < 0.0 or t > 1.0 or ee <= tiny:
        t = min(max(t, 0.0), 1.0)
        s = min(max((de * t - dr) / dd, 0.0), 1.0) if dd > tiny else 0.0
    total = 0.0
    for i in range(3):
        x = first[0, i] + s * (first[1, i] - first[0, i])
        x -= second[0, i] + t * (second[1, i] - second[0, i])
        nearest[2 + i] = x
        total += x * x
    distance = np.sqrt(total)
    nearest[0], nearest[1] = s, t
    if distance > 0.0:
        for i in range(3):
            nearest[2 + i] /= distance
    return distance


def allocate_link_motions(samples: int, joints: int) -> Array:
    return np.empty((samples, joints + 1, SENSOR_MOTION_SIZE))
