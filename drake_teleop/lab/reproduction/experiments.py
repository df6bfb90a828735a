"""The paper's experiments: free movements (Figs. 6, 7), contact (Fig. 8)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.numeric import Array
from drake_teleop.common.progress import StartStage, UpdateProgress
from drake_teleop.lab.identification import LoadIdentification, sensor_samples, slave_arm
from drake_teleop.lab.run import FILTER_SETTLING_S, is_in_contact
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

DISPLAYED_LOAD_SHARES = (1.0, 0.5, 0.0)
_CONTACT_THRESHOLD_TO_FREE_PEAK_RATIO = 1.5


@dataclass(frozen=True, eq=False)
class MotionRun:
    """Simulated movement, with wrenches for displayed load shares (sigma) of 1, 0.5 and 0."""

    scenario: Scenario
    result: SimulationResult
    #: Sigma (share of the load's wrench) -> scaled wrench (N, 6) at the slave. 1: measured wrench
    #: without offsets; 0: calculated contact wrench.
    scaled_wrenches: dict[float, Array]


@dataclass(frozen=True, eq=False)
class IdealSensorRun:
    """Free movement with the exact wrench and motion in place of sensor readings."""

    weld_reaction: Array  #: (N, 6) reaction wrench of the tool's weld [N, N m], in S about So
    #: Specific force, angular velocity and angular acceleration of S, (N, 3) each.
    sensor_motion: tuple[Array, Array, Array]
    phi: Array  #: (10,) true load


@dataclass(frozen=True, eq=False)
class RunsWithAndWithoutContact:
    """Recorded contact transition, and the same movement without the sheet spring."""

    touched: MotionRun
    free: MotionRun

    @property
    def in_contact(self) -> NDArray[np.bool_]:
        """(N,) True in true contact and in short gaps, see `is_in_contact`."""
        return is_in_contact(self.touched.result)

    @property
    def response_span_s(self) -> tuple[float, float]:
        """Times [s] of first contact and settled filters after the last; (inf, inf): no contact."""
        times = self.touched.result.t[self.in_contact]
        return (times[0], times[-1] + FILTER_SETTLING_S) if len(times) else (np.inf, np.inf)

    @property
    def threshold_N(self) -> float:
        """Force threshold of the contact detection [N]."""
        free_force = self.free.scaled_wrenches[0.0][:, :3]
        return _CONTACT_THRESHOLD_TO_FREE_PEAK_RATIO * _largest_norm(free_force)


def simulate_motion(scenario: Scenario, estimate: Array, progress: UpdateProgress) -> MotionRun:
    """Simulate a movement; scale its wrench for displayed load shares of 1, 0.5 and 0."""
    station = MakeTeleopStation(scenario, load_estimate=estimate)
    result = simulate(station, scenario.simulation, progress=progress)
    wrench, s, omega, alpha = sensor_samples(result)
    parts = wrench, estimate[:6], s, omega, alpha, estimate[6:], np.zeros(10)  # no object
    scaled = {
        sigma: scaled_wrench(*parts, sigma_gripper=sigma, sigma_object=sigma, gamma=1.0)
        for sigma in DISPLAYED_LOAD_SHARES
    }
    return MotionRun(scenario, result, scaled)


def simulate_contact(
    scenario: Scenario, estimate: Array, stage: StartStage
) -> RunsWithAndWithoutContact:
    """Simulate the contact transition, then the same motion without sheet spring, with seed + 1."""
    seed = scenario.simulation.seed
    without = replace(scenario, sheet_spring=None, simulation__seed=seed + 1)
    touched = simulate_motion(scenario, estimate, stage("Fig. 8: contact transition"))
    free = simulate_motion(without, estimate, stage("Fig. 8: same motion without contact"))
    return RunsWithAndWithoutContact(touched, free)


def simulate_ideal_motion(progress: UpdateProgress) -> IdealSensorRun:
    """Simulate a free movement along and about all axes with an ideal sensor."""
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


def peaks_and_residuals_of_free_run(run: MotionRun, component: int, unit: str) -> NamedValues:
    """Return peak, rms at sigma 0.5 over 1, and residuals (sigma 0) of one wrench component."""
    raw, half, rest = (run.scaled_wrenches[sigma][:, component] for sigma in DISPLAYED_LOAD_SHARES)
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
    result, free_residual = run.touched.result, run.free.scaled_wrenches[0.0]
    measured, calculated = (run.touched.scaled_wrenches[sigma] for sigma in (1.0, 0.0))
    t, detected = result.t, np.linalg.norm(calculated[:, :3], axis=1) > run.threshold_N
    return {
        "true_s": _time_of_first_true(t, run.in_contact),
        "detected_s": _time_of_first_true(t, detected),
        "threshold_N": run.threshold_N,
        "raw_detectable": bool(largest_raw_force_beyond_free_range(run).max() > 0),
        "false_alarm_0_6_s": bool(detected[t > run.response_span_s[1]].any()),
        "peak_contact_N": _largest_norm(calculated[:, :3]),
        "peak_true_contact_N": _largest_norm(result["true_contact_wrench_W"][:, :3]),
        "peak_inertial_N": _largest_norm((measured - calculated)[:, :3]),
        "duration_s": float(np.count_nonzero(run.in_contact) * (t[1] - t[0])),
        "largest_deflection_mm": 1e3 * float(np.abs(result["sheet_state"][:, 0]).max()),
        "free_residual_norm_max_N": _largest_norm(free_residual[:, :3]),
        "free_residual_norm_max_Nm": _largest_norm(free_residual[:, 3:]),
    }


def largest_raw_force_beyond_free_range(run: RunsWithAndWithoutContact) -> Array:
    """Return the excess (4,) [N] of raw f_x, f_y, f_z, |f| over their contact-free range."""
    touched, free = (
        np.column_stack([force, np.linalg.norm(force, axis=1)])
        for force in (one.scaled_wrenches[1.0][:, :3] for one in (run.touched, run.free))
    )
    t, (start, end) = run.touched.result.t, run.response_span_s
    touched = touched[(t >= start) & (t <= end)]
    if not len(touched):
        return np.full(4, -np.inf)
    return np.maximum(touched.max(0) - free.max(0), free.min(0) - touched.min(0))


def time_of_largest_raw_force_after_contact(run: RunsWithAndWithoutContact) -> float | None:
    """Return the time [s] of the largest raw force after the last contact's response, or None."""
    t, (_, end) = run.touched.result.t, run.response_span_s
    force = np.linalg.norm(run.touched.scaled_wrenches[1.0][t > end, :3], axis=1)
    return float(t[t > end][np.argmax(force)]) if len(force) else None


def errors_of_identification(load: LoadIdentification, scenario: Scenario) -> NamedValues:
    """Return the errors of the load estimate and the standard deviation of its mass, by name."""
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


def true_offsets_and_phi(scenario: Scenario) -> Array:
    """Return the true sensor offsets, then phi, (16,), of Eq. (7)."""
    return np.concatenate([scenario.wrist_sensor.offset, slave_arm(scenario).phi_load])


def _largest_norm(vectors: Array) -> float:
    return float(np.linalg.norm(vectors, axis=1).max())


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _time_of_first_true(t: Array, flags: NDArray[np.bool_]) -> float | None:
    return float(t[np.argmax(flags)]) if flags.any() else None
