"""The page of an experiment: that of `drive`, whose cockpit gives way to what is asked."""

from __future__ import annotations

import time
import webbrowser
from importlib import resources
from pathlib import Path
from typing import Any

from drake_teleop.experiment.design import Experiment
from drake_teleop.experiment.guided import Guided
from drake_teleop.experiment.procedure import Procedure
from drake_teleop.experiment.simulated import all_apparatus
from drake_teleop.experiment.store import Store
from drake_teleop.identified_load import IdentifiedLoad
from drake_teleop.live.external_master import with_device
from drake_teleop.live.live import Show
from drake_teleop.live.server import LiveDrive, show_in
from drake_teleop.scenario import Scenario


class ExperimentDrive(LiveDrive):
    """An experiment whose page is open to one participant.

    Args:
        experiment, scenarios: as `LoadExperiment` gives them.
        store: of the trials.
        participant: whose turn it is.
        port, device: as of `drive`.
    """

    def __init__(
        self,
        experiment: Experiment,
        scenarios: list[Scenario],
        store: Store,
        participant: int,
        port: int = 0,
        device: str | None = None,
    ) -> None:
        if device is not None:
            scenarios = [with_device(scenario) for scenario in scenarios]
        self._stations = all_apparatus(experiment, scenarios)
        self._procedure = Procedure(experiment, participant, store)
        self._scenarios, self._store = scenarios, store
        super().__init__(scenarios[0], None, port, device)

    def _make(self, scenario: Scenario, load: IdentifiedLoad | None, record: Path | None) -> Any:
        def shows(scenario: Scenario) -> Show:
            self._meshcat.Delete()
            return show_in(self._meshcat, scenario, forces=False)  # which eyes would tell

        link = None if self._device is None else self._device.link
        setup = (self._procedure, self._stations, self._scenarios, self._store, shows)
        return Guided(*setup, time.perf_counter(), link)

    def _page(self) -> bytes:
        panel = resources.files("drake_teleop.experiment").joinpath("page.html").read_bytes()
        return super()._page().replace(b"</body>", panel + b"</body>")


def serve_experiment(
    experiment: Experiment,
    scenarios: list[Scenario],
    store: Store,
    participant: int,
    *,
    port: int,
    browser: bool,
    device: str | None,
) -> None:
    """Serves the page until Ctrl-C.

    Args:
        experiment, scenarios, store, participant, port, device: as of `ExperimentDrive`.
        browser: whether to open the page.
    """
    live = ExperimentDrive(experiment, scenarios, store, participant, port, device)
    if browser:
        webbrowser.open(live.url)
    print(f"participant {participant} at {live.url}\nCtrl-C ends it", flush=True)
    live.wait()
