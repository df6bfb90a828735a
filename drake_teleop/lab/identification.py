"""The identification of section IV: the slave runs an excitation trajectory, the estimator learns.

Nothing of the plant's truth is used: what is known comes from the wrist sensor's samples.
"""

from __future__ import annotations

import copy
import dataclasses
import time
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Diagram

from drake_teleop.common.arrays import learnt
from drake_teleop.common.errors import DrakeTeleopError, expect
from drake_teleop.common.one_thread import one_blas_thread
from drake_teleop.common.progress import Progress, Stage, show_progress
from drake_teleop.lab.excitation.check import check
from drake_teleop.lab.excitation.excite import criteria_of, excite
from drake_teleop.lab.excitation.robot import Robot, RobotFromScenario
from drake_teleop.load.batch.methods import identify_batch
from drake_teleop.load.batch.moments import Noise
from drake_teleop.load.compensation import contact_wrench
from drake_teleop.load.contact.noise_floor import NoiseFloor, finite_covariance
from drake_teleop.load.contact.noise_floor_fit import fit_noise_floor
from drake_teleop.load.identification import Identification
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
from drake_teleop.station.slave.arm import ArmModel, accelerations
from drake_teleop.station.slave.plant import NominalSlave
from drake_teleop.station.station import MakeIdentificationStation

Array = NDArray[np.float64]

# The trajectory belongs to the arm, not to the run's seed.
_DESIGN_SEED = 0
#: By all that a design depends on: the trajectory and its kappa; half of the time of a first run.
_DESIGNS: dict[str, tuple[FourierTrajectory, float]] = {}


@dataclass(frozen=True, eq=False, repr=False)
class LoadIdentification:
    """What an identification run gives.

    Attributes:
        trajectory: the joint trajectory that was run.
        result: the recorded signals.
        estimate: (16,) Eq. (7), [offsets; phi] of the recursive estimator in the loop at the end.
        batch: the same record by batch total least squares, see `batch_identification`.
        kappa_w10: condition number of the motion, see `excitation/criteria.py`.
        real_time_factor: of the simulation.
        method: of the recursive estimator, one of `load.identification.METHODS`.
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
        """The recursive estimate, with the batch's uncertainties and residuals.

        The batch judges its uncertainty from the residuals, the recursive estimator from what the
        noise is said to be.
        """
        return dataclasses.replace(
            self.batch, offsets=self.estimate[:6], phi=self.estimate[6:], method=self.method
        )

    def noise_floor(self, arm: ArmModel) -> NoiseFloor:
        """How large the wrench is that the estimate leaves in this free motion, for detection.

        Args:
            arm: the slave's, for its kinematics.
        """
        usable = self.result["saturated"][:, 0] == 0
        wrench, s, omega, alpha = (x[usable] for x in sensor_samples(self.result))
        offsets, phi = self.estimate[:6], self.estimate[6:]
        contact = contact_wrench(wrench, offsets, s, omega, alpha, phi)
        a = accelerations(arm, self.result["joint_position"][usable], s)
        P = finite_covariance(phi, self.batch.covariance)
        return fit_noise_floor(contact, s, omega, alpha, a, P)

    @property
    def recursive_against_batch(self) -> float:
        """Largest difference of the two estimates, in standard deviations."""
        batch = np.concatenate([self.batch.offsets, self.batch.phi])
        return float(np.max(np.abs(self.estimate - batch) / self.batch.standard_deviations))


def slave_arm(scenario: Scenario) -> ArmModel:
    """The arm of a scenario's slave, with tool and payload as its load."""
    check_scenario(scenario)
    return NominalSlave(scenario.slave).arm


def true_load(scenario: Scenario) -> Array:
    """(16,) Eq. (7) as the simulation has it, for comparisons: no offsets; tool and payload."""
    return np.concatenate([np.zeros(6), slave_arm(scenario).phi_load])


def identification_scenario(scenario: Scenario, seed: int) -> Scenario:
    """The shipped scenario "identification" with the slave and the sensor of another scenario.

    If contact is to be detected, it is logged at the rate at which that is done: the noise floor
    tells how alike samples are that follow each other.
    """
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
    progress: bool | Stage = True,
    *,
    trajectory: FourierTrajectory | None = None,
    log: Path | None = None,
) -> LoadIdentification:
    """Runs an excitation trajectory, and identifies.

    Args:
        scenario: whose load estimator learns: the shipped "identification", or that with the slave
            and the sensor of another one (`identification_scenario`).
        progress: whether bars are shown, or where: see `pages/progress.py`.
        trajectory: to run, of the scenario's duration; if there is none, one is designed, once in
            each process for all seeds.
        log: as `simulate` has it.

    Raises:
        DrakeTeleopError: if the load estimator does not learn, no trajectory respects the limits
            of arm and sensor, or the one that was given does not, or has another duration.
    """
    check_scenario(scenario)
    if not scenario.load_estimator.enabled:
        raise DrakeTeleopError(
            "the load estimator is off, so the load would not be learnt",
            where="scenario:load_estimator.enabled",
            remedy="call identified_load(scenario) of drake_teleop.lab.identified_load, or pass "
            'LoadScenario("identification")',
        )
    if trajectory is not None:
        expect(FourierTrajectory, trajectory, "trajectory")
    simulation = scenario.simulation
    with show_progress(progress) as stage:
        if trajectory is None:
            trajectory, kappa = _designed(scenario, stage)
        else:
            robot = RobotFromScenario(scenario)
            _check_given(robot, trajectory, simulation.duration)
            kappa = criteria_of(robot, trajectory)["kappa_w10"]
        station = MakeIdentificationStation(scenario, trajectory)
        result, factor = timed(station, simulation, stage("Identify the load"), log)
    usable = result["saturated"][:, 0] == 0
    wrench, s, omega, alpha = (signal[usable] for signal in sensor_samples(result))
    with one_blas_thread():
        batch = batch_identification(scenario, wrench, s, omega, alpha, scenario.rates.log_hz)
    estimate = result["load_estimate"][-1]
    learnt("load_estimate", estimate[6:])
    method = METHODS[scenario.load_estimator.method].method
    return LoadIdentification(trajectory, result, estimate, batch, kappa, factor, method)


def batch_identification(
    scenario: Scenario, wrench: Array, s: Array, omega: Array, alpha: Array, rate_hz: float
) -> Identification:
    """The load and the offsets by total least squares, with the noise of the scenario's sensor.

    White noise of wrench and motion as its data sheet has it, and its random walks: the offsets are
    those at the start of the record.

    Args:
        scenario: with the sensor and the estimation of its motion.
        wrench, s, omega, alpha: (N, 6), (N, 3) samples, as for `identify`.
        rate_hz: of these samples.
    """
    sensor, rates = scenario.wrist_sensor, scenario.rates
    motion = estimated_motion_std(
        scenario.motion_estimation, sensor, slave_arm(scenario).num_joints, 1 / rates.sensor_hz
    )
    walk = sensor.random_walk()
    if scenario.motion_estimation.source != "accelerometer":  # the encoders do not wander
        walk[6:] = 0.0
    noise = Noise(
        wrench=sensor.wrench_std(),
        s=motion[:3],
        omega=motion[3:6],
        alpha=motion[6:],
        walk=walk / np.sqrt(rate_hz),
    )
    found = identify_batch(wrench, s, omega, alpha, method="total", noise=noise)
    return found.identification


def _designed(scenario: Scenario, stage: Stage) -> tuple[FourierTrajectory, float]:
    """The trajectory of a scenario and its kappa, a copy; designed once for all seeds.

    And for all rates of the log: where contact is detected, it has more rows.
    """
    same = replace(scenario, simulation__seed=0, rates__log_hz=1.0)
    models = [path.read_bytes() for path in scenario.slave.files()]
    key = sha256(repr((dataclasses.asdict(same), models)).encode()).hexdigest()
    if key not in _DESIGNS or scenario.environment:  # which may be in files, and they may change
        robot, period = RobotFromScenario(scenario), scenario.simulation.duration
        found = excite(robot, period=period, seed=_DESIGN_SEED, progress=stage).trajectory
        _DESIGNS[key] = found, criteria_of(robot, found)["kappa_w10"]
    return copy.deepcopy(_DESIGNS[key])


def _check_given(robot: Robot, trajectory: FourierTrajectory, duration: float) -> None:
    if len(trajectory.q0) != robot.arm.num_joints:
        raise DrakeTeleopError(
            f"it moves {len(trajectory.q0)} joints, the arm has {robot.arm.num_joints}",
            where="trajectory",
        )
    if not np.isclose(trajectory.period, duration, rtol=1e-9):
        raise DrakeTeleopError(
            f"its period is {trajectory.period:g} s, the simulation lasts {duration:g} s",
            where="trajectory",
            remedy="set simulation.duration to the period",
        )
    worst = check(robot, trajectory)[0]
    if worst.share > 1:
        raise DrakeTeleopError(f"it uses {worst}", where="trajectory")


def timed(
    station: Diagram, simulation: Simulation, progress: Progress, log: Path | None = None
) -> tuple[SimulationResult, float]:
    """`simulate`, and its real-time factor: simulated over elapsed time, compilation included."""
    start = time.perf_counter()
    result = simulate(station, simulation, progress=progress, log=log)
    elapsed = time.perf_counter() - start
    return result, (simulation.settle + simulation.duration) / elapsed


def sensor_samples(result: SimulationResult) -> tuple[Array, Array, Array, Array]:
    """What the wrist sensor gave: wrench (N, 6), s, omega, alpha (N, 3) in S."""
    return (
        result["measured_wrench_S"],
        result["specific_force_S"],
        result["angular_velocity_S"],
        result["angular_acceleration_S"],
    )
