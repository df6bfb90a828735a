from __future__ import annotations

import numpy as np
import pytest
from known_motion import motion_at

from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.read.canonical import Log
from drake_teleop.logs.read.delay import estimate_delay

PHI = phi_from_mass_com_inertia(3.13, [0.01, -0.02, 0.12], np.diag([0.02, 0.018, 0.006]))


def delayed(delay_s: float, noise: float, seed: int = 1, duration: float = 4.0) -> Log:
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
def test_delay_is_found_to_a_fraction_of_a_sample(
    delay_s: float, cutoff: float | None, phi: np.ndarray | None
) -> None:
    exact = estimate_delay(delayed(delay_s, 0.0), cutoff, phi)
    assert exact == pytest.approx(delay_s, abs=3e-5)
    noisy = estimate_delay(delayed(delay_s, 0.3), cutoff, phi)
    assert noisy == pytest.approx(delay_s, abs=2e-4)


@pytest.mark.parametrize("duration", [0.5, 1.0, 4.0])
@pytest.mark.parametrize("phi", [PHI, None])
def test_delay_of_a_sensor_at_rest_is_not_made_up(duration: float, phi: np.ndarray | None) -> None:
    for seed in range(10):
        rng = np.random.default_rng(seed)
        t = np.arange(0, duration, 1e-3) + 5000.0  # a clock that did not start with the log
        s = np.array([0, 0, 9.8]) + 0.05 * rng.normal(size=(len(t), 3))
        rest = np.zeros((len(t), 3))
        log = Log(t, rng.normal(size=(len(t), 6)), s, rest, rest)
        assert estimate_delay(log, 30.0, phi) is None


def test_delay_beyond_the_search_is_not_made_up() -> None:
    assert estimate_delay(delayed(0.4, 0.1), 30.0, PHI) is None
    # Of a short record a tenth is searched.
    assert estimate_delay(delayed(0.08, 0.0, duration=1.0), 30.0, PHI) == pytest.approx(
        0.08, abs=1e-5
    )
    assert estimate_delay(delayed(0.12, 0.0, duration=1.0), 30.0, PHI) is None
