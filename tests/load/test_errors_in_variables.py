"""The errors-in-variables benchmark with 20 seeds."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

FILE = Path(__file__).parents[2] / "benchmarks" / "errors_in_variables.py"
sys.path.insert(0, str(FILE.parent))


@pytest.fixture(scope="module")
def benchmark():
    spec = importlib.util.spec_from_file_location("errors_in_variables", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_motion_is_a_body_motion(benchmark):
    """alpha is the derivative of omega, and rotating s with the body gives gravity on average."""
    s, omega, alpha = benchmark.motion()
    change = np.gradient(omega, 1 / benchmark.RATE, axis=0)[1:-1]
    np.testing.assert_allclose(change, alpha[1:-1], atol=0.01 * np.abs(alpha).max())
    assert np.linalg.norm(s, axis=1).mean() == pytest.approx(9.81, rel=0.1)
    assert 2.0 < np.abs(alpha).max() < 60.0


@pytest.mark.slow
@pytest.mark.parametrize("level", ["JR3", "UTIAS High"])
def test_total_least_squares_and_instruments_remove_the_bias(benchmark, level):
    figures = benchmark.summary(level, benchmark.study(level, 20))
    assert {"I_xx", "I_yy", "I_zz"} <= set(figures["biased"])
    # Scatter of 20 records: that of one parameter is 16 %, and this is the largest of 16.
    for name in ("RIV", "RTLS"):
        assert figures[name]["scatter_over_bound_max"] < 1.7
        # A fifth of the bias, or the part of the scatter that 20 records cannot resolve.
        ratio = np.array(figures[name]["bias_over_rls"])
        own = np.array(figures[name]["bias_over_own_standard_error"])
        assert ((ratio <= 0.2) | (own <= 3.0)).all()
        inertias = [figures["biased"].index(parameter) for parameter in ("I_xx", "I_yy", "I_zz")]
        assert ratio[inertias].max() <= 0.1
    assert figures["RTLS"]["mass_error_max_percent"] <= 2.0
    assert figures["RTLS"]["com_error_max_percent"] <= 5.0
