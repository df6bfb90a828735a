"""Gradients of whatever depends on the motion of a serial arm's links: one sweep from the hand to
the base, the adjoint of the forward recursion of `slave/arm.py`.

A scalar J depends on each link's motion ``[s, omega, alpha, p, R]`` (world coordinates). Its
derivatives with respect to them are the seeds; the one with respect to R is the vector g of
``dJ = g . dtheta`` for a rotation dtheta of the link. `pull_back` turns seeds into dJ/dq, dJ/dqd
and dJ/dqdd.

Joint torques need no second recursion: the weighted sum of torques ``c . tau`` is the power of the
links' wrenches (f, n) under the joint velocities c (virtual power), so the same sweep carries it,
with the velocities (v, w) of the links under c as two more variables.
"""

from __future__ import annotations

import numpy as np

from drake_teleop._compiled import njit
from drake_teleop.slave.arm import MOTION_SIZE

#: Of a link's seeds: s, omega, alpha, p, theta, and v, w of virtual power.
SEED_SIZE = 21
_S, _OMEGA, _ALPHA, _P, _THETA, _V, _W = 0, 3, 6, 9, 12, 15, 18


@njit(cache=True)
def _get(x, i):
    return x[i], x[i + 1], x[i + 2]


@njit(cache=True)
def _put(x, i, a):
    x[i] += a[0]
    x[i + 1] += a[1]
    x[i + 2] += a[2]


@njit(cache=True)
def _add(a, b):
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@njit(cache=True)
def _times(k, a):
    return k * a[0], k * a[1], k * a[2]


@njit(cache=True)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True)
def to_world(motion, a):
    """R a, with the R of a link's motion (21,); a and the result are triples."""
    return (
        motion[12] * a[0] + motion[13] * a[1] + motion[14] * a[2],
        motion[15] * a[0] + motion[16] * a[1] + motion[17] * a[2],
        motion[18] * a[0] + motion[19] * a[1] + motion[20] * a[2],
    )


@njit(cache=True)
def to_link(motion, a):
    """R^T a."""
    return (
        motion[12] * a[0] + motion[15] * a[1] + motion[18] * a[2],
        motion[13] * a[0] + motion[16] * a[1] + motion[19] * a[2],
        motion[14] * a[0] + motion[17] * a[1] + motion[20] * a[2],
    )


@njit(cache=True)
def _inertia_times(phi, a):
    return (
        phi[4] * a[0] + phi[5] * a[1] + phi[6] * a[2],
        phi[5] * a[0] + phi[7] * a[1] + phi[8] * a[2],
        phi[6] * a[0] + phi[8] * a[1] + phi[9] * a[2],
    )


@njit(cache=True)
def seed_vector(motion, place, gradient, seed):
    """J depends on s, omega or alpha (`place` 0, 3, 6) as expressed in the link's own frame."""
    g = to_world(motion, gradient)
    _put(seed, place, g)
    _put(seed, _THETA, _cross(g, _get(motion, place)))


@njit(cache=True)
def seed_point(motion, point, gradient, seed):
    """J depends on the position in W of a point (3,) fixed to the link; `gradient` is in W."""
    _put(seed, _P, gradient)
    _put(seed, _THETA, _cross(to_world(motion, point), gradient))


@njit(cache=True)
def seed_wrench(motion, phi, g_force, g_torque, seed):
    """J depends on the wrench, Eqs. (1)-(2), that moves phi about the link's origin, in the link.

    Args:
        motion: (21,) of the link.
        phi: (10,) of the body.
        g_force, g_torque: dJ/df and dJ/dtau, triples in the link's frame.
        seed: (21,), added to.
    """
    s = to_link(motion, _get(motion, _S))
    w = to_link(motion, _get(motion, _OMEGA))
    h = (phi[1], phi[2], phi[3])
    lever = _cross(g_torque, h)
    gs = _add(_times(phi[0], g_force), lever)
    ga = _add(_cross(h, g_force), _inertia_times(phi, g_torque))
    # f holds w x (w x h), tau holds w x (I w).
    gw = _add(_cross(_cross(w, h), g_force), _cross(h, _cross(g_force, w)))
    gw = _add(gw, _cross(_inertia_times(phi, w), g_torque))
    gw = _add(gw, _inertia_times(phi, _cross(g_torque, w)))
    seed_vector(motion, _S, gs, seed)
    seed_vector(motion, _OMEGA, gw, seed)
    seed_vector(motion, _ALPHA, ga, seed)
    return s, w


@njit(cache=True)
def seed_joint_torque(table, motions, c, virtual, seeds):
    """J is ``c . tau``, the joint torques without those of rotors and damping.

    Args:
        table: `ArmModel.table`.
        motions: (n+1, 21), `link_motions`.
        c: (n,) weights.
        virtual: (n+1, 6) filled with the links' velocities under c, `pull_back` wants them.
        seeds: (n+1, 21), added to.
    """
    n = motions.shape[0] - 1
    v = w = p = (0.0, 0.0, 0.0)
    for row in range(n + 1):
        motion, phi = motions[row], table[row, 12:22]
        here = _get(motion, _P)
        v = _add(v, _cross(w, _add(here, _times(-1.0, p))))
        p = here
        if row < n:
            w = _add(w, _times(c[row], (motion[14], motion[17], motion[20])))
        virtual[row, 0], virtual[row, 1], virtual[row, 2] = v
        virtual[row, 3], virtual[row, 4], virtual[row, 5] = w
        v_L, w_L = to_link(motion, v), to_link(motion, w)
        s, omega = seed_wrench(motion, phi, v_L, w_L, seeds[row])
        alpha = to_link(motion, _get(motion, _ALPHA))
        h = (phi[1], phi[2], phi[3])
        force = _add(_times(phi[0], s), _cross(alpha, h))
        force = _add(force, _cross(omega, _cross(omega, h)))
        torque = _add(_inertia_times(phi, alpha), _cross(omega, _inertia_times(phi, omega)))
        torque = _add(torque, _cross(h, s))
        F, N = to_world(motion, force), to_world(motion, torque)
        _put(seeds[row], _V, F)
        _put(seeds[row], _W, N)
        _put(seeds[row], _THETA, _add(_cross(F, v), _cross(N, w)))


@njit(cache=True)
def pull_back(motions, qd, qdd, c, virtual, seeds, g_q, g_qd, g_qdd):
    """Adds dJ/dq, dJ/dqd and dJ/dqdd of the seeds to `g_q`, `g_qd`, `g_qdd`, (n,) each.

    Args:
        motions: (n+1, 21), `link_motions` at (q, qd, qdd).
        qd, qdd: (n,) [rad/s], [rad/s^2].
        c: (n,) as in `seed_joint_torque`, or zeros.
        virtual: (n+1, 6) from there, or zeros.
        seeds: (n+1, 21).
    """
    n = motions.shape[0] - 1
    gs = gw = ga = gp = gt = gv = go = (0.0, 0.0, 0.0)
    still = np.zeros(MOTION_SIZE)
    for row in range(n, -1, -1):
        motion, seed = motions[row], seeds[row]
        inboard = motions[row - 1] if row > 0 else still
        w, a = _get(inboard, _OMEGA), _get(inboard, _ALPHA)
        gs, gw = _add(gs, _get(seed, _S)), _add(gw, _get(seed, _OMEGA))
        ga, gp = _add(ga, _get(seed, _ALPHA)), _add(gp, _get(seed, _P))
        gt, gv = _add(gt, _get(seed, _THETA)), _add(gv, _get(seed, _V))
        go = _add(go, _get(seed, _W))
        if row < n:
            z = (motion[14], motion[17], motion[20])
            gz = _add(_times(qd[row], _add(gw, _cross(ga, w))), _times(qdd[row], ga))
            gz = _add(gz, _times(c[row], go))
            g_qd[row] += _dot(z, gw) + _dot(_cross(w, z), ga)
            g_qdd[row] += _dot(z, ga)
            gt = _add(gt, _cross(z, gz))
            g_q[row] += _dot(z, gt)
            gw = _add(gw, _times(qd[row], _cross(z, ga)))
        if row > 0:
            r = _add(_get(motion, _P), _times(-1.0, _get(inboard, _P)))
            turned = _cross(gs, w)
            gr = _add(gp, _add(_cross(gs, a), _cross(turned, w)))
            gr = _add(gr, _cross(gv, _get(virtual[row - 1], 3)))
            gw = _add(gw, _add(_cross(_cross(w, r), gs), _cross(r, turned)))
            ga = _add(ga, _cross(r, gs))
            go = _add(go, _cross(r, gv))
            gt = _add(gt, _cross(r, gr))
