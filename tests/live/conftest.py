"""Fixtures of drives: a leaf 6 mm below the tool, and its true load."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from drake_teleop.lab.identified_load import IdentifiedLoad
from drake_teleop.live import server
from drake_teleop.live.scenarios import live_scenario
from drake_teleop.load.identification import Identification
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.slave.plant import NominalSlave


@pytest.fixture(scope="session")
def scenario() -> Scenario:
    """Return a scenario with a leaf 6 mm below the tool and a sensor without errors."""
    setup = live_scenario(LoadScenario("contact_transition"))
    place = [0.55, 0.0, 0.233]
    return replace(setup, sheet_spring__position=place, wrist_sensor__ideal=True)


@pytest.fixture(scope="session")
def load(scenario: Scenario) -> IdentifiedLoad:
    """Return the true load."""
    phi = NominalSlave(scenario.slave).arm.phi_load
    truth = Identification(
        phi=phi, offsets=np.zeros(6), covariance=np.eye(16), identifiable=np.ones(16, bool),
        condition_number=1.0, delay_s=0.0, residual_rms=np.zeros(6),
        method="known", samples=0,
    )  # fmt: skip
    return IdentifiedLoad(truth, None, from_cache=False)


@pytest.fixture(scope="session")
def live(scenario: Scenario, load: IdentifiedLoad) -> Iterator[server.LiveDrive]:
    """Yield a drive with an open port."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(server, "identified_load", lambda *_: load)
        drive = server.drive(scenario)
    yield drive
    drive.stop()
