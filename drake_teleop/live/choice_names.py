"""What a driver may choose, by name: each choice is recorded as a number of these."""

from __future__ import annotations

from drake_teleop.station.channel.network import PRESETS as NETWORK_PRESETS
from drake_teleop.station.operator.operator import GRIPS
from drake_teleop.station.passivity.methods import METHODS
from drake_teleop.station.scenario import Scenario
from drake_teleop.station.sensor.presets import PRESETS as SENSOR_PRESETS

OWN = "as in the scenario"
NETWORKS = (OWN, *NETWORK_PRESETS, "custom")
SENSORS = (OWN, *SENSOR_PRESETS)
#: What each number of a choice means.
NAMES = {"network": NETWORKS, "method": METHODS, "grip": tuple(GRIPS), "sensor": SENSORS}


def first_choices(scenario: Scenario) -> dict[str, int]:
    """The choices that leave a scenario as it is."""
    return {
        "network": 0,
        "method": METHODS.index(scenario.passivity.method),
        "grip": list(GRIPS).index(scenario.operator.grip),
        "object": int(scenario.slave.payload.mass > 0.0),
        "detection": int(scenario.contact_detection is not None),
        "sensor": 0,
    }
