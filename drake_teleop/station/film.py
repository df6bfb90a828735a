"""Films: one HTML file with Meshcat and a player in it, to be opened in any browser, offline.

The player (`pages/player.html.j2`) has the film's clock, play and pause, a slider, speeds, numbers
and their curves. The film repeats itself.
"""

from __future__ import annotations

import gc
import logging
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    Cylinder,
    GeometryId,
    Meshcat,
    MeshcatCone,
    MeshcatParams,
    Rgba,
    SceneGraphInspector,
)
from pydrake.math import RigidTransform, RotationMatrix

from drake_teleop.common.html import render
from drake_teleop.common.policy import policy
from drake_teleop.common.writing import make_folder, write_text

Array = NDArray[np.float64]
Show = Callable[[float, int], None]
"""Shows a frame, by its number, at a time of the recording [s]."""

FRAMES_PER_SECOND = 50
# A longer film has fewer frames a second, which the browser interpolates: 3 kB each.
_MOST_FRAMES = 2000
_SHORTEST = 6.0  # a film that nobody said how slow to make lasts that long at least [s]
_SLOWER = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)  # speeds that the player has

_SHAFT, _HEAD = 0.006, 0.03  # radius of an arrow's shaft, length of its head [m]
_METRES_PER_NEWTON = 0.003
_GREY = Rgba(0.9, 0.9, 0.9)  # Drake's own default
_BACK = RotationMatrix.MakeXRotation(np.pi)
# Meshcat's page has none of the first: a telephone lays it out as if it were 980 pixels wide.
_POLICY = '<meta http-equiv="Content-Security-Policy" content="{}">'
_TITLE = '<meta name="viewport" content="width=device-width, initial-scale=1"><title>drake_teleop<'


class Canvas(Protocol):
    """Receives where things are: Meshcat, or what has its methods."""

    def SetTransform(self, path: str, X_ParentPath: RigidTransform, time: float) -> None:
        """Set the pose of what is at `path`, at a time of the recording [s]."""

    def SetProperty(self, path: str, property: str, value: Any, time: float) -> None:
        """Set a property, such as "scale"."""


@dataclass(frozen=True)
class Reading:
    """A number beside the film.

    Args:
        name: what it is.
        unit: of it.
        values: (F,) one for each frame; NaN where there is none.
        colour: of its curve, "#rrggbb"; without one it has none. Curves share one scale.
        arrow: whether arrows of this colour show it.
    """

    name: str
    unit: str
    values: Array
    colour: str = ""
    arrow: bool = False

    def for_page(self) -> dict[str, object]:
        """What the player reads."""
        largest = float(np.nanmax(np.abs(self.values), initial=0.0))
        return {
            "name": self.name,
            "unit": self.unit,
            "colour": self.colour,
            "arrow": self.arrow,
            "digits": 1 if largest >= 10 else 2,
            "values": [None if np.isnan(x) else round(float(x), 3) for x in self.values],
        }


@dataclass(frozen=True)
class Film:
    """What a film is of.

    Args:
        title: one line.
        times: (F,) of its frames, evenly spaced, at least two [s].
        slow_motion: seconds of the film for one second of what it shows, to begin with.
        readings: numbers beside it.
        shaded: spans of `times` that its curves mark.
        notes: further lines beside it.
        clock: what the times are.
        curves: what its curves are; "{top}" is where they end.
    """

    title: str
    times: Array
    slow_motion: float
    readings: Sequence[Reading] = ()
    shaded: Sequence[tuple[float, float]] = ()
    notes: Sequence[str] = ()
    clock: str = "simulated time"
    curves: str = ""

    def write(self, path: Path, make_scene: Callable[[Meshcat], Show]) -> None:
        """Writes the film.

        Args:
            path: of the HTML file.
            make_scene: puts what is to be seen into Meshcat, and gives what shows a frame.
        """
        # Meshcat may be destroyed by no other thread than the one that made it, and Drake's objects
        # hold on to each other until the garbage collector comes, in whichever thread: it comes
        # here.
        collects = gc.isenabled()
        gc.disable()
        try:
            page = self._recorded(make_scene)
            gc.collect()
        finally:
            if collects:
                gc.enable()
        make_folder(path.parent)
        write_text(path, self._with_player(page))

    def _recorded(self, make_scene: Callable[[Meshcat], Show]) -> str:
        with quiet_drake():  # nobody is to connect to its server
            meshcat = Meshcat(MeshcatParams(host="localhost", port=0))
        show = make_scene(meshcat)
        interval = self._span / (len(self.times) - 1)
        meshcat.StartRecording(1 / interval, set_visualizations_while_recording=False)
        for frame in range(len(self.times)):
            # Meshcat counts whole intervals, and 29 x 0.02 is a little less than 29 of them.
            show((frame + 0.5) * interval, frame)
        meshcat.StopRecording()
        meshcat.PublishRecording()
        return meshcat.StaticHtml()

    @property
    def _span(self) -> float:
        return max(float(self.times[-1] - self.times[0]), 1e-3)

    def _with_player(self, page: str) -> str:
        start = float(self.times[0])
        film = {
            "title": self.title,
            "start": start,
            "span": self._span,
            "frames": len(self.times),
            "slow_motion": self.slow_motion,
            "readings": [reading.for_page() for reading in self.readings],
            "shaded": [(a - start, b - start) for a, b in self.shaded],
            "notes": list(self.notes),
            "clock": self.clock,
            "curves": self.curves,
        }
        player = render("drake_teleop.common", "player.html.j2", film=film)
        head, body, tail = page.rpartition("</body>")
        whole = head.replace("<title>Drake MeshCat<", _TITLE, 1) + player + body + tail
        return whole.replace("<title>", _POLICY.format(policy(whole)) + "<title>", 1)


def frame_times(start: float, stop: float, slow_motion: float | None = None) -> tuple[Array, float]:
    """The instants that a film shows, and how slow it is.

    Args:
        start, stop: what it shows [s].
        slow_motion: seconds of the film for one second of that; by default the least of the
            player's speeds with which the film lasts 6 s.

    Returns:
        (F,) times [s], 50 for each second of the film but no more than 2001, and the slow motion.
    """
    span = stop - start
    if slow_motion is None:
        slow_motion = next((s for s in _SLOWER if s * span >= _SHORTEST), _SLOWER[-1])
    frames = min(math.ceil(span * slow_motion * FRAMES_PER_SECOND - 1e-6), _MOST_FRAMES)
    return np.linspace(start, stop, max(frames, 1) + 1), slow_motion


def plain_room(meshcat: Meshcat) -> None:
    """Light background, no grid, no axes."""
    for path in ("/Grid", "/Axes"):
        meshcat.SetProperty(path, "visible", False)
    meshcat.SetProperty("/Background/<object>", "top_color", [0.97, 0.98, 1.0])
    meshcat.SetProperty("/Background/<object>", "bottom_color", [0.86, 0.89, 0.93])


def add_shapes(
    meshcat: Meshcat,
    path: str,
    inspector: SceneGraphInspector,
    shapes: Iterable[GeometryId],
    colour: Rgba = _GREY,
) -> None:
    """Add the shapes of a body below its path, in the model's colours, or else in `colour`."""
    for shape in shapes:
        seen = inspector.GetIllustrationProperties(shape)
        own = colour if seen is None else seen.GetPropertyOrDefault("phong", "diffuse", colour)
        name = f"{path}/{shape.get_value()}"
        meshcat.SetObject(name, inspector.GetShape(shape), own)
        meshcat.SetTransform(name, inspector.GetPoseInFrame(shape))


def rgba(colour: str) -> Rgba:
    """Drake's colour of "#rrggbb"."""
    return Rgba(*(int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)))


class Arrow:
    """A force at a place; its length follows the force, 3 mm a newton."""

    def __init__(self, meshcat: Meshcat, name: str, colour: str) -> None:
        self._path = f"/forces/{name}"
        meshcat.SetObject(f"{self._path}/shaft/scaled", Cylinder(_SHAFT, 1.0), rgba(colour))
        # The cone's tip is at its origin and it widens along its z axis.
        head = MeshcatCone(_HEAD, 0.4 * _HEAD, 0.4 * _HEAD)
        meshcat.SetObject(f"{self._path}/head/scaled", head, rgba(colour))

    def show(self, canvas: Canvas, film_time: float, place: Array, force: Array) -> None:
        """Shows (3,) `force` [N] at (3,) `place` [m], both in W, at a time of the recording [s]."""
        length = _METRES_PER_NEWTON * float(np.linalg.norm(force))
        shaft = max(length - _HEAD, 1e-3)
        along = RotationMatrix.MakeFromOneVector(force, 2) if length > 0 else RotationMatrix()
        R = along.matrix()
        middle, tip = place + 0.5 * shaft * R[:, 2], place + (shaft + _HEAD) * R[:, 2]
        back = along @ _BACK
        put = canvas.SetTransform
        put(f"{self._path}/shaft", RigidTransform(along, middle), film_time)
        put(f"{self._path}/head", RigidTransform(back, tip), film_time)
        scale = canvas.SetProperty
        size = min(1.0, length / _HEAD)
        scale(f"{self._path}/shaft/scaled", "scale", [size, size, shaft], film_time)
        scale(f"{self._path}/head/scaled", "scale", [size, size, size], film_time)


@contextmanager
def quiet_drake() -> Iterator[None]:
    """Drake's notes, such as where Meshcat listens, are not printed meanwhile."""
    logger = logging.getLogger("drake")
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        logger.setLevel(level)
