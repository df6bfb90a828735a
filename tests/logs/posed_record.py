"""Records of a wrench and noisy poses of a motion in closed form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from known_motion import GRAVITY_W as DOWN
from known_motion import Motion, quaternions
from known_motion import motion_at as fast_motion_at
from scipy.signal import lfilter

from drake_teleop.common.rotations import rotation_matrices
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.pose_motion.poses import Poses

PHI = phi_from_mass_com_inertia(
    1.7,
    [0.004, -0.010, 0.062],
    [[0.0040, 0.0001, -0.0002], [0.0001, 0.0036, 0.0001], [-0.0002, 0.0001, 0.0018]],
)
OFFSETS = np.array([3.1, -1.4, 6.0, 0.13, -0.29, 0.06])
TRUTH = np.concatenate([OFFSETS, PHI])
GRAVITY_W = rotation_matrices(np.array([[0.4, -0.2, 0.0]]), "rotation_vector")[0] @ DOWN
"""Tilted: with rotations about z and x only, gravity along z would never have an x in S."""
SECONDS, LATE = 20.0, 0.013
SHIFT = np.array([0.02, -0.035, 0.15])
TURN = rotation_matrices(np.array([[0.3, -0.2, 0.6]]), "rotation_vector")[0]


@dataclass(frozen=True)
class Kind:
    """Record: rates [Hz], noise of the poses [m, rad] and its colour, frame of the poses."""

    wrench_rate: float = 200.0
    rate: float = 125.0
    place: float = 1e-4
    turn: float = 2e-4
    colour: float = 0.0
    p_SoPo_S: tuple[float, ...] = (0.0, 0.0, 0.0)
    turned: bool = False
    gain: float = 0.0
    seed: int = 0


def motion_at(t: np.ndarray) -> Motion:
    """Return the known motion at half its speed, in a world whose z is not up."""
    fast = fast_motion_at(0.5 * t)
    acceleration = 0.25 * (fast.specific_force + np.einsum("nji,j->ni", fast.R_WS, DOWN))
    return Motion(
        t,
        fast.R_WS,
        fast.p_WS,
        acceleration - np.einsum("nji,j->ni", fast.R_WS, GRAVITY_W),
        0.5 * fast.omega,
        0.25 * fast.alpha,
    )


def record(kind: Kind) -> tuple[np.ndarray, np.ndarray, Poses]:
    rng = np.random.default_rng(kind.seed)
    t = np.arange(0.0, SECONDS, 1 / kind.wrench_rate)
    at = motion_at(t)
    wrench = non_contact_wrench(at.specific_force, at.omega, at.alpha, PHI)
    wrench = wrench @ (np.eye(6) + kind.gain * rng.normal(size=(6, 6)) * UNITS).T
    wrench = wrench + OFFSETS + np.repeat([0.1, 0.004], 3) * rng.normal(size=wrench.shape)
    # Stamps jitter; each pose belongs to its stamp, except for the delay.
    stamps = np.arange(0.0, SECONDS, 1 / kind.rate)
    stamps += rng.uniform(-0.2, 0.2, len(stamps)) / kind.rate
    posed = motion_at(stamps - LATE)
    noise = rng.normal(size=(len(stamps), 6))
    if kind.colour:
        noise = np.sqrt(1 - kind.colour**2) * lfilter([1.0], [1.0, -kind.colour], noise, axis=0)
    R = posed.R_WS @ (TURN if kind.turned else np.eye(3))
    R = R @ rotation_matrices(kind.turn * noise[:, 3:], "rotation_vector")
    place = posed.p_WS + posed.R_WS @ np.array(kind.p_SoPo_S) + kind.place * noise[:, :3]
    return t, wrench, Poses(stamps, place, quaternions(R))


UNITS = np.outer(np.repeat([1.0, 0.06], 3), 1 / np.repeat([1.0, 0.06], 3))
