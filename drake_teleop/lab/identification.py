"""Load identification in simulation (paper, section IV)."""

from __future__ import annotations

import copy
import dataclasses
import time
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np
from pydrake.systems.framework import Diagram

from drake_teleop.common.errors import DrakeTeleopError, expect_type
from drake_teleop.common.numeric import Array, check_load_not_all_zero, one_blas_thread
from drake_teleop.common.progress import StartStage, UpdateProgress, show_progress
from drake_teleop.lab.excitation.check import check_trajectory
from drake_teleop.lab.excitation.excite import criterion_values, excite
from drake_teleop.lab.excitation.robot import Robot, RobotFromScenario
from drake_teleop.load.batch.methods import identify_batch
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.contact.detection import fit_noise_floor
from drake_teleop.load.contact.noise_floor import NoiseFloor, limit_covariance_to_scales
from drake_teleop.load.identification import Identification
from drake_teleop.load.normal_equations import NoiseStd
from drake_teleop.load.online.recursive_tls import METHODS
from drake_teleop.load.trajectory import FourierTrajectory
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import (
    LoadScenario,
    Scenario,
    Simulation,
    check_scenario,
    replace,
)
from drake_teleop.station.sensor.motion_estimation import estimated_motion_std
from drake_teleop.station.simulation import simulate
from drake_teleop.station.slave.arm import ArmModel, accelerations_from_specific_forces
from drake_teleop.station.slave.plant import NominalSlave
from drake_teleop.station.station import MakeIdentificationStation

#: Designed trajectory and its criterion kappa_w10, by a hash of all inputs of the design.
_EXCITATION_BY_INPUT_HASH: dict[str, tuple[FourierTrajectory, float]] = {}


@dataclass(frozen=True, eq=False, repr=False)
class LoadIdentification:
    """Result of a simulated load identification.

    Attributes:
        estimate: (16,) final recursive estimate of Eq. (7): sensor offsets [N, N m], then phi.
        batch: estimate by total least squares from all samples at once.
        kappa_w10: condition number, see `excitation.criteria`.
        real_time_factor: simulated time over elapsed time.
    """

    trajectory: FourierTrajectory
    result: SimulationResult
    estimate: Array
    batch: Identification
    kappa_w10: float
    real_time_factor: float
    method: str

    def __repr__(self) -> str:
        return repr(self.identification)

    @property
    def identification(self) -> Identification:
        """Recursive estimate, with the uncertainties and residuals of `batch`."""
        return dataclasses.replace(
            self.batch, offsets=self.estimate[:6], phi=self.estimate[6:], method=self.method
        )

    def noise_floor(self, arm: ArmModel) -> NoiseFloor:
        """Return the noise floor of the contact wrench in this motion."""
        usable = self.result["saturated"][:, 0] == 0
        wrench, s, omega, alpha = (x[usable] for x in sensor_samples(self.result))
        offsets, phi = self.estimate[:6], self.estimate[6:]
        contact = contact_wrench(wrench, offsets, s, omega, alpha, phi)
        a = accelerations_from_specific_forces(arm, self.result["joint_position"][usable], s)
        P = limit_covariance_to_scales(phi, self.batch.covariance)
        return fit_noise_floor(contact, s, omega, alpha, a, P)

    @property
    def max_recursive_minus_batch_in_stds(self) -> float:
        """Largest difference of recursive and batch estimate, in standard deviations."""
        batch = np.concatenate([self.batch.offsets, self.batch.phi])
        return float(np.max(np.abs(self.estimate - batch) / self.batch.standard_deviations))


def slave_arm(scenario: Scenario) -> ArmModel:
    """Return the model of the slave's arm with tool and payload as its load."""
    check_scenario(scenario)
    return NominalSlave(scenario.slave).arm


def true_load(scenario: Scenario) -> Array:
    """Return (16,) zero sensor offsets, then the true parameters phi of tool and payload."""
    return np.concatenate([np.zeros(6), slave_arm(scenario).phi_load])


def identification_scenario(scenario: Scenario, seed: int) -> Scenario:
    """Return the shipped scenario "identification" with slave and sensor of `scenario`."""
    check_scenario(scenario)
    rates = scenario.rates
    if scenario.contact_detection is not None:
        rates = dataclasses.replace(rates, log_hz=rates.estimator_hz)
    return replace(
        LoadScenario("identification"),
        simulation__seed=seed,
        rates=rates,
        slave=scenario.slave,
        joint_control=scenario.joint_control,
        wrist_sensor=scenario.wrist_sensor,
        motion_estimation=scenario.motion_estimation,
    )


def identify_load(
    scenario: Scenario,
    progress: bool | StartStage = True,
    *,
    trajectory: FourierTrajectory | None = None,
    log: Path | None = None,
) -> LoadIdentification:
    """Simulate an excitation trajectory and identify the load.

    Args:
        progress: True for progress bars, or a `StartStage`.
        log: as in `simulate`.
        trajectory: excitation of the scenario's duration; None: this process designs one, once.

    Raises:
        DrakeTeleopError: if the load estimator is off, or if `trajectory` violates a limit or has
            another duration.
    """
    check_scenario(scenario)
    if not scenario.load_estimator.enabled:
        what = "the load estimator is off, so it cannot identify the load"
        remedy = "call identified_load(scenario) of drake_teleop.lab.identified_load"
        remedy += ', or pass LoadScenario("identification")'
        raise DrakeTeleopError(what, where="scenario:load_estimator.enabled", remedy=remedy)
    if trajectory is not None:
        expect_type(FourierTrajectory, trajectory, "trajectory")
    simulation = scenario.simulation
    with show_progress(progress) as stage:
        if trajectory is None:
            trajectory, kappa = _get_motion_and_kappa(scenario, stage)
        else:
            robot = RobotFromScenario(scenario)
            _check_given_trajectory(robot, trajectory, simulation.duration)
            kappa = criterion_values(robot, trajectory)["kappa_w10"]
        station = MakeIdentificationStation(scenario, trajectory)
        update = stage("Identify the load")
        result, factor = simulate_with_real_time_factor(station, simulation, update, log)
    usable = result["saturated"][:, 0] == 0
    wrench, s, omega, alpha = (signal[usable] for signal in sensor_samples(result))
    with one_blas_thread():
        batch = identify_by_batch(scenario, wrench, s, omega, alpha, scenario.rates.log_hz)
    estimate = result["load_estimate"][-1]
    check_load_not_all_zero("load_estimate", estimate[6:])
    method = METHODS[scenario.load_estimator.method].method
    return LoadIdentification(trajectory, result, estimate, batch, kappa, factor, method)


def identify_by_batch(
    scenario: Scenario, wrench: Array, s: Array, omega: Array, alpha: Array, rate_hz: float
) -> Identification:
    """Identify load and sensor offsets by total least squares from N samples in S."""
    sensor, rates = scenario.wrist_sensor, scenario.rates
    motion = estimated_motion_std(
        scenario.motion_estimation, sensor, slave_arm(scenario).num_joints, 1 / rates.sensor_hz
    )
    walk = sensor.random_walk()
    if scenario.motion_estimation.source != "accelerometer":  # encoders have no random walk
        walk[6:] = 0.0
    noise = NoiseStd(
        wrench=sensor.wrench_std(),
        s=motion[:3],
        omega=motion[3:6],
        alpha=motion[6:],
        walk=walk / np.sqrt(rate_hz),
    )
    return identify_batch(wrench, s, omega, alpha, method="total", noise=noise).identification


def _get_motion_and_kappa(scenario: Scenario, stage: StartStage) -> tuple[FourierTrajectory, float]:
    design_inputs = replace(scenario, simulation__seed=0, rates__log_hz=1.0)
    models = [path.read_bytes() for path in scenario.slave.model_files()]
    key = sha256(repr((dataclasses.asdict(design_inputs), models)).encode()).hexdigest()
    # The environment's files may change.
    if key not in _EXCITATION_BY_INPUT_HASH or scenario.environment:
        robot, period = RobotFromScenario(scenario), scenario.simulation.duration
        found = excite(robot, period=period, progress=stage).trajectory
        _EXCITATION_BY_INPUT_HASH[key] = found, criterion_values(robot, found)["kappa_w10"]
    return copy.deepcopy(_EXCITATION_BY_INPUT_HASH[key])


def _check_given_trajectory(robot: Robot, trajectory: FourierTrajectory, duration: float) -> None:
    if len(trajectory.q0) != robot.arm.num_joints:
        what = f"has {len(trajectory.q0)} joints, but the arm has {robot.arm.num_joints}"
        raise DrakeTeleopError(what, where="trajectory", remedy="run excite for this arm")
    if not np.isclose(trajectory.period, duration, rtol=1e-9):
        what = f"has a period of {trajectory.period:g} s, but the simulation lasts {duration:g} s"
        remedy = "set simulation.duration to the period"
        raise DrakeTeleopError(what, where="trajectory", remedy=remedy)
    worst = check_trajectory(robot, trajectory)[0]
    if worst.used_share > 1:
        what, remedy = f"uses {worst} (at most 100 %)", "compute a trajectory for these limits"
        raise DrakeTeleopError(what, where="trajectory", remedy=remedy)


def simulate_with_real_time_factor(
    station: Diagram, simulation: Simulation, progress: UpdateProgress, log: Path | None = None
) -> tuple[SimulationResult, float]:
    start = time.perf_counter()
    result = simulate(station, simulation, progress=progress, log=log)
    elapsed = time.perf_counter() - start
    return result, (simulation.settle + simulation.duration) / elapsed


def sensor_samples(result: SimulationResult) -> tuple[Array, Array, Array, Array]:
    """Return wrench (N, 6), specific force, angular velocity and acceleration (N, 3), all in S."""
    signals = ("measured_wrench", "specific_force", "angular_velocity", "angular_acceleration")
    wrench, s, omega, alpha = (result[f"{name}_S"] for name in signals)
    return wrench, s, omega, alpha
