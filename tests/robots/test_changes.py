"""A tare and a grasp in a stream are reported once, with their time; contact is not."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_watch import DT, LOAD, OFFSETS, PHI

from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.causes.instants import NUM_SIGNALS, SPECIFIC_FORCE_SIGNALS
from drake_teleop.logs.causes.model import LoadModel, StepChange
from drake_teleop.logs.read.canonical import Log, write_log
from drake_teleop.robots import changes
from drake_teleop.robots.changes import ZeroAndLoadMonitor
from drake_teleop.robots.compensate import compensate_stream, run_compensate_command
from drake_teleop.robots.compensator import Compensator
from drake_teleop.robots.streams import CompensatedWrench, Reading, ReadingFlag
from drake_teleop.robots.watch import ContactAndLoadMonitor

OBJECT = phi_from_mass_com_inertia(0.4, [0.0, 0.01, 0.15], np.diag([1e-3, 1e-3, 5e-4]))
ZERO = np.array([2.0, -1.0, 3.0, 0.05, 0.1, -0.1])
Values = np.ndarray


def stream(rest_s: float | None = None, seconds: float = 14.0, seed: int = 0) -> Values:
    """Return readings (N, 15) of a tool that rotates about three axes, at rest from `rest_s` on."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(round(seconds / DT))
    angles = 0.8 * np.sin(np.outer(t, [0.9, 1.3, 0.7]) + rng.uniform(0.0, 6.0, 3))
    if rest_s is not None:
        share = np.clip(rest_s - t, 0.0, 1.0)[:, None]
        angles *= share**2 * (3.0 - 2.0 * share)
    R = Rotation.from_euler("xyz", angles)
    turned = (R[:-1].inv() * R[1:]).as_rotvec() / DT
    omega = np.vstack([turned, turned[-1:]])
    motion = R.inv().apply([0.0, 0.0, 9.81]), omega, np.gradient(omega, DT, axis=0)
    noise = rng.normal(size=(len(t), 6)) * np.repeat([0.1, 0.005], 3)
    return np.hstack([non_contact_wrench(*motion, PHI) + OFFSETS + noise, *motion])


def loaded(values: Values, phi: Values) -> Values:
    return non_contact_wrench(values[:, 6:9], values[:, 9:12], values[:, 12:], phi)


class ReadingSource:
    """Source that ends."""

    dt = DT

    def __init__(self, values: Values, *, live: bool) -> None:
        self.live = live
        self._left = [Reading(k, DT * k, row) for k, row in enumerate(values)]

    def read(self, timeout_s: float) -> list[Reading] | None:
        now, self._left = self._left[:50], self._left[50:]
        return now or None

    def close(self) -> None:
        pass


class ListSink:
    """Sink that stores all outputs."""

    def __init__(self) -> None:
        self.out: list[CompensatedWrench] = []

    def write(self, out: CompensatedWrench) -> None:
        self.out.append(out)

    def close(self) -> None:
        pass


def compensated(
    values: Values, *, looked_for: bool = True, live: bool = False
) -> tuple[list[CompensatedWrench], list[str]]:
    """Return outputs and reports."""
    messages: list[str] = []
    sought = ZeroAndLoadMonitor(DT, live=live, report=messages.append) if looked_for else None
    sink = ListSink()
    compensator = Compensator(LOAD, DT, watch=ContactAndLoadMonitor(LOAD, DT, 30.0))
    # As fast as possible: the clock of the loop is that of the readings.
    compensate_stream(ReadingSource(values, live=False), compensator, sink, changes=sought)
    if sought is not None:
        sought.close()
    return sink.out, messages


def time_of(report: str) -> float:
    return float(re.match(r"t = ([\d.]+) s: ", report)[1])  # type: ignore[index]


def tare(values: Values, k: int) -> None:
    values[k:, :6] += ZERO


def grasp(values: Values, k: int) -> None:
    values[k:, :6] += loaded(values, OBJECT)[k:]


def release(values: Values, k: int) -> None:
    values[k:, :6] -= loaded(values, 0.5 * PHI)[k:]


@pytest.mark.slow
@pytest.mark.parametrize("time", [5.513, 8.0])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (tare, "another zero, +2 -1 +3"),
        (grasp, "another load, +0.4 kg"),
        (release, "another load, -0.85 kg"),
    ],
)
def test_change_is_reported_once_with_time_and_size(
    change: Callable[[Values, int], None], words: str, time: float
) -> None:
    values = stream(seed=round(time))
    change(values, round(time / DT))
    out, messages = compensated(values)
    assert len(messages) == 1 and time_of(messages[0]) == pytest.approx(time, abs=0.02)
    kind, *sizes = words.split(", ")
    numbers = [float(x) for x in re.findall(r"[+-][\d.]+", sizes[0])]
    found = [float(x) for x in re.findall(r"[+-][\d.]+", messages[0])]
    assert kind in messages[0]
    np.testing.assert_allclose(found[: len(numbers)], numbers, atol=0.02)
    if change is not tare:
        assert out[-1].flags & ReadingFlag.OTHER_LOAD


@pytest.mark.slow
def test_tare_and_later_grasp_are_both_reported() -> None:
    values = stream(seconds=20.0)
    tare(values, round(5.0 / DT))
    grasp(values, round(11.0 / DT))
    messages = compensated(values)[1]
    assert ["zero" in messages[0], "load" in messages[1]] == [True, True]
    assert [time_of(x) for x in messages] == pytest.approx([5.0, 11.0], abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("push", [[1, 2, -6, 0.3, 0.1, 0], [0, 0, -4, 0.1, 0, 0]])
def test_push_at_rest_is_not_reported(push: list[float]) -> None:
    values = stream(rest_s=5.0)
    values[round(6.0 / DT) :, :6] += push
    out, messages = compensated(values)
    assert messages == [] and out[-1].flags == ReadingFlag.IN_CONTACT


@pytest.mark.slow
def test_varying_contact_and_free_motion_are_not_reported() -> None:
    values = stream()
    assert compensated(values)[1] == []
    t = DT * np.arange(len(values))
    size = np.where(np.abs(t - 8.0) < 2.0, 8.0 * np.cos(5.0 * t), 0.0)
    values[:, :6] += size[:, None] * np.array([1.0, -0.5, 0.3, 0.05, 0.1, 0.0])
    out, messages = compensated(values)
    assert messages == [] and any(row.flags & ReadingFlag.IN_CONTACT for row in out)


@pytest.mark.slow
def test_monitoring_does_not_change_the_wrenches() -> None:
    values = stream()
    tare(values, round(6.0 / DT))
    (out, _), (plain, _) = (compensated(values, looked_for=x) for x in (True, False))
    for one, other in zip(out, plain, strict=True):
        np.testing.assert_array_equal(one.contact, other.contact)
        assert one.flags == other.flags and one.t == other.t


@pytest.mark.parametrize(("rest", "certain"), [((0.0, 5.0), True), ((5.0, 9.0), False)])
def test_kind_of_a_change_needs_rotations_after_it(
    rest: tuple[float, float], certain: bool
) -> None:
    """The other kind explains the record worse by 25 in the likelihood, or by 15."""
    t, y = np.arange(0.1, 9.0, 0.02), np.zeros((445, NUM_SIGNALS))
    moves = ~((t >= rest[0]) & (t <= rest[1]))
    y[moves, SPECIFIC_FORCE_SIGNALS] = np.sin(3.0 * t[moves, None] + np.arange(3))
    for other, expected in ((-25.0, certain), (-15.0, False)):
        state = SimpleNamespace(
            model=LoadModel(steps=(StepChange("load", 5.0),)),
            means=SimpleNamespace(t=t, y=y, used=np.ones(len(t), bool)),
            x=np.zeros(27),
            log_likelihood=0.0,
            refit=lambda model, start, other=other: SimpleNamespace(log_likelihood=other),
        )
        assert changes._is_change_kind_certain(state, 5.0) == expected


@pytest.mark.slow
def test_live_stream_is_explained_by_another_process() -> None:
    values = stream()
    grasp(values, round(6.0 / DT))
    messages = compensated(values, live=True)[1]
    assert len(messages) == 1 and time_of(messages[0]) == pytest.approx(6.0, abs=0.02)


def test_failing_explanation_does_not_stop_the_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(rows: Values, dt: float) -> list[tuple[float, str]]:
        raise np.linalg.LinAlgError("singular")

    monkeypatch.setattr(changes, "find_zero_and_load_changes", fail)
    values = stream(seconds=8.0)
    tare(values, round(4.0 / DT))
    out, messages = compensated(values)
    assert len(out) == len(values)
    assert messages and all("another load (singular)" in words for words in messages)


@pytest.mark.parametrize("restart", [5.0, 5.7, 4.6, 0.0])
def test_change_on_a_restarted_clock_is_reported_again(
    monkeypatch: pytest.MonkeyPatch, restart: float
) -> None:
    """Each test finds the change that is 1 s after the start of the record."""
    monkeypatch.setattr(
        changes, "find_zero_and_load_changes", lambda rows, dt: [(float(rows[0, 0]) + 1.0, "tare")]
    )
    messages: list[str] = []
    sought = ZeroAndLoadMonitor(0.01, live=False, report=messages.append)
    for number, start in enumerate([5.0, restart], 1):
        for k in range(1600):  # two tests each
            reading = Reading(k, start + 0.01 * k, np.zeros(15))
            sought.add_reading(reading, int(ReadingFlag.IN_CONTACT))
        assert messages == ["tare"] * number
    sought.close()


def test_record_contains_the_last_20_s_after_a_clock_change() -> None:
    seen = []
    sought = ZeroAndLoadMonitor(DT, live=False, report=print)
    sought._executor.shutdown()
    sought._next_attempt = np.inf
    row = np.zeros(15)
    for k, t in enumerate([0.0, *(50.0 + DT * np.arange(11_000))]):
        sought.add_reading(Reading(k, t, row + t), int(ReadingFlag.STALE if k == 500 else 0))
    seen = sought._rows_in_time_order()[:, 0]
    assert len(seen) == 10_000 and (np.diff(seen) > 0.0).all()
    assert seen[-1] == pytest.approx(50.0 + DT * 10_999)
    sought.add_reading(Reading(0, 3.0, row), 0)
    assert sought._rows_in_time_order()[:, 0].tolist() == [3.0]


@pytest.mark.slow
def test_the_command_reports_the_time_of_a_tare(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    values = stream()
    tare(values, round(6.0 / DT))
    log = Log(DT * np.arange(len(values)), *np.split(values, [6, 9, 12], axis=1))
    write_log(log, tmp_path / "log.parquet")
    LOAD.save(tmp_path / "load.json")
    source, sink = f"replay:{tmp_path}/log.parquet", f"{tmp_path}/out.csv"
    run_compensate_command(source, tmp_path / "load.json", sink, watch=True, delay=0.0)
    messages = capfd.readouterr().err
    assert messages.count("the sensor has another zero") == 1
    assert "t = 6.00 s: the sensor has another zero" in messages
