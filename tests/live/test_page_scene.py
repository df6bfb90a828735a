"""3D scene of the page: objects, poses and failures."""

from __future__ import annotations

import base64
import json

import numpy as np
import pytest
from sockets import ports

from drake_teleop.live import page_scene
from drake_teleop.live.page_scene import PageScene
from drake_teleop.live.session import Session
from drake_teleop.station.slave.arm import forward_kinematics
from drake_teleop.station.slave.plant import NominalSlave


@pytest.fixture(scope="module")
def view(scenario) -> PageScene:
    return PageScene("own", scenario)


@pytest.fixture(scope="module")
def rows(scenario, load) -> dict[str, np.ndarray]:
    """Return rows with the tool pressed onto the leaf."""
    session = Session(scenario, load)
    session.apply_inputs(session.inputs.with_changes({"z": -3000, "rx": 1000}))
    session.advance(200)
    return session.new_rows()


def test_moving_objects_have_the_poses_of_the_station(scenario, view, rows):
    objects = json.loads(view.objects)
    commands = [base64.b64decode(text) for text in objects["commands"]]
    frame = view.scene_values(rows)
    moves = frame["moves"]
    assert (frame["view"], frame["no_view"], view.failure) == ("own", "", "")
    for path in (*moves["poses"], *moves["sizes"]):
        assert any(path.encode() in command for command in commands), path
    arm, R_WS, p_WS = NominalSlave(scenario.slave).arm, np.empty((3, 3)), np.empty(3)
    forward_kinematics(arm.table, rows["slave_state"][-1, : arm.num_joints], R_WS, p_WS)
    (tool,) = (np.array(m) for path, m in moves["poses"].items() if path.endswith("_tool"))
    X_WTool = tool.reshape(4, 4).T
    assert np.linalg.norm(X_WTool[:3, 3] - p_WS) < 0.2
    np.testing.assert_allclose(X_WTool[:3, :3].T @ X_WTool[:3, :3], np.eye(3), atol=1e-4)
    first = {name: values[:1] for name, values in rows.items()}
    earlier = view.scene_values(first)["moves"]["poses"]
    moved = [path for path in earlier if earlier[path] != moves["poses"][path]]
    assert len(moved) > 10 and sum("arm" in path or "link" in path for path in moved) > 3
    json.dumps(frame, allow_nan=False)


def test_scene_without_forces_has_no_arrow(scenario, rows):
    moves = PageScene("0", scenario, forces=False).scene_values(rows)["moves"]
    assert not moves["sizes"] and not any("forces" in path for path in moves["poses"])


def test_meshcat_is_closed_after_the_scene_is_made(scenario):
    before = ports()
    PageScene("own", scenario)
    assert ports() == before


@pytest.mark.parametrize("broken", ["Meshcat", "ReplayScene", "_scene_objects_json"])
def test_failed_scene_is_reported_without_an_error(scenario, rows, monkeypatch, capsys, broken):
    def fail(*_, **__):
        raise RuntimeError("no port is free\nfor this")

    monkeypatch.setattr(page_scene, broken, fail)
    view = PageScene("own", scenario)
    assert view.scene_values(rows) == {
        "view": "own", "no_view": "no 3D scene: no port is free for this", "moves": {},
    }  # fmt: skip
    said = capsys.readouterr().err
    assert said == f"warning: {view.failure}; the session continues without 3D\n"


def test_scene_that_fails_later_is_reported_once(scenario, rows, capsys):
    view = PageScene("own", scenario)
    for _ in range(3):
        frame = view.scene_values(
            {name: values for name, values in rows.items() if name != "slave_state"}
        )
    assert frame["no_view"] == "no 3D scene: 'slave_state'" and frame["moves"] == {}
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("name", ["slave_state", "master_state", "contact_wrench_S"])
def test_non_finite_poses_are_not_sent(view, rows, name):
    for value in (np.nan, np.inf):
        wild = view.scene_values(rows | {name: np.full_like(rows[name], value)})
        json.dumps(wild, allow_nan=False)
        assert wild["moves"] == {}
    assert view.scene_values(rows)["moves"]
