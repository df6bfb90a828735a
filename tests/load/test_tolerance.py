"""Required tolerances of the load."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.tolerance import (
    derivatives_over_tolerances,
    deviations_over_tolerances,
    display_values_of_required_entries,
    parse_tolerance,
    tolerances_in_display_units,
)

ALL = "mass 0.5 %, com 0.5 mm, inertia 5 %"
INERTIA = np.array([[0.012, 0.001, -0.002], [0.001, 0.009, 0.003], [-0.002, 0.003, 0.006]])
PHI = phi_from_mass_com_inertia(3.1, [0.02, -0.03, 0.085], INERTIA)


def test_text_of_a_tolerance_is_parsed_and_printed() -> None:
    tolerance = parse_tolerance(ALL)
    assert (tolerance.mass, tolerance.com, tolerance.inertia) == (0.005, 0.0005, 0.05)
    assert str(tolerance) == ALL and len(tolerance.required_entry_names) == 10
    assert parse_tolerance("com 1e-3 m").required_entry_names == ("com x", "com y", "com z")


@pytest.mark.parametrize(
    "text", ["", "mass 0.5", "mass 0.5 mm", "com 1 %", "mass 1 %, mass 2 %", "weight 1 %",
             "mass 0 %", "mass nan %", "mass 1e5 %", "mass 1.1.1 %"],
)  # fmt: skip
def test_invalid_tolerance_is_refused(text: str) -> None:
    with pytest.raises(DrakeTeleopError, match=r"tolerance|outside"):
        parse_tolerance(text)


def test_number_that_is_not_numeric_is_no_tolerance() -> None:
    with pytest.raises(DrakeTeleopError, match=r"'mass 1\.1\.1 %' is not a tolerance"):
        parse_tolerance("mass 1.1.1 %")


def test_derivatives_equal_finite_differences() -> None:
    tolerance, step = parse_tolerance(ALL), 1e-6
    steps = step * np.eye(10)
    values = partial(display_values_of_required_entries, tolerance)
    differences = [values(PHI + row) - values(PHI - row) for row in steps]
    numbers = (
        np.array(differences).T
        / (2.0 * step)
        / tolerances_in_display_units(tolerance, PHI)[:, None]
    )
    errors = derivatives_over_tolerances(tolerance, PHI)
    np.testing.assert_array_equal(errors[:, :6], 0.0)
    np.testing.assert_allclose(errors[:, 6:], numbers, rtol=1e-6, atol=1e-6 * np.abs(numbers).max())


def test_values_of_undetermined_parameters_have_infinite_deviations() -> None:
    covariance = np.diag(np.full(16, 1e-8))
    covariance[10, 10] = np.inf  # I_xx
    known = np.isfinite(
        deviations_over_tolerances(
            derivatives_over_tolerances(parse_tolerance(ALL), PHI), covariance
        )
    )
    np.testing.assert_array_equal(known, [True] * 4 + [False] + [True] * 5)


@pytest.mark.parametrize("inertia", [INERTIA, 1e-9 * INERTIA, np.zeros((3, 3)), -INERTIA])
@pytest.mark.parametrize("com", [[0.02, 0.0, 0.1], [0.0, 0.0, 0.0]])
@pytest.mark.parametrize("mass", [3.1, -0.2])
def test_shown_tolerances_are_those_that_the_deviations_are_compared_with(
    inertia: np.ndarray, mass: float, com: list[float]
) -> None:
    tolerance, phi = parse_tolerance(ALL), phi_from_mass_com_inertia(mass, com, inertia)
    covariance = np.diag(np.linspace(1e-6, 2e-6, 16))
    relative = deviations_over_tolerances(derivatives_over_tolerances(tolerance, phi), covariance)
    step, shown = 1e-6, partial(display_values_of_required_entries, tolerance)
    slopes = [(shown(phi + x) - shown(phi - x)) / (2.0 * step) for x in step * np.eye(10)]
    expected = np.sqrt(np.square(slopes).T @ np.diag(covariance)[6:])
    assert relative * tolerances_in_display_units(tolerance, phi) == pytest.approx(expected, 1e-4)
