"""Rigid load and sensor paths in closed form, for `cause_records.py`.

Newton and Euler's equations about the load's centre of mass give its wrench, without the package.
Frame S is the sensor's. The wrench is that of the sensor on the load. Names that end with `_W` are
of the base.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Span = tuple[float, float]
Rng = np.random.Generator


@dataclass(frozen=True)
class Motion:
    """Motion of S: R_WS (N, 3, 3), p_WS (N, 3), and in S omega, alpha, acceleration a of So."""

    R: Array
    p: Array
    omega: Array
    alpha: Array
    a: Array

    def displaced(self, r: Array) -> Motion:
        """Return the motion of the frame parallel to S whose origin is at r (3,) in S."""
        turning = np.cross(self.omega, np.cross(self.omega, r))
        a = self.a + np.cross(self.alpha, r) + turning
        return Motion(self.R, self.p + self.R @ r, self.omega, self.alpha, a)

    def in_S(self, vector_W: Array) -> Array:
        """Return vectors of the base, (3,) or (N, 3), in S (N, 3)."""
        rows = np.broadcast_to(vector_W, self.p.shape)
        return np.asarray(np.einsum("nji,nj->ni", self.R, rows))

    def specific_force(self, gravity_W: Array) -> Array:
        return self.a - self.in_S(gravity_W)


Path_W = Callable[[Array], Motion]


@dataclass(frozen=True)
class Load:
    """Rigid load: mass [kg], centre of mass in S [m], inertia about it [kg m^2]."""

    mass: float
    com: Array
    inertia: Array

    def wrench(self, motion: Motion, gravity_W: Array) -> Array:
        """Return the wrench (N, 6) [f; tau] about So that the sensor exerts on the load."""
        c, omega = np.broadcast_to(self.com, motion.p.shape), motion.omega
        force = self.mass * motion.displaced(self.com).specific_force(gravity_W)
        spin = motion.alpha @ self.inertia.T + np.cross(omega, omega @ self.inertia.T)
        return np.hstack([force, np.cross(c, force) + spin])

    def weight(self, motion: Motion, gravity_W: Array) -> Array:
        """Return the wrench (N, 6) of the load at rest in each pose."""
        force = -self.mass * motion.in_S(gravity_W)
        return np.hstack([force, np.cross(np.broadcast_to(self.com, force.shape), force)])

    @property
    def phi(self) -> Array:
        """Return (10,) [m, m c, I about So: xx xy xz yy yz zz]."""
        c = self.com
        about_So = self.inertia + self.mass * (c @ c * np.eye(3) - np.outer(c, c))
        return np.array([self.mass, *(self.mass * c), *about_So[np.triu_indices(3)]])

    def with_object(self, other: Load) -> Load:
        """Return both loads as one body."""
        mass = self.mass + other.mass
        com = (self.mass * self.com + other.mass * other.com) / mass
        inertia = np.zeros((3, 3))
        for part in (self, other):
            d = part.com - com
            inertia = inertia + part.inertia + part.mass * (d @ d * np.eye(3) - np.outer(d, d))
        return Load(mass, com, inertia)


def direction(rng: Rng) -> Array:
    """Return a random vector (3,) of length 1."""
    x = rng.normal(size=3)
    return np.asarray(x / np.linalg.norm(x))


def random_load(rng: Rng, mass: float, reach: Span = (0.02, 0.1)) -> Load:
    """Draw a load with its centre within `reach` of So and radii of gyration of 10 to 50 mm."""
    x = rng.uniform(0.01, 0.05, 3) ** 2
    axes = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    inertia = mass * axes @ np.diag(x.sum() - x) @ axes.T
    return Load(mass, rng.uniform(*reach) * direction(rng), inertia)


def _home(rng: Rng) -> Rotation:
    """Draw an orientation in which the tool points down within 40 deg."""
    tilt = np.radians(rng.uniform(0, 40)) * direction(rng)
    return Rotation.from_euler("zx", [rng.uniform(-180, 180), 180], degrees=True) * (
        Rotation.from_rotvec(tilt)
    )


def _series(rng: Rng, frequency: float, size: float) -> Callable[[Array], tuple[Array, ...]]:
    """Draw five harmonics with the largest value `size`; return value and two derivatives."""
    w = 2 * np.pi * frequency * np.arange(1, 6)
    phase, a = rng.uniform(-np.pi, np.pi, 5), rng.uniform(0.3, 1.0, 5)
    a *= size / np.abs(np.sin(np.outer(np.linspace(0, 1 / frequency, 400), w) + phase) @ a).max()

    def at(t: Array) -> tuple[Array, ...]:
        s, c = np.sin(np.outer(t, w) + phase), np.cos(np.outer(t, w) + phase)
        return s @ a, c @ (a * w), -s @ (a * w * w)

    return at


def _chain(
    home: Rotation, axes: Array, angles: list[tuple[Array, ...]], p: Array, a_W: Array
) -> Motion:
    """Compose rotations by `angles` about `axes`, each in the frame of the one before it."""
    n = len(p)
    R, (omega, alpha) = np.broadcast_to(home.as_matrix(), (n, 3, 3)), np.zeros((2, n, 3))
    for axis, (q, v, vdot) in zip(axes, angles, strict=True):
        turn = Rotation.from_rotvec(np.outer(q, axis)).as_matrix()
        rate = np.outer(v, axis)
        alpha = alpha + np.outer(vdot, axis) + np.cross(omega, rate)
        omega, alpha = (np.einsum("nji,nj->ni", turn, x) for x in (omega + rate, alpha))
        R = R @ turn
    return Motion(R, p, omega, alpha, np.einsum("nji,nj->ni", R, a_W))


def fourier(rng: Rng, span: float, *, slow: bool = False) -> Path_W:
    """Draw five harmonics of 0.1 to 0.17 Hz for each of six degrees of freedom."""
    home, size = _home(rng), 0.9 if slow else rng.uniform(0.6, 1.3)
    frequency = rng.uniform(0.02, 0.03) if slow else rng.uniform(0.1, 0.17)
    turn, place = (2.0, 0.3) if slow else (np.radians(45), 0.2)
    angles = [_series(rng, frequency, size * turn) for _ in range(3)]
    places = [_series(rng, frequency, size * place) for _ in range(3)]

    def at(t: Array) -> Motion:
        p, _, a = (np.array(x).T for x in zip(*(series(t) for series in places), strict=True))
        return _chain(home, np.eye(3)[::-1], [series(t) for series in angles], 0.5 + p, a)

    return at


def _minimum_jerk(x: Array, seconds: float) -> tuple[Array, ...]:
    """Return the minimum-jerk step from 0 to 1 and its two derivatives in time."""
    return (
        x**3 * (10 - 15 * x + 6 * x**2),
        30 * (x * (1 - x)) ** 2 / seconds,
        60 * x * (1 - x) * (1 - 2 * x) / seconds**2,
    )


def pick(rng: Rng, span: float) -> Path_W:
    """Draw moves of 0.6 to 1.2 s with rotations of 20 to 90 deg, and rests of 0.5 to 1.5 s."""
    home = now = _home(rng)
    place, start = 0.5 + rng.uniform(-0.2, 0.2, 3), rng.uniform(0.3, 1.0)
    moves = []
    while start < span + 1.0:
        seconds = rng.uniform(0.6, 1.2)
        angle = 0.0
        while not np.radians(20) < angle < np.radians(90):
            goal = home * Rotation.from_rotvec(rng.uniform(0.2, 1.2) * direction(rng))
            turn = (now.inv() * goal).as_rotvec()
            angle = float(np.linalg.norm(turn))
        target = 0.5 + rng.uniform(-0.2, 0.2, 3)
        moves.append((start, seconds, now, turn, place, target - place))
        now, place, start = goal, target, start + seconds + rng.uniform(0.5, 1.5)

    def at(t: Array) -> Motion:
        R, rest = np.zeros((len(t), 3, 3)), np.zeros((4, len(t), 3))
        edges = [0, *np.searchsorted(t, [move[0] for move in moves[1:]]), len(t)]
        for k, (begin, seconds, before, turn, from_W, step) in enumerate(moves):
            part = slice(edges[k], edges[k + 1])
            x, v, vdot = _minimum_jerk(np.clip((t[part] - begin) / seconds, 0, 1), seconds)
            R[part] = (before * Rotation.from_rotvec(np.outer(x, turn))).as_matrix()
            rest[0][part] = from_W + np.outer(x, step)
            rest[1][part], rest[2][part] = np.outer(v, turn), np.outer(vdot, turn)
            rest[3][part] = np.outer(vdot, step)
        p, omega, alpha, a_W = rest
        return Motion(R, p, omega, alpha, np.einsum("nji,nj->ni", R, a_W))

    return at


def wrist(rng: Rng, path: Path_W, span: float, series: bool) -> Path_W:
    """Rotate about one horizontal or skew axis alone, 100 to 200 mm from So."""
    home, (x, y) = _home(rng), rng.normal(size=2)
    axis_W = np.array([x, y, 0.0 if rng.random() < 0.5 else rng.uniform(-1, 1)])
    axis = home.inv().apply(axis_W / np.linalg.norm(axis_W))
    r = np.cross(axis, direction(rng))
    r *= rng.uniform(0.1, 0.2) / np.linalg.norm(r)
    turn = _series(rng, 0.1, np.radians(rng.uniform(50, 100)))
    goals = np.radians(rng.uniform(-80, 80, 1 + int(span)))
    starts = 0.4 + 1.8 * np.arange(len(goals))

    def moves(t: Array) -> tuple[Array, ...]:
        steps = np.diff(goals, prepend=0.0)
        parts = [_minimum_jerk(np.clip((t - start) / 1.0, 0, 1), 1.0) for start in starts]
        return tuple(np.tensordot(steps, np.array(x), 1) for x in zip(*parts, strict=True))

    def at(t: Array) -> Motion:
        still = np.zeros((len(t), 3))
        angles = [turn(t) if series else moves(t)]
        return _chain(home, axis[None], angles, 0.5 + still, still).displaced(r)

    return at


MOTIONS: dict[str, Callable[..., Path_W]] = {
    "fourier": fourier,
    "pick": pick,
    "slow": lambda rng, span: fourier(rng, span, slow=True),
}
