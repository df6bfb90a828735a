"""Names of the choices of a drive; a choice is an index into them."""

from __future__ import annotations

from drake_teleop.station.channel.network import PRESETS as NETWORK_PRESETS
from drake_teleop.station.operator.operator import GRIPS
from drake_teleop.station.passivity.methods import METHODS
from drake_teleop.station.scenario import Scenario
from drake_teleop.station.sensor.presets import PRESETS as SENSOR_PRESETS

OWN = "as in the scenario"
NETWORKS = (OWN, *NETWORK_PRESETS, "custom")
SENSORS = (OWN, *SENSOR_PRESETS)
#: Names of each choice; a choice is the index of its name.
NAMES = {"network": NETWORKS, "method": METHODS, "grip": tuple(GRIPS), "sensor": SENSORS}


def first_choices(scenario: Scenario) -> dict[str, int]:
    """Return the choices that leave a scenario unchanged."""
    return {
        "network": 0,
        "method": METHODS.index(scenario.passivity.method),
        "grip": list(GRIPS).index(scenario.operator.grip),
        "object": int(scenario.slave.payload.mass > 0.0),
        "detection": int(scenario.contact_detection is not None),
        "sensor": 0,
    }
