"""The paper's experiments: free movements (Figs. 6, 7), contact (Fig. 8)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.numeric import Array
from drake_teleop.common.progress import StartStage, UpdateProgress
from drake_teleop.lab.identification import LoadIdentification, sensor_samples, slave_arm
from drake_teleop.lab.run import FILTER_TAIL_S, is_in_contact
from drake_teleop.load.compensation import contact_wrench, scaled_wrench
from drake_teleop.load.regressor import regressor
from drake_teleop.station.operator.operator import Sine
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.simulation import (
    MakeSimulator,
    advance_without_garbage_collection,
    read_recorded_signals,
    simulate,
)
from drake_teleop.station.station import GetBlock, MakeTeleopStation

NamedValues = dict[str, Any]

SIGMAS = (1.0, 0.5, 0.0)
_CONTACT_THRESHOLD_OVER_FREE_PEAK = 1.5


@dataclass(frozen=True, eq=False)
class FreeMotionRun:
    """Recorded free movement.

    `scaled_wrenches`: sigma (share of the load's wrench) -> scaled wrench (N, 6) at the slave.
    """

    scenario: Scenario
    result: SimulationResult
    scaled_wrenches: dict[float, Array]


@dataclass(frozen=True, eq=False)
class IdealSensorRun:
    """Free movement with exact wrench and motion instead of sensor readings.

    Attributes:
        weld_reaction: (N, 6) reaction wrench of the tool's weld [N, N m], in S about So.
        sensor_motion: specific force, angular velocity and angular acceleration of S, (N, 3) each.
        phi: (10,) true load.
    """

    weld_reaction: Array
    sensor_motion: tuple[Array, Array, Array]
    phi: Array


@dataclass(frozen=True, eq=False)
class RunsWithAndWithoutContact:
    """Recorded contact transition, and the same movement without the sheet spring.

    Attributes:
        measured_wrench: (N, 6) measured wrench without offsets, F - F_o.
        calculated_wrench: (N, 6) calculated contact wrench.
        in_contact: (N,) True in true contact.
        threshold_N: force threshold of the contact detection [N].
    """

    scenario: Scenario
    contact_result: SimulationResult
    free_result: SimulationResult
    measured_wrench: Array
    calculated_wrench: Array
    measured_wrench_free: Array
    calculated_wrench_free: Array
    in_contact: NDArray[np.bool_]
    threshold_N: float


def simulate_free_motion(
    scenario: Scenario, estimate: Array, progress: UpdateProgress
) -> FreeMotionRun:
    """Simulate a free movement and calculate the scaled wrench for each sigma."""
    result = _run_station(scenario, estimate, progress)
    scaled = {sigma: _scaled_wrench_at_slave(result, estimate, sigma) for sigma in SIGMAS}
    return FreeMotionRun(scenario, result, scaled)


def simulate_contact(
    scenario: Scenario, estimate: Array, stage: StartStage
) -> RunsWithAndWithoutContact:
    """Simulate the contact transition with and without the sheet spring."""
    touched = _run_station(scenario, estimate, stage("Fig. 8: contact transition"))
    free_stage = stage("Fig. 8: the same without contact")
    free = _run_station(without_leaf_spring_with_next_seed(scenario), estimate, free_stage)
    calculated_free = _scaled_wrench_at_slave(free, estimate, 0.0)
    return RunsWithAndWithoutContact(
        scenario=scenario,
        contact_result=touched,
        free_result=free,
        measured_wrench=_scaled_wrench_at_slave(touched, estimate, 1.0),
        calculated_wrench=_scaled_wrench_at_slave(touched, estimate, 0.0),
        measured_wrench_free=_scaled_wrench_at_slave(free, estimate, 1.0),
        calculated_wrench_free=calculated_free,
        in_contact=is_in_contact(touched),
        threshold_N=_CONTACT_THRESHOLD_OVER_FREE_PEAK * float(_force_norms(calculated_free).max()),
    )


def simulate_ideal_motion(progress: UpdateProgress) -> IdealSensorRun:
    """Simulate a movement along and about all axes."""
    move, turn = [0.02] * 3, [0.3, 0.4, 0.5]
    motion = Sine(duration=5.0, ramp=0.4, frequency=2.0, translation=move, rotation=turn)
    scenario = LoadScenario("ideal_sensor")
    scenario = replace(scenario, operator__intent=[motion], simulation__duration=0.4)
    rate, simulation = scenario.rates.log_hz, scenario.simulation
    phi = slave_arm(scenario).phi_load
    ideal = replace(scenario, rates__sensor_hz=rate)
    station = MakeTeleopStation(ideal, load_estimate=np.concatenate([np.zeros(6), phi]))
    plant, simulator = GetBlock(station, "slave_plant"), MakeSimulator(station, simulation)
    context = plant.GetMyContextFromRoot(simulator.get_context())
    reactions = plant.get_reaction_forces_output_port()
    weld = plant.GetJointByName("sensor_weld")
    place = list(plant.GetJointIndices()).index(weld.index())
    wrenches = np.empty((round((simulation.settle + simulation.duration) * rate) + 1, 6))
    for k in range(len(wrenches)):
        # The same product as Drake's event times.
        advance_without_garbage_collection(simulator, k * (1 / rate))
        reaction = reactions.Eval(context)[place]
        wrenches[k] = *reaction.translational(), *reaction.rotational()
        if k % 256 == 0:
            progress(k / len(wrenches))
    progress(1.0)
    result = read_recorded_signals(simulator, simulation.settle)
    taken = np.rint((result["sample_time"][:, 0] + simulation.settle) * rate).astype(int)
    started = taken >= 0
    _, s, omega, alpha = (part[started] for part in sensor_samples(result))
    return IdealSensorRun(wrenches[taken[started]], (s, omega, alpha), phi)


def wrench_errors_of_ideal_run(run: IdealSensorRun) -> NamedValues:
    """Return peak wrenches and the errors of the calculated load wrench, by name."""
    load = regressor(*run.sensor_motion) @ run.phi
    left = contact_wrench(run.weld_reaction, np.zeros(6), *run.sensor_motion, run.phi)
    left = np.concatenate([left, run.weld_reaction - load])
    return {
        "peak_raw_N": _largest_norm(run.weld_reaction[:, :3]),
        "peak_raw_Nm": _largest_norm(run.weld_reaction[:, 3:]),
        "residual_max_N": _largest_norm(left[:, :3]),
        "residual_max_Nm": _largest_norm(left[:, 3:]),
    }


def peaks_and_residuals_of_free_run(run: FreeMotionRun, component: int, unit: str) -> NamedValues:
    """Return peak, RMS ratio and residuals of a wrench component by name, as in Fig. 6 and 7."""
    raw, half, rest = (run.scaled_wrenches[sigma][:, component] for sigma in SIGMAS)
    vector = slice(0, 3) if component < 3 else slice(3, 6)
    scale = run.scenario.force_scaling.force_scale
    peak = float(np.abs(raw).max())
    return {
        f"peak_raw_{unit}": peak,
        f"peak_raw_master_{unit}": scale * peak,
        "half_ratio": _rms(half) / _rms(raw),
        f"residual_max_{unit}": float(np.abs(rest).max()),
        f"residual_rms_{unit}": _rms(rest),
        f"residual_norm_max_{unit}": _largest_norm(run.scaled_wrenches[0.0][:, vector]),
    }


def detection_and_peaks_of_contact_run(run: RunsWithAndWithoutContact) -> NamedValues:
    """Return times of contact and detection, peaks and residuals by name, as in Fig. 8."""
    t, force_norm = run.contact_result.t, _force_norms(run.calculated_wrench)
    detected = force_norm > run.threshold_N
    window = _contact_window(run)
    after = t > t[window][-1] if window.any() else np.zeros(len(t), dtype=bool)
    return {
        "true_s": _time_of_first_true(t, run.in_contact),
        "detected_s": _time_of_first_true(t, detected),
        "threshold_N": run.threshold_N,
        "raw_detectable": bool(largest_raw_force_beyond_free_range(run).max() > 0),
        "false_alarm_0_6_s": bool(detected[after].any()),
        "peak_contact_N": float(force_norm.max()),
        "peak_true_contact_N": _largest_norm(run.contact_result["true_contact_wrench_W"][:, :3]),
        "peak_inertial_N": _largest_norm((run.measured_wrench - run.calculated_wrench)[:, :3]),
        "duration_s": float(np.count_nonzero(run.in_contact) * (t[1] - t[0])),
        "largest_deflection_mm": 1e3 * float(np.abs(run.contact_result["sheet_state"][:, 0]).max()),
        "free_residual_norm_max_N": float(_force_norms(run.calculated_wrench_free).max()),
        "free_residual_norm_max_Nm": _largest_norm(run.calculated_wrench_free[:, 3:]),
    }


def largest_raw_force_beyond_free_range(run: RunsWithAndWithoutContact) -> Array:
    """Return how far raw f_x, f_y, f_z, |f| (4,) leave their contact-free range in contact [N].

    Negative: a value stays within, so that no threshold on it detects the contact.
    """
    touched, free = (
        np.column_stack([raw[:, :3], _force_norms(raw)])
        for raw in (run.measured_wrench[_contact_window(run)], run.measured_wrench_free)
    )
    if not len(touched):
        return np.full(4, -np.inf)
    return np.maximum(touched.max(0) - free.max(0), free.min(0) - touched.min(0))


def errors_of_identification(load: LoadIdentification, scenario: Scenario) -> NamedValues:
    """Return errors of the load estimate and the expected deviation of its mass, by name."""
    truth = true_offsets_and_phi(scenario)
    error = load.estimate - truth
    mass, moment = load.estimate[6], load.estimate[7:10]
    true_mass, true_moment = truth[6], truth[7:10]
    deviations = load.batch.standard_deviations
    return {
        "mass_kg": float(mass),
        "mass_error_percent": 100 * abs(float(error[6] / true_mass)),
        "com_error_mm": 1e3 * float(np.linalg.norm(moment / mass - true_moment / true_mass)),
        "inertia_error_max_g_m2": 1e3 * float(np.abs(error[10:]).max()),
        "offset_error_N": float(np.linalg.norm(error[:3])),
        "offset_error_Nm": float(np.linalg.norm(error[3:6])),
        "mass_std_percent": 100 * float(deviations[6] / mass),
        "recursive_against_batch_std": load.max_recursive_minus_batch_in_stds,
        "kappa_w10": load.kappa_w10,
        "duration_s": load.trajectory.period,
        "samples": load.batch.samples,
    }


def without_leaf_spring_with_next_seed(scenario: Scenario) -> Scenario:
    """Return the scenario without the sheet spring, with the next seed."""
    return replace(scenario, sheet_spring=None, simulation__seed=scenario.simulation.seed + 1)


def _run_station(scenario: Scenario, estimate: Array, progress: UpdateProgress) -> SimulationResult:
    station = MakeTeleopStation(scenario, load_estimate=estimate)
    return simulate(station, scenario.simulation, progress=progress)


def true_offsets_and_phi(scenario: Scenario) -> Array:
    """Return the true sensor offsets and phi (16,) of Eq. (7)."""
    return np.concatenate([scenario.wrist_sensor.offset, slave_arm(scenario).phi_load])


def _scaled_wrench_at_slave(result: SimulationResult, estimate: Array, sigma: float) -> Array:
    wrench, s, omega, alpha = sensor_samples(result)
    offsets, phi, no_object = estimate[:6], estimate[6:], np.zeros(10)
    scales = {"sigma_gripper": sigma, "sigma_object": sigma, "gamma": 1.0}
    return scaled_wrench(wrench, offsets, s, omega, alpha, phi, no_object, **scales)


def _contact_window(run: RunsWithAndWithoutContact) -> NDArray[np.bool_]:
    t = run.contact_result.t
    if not run.in_contact.any():
        return run.in_contact
    times = t[run.in_contact]
    return (t >= times[0]) & (t <= times[-1] + FILTER_TAIL_S)


def time_of_largest_raw_force_after_contact(run: RunsWithAndWithoutContact) -> float | None:
    """Return the time of the largest raw force after contact [s], or None."""
    t, force_norm = run.contact_result.t, _force_norms(run.measured_wrench)
    window = _contact_window(run)
    if not window.any():
        return None
    force_norm[t <= t[window][-1]] = 0.0
    return float(t[np.argmax(force_norm)])


def _force_norms(wrench: Array) -> Array:
    return np.linalg.norm(wrench[:, :3], axis=1)


def _largest_norm(vectors: Array) -> float:
    return float(np.linalg.norm(vectors, axis=1).max())


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _time_of_first_true(t: Array, flags: NDArray[np.bool_]) -> float | None:
    return float(t[np.argmax(flags)]) if flags.any() else None
