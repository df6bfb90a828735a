"""Bilateral teleoperation with non-contact force scaling, on Drake.

Each name is imported at its first use: work with a log does not load the simulator.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.version import __version__

if TYPE_CHECKING:
    from drake_teleop.lab.identification import identify_load
    from drake_teleop.lab.run import run_scenario
    from drake_teleop.lab.tuning.tune import tune
    from drake_teleop.live.server import drive
    from drake_teleop.load.compensation import contact_wrench, scaled_wrench
    from drake_teleop.load.identification import Identification
    from drake_teleop.load.normal_equations import identify
    from drake_teleop.load.regressor import non_contact_wrench, regressor
    from drake_teleop.logs.processing import eliminate_log, identify_log
    from drake_teleop.logs.read.reading import read_log
    from drake_teleop.station.channel_side import MakeChannel
    from drake_teleop.station.master_side import MakeMasterSide
    from drake_teleop.station.operator.operator import MinimumJerk, Sine
    from drake_teleop.station.result import SimulationResult
    from drake_teleop.station.scenario import LoadScenario, Scenario, ScenarioNames
    from drake_teleop.station.sensor.plant_wrist_sensor import AddWristSensor
    from drake_teleop.station.simulation import simulate
    from drake_teleop.station.slave_side import MakeSlaveSide
    from drake_teleop.station.station import MakeIdentificationStation, MakeTeleopStation

__all__ = [
    "AddWristSensor",
    "DrakeTeleopError",
    "Identification",
    "LoadScenario",
    "MakeChannel",
    "MakeIdentificationStation",
    "MakeMasterSide",
    "MakeSlaveSide",
    "MakeTeleopStation",
    "MinimumJerk",
    "Scenario",
    "ScenarioNames",
    "SimulationResult",
    "Sine",
    "__version__",
    "contact_wrench",
    "drive",
    "eliminate_log",
    "identify",
    "identify_load",
    "identify_log",
    "non_contact_wrench",
    "read_log",
    "regressor",
    "run_scenario",
    "scaled_wrench",
    "simulate",
    "tune",
]

_NAMES_BY_MODULE = {
    "lab.identification": ("identify_load",),
    "lab.run": ("run_scenario",),
    "lab.tuning.tune": ("tune",),
    "live.server": ("drive",),
    "load.compensation": ("contact_wrench", "scaled_wrench"),
    "load.identification": ("Identification",),
    "load.normal_equations": ("identify",),
    "load.regressor": ("non_contact_wrench", "regressor"),
    "logs.processing": ("eliminate_log", "identify_log"),
    "logs.read.reading": ("read_log",),
    "station.channel_side": ("MakeChannel",),
    "station.master_side": ("MakeMasterSide",),
    "station.operator.operator": ("MinimumJerk", "Sine"),
    "station.result": ("SimulationResult",),
    "station.scenario": ("LoadScenario", "Scenario", "ScenarioNames"),
    "station.sensor.plant_wrist_sensor": ("AddWristSensor",),
    "station.simulation": ("simulate",),
    "station.slave_side": ("MakeSlaveSide",),
    "station.station": ("MakeIdentificationStation", "MakeTeleopStation"),
}
_MODULE_BY_NAME = {name: module for module, names in _NAMES_BY_MODULE.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _MODULE_BY_NAME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_MODULE_BY_NAME[name]}"), name)
    globals()[name] = value  # the next access is an ordinary one
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
