"""The identification of section IV: the slave runs an excitation trajectory, the estimator learns.

Nothing of the plant's truth is used: what is known comes from the wrist sensor's samples.
"""

from __future__ import annotations

import dataclasses
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Diagram, DiagramBuilder

from drake_teleop.experiments.progress import Progress, Stage, silent
from drake_teleop.load.excitation import FourierTrajectory, condition_numbers, design_excitation
from drake_teleop.load.identification import Identification, identify
from drake_teleop.result import SimulationResult
from drake_teleop.scenario import LoadScenario, Scenario, Simulation, replace
from drake_teleop.simulation import simulate
from drake_teleop.slave.arm import ArmModel
from drake_teleop.slave.excitation import excitation_limits, sensor_motion_of
from drake_teleop.slave.plant import AddSlavePlant, home_position
from drake_teleop.station import MakeIdentificationStation

Array = NDArray[np.float64]

# The trajectory belongs to the arm, not to the run's seed.
_DESIGN_SEED = 0


@dataclass(frozen=True, eq=False)
class LoadIdentification:
    """What an identification run gives.

    Attributes:
        trajectory: the joint trajectory that was run.
        result: the recorded signals.
        estimate: (16,) Eq. (7), [offsets; phi] of the recursive estimator in the loop at the end.
        batch: the same record by batch least squares.
        kappa_w10: condition number of the motion, see `condition_numbers`.
        real_time_factor: of the simulation.
    """

    trajectory: FourierTrajectory
    result: SimulationResult
    estimate: Array
    batch: Identification
    kappa_w10: float
    real_time_factor: float

    @property
    def identification(self) -> Identification:
        """The recursive estimate, with the batch's uncertainties and residuals.

        Both estimators minimise the same sum; the batch judges its uncertainty from the residuals.
        """
        return dataclasses.replace(
            self.batch,
            offsets=self.estimate[:6],
            phi=self.estimate[6:],
            method="recursive least squares",
        )

    @property
    def recursive_against_batch(self) -> float:
        """Largest difference of the two estimates, in standard deviations."""
        batch = np.concatenate([self.batch.offsets, self.batch.phi])
        return float(np.max(np.abs(self.estimate - batch) / self.batch.standard_deviations))


def slave_arm(scenario: Scenario) -> ArmModel:
    """The arm of a scenario's slave, with the tool as its load."""
    return AddSlavePlant(DiagramBuilder(), scenario.slave.position, None).arm


def identification_scenario(scenario: Scenario, seed: int) -> Scenario:
    """The shipped scenario "identification" with the slave and the sensor of another scenario."""
    return replace(
        LoadScenario("identification"),
        simulation__seed=seed,
        rates=scenario.rates,
        slave=scenario.slave,
        joint_control=scenario.joint_control,
        wrist_sensor=scenario.wrist_sensor,
    )


def identify_load(scenario: Scenario, stage: Stage = silent) -> LoadIdentification:
    """Designs an excitation trajectory of the scenario's duration, runs it, and identifies.

    Args:
        scenario: with the load estimator enabled.
        stage: where progress is shown.

    Raises:
        DrakeTeleopError: if no trajectory respects the limits of arm and sensor.
    """
    arm = slave_arm(scenario)
    motion = sensor_motion_of(arm)
    designed = stage("Design the excitation trajectory")
    trajectory = design_excitation(
        motion,
        excitation_limits(arm),
        home=home_position(arm, scenario.slave.position),
        seed=_DESIGN_SEED,
        period=scenario.simulation.duration,
    )
    samples = motion(*trajectory.evaluate(np.arange(0.0, trajectory.period, 1e-3)))
    designed(1.0)
    station = MakeIdentificationStation(scenario, trajectory)
    result, factor = timed(station, scenario.simulation, stage("Identify the load"))
    usable = result["saturated"][:, 0] == 0
    batch = identify(
        *(signal[usable] for signal in sensor_samples(result)),
        noise=scenario.wrist_sensor.noise_std()[:6],
    )
    kappa = condition_numbers(*samples[:3]).kappa_w10
    estimate = result["load_estimate"][-1]
    return LoadIdentification(trajectory, result, estimate, batch, kappa, factor)


def timed(
    station: Diagram, simulation: Simulation, progress: Progress
) -> tuple[SimulationResult, float]:
    """`simulate`, and its real-time factor: simulated over elapsed time, compilation included."""
    start = time.perf_counter()
    result = simulate(station, simulation, progress=progress)
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
