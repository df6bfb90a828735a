"""Event handler and server for the experiment of one participant."""

from __future__ import annotations

import dataclasses
import json
import time
import webbrowser
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import CannotWrite
from drake_teleop.live.device_link import DeviceLink
from drake_teleop.live.experiment.apparatus import Apparatus, IntervalLog
from drake_teleop.live.experiment.design import PegInSlot
from drake_teleop.live.experiment.procedure import GAP_PHASE, INTERVAL_PHASE, Procedure
from drake_teleop.live.experiment.simulated import make_apparatuses, with_noise_seed_of_interval
from drake_teleop.live.inputs import Inputs
from drake_teleop.live.live import FRAME_PERIOD_S, Live, SceneFunction, parse_message
from drake_teleop.live.page_scene import PageScene
from drake_teleop.live.scenarios import with_task_space_device
from drake_teleop.live.server import LiveDrive, compile_slice_functions
from drake_teleop.station.operator.task import Insert
from drake_teleop.station.scenario import Scenario

#: Pause between the intervals of a trial [s].
_INTERSTIMULUS_PAUSE_S = 0.8
_FRAME_KEYS_SHOWN_TO_PARTICIPANT = (
    *("t", "tool", "stylus", "device", "factor", "late", "lost", "stopped"),
    *("speed", "slow", "view", "no_view", "moves"),
)
_HIDDEN_FRAME_KEY_PLACEHOLDERS = {"contact": False, "energy": [0.0, 0.0], "words": [], "record": ""}

#: Names of the inputs that move the hand.
HAND_MOTION_INPUTS = ("x", "y", "z", "rx", "ry", "rz", "clutch")


class GuidedExperiment:
    """Event handler of an experiment for page messages and clock ticks; `now`: clock time [s].

    Each interval is a recorded live session. The page receives no force but the rendered one.
    """

    def __init__(
        self,
        procedure: Procedure,
        apparatuses: dict[tuple[int, int], Apparatus],
        scene_functions: Sequence[SceneFunction],
        now: float,
        link: DeviceLink | None = None,
    ) -> None:
        self.refused, self.requested_scene, self._write_error = 0, "", ""
        self._procedure, self._scene_functions = procedure, scene_functions
        self._apparatuses, self._link = apparatuses, link
        self._drives = procedure.store.folder / "drives" / f"{procedure.participant:02}"
        self._driver: int | None = None
        self._intervals, self._phase_start, self._frame_due = 0, now, now
        self._prepare_interval(now)

    def _prepare_interval(self, now: float) -> None:
        procedure = self._procedure
        trial, self._prepared = procedure.trial, procedure.prepared_intervals
        self._apparatus = self._apparatuses[trial.task, trial.condition]
        self._show = self._scene_functions[trial.task]
        insert = self._apparatus.base.operator.task
        insert = insert if isinstance(insert, Insert) else None
        self._rows = IntervalLog(self._apparatus.scenario, insert)
        self._stimulus = self._apparatus.stimulus_scales(
            procedure.current_level, procedure.expected_contact_force
        )
        name = f"{procedure.num_completed_trials:04}-{procedure.interval}"
        setup = with_noise_seed_of_interval(self._apparatus.scenario, procedure)
        station = setup, self._apparatus.load, self._drives / name
        show = self._store_rows_and_get_scene_values
        self._live = Live(*station, show, now, self._link, log=False, begin=self._stimulus)
        self._intervals += 1
        if self._driver is not None:
            self._live.join(self._driver, now)

    def _store_rows_and_get_scene_values(self, rows: dict[str, np.ndarray]) -> dict[str, Any]:
        self._rows.add_rows(rows)
        hidden = ("measured_wrench_S", "load_estimate")
        return self._show(rows | {name: np.zeros_like(rows[name]) for name in hidden})

    def hello_message(self) -> dict[str, Any]:
        procedure = self._procedure
        known = {"scenario": f"Participant {procedure.participant}", "scenes": []}
        hidden = {"object": False, "known": False, "noise": False, "touch": 0.01}
        study = {"feedback": procedure.experiment.feedback, "device": self._link is not None}
        return self._live.hello_message() | known | hidden | {"study": study}

    def join(self, client: int, now: float) -> None:
        if self._driver is None:
            self._set_driving_page(client, now)

    def _set_driving_page(self, client: int, now: float) -> None:
        self._remove_driving_page(now)
        self._driver = client
        self._live.join(client, now)

    def leave(self, client: int, now: float) -> None:
        if client == self._driver:
            self._remove_driving_page(now)

    def _remove_driving_page(self, now: float) -> None:
        if self._driver is None:
            return
        self._live.leave(self._driver, now)
        self._driver = None
        self._procedure.restart_trial()
        self._replace_interval_if_procedure_advanced(now)

    def _replace_interval_if_procedure_advanced(self, now: float) -> None:
        with self._catch_write_error():
            if self._procedure.prepared_intervals != self._prepared:
                self._live.end_session()
                self._prepare_interval(now)

    @contextmanager
    def _catch_write_error(self) -> Iterator[None]:
        try:
            yield
        except CannotWrite as error:
            self._write_error = str(error)

    def handle_message(self, client: int, text: Any, now: float) -> None:
        message = parse_experiment_message(text)
        if message is None:
            self.refused += 1
            return
        if "drive" in message and client != self._driver:
            self._set_driving_page(client, now)
        if client != self._driver:
            return
        procedure = self._procedure
        if procedure.phase == INTERVAL_PHASE:
            moves = {kind: message[kind] for kind in message.keys() & {"set", "rates"}}
            self._live.handle_message(client, json.dumps(moves), now)
        before = procedure.phase, procedure.num_completed_trials
        if "answer" in message:
            with self._catch_write_error():
                procedure.store_answer(message["answer"], now - self._phase_start)
        elif "go" in message:
            procedure.advance_phase()
        if (procedure.phase, procedure.num_completed_trials) == before:
            return
        self._replace_interval_if_procedure_advanced(now)
        self._phase_start = now
        if procedure.phase == INTERVAL_PHASE:
            self._live.pace.restart(now)

    def time_to_next_tick(self, now: float) -> float:
        if self._is_interval_running:
            return self._live.time_to_next_tick(now)
        return max(0.0, self._frame_due - now)

    @property
    def stop_reason(self) -> str:
        return self._live.stop_reason

    @property
    def simulated_ms(self) -> int:
        return self._live.simulated_ms

    @property
    def _is_interval_running(self) -> bool:
        return self._procedure.phase == INTERVAL_PHASE and self._driver is not None

    def tick(self, clock: Callable[[], float]) -> dict[str, Any] | None:
        if self._write_error:
            raise CannotWrite(self._write_error)
        now = clock()
        if self._procedure.phase == GAP_PHASE and now - self._phase_start >= _INTERSTIMULUS_PAUSE_S:
            self._procedure.start_second_interval()
            self._live.pace.restart(now)
        if self._is_interval_running:
            frame_is_due = self._live.tick(clock) is not None
            self._end_interval_if_over(clock())
            return self.frame() if frame_is_due else None
        if now < self._frame_due:
            return None
        self._frame_due = now + FRAME_PERIOD_S
        return self.frame()

    def _end_interval_if_over(self, now: float) -> None:
        task, live = self._procedure.task, self._live
        slot = isinstance(task, PegInSlot)
        length = task.timeout if isinstance(task, PegInSlot) else task.interval
        if live.simulated_ms < 1e3 * length and not (slot and self._rows.done_at):
            return
        live.frame()
        level = self._procedure.current_level
        result = self._apparatus.interval_result(level, self._stimulus, self._rows)
        self._procedure.finish_interval(dataclasses.replace(result, lost_s=live.pace.lost_time_s))
        self._phase_start = self._frame_due = now
        self._replace_interval_if_procedure_advanced(now)

    def frame(self) -> dict[str, Any]:
        inner = self._live.frame()
        rendered = inner.get("f", [[0.0, 0.0]] * 3)[2] if self._is_interval_running else [0.0, 0.0]
        task = self._procedure.task
        end = task.timeout if isinstance(task, PegInSlot) else task.interval
        left = max(0.0, 1.0 - 1e-3 * self.simulated_ms / end) if self._is_interval_running else 0.0
        inputs = vars(Inputs()) | {name: inner["inputs"][name] for name in HAND_MOTION_INPUTS}
        scaling = self._apparatus.scenario.kinematic_scaling
        return {
            **{name: inner[name] for name in _FRAME_KEYS_SHOWN_TO_PARTICIPANT if name in inner},
            **_HIDDEN_FRAME_KEY_PLACEHOLDERS,
            "f": [rendered] * 3,
            "scene": "own",
            "state": "stopped" if inner["stopped"] else "running",
            "driver": self._driver,
            "drive": self._intervals,
            "inputs": inputs,
            "scale": scaling.translation_scale,
            "study": self._procedure.page_state() | {"left": round(left, 3)},
        }

    def close(self) -> None:
        self._live.close()
        if self._link is not None:
            self._link.close()


def parse_experiment_message(text: Any) -> dict[str, Any] | None:
    """Return the valid requests of a participant in a message, or None."""
    message = parse_message(text) or {}
    found = {name: message[name] for name in message.keys() & {"drive", "go", "answer"}}
    for kind in message.keys() & {"set", "rates"}:
        found[kind] = {
            name: value for name, value in message[kind].items() if name in HAND_MOTION_INPUTS
        }
    return found or None


class ExperimentDrive(LiveDrive):
    """Live session and server of one participant."""

    def __init__(
        self, procedure: Procedure, scenarios: list[Scenario], port: int, device: str | None
    ) -> None:
        if device is not None:
            scenarios = [with_task_space_device(scenario) for scenario in scenarios]
        self._procedure = procedure
        self._apparatuses = make_apparatuses(procedure.experiment, scenarios)
        super().__init__(scenarios[0], None, port, device)

    def _build_scenes_and_compile(self, scenario: Scenario, device: bool) -> None:
        for task in range(len(self._procedure.experiment.tasks)):
            setup = self._apparatuses[task, 0].scenario
            self._views[str(task)] = PageScene(str(task), setup, forces=False)
        first = self._apparatuses[0, 0]
        compile_slice_functions(first.scenario, first.load, device)

    def _make_live_session(self, scenario: Scenario, record: Path | None) -> Any:
        scenes = [view.scene_values for view in self._views.values()]
        now = time.perf_counter()
        return GuidedExperiment(self._procedure, self._apparatuses, scenes, now, self._link)

    def _page_html(self) -> str:
        panel = resources.files("drake_teleop.live.experiment") / "page.html"
        return super()._page_html().replace("</body>", panel.read_text("utf-8") + "</body>")


def serve_experiment(
    procedure: Procedure, scenarios: list[Scenario], *, port: int, browser: bool, device: str | None
) -> None:
    live, who = ExperimentDrive(procedure, scenarios, port, device), procedure.participant
    if browser:
        webbrowser.open(live.url)
    reason = live.announce_and_wait(f"participant {who}")
    done, trials = procedure.num_completed_trials, len(procedure.trials)
    what = f"participant {who} has done {done} of {trials} trials"
    if live.ended:
        what = f"the simulation has stopped: {live.ended}; {what}"
        raise DrakeTeleopError(what, where="drive", remedy="run the same command again to continue")
    if done < trials:
        raise KeyboardInterrupt(f"{reason}: {what}; run the same command again to continue")
    print(f"\nended by {reason}: {what}")
