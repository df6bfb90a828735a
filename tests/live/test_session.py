"""A drive with inputs between slices, and its repetition to the same bytes."""

from __future__ import annotations

import json
import shutil
import threading
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from drake_teleop.cli.main import main
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import DRIVE_INPUTS_FILE_NAME, models_dir
from drake_teleop.common.progress import show_no_progress
from drake_teleop.lab.identification import slave_arm
from drake_teleop.live.hand import TARGET_LEAD_TIME_S
from drake_teleop.live.inputs import (
    INPUT_RANGES,
    Inputs,
    csv_header,
    csv_row,
    read_inputs,
)
from drake_teleop.live.record import LOAD_FILE, BackgroundLog, SessionRecord
from drake_teleop.live.session import RecordedDrive, Session, read_drive
from drake_teleop.live.station_swap import CrossFade
from drake_teleop.load.regressor import sample_size
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.passivity.methods import METHODS
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import Scenario, replace
from drake_teleop.station.slave.arm import forward_kinematics

END = 300  # ms


def script(scenario: Scenario) -> list[tuple[int, Inputs]]:
    """Return inputs: a press, ramps of sliders, clutch, object, release, another network."""
    now, changes = Inputs.from_scenario(scenario), []
    for ms in range(0, END, 20):
        now = now.with_changes(
            {"z": -20 * ms, "rx": 2 * ms, "sigma": ms // 3, "gamma": 100 + ms // 5}
            | {"force_scale": 5714 + 10 * ms, "clutch": ms not in (160, 180)}
            | {"held": ms < 240, "object": ms >= 220}
            | ({"network": 2, "method": 4} if ms >= 260 else {})
        )
        changes.append((ms, now))
    return [*changes, (END, now)]


def same(one: SimulationResult, other: SimulationResult) -> bool:
    return list(one) == list(other) and all(
        np.array_equal(one[name], other[name], equal_nan=True) for name in ("t", *one)
    )


@pytest.fixture(scope="module")
def driven(scenario, load, tmp_path_factory):
    """Return the folder and the log of a drive in slices."""
    folder = tmp_path_factory.mktemp("drive")
    session = Session(scenario, load, log=folder / "log.parquet", record=folder)
    changes = dict(script(scenario))
    while session.ms < END:
        session.apply_inputs(changes.get(session.ms, session.inputs))
        session.advance()
        if session.ms % 50 == 0:
            session.new_rows()
            session.write_record_and_log()
    session.close()
    return folder, SimulationResult.read_parquet(folder / "log.parquet")


@pytest.mark.slow
def test_recorded_drive_repeats_for_any_slices(driven, scenario, load):
    folder, log = driven
    drive = read_drive(folder)
    assert drive.scenario == replace(scenario, simulation__duration=1e-3 * END)
    assert dict(drive.changes).items() >= dict(script(scenario)).items()
    for slice_ms in (1, 7, END):
        assert same(drive.repeat(show_no_progress(""), slice_ms=slice_ms), log)
    assert len(log.t) == END + 1 and np.abs(log["true_contact_wrench_W"][:, 2]).max() > 5.0
    # One input one slice late is another drive.
    late = [(ms + 5 * (ms == 100), inputs) for ms, inputs in script(scenario)]
    assert not same(RecordedDrive(scenario, load, late).repeat(show_no_progress("")), log)


@pytest.mark.slow
def test_signals_are_continuous_when_inputs_change(driven, scenario):
    _, log = driven
    step = np.abs(np.diff(log["pose_command"][:, 4:], axis=0)).max()
    assert step < 1e-3  # at 1 kHz, less than 1 m/s
    assert np.abs(np.diff(log["intent"][:239, 4:], axis=0)).max() < 6e-4
    free = log["force_to_master"][:80, :3]  # before the leaf
    assert np.abs(free).max() > 0.1 and np.abs(np.diff(free, axis=0)).max() < 0.02
    # The command is constant while the clutch is open, and continues from there.
    held = log["pose_command"][170:180]
    assert np.ptp(held, axis=0).max() == 0.0
    assert np.ptp(log["pose_command"][210:230], axis=0).max() > 1e-4


@pytest.mark.slow
def test_new_network_and_method_continue_the_state(scenario, load):
    """The channel changes in contact and back; the rendered wrench cross-fades."""
    session = Session(scenario, load)
    now = session.inputs.with_changes({"z": -2900})
    for end, change in ((250, {}), (1050, {"network": 2, "method": 4}), (1400, {"network": 0})):
        now = now.with_changes(change | ({"method": 0} if end == 1400 else {}))
        session.apply_inputs(now)
        assert session.is_channel_filling == bool(change)
        while session.ms < end:
            session.advance()
    log = session.log()
    np.testing.assert_allclose(np.diff(log.t), 1e-3, atol=1e-12)
    assert np.linalg.norm(log["true_contact_wrench_W"][200:, :3], axis=1).min() > 3.0
    rendered, command = log["force_to_master"][:, 2], log["pose_received"][:, 4:]
    for k in (250, 1050):
        np.testing.assert_array_equal(command[k + 2], command[k])
        np.testing.assert_allclose(rendered[k : k + 6], rendered[k], atol=1e-3)
        assert np.abs(np.diff(rendered[k:])).max() < 0.02
    # The number of steps of a slice is limited.
    assert session._station.simulator.get_integrator().get_num_steps_taken() <= 4 * (1400 - 1050)
    # The clutch is closed at the end, and the channel delivers packets.
    assert np.ptp(command[260:1000], axis=0).max() < 1e-15
    assert (
        not session.is_channel_filling
        and session.apply_inputs(now.with_changes({"z": -1000})) is None
    )
    session.advance(100)
    assert session.log()["pose_command"][-1, 6] > command[-1, 2] + 1e-3


def test_rendered_wrench_cross_fades_at_a_constant_wrench():
    simulator = Simulator(CrossFade(1e-3))
    cross_fade, context = simulator.get_system(), simulator.get_mutable_context()
    wrench = np.array([3.0, 0.0, 4.0, 0.1, 0.2, 0.3])
    cross_fade.get_input_port().FixValue(context, wrench)
    rendered = cross_fade.get_output_port()
    np.testing.assert_array_equal(rendered.Eval(context), wrench)
    cross_fade.StartFade(context, 0.1, 0.2, np.ones(6))
    np.testing.assert_array_equal(rendered.Eval(context), np.ones(6))
    simulator.AdvanceTo(0.1995)
    np.testing.assert_allclose(rendered.Eval(context), (1.0 + wrench) / 2, atol=0.05)
    cross_fade.LimitForce(context, 2.5)
    simulator.AdvanceTo(0.4)
    np.testing.assert_allclose(rendered.Eval(context), wrench / 2, rtol=1e-12)
    cross_fade.get_input_port().FixValue(context, wrench / 2)
    simulator.AdvanceTo(0.402)
    cross_fade.get_input_port().FixValue(context, wrench)
    np.testing.assert_array_equal(rendered.Eval(context), wrench)


@pytest.mark.slow
def test_force_limit_of_a_new_channel_ends_after_the_hand_eases_off(scenario, load):
    """A press is rendered at most 0.9 N harder, and in full from the next one on."""
    session, rendered = Session(scenario, load), []

    def simulate(ms, **changes):
        session.apply_inputs(session.inputs.with_changes(changes))
        session.advance(ms)
        rendered.append(float(np.linalg.norm(session.device_wrench()[:3])))
        return session.force_above_limit()

    assert simulate(500, z=-4000) == 0.0
    assert simulate(1000, network=2, method=list(METHODS).index("force_limit")) == 0.0
    removed = simulate(1000, method=0)
    assert rendered[-1] == pytest.approx(rendered[-2] + 0.9, abs=1e-9)
    assert rendered[-1] + removed == pytest.approx(rendered[0], rel=0.02) and removed > 1.0
    assert simulate(400, grip=1) > 0.2  # another station, but no other channel
    assert rendered[-1] == pytest.approx(rendered[-2], abs=1e-9)
    assert simulate(400, z=-1000) == 0.0 and rendered[-1] < 0.1
    assert simulate(400, z=-4000) == 0.0 and rendered[-1] > rendered[1] + 1.0
    until_it_leaves = np.linalg.norm(session.log()["force_to_master"][1500:3200, :3], axis=1)
    assert np.abs(np.diff(until_it_leaves)).max() < 0.2


@pytest.mark.slow
def test_tool_follows_the_target_without_lag_and_stops_at_it(scenario, load):
    """The arm's servo has a lag of 10 ms."""
    session, speed = Session(scenario, load), 0.12
    session.apply_inputs(session.inputs.with_changes({"z": 1000}))
    session.advance(50)
    for ms in range(200):
        session.apply_inputs(
            session.inputs.with_changes(
                {"x": round(1e5 * speed * (1e-3 * ms + TARGET_LEAD_TIME_S))}
            )
        )
        session.advance(1)
    session.apply_inputs(session.inputs.with_changes({"x": round(1e5 * speed * 0.2)}))
    session.advance(200)
    log = session.log()
    places, R_WS = np.empty((len(log.t), 3)), np.empty((3, 3))
    arm = slave_arm(scenario).table
    for q, place in zip(log["slave_state"][:, :6], places, strict=True):
        forward_kinematics(arm, q, R_WS, place)
    moved = np.linalg.norm(places - places[0], axis=1)
    assert np.flatnonzero(moved > 2e-4)[0] <= 15
    wanted = log["intent"][:, 4] - log["intent"][0, 4]
    assert wanted[249] == pytest.approx(speed * 0.199, abs=1e-3)
    assert wanted.max() == pytest.approx(speed * 0.2, abs=0.6e-3)
    assert wanted[-1] == pytest.approx(speed * 0.2, abs=2e-5)


@pytest.mark.slow
def test_new_grip_object_and_sensor_continue_the_state(scenario, load):
    session = Session(scenario, load)
    now = session.inputs.with_changes({"x": 1000, "grip": 0})
    session.apply_inputs(now)
    session.advance(120)
    ends = []
    for change in ({"grip": 2}, {"object": 1}, {"sensor": 2}, {"detection": 1}):
        now = now.with_changes(change)
        session.apply_inputs(now)
        ends.append(session.ms)
        session.advance(30)
    log = session.log()
    pull, rendered = log["hand_wrench_E"][:, :3], log["force_to_master"][:, :3]
    assert np.abs(pull[115:120]).max() > 0.01
    for k in ends:
        assert np.abs(np.diff(pull[k - 1 : k + 2], axis=0)).max() < 0.05
        assert np.abs(np.diff(rendered[k - 1 : k + 5], axis=0)).max() < 2e-3
        assert np.abs(np.diff(log["slave_state"][k - 1 : k + 5, :6], axis=0)).max() < 1e-3
    mass = log["load_estimate"][:, 6]
    assert mass[ends[1] + 1] - mass[ends[1]] == pytest.approx(0.8)


@pytest.mark.slow
def test_filters_of_a_sensor_restart_after_an_ideal_one(scenario, load):
    """The memory of a sensor before the ideal one belongs to an old motion."""
    session = Session(scenario, load)
    for sensor in (2, 1, 2):
        session.apply_inputs(session.inputs.with_changes({"sensor": sensor}))
        session.advance(30)
    _, context = session._station.block_and_context("wrist_sensor")
    chain_start = 2 * sample_size(slave_arm(scenario).num_joints)
    count = context.get_discrete_state_vector().value()[chain_start]
    assert count == pytest.approx(0.03 * scenario.rates.sensor_hz, abs=20)


@pytest.mark.slow
def test_packets_in_the_channel_arrive_after_a_change_of_grip(scenario, load):
    """The channel has a delay of 100 ms each way."""
    far = replace(scenario, channel=Channel(delay=0.1))
    logs = []
    for grip in (1, 2):
        session = Session(far, load)
        session.apply_inputs(session.inputs.with_changes({"x": 1000}))
        session.advance(150)
        session.apply_inputs(session.inputs.with_changes({"grip": grip}))
        session.advance(100)
        logs.append(session.log())
    one, other = (log["pose_received"][150:] for log in logs)
    assert np.ptp(one[:, 4]) > 1e-4
    np.testing.assert_array_equal(other, one)
    # Time since the last packet of master and slave: one arrives at each step.
    assert logs[1]["ports"][150:, 4:6].max() == 0.0


@pytest.mark.slow
def test_released_hand_only_dissipates(driven):
    _, log = driven
    after = slice(241, None)
    np.testing.assert_allclose(
        log["hand_wrench_E"][after, :3], -20.0 * log["twist_master"][after, :3], atol=1e-12
    )
    np.testing.assert_allclose(log["intent"][after], log["pose_master"][after], atol=1e-15)
    assert np.linalg.norm(log["hand_wrench_E"][:239, :3], axis=1).max() > 0.5


@pytest.mark.slow
def test_run_repeats_a_drive_to_the_same_bytes(driven, tmp_path, capsys, monkeypatch):
    folder, _ = driven
    for painted in (
        "station.replay.write_replay",
        "common.files.write_picture",
        "lab.run.draw_overview",
    ):
        monkeypatch.setattr(f"drake_teleop.{painted}", lambda *_: None)
    with pytest.raises(SystemExit) as end:
        main(["run", "--inputs", str(folder), "--out", str(tmp_path / "again"), "--quiet"])
    assert end.value.code == 0, capsys.readouterr().err
    parts = sorted((folder / "log.parquet").iterdir())
    again = sorted((tmp_path / "again" / "log.parquet").iterdir())
    assert [p.read_bytes() for p in parts] == [p.read_bytes() for p in again]
    assert (
        json.loads((tmp_path / "again" / "session.json").read_text())["load_source"]
        == "from the recorded drive"
    )
    for wrong in ([], ["press", "--inputs", str(folder)], ["--inputs", str(folder), "--seed", "1"]):
        with pytest.raises(SystemExit) as end:
            main(["run", *wrong, "--out", str(tmp_path / "wrong")])
        assert end.value.code == 2
        assert "error: " in capsys.readouterr().err


@pytest.mark.slow
def test_unclosed_drive_loses_two_seconds_of_log_and_no_input(scenario, load, tmp_path):
    """The files are those of a killed process."""
    session = Session(scenario, load, log=tmp_path / "log.parquet", record=tmp_path)
    changes = []
    while session.ms < 2100:
        changes.append((session.ms, session.inputs.with_changes({"x": session.ms})))
        session.apply_inputs(changes[-1][1])
        session.advance(100)
    session._on_disk.wait_until_written()  # the thread has written all parts taken so far
    assert list(read_drive(tmp_path).changes)[1:] == changes[1:]
    log = SimulationResult.read_parquet(tmp_path / "log.parquet")
    assert log.t[-1] >= 1e-3 * session.ms - 2.0


def test_parts_of_a_drive_are_written_by_another_thread(tmp_path, monkeypatch):
    writers = []
    part = SimpleNamespace(t=[0.0], write_part=lambda *_: writers.append(threading.get_ident()))
    monkeypatch.setattr("drake_teleop.station.simulation.read_recorded_signals", lambda *_: part)
    log = BackgroundLog(tmp_path / "log.parquet", MagicMock(), 0.0, lambda part: part)
    log.write_and_clear_rows()
    log.write_and_keep_rows()
    log.wait_until_written()
    assert len(writers) == 2 and threading.get_ident() not in writers


MADE_BY = {"drake_teleop": "1.2", "drake": "3.4"}
HEADER = csv_header(MADE_BY)


def test_inputs_are_clipped_and_invalid_ones_ignored():
    wild = {"x": 1e300, "y": -(10**400), "z": np.nan, "rx": "1", "clutch": 7, "sigma": 12.6}
    inputs = Inputs().with_changes(
        wild | {"unknown": 1, "gamma": None, "held": False, "rz": np.inf}
    )
    assert inputs == Inputs(sigma=13, clutch=1, held=0)
    assert Inputs().with_changes({"x": 1e9, "force_scale": -3}) == Inputs(x=15_000, force_scale=0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "does not contain the inputs of a recorded live session"),
        (HEADER, "has a duration of 0 s"),
        (HEADER + csv_row(0, Inputs()), "has a duration of 0 s"),
        (HEADER + csv_row(5, Inputs()), "5 ms is not a valid time"),
        (HEADER + csv_row(0, Inputs()) + csv_row(-5, Inputs()), "-5 ms is not a valid time"),
        (
            HEADER + csv_row(0, Inputs()) + csv_row(5, Inputs(x=1_000_000)),
            ":4.*x = 1000000 is outside",
        ),
        (HEADER + "0,1\n", "has 2 values, must have 23"),
        (
            HEADER + csv_row(0, Inputs()).replace("0,", "a,", 1),
            "a value that is not a whole number",
        ),
        (
            HEADER + csv_row(0, Inputs()).replace("none", "share"),
            "has the unknown method 'share'; it ca",
        ),
        (
            HEADER + csv_row(0, Inputs()).replace("none", "0"),
            "has the unknown method '0'; it cannot be",
        ),
        (
            HEADER + csv_row(0, Inputs()).replace("medium", "iron"),
            "has the unknown grip 'iron'",
        ),
        (
            HEADER.replace("1.2", "1.1"),
            "recorded with drake_teleop 1.1, not with 1.2; it cannot",
        ),
        (HEADER.replace(", drake 3.4", ""), "recorded with drake unknown, not with 3.4"),
        (HEADER.partition("\n")[2] + "0,0\n", "lacks the version of drake_teleop that wrote it"),
        ("# \n" + HEADER.partition("\n")[2], "recorded with drake_teleop unknown"),
    ],
)
def test_invalid_file_of_inputs_is_one_error_line(tmp_path, text, message):
    (tmp_path / DRIVE_INPUTS_FILE_NAME).write_text(text)
    with pytest.raises(DrakeTeleopError, match=message):
        read_inputs(tmp_path / DRIVE_INPUTS_FILE_NAME, MADE_BY)


def test_drive_with_a_changed_model_is_not_repeated(scenario, load, tmp_path):
    model = tmp_path / "arm.sdf"
    shutil.copy(models_dir() / "rx90.sdf", model)
    session = Session(replace(scenario, slave__model=str(model)), load, record=tmp_path / "drive")
    session.advance(5)
    session.close()
    assert read_drive(tmp_path / "drive").changes[-1][0] == 5
    model.write_text(model.read_text() + "\n")
    with pytest.raises(DrakeTeleopError, match=r"models or other files .* have changed; it cannot"):
        read_drive(tmp_path / "drive")


@pytest.mark.quick_cases(3)
@pytest.mark.parametrize("damage", [b"", b"PK", None])
@pytest.mark.parametrize("sigma", [0.0, 1.0])
def test_drive_without_its_load_is_not_repeated(scenario, load, tmp_path, damage, sigma):
    """The station with sigma = gamma = 1 would run without the load, with another log."""
    scaled = replace(scenario, force_scaling__sigma=sigma, force_scaling__gamma=1.0)
    SessionRecord(tmp_path, scaled, load, Inputs(), device=False).close(5, Inputs())
    assert read_drive(tmp_path).load.estimate.tolist() == load.estimate.tolist()
    (tmp_path / LOAD_FILE).unlink()
    if damage is not None:
        (tmp_path / LOAD_FILE).write_bytes(damage)
    with pytest.raises(DrakeTeleopError, match=r"load\.npz: is not an identified load"):
        read_drive(tmp_path)


def test_incomplete_last_line_is_ignored(tmp_path):
    path = tmp_path / DRIVE_INPUTS_FILE_NAME
    path.write_text(
        HEADER + csv_row(0, Inputs()) + csv_row(5, Inputs(x=3)) + csv_row(10, Inputs())[:9]
    )
    assert read_inputs(path, MADE_BY) == [(0, Inputs()), (5, Inputs(x=3))]
    assert len(INPUT_RANGES) == 22


def test_weight_scale_is_separate_or_that_of_the_inertia_at_minus_one(scenario, load):
    apart = replace(scenario, force_scaling__sigma_weight=0.5, force_scaling__sigma_inertia=0.25)
    assert (
        Inputs.from_scenario(scenario).sigma_weight == -1
        and Inputs().force_scales["sigma_weight"] is None
    )
    inputs = Inputs.from_scenario(apart)
    assert (inputs.sigma, inputs.sigma_weight, inputs.force_scales["sigma_weight"]) == (25, 50, 0.5)
    session = Session(scenario, load)
    felt = {}
    for weight in (0, 100):
        session.apply_inputs(session.inputs.with_changes({"sigma": 0, "sigma_weight": weight}))
        session.advance(150)
        felt[weight] = session.new_rows()["force_to_master"][-1, 2]
    session.close()
    # 3.13 kg at rest, on the scale of the master
    scale = scenario.force_scaling.force_scale
    assert abs((felt[100] - felt[0]) / scale) == pytest.approx(3.13 * 9.81, rel=0.02)


@pytest.mark.parametrize(
    ("percent", "scale"), [(-1, None), (0, 0.0), (1, 0.01), (50, 0.5), (300, 3.0)]
)
def test_weight_scale_is_absent_only_at_minus_one(percent, scale):
    inputs = Inputs().with_changes({"sigma": 50, "sigma_weight": percent})
    assert inputs.force_scales["sigma_weight"] == scale


@pytest.mark.parametrize(
    "scales",
    [
        {"force_scale": 2.0},
        {"force_scale": 100.0, "sigma": 100.0, "gamma": 100.0},
        {"sigma": 5.0, "gamma": 3.5},
        {"sigma_weight": 4.0, "sigma_inertia": 0.0},
    ],
)
def test_scales_of_a_scenario_beyond_the_page_are_recorded_and_read(scenario, tmp_path, scales):
    own = {f"force_scaling__{name}": value for name, value in scales.items()}
    inputs = Inputs.from_scenario(replace(scenario, **own))
    path = tmp_path / DRIVE_INPUTS_FILE_NAME
    path.write_text(HEADER + csv_row(0, inputs) + csv_row(5, inputs))
    assert read_inputs(path, MADE_BY) == [(0, inputs), (5, inputs)]
    assert inputs.with_changes({"gamma": 1e4}).gamma == 300
