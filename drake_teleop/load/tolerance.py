"""Required accuracy of a load, such as "mass 0.5 %, com 0.5 mm, inertia 5 %"."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.load.inertia import mass_com_inertia

QUANTITY_NAMES = ("mass", "com", "inertia")
"""Quantities whose accuracy a tolerance can require."""
ENTRY_NAMES_OF_QUANTITY = {
    "mass": ("mass",),
    "com": ("com x", "com y", "com z"),
    "inertia": tuple(f"inertia {axes}" for axes in ("xx", "xy", "xz", "yy", "yz", "zz")),
}
"""Numbers that each quantity consists of."""
QUANTITY_UNITS = {"mass": "kg", "com": "mm", "inertia": "kg m^2"}
"""Unit of each quantity in printed values."""

_SI_VALUE_OF_UNIT = {"%": 0.01, "mm": 1e-3, "m": 1.0}
_TOLERANCE_PATTERN = re.compile(r"\s*([a-z]+)\s+([0-9.eE+-]+)\s*(%|mm|m)\s*")
_MIN_TOLERANCE, _MAX_TOLERANCE = 1e-9, 10.0


class Tolerance(NamedTuple):
    """Largest permitted errors of a load; None for no requirement.

    Attributes:
        mass: relative to the mass.
        com: of the centre of mass, along each axis [m].
        inertia: of each entry about the centre of mass, relative to the mean principal moment.
    """

    mass: float | None = None
    com: float | None = None
    inertia: float | None = None

    @property
    def required_quantity_names(self) -> tuple[str, ...]:
        return tuple(name for name in QUANTITY_NAMES if getattr(self, name) is not None)

    @property
    def required_entry_names(self) -> tuple[str, ...]:
        """Names (k,) of the numbers that have a tolerance, such as "com x"."""
        return sum((ENTRY_NAMES_OF_QUANTITY[name] for name in self.required_quantity_names), ())

    def __str__(self) -> str:
        return ", ".join(
            f"com {1e3 * value:g} mm" if name == "com" else f"{name} {100.0 * value:g} %"
            for name, value in zip(QUANTITY_NAMES, self, strict=True)
            if value is not None
        )


def parse_tolerance(text: str) -> Tolerance:
    found: dict[str, float] = {}
    for part in text.split(","):
        match = _TOLERANCE_PATTERN.fullmatch(part)
        name, number, unit = match.groups() if match else ("", "0", "m")
        try:
            value = float(number) * _SI_VALUE_OF_UNIT[unit]
        except ValueError:
            name = ""
        if name not in QUANTITY_NAMES or (unit == "%") == (name == "com") or name in found:
            what = f"{part.strip()!r} is not a tolerance (quantity, number, unit), or is repeated"
            remedy = "write, for example, mass 0.5 %, com 0.5 mm, inertia 5 %"
            raise DrakeTeleopError(what, where=text, remedy=remedy)
        if not _MIN_TOLERANCE <= value <= _MAX_TOLERANCE:
            what = f"{part.strip()!r} is outside 1e-9 to 10 (for %: of 1; for com: in m)"
            raise DrakeTeleopError(what, where=text, remedy="correct the number or its unit")
        found[name] = value
    return Tolerance(**found)


def derivatives_over_tolerances(tolerance: Tolerance, phi: Array) -> Array:
    """Return derivatives (k, 16) of mass, com x ... by [offsets; phi], divided by tolerances."""
    m, c, inertia = mass_com_inertia(phi)
    rows = np.zeros((10, 10))
    rows[0, 0] = 1.0 / m
    rows[1:4, 0], rows[1:4, 1:4] = -c / m, np.eye(3) / m
    # I_com = I - (h.h E - h h^T) / m with h = m c.
    E, upper = np.eye(3), np.triu_indices(3)
    rows[4:, 0] = ((c @ c) * E - np.outer(c, c))[upper]
    for k in range(3):
        rows[4:, 1 + k] = -(2.0 * c[k] * E - (np.outer(E[k], c) + np.outer(c, E[k])))[upper]
    rows[4:, 4:] = np.eye(6)
    scale = _lower_bounded_mean_moment(m, c, inertia)
    parts = {"mass": (rows[:1], 1.0), "com": (rows[1:4], 1.0), "inertia": (rows[4:], scale)}
    required = [(*parts[x], getattr(tolerance, x)) for x in tolerance.required_quantity_names]
    out = np.concatenate([part / (size * limit) for part, size, limit in required])
    return np.hstack([np.zeros((len(out), 6)), out])


def _lower_bounded_mean_moment(m: float, c: Array, inertia_com: Array) -> float:
    # Lower bound, because a poorly determined inertia can have any estimate.
    return max(float(np.trace(inertia_com)) / 3.0, 1e-4 * abs(m) * (float(c @ c) + 1e-4))


def deviations_over_tolerances(derivatives: Array, covariance: Array) -> Array:
    """Return standard deviations (k,) divided by tolerances; inf: undetermined."""
    unknown = np.isinf(np.diag(covariance))
    finite = np.where(unknown | unknown[:, np.newaxis], 0.0, covariance)
    variances = np.einsum("ki,ij,kj->k", derivatives, finite, derivatives)
    is_undetermined = (derivatives[:, unknown] != 0.0).any(axis=1)
    return np.where(is_undetermined, np.inf, np.sqrt(np.maximum(variances, 0.0)))


def display_values_of_required_entries(tolerance: Tolerance, phi: Array) -> Array:
    """Return the values (k,) of mass, com x ... that have a tolerance [kg, mm, kg m^2]."""
    m, c, inertia = mass_com_inertia(phi)
    values = {"mass": [m], "com": 1e3 * c, "inertia": inertia[np.triu_indices(3)]}
    return np.concatenate([values[name] for name in tolerance.required_quantity_names])


def tolerances_in_display_units(tolerance: Tolerance, phi: Array) -> Array:
    """Return the absolute tolerances (k,) of mass, com x ... [kg, mm, kg m^2]."""
    m, c, inertia = mass_com_inertia(phi)
    scales = {"mass": abs(m), "com": 1e3, "inertia": _lower_bounded_mean_moment(m, c, inertia)}
    names = tolerance.required_quantity_names
    sizes = [scales[name] * getattr(tolerance, name) for name in names]
    return np.repeat(sizes, [len(ENTRY_NAMES_OF_QUANTITY[name]) for name in names])
