"""The sampled axis as a discrete linear system: closed, or the two-port without hand and wall."""

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
    """x[k+1] = A x[k] + B u[k], y[k] = C x[k] + D u[k] over the period of all rates.

    Outputs are those at the beginning of a period, before its updates. Inputs are held: what the
    hand pushes beyond its impedance, and what the slave exerts beyond the wall [N].

    Args:
        A, B, C, D: (..., n, n), (..., n, 2), (..., 5, n), (..., 5, 2).
        period: [s].
        states: their names.
    """

    A: Array
    B: Array
    C: Array
    D: Array
    period: float
    states: tuple[str, ...]
    inputs: tuple[str, ...] = INPUTS
    outputs: tuple[str, ...] = OUTPUTS

    def to_control(self) -> Any:
        """The same as a discrete `control.StateSpace` with named signals."""
        import control

        return control.ss(
            self.A, self.B, self.C, self.D, self.period,
            states=list(self.states), inputs=list(self.inputs), outputs=list(self.outputs),
        )  # fmt: skip


def sampled_loop(axis: OneAxis, sampling: Sampling) -> SampledLoop:
    """The closed loop over the period that all rates have in common.

    Args:
        axis: its delay must be one number; it is rounded as the channel does.
        sampling: the rates.

    Raises:
        DrakeTeleopError: for an ideal servo, or rates without a common period.
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
    """Eigenvalues of the map over one period, (..., n), of a `SampledLoop` or `StateSpace`."""
    return np.linalg.eigvals(system.A).astype(np.complex128)


def growth_rate(system: Any) -> Any:
    """How fast a perturbation grows in the end, negative if it decays [1/s], (...).

    Args:
        system: a `SampledLoop` or a discrete `control.StateSpace`.
    """
    period = system.period if isinstance(system, SampledLoop) else system.dt
    return np.log(np.abs(multipliers(system)).max(axis=-1)) / period


def sampled_response(system: Any, frequency: ArrayLike) -> Complex:
    """C (z - A)^-1 B + D at z = e^(j w T).

    Args:
        system: one `SampledLoop` or discrete `control.StateSpace`.
        frequency: (N,) w [rad/s].

    Returns:
        (N, outputs, inputs).
    """
    period = system.period if isinstance(system, SampledLoop) else system.dt
    z = np.exp(1j * np.atleast_1d(np.asarray(frequency, dtype=float)) * period)
    return _resolvent(system.A, system.B, system.C, z) + system.D


def sampled_two_port(axis: OneAxis, sampling: Sampling, frequency: ArrayLike) -> Complex:
    """H of [F_h; -V_s] = H [V_m; F_e] between a held hand force, a held environment and samples.

    Forces are taken by the share of a held one that is of the frequency itself: the spectrum of the
    hold, (1 - e^(-j w T)) / (j w T), is divided out. What is left of the continuous H's difference
    are the station's own holds and samples.

    Args:
        axis: hand and wall do not belong to the two-port and are left out; the delay, one number,
            is rounded as the channel does.
        sampling: the rates.
        frequency: (N,) w [rad/s], not zero, below half the hand's rate.

    Returns:
        (N, 2, 2) [N s/m, 1; 1, m/(N s)].

    Raises:
        DrakeTeleopError: as `cut_loop`.
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
    late = z ** -delay_steps(axis, sampling)
    # Without delay, of the device's own force and of the environment's.
    C = np.eye(n)[[V_M, V_S, SAMPLE]]
    response = _resolvent(M[:n, :n], M[:n, n : n + 2], C, z)
    (v_m, _), (v_s, give), (felt, felt_e) = np.moveaxis(response, 0, 2)
    hold = -np.expm1(-1j * w * period) / (1j * w * period)
    H = np.array(
        [
            [hold * (1 + late**2 * felt) / v_m, late * felt_e],
            [-late * v_s / v_m, -give / hold],
        ]
    )
    return np.moveaxis(H, 2, 0)


def _resolvent(A: Array, B: Array, C: Array, z: Complex) -> Complex:
    """C (z - A)^-1 B, (N, p, m) at z (N,): by A's Schur form, triangular for every z."""
    balanced, (scale, _) = matrix_balance(A, permute=False, separate=True)
    T, Q = schur(balanced, output="complex")
    right, left = Q.conj().T @ (B / scale[:, None]), (C * scale) @ Q
    states = np.empty((len(T), len(z), right.shape[1]), complex)
    for i in reversed(range(len(T))):
        known = right[i] + np.tensordot(T[i, i + 1 :], states[i + 1 :], 1)
        states[i] = known / (z - T[i, i])[:, None]
    return np.moveaxis(np.tensordot(left, states, 1), 1, 0)
