"""Contact and another load, flagged beside the live wrench."""

from __future__ import annotations

import numpy as np

from drake_teleop.load.identification import Identification
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.robots.compensator import Compensator
from drake_teleop.robots.streams import Flag, Reading
from drake_teleop.robots.watch import Watch

DT = 0.002
PHI = phi_from_mass_com_inertia(1.7, [0.01, -0.02, 0.06], np.diag([0.004, 0.005, 0.003]))
OFFSETS = np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.1])
LOAD = Identification(
    *(PHI, OFFSETS, 1e-6 * np.eye(16), np.ones(16, bool), 4.0, 0.0, np.repeat([0.03, 0.0015], 3)),
    *("batch least squares", 100),
)


def readings() -> tuple[np.ndarray, np.ndarray]:
    """4 s of turning, (N,) times and (N, 15) values."""
    t = DT * np.arange(2000)
    angle, w = 0.8 * np.sin(3.0 * t), 2.4 * np.cos(3.0 * t)
    zero = np.zeros_like(t)
    s = 9.81 * np.column_stack([np.sin(angle), zero, np.cos(angle)])
    omega = np.column_stack([zero, -w, zero])
    alpha = np.column_stack([zero, 7.2 * np.sin(3.0 * t), zero])
    noise = np.random.default_rng(2).normal(size=(2000, 6)) * np.repeat([0.1, 0.005], 3)
    wrench = non_contact_wrench(s, omega, alpha, PHI) + OFFSETS + noise
    return t, np.hstack([wrench, s, omega, alpha])


def flagged(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(N,) flags; the wrench is the same with and without the watch."""
    watched = Compensator(LOAD, DT, watch=Watch(LOAD, DT, 30.0))
    plain = Compensator(LOAD, DT)
    found = []
    for k, row in enumerate(values):
        one, other = (c.step(Reading(k, float(t[k]), row), float(t[k])) for c in (watched, plain))
        np.testing.assert_array_equal(one.contact, other.contact)
        assert other.flags == 0
        found.append(one.flags)
    return np.array(found)


def test_a_push_is_flagged_while_it_lasts_and_nothing_else() -> None:
    t, values = readings()
    assert not flagged(t, values).any()
    values[1000:1250, 0] += 5.0
    flags = flagged(t, values)
    assert not flags[:1000].any() and not flags[1400:].any()
    assert (flags[1025:1250] == Flag.IN_CONTACT).all()


def test_another_load_is_flagged_as_that_once_it_has_moved() -> None:
    t, values = readings()
    more = phi_from_mass_com_inertia(0.5, [0.0, 0.03, 0.1], 1e-4 * np.eye(3))
    motion = values[:, 6:9], values[:, 9:12], values[:, 12:]
    values[800:, :6] += non_contact_wrench(*motion, more)[800:]
    flags = flagged(t, values)
    assert not flags[:800].any() and (flags[-200:] == Flag.OTHER_LOAD).all()


def test_a_tare_is_told_to_the_watch() -> None:
    watch = Watch(LOAD, DT, 30.0)
    compensator = Compensator(LOAD, DT, watch=watch)
    values = np.concatenate([OFFSETS, [0.0, 0.0, 9.81], np.zeros(6)])
    values[:6] += non_contact_wrench(values[6:9], values[9:12], values[12:], PHI)
    values[0] += 4.0
    flags = [compensator.step(Reading(k, DT * k, values), DT * k).flags for k in range(300)]
    assert flags[-1] == Flag.IN_CONTACT
    assert compensator.tare().startswith("done")
    after = [compensator.step(Reading(k, DT * k, values), DT * k).flags for k in range(300, 400)]
    assert not any(after)
