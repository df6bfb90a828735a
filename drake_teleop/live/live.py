"""A drive with its driver and spectators, on any clock and independent of the page.

After the driver leaves, the next client that asks drives. Without a driver the hand lets go and the
clutch opens; a quarter of a second later the simulation stops, with a complete record.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import RollPitchYaw

from drake_teleop.common.errors import DrakeTeleopError, one_line
from drake_teleop.common.writing import CannotWrite
from drake_teleop.lab.identified_load import IdentifiedLoad
from drake_teleop.live.cockpit import Cockpit
from drake_teleop.live.device_link import DeviceLink
from drake_teleop.live.external_master import TICK_MS
from drake_teleop.live.inputs import CHOICES, NAMES, RANGES, SLICE_MS, Inputs
from drake_teleop.live.motion_limits import Follower, Steering
from drake_teleop.live.pace import Pace
from drake_teleop.live.scenarios import SCENES
from drake_teleop.live.session import Session
from drake_teleop.station.scenario import Scenario

Show = Callable[[dict[str, np.ndarray]], dict[str, Any]]
"""Function from rows of a log to the 3D scene's part of a frame."""

#: Period of the frames for the page [s].
FRAME = 1 / 60
_SHORTEST = 0.25 * FRAME  # s, shortest time between two frames
#: Smallest contact force at the hand that a gamepad displays [N].
TOUCH = 0.12
# Time without a driver until the simulation stops [s]; most slices between two polls of messages.
_ALONE, _IN_A_ROW = 0.25, 4
_KEPT_BACK = 0.05  # N, smallest removed force that the page reports
_LONGEST_MS = 36_000_000
_LIMP = {"held": 0, "clutch": 0}
# Errors of this package and of Drake; SystemExit is a failed assertion of Drake.
_FAILURES = (DrakeTeleopError, RuntimeError, SystemExit)

#: Largest message [bytes]; a longer one closes the connection.
LONGEST = 4096
#: Largest clock time per simulated time.
SLOWEST = 20.0


class Live:
    """Event handler of a drive: messages of pages and ticks of the clock.

    Attributes:
        refused: number of invalid messages.
        stopped: failure that stops the simulation until a reset; "" without one.
        asked: requested scene, "" for none; the simulation waits for `change`.
        scene: present scene.
        pace: timing of the slices.
        recorded: folders of the completed drives.

    Args:
        scenario: from `live_scenario`.
        load: identified load of the station.
        record: folder, or if it is not empty the next free one beside it; None for none.
        show: returns the scene's part of a frame.
        now: the clock [s].
        link: to a haptic device; None for the hand of a page.
        log: whether the log is recorded in addition to the inputs.
        begin: initial inputs that differ from the scenario's.
    """

    def __init__(
        self,
        scenario: Scenario,
        load: IdentifiedLoad | None,
        record: Path | None,
        show: Show,
        now: float,
        link: DeviceLink | None = None,
        *,
        log: bool = True,
        begin: Mapping[str, int] | None = None,
    ) -> None:
        self._log, self._first = log, begin or {}
        self._link, self._slice_ms = link, SLICE_MS if link is None else TICK_MS
        self.refused, self.asked, self.scene = 0, "", SCENES[0]
        self._scenario, self._load, self._record, self._show = scenario, load, record, show
        self._clients: list[int] = []
        self._driver: int | None = None
        self._drives, self._paused, self.stopped = 0, False, ""
        self.recorded: list[str] = []
        self._unwritten = ""
        self._alone_since = now
        self.pace = Pace(1e-3 * self._slice_ms, now)
        self._frame_due, self._framed, self._heeded = now, now, False
        self._begin(now)

    def _begin(self, now: float) -> None:
        folder = None if self._record is None else _free(self._record)
        self._drives += 1
        log = folder / "log.parquet" if folder is not None and self._log else None
        self._session = Session(
            self._scenario, self._load, log=log, record=folder, device=self._link is not None
        )
        self._folder = "" if folder is None else str(folder)
        self._session.apply(self._session.inputs.changed(self._first))
        if self._link is not None:
            self._link.begin_anew(now)
        scaling, by_device = self._scenario.kinematic_scaling, self._link is not None
        scales = scaling.translation_scale, scaling.rotation_scale
        self._follower = Follower(1e-3 * self._slice_ms, scales, device=by_device)
        self._cockpit, self.stopped = Cockpit(self._scenario), ""
        self._asleep = self._driver is None
        self._refusal, self._pressed = "", False
        self._wanted, self._steering = self._session.inputs, Steering()
        self._led = self._wanted.target
        self._frame: dict[str, Any] = {}
        self.pace.start(now)

    def change(
        self, scenario: Scenario, load: IdentifiedLoad | None, show: Show, now: float
    ) -> None:
        """Start a drive of the requested scene."""
        self._scenario, self._load, self._show = scenario, load, show
        self.scene, self.asked = self.asked, ""
        self._restart(now)

    def _restart(self, now: float) -> None:
        self.stopped = ""
        self._try(self.end)
        failure = self.stopped
        self._try(lambda: self._begin(now))
        self._refusal = failure

    def refuse(self, why: str, now: float) -> None:
        """Continue the present scene, and report why the requested one is impossible."""
        self.asked, self._refusal = "", why
        self.pace.start(now)

    def hello(self) -> dict[str, Any]:
        """Return the constants of the scenario for a page."""
        scaling = self._scenario.kinematic_scaling
        return {
            "scenario": self._scenario.description or "a station",
            "ranges": RANGES,
            "names": NAMES,
            "object": self._scenario.force_scaling.gripper_phi is not None,
            "touch": TOUCH,
            "known": self._load is not None,
            "noise": self._load is not None and self._load.noise_floor is not None,
            "scale": scaling.translation_scale,
            "alignment": RollPitchYaw(scaling.alignment).ToRotationMatrix().matrix().tolist(),
            "scenes": SCENES,
        }

    def join(self, client: int, now: float) -> None:
        """Add a page; the first one drives."""
        self._clients.append(client)
        if self._driver is None:
            self._hand_over(client, now)

    def leave(self, client: int, now: float) -> None:
        """Remove a page; the hand of the driver lets go."""
        self._clients.remove(client)
        if client == self._driver:
            self._driver, self._alone_since = None, now
            self._wanted, self._steering = self._wanted.changed(_LIMP), Steering()

    def hear(self, client: int, text: Any, now: float) -> None:
        """Handle a message of a page; count an invalid one."""
        said = parse(text)
        if said is None:
            self.refused += 1
            return
        if "drive" in said and client != self._driver:
            self._hand_over(client, now)
        if client != self._driver:
            return
        if "set" in said:
            if not CHOICES.isdisjoint(said["set"]):
                self._refusal = ""
            self._wanted = self._wanted.changed(said["set"])
            self._steering = Steering()
        if "rates" in said:
            self._wanted = self._steering.begin(said["rates"], self._wanted, now)
        if "slow" in said:
            self.pace.slow = said["slow"]
            self.pace.start(now)
        if "pause" in said and said["pause"] != self._paused:
            self._paused = said["pause"]
            self.pace.start(now)
        if "scene" in said and not self.asked:
            self.asked = said["scene"]
        if "reset" in said:
            self._restart(now)

    def _hand_over(self, client: int, now: float) -> None:
        self._driver = client
        self._wanted, self._steering = self._session.stylus().changed({"clutch": 1}), Steering()
        if self._asleep:
            self.pace.start(now)
        self._asleep = False

    @property
    def ms(self) -> int:
        """Simulated time [ms]."""
        return self._session.ms

    @property
    def still(self) -> bool:
        """Whether simulated time is stopped."""
        return self._paused or self._asleep or bool(self.stopped or self.asked)

    def wait(self, now: float) -> float:
        """Return the time until the next slice or frame [s]."""
        frame = self._frame_due - now
        return max(0.0, frame if self.still else min(frame, self.pace.wait(now)))

    def tick(self, clock: Callable[[], float]) -> dict[str, Any] | None:
        """Simulate at most four due slices; return a frame if one is due."""
        for _ in range(_IN_A_ROW):
            now = clock()
            if self.still or self.pace.wait(now) > 0:
                break
            self.pace.begin(now)
            self._slice(now)
        now = clock()
        self._listen(now)
        if self._driver is None and not self._asleep and now - self._alone_since >= _ALONE:
            self._asleep = True
            self._try(self._session.keep)
        # A new input or contact is shown at once; the schedule of frames then restarts.
        heeded = self._heeded and now >= self._framed + _SHORTEST
        if now < self._frame_due and not heeded:
            return None
        self._frame_due = now + 1.5 * FRAME if heeded else max(self._frame_due + FRAME, now - FRAME)
        self._framed, self._heeded = now, False
        return self.frame()

    def _listen(self, now: float) -> None:
        if self._link is None or self._link.poll(now) is None:
            return
        self._alone_since = now
        if self._asleep:
            self._asleep = False
            self.pace.start(now)

    def _try(self, action: Callable[[], None]) -> None:
        """Run an action; a failure stops the drive with its message."""
        try:
            action()
        except _FAILURES as error:
            self.stopped = one_line(str(error))

    def _slice(self, now: float) -> None:
        by_device = {} if self._link is None else self._link.lead(now)
        self._wanted = self._steering.step(self._wanted, 1e-3 * self._slice_ms, now)
        self._heeded |= self._wanted.target != self._led
        self._led = self._wanted.target
        try:
            self._session.apply(self._followed(self._wanted.changed(by_device)))
        except _FAILURES as error:
            present = self._session.inputs
            if self._wanted.station == present.station:
                self.stopped = one_line(str(error))
            else:  # there is no such station: keep the present one
                self._refusal = one_line(str(error))
                kept = {name: getattr(present, name) for name in CHOICES}
                self._wanted = self._wanted.changed(kept)
        if not self.stopped:
            self._try(lambda: self._session.advance(self._slice_ms))
            pressed = self._session.pressed() > TOUCH
            self._heeded |= pressed and not self._pressed
            self._pressed = pressed
        if self._link is not None and not self.stopped:
            self._link.send(self._session.force())
        if self._session.ms >= _LONGEST_MS:
            self.stopped = "ten hours are over"

    def _followed(self, wanted: Inputs) -> Inputs:
        by_device = self._link is not None
        free = not self._session.inputs.held or (by_device and not wanted.clutch)
        return self._follower.step(wanted, free=free)

    def frame(self) -> dict[str, Any]:
        """Return the present frame for the pages."""
        rows = self._session.news()
        if len(rows["t"]):
            self._frame = self._cockpit.frame(rows, self._session.inputs) | self._show(rows)
        inputs = self._wanted
        words = self._frame.get("words", [])
        if self._session.filling:
            words = ["a new channel starts: the clutch is open until its packets arrive", *words]
        kept = self._session.kept_back()
        if kept > _KEPT_BACK:
            words = [f"{kept:.1f} N are not rendered until the hand presses less", *words]
        if self._refusal:
            words = [self._refusal, *words]
        return self._frame | {
            "words": words,
            "device": "" if self._link is None else self._link.text(),
            "speed": round(self.pace.factor, 4),
            "slow": self.pace.slow,
            "factor": round(self.pace.factor * self.pace.slow, 3),
            "late": round(1e3 * self.pace.lateness(), 1),
            "lost": round(self.pace.given_up, 2),
            "state": self._state(),
            "driver": self._driver,
            "drive": self._drives,
            "scene": self.asked or self.scene,
            "record": self._folder,
            "stopped": self.stopped,
            "inputs": {name: getattr(inputs, name) for name in RANGES},
        }

    def _state(self) -> str:
        if self.asked:
            return "preparing"
        if self.stopped:
            return "stopped"
        return "paused" if self._paused else "waiting" if self._asleep else "running"

    def end(self) -> None:
        """Complete the record; keep the link for the next drive.

        Raises:
            CannotWrite: if the record cannot be completed.
        """
        try:
            self._session.close()
        except DrakeTeleopError as error:
            self._unwritten = self._unwritten or str(error)
            raise
        if self._folder and self._session.ms:
            self.recorded.append(self._folder)
        self._folder = ""

    def close(self) -> None:
        """End the drive and the link to a device.

        Raises:
            CannotWrite: if the record of any of its drives is incomplete.
        """
        self._try(self.end)
        if self._link is not None:
            self._link.close()
        if self._unwritten:
            raise CannotWrite(self._unwritten)


def _free(folder: Path) -> Path:
    """Return the folder if it is absent or empty, else the first absent of DIR-2, DIR-3, ..."""
    folder = folder if folder.name.strip(".") else folder.resolve()  # "." has no name to number
    if not folder.is_dir() or not any(folder.iterdir()):
        return folder
    names = (folder.with_name(f"{folder.name}-{k}") for k in itertools.count(2))
    return next(name for name in names if not name.exists())


def parse(text: Any) -> dict[str, Any] | None:
    """Return the valid requests of a message; None without any.

    Returns:
        Any of "set" and "rates" (numbers by input), "pause" (bool), "slow" (1 to 20), "scene" (of
        `SCENES`), "reset" and "drive" (True).
    """
    if not isinstance(text, str) or len(text) > LONGEST:
        return None
    try:
        said = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if not isinstance(said, dict):
        return None
    found: dict[str, Any] = {}
    for kind in ("set", "rates"):
        values = said.get(kind)
        if isinstance(values, dict):
            found[kind] = {name: value for name, value in values.items() if _is_number(value)}
    if isinstance(said.get("pause"), bool):
        found["pause"] = said["pause"]
    if _is_number(said.get("slow")):
        found["slow"] = min(max(float(said["slow"]), 1.0), SLOWEST)
    if isinstance(said.get("scene"), str) and said["scene"] in SCENES:
        found["scene"] = said["scene"]
    found |= {name: True for name in ("reset", "drive") if said.get(name) is True}
    return found or None


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return abs(value) < 1e15 and math.isfinite(value)
