"""3D replay: postures, directions of forces, self-contained page."""

from __future__ import annotations

import json
import re
import socket
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.geometry import Meshcat

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.identification import true_load
from drake_teleop.station import replay, replay_file
from drake_teleop.station.replay import ReplayScene, replay_command, write_replay
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.scenario_reference import write_scenario
from drake_teleop.station.signals import signal_with_size
from drake_teleop.station.simulation import simulate
from drake_teleop.station.slave.home import R_WS_HOME
from drake_teleop.station.station import MakeTeleopStation


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    """Return a scenario in free motion, away from its start."""
    return replace(
        LoadScenario("contact_transition"), simulation__settle=0.9, simulation__duration=0.04
    )


@pytest.fixture(scope="module")
def result(scenario) -> SimulationResult:
    station = MakeTeleopStation(scenario, load_estimate=true_load(scenario))
    return simulate(station, scenario.simulation)


@pytest.fixture
def arrows(monkeypatch) -> dict[str, np.ndarray]:
    """Return the forces of the arrows by name."""
    shown = {}

    class Arrow:
        def __init__(self, meshcat, name, colour):
            self.name = name

        def show_force(self, canvas, replay_time, place, force):
            shown[self.name] = force

    monkeypatch.setattr(replay, "ForceArrow", Arrow)
    return shown


def of_player(page: str) -> dict:
    """Return the data in the page's player."""
    return json.loads(re.search(r"const film = (.*);\n", page)[1])


def test_postures_equal_the_record(meshcat, scenario, result):
    scene = ReplayScene(meshcat, scenario, result)
    base = scene.plant.GetFrameByName("base", scene.plant.GetModelInstanceByName("master::phantom"))
    for sample in (0, 25):
        scene.show_sample(0.0, result, sample)
        X_BE = scene.plant.GetFrameByName("stylus").CalcPose(scene.context, base)
        pose = result["pose_master"][sample]
        np.testing.assert_allclose(X_BE.translation(), pose[4:], atol=1e-12)
        tool = scene.plant.GetFrameByName("sensor").CalcPoseInWorld(scene.context)
        # The arm lags the command by some centimetres.
        np.testing.assert_allclose(
            tool.translation(), result["pose_command"][sample, 4:], atol=0.06
        )


def test_arrows_of_load_point_down_and_of_contact_up(meshcat, scenario, result, arrows):
    recorded = {name: np.array(result[name]) for name in result}
    recorded["load_estimate"][:] = 0.0
    weight = R_WS_HOME.inverse().matrix() @ [0.0, 0.0, 30.7]  # the sensor carries the load
    recorded["measured_wrench_S"][:, :3] = weight
    recorded["contact_wrench_S"][:, :3] = -0.5 * weight
    scene = ReplayScene(meshcat, scenario, result)
    scene.show_sample(0.0, SimulationResult(result.t, recorded, result.specs), 0)
    # The tool rotates by less than a degree.
    np.testing.assert_allclose(arrows["measured_at_stylus"], [0, 0, -30.7], atol=0.5)
    np.testing.assert_allclose(arrows["contact_at_stylus"], [0, 0, 15.35], atol=0.25)
    np.testing.assert_allclose(arrows["measured_at_wrist"], arrows["measured_at_stylus"])
    np.testing.assert_allclose(arrows["contact_at_tip"], arrows["contact_at_stylus"])


def test_replay_without_master_shows_slave_and_measured_force(meshcat, scenario, result, arrows):
    """A run that identifies the load has no master."""
    names = ("slave_state", "measured_wrench_S", "load_estimate", "sheet_state")
    recorded = {name: result[name] for name in names}
    scene = ReplayScene(meshcat, scenario, recorded)
    scene.show_sample(0.0, recorded, 0)
    assert list(arrows) == ["measured_at_wrist"]
    assert not scene.plant.HasFrameNamed("stylus")


@pytest.fixture(scope="module")
def page(tmp_path_factory, scenario, result) -> str:
    """Return the replay of a folder from `run`."""
    run, out = tmp_path_factory.mktemp("run"), tmp_path_factory.mktemp("out")
    result.write_part(run / "log.parquet", 0)
    write_scenario(run / "scenario.yaml", scenario)
    summary = replay_command(run, out, quiet=True)
    assert json.loads((out / "summary.json").read_text()) == summary
    assert summary["films"][0]["film"] == str(out / "replay.html")
    return (out / "replay.html").read_text(encoding="utf-8")


def test_replay_is_one_self_contained_page(page):
    assert 1e6 < len(page) < 4e6  # Meshcat is inside the page
    assert not re.search(r"<(script|link|img)[^>]*(src|href)=.?(http|//|/)", page)
    # Names that the player uses of Meshcat.
    assert all(
        name in page
        for name in (
            "var viewer =",
            "viewer.animate()",
            "this.animator=",
            "seek(",
            "this.actions=",
            "this.gui=",
        )
    )
    assert all(f'id="{name}"' in page for name in ("play", "clock", "time", "speed", "readings"))


def test_clock_and_readings_equal_the_log(page, scenario, result):
    shown = of_player(page)
    assert shown["title"] == scenario.description
    assert (shown["start"], shown["span"]) == pytest.approx((0.0, 0.04))
    assert shown["clock"] == "simulated time"
    measured, contact, hand = shown["readings"]
    assert measured["arrow"] and contact["arrow"] and not hand["arrow"]
    # 40 ms, a hundred times slower: a frame every 0.2 ms, from a log of 1 kHz.
    assert (shown["slow_motion"], shown["frames"]) == (100, 201)
    for reading, force in (
        (measured, result["measured_wrench_S"] - result["load_estimate"][:, :6]),
        (contact, result["contact_wrench_S"]),
        (hand, result["force_to_master"]),
    ):
        assert reading["unit"] == "N"
        newtons = np.linalg.norm(force[:, :3], axis=1)
        np.testing.assert_allclose(reading["values"][::5], newtons, atol=6e-4)


def test_replay_restarts_at_its_end(page):
    """The player's next frame equals that of a Python implementation."""
    (following,) = re.findall(r"if \(playing\) show\((.*)\);", page)
    film = SimpleNamespace(span=0.04)
    for now, expected in ((0.01, 0.012), (0.039, 0.001)):
        found = eval(following, {"now": now, "passed": 0.002, "film": film})
        assert found == pytest.approx(expected)


def test_scenario_file_is_beside_the_log(tmp_path, scenario):
    write_scenario(tmp_path / "scenario.yaml", scenario)
    assert LoadScenario(tmp_path / "scenario.yaml") == scenario


def test_all_logs_of_a_folder_are_replayed(tmp_path, scenario, result, monkeypatch):
    monkeypatch.setattr(replay, "write_replay", lambda path, result, scenario: path.write_text("-"))
    for name in ("b", "a", "without_scenario"):
        result.write_part(tmp_path / "logs" / f"{name}.parquet", 0)
    for name in "ab":
        write_scenario(tmp_path / "logs" / f"{name}.yaml", scenario)
    (tmp_path / "out").mkdir()
    summary = replay_command(tmp_path, tmp_path / "out", quiet=True)
    films = [tmp_path / "out" / "a.html", tmp_path / "out" / "b.html"]
    assert [entry["film"] for entry in summary["films"]] == [str(film) for film in films]
    with pytest.raises(DrakeTeleopError, match="has no scenario file beside it; give --sc"):
        replay_command(tmp_path / "logs" / "without_scenario.parquet", tmp_path / "out")


def test_replay_does_not_replace_the_summary_of_the_run(tmp_path, scenario, result):
    reproduced, run = tmp_path / "reproduced", tmp_path / "run"
    for log in (reproduced / "logs" / "log.parquet", run / "log.parquet"):
        result.write_part(log, 0)
        write_scenario(log.with_suffix(".yaml"), scenario)
    cases = ((run, run), (run / "log.parquet", run), (reproduced, reproduced))
    for given, folder in (*cases, (reproduced, reproduced / "logs")):
        summary = folder / "summary.json"
        summary.write_text("{}")
        with pytest.raises(
            DrakeTeleopError, match=r"contains the input summary\.json, .* another --out"
        ):
            replay_command(given, folder)
        assert summary.read_text() == "{}" and not (folder / "replay.html").exists()


def test_folder_without_run_is_rejected(tmp_path, scenario, result):
    with pytest.raises(DrakeTeleopError, match=r"contains no log of a run; give .* a study"):
        replay_command(tmp_path, tmp_path)
    wrench = SimulationResult(
        result.t,
        {"measured_wrench_S": result["measured_wrench_S"]},
        [spec for spec in result.specs if spec.name == "measured_wrench_S"],
    )
    with pytest.raises(DrakeTeleopError, match=r"replay\.html: .* contains no slave_state, load_e"):
        write_replay(tmp_path / "replay.html", wrench, scenario)


@pytest.mark.parametrize("row", [0, 7])
def test_replay_of_a_log_without_rows_names_the_settings(tmp_path, scenario, result, row):
    with pytest.raises(DrakeTeleopError, match="contains no samples; increase simula"):
        write_replay(tmp_path / "replay.html", result[row:row], scenario)


@pytest.mark.parametrize("joints", [5, 7])
@pytest.mark.parametrize("name", ["slave_state", "master_state"])
def test_log_of_another_arm_or_device_is_rejected(tmp_path, scenario, result, name, joints):
    signals = {each: result[each] for each in result}
    signals[name] = np.tile(signals[name], 2)[:, : 2 * joints]
    specs = [signal_with_size(each, values.shape[1]) for each, values in signals.items()]
    odd = SimulationResult(result.t, signals, specs)
    message = rf"replay\.html: {name} has {joints} joints, .* device 6; give the scenario of"
    with pytest.raises(DrakeTeleopError, match=message):
        write_replay(tmp_path / "replay.html", odd, scenario)


@pytest.mark.parametrize(("slow_motion", "frames"), [(1.0, 3), (10.0, 21), (50.0, 101)])
def test_replay_has_fifty_frames_per_second(
    tmp_path, monkeypatch, scenario, result, slow_motion, frames
):
    """Meshcat stores one frame for each whole interval."""
    kept = {}

    class Recorder:
        def __init__(self, params):
            pass

        def StartRecording(self, rate, **options):
            self.rate = rate

        def __getattr__(self, name):
            return lambda *arguments: "<body></body>"

    class Scene:
        def __init__(self, meshcat, scenario, recorded):
            self.meshcat = meshcat

        def show_sample(self, replay_time, signals, sample):
            kept[np.floor(replay_time * self.meshcat.rate)] = signals["slave_state"][sample]

    monkeypatch.setattr(replay_file, "Meshcat", Recorder)
    monkeypatch.setattr(replay, "ReplayScene", Scene)
    write_replay(tmp_path / "replay.html", result, scenario, slow_motion=slow_motion)
    assert list(kept) == list(range(frames))
    nearest = np.rint(np.linspace(0, 40, frames) - 1e-9).astype(int)
    np.testing.assert_array_equal(list(kept.values()), result["slave_state"][nearest])


def test_meshcat_server_is_stopped_after_writing(tmp_path, result, scenario, monkeypatch):
    """A later garbage collection in a progress bar's thread would abort the program."""
    ports = []

    def remember(params):
        meshcat = Meshcat(params)
        ports.append(meshcat.port())
        return meshcat

    monkeypatch.setattr(replay_file, "Meshcat", remember)
    replay.write_replay(tmp_path / "replay.html", result, scenario)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("localhost", ports[0]))
