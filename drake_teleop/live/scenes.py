"""Scenes of a drive: stations that the page offers."""

from __future__ import annotations

from drake_teleop.live.session import live_scenario
from drake_teleop.station.environment.wall import Wall
from drake_teleop.station.scenario import LoadScenario, Scenario, replace

#: Shipped scenario of each scene; "own" is the scenario of the drive.
_SHIPPED = {
    "leaf": "touch",
    "slot": "peg_in_slot",
    "wall": "touch",
    "block": "push_block",
}
SCENES = ("own", *_SHIPPED)


def scene(name: str, own: Scenario) -> Scenario:
    """Return the scenario of one of `SCENES`; "own" is the drive's first scenario."""
    if name == "own":
        return own
    scenario = LoadScenario(_SHIPPED[name])
    if name == "wall":
        wall = Wall(position=[0.55, 0.0, 0.17], stiffness=1e4)
        changes = {"sheet_spring": None, "environment": [wall], "description": "a wall to press on"}
        scenario = replace(scenario, **changes)
    return live_scenario(scenario)
