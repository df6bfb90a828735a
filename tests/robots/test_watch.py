"""Flags for contact and another load, beside the live wrench."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.identification import Identification
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.causal import low_pass_delay_s
from drake_teleop.logs.read.alignment import low_pass
from drake_teleop.logs.read.canonical import Log, write_log
from drake_teleop.robots.compensate import run_compensate_command
from drake_teleop.robots.compensator import Compensator
from drake_teleop.robots.streams import Reading, ReadingFlag
from drake_teleop.robots.watch import (
    ContactAndLoadMonitor,
    StreamContactDetector,
    white_wrench_noise,
)

DT = 0.002
PHI = phi_from_mass_com_inertia(1.7, [0.01, -0.02, 0.06], np.diag([0.004, 0.005, 0.003]))
OFFSETS = np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.1])
LOAD = Identification(
    *(PHI, OFFSETS, 1e-6 * np.eye(16), np.ones(16, bool), 4.0, 0.0, np.repeat([0.03, 0.0015], 3)),
    *("batch least squares", 100),
)


def readings(seed: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """Return 4 s of rotation: times (N,) and values (N, 15)."""
    t = DT * np.arange(2000)
    angle, w = 0.8 * np.sin(3.0 * t), 2.4 * np.cos(3.0 * t)
    zero = np.zeros_like(t)
    s = 9.81 * np.column_stack([np.sin(angle), zero, np.cos(angle)])
    omega = np.column_stack([zero, -w, zero])
    alpha = np.column_stack([zero, 7.2 * np.sin(3.0 * t), zero])
    noise = np.random.default_rng(seed).normal(size=(2000, 6)) * np.repeat([0.1, 0.005], 3)
    wrench = non_contact_wrench(s, omega, alpha, PHI) + OFFSETS + noise
    return t, np.hstack([wrench, s, omega, alpha])


def flagged(t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return flags (N,); the wrench is equal with and without the watch."""
    watched = Compensator(LOAD, DT, watch=ContactAndLoadMonitor(LOAD, DT, 30.0))
    plain = Compensator(LOAD, DT)
    found = []
    for k, row in enumerate(values):
        one, other = (c.step(Reading(k, float(t[k]), row), float(t[k])) for c in (watched, plain))
        np.testing.assert_array_equal(one.contact, other.contact)
        assert other.flags == 0
        found.append(one.flags)
    return np.array(found)


def test_push_is_flagged_while_it_lasts() -> None:
    t, values = readings()
    assert not flagged(t, values).any()
    values[1000:1250, 0] += 5.0
    flags = flagged(t, values)
    assert not flags[:1000].any() and not flags[1400:].any()
    assert (flags[1025:1250] == ReadingFlag.IN_CONTACT).all()


@pytest.mark.slow
def test_noise_floor_of_a_free_log_detects_small_contacts(tmp_path: Path) -> None:
    """The threshold is a third of that of the watch with gain errors of 5 %."""
    gains, free = np.array([1.05, 1.0, 0.95, 1.0, 1.05, 1.0]), tmp_path / "free.parquet"
    t, before = readings(seed=5)
    before[:, :6] *= gains
    write_log(Log(t, *np.split(before, [6, 9, 12], axis=1)), free)
    _, values = readings()
    values[:, :6] *= gains
    start = np.split(values[:250, 6:], 3, axis=1)
    tared = (values[:250, :6] - non_contact_wrench(*start, PHI)).mean(axis=0)
    for push in (0.0, 0.5):
        rows = values.copy()
        rows[1000:1250, 1] += push
        detector = StreamContactDetector(LOAD, free, DT, 30.0, 0.0)
        assert LOAD.covariance[:6].any() and not detector._settings[0][1][:6].any()
        compensator = Compensator(LOAD, DT, detector=detector)
        compensator.offsets = tared.copy()
        out = [
            compensator.step(Reading(k, float(t[k]), row), float(t[k]))
            for k, row in enumerate(rows)
        ]
        flags = np.array([row.flags for row in out])
        assert not flags[:1000].any() and not flags[1350:].any()
        assert (flags[1030:1250] == (ReadingFlag.IN_CONTACT if push else 0)).all()


def shaken(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return 2 s at rest, 2 s along x with 8 m/s^2 at 4 Hz; forces are 5 % too large."""
    t = readings(seed)[0]
    at, zero = t - 2.0, np.zeros_like(t)
    x = np.where(at > 0.0, 8.0 * np.minimum(at / 0.2, 1.0) * np.sin(8 * np.pi * at), 0.0)
    motion = np.column_stack([x, zero, zero + 9.81]), np.zeros((2000, 3)), np.zeros((2000, 3))
    noise = np.random.default_rng(seed).normal(size=(2000, 6)) * np.repeat([0.1, 0.005], 3)
    wrench = 1.05 * non_contact_wrench(*motion, PHI) + OFFSETS + noise
    return t, np.hstack([wrench, *motion])


@pytest.mark.slow
def test_noise_floor_rises_with_acceleration(tmp_path: Path) -> None:
    """The gain error leaves 0.7 N at 8 m/s^2, no contact; half of it at rest is contact."""
    free = tmp_path / "free.parquet"
    t, before = shaken(seed=5)
    write_log(Log(t, *np.split(before, [6, 9, 12], axis=1)), free)
    _, values = shaken(seed=2)
    start = np.split(values[:250, 6:], 3, axis=1)
    tared = (values[:250, :6] - non_contact_wrench(*start, PHI)).mean(axis=0)
    # At the centre of mass, like inertia: no other channel contains the contact.
    values[500:750, :6] += 0.35 * np.array([1.0, 0.0, 0.0, 0.0, 0.06, 0.02])
    compensator = Compensator(LOAD, DT, detector=StreamContactDetector(LOAD, free, DT, 30.0, 0.0))
    compensator.offsets = tared
    out = [
        compensator.step(Reading(k, float(t[k]), row), float(t[k])) for k, row in enumerate(values)
    ]
    flags = np.array([row.flags for row in out])
    assert (flags[530:750] == ReadingFlag.IN_CONTACT).all()
    assert not flags[:500].any() and not flags[850:].any()
    assert max(abs(row.contact[0]) for row in out[1200:]) > 0.6


@pytest.mark.parametrize(("cutoff_hz", "delay_readings"), [(30.0, 0), (20.0, 3)])
def test_predicted_wrenches_are_compared_with_their_own_noise(
    tmp_path: Path, cutoff_hz: float, delay_readings: int
) -> None:
    free, late = tmp_path / "free.parquet", {"delay_readings": delay_readings, "predicted": True}
    t, before = readings(seed=5)
    write_log(Log(t, *np.split(before, [6, 9, 12], axis=1)), free)
    _, values = readings()
    plain = Compensator(LOAD, DT, cutoff_hz=cutoff_hz, **late)
    detector = StreamContactDetector(LOAD, free, DT, cutoff_hz, 0.0, plain.lag_s)
    compensator = Compensator(LOAD, DT, cutoff_hz=cutoff_hz, detector=detector, **late)
    steps = (Reading(k, float(t[k]), row) for k, row in enumerate(values))
    assert not any(compensator.step(each, each.t).flags for each in steps)


@pytest.mark.parametrize(("predicted", "delay"), [(False, 0.004), (True, -0.002), (True, "auto")])
def test_command_gives_delay_and_prediction_to_the_detector(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, predicted: bool, delay: float | str
) -> None:
    (t, values), log = readings(), tmp_path / "log.parquet"
    write_log(Log(t, *np.split(values, [6, 9, 12], axis=1)), log)
    LOAD.save(tmp_path / "load.json")
    given = []

    def detector(*arguments: object) -> None:
        given.extend(arguments[3:])

    monkeypatch.setattr("drake_teleop.robots.compensate.StreamContactDetector", detector)
    loop = f"replay:{log}", tmp_path / "load.json", str(tmp_path / "out.csv")
    run_compensate_command(*loop, free=log, predicted=predicted, delay=delay)
    cutoff_hz, used_delay, ahead_s = given
    delay_readings = max(0, round(delay / DT)) if delay != "auto" else 0
    assert (cutoff_hz, used_delay) == (30.0, delay)
    expected = delay_readings * DT + low_pass_delay_s(DT, 30.0) if predicted else 0.0
    assert ahead_s == pytest.approx(expected)


@pytest.mark.parametrize("sink", ["free.csv", "load.csv", "log.csv"])
def test_output_does_not_replace_an_input(tmp_path: Path, sink: str) -> None:
    t, values = readings()
    for name in ("free.csv", "log.csv"):
        write_log(Log(t, *np.split(values, [6, 9, 12], axis=1)), tmp_path / name)
    LOAD.save(tmp_path / "load.csv")
    before = (tmp_path / sink).read_bytes()
    loop = f"replay:{tmp_path / 'log.csv'}", tmp_path / "load.csv", str(tmp_path / sink)
    with pytest.raises(DrakeTeleopError, match=f"contains the input {sink}"):
        run_compensate_command(*loop, free=tmp_path / "free.csv", delay=0.0)
    assert (tmp_path / sink).read_bytes() == before


@pytest.mark.parametrize("removed", [False, True])
def test_another_load_with_or_without_weight_is_refused(tmp_path: Path, removed: bool) -> None:
    """The motion of the open source fits the load at the start."""
    t, values = readings()
    turn = {"q_w": np.cos(t), "q_x": np.sin(t), "q_y": 0 * t, "q_z": 0 * t}
    write_log(Log(t, *np.split(values, [6, 9, 12], axis=1)), tmp_path / "log.parquet")
    columns = [pl.Series(name, column) for name, column in turn.items()]
    table = pl.read_parquet(tmp_path / "log.parquet").with_columns(columns)
    table.write_parquet(tmp_path / "log.parquet")
    replace(LOAD, weight_removed=removed).save(tmp_path / "load.json")
    refused = []

    def attach(make):
        with pytest.raises(DrakeTeleopError, match=r"has another .weight_removed. than") as error:
            make(replace(LOAD, weight_removed=not removed))
        refused.append(error)
        return make(replace(LOAD, weight_removed=removed))

    loop = f"replay:{tmp_path}/log.parquet", tmp_path / "load.json", str(tmp_path / "out.csv")
    run_compensate_command(*loop, delay=0.0, attach=attach)
    assert refused


def test_noise_floor_requires_the_same_rate_and_a_low_pass(tmp_path: Path) -> None:
    t, values = readings()
    write_log(Log(t, *np.split(values, [6, 9, 12], axis=1)), tmp_path / "free.parquet")
    with pytest.raises(DrakeTeleopError, match="has readings at 500 Hz, but the stream at 1000 Hz"):
        StreamContactDetector(LOAD, tmp_path / "free.parquet", 0.001, 30.0, 0.0)
    with pytest.raises(DrakeTeleopError, match=r"needs a low-pass below half .*, 250 Hz"):
        StreamContactDetector(LOAD, tmp_path / "free.parquet", DT, None)


def test_short_free_log_is_named_with_the_required_number_of_readings(tmp_path: Path) -> None:
    (t, values), free = readings(), tmp_path / "free.parquet"
    write_log(Log(t[:540], *np.split(values[:540], [6, 9, 12], axis=1)), free)
    message = r"free\.parquet: has 540 valid readings, .* free motion with at least 600"
    with pytest.raises(DrakeTeleopError, match=message):
        StreamContactDetector(LOAD, free, DT, 30.0, 0.0)


def test_another_load_is_flagged_after_a_motion() -> None:
    t, values = readings()
    more = phi_from_mass_com_inertia(0.5, [0.0, 0.03, 0.1], 1e-4 * np.eye(3))
    motion = values[:, 6:9], values[:, 9:12], values[:, 12:]
    values[800:, :6] += non_contact_wrench(*motion, more)[800:]
    flags = flagged(t, values)
    assert not flags[:800].any() and (flags[-200:] == ReadingFlag.OTHER_LOAD).all()


def test_tare_resets_the_watch() -> None:
    watch = ContactAndLoadMonitor(LOAD, DT, 30.0)
    compensator = Compensator(LOAD, DT, watch=watch)
    values = np.concatenate([OFFSETS, [0.0, 0.0, 9.81], np.zeros(6)])
    values[:6] += non_contact_wrench(values[6:9], values[9:12], values[12:], PHI)
    values[0] += 4.0
    flags = [compensator.step(Reading(k, DT * k, values), DT * k).flags for k in range(300)]
    assert flags[-1] == ReadingFlag.IN_CONTACT
    assert compensator.tare().startswith("done")
    after = [compensator.step(Reading(k, DT * k, values), DT * k).flags for k in range(300, 400)]
    assert not any(after)


def test_noise_of_readings_follows_from_the_filtered_residual() -> None:
    std = np.array([0.2, 0.3, 0.4, 0.02, 0.03, 0.04])
    noise = std * np.random.default_rng(0).normal(size=(200_000, 6))
    for cutoff in (30.0, None):
        filtered = replace(LOAD, residual_rms=low_pass(noise, DT, cutoff).std(axis=0))
        np.testing.assert_allclose(white_wrench_noise(filtered, DT, cutoff), std, rtol=0.05)
