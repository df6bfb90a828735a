"""Gradients of functions of a serial arm's link motions, by the adjoint recursion (T48, T49).

An adjoint (21,) contains the derivatives of a scalar J by a link's motion in W, which is
``[s, omega, alpha, p, R]``. That by R is the vector g of dJ = g . dtheta, for rotations dtheta.
"""

from __future__ import annotations

import numpy as np

from drake_teleop.common.compiled import njit
from drake_teleop.common.vectors import (
    add_vector_into,
    apply_matrix,
    cross,
    dot,
    matrix_at,
    minus,
    plus,
    scale_vector,
    symmetric_matrix_at,
    transposed,
    vector_at,
)
from drake_teleop.load.regressor import wrench_of_load
from drake_teleop.station.slave.arm import IS_PRISMATIC_COLUMN, SENSOR_MOTION_SIZE

#: Size of a link's adjoint (`seed`): derivatives by s, omega, alpha, p, theta, virtual v and w.
ADJOINT_SIZE = 21
_S_INDEX, _OMEGA_INDEX, _ALPHA_INDEX, _P_INDEX, _THETA_INDEX = 0, 3, 6, 9, 12
_VIRTUAL_V_INDEX, _VIRTUAL_W_INDEX = 15, 18


@njit(cache=True)
def rotate_to_world(motion, vector_L):
    return apply_matrix(matrix_at(motion, 12), vector_L)


@njit(cache=True)
def rotate_to_link(motion, vector_W):
    return apply_matrix(transposed(matrix_at(motion, 12)), vector_W)


@njit(cache=True)
def add_vector_to_adjoint(motion, offset, gradient, seed):
    """Add a `gradient` by s, omega or alpha (`offset` 0, 3, 6), in link frame, to the `seed`."""
    g = rotate_to_world(motion, gradient)
    add_vector_into(seed, offset, g)
    add_vector_into(seed, _THETA_INDEX, cross(g, vector_at(motion, offset)))


@njit(cache=True)
def add_point_to_adjoint(motion, point, gradient, seed):
    """Add a `gradient` in W, by the position of a link-fixed point (3,), to the link's `seed`."""
    add_vector_into(seed, _P_INDEX, gradient)
    add_vector_into(seed, _THETA_INDEX, cross(rotate_to_world(motion, point), gradient))


@njit(cache=True)
def add_wrench_to_adjoint(motion, phi, g_force, g_torque, seed):
    """Add dJ/dforce, dJ/dtorque of load phi to `seed`; return s, omega; all in link frame."""
    s = rotate_to_link(motion, vector_at(motion, _S_INDEX))
    w = rotate_to_link(motion, vector_at(motion, _OMEGA_INDEX))
    h, inertia = vector_at(phi, 1), symmetric_matrix_at(phi, 4)
    lever = cross(g_torque, h)
    gs = plus(scale_vector(phi[0], g_force), lever)
    ga = plus(cross(h, g_force), apply_matrix(inertia, g_torque))
    # Terms of f: w x (w x h); of tau: w x (I w).
    gw = plus(cross(cross(w, h), g_force), cross(h, cross(g_force, w)))
    gw = plus(gw, cross(apply_matrix(inertia, w), g_torque))
    gw = plus(gw, apply_matrix(inertia, cross(g_torque, w)))
    add_vector_to_adjoint(motion, _S_INDEX, gs, seed)
    add_vector_to_adjoint(motion, _OMEGA_INDEX, gw, seed)
    add_vector_to_adjoint(motion, _ALPHA_INDEX, ga, seed)
    return s, w


@njit(cache=True)
def add_torque_to_adjoints(arm_table, motions, c, virtual_velocities, seeds):
    """Add the gradients of sum(c * tau) to `seeds`; torques tau exclude rotor inertia and damping.

    Write link velocities for joint velocities c (n,) into `virtual_velocities` (n+1, 6).
    """
    n = motions.shape[0] - 1
    v = w = p = (0.0, 0.0, 0.0)
    for row in range(n + 1):
        motion, phi = motions[row], arm_table[row, 12:22]
        here = vector_at(motion, _P_INDEX)
        v = plus(v, cross(w, minus(here, p)))
        p = here
        if row < n:
            along = scale_vector(c[row], (motion[14], motion[17], motion[20]))
            if arm_table[row, IS_PRISMATIC_COLUMN] != 0.0:
                v = plus(v, along)
            else:
                w = plus(w, along)
        virtual_velocities[row, 0], virtual_velocities[row, 1], virtual_velocities[row, 2] = v
        virtual_velocities[row, 3], virtual_velocities[row, 4], virtual_velocities[row, 5] = w
        v_L, w_L = rotate_to_link(motion, v), rotate_to_link(motion, w)
        s, omega = add_wrench_to_adjoint(motion, phi, v_L, w_L, seeds[row])
        alpha = rotate_to_link(motion, vector_at(motion, _ALPHA_INDEX))
        force, torque = wrench_of_load(s, omega, alpha, phi)
        F, N = rotate_to_world(motion, force), rotate_to_world(motion, torque)
        add_vector_into(seeds[row], _VIRTUAL_V_INDEX, F)
        add_vector_into(seeds[row], _VIRTUAL_W_INDEX, N)
        add_vector_into(seeds[row], _THETA_INDEX, plus(cross(F, v), cross(N, w)))


@njit(cache=True)
def pull_back_adjoints(arm_table, motions, qd, qdd, c, virtual_velocities, seeds, g_q, g_qd, g_qdd):
    """Add the gradients by q, qd, qdd to `g_q`, `g_qd`, `g_qdd` (n,), from the seeds of all links.

    `c` and `virtual_velocities` are those of `add_torque_to_adjoints`, or zeros.
    """
    n = motions.shape[0] - 1
    gs = gw = ga = gp = gt = gv = go = (0.0, 0.0, 0.0)
    still = np.zeros(SENSOR_MOTION_SIZE)
    for row in range(n, -1, -1):
        motion, seed = motions[row], seeds[row]
        inboard = motions[row - 1] if row > 0 else still
        w, a = vector_at(inboard, _OMEGA_INDEX), vector_at(inboard, _ALPHA_INDEX)
        gs, gw = plus(gs, vector_at(seed, _S_INDEX)), plus(gw, vector_at(seed, _OMEGA_INDEX))
        ga, gp = plus(ga, vector_at(seed, _ALPHA_INDEX)), plus(gp, vector_at(seed, _P_INDEX))
        gt = plus(gt, vector_at(seed, _THETA_INDEX))
        gv = plus(gv, vector_at(seed, _VIRTUAL_V_INDEX))
        go = plus(go, vector_at(seed, _VIRTUAL_W_INDEX))
        z, slides = (motion[14], motion[17], motion[20]), arm_table[row, IS_PRISMATIC_COLUMN] != 0.0
        if row < n and slides:
            gz = plus(scale_vector(qdd[row], gs), scale_vector(2.0 * qd[row], cross(gs, w)))
            gz = plus(gz, scale_vector(c[row], gv))
            g_qd[row] += 2.0 * dot(cross(w, z), gs)
            g_qdd[row] += dot(z, gs)
            gt = plus(gt, cross(z, gz))
        elif row < n:
            gz = plus(scale_vector(qd[row], plus(gw, cross(ga, w))), scale_vector(qdd[row], ga))
            gz = plus(gz, scale_vector(c[row], go))
            g_qd[row] += dot(z, gw) + dot(cross(w, z), ga)
            g_qdd[row] += dot(z, ga)
            gt = plus(gt, cross(z, gz))
            g_q[row] += dot(z, gt)
            gw = plus(gw, scale_vector(qd[row], cross(z, ga)))
        turned, gr = cross(gs, w), gp
        if row > 0:
            gr = plus(gp, plus(cross(gs, a), cross(turned, w)))
            gr = plus(gr, cross(gv, vector_at(virtual_velocities[row - 1], 3)))
        if row < n and slides:
            g_q[row] += dot(z, gr)
        if row > 0:
            r = minus(vector_at(motion, _P_INDEX), vector_at(inboard, _P_INDEX))
            gw = plus(gw, plus(cross(cross(w, r), gs), cross(r, turned)))
            ga = plus(ga, cross(r, gs))
            go = plus(go, cross(r, gv))
            gt = plus(gt, cross(r, gr))
            if row < n and slides:
                gw = plus(gw, scale_vector(2.0 * qd[row], cross(z, gs)))
