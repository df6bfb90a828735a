"""3D replay: one HTML file with Meshcat and a player, for any browser without network."""

from __future__ import annotations

import gc
import logging
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydrake import geometry
from pydrake.geometry import Cylinder, GeometryId, Meshcat, MeshcatCone, MeshcatParams, Rgba
from pydrake.math import RigidTransform, RotationMatrix

from drake_teleop.common.files import make_folder, write_text
from drake_teleop.common.html import content_security_policy, render_page
from drake_teleop.common.numeric import Array

ShowFrame = Callable[[float, int], None]
"""Function that shows a frame (index) at a time of the recording [s]."""

FRAMES_PER_SECOND = 50
# A longer replay has a lower frame rate; a frame takes 3 kB and the browser interpolates.
_MAX_FRAMES = 2000
_MIN_REPLAY_DURATION_S = 6.0  # shortest replay with the default speed [s]
_SLOW_MOTION_FACTORS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)  # slow-motion factors of the player

_ARROW_RADIUS_M, _ARROW_HEAD_M = 0.006, 0.03  # of the shaft; length
_ARROW_LENGTH_M_PER_N = 0.003
_DEFAULT_SHAPE_COLOUR = Rgba(0.9, 0.9, 0.9)  # Drake's own default
_HALF_TURN_ABOUT_X = RotationMatrix.MakeXRotation(np.pi)
# Meshcat's page has no viewport: a telephone would use a width of 980 pixels.
_SECURITY_POLICY_TAG = '<meta http-equiv="Content-Security-Policy" content="{}">'
_VIEWPORT_AND_TITLE_TAGS = (
    '<meta name="viewport" content="width=device-width, initial-scale=1"><title>drake_teleop<'
)


@dataclass(frozen=True)
class DisplayedNumber:
    """Number over time that the page of a replay displays.

    Args:
        values: (F,) one value per frame; NaN where the number does not exist.
        colour: colour of its curve, "#rrggbb"; "" for no curve. All curves share one scale.
        has_arrow: True if the scene shows arrows of this colour for it.
    """

    name: str
    unit: str
    values: Array
    colour: str = ""
    has_arrow: bool = False

    def data_for_page(self) -> dict[str, object]:
        largest = float(np.nanmax(np.abs(self.values), initial=0.0))
        return {
            "name": self.name,
            "unit": self.unit,
            "colour": self.colour,
            "arrow": self.has_arrow,
            "digits": 1 if largest >= 10 else 2,
            "values": [None if np.isnan(x) else round(float(x), 3) for x in self.values],
        }


@dataclass(frozen=True)
class ReplayFile:
    """Contents of the page of a 3D replay, without the 3D scene.

    Args:
        times: (F,) times of the frames, evenly spaced, at least two [s].
        slow_motion: initial factor: seconds of replay per second of `times`.
        displayed_numbers: numbers that the page displays.
        shaded_spans: time spans (start, stop) that are shaded behind the curves.
        clock_label, curves_label: texts; "{top}" in `curves_label` becomes the largest value.
    """

    title: str
    times: Array
    slow_motion: float
    displayed_numbers: Sequence[DisplayedNumber] = ()
    shaded_spans: Sequence[tuple[float, float]] = ()
    notes: Sequence[str] = ()
    clock_label: str = "simulated time"
    curves_label: str = ""

    def write(self, path: Path, make_scene: Callable[[Meshcat], ShowFrame]) -> None:
        """Write the replay to an HTML file.

        `make_scene` adds the objects to Meshcat and returns the function that shows one frame.
        """
        # Only the thread that created Meshcat may destroy it, and reference cycles keep Drake's
        # objects until garbage collection, which may run in any thread: so collect here.
        collects = gc.isenabled()
        gc.disable()
        try:
            page = self._record_scene_html(make_scene)
            gc.collect()
        finally:
            if collects:
                gc.enable()
        make_folder(path.parent)
        write_text(path, self._add_player_to_page(page))

    def _record_scene_html(self, make_scene: Callable[[Meshcat], ShowFrame]) -> str:
        with silence_drake_log():  # no client connects to its server
            meshcat = Meshcat(MeshcatParams(host="localhost", port=0))
        show = make_scene(meshcat)
        interval = self._recorded_time_span_s / (len(self.times) - 1)
        meshcat.StartRecording(1 / interval, set_visualizations_while_recording=False)
        for frame in range(len(self.times)):
            # Meshcat counts whole intervals: 29 x 0.02 rounds to less than 29 of them.
            show((frame + 0.5) * interval, frame)
        meshcat.StopRecording()
        meshcat.PublishRecording()
        return meshcat.StaticHtml()

    @property
    def _recorded_time_span_s(self) -> float:
        return max(float(self.times[-1] - self.times[0]), 1e-3)

    def _add_player_to_page(self, page: str) -> str:
        start = float(self.times[0])
        film = {
            "title": self.title,
            "start": start,
            "span": self._recorded_time_span_s,
            "frames": len(self.times),
            "slow_motion": self.slow_motion,
            "readings": [reading.data_for_page() for reading in self.displayed_numbers],
            "shaded": [(a - start, b - start) for a, b in self.shaded_spans],
            "notes": list(self.notes),
            "clock": self.clock_label,
            "curves": self.curves_label,
        }
        player = render_page("drake_teleop.common", "player.html.j2", film=film)
        head, body, tail = page.rpartition("</body>")
        head = head.replace("<title>Drake MeshCat<", _VIEWPORT_AND_TITLE_TAGS, 1)
        whole = head + player + body + tail
        policy = _SECURITY_POLICY_TAG.format(content_security_policy(whole))
        return whole.replace("<title>", f"{policy}<title>", 1)


def frame_times(start: float, stop: float, slow_motion: float | None = None) -> tuple[Array, float]:
    """Return times (F,) of a replay's frames [s], and its slow-motion factor.

    By default the factor is the smallest for a replay of at least 6 s, and at most 100.
    """
    span = stop - start
    if slow_motion is None:
        enough = [s for s in _SLOW_MOTION_FACTORS if s * span >= _MIN_REPLAY_DURATION_S]
        slow_motion = enough[0] if enough else _SLOW_MOTION_FACTORS[-1]
    frames = min(math.ceil(span * slow_motion * FRAMES_PER_SECOND - 1e-6), _MAX_FRAMES)
    return np.linspace(start, stop, max(frames, 1) + 1), slow_motion


def set_plain_background(meshcat: Meshcat) -> None:
    for path in ("/Grid", "/Axes"):
        meshcat.SetProperty(path, "visible", False)
    meshcat.SetProperty("/Background/<object>", "top_color", [0.97, 0.98, 1.0])
    meshcat.SetProperty("/Background/<object>", "bottom_color", [0.86, 0.89, 0.93])


def add_shapes(
    meshcat: Meshcat,
    path: str,
    inspector: geometry.SceneGraphInspector,
    shapes: Iterable[GeometryId],
    colour: Rgba = _DEFAULT_SHAPE_COLOUR,
) -> None:
    """Add a body's shapes to Meshcat below `path`; `colour` is that of shapes without a colour."""
    for shape in shapes:
        seen = inspector.GetIllustrationProperties(shape)
        own = colour if seen is None else seen.GetPropertyOrDefault("phong", "diffuse", colour)
        name = f"{path}/{shape.get_value()}"
        meshcat.SetObject(name, inspector.GetShape(shape), own)
        meshcat.SetTransform(name, inspector.GetPoseInFrame(shape))


def colour_to_rgba(colour: str) -> Rgba:
    return Rgba(*(int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)))


class ForceArrow:
    """Arrow in Meshcat that represents a force, 3 mm long per newton."""

    def __init__(self, meshcat: Meshcat, name: str, colour: str) -> None:
        self._path, rgba = f"/forces/{name}", colour_to_rgba(colour)
        meshcat.SetObject(f"{self._path}/shaft/scaled", Cylinder(_ARROW_RADIUS_M, 1.0), rgba)
        # The cone's tip is at its origin; its axis is z.
        head = MeshcatCone(_ARROW_HEAD_M, 0.4 * _ARROW_HEAD_M, 0.4 * _ARROW_HEAD_M)
        meshcat.SetObject(f"{self._path}/head/scaled", head, rgba)

    def show_force(self, canvas: Any, replay_time: float, p_W: Array, force: Array) -> None:
        """Show `force` (3,) [N] at the point `p_W` (3,) [m], both in W, at `replay_time` [s]."""
        length = _ARROW_LENGTH_M_PER_N * float(np.linalg.norm(force))
        shaft = max(length - _ARROW_HEAD_M, 1e-3)
        along = RotationMatrix.MakeFromOneVector(force, 2) if length > 0 else RotationMatrix()
        R = along.matrix()
        middle, tip = p_W + 0.5 * shaft * R[:, 2], p_W + (shaft + _ARROW_HEAD_M) * R[:, 2]
        back = along @ _HALF_TURN_ABOUT_X
        put = canvas.SetTransform
        put(f"{self._path}/shaft", RigidTransform(along, middle), replay_time)
        put(f"{self._path}/head", RigidTransform(back, tip), replay_time)
        scale = canvas.SetProperty
        size = min(1.0, length / _ARROW_HEAD_M)
        scale(f"{self._path}/shaft/scaled", "scale", [size, size, shaft], replay_time)
        scale(f"{self._path}/head/scaled", "scale", [size, size, size], replay_time)


@contextmanager
def silence_drake_log() -> Iterator[None]:
    logger = logging.getLogger("drake")
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        logger.setLevel(level)
