"""Scenarios of a live session: those of the web page's scenes, changed by the user's choices."""

from __future__ import annotations

import dataclasses

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.lab.identified_load import IdentifiedLoad
from drake_teleop.live.inputs import NETWORK_NAMES, SENSOR_NAMES, UNCHANGED_CHOICE, Inputs
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.channel.network import longest_delay
from drake_teleop.station.environment.solids import Wall
from drake_teleop.station.estimation.contact_detection import ContactDetectionConfig
from drake_teleop.station.master.data_sheets import LEADER_NAME, PHANTOM_NAME, Master
from drake_teleop.station.operator.operator import GRIP_IMPEDANCES
from drake_teleop.station.passivity.methods import METHODS
from drake_teleop.station.passivity.safe_state import RESUME_TIME_S
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.sensor.presets import PRESETS as SENSOR_PRESETS
from drake_teleop.station.slave.plant import NominalSlave
from drake_teleop.station.slave.slave_config import Payload

#: Gripped object, if the scenario has no payload.
DEFAULT_GRIPPED_PAYLOAD = Payload(mass=0.8)
#: Duration of the cross-fade to the rendered wrench of a new station [s].
CROSS_FADE_S = 0.25
# Smallest rotational impedance if the scenario does not use `wave` [N m s/rad]. The friction of a
# ball on a leaf is 1.5 N m about the sensor; with the default 0.05 the tool topples at 0.2 s.
_MIN_ROTATIONAL_WAVE_IMPEDANCE_NMS_RAD = 0.5
_DELAY_INPUT_UNIT_S, _JITTER_INPUT_UNIT, _LOSS_INPUT_UNIT = 1e-4, 1e-2, 1e-3

#: Shipped scenario of each scene; "own" is the scenario of the user.
_SHIPPED_SCENES = {"leaf": "touch", "slot": "peg_in_slot", "wall": "touch", "block": "push_block"}
SCENE_NAMES = ("own", *_SHIPPED_SCENES)


def live_scenario(scenario: Scenario) -> Scenario:
    """Return the scenario without scripted motion, settling and end by faults, for a live hand."""
    return replace(
        scenario,
        operator__intent=[],
        operator__task=None,
        simulation__settle=0.0,
        simulation__end_with_task=False,
        simulation__on_fault="continue",
        simulation__integrator="runge_kutta3",
    )


def with_task_space_device(scenario: Scenario) -> Scenario:
    """Return the scenario, with a Haply Inverse3 in place of a master that is a serial arm."""
    if scenario.master.model not in (PHANTOM_NAME, LEADER_NAME):
        return scenario
    return replace(scenario, master=Master(model="haply_inverse3"))


def scenario_of_scene(name: str, user_scenario: Scenario) -> Scenario:
    """Return the scenario of a scene in `SCENE_NAMES`; "own" is `user_scenario`."""
    if name == "own":
        return user_scenario
    scenario = LoadScenario(_SHIPPED_SCENES[name])
    if name == "wall":
        wall = Wall(position=[0.55, 0.0, 0.17], stiffness=1e4)
        changes = {"sheet_spring": None, "environment": [wall], "description": "a wall to press on"}
        scenario = replace(scenario, **changes)
    return live_scenario(scenario)


def scenario_of_inputs(scenario: Scenario, load: IdentifiedLoad | None, inputs: Inputs) -> Scenario:
    """Return the scenario with the driver's choices (network, grip ...) in `inputs`.

    Contact detection is off if `load` has no noise floor or the inputs replace the sensor.
    """
    method = tuple(METHODS)[inputs.method]
    changes: dict[str, object] = {"passivity__method": method}
    changes["operator__grip"] = list(GRIP_IMPEDANCES)[inputs.grip]
    if method == "wave" != scenario.passivity.method:
        along, turning = (wave := scenario.passivity.wave).impedance
        impedance = [along, max(turning, _MIN_ROTATIONAL_WAVE_IMPEDANCE_NMS_RAD)]
        changes["passivity__wave"] = dataclasses.replace(wave, impedance=impedance)
    name = NETWORK_NAMES[inputs.network]
    if name == "custom":
        delay, jitter = _DELAY_INPUT_UNIT_S * inputs.delay, _JITTER_INPUT_UNIT * inputs.jitter
        loss = _LOSS_INPUT_UNIT * inputs.loss
        changes["channel"] = Channel(delay=delay, jitter=jitter, distribution="gamma", loss=loss)
    elif name != UNCHANGED_CHOICE:
        changes["channel"] = Channel(network=name)
    if inputs.sensor:
        changes["wrist_sensor"] = SENSOR_PRESETS[SENSOR_NAMES[inputs.sensor]]
    has_noise_floor = load is not None and load.noise_floor is not None and inputs.sensor == 0
    if not (inputs.detection and has_noise_floor):
        changes["contact_detection"] = None
    elif scenario.contact_detection is None:
        changes["contact_detection"] = ContactDetectionConfig()
    has_payload = scenario.slave.payload.mass > 0.0
    if inputs.object != has_payload:
        mass = DEFAULT_GRIPPED_PAYLOAD.mass if inputs.object else 0.0
        changes["slave__payload"] = dataclasses.replace(DEFAULT_GRIPPED_PAYLOAD, mass=mass)
    changed = replace(scenario, **changes)
    if inputs.object and load is not None and scenario.force_scaling.gripper_phi is None:
        gripper = load.identification.phi - has_payload * _inertial_parameters_of_payload(changed)
        changed = replace(changed, force_scaling__gripper_phi=gripper.tolist())
    return changed


def _inertial_parameters_of_payload(scenario: Scenario) -> Array:
    payload = NominalSlave(scenario.slave).arm.phi_load
    empty = replace(scenario, slave__payload=Payload(mass=0.0))
    return payload - NominalSlave(empty.slave).arm.phi_load


def adapt_load_estimate(old: Scenario, load: IdentifiedLoad | None, new: Scenario) -> Array | None:
    """Return [offsets; phi] (16,) of `load`, adapted from scenario `old` to the load of `new`."""
    if load is None:
        return None
    estimate = load.estimate.copy()
    estimate[:6] += _sensor_wrench_offset(new) - _sensor_wrench_offset(old)
    arms = (NominalSlave(scenario.slave).arm for scenario in (new, old))
    estimate[6:] += np.subtract(*(arm.phi_load for arm in arms))
    return estimate


def _sensor_wrench_offset(scenario: Scenario) -> Array:
    sensor = scenario.wrist_sensor
    return np.zeros(6) if sensor.ideal else np.array(sensor.offset)


def channel_fill_time_s(scenario: Scenario) -> float:
    """Return the longest round trip plus the time until transmission resumes [s]."""
    if scenario.has_no_network_or_passivity:
        return 0.0
    return RESUME_TIME_S + sum(map(longest_delay, scenario.channel.networks_of_directions()))
