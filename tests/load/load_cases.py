"""Loads and motions that several tests use."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from drake_teleop.load.inertia import phi_from_mass_com_inertia, phi_from_pseudo_inertia

TOOL = phi_from_mass_com_inertia(
    3.13,
    [0.004, -0.003, 0.085],
    [[0.0140, 0.0002, -0.0004], [0.0002, 0.0135, 0.0003], [-0.0004, 0.0003, 0.0060]],
)
OFFSETS = np.array([9.1, -1.0, 10.0, 0.43, -0.69, -0.16])


def vectors(n: int, largest: float = 10.0):
    """Return a strategy for (n,) numbers up to `largest`."""
    return arrays(np.float64, n, elements=st.floats(-largest, largest, allow_subnormal=False))


def motions():
    """Return a strategy for motions (s, omega, alpha), each (3,)."""
    return st.tuples(vectors(3, 30.0), vectors(3), vectors(3, 50.0))


def loads():
    """Return a strategy for (10,) phi of possible bodies from 0.1 kg, also points and plates."""
    bead = np.diag([0.0, 0.0, 0.0, 0.1])
    return arrays(np.float64, (4, 4), elements=st.floats(-1.0, 1.0, allow_subnormal=False)).map(
        lambda root: phi_from_pseudo_inertia(root @ root.T + bead)
    )


def rotations():
    """Return a strategy for (3, 3) rotation matrices."""

    def from_quaternion(q):
        norm = np.linalg.norm(q)
        w, x, y, z = q / norm if norm > 0.1 else (1.0, 0.0, 0.0, 0.0)
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )

    return vectors(4, 1.0).map(from_quaternion)


def rich_motion(samples: int, seed: int = 0):
    """Return (s, omega, alpha), each (samples, 3): slow sines that rotate about all axes.

    s is not that of a body under gravity, which least squares does not require.
    """
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 2.0 * np.pi, samples, endpoint=False)
    harmonics = np.arange(1, 6)
    phase = rng.uniform(0.0, 2.0 * np.pi, (9, 5))
    sines = np.sin(t[:, None, None] * harmonics + phase).sum(axis=2) / np.sqrt(5.0)
    return 10.0 * sines[:, :3], 3.0 * sines[:, 3:6], 15.0 * sines[:, 6:]
