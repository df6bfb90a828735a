"""Drake blocks of the teleoperation station, with one port per signal, for custom Diagrams."""

from drake_teleop.station.blocks.channel import NetworkChannel, PassivityAtMaster, PassivityAtSlave
from drake_teleop.station.blocks.estimators import ContactDetector, LoadEstimator
from drake_teleop.station.blocks.force_display import ForceDisplay
from drake_teleop.station.blocks.wrenches import (
    NonContactWrench,
    NonContactWrench_,
    WrenchScaling,
    WrenchScaling_,
)
from drake_teleop.station.scaling.kinematic_scaling import KinematicScaling

__all__ = [
    "ContactDetector",
    "ForceDisplay",
    "KinematicScaling",
    "LoadEstimator",
    "NetworkChannel",
    "NonContactWrench",
    "NonContactWrench_",
    "PassivityAtMaster",
    "PassivityAtSlave",
    "WrenchScaling",
    "WrenchScaling_",
]
