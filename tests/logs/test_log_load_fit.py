"""What of a wrench is noise, whatever the motion."""

from __future__ import annotations

import numpy as np
import pytest
from known_motion import motion_at
from planted import PHI
from scipy.spatial.transform import Rotation

from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.check.against_load import LoadFit, fit_load
from drake_teleop.logs.read.alignment import white_noise_deviations
from drake_teleop.logs.read.canonical import Log


def test_white_noise_is_seen_under_a_smooth_motion() -> None:
    rng, sigma = np.random.default_rng(4), np.array([0.02, 0.3, 1.5])
    t = np.arange(0, 20, 1e-3)[:, None]
    motion = 20 * np.sin(2 * np.pi * np.array([0.5, 1.0, 2.0]) * t)
    found = white_noise_deviations(motion + sigma * rng.normal(size=(len(t), 3)))
    np.testing.assert_allclose(found, sigma, rtol=0.05)
    assert not white_noise_deviations(motion[:3]).any()


@pytest.mark.parametrize("start", [0.0, 1000.0])
def test_samples_that_say_something_new_are_those_of_the_pass_band(start: float) -> None:
    t = start + np.arange(0, 4, 2e-3)
    motion = motion_at(t - start)
    wrench = non_contact_wrench(motion.specific_force, motion.omega, motion.alpha, PHI)
    log = Log(t, wrench, motion.specific_force, motion.omega, motion.alpha)
    fit = fit_load(log)
    assert fit.independent == pytest.approx(2 * 15 * 4, rel=1e-3)  # at 15 Hz, of 4 s
    assert fit.unexplained < 1e-6 and fit.mass == pytest.approx(PHI[0], rel=1e-3)


def test_poses_at_rest_say_the_mass_and_each_says_something_new() -> None:
    s = 9.81 * Rotation.random(30, random_state=2).apply([0.0, 0.0, 1.0])
    rest = np.zeros((30, 3))
    wrench = non_contact_wrench(s, rest, rest, PHI) + 3.0
    fit = fit_load(Log(np.arange(30.0), wrench, s, rest, rest, static=True))
    assert fit.mass == pytest.approx(PHI[0], rel=1e-6) and fit.is_good
    assert fit.independent == 30 - 8


def test_a_good_fit_explains_most_and_has_a_mass() -> None:
    assert LoadFit(0.001, 1.0).is_good
    assert not LoadFit(0.9, 1.0).is_good and not LoadFit(0.001, -1.0).is_good
