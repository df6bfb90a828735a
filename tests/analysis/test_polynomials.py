"""Roots of polynomials with leading zeros, of either sign."""

from __future__ import annotations

import numpy as np
import pytest

from drake_teleop.lab.analysis.polynomials import roots_of


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_leading_zero_is_a_root_far_away_whatever_the_sign(sign: float) -> None:
    polynomials = sign * np.array([[0.0, 2.0, 6.0], [2.0, 6.0, 4.0]])
    roots = roots_of(polynomials)
    roots = np.take_along_axis(roots, np.argsort(np.abs(roots), axis=-1), axis=-1)
    np.testing.assert_allclose(roots[:, 0], [-3.0, -1.0], rtol=1e-12)
    assert abs(roots[0, 1]) > 1e20
    assert roots[1, 1] == pytest.approx(-2.0)
