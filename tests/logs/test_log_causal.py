"""The contact wrench from the past alone, its noise floor, and the contacts in it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.logs.causal import causal_low_pass, causal_wrenches, filter_lag
from drake_teleop.logs.contact import contacts_of, in_contact, noise_floor
from drake_teleop.logs.read.alignment import low_pass

DT, CUTOFF = 1e-3, 30.0


def test_the_low_pass_is_a_butterworth_of_second_order() -> None:
    t = np.arange(0, 4, DT)
    for rate in (5.0, 30.0, 90.0):
        wave = np.stack([np.sin(2 * np.pi * rate * t), np.cos(2 * np.pi * rate * t)], axis=1)
        after = causal_low_pass(wave, DT, CUTOFF)[2000:]
        # Prewarped: exact at the cut-off; elsewhere the bilinear transform bends the axis.
        warped = np.tan(np.pi * rate * DT) / np.tan(np.pi * CUTOFF * DT)
        gain = np.sqrt(np.mean(after**2) / 0.5)
        assert gain == pytest.approx(1 / np.sqrt(1 + warped**4), rel=2e-3)


def test_it_never_looks_ahead_and_starts_settled() -> None:
    x = np.full((400, 6), 3.0)
    np.testing.assert_allclose(causal_low_pass(x, DT, CUTOFF), 3.0, rtol=1e-12)
    kicked = x.copy()
    kicked[200:] += 1
    for ahead in (0.0, 0.01):
        a, b = (causal_low_pass(v, DT, CUTOFF, ahead) for v in (x, kicked))
        np.testing.assert_array_equal(a[:200], b[:200])
        assert (b[200] != a[200]).all()


@pytest.mark.parametrize(("delay", "wait"), [(0.0, 0), (0.0052, 6), (0.006, 6), (-0.004, 0)])
def test_a_ramp_is_late_by_the_lag_or_not_at_all(delay: float, wait: int) -> None:
    ramp = np.outer(np.arange(0, 2, DT), [1.0, 2, 3, 4, 5, 6])
    options = {"cutoff_hz": CUTOFF, "delay_s": delay}
    late = causal_wrenches(ramp, 2 * ramp, DT, mode="delayed", **options)
    assert late.lag_s == pytest.approx(wait * DT + filter_lag(DT, CUTOFF))
    assert late.lag_s - wait * DT == pytest.approx(np.sqrt(2) / (2 * np.pi * CUTOFF), rel=0.005)
    slope = np.array([1.0, 2, 3, 4, 5, 6])
    np.testing.assert_allclose((ramp - late.contact)[1000:] / slope, late.lag_s, rtol=1e-6)
    np.testing.assert_allclose(late.scaled, 2 * late.contact, atol=1e-12)
    np.testing.assert_array_equal(late.contact[: wait + 1], 0.0)  # until the first has come
    ahead = causal_wrenches(ramp, ramp, DT, mode="predicted", **options)
    np.testing.assert_allclose(ahead.contact[1000:], ramp[1000:], rtol=1e-6)


def test_prediction_costs_as_much_noise_as_is_said() -> None:
    noise = np.random.default_rng(5).normal(size=(200_000, 1))
    lag = filter_lag(DT, CUTOFF)
    plain, ahead = (causal_low_pass(noise, DT, CUTOFF, a).std() for a in (0.0, lag))
    assert ahead / plain == pytest.approx(np.sqrt(3), rel=0.04)


def test_what_cannot_be_asked_for() -> None:
    x = np.zeros((50, 6))
    with pytest.raises(DrakeTeleopError, match="prediction needs a low-pass"):
        causal_wrenches(x, x, DT, cutoff_hz=None, delay_s=0.005, mode="predicted")
    with pytest.raises(DrakeTeleopError, match="'soon' is not a causal mode"):
        causal_wrenches(x, x, DT, cutoff_hz=None, delay_s=0.0, mode="soon")
    same = causal_wrenches(x, x, DT, cutoff_hz=None, delay_s=0.0, mode="delayed")
    assert same.lag_s == 0.0


STD = np.array([0.2, 0.3, 0.4, 0.02, 0.03, 0.04])


def quiet(seed: int, n: int = 6000) -> np.ndarray:
    return STD * np.random.default_rng(seed).normal(size=(n, 6))


def test_the_noise_floor_is_that_of_the_quiet_part() -> None:
    contact = quiet(1)
    np.testing.assert_allclose(noise_floor(contact), STD, rtol=0.05)
    contact[3500:] += 5.0 + 3 * np.sin(np.linspace(0, 9, 2500))[:, None]
    np.testing.assert_allclose(noise_floor(contact), STD, rtol=0.05)
    assert (noise_floor(np.zeros((100, 6))) == np.repeat([1e-3, 1e-4], 3)).all()


def test_contacts_have_their_times_and_peaks_and_noise_has_none() -> None:
    contact = quiet(2)
    t = 10 + DT * np.arange(len(contact))
    floor = noise_floor(contact)
    assert not in_contact(contact, floor, 33).any()
    force = np.zeros(len(t))
    force[1000:1300] = 12.0 * np.sin(np.linspace(0, 2 * np.pi, 300))  # changes its sign
    force[4000:4001] = 40.0
    contact[:, 2] += force
    found = contacts_of(t, contact, in_contact(contact, floor, 33))
    assert len(found) == 2
    assert found[0].start_s == pytest.approx(11.0, abs=0.02)
    assert found[0].stop_s == pytest.approx(11.3, abs=0.02)
    assert found[0].peak_force == pytest.approx(12.0, abs=1.5)
    assert found[0].peak_torque < 0.3
    assert found[1].start_s == found[1].stop_s == pytest.approx(14.0)


@pytest.mark.parametrize("memory", [0.0, 0.2])
def test_noise_is_a_contact_less_than_once_an_hour(memory: float) -> None:
    """An hour in records of a minute, each with its own noise floor."""
    rate, n = 200.0, 12_000
    rng, count = np.random.default_rng(7), 0
    decay = np.exp(-1 / (rate * memory)) if memory else 0.0
    for _ in range(60):
        noise = lfilter([1.0], [1.0, -decay], rng.normal(size=(n + 400, 6)), axis=0)[400:]
        contact = low_pass(STD * noise, 1 / rate, 30.0)
        contact = contact - contact.mean(axis=0)
        count += len(
            contacts_of(np.arange(n) / rate, contact, in_contact(contact, noise_floor(contact), 7))
        )
    assert count <= 1


def test_hysteresis_lasts_until_the_lower_threshold() -> None:
    contact = np.zeros((300, 6))
    contact[:, 0] = np.concatenate([np.full(50, 5.0), [6.0], np.full(149, 5.0), np.full(100, 3.0)])
    touched = in_contact(contact, np.ones(6), 10)
    assert np.flatnonzero(touched).tolist() == list(range(50, 200))
    assert not in_contact(contact[:50], np.ones(6), 10).any()
