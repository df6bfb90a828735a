"""Server of the page of an experiment."""

from __future__ import annotations

import time
import webbrowser
from importlib import resources
from pathlib import Path
from typing import Any

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.live.experiment.design import Experiment
from drake_teleop.live.experiment.guided import GuidedExperiment
from drake_teleop.live.experiment.procedure import Procedure
from drake_teleop.live.experiment.simulated import make_apparatuses
from drake_teleop.live.experiment.store import TrialStore
from drake_teleop.live.page_scene import PageScene
from drake_teleop.live.scenarios import with_task_space_device
from drake_teleop.live.server import LiveDrive, compile_slice_functions, start_condition_text
from drake_teleop.station.scenario import Scenario


class ExperimentDrive(LiveDrive):
    """Live session of one participant, with its server."""

    def __init__(
        self,
        experiment: Experiment,
        scenarios: list[Scenario],
        store: TrialStore,
        participant: int,
        port: int = 0,
        device: str | None = None,
    ) -> None:
        if device is not None:
            scenarios = [with_task_space_device(scenario) for scenario in scenarios]
        self._stations = make_apparatuses(experiment, scenarios)
        self.procedure = Procedure(experiment, participant, store)
        self._scenarios, self._store = scenarios, store
        super().__init__(scenarios[0], None, port, device)

    def _prepare_scenes(self, scenario: Scenario, device: bool) -> None:
        for task in map(str, range(len(self._scenarios))):
            self._views[task] = PageScene(task, self._stations[int(task), 0].scenario, forces=False)
        first = self._stations[0, 0]
        compile_slice_functions(first.scenario, first.load, device)

    def _make_live(self, scenario: Scenario, record: Path | None) -> Any:
        link = None if self._device is None else self._device.link
        shows = [view.frame_part for view in self._views.values()]
        setup = (self.procedure, self._stations, self._scenarios, self._store, shows)
        return GuidedExperiment(*setup, time.perf_counter(), link)

    def _page_html(self) -> str:
        panel = resources.files("drake_teleop.live.experiment") / "page.html"
        return super()._page_html().replace("</body>", panel.read_text("utf-8") + "</body>")


def serve_experiment(
    experiment: Experiment,
    scenarios: list[Scenario],
    store: TrialStore,
    participant: int,
    *,
    port: int,
    browser: bool,
    device: str | None,
) -> None:
    live = ExperimentDrive(experiment, scenarios, store, participant, port, device)
    if browser:
        webbrowser.open(live.url)
    print(
        f"participant {participant} at {live.url}\n{start_condition_text(device)}; Ctrl-C ends it",
        flush=True,
    )
    reason = live.wait_for_signal()
    done, trials = live.procedure.trial_number, len(live.procedure.trials)
    what = f"participant {participant} has done {done} of {trials} trials"
    if live.ended:
        what = f"the simulation has stopped: {live.ended}; {what}"
        raise DrakeTeleopError(what, where="drive", remedy="run the same command again to continue")
    if done < trials:
        raise KeyboardInterrupt(f"{reason}: {what}; run the same command again to continue")
    print(f"\nended by {reason}: {what}")
