"""What of a wrench is noise, whatever the motion."""

from __future__ import annotations

import numpy as np

from drake_teleop.logs.check.load_fit import LoadFit, white_noise


def test_white_noise_is_seen_under_a_smooth_motion() -> None:
    rng, sigma = np.random.default_rng(4), np.array([0.02, 0.3, 1.5])
    t = np.arange(0, 20, 1e-3)[:, None]
    motion = 20 * np.sin(2 * np.pi * np.array([0.5, 1.0, 2.0]) * t)
    found = white_noise(motion + sigma * rng.normal(size=(len(t), 3)))
    np.testing.assert_allclose(found, sigma, rtol=0.05)
    assert not white_noise(motion[:3]).any()


def test_a_good_fit_explains_most_and_has_a_mass() -> None:
    assert LoadFit(0.001, 1.0).good
    assert not LoadFit(0.9, 1.0).good and not LoadFit(0.001, -1.0).good
