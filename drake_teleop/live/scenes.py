"""What there is to touch in a drive: stations to choose from in the page."""

from __future__ import annotations

from drake_teleop.live.session import live_scenario
from drake_teleop.station.environment.solids import Wall
from drake_teleop.station.scenario import LoadScenario, Scenario, replace

#: Scene -> a shipped scenario; "own" is what the drive was begun with.
_SHIPPED = {
    "leaf": "touch",
    "slot": "peg_in_slot",
    "wall": "touch",
    "block": "push_block",
}
SCENES = ("own", *_SHIPPED)


def scene(name: str, own: Scenario) -> Scenario:
    """A scenario to drive.

    Args:
        name: one of `SCENES`.
        own: that the drive was begun with.
    """
    if name == "own":
        return own
    scenario = LoadScenario(_SHIPPED[name])
    if name == "wall":
        wall = Wall(position=[0.55, 0.0, 0.17], stiffness=1e4)
        changes = {"sheet_spring": None, "environment": [wall], "description": "a wall to press on"}
        scenario = replace(scenario, **changes)
    return live_scenario(scenario)
