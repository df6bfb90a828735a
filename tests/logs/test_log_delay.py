from __future__ import annotations

import numpy as np
import pytest
from known_motion import motion_at
from scipy.spatial.transform import Rotation

from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.check.against_load import LoadFitQuality, fit_load
from drake_teleop.logs.read.alignment import estimate_delay
from drake_teleop.logs.read.canonical import Log

PHI = phi_from_mass_com_inertia(3.13, [0.01, -0.02, 0.12], np.diag([0.02, 0.018, 0.006]))


def delayed_log(delay_s: float, noise: float, seed: int = 1, duration: float = 4.0) -> Log:
    rng = np.random.default_rng(seed)
    t = np.arange(0, duration, 1e-3)
    now, then = motion_at(t), motion_at(t - delay_s)
    wrench = non_contact_wrench(now.specific_force, now.omega, now.alpha, PHI) + 3.0
    size = noise * np.array([1, 1, 1, 0.1, 0.1, 0.1])
    wrench += size * rng.normal(size=(len(t), 6))
    return Log(
        t,
        wrench,
        then.specific_force + noise * rng.normal(size=(len(t), 3)),
        then.omega,
        then.alpha,
    )


@pytest.mark.slow
@pytest.mark.parametrize("delay_s", [-0.0371, 0.0, 0.0004, 0.0061, 0.18])
@pytest.mark.parametrize("cutoff", [15.0, None])
@pytest.mark.parametrize("phi", [PHI, None])
def test_delay_is_estimated_within_a_fraction_of_a_sample(
    delay_s: float, cutoff: float | None, phi: np.ndarray | None
) -> None:
    exact = estimate_delay(delayed_log(delay_s, 0.0), cutoff, phi)
    assert exact == pytest.approx(delay_s, abs=3e-5)
    noisy = estimate_delay(delayed_log(delay_s, 0.3), cutoff, phi)
    assert noisy == pytest.approx(delay_s, abs=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize("duration", [0.5, 1.0, 4.0])
@pytest.mark.parametrize("phi", [PHI, None])
def test_delay_is_none_for_a_sensor_at_rest(duration: float, phi: np.ndarray | None) -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        t = np.arange(0, duration, 1e-3) + 5000.0  # clock with another zero
        s = np.array([0, 0, 9.8]) + 0.05 * rng.normal(size=(len(t), 3))
        rest = np.zeros((len(t), 3))
        log = Log(t, rng.normal(size=(len(t), 6)), s, rest, rest)
        assert estimate_delay(log, 30.0, phi) is None


def test_delay_outside_the_search_range_is_none() -> None:
    assert estimate_delay(delayed_log(0.4, 0.1), 30.0, PHI) is None
    # The search range of a short record is a tenth of it.
    assert estimate_delay(delayed_log(0.08, 0.0, duration=1.0), 30.0, PHI) == pytest.approx(
        0.08, abs=1e-5
    )
    assert estimate_delay(delayed_log(0.12, 0.0, duration=1.0), 30.0, PHI) is None


@pytest.mark.parametrize("start", [0.0, 1000.0])
def test_independent_samples_are_those_of_the_pass_band(start: float) -> None:
    t = start + np.arange(0, 4, 2e-3)
    motion = motion_at(t - start)
    wrench = non_contact_wrench(motion.specific_force, motion.omega, motion.alpha, PHI)
    log = Log(t, wrench, motion.specific_force, motion.omega, motion.alpha)
    fit = fit_load(log)
    assert fit.independent_samples == pytest.approx(2 * 15 * 4, rel=1e-3)  # at 15 Hz, of 4 s
    assert fit.unexplained < 1e-6 and fit.mass == pytest.approx(PHI[0], rel=1e-3)


def test_poses_at_rest_are_independent_and_give_the_mass() -> None:
    s = 9.81 * Rotation.random(30, random_state=2).apply([0.0, 0.0, 1.0])
    rest = np.zeros((30, 3))
    wrench = non_contact_wrench(s, rest, rest, PHI) + 3.0
    fit = fit_load(Log(np.arange(30.0), wrench, s, rest, rest, static=True))
    assert fit.mass == pytest.approx(PHI[0], rel=1e-6) and fit.is_good
    assert fit.independent_samples == 30 - 8


def test_good_fit_has_a_small_residual_and_a_positive_mass() -> None:
    assert LoadFitQuality(0.001, 1.0).is_good
    assert not LoadFitQuality(0.9, 1.0).is_good and not LoadFitQuality(0.001, -1.0).is_good
