"""Contacts in a record, detected with the noise floor of the same record."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.logs.aligned_log import replace_specific_force_by_acceleration
from drake_teleop.logs.contact import (
    Detection,
    DetectorSamples,
    detect_contact,
    noise_floor,
    samples_for_detector,
    summarize_contacts,
)
from drake_teleop.logs.read.alignment import low_pass
from drake_teleop.logs.read.canonical import Log

DT, CUTOFF = 2e-3, 30.0
STD = np.array([0.2, 0.3, 0.4, 0.02, 0.03, 0.04])


def noise_of(seed: int, n: int = 6000) -> np.ndarray:
    return STD * np.random.default_rng(seed).normal(size=(n, 6))


def detect(
    contact: np.ndarray,
    dt: float = DT,
    free: np.ndarray | None = None,
    free_dt: float = DT,
    statistic: str = "level",
) -> Detection:
    """Return the detection for a contact wrench of a sensor at rest."""

    def samples_at_rest(wrench: np.ndarray) -> DetectorSamples:
        still, up = np.zeros((len(wrench), 3)), np.tile([0.0, 0.0, 9.81], (len(wrench), 1))
        return DetectorSamples(wrench, up, still, still, still)

    calm = None if free is None else (samples_at_rest(free), free_dt)
    options = {"free": calm, "statistic": statistic}
    found = detect_contact(samples_at_rest(contact), dt, CUTOFF, np.zeros((16, 16)), STD, **options)
    assert found is not None
    return found


def test_noise_floor_excludes_contact() -> None:
    contact = noise_of(1)
    np.testing.assert_allclose(noise_floor(contact), STD, rtol=0.05)
    contact[3500:] += 5.0 + 3 * np.sin(np.linspace(0, 9, 2500))[:, None]
    np.testing.assert_allclose(noise_floor(contact), STD, rtol=0.05)
    assert (noise_floor(np.zeros((100, 6))) == np.repeat([1e-3, 1e-4], 3)).all()


@pytest.mark.parametrize("ratio", [0.25, 0.5, 1.0, 3.0])
def test_log_of_free_motion_may_have_another_rate(ratio: float) -> None:
    free_dt = ratio * DT
    found = detect(noise_of(1, 1000), free=noise_of(2, 2000), free_dt=free_dt)
    # The fade is per sample of the judged log.
    assert found.noise_floor.fade == pytest.approx(np.exp(-DT * CUTOFF))
    judged = 2000 - 2 * round(1.0 / (CUTOFF * free_dt))
    assert found.free_duration_s == pytest.approx(judged * free_dt)


@pytest.mark.parametrize("statistic", ["cusum", "glr"])
@pytest.mark.parametrize("step", [1, 2, 8])
def test_sums_are_refused_for_free_motion_of_another_rate(statistic: str, step: int) -> None:
    """Noise that is correlated over samples of 2 ms is not correlated over steps of 16 ms."""
    wrench, free = (low_pass(noise_of(seed, 8000), DT, CUTOFF) for seed in (1, 2))
    rates = ({"dt": DT, "free_dt": step * DT}, {"dt": step * DT, "free_dt": DT})
    for now, calm, rate in zip((wrench, wrench[::step]), (free[::step], free), rates, strict=True):
        if step == 1:
            assert not detect(now, free=calm, statistic=statistic, **rate).touched.any()
            continue
        with pytest.raises(DrakeTeleopError, match=f"^free: .* is not the rate.*'{statistic}'"):
            detect(now, free=calm, statistic=statistic, **rate)
        assert not detect(now, free=calm, **rate).touched.any()


@pytest.mark.parametrize("size", [0.0, 2.0, 7.5])
def test_a_removed_weight_is_no_acceleration_of_the_detector(size: float) -> None:
    n = 500
    rng = np.random.default_rng(2)
    gravity = rng.normal(size=3) + np.zeros((n, 3))
    a = size * np.tile([0.6, 0.0, -0.8], (n, 1))
    log = Log(DT * np.arange(n), np.zeros((n, 6)), a - gravity, 0 * a, 0 * a, gravity=gravity)
    for given in (log, replace_specific_force_by_acceleration(log)):
        found = samples_for_detector(given, np.zeros((n, 6)), CUTOFF).acceleration
        np.testing.assert_allclose(found, a, atol=1e-9)


def test_contacts_have_their_times_and_peaks() -> None:
    contact = noise_of(2)
    t = 10 + DT * np.arange(len(contact))
    force = np.zeros(len(t))
    force[1000:1300] = 12.0 * np.sin(np.linspace(0, 2 * np.pi, 300))  # changes its sign
    force[4000:4001] = 40.0
    contact[:, 2] += force
    swing, knock = summarize_contacts(t, contact, detect(contact).touched)
    assert swing["start_s"] == pytest.approx(12.0, abs=0.05)
    assert swing["stop_s"] == pytest.approx(12.6, abs=0.05)
    assert swing["peak_N"] == pytest.approx(12.0, abs=1.5)
    assert swing["peak_Nm"] < 0.3
    assert knock["start_s"] == knock["stop_s"] == pytest.approx(18.0)
    np.testing.assert_allclose(knock["push"], [0, 0, -1], atol=0.05)


@pytest.mark.parametrize("memory", [0.0, 0.2])
def test_noise_is_no_contact(memory: float) -> None:
    """Each of several records of a minute has its own noise floor."""
    rate, n = 200.0, 12_000
    rng = np.random.default_rng(7)
    decay = np.exp(-1 / (rate * memory)) if memory else 0.0
    for _ in range(2):
        noise = lfilter([1.0], [1.0, -decay], rng.normal(size=(n + 400, 6)), axis=0)[400:]
        contact = low_pass(STD * noise, 1 / rate, CUTOFF)
        assert not detect(contact - contact.mean(axis=0), 1 / rate).touched.any()


@pytest.mark.quick_cases(2)
@pytest.mark.parametrize(
    ("share", "count", "slow"),
    [(0.1, 5, False), (0.4, 20, False), (0.4, 5, True), (0.3, 1, True)],
)
def test_the_threshold_does_not_rise_with_the_contacts(
    share: float, count: int, slow: bool
) -> None:
    """Contact lasts up to 40 %, at once, repeatedly or slowly rising."""
    n = 10_000
    noise = low_pass(noise_of(3, n), DT, CUTOFF)
    push, length = np.zeros(n), share * n / count
    for k in range(count):
        middle = (k + 0.5) * n / count
        rows = np.arange(round(middle - length / 2), round(middle + length / 2))
        rise = np.sin(np.pi * np.linspace(0, 1, len(rows))) ** 2 if slow else 1.0
        push[rows] = (2.0 + k) * rise
    contact = noise.copy()
    contact[:, 2] += push
    found, free = detect(contact), detect(contact, free=noise)
    assert found.threshold < 1.6 / 1.25 * 1.2 * free.threshold
    # 0.13 N of noise hide 1 N.
    assert found.touched[push > 1.4].all()
    assert not found.touched[push == 0.0].any()
    assert len(summarize_contacts(DT * np.arange(n), contact, found.touched)) == count


@pytest.mark.slow
def test_note_reports_too_much_contact() -> None:
    contact = low_pass(noise_of(4), DT, CUTOFF)
    assert detect(contact).notes == ()
    much = contact.copy()
    much[1000:3700] += 20 * STD
    assert "45 % of the record" in detect(much).notes[0]
    assert "--free" in detect(much).notes[0]
    most = contact.copy()  # most of the record counts as noise
    most[800:] += 40 * STD * np.sin(np.arange(5200) * 0.05)[:, None]
    assert "most of the record may be in contact" in detect(most).notes[0]
    assert detect(most, free=contact).notes == ()
    assert detect(most, free=contact).touched[900:-50].mean() > 0.9


def test_record_that_is_too_short_has_no_result() -> None:
    rows = DetectorSamples(noise_of(5, 120), *(np.zeros((120, 3)) for _ in range(4)))
    assert detect_contact(rows, DT, CUTOFF, np.zeros((16, 16)), STD) is None
