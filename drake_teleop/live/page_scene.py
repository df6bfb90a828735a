"""3D scene of a live session for its page."""

from __future__ import annotations

import json
import re
import sys
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.math import RigidTransform

from drake_teleop.common.errors import to_one_line
from drake_teleop.common.numeric import Array
from drake_teleop.station.replay import ReplayScene
from drake_teleop.station.replay_file import silence_drake_log
from drake_teleop.station.scenario import Scenario

LogRows = dict[str, Array]

_SCENE_DISABLING_EXCEPTIONS = (Exception, SystemExit)  # SystemExit is a failed assertion of Drake

# Commands in base64 and their files in the static page of Meshcat.
_MESHCAT_COMMAND_PATTERN = re.compile(r'fetch\("data:application/octet-binary;base64,([^"]*)"\)')
_FILE_PATTERN = re.compile(r'^casAssets\["([^"]*)"\] = "([^"]*)";$', re.M)


class PageScene:
    """3D scene of a scenario; its failure does not end the session.

    Attributes:
        objects: JSON {"commands": [base64], "files": {address: data URL}}.
        failure: reason if there is no scene, or "".
    """

    def __init__(self, name: str, scenario: Scenario, *, forces: bool = True) -> None:
        self.name, self.scenario, self.objects, self.failure = name, scenario, b"{}", ""
        arrows = ("measured_wrench_S", "contact_wrench_S") if forces else ()
        recorded = ("slave_state", "master_state", *arrows)
        try:
            with silence_drake_log():
                meshcat = Meshcat(MeshcatParams(host="localhost", port=0))
            self._scene = ReplayScene(meshcat, scenario, recorded)
            self.objects = _scene_objects_json(meshcat.StaticHtml())
            self._scene.canvas = _SceneChangeRecorder()  # only this thread may destroy Meshcat
        except _SCENE_DISABLING_EXCEPTIONS as error:
            self._report_scene_failure(error)

    def scene_values(self, rows: LogRows) -> dict[str, Any]:
        """Return 4x4 poses (column-major) and sizes of 3D objects by path, for the last row."""
        moves = {} if self.failure else self._scene_poses_and_sizes_of_last_row(rows)
        return {"view": self.name, "no_view": self.failure, "moves": moves}

    def _scene_poses_and_sizes_of_last_row(self, rows: LogRows) -> dict[str, Any]:
        moves = _SceneChangeRecorder()
        try:
            self._scene.canvas = moves
            self._scene.show_sample(0.0, rows, -1)
        except _SCENE_DISABLING_EXCEPTIONS as error:
            if all(np.isfinite(values[-1]).all() for values in rows.values()):
                self._report_scene_failure(error)
            return {}
        return moves.rounded_poses_and_sizes()

    def _report_scene_failure(self, error: BaseException) -> None:
        self.failure = to_one_line(f"no 3D scene: {error}")
        print(f"warning: {self.failure}; the session continues without 3D", file=sys.stderr)


class _SceneChangeRecorder:
    def __init__(self) -> None:
        self._poses: dict[str, Array] = {}
        self._sizes: dict[str, list[float]] = {}

    def SetTransform(self, path: str, X_ParentPath: RigidTransform, time: float) -> None:
        self._poses[path] = X_ParentPath.GetAsMatrix4()

    def SetProperty(self, path: str, property: str, value: list[float], time: float) -> None:
        self._sizes[path] = [round(x, 4) for x in value]

    def rounded_poses_and_sizes(self) -> dict[str, Any]:
        matrices = np.array([*self._poses.values()]).round(5)
        if not np.isfinite(matrices).all():
            return {}
        columns = matrices.swapaxes(1, 2).reshape(-1, 16).tolist()
        return {"poses": dict(zip(self._poses, columns, strict=True)), "sizes": self._sizes}


def _scene_objects_json(html: str) -> bytes:
    commands = _MESHCAT_COMMAND_PATTERN.findall(html)
    if not commands:
        raise ValueError("the static page of Drake's Meshcat has an unknown format")
    return json.dumps({"commands": commands, "files": dict(_FILE_PATTERN.findall(html))}).encode()
