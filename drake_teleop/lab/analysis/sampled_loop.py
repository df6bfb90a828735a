"""Sampled one-axis model as a linear system: closed loop, or two-port without hand and wall."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import matrix_balance, schur

from drake_teleop.lab.analysis.one_axis import Complex, OneAxis
from drake_teleop.lab.analysis.period_map import (
    FILTER,
    SAMPLE,
    V_M,
    V_S,
    X_M,
    X_S,
    Array,
    Sampling,
    cut_map,
    delay_steps,
    period_map,
)

INPUTS = ("hand_force", "environment_force")
OUTPUTS = ("x_m", "v_m", "x_s", "v_s", "felt_force")
_MOTION = ("x_m", "v_m", "servo_acceleration", "x_s", "v_s", "sample")


@dataclass(frozen=True)
class SampledLoop:
    """System x[k+1] = A x[k] + B u[k], y[k] = C x[k] + D u[k] over the common period of all rates.

    Outputs are sampled before the updates. Inputs are held additional forces [N]: of the hand on
    the device, and of the slave on the environment.
    """

    A: Array  #: (..., n, n)
    B: Array  #: (..., n, 2)
    C: Array  #: (..., 5, n)
    D: Array  #: (..., 5, 2)
    period: float  #: s
    states: tuple[str, ...]
    inputs: tuple[str, ...] = INPUTS
    outputs: tuple[str, ...] = OUTPUTS

    def to_control(self) -> Any:
        """Return a discrete `control.StateSpace` with named signals."""
        import control

        return control.ss(
            self.A, self.B, self.C, self.D, self.period,
            states=list(self.states), inputs=list(self.inputs), outputs=list(self.outputs),
        )  # fmt: skip


def sampled_loop(axis: OneAxis, sampling: Sampling) -> SampledLoop:
    """Return the closed loop of the sampled model over the common period of all rates.

    `axis.delay` must be a scalar; it is rounded to hand periods.
    """
    steps = delay_steps(axis, sampling)
    M, periods = period_map(axis, sampling, steps, cut=False)
    n = M.shape[-1] - 3
    lines = [f"{line}_{i + 1}" for line in ("command", "wrench") for i in range(steps)]
    filters = [f"low_pass_{i + 1}" for i in range(n - FILTER - 2 * steps)]
    C = np.zeros((len(OUTPUTS), n))
    C[range(5), [X_M, V_M, X_S, V_S, SAMPLE if steps == 0 else n - 1]] = 1.0
    return SampledLoop(
        M[..., :n, :n],
        M[..., :n, n : n + 2],
        C,
        np.zeros((len(OUTPUTS), 2)),
        periods / sampling.hand_hz,
        (*_MOTION, *filters, *lines),
    )


def multipliers(system: Any) -> Complex:
    """Return the eigenvalues (..., n) over one period of a `SampledLoop` or `StateSpace`."""
    return np.linalg.eigvals(system.A).astype(np.complex128)


def growth_rate(system: Any) -> Any:
    """Return the growth rate [1/s] of the slowest-decaying motion; negative: stable.

    `system` is a `SampledLoop` or a discrete `StateSpace`.
    """
    period = system.period if isinstance(system, SampledLoop) else system.dt
    return np.log(np.abs(multipliers(system)).max(axis=-1)) / period


def sampled_two_port(axis: OneAxis, sampling: Sampling, frequency: ArrayLike) -> Complex:
    """Return the two-port H (N, 2, 2) of the sampled station, without hand and wall.

    The spectrum of held forces is divided out; the delay is rounded to hand periods. `frequency`
    (N,) [rad/s]: positive, below half the hand's rate.
    """
    bare = replace(
        axis,
        hand_mass=0.0,
        hand_damping=0.0,
        hand_stiffness=0.0,
        wall_stiffness=0.0,
        wall_damping=0.0,
    )
    M = cut_map(bare, sampling)
    n, period = M.shape[-1] - 3, 1 / sampling.hand_hz
    w = np.atleast_1d(np.asarray(frequency, dtype=float))
    z = np.exp(1j * w * period)
    delay_factor = z ** -delay_steps(axis, sampling)
    # Responses without delay to a force on the device, and to one of the environment.
    C = np.eye(n)[[V_M, V_S, SAMPLE]]
    response = _resolvent(M[:n, :n], M[:n, n : n + 2], C, z)
    (v_m, _), (v_s, give), (felt, felt_e) = np.moveaxis(response, 0, 2)
    hold = -np.expm1(-1j * w * period) / (1j * w * period)
    H = np.array(
        [
            [hold * (1 + delay_factor**2 * felt) / v_m, delay_factor * felt_e],
            [-delay_factor * v_s / v_m, -give / hold],
        ]
    )
    return np.moveaxis(H, 2, 0)


def _resolvent(A: Array, B: Array, C: Array, z: Complex) -> Complex:
    """Return C (z - A)^-1 B (N, p, m) at z (N,)."""
    balanced, (scale, _) = matrix_balance(A, permute=False, separate=True)
    T, Q = schur(balanced, output="complex")
    right, left = Q.conj().T @ (B / scale[:, None]), (C * scale) @ Q
    states = np.empty((len(T), len(z), right.shape[1]), complex)
    for i in reversed(range(len(T))):
        known = right[i] + np.tensordot(T[i, i + 1 :], states[i + 1 :], 1)
        states[i] = known / (z - T[i, i])[:, None]
    return np.moveaxis(np.tensordot(left, states, 1), 1, 0)
