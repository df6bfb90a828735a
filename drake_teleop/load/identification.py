"""Identifying the load and the sensor's offsets from a record: batch least squares, Eqs. (7)-(8).

The measured wrench of a free motion is F = [E V] [F_o; phi] + residual. `NormalEquations` sums what
least squares needs over any number of samples, chunk by chunk, and never builds the stacked matrix.

**What is reported as known.** A load is known to the extent that the motion excited it, and least
squares gives numbers for the rest too. Two steps decide what `Identification.identifiable` says:

1. Columns are scaled to unit norm and the Gram matrix is decomposed. Directions with an eigenvalue
   below 1e-12 of the largest are undetermined: that is 1e-6 in terms of the regressor, which no
   sensor resolves, and where the rounding of the sums begins. The solution has no component there
   (minimum norm), and a parameter that has one is undetermined: its variance is infinite.
2. The standard deviations must be honest, and small enough for the value to mean something.
   Residuals of real records are coloured (filters, vibration, drift), so that N samples are worth
   far fewer. The variance of each channel is therefore taken from the means of blocks of samples:
   for white noise, (block length) x (variance of block means) is the variance of the samples
   whatever the length; for coloured noise it grows with the length until the blocks are longer than
   the memory of the noise. The largest value over the lengths 1, 2, 4, ... that leave at least 16
   blocks is used (batch means; the effective number of samples is N times the ratio of the
   two variances). A parameter is identifiable if its standard deviation is at most 5 % of what
   is natural for a load of this mass m and size L (centre of mass from So, at least 3 cm):
   m g and m g L for the offsets, m, m L for the first moments, and m L^2 / 3 for the inertia,
   which is what a rod from So to as far again beyond the centre of mass has about the latter.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.load.arrays import Array, checked, checked_rows
from drake_teleop.load.inertia import is_physically_consistent, mass_com_inertia
from drake_teleop.load.regressor import regressor_into

PARAMETERS = (
    *("f_ox", "f_oy", "f_oz", "tau_ox", "tau_oy", "tau_oz"),
    *("m", "m c_x", "m c_y", "m c_z", "I_xx", "I_xy", "I_xz", "I_yy", "I_yz", "I_zz"),
)
"""Names of the 16 parameters in the order of Eq. (7): [offsets; phi]."""

METHODS = (
    *("batch least squares", "recursive least squares"),
    *("whitened least squares", "robust least squares", "physically consistent least squares"),
    *("total least squares", "recursive instrumental variables", "recursive total least squares"),
)
"""What `Identification.method` may say."""

# Rank: smallest eigenvalue of the scaled Gram over the largest, component of a parameter in the
# null space, and excitation of a column [m/s^2, rad/s^2] below which it counts as none.
_RANK, _NULL_COMPONENT, _NO_EXCITATION = 1e-12, 1e-6, 1e-9
# Worth stating: standard deviation over natural scale, smallest size of a load [m], gravity.
_WORTH_STATING, _SMALLEST_SIZE, _GRAVITY = 0.05, 0.03, 9.81
_MOST_BLOCKS, _FEWEST_BLOCKS = 512, 16
_FEWEST_SAMPLES = 3
# Where the wrench and the factors of [offset, phi] stand in x of the sums.
_WRENCH, _MODEL = 1, np.array([0, *range(2, 12)])


@dataclass(frozen=True, eq=False)
class Identification:
    """An identified load; what identification.json holds.

    Attributes:
        phi: (10,) the load about So in S [kg, kg m, kg m^2].
        offsets: (6,) of the force-torque sensor [N, N m].
        covariance: (16, 16) of [offsets; phi], Eq. (7), in SI. The variance of an undetermined
            parameter is inf and its covariances are 0; in the file inf is null.
        identifiable: (16,) bools, whether the record determines the parameter well enough for its
            value to mean something (the rule is in the module's docstring).
        condition_number: of the regressor [E V] of Eq. (8) with its 16 columns scaled to unit norm
            (and rows by the noise), over the directions that the record determines.
        delay_s: how much later the motion was recorded than the wrench [s].
        residual_rms: (6,) of the wrench channels [N, N m].
        method: one of `METHODS`.
        samples: number of samples.
    """

    phi: Array
    offsets: Array
    covariance: Array
    identifiable: NDArray[np.bool_]
    condition_number: float
    delay_s: float
    residual_rms: Array
    method: str
    samples: int

    @property
    def mass(self) -> float:
        """[kg]; negative if the wrench has the opposite sign of Eq. (1)."""
        return float(self.phi[0])

    @property
    def com(self) -> Array:
        """(3,) centre of mass p_SoBcm_S [m]."""
        return mass_com_inertia(self.phi)[1]

    @property
    def inertia_com(self) -> Array:
        """(3, 3) inertia about the centre of mass, axes of S [kg m^2]."""
        return mass_com_inertia(self.phi)[2]

    @property
    def physically_consistent(self) -> bool:
        """Whether some body can have these parameters; seldom so if some are not identifiable."""
        return is_physically_consistent(self.phi)

    @property
    def standard_deviations(self) -> Array:
        """(16,) of [offsets; phi], inf for undetermined parameters."""
        return np.sqrt(np.diag(self.covariance))

    def save(self, path: str | Path) -> None:
        """Writes identification.json."""
        covariance = self.covariance.tolist()
        for i in np.flatnonzero(np.isinf(np.diag(self.covariance))):
            covariance[i][i] = None
        document = {
            "phi": self.phi.tolist(),
            "offsets": self.offsets.tolist(),
            "covariance": covariance,
            "identifiable": self.identifiable.tolist(),
            **self._derived(),
            "condition_number": self.condition_number,
            "delay_s": self.delay_s,
            "residual_rms": self.residual_rms.tolist(),
            "method": self.method,
            "samples": self.samples,
        }
        Path(path).write_text(json.dumps(document, indent=2, allow_nan=False) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> Identification:
        """Reads identification.json.

        Raises:
            DrakeTeleopError: naming file and field, if the file is missing, is no JSON, or a field
                is missing, unknown, of the wrong shape or type, not finite, or at odds with phi.
        """
        document = _read_json(path)
        known = {*cls.__dataclass_fields__, "mass", "com", "inertia_com", "physically_consistent"}
        for name in sorted(known ^ document.keys()):
            what = "is missing" if name in known else "is not a field of an identification"
            raise DrakeTeleopError(what, where=f"{path}:{name}")

        def numbers(name: str, *shape: int) -> Array:
            return checked(f"{path}:{name}", document[name], *shape)

        if document["method"] not in METHODS:
            raise DrakeTeleopError(f"is not one of {METHODS}", where=f"{path}:method")
        result = cls(
            phi=numbers("phi", 10),
            offsets=numbers("offsets", 6),
            covariance=_read_covariance(f"{path}:covariance", document["covariance"]),
            identifiable=_read_flags(f"{path}:identifiable", document["identifiable"]),
            condition_number=float(numbers("condition_number")),
            delay_s=float(numbers("delay_s")),
            residual_rms=numbers("residual_rms", 6),
            method=document["method"],
            samples=int(numbers("samples")),
        )
        for name, value in result._derived().items():
            stated = numbers(name, *np.shape(value))
            if not np.allclose(stated, value, rtol=1e-6, atol=1e-9):
                raise DrakeTeleopError(
                    "does not follow from phi", where=f"{path}:{name}", remedy="edit phi"
                )
        return result

    def _derived(self) -> dict[str, Any]:
        mass, com, inertia = mass_com_inertia(self.phi)
        return {
            "mass": mass,
            "com": com.tolist(),
            "inertia_com": inertia.tolist(),
            "physically_consistent": self.physically_consistent,
        }


class NormalEquations:
    """Sums over a record from which the load follows, in memory that does not grow with it.

    Samples have to come in the order of time: the variances are judged from consecutive blocks.

    Args:
        noise: (6,) standard deviations of the wrench channels [N, N m], for the weights. None
            gives every row the same weight, in N and N m alike.

    Raises:
        DrakeTeleopError: if a standard deviation is not a positive number.
    """

    def __init__(self, noise: ArrayLike | None = None) -> None:
        self._weights = np.ones(6) if noise is None else positive("noise", noise, 6) ** -2.0
        # Channel c: sum of x x^T, x = [1, wrench c, row c of V (10)]; and its first row by blocks.
        self._moments = np.zeros((6, 12, 12))
        self._blocks = np.zeros((_MOST_BLOCKS, 6, 12))
        self._last, self._length = 0, 1

    @property
    def samples(self) -> int:
        """The number of samples so far."""
        return int(self._moments[0, 0, 0])

    def add(self, wrench: ArrayLike, s: ArrayLike, omega: ArrayLike, alpha: ArrayLike) -> None:
        """Adds samples.

        Args:
            wrench: (N, 6) or (6,) measured [f; tau] in S about So, sign of Eq. (1) [N, N m].
            s, omega, alpha: (N, 3) or (3,) specific force [m/s^2], angular velocity [rad/s] and
                acceleration [rad/s^2] of S in S.

        Raises:
            DrakeTeleopError: for arrays of another shape or with numbers that are not finite.
        """
        _, rows = checked_rows(wrench=(wrench, 6), s=(s, 3), omega=(omega, 3), alpha=(alpha, 3))
        start, n = 0, rows[0].shape[0]
        while start < n:
            stop = min(n, start + self._room())
            part = np.zeros((6, 12, 12))
            _accumulate(*(table[start:stop] for table in rows), part)
            self._moments += part + np.triu(part, 1).transpose(0, 2, 1)
            self._blocks[self._last] += part[:, 0]
            start = stop

    def _room(self) -> int:
        """How many samples the last block still takes; opens one if it is full."""
        if self._blocks[self._last, 0, 0] < self._length:
            return int(self._length - self._blocks[self._last, 0, 0])
        self._last += 1
        if self._last == _MOST_BLOCKS:
            self._last //= 2
            self._length *= 2
            self._blocks[: self._last] = self._blocks[::2] + self._blocks[1::2]
            self._blocks[self._last :] = 0.0
        return self._length

    def solve(self, delay_s: float = 0.0) -> Identification:
        """Least squares with the six offsets.

        Args:
            delay_s: the delay that was taken out of the motion, for the record [s].

        Raises:
            DrakeTeleopError: for fewer than 3 samples, or if the wrench is zero throughout.
        """
        if self.samples < _FEWEST_SAMPLES:
            raise DrakeTeleopError(
                f"{self.samples} samples cannot determine a load",
                remedy=f"give at least {_FEWEST_SAMPLES}, in different orientations",
            )
        gram, right = self.normal_equations()
        inverse, undetermined, condition_number, rank = _pseudo_inverse(gram, self._unexcited())
        theta = inverse @ right
        if theta[6] == 0.0:
            raise DrakeTeleopError(
                "no mass can be told from this wrench",
                where="wrench",
                remedy="is the sensor connected, and does its orientation change?",
            )
        squares = self.residual_squares(theta)
        variances = self._long_run_variances(theta, squares, rank / 6.0)
        covariance = inverse @ self.normal_equations(self._weights**2 * variances)[0] @ inverse
        covariance[undetermined, :] = covariance[:, undetermined] = 0.0
        covariance[undetermined, undetermined] = np.inf
        return Identification(
            phi=theta[6:],
            offsets=theta[:6],
            covariance=covariance,
            identifiable=worth_stating(np.sqrt(np.diag(covariance)), theta[6:]),
            condition_number=condition_number,
            delay_s=float(delay_s),
            residual_rms=np.sqrt(squares / self.samples),
            method=METHODS[0],
            samples=self.samples,
        )

    def normal_equations(self, weights: ArrayLike | None = None) -> tuple[Array, Array]:
        """Gram (16, 16) and right-hand side (16,) of [E V], sums over the rows.

        Args:
            weights: (6,) of the squares of each wrench channel [1/N^2, 1/(N m)^2]; default: those
                of the noise given at the start.
        """
        weights = self._weights if weights is None else checked("weights", weights, 6)
        gram, right = np.zeros((16, 16)), np.zeros(16)
        for c, weight in enumerate(weights):
            columns = np.array([c, *range(6, 16)])
            gram[np.ix_(columns, columns)] += weight * self._moments[c][np.ix_(_MODEL, _MODEL)]
            right[columns] += weight * self._moments[c, _MODEL, _WRENCH]
        return gram, right

    def _unexcited(self) -> NDArray[np.bool_]:
        squares = np.diag(self.normal_equations(np.ones(6))[0]) / self.samples
        return np.sqrt(squares) < _NO_EXCITATION

    @property
    def weights(self) -> Array:
        """(6,) of the squares of each wrench channel, from the noise given at the start."""
        return self._weights.copy()

    def residual_squares(self, theta: ArrayLike) -> Array:
        """(6,) sums of squared residuals; rounding leaves 1e-7 of the wrench in their roots.

        Args:
            theta: (16,) [offsets; phi].
        """
        theta = checked("theta", theta, 16)
        squares = np.empty(6)
        for c in range(6):
            x = np.concatenate([[-theta[c], 1.0], -theta[6:]])
            squares[c] = max(0.0, x @ self._moments[c] @ x)
        return squares

    def _long_run_variances(self, theta: Array, squares: Array, parameters: float) -> Array:
        """(6,) variance of a sample by which the mean of many scatters (module docstring)."""
        largest = squares / (self.samples - parameters)
        blocks = self._blocks[: self._last + 1]
        while len(blocks) >= _FEWEST_BLOCKS:
            model = blocks[:, :, 0] * theta[:6] + blocks[:, :, 2:] @ theta[6:]
            sums = blocks[:, :, _WRENCH] - model
            of_means = np.sum(sums**2 / blocks[:, :, 0], axis=0) / (len(blocks) - parameters)
            largest = np.maximum(largest, of_means)
            even = len(blocks) // 2 * 2
            blocks = blocks[0:even:2] + blocks[1:even:2]
        return largest


def identify(
    wrench: ArrayLike,
    s: ArrayLike,
    omega: ArrayLike,
    alpha: ArrayLike,
    *,
    noise: ArrayLike | None = None,
    delay_s: float = 0.0,
) -> Identification:
    """Load and sensor offsets of a free motion by batch least squares, Eqs. (7)-(8).

    Args:
        wrench: (N, 6) measured [f; tau] in S about So, sign of Eq. (1) [N, N m].
        s, omega, alpha: (N, 3) specific force a - g [m/s^2], angular velocity [rad/s] and angular
            acceleration [rad/s^2] of S in S, at the same instants; zeros (3,) for static poses.
        noise: (6,) standard deviations of the wrench channels, for the weights; None: unweighted.
        delay_s: the delay that was taken out of the motion, for the record [s].

    Raises:
        DrakeTeleopError: for arrays of another shape, numbers that are not finite, fewer than
            3 samples, or a wrench that is zero throughout.
    """
    equations = NormalEquations(noise)
    equations.add(wrench, s, omega, alpha)
    return equations.solve(delay_s)


def worth_stating(standard_deviations: Array, phi: Array) -> NDArray[np.bool_]:
    """(16,) whether a parameter is known to 5 % of what is natural for the load (module docstring).

    Args:
        standard_deviations: (16,) of [offsets; phi] [SI].
        phi: (10,) the load.
    """
    m = abs(phi[0])
    L = max(float(np.linalg.norm(phi[1:4])) / m, _SMALLEST_SIZE)
    natural = m * np.repeat([_GRAVITY, _GRAVITY * L, 1.0, L, L * L / 3.0], [3, 3, 1, 3, 6])
    return standard_deviations <= _WORTH_STATING * natural


def positive(name: str, value: ArrayLike, *shape: int) -> Array:
    """`value` as a `checked` array of positive numbers."""
    array = checked(name, value, *shape)
    if not (array > 0.0).all():
        raise DrakeTeleopError("is not positive throughout", where=name)
    return array


@njit(cache=True)
def _accumulate(wrench, s, omega, alpha, moments):
    """Adds sum x x^T, x = [1, wrench, row of V], by channel to moments (6, 12, 12), upper half.

    Rows of force have no inertia in them: their sums end with the first moments.
    """
    V, x = np.empty((6, 10)), np.empty(12)
    x[0] = 1.0
    for i in range(wrench.shape[0]):
        regressor_into(s[i], omega[i], alpha[i], V)
        for c in range(6):
            size = 6 if c < 3 else 12
            x[1] = wrench[i, c]
            for k in range(size - 2):
                x[2 + k] = V[c, k]
            for j in range(size):
                for k in range(j, size):
                    moments[c, j, k] += x[j] * x[k]


def _pseudo_inverse(
    gram: Array, unexcited: NDArray[np.bool_]
) -> tuple[Array, NDArray[np.bool_], float, int]:
    """(inverse, undetermined (16,), condition number, rank) of a Gram matrix, columns scaled."""
    scale = np.where(unexcited, 0.0, 1.0 / np.sqrt(np.where(unexcited, 1.0, np.diag(gram))))
    eigenvalues, vectors = np.linalg.eigh(gram * np.outer(scale, scale))
    kept = eigenvalues > _RANK * eigenvalues[-1]
    half = scale[:, None] * vectors[:, kept] / np.sqrt(eigenvalues[kept])
    undetermined = (np.abs(vectors[:, ~kept]) > _NULL_COMPONENT).any(axis=1)
    condition_number = float(np.sqrt(eigenvalues[-1] / eigenvalues[kept][0]))
    return half @ half.T, undetermined, condition_number, int(kept.sum())


def _read_json(path: str | Path) -> dict[str, Any]:
    try:
        document = json.loads(Path(path).read_text())
    except OSError as error:
        raise DrakeTeleopError(
            f"cannot be read ({error.strerror})", where=str(path), remedy="run `identify` first"
        ) from error
    except ValueError as error:
        raise DrakeTeleopError(f"is not JSON ({error})", where=str(path)) from error
    if not isinstance(document, dict):
        raise DrakeTeleopError("holds no JSON object", where=str(path))
    return document


def _read_covariance(where: str, value: Any) -> Array:
    try:
        raw = np.array(value, dtype=object)
    except ValueError:
        raw = np.empty(0)
    if raw.shape != (16, 16):
        raise DrakeTeleopError("is not a (16, 16) table of numbers", where=where)
    unknown = np.array([[i == j and raw[i, j] is None for j in range(16)] for i in range(16)])
    covariance = checked(where, np.where(unknown, 0.0, raw), 16, 16)
    return np.where(unknown, np.inf, covariance)


def _read_flags(where: str, value: Any) -> NDArray[np.bool_]:
    if not (
        isinstance(value, list) and len(value) == 16 and all(v in (True, False) for v in value)
    ):
        raise DrakeTeleopError("is not a list of 16 true or false", where=where)
    return np.array(value, dtype=bool)
