"""Arm with surroundings and limits, for which trajectories are designed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, ModelInstanceIndex

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.lab.excitation.collision import MIN_CLEARANCE_M, CollisionScene
from drake_teleop.lab.excitation.criteria import CriterionScales, limited_gyration_radius
from drake_teleop.lab.excitation.limits import Limits, finite_half_ranges
from drake_teleop.lab.excitation.prediction import SensorNoise, sensor_noise
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.station.scenario import Scenario, check_scenario
from drake_teleop.station.sensor.motion_estimation import MotionEstimationConfig
from drake_teleop.station.sensor.sensor_chain import WristSensorConfig
from drake_teleop.station.slave.arm import ArmModel
from drake_teleop.station.slave.arm_from_plant import check_arm_lengths, fill_missing_joint_limits
from drake_teleop.station.slave.models import ParseModel, translate_drake_errors
from drake_teleop.station.slave.plant import (
    NominalSlave,
    ParseSlave,
    read_arm_without_default_limits,
)
from drake_teleop.station.slave.surroundings import AddEnvironment

_NUM_COLLISION_TEST_POSTURES = 1000  # random
# Usable share of joint limits; the rest is for tracking errors and feedback.
_USABLE_JOINT_LIMIT_SHARE = 0.8
# Usable share of the sensor's weakest axis; a grasped object is farther out than the tool.
_USABLE_SENSOR_FORCE_SHARE, _USABLE_SENSOR_TORQUE_SHARE = 0.9, 10.0 / 12.0
# Heaviest expected load over the modelled one (a grasped object of 0.8 kg).
_HEAVIEST_TO_MODELLED_LOAD_RATIO = 1.3
# Payload of unknown shape: centre of mass along z_S, radius of gyration [m].
_ASSUMED_PAYLOAD_COM_ALONG_Z_S_M, _ASSUMED_PAYLOAD_GYRATION_RADIUS_M = 0.08, 0.05
_DEFAULT_PAYLOAD_KG = 2.0
_MIN_PAYLOAD_KG, _MAX_PAYLOAD_KG = 1e-3, 1e4

# The station's wrist centre and ball tip, and their box in front of the arm and above the table.
_TOOL_POINTS_IN_WORKSPACE_S = ((0.0, 0.0, -0.085), (0.0, 0.0, 0.2))
_WORKSPACE_BOX_CORNERS_W = ((0.25, -0.7, 0.1), (1.05, 0.7, 1.3))
_SENSOR_ORIGIN_S, _UNLIMITED_BOX = np.zeros((1, 3)), (np.zeros(3), np.full(3, np.inf))


@dataclass(frozen=True, eq=False)
class Robot:
    """Arm with surroundings, limits and sensor noise.

    Attributes:
        scene: Drake's plant, with the heaviest load.
        home_posture: (n,) start posture of the search [rad].
        assumptions: sentences on values that the model lacks.
    """

    name: str
    scene: CollisionScene
    arm: ArmModel
    limits: Limits
    criterion_scales: CriterionScales
    sensor_noise: SensorNoise
    home_posture: Array
    assumptions: tuple[str, ...]


def RobotFromScenario(scenario: Scenario) -> Robot:
    """Return the scenario's slave as `Robot`, with surroundings and a table at z = 0."""
    check_scenario(scenario)

    def parse_slave_and_surroundings(plant: MultibodyPlant) -> tuple[ModelInstanceIndex, Frame]:
        parsed = ParseSlave(plant, scenario.slave)
        if scenario.surroundings is not None:
            AddEnvironment(plant, scenario.surroundings)
        return parsed.instance, parsed.sensor_frame

    slave = NominalSlave(scenario.slave)
    own = scenario.slave.model != ""
    reserve = (_HEAVIEST_TO_MODELLED_LOAD_RATIO - 1) * slave.arm.phi_load
    scene = CollisionScene(parse_slave_and_surroundings, reserve, visuals_collide=not own)
    scene.arm, _ = fill_missing_joint_limits(scene.arm, str(scenario.slave.path))
    lower, upper = np.array(_WORKSPACE_BOX_CORNERS_W)
    sensor, period = scenario.wrist_sensor, 1 / scenario.rates.sensor_hz
    return _make_robot(
        scene,
        "the station's slave",
        sensor,
        sensor_noise(sensor, scenario.motion_estimation, scene.arm.num_joints, period),
        ["a table at z = 0", *slave.assumptions],
        start=slave.start,
        points_S=np.array([np.zeros(3), slave.tip] if own else _TOOL_POINTS_IN_WORKSPACE_S),
        box=_UNLIMITED_BOX if own else ((upper + lower) / 2, (upper - lower) / 2),
    )


def RobotFromModel(
    path: Path,
    sensor_frame: str,
    sensor: WristSensorConfig,
    *,
    estimation: MotionEstimationConfig | None = None,
    sensor_hz: float = 8000.0,
    package_paths: tuple[Path, ...] = (),
    acceleration: tuple[float, ...] = (),
    payload: float | None = None,
) -> Robot:
    """Return a serial arm from a model file; weld free bases, lock joints beyond the sensor.

    `acceleration` limits [rad/s^2] replace the model's; `payload` [kg]: mass beyond the sensor.
    """
    missing: list[str] = []

    def parse_model_file(plant: MultibodyPlant) -> tuple[ModelInstanceIndex, Frame]:
        model = ParseModel(plant, path, sensor_frame, package_paths)
        missing[:] = model.assumptions
        return model.instance, model.sensor_frame

    assumptions = ["a table at z = 0"]
    arm = read_arm_without_default_limits(path, sensor_frame, package_paths)
    check_arm_lengths(arm, str(path))
    load = arm.phi_load
    if payload is None and load[0] > 0:
        reserve = (_HEAVIEST_TO_MODELLED_LOAD_RATIO - 1) * load
    else:
        mass = _DEFAULT_PAYLOAD_KG if payload is None else payload
        if not _MIN_PAYLOAD_KG <= mass <= _MAX_PAYLOAD_KG:
            what = f"{mass:g} kg is outside {_MIN_PAYLOAD_KG:g} to {_MAX_PAYLOAD_KG:g} kg"
            remedy = "give the mass beyond the sensor in kg"
            raise DrakeTeleopError(what, where="--payload", remedy=remedy)
        if payload is None:
            assumptions.append(f"the load has {mass:g} kg (--payload sets it)")
        if mass <= load[0]:
            what = f"is {mass:g} kg, but the model contains {load[0]:.3g} kg beyond the sensor"
            remedy = "give the total mass beyond the sensor, or remove the option"
            raise DrakeTeleopError(what, where="--payload", remedy=remedy)
        missing_mass, com = mass - load[0], np.array([0.0, 0.0, _ASSUMED_PAYLOAD_COM_ALONG_Z_S_M])
        inertia = missing_mass * _ASSUMED_PAYLOAD_GYRATION_RADIUS_M**2 * np.eye(3) * 2 / 3
        reserve = phi_from_mass_com_inertia(missing_mass, com, inertia)
    with translate_drake_errors(path):
        scene = CollisionScene(parse_model_file, reserve, visuals_collide=False, where=str(path))
    assumptions += missing
    hint = " (--acceleration)"
    scene.arm, completed = fill_missing_joint_limits(scene.arm, str(path), acceleration, hint=hint)
    estimation = estimation or MotionEstimationConfig()
    noise = sensor_noise(sensor, estimation, scene.arm.num_joints, 1 / sensor_hz)
    return _make_robot(scene, path.name, sensor, noise, assumptions + completed)


def _make_robot(
    scene: CollisionScene,
    name: str,
    sensor: WristSensorConfig,
    noise: SensorNoise,
    assumptions: list[str],
    start: Array | None = None,
    points_S: Array = _SENSOR_ORIGIN_S,
    box: tuple[Array, Array] = _UNLIMITED_BOX,
) -> Robot:
    arm = scene.arm
    middle, half = arm.middle_positions, (arm.upper - arm.lower) / 2
    random = np.random.default_rng(0).uniform(-1, 1, (_NUM_COLLISION_TEST_POSTURES, len(half)))
    postures = middle + finite_half_ranges(half) * random
    candidates, touching = scene.find_collision_candidates_and_touching(postures, start)
    if touching:
        names = ", ".join(touching)
        assumptions.append(f"no clearance required, as these bodies touch at the start: {names}")
    phi, std = arm.phi_load, sensor.wrench_std()
    wrench_noise = float(std[0]), float(std[3])
    force = _USABLE_SENSOR_FORCE_SHARE * min(sensor.force_range)
    torque = _USABLE_SENSOR_TORQUE_SHARE * min(sensor.torque_range)
    alpha = sensor.angular_acceleration_range
    limits = Limits(
        q_middle=middle,
        q_half=_USABLE_JOINT_LIMIT_SHARE * half,
        velocity=_USABLE_JOINT_LIMIT_SHARE * arm.velocity_limit,
        acceleration=arm.acceleration_limit,
        max_torques=_USABLE_JOINT_LIMIT_SHARE * arm.effort_limit,
        heaviest_phi=phi,
        max_sensor_norms=np.array([force, torque, sensor.acceleration_range, alpha]),
        points_S=points_S,
        box_middle=box[0],
        box_half=box[1],
        clearance=MIN_CLEARANCE_M,
        **scene.bounding_capsules_and_pairs(candidates, postures),
    )
    return Robot(
        name=name,
        scene=scene,
        arm=arm,
        limits=limits,
        criterion_scales=CriterionScales(wrench_noise, limited_gyration_radius(phi), phi),
        sensor_noise=noise,
        home_posture=middle if start is None else start,
        assumptions=tuple(assumptions),
    )
