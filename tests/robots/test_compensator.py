"""The live wrench equals `eliminate --causal`, and is zero for invalid readings."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.identification import Identification
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.causal import causal_low_pass
from drake_teleop.logs.processing import eliminate_log
from drake_teleop.logs.read.canonical import Log, write_log
from drake_teleop.robots import replay_log
from drake_teleop.robots.compensate import compensate_stream
from drake_teleop.robots.compensator import (
    MIN_CLOCK_JUMP_S,
    STALE_AGE_S,
    TARE_AVERAGING_S,
    Compensator,
)
from drake_teleop.robots.replay_log import ReplayLogSource
from drake_teleop.robots.streams import DAMAGED_READING, CompensatedWrench, Reading, ReadingFlag

DT, DELAY = 0.002, 0.0051
PHI = phi_from_mass_com_inertia(1.7, [0.01, -0.02, 0.06], np.diag([0.004, 0.005, 0.003]))
OFFSETS = np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.1])


def load() -> Identification:
    return Identification(
        *(PHI, OFFSETS, 1e-6 * np.eye(16), np.ones(16, bool), 4.0, 0.0, np.full(6, 0.01)),
        *("batch least squares", 100),
    )


def moving(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    omega = np.column_stack([np.sin(5 * t + k) for k in range(3)])
    alpha = np.column_stack([5 * np.cos(5 * t + k) for k in range(3)])
    return 3.0 * omega + [0.0, 0.0, 9.81], omega, alpha


def readings(count: int, *, touched: float = 0.0, start: float = 0.0) -> list[Reading]:
    """Return readings of a moving load, with a contact force of `touched` N along x."""
    t = start + DT * np.arange(count)
    motion = moving(t)
    wrench = non_contact_wrench(*motion, PHI) + OFFSETS
    wrench[:, 0] += touched
    values = np.hstack([wrench, *motion])
    return [Reading(k, float(t[k]), values[k]) for k in range(count)]


def resting(count: int, wrench: np.ndarray) -> list[Reading]:
    values = np.concatenate([wrench, [0.0, 0.0, 9.81], np.zeros(6)])
    values[:6] += non_contact_wrench(values[6:9], values[9:12], values[12:15], PHI)
    return [Reading(k, DT * k, values) for k in range(count)]


class ListSink:
    """Sink that stores all outputs."""

    def __init__(self) -> None:
        self.rows: list[CompensatedWrench] = []

    def write(self, out: CompensatedWrench) -> None:
        self.rows.append(out)

    def close(self) -> None:
        pass


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return 2 s with a push, noise, a late motion, and a gap."""
    t = DT * np.arange(1000)
    rng = np.random.default_rng(3)
    wrench = non_contact_wrench(*moving(t), PHI) + OFFSETS + 0.1 * rng.normal(size=(1000, 6))
    wrench[600:700, 2] += 8.0
    path = tmp_path_factory.mktemp("log") / "log.parquet"
    kept = (t < 1.5) | (t > 1.56)
    write_log(Log(t[kept], wrench[kept], *(x[kept] for x in moving(t - DELAY))), path)
    turn = {"q_w": np.cos(t), "q_x": 0.6 * np.sin(t), "q_y": 0 * t, "q_z": 0.8 * np.sin(t)}
    columns = [pl.Series(name, values[kept]) for name, values in turn.items()]
    pl.read_parquet(path).with_columns(columns).write_parquet(path)
    return path


@pytest.mark.parametrize(("mode", "weight"), [("delayed", None), ("predicted", 0.9)])
def test_replayed_log_equals_eliminate(log: Path, mode: str, weight: float | None) -> None:
    options = {"sigma": 0.3, "gamma": 1.5, "sigma_weight": weight}
    wanted = eliminate_log(log, load(), **options, causal=mode, delay=DELAY)
    assert wanted.causal is not None and len(wanted.log) < 960

    @settings(max_examples=3, deadline=None, derandomize=True)
    @given(chunk=st.integers(1, 2000))
    def at(chunk: int) -> None:
        source, kept = ReplayLogSource(log, load(), delay=DELAY, chunk=chunk), ListSink()
        late = {"delay_readings": source.delay_readings, "predicted": mode == "predicted"}
        counts = compensate_stream(source, Compensator(load(), source.dt, **options, **late), kept)
        good = [row for row in kept.rows if not row.flags]
        assert counts["gap"] == counts["wrenches"] - len(good) > 0
        assert set(counts) == {"wrenches", "gap"}
        np.testing.assert_array_equal([row.t for row in good], wanted.log.t)
        np.testing.assert_array_equal([row.contact for row in good], wanted.causal.contact)
        np.testing.assert_array_equal([row.scaled for row in good], wanted.causal.scaled)
        assert all(not row.contact.any() for row in kept.rows if row.flags)

    at()


@pytest.mark.parametrize("start", [0.0, 1e3, -7.5])
def test_replay_in_real_time_begins_with_the_first_sample(
    start: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = np.array([each.values for each in readings(60, start=start)])
    t, now, found = start + DT * np.arange(60), [50.0], []
    write_log(Log(t, *np.split(values, [6, 9, 12], axis=1)), tmp_path / "log.parquet")

    def sleep(seconds: float) -> None:
        now[0] += seconds + 1e-3

    monkeypatch.setattr(replay_log, "time", SimpleNamespace(monotonic=lambda: now[0], sleep=sleep))
    source = ReplayLogSource(tmp_path / "log.parquet", None, real_time=True)
    while (arrived := source.read(0.01)) is not None:
        found += [each.t for each in arrived]
        assert abs(len(found) - min((now[0] - 50.0) / DT + 1.0, 60)) < 1.01
    np.testing.assert_array_equal(found, t)


@pytest.mark.parametrize("delay_s", [0.0, 0.013, 0.04])
def test_replayed_log_at_rest_has_the_delay_of_the_load(delay_s: float, tmp_path: Path) -> None:
    values = np.array([each.values for each in resting(300, OFFSETS)])
    write_log(Log(DT * np.arange(300), *np.split(values, [6, 9, 12], axis=1)), tmp_path / "l.csv")
    source = ReplayLogSource(tmp_path / "l.csv", replace(load(), delay_s=delay_s))
    assert source.delay_readings == math.ceil(delay_s / DT)
    assert len(source.read(0.0) or ()) == 256 and len(source.read(0.0) or ()) < 45


@pytest.mark.parametrize("rate_hz", [8.0, 15.0, 20.0, 25.0])
def test_slow_stream_is_filtered_and_loses_the_filter_with_a_reading(rate_hz: float) -> None:
    """The low-pass is that of `eliminate`, in Python and by `stale_steps` of the exported code."""
    count, dt = 40, 1.0 / rate_hz
    wrench = np.random.default_rng(1).normal(size=(count, 6))
    expected = causal_low_pass(wrench, dt, 0.1 * rate_hz)
    compensator = Compensator(load(), dt, cutoff_hz=0.1 * rate_hz)
    for k, reading in enumerate(resting(1, OFFSETS) * count):
        reading = reading._replace(number=k, t=k * dt, values=reading.values.copy())
        reading.values[:6] += wrench[k]
        assert compensator.stale_output((k - 0.1) * dt) is None or k == 0
        out = compensator.step(reading, k * dt)
        np.testing.assert_allclose(out.contact, expected[k], atol=1e-12)
    last = reading._replace(number=count, t=(count + 1) * dt)
    out = compensator.step(last, last.t)
    np.testing.assert_allclose(out.contact, wrench[-1], atol=1e-12)
    assert compensator.c_settings["stale_steps"] == 0


def test_weight_and_inertia_have_separate_scales() -> None:
    (reading,) = readings(1, touched=4.0)
    gravity, rest = np.array([3.0, -5.0, 7.0]), np.zeros(3)
    options = {"sigma": 9.0, "sigma_weight": 0.8, "sigma_inertia": 0.3, "gamma": 2.0}
    compensator = Compensator(load(), DT, **options, cutoff_hz=None)
    found = compensator.step(reading._replace(gravity=gravity), 0.0).scaled
    s, omega, alpha = np.split(reading.values[6:], 3)
    expected = 0.8 * non_contact_wrench(-gravity, rest, rest, PHI)
    expected += 0.3 * non_contact_wrench(s + gravity, omega, alpha, PHI) + 2.0 * 4.0 * np.eye(6)[0]
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_separate_scales_need_gravity_in_the_readings() -> None:
    compensator = Compensator(load(), DT, sigma_weight=0.5)
    with pytest.raises(DrakeTeleopError, match="gravity in the sensor frame: is unknown"):
        compensator.step(readings(1)[0], 0.0)
    with pytest.raises(DrakeTeleopError, match="the robot has removed the weight"):
        Compensator(replace(load(), weight_removed=True), DT, sigma_inertia=0.5)


@pytest.mark.parametrize("different", [{"sigma_weight": 0.5}, {"sigma_inertia": 0.2, "sigma": 1.0}])
def test_separate_scales_are_refused_once_the_gravity_is_unknown(different) -> None:
    compensator, (first, second) = Compensator(load(), DT, sigma=0.3), readings(2)
    compensator.set_scales(**different)  # nothing is known before the first reading
    compensator.set_scales(0.3)
    before = compensator.step(first, first.t).scaled
    with pytest.raises(DrakeTeleopError, match="gravity in the sensor frame: is unknown"):
        compensator.set_scales(**different)
    assert before.any() and compensator.step(second, second.t).flags == 0
    compensator.step(second._replace(t=second.t + DT, number=2, gravity=np.zeros(3)), 3 * DT)
    compensator.set_scales(**different)


@pytest.mark.parametrize(("cutoff_hz", "delay_readings"), [(None, 1), (250.0, 3), (400.0, 2)])
def test_prediction_over_a_delay_needs_a_low_pass(cutoff_hz, delay_readings) -> None:
    options = {"cutoff_hz": cutoff_hz, "delay_readings": delay_readings}
    with pytest.raises(DrakeTeleopError, match="is not below 250 Hz, half the rate"):
        Compensator(load(), DT, **options, predicted=True)
    assert Compensator(load(), DT, **options).lag_s == delay_readings * DT
    assert Compensator(load(), DT, cutoff_hz=cutoff_hz, predicted=True).lag_s == 0.0


def bad_reading(reading: Reading, name: str) -> Reading:
    values = reading.values.copy()
    if name == "damaged":
        return DAMAGED_READING
    if name == "not finite":
        values[7] = math.nan
    if name == "out of range":
        values[13] = 1e9
    if name == "saturated":
        values[2] = -60.0
    late = {"reordered": reading.t - 3 * DT}.get(name, reading.t)
    return Reading(
        reading.number, late, values, int(ReadingFlag.SATURATED) if name == "told" else 0
    )


@pytest.mark.parametrize(
    ("name", "flag"),
    [
        ("damaged", ReadingFlag.DAMAGED), ("not finite", ReadingFlag.NOT_FINITE),
        ("reordered", ReadingFlag.REORDERED),
        ("out of range", ReadingFlag.OUT_OF_RANGE), ("saturated", ReadingFlag.SATURATED),
        ("told", ReadingFlag.SATURATED),
    ],
)  # fmt: skip
def test_wrench_is_zero_for_a_bad_reading_only(name: str, flag: ReadingFlag) -> None:
    compensator = Compensator(load(), DT, sensor_range=np.full(6, 60.0))
    stream = readings(40, touched=5.0)
    for reading in stream[:20]:
        before = compensator.step(reading, reading.t)
    wrong = compensator.step(bad_reading(stream[20], name), stream[20].t)
    assert wrong.flags & flag and not wrong.contact.any() and not wrong.scaled.any()
    assert math.isfinite(wrong.t)
    for reading in stream[21:]:
        after = compensator.step(reading, reading.t)
        assert after.flags == 0
        np.testing.assert_allclose(after.contact, before.contact, atol=1e-9)
    np.testing.assert_allclose(after.contact, [5.0, 0, 0, 0, 0, 0], atol=1e-9)


def test_wrench_is_zero_during_silence_and_the_filter_restarts() -> None:
    compensator = Compensator(load(), DT)
    first = compensator.stale_output(0.0)
    assert first is not None and first.flags == ReadingFlag.STALE
    for reading in readings(20, touched=5.0):
        compensator.step(reading, reading.t)
    last = 19 * DT
    assert compensator.stale_output(last + 0.9 * STALE_AGE_S) is None
    assert compensator.time_to_stale(last + 0.9 * STALE_AGE_S) == pytest.approx(0.1 * STALE_AGE_S)
    assert compensator.time_to_stale(last + 1.1 * STALE_AGE_S) == 0.0
    stale = compensator.stale_output(last + 1.1 * STALE_AGE_S)
    assert stale is not None and stale.flags == ReadingFlag.STALE and not stale.contact.any()
    again = readings(1200, touched=-4.0)[1000]  # two seconds later, another contact
    out = compensator.step(again, again.t)
    assert out.flags == 0
    np.testing.assert_allclose(out.contact[0], -4.0, atol=1e-9)


def test_no_delayed_wrench_is_older_than_a_silence() -> None:
    compensator = Compensator(load(), DT, delay_readings=3, cutoff_hz=None)
    for reading in readings(20, touched=5.0):
        compensator.step(reading, reading.t)
    for reading in readings(1005, touched=-4.0)[1000:]:
        out = compensator.step(reading, reading.t)
        np.testing.assert_allclose(out.contact[0], -4.0, atol=1e-9)


class RestartCounter:
    """Monitor and contact detector that count restarts."""

    def __init__(self) -> None:
        self.restarts: list[np.ndarray | None] = []

    def restart(self, offsets: np.ndarray | None = None) -> None:
        self.restarts.append(offsets)

    def reading_flags(self, values: np.ndarray) -> int:
        return 0

    def contact_flag(self, values: np.ndarray, contact: np.ndarray) -> int:
        return 0


def test_detectors_restart_after_silence_and_tare() -> None:
    watch, detector, drift = RestartCounter(), RestartCounter(), np.full(6, 0.01)
    compensator = Compensator(load(), DT, watch=watch, detector=detector)
    stream = resting(round(TARE_AVERAGING_S / DT) + 30, OFFSETS + drift)
    for counter in (watch, detector):
        counter.restarts.clear()
    for reading in stream:
        t = reading.t + (0.2 if reading.number >= 30 else 0.0)
        compensator.step(reading._replace(t=t), t)
    assert (len(watch.restarts), len(detector.restarts)) == (0, 2)  # also at the first reading
    assert compensator.tare().startswith("done")
    assert len(detector.restarts) == 3
    np.testing.assert_allclose(watch.restarts, [OFFSETS + drift])


def test_late_readings_are_stale_until_the_clock_is_accepted() -> None:
    compensator, delay = Compensator(load(), DT), 0.2
    flags = []
    for reading in readings(800, touched=5.0):
        now = reading.t + (delay if reading.t > 0.2 else 0.0)
        flags.append(compensator.step(reading, now).flags)
    at = round(0.2 / DT) + 1
    assert not any(flags[:at]) and flags[at] == ReadingFlag.STALE
    here = flags.index(ReadingFlag.CLOCK_JUMP)
    assert here * DT == pytest.approx(0.2 + MIN_CLOCK_JUMP_S, abs=delay + 5 * DT)
    assert not any(flags[here + 1 :])


@pytest.mark.parametrize(
    ("start", "number", "flag"),
    [(50.0, 20, ReadingFlag.CLOCK_JUMP), (-50.0, 20, ReadingFlag.CLOCK_JUMP),
     (-50.0, 0, ReadingFlag.RESTART),
     (20 * DT, 0, ReadingFlag.RESTART)],
)  # fmt: skip
def test_clock_jumps_and_restarts_are_flagged(start: float, number: int, flag: ReadingFlag) -> None:
    compensator = Compensator(load(), DT)
    for reading in readings(20):
        compensator.step(reading, reading.t)
    after = [
        compensator.step(reading._replace(number=reading.number + number), (20 + k) * DT)
        for k, reading in enumerate(readings(20, touched=5.0, start=start))
    ]
    assert [row.flags for row in after] == [flag] + [0] * 19
    assert not after[0].contact.any()
    np.testing.assert_allclose(after[-1].contact[0], 5.0, atol=1e-9)


@pytest.mark.parametrize(
    ("number", "flag"), [(0, ReadingFlag.RESTART), (60, ReadingFlag.CLOCK_JUMP)]
)
def test_small_backward_clock_step_is_accepted_after_a_silence(
    number: int, flag: ReadingFlag
) -> None:
    compensator = Compensator(load(), DT)
    for reading in readings(60):
        compensator.step(reading, reading.t)
    flags = [
        compensator.step(reading._replace(number=reading.number + number), (60 + k) * DT).flags
        for k, reading in enumerate(readings(50))
    ]
    at = flags.index(flag)
    assert at * DT == pytest.approx(STALE_AGE_S, abs=2 * DT)
    assert flags == [ReadingFlag.REORDERED] * at + [flag] + [0] * (49 - at)


def test_wrong_rate_is_flagged() -> None:
    flags = {}
    for share in (1.0, 1.2):
        compensator = Compensator(load(), share * DT)
        flags[share] = [compensator.step(each, each.t).flags for each in readings(300)][-1]
    assert flags == {1.0: 0, 1.2: ReadingFlag.WRONG_RATE}
    compensator, kept = Compensator(load(), DT), [each for each in readings(600) if each.number % 8]
    assert not any(compensator.step(each, each.t).flags for each in kept)  # an eighth is lost


@pytest.mark.parametrize("count", [100, 250])
def test_rate_is_measured_anew_after_a_restart(count: int) -> None:
    compensator = Compensator(load(), DT)
    again = readings(450, start=5.0)
    flags = [compensator.step(each, each.t).flags for each in (*readings(count), *again)]
    assert np.flatnonzero(flags).tolist() == [count] and flags[count] == ReadingFlag.RESTART


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("channel", range(6))
def test_wrench_is_limited_to_the_range_of_the_sensor(channel: int, sign: float) -> None:
    limits, unit = np.array([60.0, 70.0, 80.0, 6.0, 7.0, 8.0]), np.eye(6)[channel]
    compensator = Compensator(load(), DT, gamma=4.0, sensor_range=limits)
    push = 0.3 * sign * limits * unit
    out = [compensator.step(each, each.t) for each in resting(5, OFFSETS + push)][-1]
    assert out.flags == ReadingFlag.CLIPPED
    np.testing.assert_allclose(out.contact, push, atol=1e-12)
    np.testing.assert_allclose(out.scaled, sign * limits * unit, atol=1e-12)


def test_delayed_wrenches_are_clipped() -> None:
    compensator = Compensator(
        load(), DT, delay_readings=2, cutoff_hz=None, sensor_range=np.full(6, 60.0)
    )
    compensator.offsets = OFFSETS - 20.0 * (np.arange(6) == 0)
    out = [compensator.step(each, each.t) for each in readings(3, touched=45.0)]
    assert all(row.flags == ReadingFlag.CLIPPED and row.contact[0] == 60.0 for row in out)


@pytest.mark.parametrize(
    ("name", "reason"),
    [("free", "done"), ("short", "fewer than 0.5 s"), ("moving", "the sensor moves"),
     ("push", "contact, or"), ("twist", "contact, or"), ("spin", "the sensor moves"),
     ("wavers", "the wrench varies")],
)  # fmt: skip
def test_tare_is_refused_with_a_reason(name: str, reason: str) -> None:
    compensator, count = Compensator(load(), DT), round(TARE_AVERAGING_S / DT)
    drift = np.array([0.5, -0.3, 0.2, 0.01, 0.0, 0.02])
    stream = resting(count, OFFSETS + drift)
    if name == "short":
        stream = stream[1:]
    if name == "moving":
        stream = readings(count)
    for reading in stream:
        values = reading.values.copy()
        values[2] += {"push": 8.0, "wavers": 0.5 * math.sin(30 * reading.t)}.get(name, 0.0)
        values[[4, 11]] += {"twist": (0.4, 0.0), "spin": (0.0, 0.05)}.get(name, (0.0, 0.0))
        compensator.step(reading._replace(values=values), reading.t)
    assert reason in compensator.tare()
    moved = drift if name == "free" else np.zeros(6)
    np.testing.assert_allclose(compensator.offsets, OFFSETS + moved, atol=1e-12)
    assert compensator.tare().startswith("refused") or name != "free"
