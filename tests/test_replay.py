"""The replay: postures as recorded, forces the right way round, a page that stands alone."""

from __future__ import annotations

import re
import socket

import numpy as np
import pytest
from pydrake.geometry import Meshcat, MeshcatParams

from drake_teleop import replay
from drake_teleop.replay import ReplayScene, write_replay
from drake_teleop.result import SimulationResult
from drake_teleop.scenario import LoadScenario, Scenario, replace
from drake_teleop.simulation import simulate
from drake_teleop.slave.plant import R_WS_HOME
from drake_teleop.station import MakeTeleopStation


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    """Far enough into the movement for everything to be away from its start; no contact."""
    return replace(
        LoadScenario("contact_transition"), simulation__settle=0.9, simulation__duration=0.04
    )


@pytest.fixture(scope="module")
def result(scenario) -> SimulationResult:
    station = MakeTeleopStation(scenario, load_estimate=np.zeros(16))
    return simulate(station, scenario.simulation)


@pytest.fixture
def meshcat() -> Meshcat:
    return Meshcat(MeshcatParams(host="localhost"))


@pytest.fixture
def arrows(monkeypatch) -> dict[str, np.ndarray]:
    """The forces that the arrows show, by the arrow's name."""
    shown = {}

    class Arrow:
        def __init__(self, meshcat, name, colour):
            self.name = name

        def show(self, film_time, place, force):
            shown[self.name] = force

    monkeypatch.setattr(replay, "_Arrow", Arrow)
    return shown


def test_master_and_slave_stand_as_recorded(meshcat, scenario, result):
    scene = ReplayScene(meshcat, scenario)
    base = scene.plant.GetFrameByName("base", scene.plant.GetModelInstanceByName("master::phantom"))
    for sample in (0, 25):
        scene.show(0.0, result, sample)
        X_BE = scene.plant.GetFrameByName("stylus").CalcPose(scene.context, base)
        pose = result["pose_master"][sample]
        np.testing.assert_allclose(X_BE.translation(), pose[4:], atol=1e-12)
        tool = scene.plant.GetFrameByName("sensor").CalcPoseInWorld(scene.context)
        # The arm follows the command with a lag of some centimetres.
        np.testing.assert_allclose(
            tool.translation(), result["pose_command"][sample, 4:], atol=0.06
        )


def test_a_load_at_rest_pulls_the_hand_down_and_contact_pushes_it_up(
    meshcat, scenario, result, arrows
):
    recorded = {name: np.array(result[name]) for name in result}
    recorded["load_estimate"][:] = 0.0
    weight = R_WS_HOME.inverse().matrix() @ [0.0, 0.0, 30.7]  # the sensor holds the load up
    recorded["measured_wrench_S"][:, :3] = weight
    recorded["contact_wrench_S"][:, :3] = -0.5 * weight
    scene = ReplayScene(meshcat, scenario)
    scene.show(0.0, SimulationResult(result.t, recorded, result.specs), 0)
    # The tool swings by less than a degree.
    np.testing.assert_allclose(arrows["measured_at_stylus"], [0, 0, -30.7], atol=0.5)
    np.testing.assert_allclose(arrows["contact_at_stylus"], [0, 0, 15.35], atol=0.25)
    np.testing.assert_allclose(arrows["contact_at_tip"], arrows["contact_at_stylus"])


def test_the_film_is_one_page_that_needs_nothing_else(tmp_path, scenario, result):
    path = tmp_path / "replay.html"
    write_replay(path, result, scenario, slow_motion=5.0)
    page = path.read_text(encoding="utf-8")
    assert len(page) > 1e6  # Meshcat itself is inside
    assert not re.search(r"<(script|link|img)[^>]*(src|href)=.?(http|//|/)", page)


@pytest.mark.slow
@pytest.mark.parametrize(("slow_motion", "frames"), [(1.0, 3), (10.0, 21)])
def test_the_film_has_fifty_frames_a_second(
    tmp_path, monkeypatch, scenario, result, slow_motion, frames
):
    shown = []

    def show(scene, film_time, result, sample):
        shown.append((film_time, sample))

    monkeypatch.setattr(ReplayScene, "show", show)
    write_replay(tmp_path / "replay.html", result, scenario, slow_motion=slow_motion)
    times, samples = zip(*shown, strict=True)
    assert len(shown) == frames
    np.testing.assert_allclose(np.diff(times), 1 / 50)
    np.testing.assert_allclose(result.t[list(samples)], np.array(times) / slow_motion, atol=1e-9)


def test_its_server_is_gone_when_it_returns(tmp_path, result, scenario, monkeypatch):
    """Collected later, in a thread of the progress bars, Meshcat would abort the program."""
    ports = []

    def remember(params):
        meshcat = Meshcat(params)
        ports.append(meshcat.port())
        return meshcat

    monkeypatch.setattr(replay, "Meshcat", remember)
    replay.write_replay(tmp_path / "replay.html", result, scenario)
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("localhost", ports[0]))
