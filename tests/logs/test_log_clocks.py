"""Time stamps of recorders: removal, correction and errors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from known_motion import motion_at

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.processing import eliminate_log, identify_log
from drake_teleop.logs.read.canonical import (
    ANGULAR_VELOCITY_COLUMNS,
    SPECIFIC_FORCE_COLUMNS,
    WRENCH_COLUMNS,
)
from drake_teleop.logs.read.clocks import (
    Clock,
    find_gaps_in_times,
    read_clock,
    smooth_duplicate_stamps,
)
from drake_teleop.logs.read.description import Time
from drake_teleop.logs.read.reading import read_log
from drake_teleop.logs.read.tables import Table

PHI = phi_from_mass_com_inertia(1.7, [0.01, -0.02, 0.06], np.diag([0.004, 0.005, 0.003]))
OFFSETS = np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.3])
NAN = float("nan")


def clock_of(stamps: object, values: object = None, **time: object) -> Clock:
    t = np.array(stamps, float)
    x = np.arange(float(len(t))) if values is None else np.array(values, float)
    table = Table(Path("log.csv"), {"t": t, "x": x}, first_row=2)
    return read_clock(Time.model_validate({"column": "t"} | time), table, ["x"], "here")


@pytest.mark.parametrize("stride", [1, 8])
def test_rows_without_numbers_are_gaps_at_a_constant_rate(stride: int) -> None:
    """The stream starts late, has a gap, and uses one of `stride` rows of its table."""
    rows = np.delete(np.arange(10, 200), slice(40, 90)) * stride
    x = np.full(200 * stride, NAN)
    x[rows] = rows
    table = Table(Path("log.csv"), {"x": x}).rows_with_any_number(["x"])
    clock = read_clock(Time(rate=100.0), table, ["x"], "here")
    np.testing.assert_allclose(clock.t, rows / stride / 100.0)
    np.testing.assert_allclose(find_gaps_in_times(clock.t, 30.0), [[0.49, 1.0]])


def test_valid_stamps_are_unchanged() -> None:
    t = 1.7e9 + np.arange(50) * 0.01
    clock = clock_of(t, offset=0.5)
    np.testing.assert_array_equal(clock.t, t + 0.5)
    np.testing.assert_array_equal(clock.kept_rows, np.arange(50))
    assert clock.notes == () and not len(find_gaps_in_times(clock.t, 30.0))
    scaled = clock_of(t, scale=1.001, offset=0.5).t
    np.testing.assert_allclose(scaled - t[0] - 0.5, 1.001 * (t - t[0]), atol=1e-6)


def test_rate_of_5_hz_is_accepted() -> None:
    assert len(clock_of(np.arange(9.0) * 0.19).t) == 9


def test_rows_without_a_stamp_are_removed() -> None:
    clock = clock_of([0.0, 0.1, NAN, NAN, 0.4, 0.5])
    assert clock.kept_rows.tolist() == [0, 1, 4, 5] and clock.num_rows == 6
    assert clock.notes == ("2 rows without a time stamp are removed",)


def test_repeated_rows_are_removed() -> None:
    clock = clock_of([0.0, 0.1, 0.1, 0.1, 0.2, 0.3], [1, 2, 2, 2, NAN, 5])
    assert clock.kept_rows.tolist() == [0, 1, 4, 5]
    assert "2 rows that repeat the previous row" in clock.notes[0]
    blank = clock_of([0.0, 0.1, 0.1, 0.2], [1, NAN, NAN, 2])
    assert blank.kept_rows.tolist() == [0, 1, 3]


@pytest.mark.parametrize(
    ("stamps", "time", "words"),
    [
        ([0, 0.1, 0.2, 0.15, 0.3], {}, "1 time stamps decrease, the first in row 5 of log.csv, by"),
        ([0.1] * 9, {}, "the time stamps of log.csv never increase; set time.column"),
        ([NAN] * 9, {}, "no finite number in 9 rows"),
        (np.arange(9.0), {}, "a rate of 1 Hz; probably `unit: ms`"),
        (np.arange(9.0) * 1e3, {}, "probably `unit: us`"),
        (np.arange(9.0) * 1e6, {}, "probably `unit: ns`"),
        (np.arange(9.0) * 1e-3, {"unit": "ms"}, "a rate of 1e+06 Hz; probably `unit: s`"),
        (np.arange(9.0) * 0.5, {"unit": "s"}, "a rate of 2 Hz; probably `unit: ms`"),
        (np.arange(9.0) * 0.21, {"unit": "s"}, "a rate of 4.76 Hz; probably `unit: ms`"),
        (np.arange(9.0) * 20, {"unit": "s"}, "a rate of 0.05 Hz; probably `unit: ms`"),
        ([0, 0.01, 0.02, 0.03, 99, 99.01], {}, "longest 99 s to row 6 of log.csv; cut the log"),
        ([*np.arange(200) * 0.01, *[2.0] * 400, 2.01], {}, "do not increase around row 2"),
    ],
)
def test_unusable_stamps_raise_error(stamps: object, time: dict, words: str) -> None:
    with pytest.raises(DrakeTeleopError) as error:
        clock_of(stamps, **time)
    assert words in str(error.value)
    assert str(error.value).startswith(("here", "log.csv"))


@settings(max_examples=60, deadline=None)
@given(
    rate=st.floats(50, 3000),
    burst=st.integers(2, 12),
    start=st.sampled_from([0.0, 1.7e9]),
    missing=st.sets(st.sampled_from([0.25, 0.5, 0.75])),
)
def test_spread_restores_times_of_bursts(
    rate: float, burst: int, start: float, missing: set[float]
) -> None:
    """Each burst has the time of its last row; some bursts are missing."""
    true = np.arange(300 * burst) / rate
    kept = np.ones(len(true), bool)
    for share in missing:
        first = burst * int(share * 300)
        kept[first : first + 5 * burst] = False
    stamps = start + true[burst - 1 :: burst].repeat(burst)[kept]
    found = smooth_duplicate_stamps(stamps) - start
    assert (np.diff(found) > 0).all()
    # Constant delay of half a burst; the remainder is one burst among 50 of a window.
    late = (burst - 1) / 2 / rate
    np.testing.assert_allclose(found - late, true[kept], atol=1e-6 + burst / 50 / rate)


def test_burst_between_gaps_is_spread_about_its_stamp() -> None:
    stamps = np.concatenate([np.arange(20) * 0.1, [5.0], 8.0 + np.arange(20) * 0.1]).repeat(4)
    found = smooth_duplicate_stamps(stamps)
    np.testing.assert_allclose(found[80:84], 5.0 + 0.025 * np.array([-1.5, -0.5, 0.5, 1.5]))
    assert (np.diff(found) > 0).all()


@settings(max_examples=60, deadline=None)
@given(
    rate=st.floats(300, 3000),
    resolution=st.floats(2.5, 10.0),
    jitter=st.floats(0, 0.3),
    seed=st.integers(0, 2**31),
)
def test_spread_restores_coarse_stamps(
    rate: float, resolution: float, jitter: float, seed: int
) -> None:
    """Stamps with jitter are rounded down to a multiple of several periods."""
    rng = np.random.default_rng(seed)
    true = np.arange(2000) / rate
    step = resolution / rate
    uneven = np.sort(true + rng.uniform(-jitter, jitter, len(true)) / rate)
    stamps = np.floor(uneven / step) * step
    found = smooth_duplicate_stamps(stamps)
    assert (np.diff(found) > 0).all()
    # Rounding down causes a constant delay; the remaining error is halved.
    error, raw = found - true, stamps - true
    assert np.ptp(error) < 0.5 * np.ptp(raw)
    assert error.std() < 0.5 * raw.std()


def record(t: np.ndarray) -> np.ndarray:
    motion = motion_at(t)
    wrench = OFFSETS + non_contact_wrench(motion.specific_force, motion.omega, motion.alpha, PHI)
    return np.hstack([wrench, motion.specific_force, motion.omega])


def write_streams(folder: Path, wrench: pl.DataFrame, imu: pl.DataFrame, **imu_time: float) -> Path:
    wrench.write_parquet(folder / "wrench.parquet")
    imu.write_parquet(folder / "imu.parquet")
    path = folder / "log.yaml"
    path.write_text(
        f"""
wrench:
  file: wrench.parquet
  time: {{column: t, unit: ms}}
  force: {{columns: [f_x, f_y, f_z]}}
  torque: {{columns: [tau_x, tau_y, tau_z]}}
imu:
  file: imu.parquet
  time: {{column: t, offset: {imu_time.get("offset", 0.0)}}}
  specific_force: {{columns: [s_x, s_y, s_z]}}
  angular_velocity: {{columns: [omega_x, omega_y, omega_z]}}
"""
    )
    return path


def frame(t: np.ndarray, names: tuple[str, ...], values: np.ndarray) -> pl.DataFrame:
    return pl.DataFrame({"t": t} | dict(zip(names, values.T, strict=True)))


@pytest.mark.slow
@settings(max_examples=8, deadline=None)
@given(
    offset=st.floats(-50, 50),
    jitter=st.floats(0, 0.3),
    repeated=st.floats(0, 0.1),
    blank=st.floats(0, 0.02),
    gap=st.tuples(st.floats(0.15, 0.7), st.floats(0.05, 1.0)),
    wrench_gap=st.booleans(),
    seed=st.integers(0, 2**31),
)
def test_load_is_identified_despite_clock_errors(
    tmp_path_factory: pytest.TempPathFactory,
    offset: float,
    jitter: float,
    repeated: float,
    blank: float,
    gap: tuple[float, float],
    wrench_gap: bool,
    seed: int,
) -> None:
    """Two clocks with different zero and rate, jitter, repeated rows, missing stamps and a gap."""
    rng = np.random.default_rng(seed)
    tables = []
    for rate, zero, unit, columns, holed in (
        (500.0, 0.0, 1e-3, slice(0, 6), wrench_gap),
        (400.0, offset, 1.0, slice(6, 12), not wrench_gap),
    ):
        t = np.arange(0.0, 8.0, 1 / rate)
        t = t + rng.uniform(-jitter, jitter, len(t)) / rate
        values = record(t)[:, columns]
        stamps = (t - zero) / unit
        stamps[1:][rng.random(len(t) - 1) < blank] = NAN
        rows = np.arange(len(t)).repeat(1 + (rng.random(len(t)) < repeated))
        if holed:
            start, length = 8.0 * gap[0], gap[1]
            rows = rows[(t[rows] < start) | (t[rows] > start + length)]
        names = (
            WRENCH_COLUMNS if unit == 1e-3 else (*SPECIFIC_FORCE_COLUMNS, *ANGULAR_VELOCITY_COLUMNS)
        )
        tables.append(frame(stamps[rows], names, values[rows]))
    folder = tmp_path_factory.mktemp("clocks")
    path = write_streams(folder, *tables, offset=offset)
    found = identify_log(path, delay=0.0)
    load = found.identification
    np.testing.assert_allclose(load.phi, PHI, rtol=3e-3, atol=3e-4)
    start, stop = 8.0 * gap[0], 8.0 * gap[0] + gap[1]
    lost = (found.log.t > start) & (found.log.t < stop)
    assert not lost.any()
    assert any("1 gaps" in note for note in found.log.notes)


def test_interpolated_samples_in_a_gap_are_not_used(tmp_path: Path) -> None:
    """One second of the wrench is missing; interpolation would cause an error of 20 N."""
    t = np.arange(0.0, 8.0, 0.002)
    x = record(t)
    kept = (t < 3.0) | (t > 4.0)
    wrench = frame(1e3 * t[kept], WRENCH_COLUMNS, x[kept, :6])
    imu = frame(t, (*SPECIFIC_FORCE_COLUMNS, *ANGULAR_VELOCITY_COLUMNS), x[:, 6:])
    path = write_streams(tmp_path, wrench, imu)
    bridged = read_log(path)
    assert np.abs(bridged.wrench - record(bridged.t)[:, :6]).max() > 5
    found = identify_log(path)
    assert found.log.t[np.argmax(np.diff(found.log.t))] == pytest.approx(3 - 0.03 - 0.067, abs=0.01)
    assert np.diff(found.log.t).max() == pytest.approx(1 + 2 * (0.03 + 0.067), abs=0.02)
    assert 1 / found.log.dt == pytest.approx(500)
    assert abs(found.identification.delay_s) < 1e-4
    np.testing.assert_allclose(found.identification.phi, PHI, rtol=1e-3, atol=1e-4)
    free = eliminate_log(path, found.identification, causal="delayed")
    assert free.causal is not None
    assert not free.touched.any()
    assert len(free.log) == len(free.contact) == len(free.causal.contact) == len(free.scaled)
    assert np.abs(free.contact).max() < 0.05


def test_unit_of_dates_raises_error() -> None:
    stamps = np.array(["2026-03-01T12:00:00.000", "2026-03-01T12:00:00.002"], "datetime64[ms]")
    table = Table(Path("x.csv"), {"t": stamps, "f": np.zeros(2)})
    with pytest.raises(DrakeTeleopError, match=r"here\.unit.*no unit; leave `unit` out"):
        read_clock(Time(column="t", unit="ms"), table, ["f"], "here")
