"""Readings from separate streams of wrench and motion."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from test_compensator import OFFSETS, PHI, load

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.rotations import rotation_matrices
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.robots import connections
from drake_teleop.robots.assembly import (
    ReadingAssembler,
    WrenchAndMotionStreams,
    _ClockOffsetEstimator,
    pose_from_rpy,
)
from drake_teleop.robots.compensator import Compensator
from drake_teleop.robots.connections import open_source
from drake_teleop.robots.streams import IMU, POSE, WRENCH, Reading, ReadingFlag

DT, GRAVITY = 0.001, np.array([0.0, 0.0, 9.81])
X_FS = np.array([math.cos(0.3), 0.0, math.sin(0.3), 0.0, 0.02, -0.03, 0.08])


def turn(axis: int, angle: float) -> np.ndarray:
    c, s, R = math.cos(angle), math.sin(angle), np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R[i, i], R[j, j], R[i, j], R[j, i] = c, c, -s, s
    return R


def truth(t: float) -> tuple[np.ndarray, np.ndarray]:
    """Return X_WF (7,) and the motion (9,) of S in closed form: R_WF = Rz(a) Rx(b), linear b."""
    a, da, dda = 0.5 * math.sin(4 * t), 2.0 * math.cos(4 * t), -8.0 * math.sin(4 * t)
    b, db = 0.7 * t, 0.7
    R_WF = turn(2, a) @ turn(0, b)
    z = turn(0, b).T @ [0.0, 0.0, 1.0]  # in F, as are those that follow
    omega = da * z + [db, 0.0, 0.0]
    alpha = dda * z + da * np.cross(z, [db, 0.0, 0.0])
    p, ddp = np.array([0.1 * math.sin(5 * t), 0.2, 0.0]), np.array([-2.5 * math.sin(5 * t), 0, 0])
    R_FS, r = turn(1, 0.6), X_FS[4:]
    origin = R_WF.T @ (ddp + GRAVITY)
    s = origin + np.cross(alpha, r) + np.cross(omega, np.cross(omega, r))
    half = (math.cos(a / 2) * math.cos(b / 2), math.cos(a / 2) * math.sin(b / 2))
    other = (math.sin(a / 2) * math.sin(b / 2), math.sin(a / 2) * math.cos(b / 2))
    pose = np.array([*half, *other, *p])
    return pose, np.concatenate([R_FS.T @ x for x in (s, omega, alpha)])


class StreamStub:
    """Source of streams without data."""

    def __init__(self, *streams: str) -> None:
        self.dt, self.streams = DT, streams

    def read(self, timeout_s: float) -> list[Reading]:
        return []

    def close(self) -> None:
        pass


def wrench_at(t: float, k: int) -> Reading:
    motion = np.split(truth(t)[1], 3)
    return Reading(k, t, non_contact_wrench(*motion, PHI) + OFFSETS, stream=WRENCH)


def played(
    assembly: ReadingAssembler, seconds: float, *, lost=lambda k: False, later: float = 0.0
) -> list[Reading]:
    """Feed wrenches at 1 kHz and poses at 500 Hz, with clock offset `later` and lost poses."""
    found = []
    for k in range(round(seconds / DT)):
        t = k * DT
        if k % 2 == 0 and not lost(k):
            found += assembly.readings_completed_by(
                Reading(k // 2, t + later, truth(t)[0], stream=POSE, arrival=t)
            )
        found += assembly.readings_completed_by(wrench_at(t, k)._replace(arrival=t))
    return found


@pytest.mark.parametrize("lost", [lambda k: False, lambda k: k % 14 == 0])
def test_motion_belongs_to_the_instant_of_the_wrench(lost) -> None:
    found = played(
        ReadingAssembler(WrenchAndMotionStreams(StreamStub(WRENCH, POSE)), X_FS=X_FS),
        0.4,
        lost=lost,
    )
    good = [each for each in found if not each.flags]
    assert len(good) > 200 and good[-1].t > 0.4 - 0.035  # half a window late
    wanted = np.array([truth(each.t)[1] for each in good])
    motion = np.array([each.values[6:] for each in good])
    worst = np.abs(motion - wanted).max(axis=0)
    np.testing.assert_array_less(worst, np.repeat([0.01, 0.002, 0.1], 3))
    compensator = Compensator(load(), DT)
    out = [compensator.step(each, each.t) for each in found]
    assert not any(row.contact.any() for row in out if row.flags)
    left = np.array([row.contact for row in out if not row.flags])
    assert len(left) > 200 and np.abs(left).max() < 0.03  # of 17 N


@pytest.mark.parametrize("rate_hz", [0.3, 1.0, 5.0, 100.0])
def test_slow_wrenches_receive_their_motion(rate_hz: float) -> None:
    streams = WrenchAndMotionStreams(StreamStub(WRENCH, POSE))
    streams.dt = 1.0 / rate_hz
    assembly, found = ReadingAssembler(streams, X_FS=X_FS), []
    for k in range(1000):
        t = 0.002 * k
        pose = Reading(k, t, truth(t)[0], stream=POSE, arrival=t)
        found += assembly.readings_completed_by(pose)
        if k == 900:
            found += assembly.readings_completed_by(wrench_at(t, k)._replace(arrival=t))
    (reading,) = found
    assert reading.flags == 0 and reading.t == 1.8
    np.testing.assert_allclose(reading.values[6:9], truth(1.8)[1][:3], atol=0.01)


@pytest.mark.parametrize("cutoff_hz", [30.0, 100.0])
@pytest.mark.parametrize("rate_hz", [40, 100, 500])
def test_stated_lag_is_that_of_the_window(rate_hz: int, cutoff_hz: float) -> None:
    """The window has at least seven poses, so that slow poses are later than 0.9 / cut-off."""
    streams = WrenchAndMotionStreams(StreamStub(WRENCH, POSE))
    assembly, ages = ReadingAssembler(streams, cutoff_hz=cutoff_hz), []
    for k in range(1000):
        t, found = k * DT, assembly.readings_completed_by(wrench_at(k * DT, k))
        if k % (1000 // rate_hz) == 0:
            pose = Reading(k, t, truth(t)[0], stream=POSE, arrival=t)
            found += assembly.readings_completed_by(pose)
        ages += [t - each.t for each in found if not each.flags]
    assert min(ages) > assembly.lag_s - 1e-9
    assert max(ages) < assembly.lag_s + 2.0 / rate_hz


@pytest.mark.quick_cases(2)
@pytest.mark.parametrize(
    ("delay", "first", "last"), [("auto", 0.003, 0.004), (0.0, 0.0, 0.0), (-0.01, -0.01, -0.01)]
)
def test_only_an_automatic_delay_is_tracked_from_that_of_the_load(
    delay: str | float, first: float, last: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Poses are stamped 4 ms late."""
    posed = StreamStub(WRENCH, POSE)
    monkeypatch.setattr(connections, "_open_registered_source", lambda *_: posed)
    known = dataclasses.replace(load(), delay_s=0.003)
    place = (*X_FS[4:], 0.0, math.degrees(0.6), 0.0)
    source = open_source("posed", known, rate_hz=500.0, delay=delay, sensor_pose=place)
    assert source.delay_s == first
    played(source, 0.8, later=0.004)
    assert source.delay_s == pytest.approx(last, abs=3e-4 if delay == "auto" else 0.0)


def test_pose_of_the_sensor_is_refused_for_an_imu(monkeypatch: pytest.MonkeyPatch) -> None:
    stubs = {"imu": StreamStub(WRENCH, IMU), "posed": StreamStub(WRENCH, POSE)}
    monkeypatch.setattr(connections, "_open_registered_source", lambda at, *_: stubs[at])
    pose = {"sensor_pose": (0.0, 0.0, 0.1, 0.0, 0.0, 90.0)}
    with pytest.raises(DrakeTeleopError, match=r"^imu: .* remove --sensor-pose"):
        open_source("imu", load(), rate_hz=500.0, **pose)
    with pytest.raises(DrakeTeleopError, match=r"^imu: .* remove --sensor-pose"):
        open_source("posed", load(), rate_hz=500.0, motion="imu", **pose)
    open_source("posed", load(), rate_hz=500.0, **pose)
    open_source("imu", load(), rate_hz=500.0)


def test_only_inertial_wrench_is_subtracted_if_the_weight_is_removed() -> None:
    """The removed weight has the same orientation, so that only mass times acceleration remains."""
    assembly = ReadingAssembler(
        WrenchAndMotionStreams(StreamStub(WRENCH, POSE)), X_FS=X_FS, weight_removed=True
    )
    found = [each for each in played(assembly, 0.4) if not each.flags]
    rest, left = np.zeros(3), []
    for each in found:
        R_WS = rotation_matrices(truth(each.t)[0][None, :4], "quaternion_wxyz")[0] @ turn(1, 0.6)
        weight = non_contact_wrench(R_WS.T @ GRAVITY, rest, rest, PHI)
        motion = np.split(each.values[6:], 3)
        left.append(each.values[:6] - weight - OFFSETS - non_contact_wrench(*motion, PHI))
    assert len(left) > 200 and np.abs(left).max() < 0.03
    with pytest.raises(DrakeTeleopError, match="without an orientation"):
        ReadingAssembler(WrenchAndMotionStreams(StreamStub(WRENCH, IMU)), weight_removed=True)
    weightless = dataclasses.replace(load(), weight_removed=True)
    with pytest.raises(DrakeTeleopError, match=r"udp://:0.*without an orientation"):
        open_source("udp://:0", weightless, rate_hz=500.0)
    with pytest.raises(DrakeTeleopError, match=r"^replay:log\.csv: .*; remove --motion$"):
        open_source("replay:log.csv", None, motion="udp://:0")


def test_motion_on_another_clock_is_synchronised() -> None:
    apart = ReadingAssembler(
        WrenchAndMotionStreams(StreamStub(WRENCH), StreamStub(POSE)), X_FS=X_FS
    )
    same = ReadingAssembler(WrenchAndMotionStreams(StreamStub(WRENCH, POSE)), X_FS=X_FS)
    a, b = played(apart, 0.3, later=1e4), played(same, 0.3)
    good = [each.values for each in a if not each.flags], [x.values for x in b if not x.flags]
    np.testing.assert_allclose(good[0][-150:], good[1][-150:], atol=1e-4)
    late = ReadingAssembler(
        WrenchAndMotionStreams(StreamStub(WRENCH), StreamStub(POSE)), X_FS=X_FS, delay_s=0.01
    )
    assert [same.lag_s, late.lag_s] == pytest.approx([0.5 * 1.8 / 30.0, 0.5 * 1.8 / 30.0 + 0.01])
    shifted = [each for each in played(late, 0.3, later=1e4) if not each.flags]
    np.testing.assert_allclose(shifted[-1].values[6:], truth(shifted[-1].t + 0.01)[1], atol=0.1)


def test_offset_of_a_slow_clock_increases() -> None:
    rng, clock = np.random.default_rng(0), _ClockOffsetEstimator()
    for now in np.arange(0.0, 100.0, 0.01):
        clock.update_offset(now * (1.0 - 5e-4), now + 0.01 * rng.random())
    assert clock.offset == pytest.approx(0.05, abs=2e-3)


def test_readings_are_stale_without_poses_and_recover() -> None:
    assembly = ReadingAssembler(WrenchAndMotionStreams(StreamStub(WRENCH, POSE)), X_FS=X_FS)
    found = played(assembly, 0.6, lost=lambda k: 200 <= k < 280)
    assert not any(0.2 <= each.t < 0.28 for each in found if not each.flags)
    assert {each.flags for each in found} == {0, int(ReadingFlag.STALE)}
    assert [each.flags for each in found[-150:]] == [0] * 150


def test_invalid_and_out_of_order_poses_are_ignored() -> None:
    assembly = ReadingAssembler(WrenchAndMotionStreams(StreamStub(WRENCH, POSE)), X_FS=X_FS)
    played(assembly, 0.3)
    for values, t in (
        (np.full(7, math.nan), 0.3),
        (truth(0.2)[0], 0.2),
        (truth(0.3)[0], math.nan),
        (truth(0.3)[0], math.inf),
    ):
        assert assembly.readings_completed_by(Reading(0, t, values, stream=POSE, arrival=0.3)) == []
    after = [
        each
        for k in range(300, 400)
        for each in assembly.readings_completed_by(wrench_at(k * DT, k)._replace(arrival=k * DT))
    ]
    assert after == []  # unknown motion


def test_assembly_accepts_a_clock_that_is_set_back() -> None:
    assembly = ReadingAssembler(WrenchAndMotionStreams(StreamStub(WRENCH, POSE)), X_FS=X_FS)
    compensator = Compensator(load(), DT)
    for each in played(assembly, 0.2):
        compensator.step(each, each.t + 0.03)
    out = []
    for k in range(300):
        t, now = k * DT - 50.0, 0.2 + k * DT
        parts = [Reading(200 + k, t, wrench_at(t, 0).values, stream=WRENCH)]
        if k % 2 == 0:
            parts.insert(0, Reading(k, t, truth(t)[0], stream=POSE))
        for part in parts:
            out += [
                compensator.step(each, now)
                for each in assembly.readings_completed_by(part._replace(arrival=now))
            ]
    left = [row.contact for row in out if not row.flags]
    assert len(left) > 50 and np.abs(left).max() < 0.03
    assert any(row.flags & ReadingFlag.CLOCK_JUMP for row in out)


def test_imu_gives_the_motion() -> None:
    assembly, found = ReadingAssembler(WrenchAndMotionStreams(StreamStub(WRENCH, IMU))), []
    for k in range(250):
        t = k * DT
        found += assembly.readings_completed_by(
            Reading(k, t, truth(t)[1][:6], stream=IMU, arrival=t)
        )
        found += assembly.readings_completed_by(wrench_at(t, k)._replace(arrival=t))
    good = [each for each in found if not each.flags]
    wanted = np.array([truth(each.t)[1] for each in good])
    motion = np.array([each.values[6:] for each in good])
    np.testing.assert_array_less(np.abs(motion - wanted).max(axis=0), [0.01] * 6 + [0.1] * 3)


def test_wrench_without_motion_is_refused() -> None:
    with pytest.raises(DrakeTeleopError, match=r"^ros2://ft: delivers no motion; give --motion"):
        WrenchAndMotionStreams(StreamStub(WRENCH), where="ros2://ft")


def test_log_is_not_recommended_as_source_of_the_motion_alone() -> None:
    match = r"^replay:a.csv: is not the address of a source; give (?!.*replay:LOG)"
    with pytest.raises(DrakeTeleopError, match=match):
        open_source("posed://127.0.0.1:0", None, rate_hz=500.0, motion="replay:a.csv")


@pytest.mark.parametrize("angles", [(20.0, -35.0, 110.0), (0.0, 80.0, 30.0), (-170.0, 5.0, 0.0)])
def test_pose_of_the_sensor_has_fixed_axes_as_in_a_urdf(angles: tuple[float, ...]) -> None:
    roll, pitch, yaw = np.radians(angles)
    pose = pose_from_rpy((0.1, -0.2, 0.3, *angles))
    R = rotation_matrices(pose[None, :4], "quaternion_wxyz")[0]
    np.testing.assert_allclose(R, turn(2, yaw) @ turn(1, pitch) @ turn(0, roll), atol=1e-12)
    np.testing.assert_array_equal(pose[4:], [0.1, -0.2, 0.3])
