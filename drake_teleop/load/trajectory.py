"""Joint trajectories as Fourier series, to excite the load's parameters, Eqs. (9)-(10)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import write_text
from drake_teleop.common.numeric import Array

_FILE_FIELDS, _FIELDS_PER_JOINT = {"frequency", "joints"}, {"q0", "rho", "delta"}
_MAX_ABSOLUTE_VALUE_IN_FILE = 1e6  # of any number in a file [rad, Hz]


@dataclass(frozen=True)
class FourierTrajectory:
    """Periodic trajectory of n joints with N harmonics, Eqs. (9)-(10).

    Attributes:
        q0: (n,) constant part [rad].
        rho, delta: (n, N) sine and cosine coefficients [rad].
        frequency: base frequency [Hz].
    """

    q0: Array
    rho: Array
    delta: Array
    frequency: float

    @classmethod
    def rest_to_rest(
        cls, q0: ArrayLike, sine: ArrayLike, cosine: ArrayLike, frequency: float
    ) -> FourierTrajectory:
        """Return a trajectory with velocity and acceleration 0 at both ends, Eq. (T17).

        `sine` and `cosine` (n, N - 1) [rad] are free coefficients; harmonic k is divided by k.
        """
        sine, cosine = np.asarray(sine, float), np.asarray(cosine, float)
        k = np.arange(1.0, sine.shape[-1] + 2)[:, np.newaxis]
        # Bases of the coefficients whose sums, plain or weighted by k, are zero.
        bases = [np.linalg.qr(weights, mode="complete")[0][:, 1:] for weights in (k**0, k)]
        rho, delta = sine @ (bases[0] / k).T, cosine @ (bases[1] / k).T
        return cls(np.asarray(q0, float), rho, delta, frequency)

    @property
    def period(self) -> float:
        return 1.0 / self.frequency

    def evaluate(self, t: ArrayLike) -> tuple[Array, Array, Array]:
        """Return joint position, velocity and acceleration (..., n) at times t (...) [rad, s]."""
        rate = 2 * np.pi * self.frequency * np.arange(1, self.rho.shape[1] + 1)
        phase = np.multiply.outer(np.asarray(t, float), rate)
        sine, cosine = np.sin(phase), np.cos(phase)
        rho, delta = self.rho.T, self.delta.T
        q = self.q0 + sine @ rho + cosine @ delta
        qd = (rate * cosine) @ rho - (rate * sine) @ delta
        qdd = -(rate**2 * sine) @ rho - (rate**2 * cosine) @ delta
        return q, qd, qdd

    def with_scaled_amplitudes(self, factor: float) -> FourierTrajectory:
        return FourierTrajectory(self.q0, factor * self.rho, factor * self.delta, self.frequency)

    def save(self, path: str | Path, joint_names: tuple[str, ...]) -> None:
        from drake_teleop.common.texts import to_yaml_text

        joints = {
            name: {"q0": float(q0), "rho": rho.tolist(), "delta": delta.tolist()}
            for name, q0, rho, delta in zip(joint_names, self.q0, self.rho, self.delta, strict=True)
        }
        data = {"frequency": float(self.frequency), "joints": joints}
        write_text(Path(path), to_yaml_text(data, head=["Eqs. (9)-(10), rad and Hz."]))

    @classmethod
    def load(cls, path: str | Path) -> FourierTrajectory:
        from drake_teleop.common.texts import read_yaml

        data, where = read_yaml(path), str(path)
        remedy = "give each joint one q0, and one rho and delta per harmonic"
        try:
            joints = list(data["joints"].values())
            parts = [(data, _FILE_FIELDS), *((joint, _FIELDS_PER_JOINT) for joint in joints)]
            for fields, known in parts:
                if unknown := sorted(fields.keys() - known):
                    what = f"there is no field '{unknown[0]}'"
                    names = ", ".join(sorted(known))
                    raise DrakeTeleopError(what, where=where, remedy=f"the fields are {names}")
            columns = ([joint[name] for joint in joints] for name in ("q0", "rho", "delta"))
            q0, rho, delta = (np.array(column, dtype=float) for column in columns)
            frequency = float(data["frequency"])
        except KeyError as error:
            what, remedy = f"{error} is missing", "give q0, rho, delta and frequency"
            raise DrakeTeleopError(what, where=where, remedy=remedy) from None
        except DrakeTeleopError:
            raise
        except (AttributeError, TypeError, ValueError) as error:
            what = f"is not a trajectory ({error})"
            raise DrakeTeleopError(what, where=where, remedy=remedy) from None
        if not (q0.ndim == 1 and rho.ndim == 2 and rho.shape == delta.shape):
            what = f"q0, rho and delta have the shapes {q0.shape}, {rho.shape} and {delta.shape}"
            raise DrakeTeleopError(what, where=where, remedy=remedy)
        numbers = np.concatenate([q0.ravel(), rho.ravel(), delta.ravel(), [frequency]])
        wrong = numbers[~(np.abs(numbers) <= _MAX_ABSOLUTE_VALUE_IN_FILE)]
        if len(wrong):
            what = f"contains {wrong[0]:g}, outside +-{_MAX_ABSOLUTE_VALUE_IN_FILE:g}"
            raise DrakeTeleopError(what, where=where, remedy="give angles in rad, Hz")
        if not frequency > 0:
            what, remedy = f"{frequency:g} Hz is not above 0", "give the frequency of a motion"
            raise DrakeTeleopError(what, where=f"{where}:frequency", remedy=remedy)
        return cls(q0, rho, delta, frequency)
