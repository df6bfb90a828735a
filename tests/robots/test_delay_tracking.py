"""Tracking of the motion's delay behind the wrench."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_changes import ListSink
from test_compensator import OFFSETS, PHI, load
from test_reading_assembly import DT as WRENCH_DT
from test_reading_assembly import X_FS, StreamStub, played, truth

from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.robots import assembly
from drake_teleop.robots.assembly import (
    DELAY_SAMPLE_PERIOD_S,
    DelayTracker,
    ReadingAssembler,
    WrenchAndMotionStreams,
)
from drake_teleop.robots.compensate import compensate_stream
from drake_teleop.robots.compensator import Compensator
from drake_teleop.robots.streams import POSE, WRENCH

DT = 1.01 * DELAY_SAMPLE_PERIOD_S
NOISE = np.repeat([0.05, 0.0025], 3)


def followed(
    follower: DelayTracker,
    start: float,
    stop: float,
    late: float,
    *,
    push: float = 0.0,
    noise: float = 1.0,
) -> None:
    """Feed wrenches with noise and drifted offsets, and motions whose stamps are `late`.

    A push is [N] along x with the sign of the wrench's slope, as a longer delay would cause.
    """
    rng = np.random.default_rng(0)
    for t in np.arange(start, stop, DT):
        wrench = non_contact_wrench(*np.split(truth(t)[1], 3), PHI) + OFFSETS
        wrench[:3] += 1.0
        wrench += noise * NOISE * rng.normal(size=6)
        error = follower.delay_s - late
        at, before, after = [(t + e, truth(t + e + error)[1]) for e in (0.0, -0.001, 0.001)]
        ends = (non_contact_wrench(*np.split(each[1], 3), PHI)[0] for each in (before, after))
        wrench[0] += push * np.sign(-np.subtract(*ends))
        follower.update_delay(at, wrench, before, after)


@pytest.mark.slow
@pytest.mark.quick_cases(1)
@pytest.mark.parametrize("late", [-0.006, 0.011])
def test_delay_is_estimated_and_tracked(late: float) -> None:
    follower = DelayTracker(load(), 0.001, 30.0, 0.0)
    followed(follower, 0.0, 3.0, late)
    assert follower.delay_s == pytest.approx(late, abs=2e-4)
    followed(follower, 3.0, 5.0, late + 0.003)
    assert late + 5e-4 < follower.delay_s < late + 0.003


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "samples", "late"), [(1.0, 80, 0.006), (4.0, 200, -0.01)])
def test_delay_stays_until_it_is_certain_and_then_changes_slowly(
    noise: float, samples: int, late: float
) -> None:
    """Noise beyond the stated one takes longer."""
    follower = DelayTracker(load(), 0.001, 30.0, 0.0)
    followed(follower, 0.0, (samples - 0.5) * DT, late, noise=noise)
    assert follower.delay_s == 0.0
    for k in range(samples, samples + 280, 20):
        before = follower.delay_s
        followed(follower, k * DT, (k + 19.5) * DT, late, noise=noise)
        assert 0.0 <= (follower.delay_s - before) * np.sign(late) <= 0.005 * 20.1 * DT
    assert follower.delay_s * np.sign(late) > 1e-3


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_delay_is_at_most_100_ms(side: float) -> None:
    follower = DelayTracker(load(), 0.001, 30.0, side * 0.099)
    followed(follower, 0.0, 1.1, side * 0.115)
    assert follower.delay_s == side * 0.1


@pytest.mark.slow
def test_contact_is_excluded_and_a_new_clock_restarts_the_tracking() -> None:
    follower = DelayTracker(load(), 0.001, 30.0, 0.005)
    followed(follower, 0.0, 1.0, 0.005)
    followed(follower, 1.0, 2.0, 0.005, push=5.0)
    assert follower.delay_s == pytest.approx(0.005, abs=5e-4)
    followed(follower, 2.0, 3.5, 0.007)  # and is followed at once after it
    assert follower.delay_s > 0.0057
    followed(follower, -50.0, -48.5, 0.007)
    assert follower.delay_s == pytest.approx(0.007, abs=3e-4)


def test_delay_is_constant_at_rest() -> None:
    follower = DelayTracker(load(), 0.001, 30.0, 0.005)
    rest, rng = truth(0.3)[1], np.random.default_rng(0)
    rest[3:] = 0.0
    still = non_contact_wrench(*np.split(rest, 3), PHI) + OFFSETS
    for t in np.arange(0.0, 2.0, DT):
        shaken = rest + np.repeat([1e-3, 0.0], [3, 6]) * rng.normal(size=9)
        wrench = still + NOISE * rng.normal(size=6)
        follower.update_delay((t, rest), wrench, (t - 0.001, rest), (t + 0.001, shaken))
    assert follower.delay_s == 0.005


@pytest.mark.slow
def test_another_load_takes_over_the_delay_and_tracks_it() -> None:
    stub = StreamStub(WRENCH, POSE)
    stub.read = lambda timeout_s: None  # the stream ends at once
    streams = WrenchAndMotionStreams(stub)
    other = replace(load(), offsets=OFFSETS - 30.0)
    tracked = ReadingAssembler(streams, X_FS=X_FS, track=other, delay_s=0.001)
    for each in played(tracked, 0.5, later=0.004):
        assert each.t < 0.5 and tracked.delay_s == 0.001  # no sample agrees with this load
    compensate_stream(tracked, Compensator(load(), WRENCH_DT), ListSink())
    assert tracked.delay_s == 0.001
    list(played(tracked, 1.6, later=0.004))
    assert tracked.delay_s == pytest.approx(0.004, abs=3e-4)
    fixed = ReadingAssembler(streams, X_FS=X_FS, delay_s=0.002)
    fixed.track_delay_with(load())
    played(fixed, 1.6, later=0.004)
    assert fixed.delay_s == 0.002


def test_the_same_load_does_not_restart_the_tracking(monkeypatch: pytest.MonkeyPatch) -> None:
    known, streams = load(), WrenchAndMotionStreams(StreamStub(WRENCH, POSE))
    tracked = ReadingAssembler(streams, X_FS=X_FS, track=known)
    monkeypatch.setattr(assembly, "DelayTracker", lambda *_: pytest.fail("restarted"))
    tracked.track_delay_with(known)


@pytest.mark.slow
def test_assembly_tracks_an_unknown_delay() -> None:
    """Poses are stamped 4 ms late."""
    tracked = ReadingAssembler(
        WrenchAndMotionStreams(StreamStub(WRENCH, POSE)), X_FS=X_FS, track=load()
    )
    good = [each for each in played(tracked, 1.6, later=0.004) if not each.flags]
    assert tracked.delay_s == pytest.approx(0.004, abs=2e-4)
    assert good[-1].t > 1.6 - 0.035 - WRENCH_DT
    wanted = np.array([truth(each.t)[1] for each in good[-50:]])
    motion = np.array([each.values[6:] for each in good[-50:]])
    worst = np.abs(motion - wanted).max(axis=0)
    np.testing.assert_array_less(worst, np.repeat([0.05, 0.01, 0.2], 3))
