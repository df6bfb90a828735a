"""Live session with one driving page and spectators, independent of web server and clock."""

from __future__ import annotations

import gc
import itertools
import json
import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError, to_one_line
from drake_teleop.common.files import CannotWrite
from drake_teleop.lab.identified_load import IdentifiedLoad
from drake_teleop.live import inputs as live_inputs
from drake_teleop.live.cockpit import PageValueCalculator
from drake_teleop.live.device_link import DeviceLink
from drake_teleop.live.hand import POSE_PERIOD_MS
from drake_teleop.live.motion_limits import InputRateIntegrator, MotionLimiter
from drake_teleop.live.scenarios import SCENE_NAMES
from drake_teleop.live.session import Session
from drake_teleop.station.scenario import Scenario

SceneFunction = Callable[[dict[str, np.ndarray]], dict[str, Any]]
"""Function from rows of a log to the 3D scene's part of a frame."""

#: Period of the frames for the page [s].
FRAME_PERIOD_S = 1 / 60
_MIN_TIME_BETWEEN_PAGE_FRAMES_S = 0.25 * FRAME_PERIOD_S  # s, shortest time between two frames
#: Smallest contact force at the hand that a gamepad displays [N].
MIN_GAMEPAD_TOUCH_FORCE_N = 0.12
# Time without a driver until the simulation stops [s]; maximum number of slices between two polls
# of messages.
_MAX_UNDRIVEN_S, _MAX_SLICES_PER_TICK = 0.25, 4
_MIN_REPORTED_UNRENDERED_FORCE_N = 0.05  # N, smallest removed force that the page reports
# Errors of this package and of Drake; SystemExit is a failed assertion of Drake.
_EXCEPTIONS_THAT_STOP_SESSION = (DrakeTeleopError, RuntimeError, SystemExit)

#: Largest message [bytes]; a longer one closes the connection.
MAX_MESSAGE_BYTES = 4096
#: Largest clock time per simulated time.
MAX_SLOWDOWN = 20.0
#: Lateness above which lost time is not caught up [s].
_MAX_RECOVERABLE_LATENESS_S = 0.1
_NUM_SLICES_OF_TIMING_STATISTICS = 400  # slices


class SliceSchedule:
    """Schedule of slices of `slice_s` simulated seconds; `now`: clock time [s].

    Attributes:
        slowdown: clock time per simulated time; 1: real time.
        lost_time_s: total lateness that was not caught up [s].
    """

    def __init__(self, slice_s: float, now: float) -> None:
        self.slowdown, self.lost_time_s = 1.0, 0.0
        self._slice = slice_s
        self._lateness: deque[float] = deque(maxlen=_NUM_SLICES_OF_TIMING_STATISTICS)
        self._starts: deque[float] = deque(maxlen=_NUM_SLICES_OF_TIMING_STATISTICS)
        self.restart(now)

    def restart(self, now: float) -> None:
        self._due = now
        self._starts.clear()

    def time_to_next_slice(self, now: float) -> float:
        return self._due - now

    def begin_slice(self, now: float) -> None:
        late = now - self._due
        if late > _MAX_RECOVERABLE_LATENESS_S:
            self.lost_time_s += late
            self._due = now
        self._lateness.append(late)
        self._starts.append(now)
        self._due += self._slice * self.slowdown

    @property
    def real_time_factor(self) -> float:
        """Ratio of simulated to clock time of the last 400 slices; 0 before the second slice."""
        if len(self._starts) < 2 or self._starts[-1] <= self._starts[0]:
            return 0.0
        return (len(self._starts) - 1) * self._slice / (self._starts[-1] - self._starts[0])

    def lateness_p99_s(self) -> float:
        late = sorted(self._lateness) or [0.0]
        return late[(99 * len(late) - 1) // 100]


@contextmanager
def without_garbage_collection() -> Iterator[None]:
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()


class Live:
    """Event handler of a live session for messages and clock ticks; `now`: clock time [s].

    Attributes:
        refused: number of invalid messages.
        stop_reason: failure that stops the simulation, or "".
        requested_scene: scene requested by a page, or "".
        recorded: folders of completed records.

    Args:
        record: folder of the record (NAME-2 ... if it is not empty); None: no record.
        show: function that returns the 3D scene's part of a frame.
        link: link to a haptic device; None: the page moves the hand.
    """

    def __init__(
        self,
        scenario: Scenario,
        load: IdentifiedLoad | None,
        record: Path | None,
        show: SceneFunction,
        now: float,
        link: DeviceLink | None = None,
        *,
        log: bool = True,
        begin: Mapping[str, int] | None = None,
    ) -> None:
        self._log, self._initial = log, begin or {}
        self._link, self._slice_ms = link, live_inputs.SLICE_MS if link is None else POSE_PERIOD_MS
        self.refused, self.requested_scene, self.scene = 0, "", SCENE_NAMES[0]
        self._scenario, self._load, self._record, self._scene_part = scenario, load, record, show
        self._driver: int | None = None
        self._drives, self._paused, self.stop_reason = 0, False, ""
        self.recorded: list[str] = []
        self._write_error = ""
        self._idle_since = now
        self.pace = SliceSchedule(1e-3 * self._slice_ms, now)
        self._frame_due, self._last_frame_at, self._show_now = now, now, False
        self._start_session(now)

    def _start_session(self, now: float) -> None:
        folder = None if self._record is None else _unused_folder_path(self._record)
        self._drives += 1
        log = folder / "log.parquet" if folder is not None and self._log else None
        device = self._link is not None
        self._session = Session(self._scenario, self._load, log=log, record=folder, device=device)
        self._folder = "" if folder is None else str(folder)
        self._session.apply_inputs(self._session.inputs.with_changes(self._initial))
        if self._link is not None:
            self._link.reset_pose_origin(now)
        scaling = self._scenario.kinematic_scaling
        scales = scaling.translation_scale, scaling.rotation_scale
        self._limiter = MotionLimiter(1e-3 * self._slice_ms, scales, device=device)
        self._cockpit, self.stop_reason = PageValueCalculator(self._scenario), ""
        self._asleep = self._driver is None
        self._refusal, self._touched = "", False
        self._requested, self._rates = self._session.inputs, InputRateIntegrator()
        self._last_target = self._requested.hand_pose_and_held
        self._last_frame: dict[str, Any] = {}
        self.pace.restart(now)

    def change_scene(
        self, scenario: Scenario, load: IdentifiedLoad | None, show: SceneFunction, now: float
    ) -> None:
        """Complete the record and start a session with the requested scene."""
        self._scenario, self._load, self._scene_part = scenario, load, show
        self.scene, self.requested_scene = self.requested_scene, ""
        self._restart_session(now)

    def _restart_session(self, now: float) -> None:
        self.stop_reason = ""
        self._run_and_stop_session_on_failure(self.end_session)
        failure = self.stop_reason
        self._run_and_stop_session_on_failure(lambda: self._start_session(now))
        self._refusal = failure

    def reject_scene(self, why: str, now: float) -> None:
        """Continue the present scene; the page shows the reason `why`."""
        self.requested_scene, self._refusal = "", why
        self.pace.restart(now)

    def hello_message(self) -> dict[str, Any]:
        scaling = self._scenario.kinematic_scaling
        return {
            "scenario": self._scenario.description or "a station",
            "ranges": {name: live_inputs.input_range(name) for name in live_inputs.INPUT_RANGES},
            "names": live_inputs.choice_names(),
            "object": self._scenario.force_scaling.gripper_phi is not None,
            "touch": MIN_GAMEPAD_TOUCH_FORCE_N,
            "known": self._load is not None,
            "noise": self._load is not None and self._load.noise_floor is not None,
            "scale": scaling.translation_scale,
            "alignment": scaling.R_WB.tolist(),
            "scenes": SCENE_NAMES,
        }

    def join(self, client: int, now: float) -> None:
        """Add a page; the first one drives (its inputs move the hand)."""
        if self._driver is None:
            self._set_driving_page(client, now)

    def leave(self, client: int, now: float) -> None:
        """Remove a page; if it drives, a simulated hand releases the stylus."""
        if client == self._driver:
            self._driver, self._idle_since = None, now
            changes = {"held": 0, "clutch": 0} if self._link is None else {"clutch": 1}
            self._requested = self._requested.with_changes(changes)
            self._rates = InputRateIntegrator()

    def handle_message(self, client: int, text: Any, now: float) -> None:
        message = parse_message(text)
        if message is None:
            self.refused += 1
            return
        if "drive" in message and client != self._driver:
            self._set_driving_page(client, now)
        if client != self._driver:
            return
        if "set" in message:
            if not live_inputs.STATION_SWAP_INPUTS.isdisjoint(message["set"]):
                self._refusal = ""
            self._requested = self._requested.with_changes(message["set"])
            self._rates = InputRateIntegrator()
        if "rates" in message:
            self._requested = self._rates.set_rates(message["rates"], self._requested, now)
        if "slow" in message:
            self.pace.slowdown = message["slow"]
            self.pace.restart(now)
        if "pause" in message and message["pause"] != self._paused:
            self._paused = message["pause"]
            self.pace.restart(now)
        if "scene" in message and not self.requested_scene:
            self.requested_scene = message["scene"]
        if "reset" in message:
            self._restart_session(now)

    def _set_driving_page(self, client: int, now: float) -> None:
        self._driver = client
        self._requested = self._session.inputs_at_stylus().with_changes({"clutch": 1})
        self._rates = InputRateIntegrator()
        if self._asleep:
            self.pace.restart(now)
        self._asleep = False

    @property
    def simulated_ms(self) -> int:
        return self._session.ms

    @property
    def is_halted(self) -> bool:
        return self._paused or self._asleep or bool(self.stop_reason or self.requested_scene)

    def time_to_next_tick(self, now: float) -> float:
        frame = self._frame_due - now
        due = frame if self.is_halted else min(frame, self.pace.time_to_next_slice(now))
        return max(0.0, due)

    def tick(self, clock: Callable[[], float]) -> dict[str, Any] | None:
        """Simulate the due slices, at most four; return a frame for the pages if one is due."""
        for _ in range(_MAX_SLICES_PER_TICK):
            now = clock()
            if self.is_halted or self.pace.time_to_next_slice(now) > 0:
                break
            self.pace.begin_slice(now)
            self._simulate_time_slice(now)
        now = clock()
        self._resume_simulation_if_device_sends(now)
        if self._driver is None and not self._asleep and now - self._idle_since >= _MAX_UNDRIVEN_S:
            self._asleep = True
            self._run_and_stop_session_on_failure(self._session.write_record_and_log)
        # A new input or contact is shown at once; the schedule of frames then restarts.
        show_now = self._show_now and now >= self._last_frame_at + _MIN_TIME_BETWEEN_PAGE_FRAMES_S
        if now < self._frame_due and not show_now:
            return None
        scheduled = max(self._frame_due + FRAME_PERIOD_S, now - FRAME_PERIOD_S)
        self._frame_due = now + 1.5 * FRAME_PERIOD_S if show_now else scheduled
        self._last_frame_at, self._show_now = now, False
        return self.frame()

    def _resume_simulation_if_device_sends(self, now: float) -> None:
        if self._link is None or self._link.receive_state(now) is None:
            return
        self._idle_since = now
        if self._asleep:
            self._asleep = False
            self.pace.restart(now)

    def _run_and_stop_session_on_failure(self, action: Callable[[], None]) -> None:
        try:
            action()
        except _EXCEPTIONS_THAT_STOP_SESSION as error:
            self.stop_reason = to_one_line(str(error))

    def _simulate_time_slice(self, now: float) -> None:
        self._requested = self._rates.advance_inputs(self._requested, 1e-3 * self._slice_ms, now)
        self._show_now |= self._requested.hand_pose_and_held != self._last_target
        self._last_target = self._requested.hand_pose_and_held
        requested, may_jump = self._requested, not self._session.inputs.held
        if self._link is not None:
            requested = requested.with_changes(self._link.hand_inputs(now))
            may_jump |= not requested.clutch
        try:
            self._session.apply_inputs(self._limiter.limit_inputs(requested, may_jump=may_jump))
        except _EXCEPTIONS_THAT_STOP_SESSION as error:
            present = self._session.inputs
            if self._requested.station_choices == present.station_choices:
                self.stop_reason = to_one_line(str(error))
            else:  # there is no such station: keep the present one
                self._refusal = to_one_line(str(error))
                removed = {name: getattr(present, name) for name in live_inputs.STATION_SWAP_INPUTS}
                self._requested = self._requested.with_changes(removed)
        if not self.stop_reason:
            self._run_and_stop_session_on_failure(lambda: self._session.advance(self._slice_ms))
            pressed = self._session.contact_force() > MIN_GAMEPAD_TOUCH_FORCE_N
            self._show_now |= pressed and not self._touched
            self._touched = pressed
        if self._link is not None and not self.stop_reason:
            self._link.send_wrench(self._session.device_wrench())
        if self._session.ms >= live_inputs.MAX_DURATION_MS:
            self.stop_reason = "the limit of ten hours of simulated time is reached"

    def frame(self) -> dict[str, Any]:
        rows = self._session.new_rows()
        if len(rows["t"]):
            values = self._cockpit.page_values(rows, self._session.inputs)
            self._last_frame = values | self._scene_part(rows)
        inputs = self._requested
        words = self._last_frame.get("words", [])
        if self._session.is_channel_filling:
            words = ["a new channel starts: the clutch is open until its packets arrive", *words]
        removed = self._session.force_above_limit()
        if removed > _MIN_REPORTED_UNRENDERED_FORCE_N:
            words = [f"{removed:.1f} N are not rendered until the hand presses less", *words]
        if self._refusal:
            words = [self._refusal, *words]
        return self._last_frame | {
            "words": words,
            "device": "" if self._link is None else self._link.status_text(),
            "speed": round(self.pace.real_time_factor, 4),
            "slow": self.pace.slowdown,
            "factor": round(self.pace.real_time_factor * self.pace.slowdown, 3),
            "late": round(1e3 * self.pace.lateness_p99_s(), 1),
            "lost": round(self.pace.lost_time_s, 2),
            "state": self._session_state_name(),
            "driver": self._driver,
            "drive": self._drives,
            "scene": self.requested_scene or self.scene,
            "record": self._folder,
            "stopped": self.stop_reason,
            "inputs": dict(vars(inputs)),
        }

    def _session_state_name(self) -> str:
        if self.requested_scene:
            return "preparing"
        if self.stop_reason:
            return "stopped"
        return "paused" if self._paused else "waiting" if self._asleep else "running"

    def end_session(self) -> None:
        try:
            self._session.close()
        except DrakeTeleopError as error:
            self._write_error = self._write_error or str(error)
            raise
        if self._folder and self._session.ms:
            self.recorded.append(self._folder)
        self._folder = ""

    def close(self) -> None:
        self._run_and_stop_session_on_failure(self.end_session)
        if self._link is not None:
            self._link.close()
        if self._write_error:
            raise CannotWrite(self._write_error)


def _unused_folder_path(folder: Path) -> Path:
    folder = folder if folder.name.strip(".") else folder.resolve()  # "." has no name to number
    if not folder.is_dir() or not any(folder.iterdir()):
        return folder
    names = (folder.with_name(f"{folder.name}-{k}") for k in itertools.count(2))
    return next(name for name in names if not name.exists())


def parse_message(text: Any) -> dict[str, Any] | None:
    if not isinstance(text, str) or len(text) > MAX_MESSAGE_BYTES:
        return None
    try:
        message = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if not isinstance(message, dict):
        return None
    found: dict[str, Any] = {}
    for kind in ("set", "rates"):
        values = message.get(kind)
        if isinstance(values, dict):
            found[kind] = {name: value for name, value in values.items() if _is_valid_number(value)}
    if isinstance(message.get("pause"), bool):
        found["pause"] = message["pause"]
    if _is_valid_number(message.get("slow")):
        found["slow"] = min(max(float(message["slow"]), 1.0), MAX_SLOWDOWN)
    if isinstance(message.get("scene"), str) and message["scene"] in SCENE_NAMES:
        found["scene"] = message["scene"]
    found |= {name: True for name in ("reset", "drive", "go") if message.get(name) is True}
    if type(message.get("answer")) is int and message["answer"] in (1, 2):
        found["answer"] = message["answer"]
    return found or None


def _is_valid_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return abs(value) < 1e15 and math.isfinite(value)
