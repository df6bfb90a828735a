"""Limits of arm, sensor and workspace, and their use by a motion with gradients (T47)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from drake_teleop.common.compiled import njit
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import dot, minus, plus, scale_vector, vector_at
from drake_teleop.lab.excitation.criteria import write_gradients_by_motion
from drake_teleop.lab.excitation.link_gradients import (
    ADJOINT_SIZE,
    add_point_to_adjoint,
    add_torque_to_adjoints,
    add_vector_to_adjoint,
    add_wrench_to_adjoint,
    pull_back_adjoints,
    rotate_to_link,
    rotate_to_world,
)
from drake_teleop.load.regressor import non_contact_wrench_into
from drake_teleop.station.slave.arm import SENSOR_MOTION_SIZE, inverse_dynamics, link_motions

LIMIT_NAMES = ("position", "velocity", "acceleration", "torque", "sensor", "workspace", "clearance")

#: Distance beyond the clearance at which the use of the clearance is 0 [m].
CLEARANCE_USE_RANGE_M = 0.1
_NEGLIGIBLE_GRADIENT_WEIGHT = 1e-7  # smaller weights in a smooth maximum's gradient are skipped
_DISTANCE_OF_FAR_CAPSULES_M = 1.0  # replaces distances with zero clearance use [m]


class Limits(NamedTuple):
    """Limits of an excitation; a use (value over limit) of 1 reaches the limit.

    Attributes:
        q_middle, q_half: (n,) middle and half of the joint ranges [rad]; half may be inf.
        velocity, acceleration, max_torques: (n,) of joints [rad/s, rad/s^2, N m]; may be inf.
        heaviest_phi: (10,) heaviest expected load about the origin of S.
        max_sensor_norms: (4,) of force [N], torque [N m], s [m/s^2], alpha [rad/s^2] at S.
        points_S: (P, 3) points in S that remain in the box [m].
        box_middle, box_half: (3,) middle and half size of the box in W [m]; half may be inf.
        capsule_links: (C,) link of each capsule, a row of `link_motions`; -1 is the world.
        capsule_ends, capsule_radius: (C, 2, 3) end points in the link's frame, (C,) radii [m].
        capsule_pairs, min_pair_distances: (K, 2) capsules, (K,) distances [m], maybe negative.
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
    """Return half ranges (n,) [rad] for random postures: pi for unlimited joints."""
    return np.where(np.isfinite(q_half), q_half, np.pi)


@njit(cache=True)
def link_motion_series(arm_table, q, qd, qdd):
    """Return specific force to rotation [s, omega, alpha, p, R] of links in W (T, n+1, 21)."""
    motions = np.empty((len(q), q.shape[1] + 1, SENSOR_MOTION_SIZE))
    for t in range(len(q)):
        link_motions(arm_table, q[t], qd[t], qdd[t], motions[t])
    return motions


@njit(cache=True)
def sensor_motion_series(motions):
    """Return specific force, omega and alpha (3, T, 3) of the sensor in S, the last link."""
    out = np.empty((3, len(motions), 3))
    for t in range(len(motions)):
        for k in range(3):
            x = rotate_to_link(motions[t, -1], vector_at(motions[t, -1], 3 * k))
            out[k, t, 0], out[k, t, 1], out[k, t, 2] = x
    return out


@njit(cache=True)
def add_gradient_by_joints(arm_table, motions, qd, qdd, g_V, gradient):
    """Add dJ/dq, dJ/dqd, dJ/dqdd to `gradient` (3, T, n), from g_V = dJ/dV (V: regressor)."""
    buffers, g = _allocate_gradient_buffers(motions), np.empty((3, 3))
    seed = buffers[0][-1]
    for t in range(len(motions)):
        motion = motions[t, -1]
        write_gradients_by_motion(
            rotate_to_link(motion, vector_at(motion, 3)), g_V[t], g[0], g[1], g[2]
        )
        seed[:] = 0.0
        for k in range(3):
            add_vector_to_adjoint(motion, 3 * k, vector_at(g[k], 0), seed)
        _add_joint_gradients_at_sample(arm_table, qd, qdd, motions, t, gradient, buffers)


@njit(cache=True)
def max_limit_uses_into(arm_table, q, qd, qdd, motions, limits, sharpness, gradient):
    """Return smooth and exact maxima over samples of value over limit, by `LIMIT_NAMES` (7,).

    Write the gradient (7, 3, T, n) of the smooth ones by q, qd, qdd (T, n) (T47).
    """
    gradient[:] = 0.0
    smooth, largest = np.empty(7), np.empty(7)
    scales = limits.q_half, limits.velocity, limits.acceleration
    for k in range(3):
        x = (q - limits.q_middle, qd, qdd)[k]
        use = np.abs(x) / scales[k]
        largest[k], smooth[k] = _exact_and_smooth_maximum(use, sharpness)
        gradient[k, k] = use * (np.sign(x) / scales[k])
    samples = arm_table, q, qd, qdd, motions
    largest[3], smooth[3] = _max_torque_use_into(samples, limits, sharpness, gradient[3])
    largest[4], smooth[4] = _max_sensor_use_into(samples, limits, sharpness, gradient[4])
    largest[5], smooth[5] = _max_workspace_use_into(samples, limits, sharpness, gradient[5])
    largest[6] = smooth[6] = 0.0
    if len(limits.capsule_pairs) > 0:
        largest[6], smooth[6] = _max_clearance_use_into(samples, limits, sharpness, gradient[6])
    return smooth, largest


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
    use /= total
    return top, top + np.log(total) / sharpness


@njit(cache=True)
def _allocate_gradient_buffers(motions):
    # Seeds, joint velocities and link velocities of virtual power, see `add_torque_to_adjoints`.
    rows = motions.shape[1]
    return np.zeros((rows, ADJOINT_SIZE)), np.zeros(rows - 1), np.zeros((rows, 6))


@njit(cache=True)
def _add_joint_gradients_at_sample(arm_table, qd, qdd, motions, t, gradient, buffers):
    seeds, weights, virtual = buffers
    pull_back_adjoints(
        arm_table, motions[t], qd[t], qdd[t], weights, virtual, seeds,
        gradient[0, t], gradient[1, t], gradient[2, t],
    )  # fmt: skip


@njit(cache=True, inline="always")
def _max_torque_use_into(samples, limits, sharpness, gradient):
    arm_table, q, qd, qdd, motions = samples
    tau = np.empty(q.shape)
    for t in range(len(q)):
        inverse_dynamics(arm_table, q[t], qd[t], qdd[t], tau[t])
    use = np.abs(tau) / limits.max_torques
    maxima = _exact_and_smooth_maximum(use, sharpness)
    buffers = _allocate_gradient_buffers(motions)
    seeds, weights, virtual = buffers
    for t in range(len(q)):
        if use[t].max() < _NEGLIGIBLE_GRADIENT_WEIGHT:
            continue
        seeds[:] = 0.0
        weights[:] = use[t] * np.sign(tau[t]) / limits.max_torques
        # Table columns 22 and 23: rotor inertia and joint damping.
        gradient[2, t] += weights * arm_table[:-1, 22]
        gradient[1, t] += weights * arm_table[:-1, 23]
        add_torque_to_adjoints(arm_table, motions[t], weights, virtual, seeds)
        _add_joint_gradients_at_sample(arm_table, qd, qdd, motions, t, gradient, buffers)
    return maxima


@njit(cache=True, inline="always")
def _max_sensor_use_into(samples, limits, sharpness, gradient):
    arm_table, _, qd, qdd, motions = samples
    sensor, size = sensor_motion_series(motions), np.empty((len(motions), 4))
    x = np.empty((len(motions), 12))  # force, torque, s, alpha in S
    x[:, 6:9], x[:, 9:] = sensor[0], sensor[2]
    for t in range(len(motions)):
        s, omega, alpha = sensor[0, t], sensor[1, t], sensor[2, t]
        non_contact_wrench_into(s, omega, alpha, limits.heaviest_phi, x[t])
        for k in range(4):
            part = vector_at(x[t], 3 * k)
            size[t, k] = np.sqrt(dot(part, part))
    use = size / limits.max_sensor_norms
    maxima = _exact_and_smooth_maximum(use, sharpness)
    buffers = _allocate_gradient_buffers(motions)
    seed = buffers[0][-1]
    for t in range(len(motions)):
        if use[t].max() < _NEGLIGIBLE_GRADIENT_WEIGHT:
            continue
        seed[:] = 0.0
        motion, g = motions[t, -1], x[t]
        for k in range(4):
            size_limit = limits.max_sensor_norms[k] * max(size[t, k], 1e-12)
            g[3 * k : 3 * k + 3] *= use[t, k] / size_limit
        add_wrench_to_adjoint(motion, limits.heaviest_phi, vector_at(g, 0), vector_at(g, 3), seed)
        add_vector_to_adjoint(motion, 0, vector_at(g, 6), seed)
        add_vector_to_adjoint(motion, 6, vector_at(g, 9), seed)
        _add_joint_gradients_at_sample(arm_table, qd, qdd, motions, t, gradient, buffers)
    return maxima


@njit(cache=True, inline="always")
def _max_workspace_use_into(samples, limits, sharpness, gradient):
    arm_table, _, qd, qdd, motions = samples
    T, P = len(motions), len(limits.points_S)
    x = np.empty((T, P, 3))
    for t in range(T):
        for k in range(P):
            p = _point_in_world(motions[t, -1], limits.points_S[k])
            x[t, k, 0], x[t, k, 1], x[t, k, 2] = minus(p, limits.box_middle)
    use = (np.abs(x) / limits.box_half).reshape(T, 3 * P)
    maxima = _exact_and_smooth_maximum(use, sharpness)
    by_x = use.reshape(T, P, 3) * (np.sign(x) / limits.box_half)
    buffers = _allocate_gradient_buffers(motions)
    seed = buffers[0][-1]
    for t in range(T):
        if use[t].max() < _NEGLIGIBLE_GRADIENT_WEIGHT:
            continue
        seed[:] = 0.0
        for k in range(P):
            add_point_to_adjoint(motions[t, -1], limits.points_S[k], vector_at(by_x[t, k], 0), seed)
        _add_joint_gradients_at_sample(arm_table, qd, qdd, motions, t, gradient, buffers)
    return maxima


@njit(cache=True, inline="always")
def _max_clearance_use_into(samples, limits, sharpness, gradient):
    arm_table, _, qd, qdd, motions = samples
    T, K = len(motions), len(limits.capsule_pairs)
    use, ends = np.empty((T, K)), np.empty((T, *limits.capsule_ends.shape))
    for t in range(T):
        _transform_capsules_to_world(motions[t], limits.capsule_links, limits.capsule_ends, ends[t])
        for k in range(K):
            a, b = limits.capsule_pairs[k]
            reach = limits.capsule_radius[a] + limits.capsule_radius[b]
            distance, far = _DISTANCE_OF_FAR_CAPSULES_M, reach + CLEARANCE_USE_RANGE_M
            if not _are_segments_surely_apart(ends[t, a], ends[t, b], far):
                distance = _nearest_points_of_segments(ends[t, a], ends[t, b])[0] - reach
            excess = distance - limits.min_pair_distances[k]
            use[t, k] = 1.0 - excess / CLEARANCE_USE_RANGE_M
    maxima = _exact_and_smooth_maximum(use, sharpness)
    buffers = _allocate_gradient_buffers(motions)
    seeds = buffers[0]
    for t in range(T):
        if use[t].max() < _NEGLIGIBLE_GRADIENT_WEIGHT:
            continue
        seeds[:] = 0.0
        for k in range(K):
            if use[t, k] < _NEGLIGIBLE_GRADIENT_WEIGHT:
                continue
            a, b = limits.capsule_pairs[k]
            _, on_a, on_b, towards_a = _nearest_points_of_segments(ends[t, a], ends[t, b])
            g = scale_vector(-use[t, k] / CLEARANCE_USE_RANGE_M, towards_a)
            for capsule, share, sign in ((a, on_a, 1.0), (b, on_b, -1.0)):
                row = limits.capsule_links[capsule]
                if row >= 0:
                    start, along = _start_and_direction(limits.capsule_ends[capsule])
                    point = plus(start, scale_vector(share, along))
                    add_point_to_adjoint(motions[t, row], point, scale_vector(sign, g), seeds[row])
        _add_joint_gradients_at_sample(arm_table, qd, qdd, motions, t, gradient, buffers)
    return maxima


@njit(cache=True)
def capsule_distances(motions, capsule_links, capsule_ends, capsule_radius, capsule_pairs):
    """Return the distances (T, K) of K capsule pairs [m], negative for overlaps.

    `motions` are from `link_motion_series`, the other arguments from `Limits`.
    """
    distances = np.empty((len(motions), len(capsule_pairs)))
    placed = np.empty(capsule_ends.shape)
    for t in range(len(motions)):
        _transform_capsules_to_world(motions[t], capsule_links, capsule_ends, placed)
        for k in range(len(capsule_pairs)):
            a, b = capsule_pairs[k]
            distance = _nearest_points_of_segments(placed[a], placed[b])[0]
            distances[t, k] = distance - capsule_radius[a] - capsule_radius[b]
    return distances


@njit(cache=True)
def _transform_capsules_to_world(motions, links, ends_L, ends_W):
    for k in range(len(links)):
        for e in range(2):
            p = vector_at(ends_L[k, e], 0)
            if links[k] >= 0:
                p = _point_in_world(motions[links[k]], p)
            ends_W[k, e, 0], ends_W[k, e, 1], ends_W[k, e, 2] = p


@register_jitable
def _point_in_world(motion, point):
    return plus(vector_at(motion, 9), rotate_to_world(motion, point))


@register_jitable
def _start_and_direction(segment):
    start = vector_at(segment[0], 0)
    return start, minus(vector_at(segment[1], 0), start)


@njit(cache=True)
def _are_segments_surely_apart(first, second, distance):
    # Sufficient condition for two segments (2, 3): four times the square of the middles' distance.
    (a, along_a), (b, along_b) = _start_and_direction(first), _start_and_direction(second)
    between = minus(minus(plus(a, vector_at(first[1], 0)), b), vector_at(second[1], 0))
    # (a + b + c)^2 <= 3 (a^2 + b^2 + c^2)
    squares = dot(along_a, along_a) + dot(along_b, along_b) + 4 * distance * distance
    return dot(between, between) > 3 * squares


@njit(cache=True)
def _nearest_points_of_segments(first, second):
    # Distance of two segments (2, 3) [m], positions of the nearest points on both (0 to 1), and
    # unit vector to the first (Ericson, Real-Time Collision Detection).
    (a, d), (b, e) = _start_and_direction(first), _start_and_direction(second)
    r = minus(a, b)
    dd, ee, de, dr, er = dot(d, d), dot(e, e), dot(d, e), dot(d, r), dot(e, r)
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
    x = minus(plus(a, scale_vector(s, d)), plus(b, scale_vector(t, e)))
    distance = np.sqrt(dot(x, x))
    if distance > 0.0:
        x = x[0] / distance, x[1] / distance, x[2] / distance
    return distance, s, t, x
