"""Numbers in the summary of `drake-teleop analyze`, by section."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from drake_teleop.common.numeric import Array
from drake_teleop.common.progress import StartStage
from drake_teleop.lab.analysis import absolute_stability, sampled_wall, transparency
from drake_teleop.lab.analysis.cut_loop import (
    count_unstable_multipliers,
    cut_loop,
    delay_margin,
    gain_and_phase_margin,
    loop_response,
)
from drake_teleop.lab.analysis.frequency_response import MultiSine, measure_frequency_response
from drake_teleop.lab.analysis.linear_model import MAX_STATES, Linearization
from drake_teleop.lab.analysis.linearization import hybrid_along
from drake_teleop.lab.analysis.maps import RATE_NAME, StabilityMap, stability_map
from drake_teleop.lab.analysis.one_axis import Complex, OneAxis
from drake_teleop.lab.analysis.period_map import Sampling, closed_axis_model, sampled_two_port
from drake_teleop.lab.analysis.task_direction import TaskDirection
from drake_teleop.lab.analysis.two_port import (
    hybrid_matrix,
    power_ratio,
    reference_impedances,
    scale_slave_power,
    scattering_matrix,
    transmitted_impedance,
)
from drake_teleop.lab.identification import slave_arm
from drake_teleop.station.operator.operator import GRIP_IMPEDANCES
from drake_teleop.station.scenario import Scenario, replace

#: N/m, walls of the table of margins, in addition to the scenario's own.
WALL_STIFFNESSES_N_M = (0.0, 1000.0, 5100.0, 20000.0)
COMPARISON_BAND_RAD_S = 2 * np.pi * 30.0  #: rad/s, limit of the comparison of models
OMEGA: Array = 2 * np.pi * np.geomspace(0.1, 300.0, 500)
S_AT_OMEGA: Complex = 1j * OMEGA.astype(complex)
_MAX_FITTED_OMEGA_RAD_S = 2 * np.pi * 5.0  # rad/s, limit of the fit of mass, damping and stiffness
_POINTS_PER_MAP_AXIS = 80  # points of a map in each direction
_MEASUREMENT_MOTION = MultiSine(lowest=0.6, period=1.5, settle=1.0)


def axis_with_grip(axis: OneAxis, grip: str) -> OneAxis:
    hand = GRIP_IMPEDANCES[grip]
    return dataclasses.replace(
        axis, hand_mass=hand.mass, hand_damping=hand.damping, hand_stiffness=hand.stiffness
    )


def summarise_diagram_stability(
    name: str, system: Linearization, axis: OneAxis, sampling: Sampling
) -> dict[str, Any]:
    """Return stability, decay rate and frequency of linearised Diagram and one-axis model.

    Decay and frequency are those of the largest multiplier.
    """
    stable = bool(count_unstable_multipliers(cut_loop(axis, sampling), axis.delay) == 0)
    return {
        "point": name,
        "states": system.num_states,
        **_slowest_motion(system, stable),
        # The count of unstable multipliers also includes those far from the unit circle.
        "one_axis": _slowest_motion(closed_axis_model(axis, sampling), stable) | {"stable": stable},
    }


def _slowest_motion(system: Linearization, stable: bool) -> dict[str, Any]:
    # `stable` replaces the multipliers of a model with too many states.
    if system.num_states > MAX_STATES:
        return {"stable": stable, "decay_1_per_s": None, "frequency_Hz": None}
    multiplier = complex(system.multipliers[0])
    return {
        "stable": abs(multiplier) < 1,
        "decay_1_per_s": float(-np.log(abs(multiplier)) / system.dt),
        "frequency_Hz": float(abs(np.angle(multiplier)) / system.dt / (2 * np.pi)),
    }


def two_port_deviations(H: Complex, axis: OneAxis, sampling: Sampling) -> dict[str, Any]:
    """Return the largest deviations of H from the one-axis models up to 30 Hz.

    They are relative to the largest magnitude of each entry. `H` (N, 2, 2) is the linearised
    Diagram's at `OMEGA`, with the hand's mass.
    """
    compared = OMEGA <= COMPARISON_BAND_RAD_S
    with_hand_mass = dataclasses.replace(axis, device_mass=axis.device_mass + axis.hand_mass)

    def greatest_deviations(other: Complex) -> dict[str, float]:
        found = np.abs(H[compared] - other).max(axis=0) / np.abs(other).max(axis=0)
        return {f"h{i + 1}{j + 1}": float(found[i, j]) for i in range(2) for j in range(2)}

    return {
        "closed_form": greatest_deviations(hybrid_matrix(with_hand_mass, S_AT_OMEGA[compared])),
        "sampled": greatest_deviations(sampled_two_port(with_hand_mass, sampling, OMEGA[compared])),
    }


def margin_rows(axis: OneAxis, sampling: Sampling, own_wall: float) -> list[dict[str, Any]]:
    """Return stability margins for each grip and wall; `own_wall`: another stiffness [N/m]."""
    rows = []
    omega = np.geomspace(1e-2, np.pi * sampling.hand_hz, 6000)
    for grip in GRIP_IMPEDANCES:
        for wall in sorted({*WALL_STIFFNESSES_N_M, own_wall}):
            held = dataclasses.replace(axis_with_grip(axis, grip), wall_stiffness=wall)
            loop = cut_loop(held, sampling)
            stable = bool(count_unstable_multipliers(loop, axis.delay) == 0)
            gain, phase = 1.0, 0.0
            if stable:
                gain, phase = gain_and_phase_margin(loop_response(loop, omega, axis.delay))
            rows.append(
                {
                    "grip": grip,
                    "wall_N_per_m": wall,
                    "stable": stable,
                    "gain": gain,
                    "phase_deg": float(np.degrees(phase)),
                    "round_trip_s": float(delay_margin(loop)),
                }
            )
    return rows


def absolute_stability_values(H: Complex, axis: OneAxis) -> dict[str, Any]:
    """Return stability criteria for any passive hand and environment."""
    parameter = absolute_stability.llewellyn_parameter(H)
    worst = int(np.argmin(parameter))
    scaled = scale_slave_power(H, power_ratio(axis)) if power_ratio(axis) > 0 else H
    norm = absolute_stability.scattering_norm(scattering_matrix(scaled, reference_impedances(axis)))
    return {
        "absolutely_stable": bool(absolute_stability.is_absolutely_stable(H).all()),
        "least_parameter": float(parameter[worst]),
        "at_Hz": float(OMEGA[worst] / (2 * np.pi)),
        "lacking_damping_Ns_per_m": float(absolute_stability.required_damping(H).max()),
        "passive": bool(absolute_stability.is_passive(scaled).all()),
        "scattering_norm": float(norm.max()),
    }


def stiffest_stable_walls(H: Complex, axis: OneAxis, sampling: Sampling) -> dict[str, Any]:
    """Return the stiffest stable wall [N/m]: for any hand between light and firm, and per grip."""
    hands = absolute_stability.impedance_range_of_grips()
    limit = float(absolute_stability.stiffness_limit(H, OMEGA, hands).min())
    each = {
        grip: _find_stiffest_stable_wall(axis_with_grip(axis, grip), sampling)
        for grip in GRIP_IMPEDANCES
    }
    return {"grips": limit if min(each.values()) > 0 else 0.0, "each": each}


def _find_stiffest_stable_wall(axis: OneAxis, sampling: Sampling) -> float:
    stiffness = np.concatenate([[0.0], np.geomspace(10.0, 1e7, 1000)])
    walls: Any = {"wall_stiffness": stiffness, "wall_damping": 0.0}
    loop = cut_loop(dataclasses.replace(axis, **walls), sampling)
    (bad,) = np.nonzero(count_unstable_multipliers(loop, axis.delay))
    return float("inf") if len(bad) == 0 else float(stiffness[max(bad[0] - 1, 0)])


def transparency_values(H: Complex, axis: OneAxis, wall: tuple[float, float]) -> dict[str, Any]:
    """Return displayed and ideal impedances, and the tracking bandwidth; `wall`: [N/m], [N s/m]."""
    fitted = OMEGA <= _MAX_FITTED_OMEGA_RAD_S
    figures: dict[str, Any] = {}
    environments = {"free": np.zeros_like(S_AT_OMEGA), "wall": wall[1] + wall[0] / S_AT_OMEGA}
    for name, environment in environments.items():
        felt = transmitted_impedance(H, environment)
        ideal = transparency.ideal_impedance(axis, S_AT_OMEGA, environment)
        noticed = transparency.is_difference_noticed(felt, ideal)
        first = int(np.argmax(noticed)) if noticed.any() else len(noticed)
        figures[name] = {
            which: transparency.fit_apparent_impedance(impedance[fitted], OMEGA[fitted])._asdict()
            for which, impedance in (("felt", felt), ("ideal", ideal))
        }
        figures[name]["unnoticed_to_Hz"] = float(OMEGA[first - 1] / (2 * np.pi)) if first else 0.0
    tracks = np.abs(H[:, 1, 0]) > axis.position_scale / np.sqrt(2)
    end = len(tracks) if tracks.all() else int(np.argmin(tracks))
    figures["tracking_bandwidth_Hz"] = float(OMEGA[max(end - 1, 0)] / (2 * np.pi))
    width = transparency.transmitted_z_width(H).decades
    figures["width_decades"] = {
        f"{hz:g} Hz": float(np.interp(2 * np.pi * hz, OMEGA, width)) for hz in (1.0, 5.0, 10.0)
    }
    change = transparency.smallest_stiffness_change(H, OMEGA, wall[0])
    figures["smallest_stiffness_N_per_m"] = {
        "on the master, 1 Hz": float(np.interp(2 * np.pi, OMEGA, change)),
        "on the wall itself": transparency.WEBER_FRACTION * wall[0],
    }
    return figures


def virtual_wall_limits(axis: OneAxis, sampling: Sampling) -> dict[str, Any]:
    damping, period = np.linspace(0.0, 60.0, 31), 1 / sampling.hand_hz
    passive = sampled_wall.passive_stiffness(axis.device_damping, damping, period)
    stable = sampled_wall.stable_stiffness(
        axis.hand_mass + axis.device_mass,
        axis.hand_damping + axis.device_damping,
        damping,
        period,
        hand_stiffness=axis.hand_stiffness,
    )
    held = sampled_wall.passive_stiffness(axis.hand_damping + axis.device_damping, damping, period)
    return {
        "device_damping_Ns_per_m": axis.device_damping,
        "rate_Hz": sampling.hand_hz,
        "walls": [
            {
                "wall_damping_Ns_per_m": float(B),
                "passive_N_per_m": float(alone),
                "passive_in_the_hand_N_per_m": float(in_hand),
                "stable_in_the_hand_N_per_m": float(limit),
            }
            for B, alone, in_hand, limit in zip(damping, passive, held, stable, strict=True)
        ],
    }


def measure_free_impedance(
    scenario: Scenario, along: TaskDirection, system: Linearization
) -> dict[str, Any]:
    """Return the impedance displayed in free motion, from a simulation without Coulomb friction.

    The errors are those of the linear model `system`.
    """
    frictionless = scenario.master.without_coulomb_friction_and_encoder_steps()
    free = scenario.without_environment()
    smooth = replace(free, master=frictionless, slave__friction=[])
    estimate = np.concatenate([scenario.wrist_sensor.offset, slave_arm(scenario).phi_load])
    if scenario.wrist_sensor.ideal:
        estimate[:6] = 0.0
    found = measure_frequency_response(smooth, along, _MEASUREMENT_MOTION, load_estimate=estimate)
    # Held force: its component at the frequency itself, as in the two-port.
    step = 1j * found.omega / scenario.rates.hand_hz
    held = found.response("hand_force", "hand_velocity") * -np.expm1(-step) / step
    # The hand's mass moves with the stylus and belongs to the hand.
    felt = held - 1j * found.omega * along.axis.hand_mass
    ratio = held / hybrid_along(system, found.omega, along.hand, along.tool)[:, 0, 0]
    return {
        "frequency_Hz": found.omega / (2 * np.pi),
        "felt_re": felt.real,
        "felt_im": felt.imag,
        "coherence": found.coherence("hand_velocity", "hand_force"),
        "greatest_error": np.abs(np.abs(ratio) - 1).max(),
        "greatest_error_deg": np.abs(np.angle(ratio, deg=True)).max(),
    }


def parameter_maps(
    axis: OneAxis, wall: tuple[float, float], sampling: Sampling, stage: StartStage
) -> dict[str, dict[str, StabilityMap]]:
    touching = dataclasses.replace(axis, wall_stiffness=wall[0], wall_damping=wall[1])
    n, tool = _POINTS_PER_MAP_AXIS, axis.tool_mass
    delay, sigma = np.linspace(0.0, 0.2, n), np.linspace(0.0, 2.0, n)
    walls = np.geomspace(100.0, 1e5, n)
    # The sensor's low-pass has to stay below half of its rate.
    slowest = 2.4 * (sampling.low_pass_hz or 0.0) * sampling.hand_hz / sampling.sensor_hz
    rate = np.geomspace(max(slowest, 100.0), 10e3, n)
    parameters: dict[str, tuple[Any, ...]] = {
        "Delay and stiffness of the wall": (touching, "delay", delay, "wall_stiffness", walls),
        "Delay and σ, in free motion": (axis, "delay", delay, "sigma", sigma),
        "Delay and σ, on the wall": (touching, "delay", delay, "sigma", sigma),
        "Error of the estimated mass and σ, in free motion": (
            *(axis, "mass_error", np.linspace(-0.9, 4.0, n) * tool, "sigma", sigma),
        ),
        "Rate and stiffness of the wall": (touching, RATE_NAME, rate, "wall_stiffness", walls),
    }
    progress, found = stage("Maps"), {}
    for done, (title, (base, *grid)) in enumerate(parameters.items()):
        found[title] = {
            grip: stability_map(axis_with_grip(base, grip), sampling, *grid)
            for grip in GRIP_IMPEDANCES
        }
        progress((done + 1) / len(parameters))
    return found
