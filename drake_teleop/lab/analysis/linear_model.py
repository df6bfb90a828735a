"""Linear model of a station over one hand period, with delayed feedback loops."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.lab.analysis.one_axis import Complex

COMPONENT_NAMES = ("x", "y", "z", "rx", "ry", "rz")
_MAX_STATES_FOR_DENSE_EIGENVALUES = 800  # states; more need the sparse eigenvalue search
MAX_STATES = 8000  #: largest number of states, delay included, for multipliers
_EIGENVALUES_PER_SHIFT = 40


@dataclass(frozen=True, eq=False)
class Linearization:
    """Linear model x[k+1] = A x + B u, y = C x + D u of one period, and delayed feedback loops.

    Components of a port are "port.x", ..., "port.rz": poses as translation [m] and rotation vector
    [rad], wrenches [N, N m], twists [m/s, rad/s].
    """

    A: Array
    B: Array
    C: Array
    D: Array
    dt: float  #: period [s]
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    #: (outputs, inputs, periods) closed with a delay: u += z^-periods y
    loops: tuple[tuple[tuple[int, ...], tuple[int, ...], int], ...] = ()

    def close_loop(
        self, outputs: str | Sequence[str], inputs: str | Sequence[str], periods: int = 0
    ) -> Linearization:
        """Return the model with the feedback u += z^-periods y of outputs y to inputs u."""
        rows = self._component_indices(outputs, self.outputs)
        columns = self._component_indices(inputs, self.inputs)
        if periods > 0:
            return dataclasses.replace(self, loops=(*self.loops, (rows, columns, periods)))
        return dataclasses.replace(self, A=self.A + self.B[:, columns] @ self.C[list(rows)])

    def frequency_response(self, omega: Array) -> Complex:
        """Return the response (n, outputs, inputs) at `omega` (n,) [rad/s], with closed loops."""
        z = np.exp(1j * np.asarray(omega, dtype=float) * self.dt)
        identity = np.eye(len(self.A))
        # Solve for each frequency: a chain of delays has no basis of eigenvectors.
        states = [np.linalg.solve(w * identity - self.A, self.B.astype(complex)) for w in z]
        G: Complex = self.C @ np.stack(states) + self.D
        for rows, columns, periods in self.loops:
            delay = z[:, None, None] ** -periods
            L = delay * G[:, list(rows)][:, :, list(columns)]
            back = np.linalg.solve(np.eye(len(rows)) - L, delay * G[:, list(rows)])
            G = G + G[:, :, list(columns)] @ back
        return G

    @property
    def multipliers(self) -> Complex:
        """Eigenvalues over one period, by falling magnitude; stable if all magnitudes are below 1.

        With more than 800 states only those near the unit circle with angles below 100 Hz.
        """
        A, size = self._state_matrix_with_delays(), self.num_states
        if size <= _MAX_STATES_FOR_DENSE_EIGENVALUES:
            values = np.linalg.eigvals(A.toarray())
        elif size > MAX_STATES:
            what = f"this delay requires {size} states (maximum {MAX_STATES})"
            remedy = "shorten it, or call count_unstable_multipliers(cut_loop(axis, ...), delay)"
            raise DrakeTeleopError(what, where="channel.delay", remedy=remedy)
        else:
            max_angle_rad = 2 * np.pi * 100.0 * self.dt
            values = _find_eigenvalues_near_unit_circle(A.astype(complex).tocsc(), max_angle_rad)
        return values[np.argsort(-np.abs(values))].astype(complex)

    @property
    def num_states(self) -> int:
        return len(self.A) + sum(len(rows) * periods for rows, _, periods in self.loops)

    def _state_matrix_with_delays(self) -> Any:
        from scipy.sparse import lil_array

        n = end = len(self.A)
        A = lil_array((self.num_states, self.num_states))
        A[:n, :n] = self.A
        for rows, columns, periods in self.loops:
            start, width = end, len(rows)
            end = start + width * periods
            A[start : start + width, :n] = self.C[list(rows)]
            A[:n, end - width : end] = self.B[:, columns]
            for k in range(start + width, end):
                A[k, k - width] = 1.0
        return A

    def with_delays_as_states(self) -> Linearization:
        """Return the model with each delay as a shift register among the states."""
        A = self._state_matrix_with_delays().toarray()
        delays = len(A) - len(self.A)
        names = [
            f"delayed {self.outputs[row]} {k + 1}"
            for rows, _, periods in self.loops
            for k in range(periods)
            for row in rows
        ]
        B, C = np.pad(self.B, ((0, delays), (0, 0))), np.pad(self.C, ((0, 0), (0, delays)))
        return dataclasses.replace(self, A=A, B=B, C=C, states=(*self.states, *names), loops=())

    def to_control(self) -> Any:
        """Return a discrete `control.StateSpace`; the name "port.x" becomes "port[x]"."""
        import control

        system = self.with_delays_as_states()
        return control.StateSpace(
            *(system.A, system.B, system.C, system.D, system.dt),
            # python-control rejects dots in the names of inputs and outputs.
            inputs=[_bracketed_port_name(name) for name in system.inputs],
            outputs=[_bracketed_port_name(name) for name in system.outputs],
            states=list(system.states),
        )

    @staticmethod
    def _component_indices(names: str | Sequence[str], known: tuple[str, ...]) -> tuple[int, ...]:
        parts = port_component_names(names) if isinstance(names, str) else names
        if missing := [name for name in parts if name not in known]:
            ports = sorted({name.rpartition(".")[0] or name for name in known})
            what = f"'{missing[0]}' is no port or component of this model"
            remedy = f"name one of {', '.join(ports)}, or list components, as ['{known[0]}']"
            raise DrakeTeleopError(what, where="close_loop", remedy=remedy)
        return tuple(known.index(name) for name in parts)


def _bracketed_port_name(name: str) -> str:
    port, dot, part = name.rpartition(".")
    return f"{port}[{part}]" if dot else name


def _find_eigenvalues_near_unit_circle(A: Any, max_angle_rad: float) -> Complex:
    from scipy.sparse.linalg import eigs

    start = np.random.default_rng(0).standard_normal(A.shape[0]).astype(complex)
    found, angle = np.zeros(0, dtype=complex), 0.0
    while angle < max_angle_rad:
        # Beside the circle, so that no shift is an eigenvalue.
        shift = 1.0005 * np.exp(1j * angle)
        values = eigs(A, _EIGENVALUES_PER_SHIFT, sigma=shift, v0=start, return_eigenvectors=False)
        known = np.abs(values[:, None] - found).min(axis=1, initial=np.inf) < 1e-9
        found = np.concatenate([found, values[~known]])
        angle = max(float(np.angle(values).max()), angle + 1e-4)
    return found


def port_component_names(*ports: str) -> tuple[str, ...]:
    return tuple(f"{port}.{axis}" for port in ports for axis in COMPONENT_NAMES)
