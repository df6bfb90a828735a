"""What of its station a driver chooses while it runs: network, method, grip, object, sensor.

A choice is a number, as every input of a drive; together they make another scenario, whose station
goes on where the present one is (`drake_teleop.live.handing_on`).
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from drake_teleop.lab.identified_load import IdentifiedLoad
from drake_teleop.live.choice_names import NETWORKS, OWN, SENSORS
from drake_teleop.live.inputs import Inputs
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.channel.network import longest_delay
from drake_teleop.station.estimation.contact_detection import ContactDetectionConfig
from drake_teleop.station.operator.operator import GRIPS
from drake_teleop.station.passivity.methods import METHODS
from drake_teleop.station.passivity.safe_state import RESUME_TIME
from drake_teleop.station.scenario import Scenario, replace
from drake_teleop.station.sensor.presets import PRESETS as SENSOR_PRESETS
from drake_teleop.station.slave.payload import Payload
from drake_teleop.station.slave.plant import NominalSlave

Array = NDArray[np.float64]

#: What is grasped, if the scenario's tool holds nothing.
OBJECT = Payload(mass=0.8)
#: In which the hand goes over to what it feels of another station [s].
BLEND = 0.25
# Of `wave`'s line, where the scenario does not use it [N m s/rad]. A ball on a leaf has 1.5 N m of
# friction about the sensor, which a line of the default 0.05 does not hold: over 0.2 s it topples.
_TURNING = 0.5
_TENTH_OF_MS, _PERCENT, _PER_MILLE = 1e-4, 1e-2, 1e-3


def chosen(scenario: Scenario, load: IdentifiedLoad | None, inputs: Inputs) -> Scenario:
    """The scenario with everything that the driver has chosen.

    Contact is detected with the sensor alone whose noise is known, the scenario's own.
    """
    changes: dict[str, object] = {
        "passivity__method": METHODS[inputs.method],
        "operator__grip": list(GRIPS)[inputs.grip],
    }
    if METHODS[inputs.method] == "wave" != scenario.passivity.method:
        along, turning = scenario.passivity.wave.impedance
        wave = dataclasses.replace(
            scenario.passivity.wave, impedance=[along, max(turning, _TURNING)]
        )
        changes["passivity__wave"] = wave
    name = NETWORKS[inputs.network]
    if name == "custom":
        changes["channel"] = Channel(
            delay=_TENTH_OF_MS * inputs.delay,
            jitter=_PERCENT * inputs.jitter,
            distribution="gamma",
            loss=_PER_MILLE * inputs.loss,
        )
    elif name != OWN:
        changes["channel"] = Channel(network=name)
    if inputs.sensor:
        changes["wrist_sensor"] = SENSOR_PRESETS[SENSORS[inputs.sensor]]
    if not (inputs.detection and _noise_is_known(load, inputs)):
        changes["contact_detection"] = None
    elif scenario.contact_detection is None:
        changes["contact_detection"] = ContactDetectionConfig()
    holds = scenario.slave.payload.mass > 0.0
    if inputs.object != holds:
        held = OBJECT if inputs.object else dataclasses.replace(OBJECT, mass=0.0)
        changes["slave__payload"] = held
    changed = replace(scenario, **changes)
    if inputs.object and load is not None and scenario.force_scaling.gripper_phi is None:
        gripper = load.identification.phi - holds * _object_phi(changed)
        changed = replace(changed, force_scaling__gripper_phi=gripper.tolist())
    return changed


def _noise_is_known(load: IdentifiedLoad | None, inputs: Inputs) -> bool:
    return load is not None and load.noise_floor is not None and inputs.sensor == 0


def _object_phi(scenario: Scenario) -> Array:
    """(10,) of the object alone, about So in S."""
    held = NominalSlave(scenario.slave).arm.phi_load
    empty = replace(scenario, slave__payload=Payload(mass=0.0))
    return held - NominalSlave(empty.slave).arm.phi_load


def known_estimate(before: Scenario, load: IdentifiedLoad | None, now: Scenario) -> Array | None:
    """(16,) what the station knows of its load in another scenario than it was identified in.

    It is told what it grasps, as a robot is; and another sensor is tared as the first one was.
    """
    if load is None:
        return None
    estimate = load.estimate.copy()
    estimate[:6] += _offset(now) - _offset(before)
    arms = (NominalSlave(scenario.slave).arm for scenario in (now, before))
    estimate[6:] += np.subtract(*(arm.phi_load for arm in arms))
    return estimate


def _offset(scenario: Scenario) -> Array:
    sensor = scenario.wrist_sensor
    return np.zeros(6) if sensor.ideal else np.array(sensor.offset)


def filled_after(scenario: Scenario) -> float:
    """How long it takes until a new channel passes on all that it gets [s]."""
    if scenario.is_direct:
        return 0.0
    return sum(longest_delay(line) for line in scenario.channel.lines()) + RESUME_TIME
