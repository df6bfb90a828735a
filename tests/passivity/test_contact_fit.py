"""Stiffness and damping of a contact from stretches of its displacement."""

from __future__ import annotations

import numpy as np
import pytest

from drake_teleop.station.passivity.contact_fit import (
    NUM_CONTACT_FIT_SUMS,
    force_change_by_slip,
    update_contact_fit,
)


def fit_contact(stiffness, damping, way, faster, keep=0.8):
    sums, values = np.zeros(NUM_CONTACT_FIT_SUMS), (0.0, 0.0)
    for dx, dv in zip(way, faster, strict=True):
        values = update_contact_fit(sums, stiffness * dx + damping * dv, dx, dv, keep)
    return values


@pytest.mark.parametrize(("stiffness", "damping"), [(290.0, 17.0), (1100.0, 3.0), (150.0, 0.0)])
def test_fit_separates_stiffness_and_damping(stiffness, damping):
    rng = np.random.default_rng(4)
    way, faster = 3e-4 * rng.normal(size=30), 0.01 * rng.normal(size=30)
    k, b = fit_contact(stiffness, damping, way, faster)
    # Regularisation reduces the damping by a twentieth, and adds it to the spring if correlated.
    assert b == pytest.approx(damping / 1.05, rel=0.02, abs=1e-9)
    assert k == pytest.approx(stiffness, rel=0.1 * (damping > 0.0), abs=1e-9)


def test_proportional_speed_is_stiffness_and_old_stretches_fade():
    way = np.full(20, 2e-4)
    k, b = fit_contact(300.0, 17.0, way, 10.0 * way)
    assert b <= 17.0 and k + 10.0 * b == pytest.approx(470.0, rel=0.02)
    assert fit_contact(300.0, 17.0, way[:1], 10.0 * way[:1]) == (pytest.approx(470.0), 0.0)
    sums = np.zeros(NUM_CONTACT_FIT_SUMS)
    for stiffness in (2000.0, 100.0):
        for step in 2e-4 * np.array([1.0, -1.0, 2.0, -1.0, 1.0, 2.0] * 4):
            k, _ = update_contact_fit(sums, stiffness * step, step, 0.0, 0.5)
    assert k == pytest.approx(100.0, rel=0.01)


def test_stiffness_and_damping_are_not_negative():
    assert update_contact_fit(np.zeros(NUM_CONTACT_FIT_SUMS), -1.0, 1e-3, 0.1, 0.5) == (
        0.0,
        pytest.approx(0.0, abs=1e-9),
    )


def test_slip_is_excluded_from_stiffness_and_a_hit_stop_is_not():
    """Forces up to 0.12 N over 0.2 mm belong to the spring, and at most 0.4 N to friction."""
    for sign in (1.0, -1.0):
        assert sign * force_change_by_slip(sign * 0.1, sign * 0.12, 0.4) == 0.0
        assert sign * force_change_by_slip(sign * 0.4, sign * 0.12, 0.4) == pytest.approx(0.28)
        assert sign * force_change_by_slip(-sign * 0.1, sign * 0.12, 0.4) == pytest.approx(-0.1)
        assert sign * force_change_by_slip(sign * 2.0, sign * 0.12, 0.4) == pytest.approx(0.4)
        assert force_change_by_slip(sign * 2.0, sign * 0.12, 0.0) == 0.0
