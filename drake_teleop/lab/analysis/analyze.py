"""`drake-teleop analyze`: stability and transparency of a station at rest, along one direction."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import numpy as np

from drake_teleop.common.files import make_folder, output_folder, to_json_data, write_json
from drake_teleop.common.numeric import Array, one_blas_thread
from drake_teleop.common.progress import StartStage, show_progress
from drake_teleop.lab.analysis import absolute_stability, cut_loop, linearization, report, two_port
from drake_teleop.lab.analysis.frequency_response import MultiSine, measure_frequency_response
from drake_teleop.lab.analysis.linear_model import COMPONENT_NAMES, MAX_STATES, Linearization
from drake_teleop.lab.analysis.linearization import close_network_loop, linearize, two_port_along
from drake_teleop.lab.analysis.maps import RATE_NAME, StabilityMap, stability_map
from drake_teleop.lab.analysis.one_axis import Complex, OneAxis, environment_impedance
from drake_teleop.lab.analysis.period_map import Sampling, closed_axis_model, sampled_two_port
from drake_teleop.lab.analysis.sampled_wall import passive_stiffness, stable_stiffness
from drake_teleop.lab.analysis.task_direction import TaskDirection, check_can_press, task_direction
from drake_teleop.lab.identification import true_load
from drake_teleop.station.operator.operator import GRIP_IMPEDANCES
from drake_teleop.station.passivity.methods import PassivityConfig
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.slave.plant import NominalSlave

UNIT_VECTOR_W_BY_AXIS = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
#: N/m, walls of the table of margins, in addition to the scenario's own.
MARGIN_WALL_STIFFNESSES_N_M = (0.0, 1000.0, 5100.0, 20000.0)
MAX_COMPARED_OMEGA_RAD_S = 2 * np.pi * 30.0  #: rad/s, limit of the comparison of models
#: Frequencies of the analysis [rad/s].
OMEGA: Array = 2 * np.pi * np.geomspace(0.1, 300.0, 500)
J_OMEGA: Complex = 1j * OMEGA.astype(complex)
_MAX_IMPEDANCE_FIT_OMEGA_RAD_S = 2 * np.pi * 5.0  # limit of the fit of mass, damping and stiffness
_NUM_POINTS_PER_MAP_AXIS = 80  # points of a map in each direction
_PROBING_MULTI_SINE = MultiSine(lowest=0.6, period=1.5, settle=1.0)


def analyze_command(
    scenario: str | Path,
    out: Path,
    *,
    direction: str = "z",
    quiet: bool = False,
    progress: bool = True,
) -> dict[str, Any]:
    """Analyse a scenario along the world's x, y or z axis; write report and summary into `out`.

    Return the content of summary.json (docs/analysis.md).
    """
    setup = LoadScenario(scenario)
    make_folder(out)  # before the work, so that a bad path fails early
    summary, curves = analyze(setup, direction, progress and not quiet)
    summary = {"scenario": str(scenario), **summary}
    with output_folder(out):
        report.write_report(summary, curves, out)
        write_json(out / "summary.json", summary)
    if not quiet:
        report.print_tables(summary, out)
    return summary


def analyze(
    scenario: Scenario, direction: str = "z", progress: bool | StartStage = True
) -> tuple[dict[str, Any], report.ReportCurves]:
    """Return summary and report curves of a scenario, analysed without its passivity method."""
    with show_progress(progress) as stage, one_blas_thread():
        return _analyze_in_stages(scenario, direction, stage)


def _analyze_in_stages(
    scenario: Scenario, direction: str, stage: StartStage
) -> tuple[dict[str, Any], report.ReportCurves]:
    check_can_press(scenario)
    method = scenario.passivity.method
    linear = replace(scenario, passivity=PassivityConfig())
    estimate = true_load(scenario)
    along = task_direction(linear, UNIT_VECTOR_W_BY_AXIS[direction])
    sampling = sampling_of_scenario(linear)
    contact, is_wall_known = along.axis, along.axis.wall_stiffness > 0.0
    if not is_wall_known:
        contact = dataclasses.replace(contact, wall_stiffness=5100.0, wall_damping=0.0)
    axis = dataclasses.replace(contact, wall_stiffness=0.0, wall_damping=0.0)

    progress = stage("Linearise the Diagram")
    free = linearize(linear.without_environment(), load_estimate=estimate)
    progress(0.5)
    points = [("free motion", free, axis)]
    if scenario.first_sheet_spring is not None:
        alone = replace(linear.without_environment(), sheet_spring=scenario.first_sheet_spring)
        depth = master_displacement_into_sheet_spring(alone)
        pressed = linearize(alone, load_estimate=estimate, displacement=depth)
        points.append(("on the leaf", pressed, contact))
    progress(1.0)

    progress = stage("Two-port, margins, transparency")
    one_loop_open = close_feedback_of_other_directions(free, linear, along)
    with_hand = two_port_along(one_loop_open, OMEGA, along.hand, along.tool)
    H = two_port.absorb_impedances(with_hand, hand=-J_OMEGA * axis.hand_mass)
    progress(0.3)
    summary: dict[str, Any] = {
        "direction": direction,
        "grip": scenario.operator.grip,
        "method": method,
        "delay_s": axis.delay,
        "wall_N_per_m": contact.wall_stiffness,
        "wall_is": describe_origin_of_wall_stiffness(scenario, is_wall_known),
        "axis": dataclasses.asdict(axis) | {"tool_coupling": along.tool_coupling},
        "diagram": [
            summarise_diagram_stability(name, close_all_loops(system, linear), one_axis, sampling)
            for name, system, one_axis in points
        ],
        "two_port": two_port_errors_of_axis(with_mean_delays(with_hand, linear), axis, sampling),
        "margins": margin_rows(axis, sampling, contact.wall_stiffness),
        "absolute": absolute_stability_values(H, axis),
        "bounded": stiffest_stable_walls(H, axis, sampling),
        "transparency": transparency_values(H, axis, contact),
        "z_width": virtual_wall_limits(axis, sampling),
    }
    progress(1.0)
    maps = parameter_maps(axis, contact, sampling, stage)
    summary["maps"] = [
        {
            "title": title,
            "x": shown[scenario.operator.grip].x_name,
            "y": shown[scenario.operator.grip].y_name,
            "stable": {grip: float(one.stable.mean()) for grip, one in shown.items()},
            "boundary": {grip: one.boundary.tolist() for grip, one in shown.items()},
        }
        for title, shown in maps.items()
    ]
    summary["measured"] = None
    if summary["diagram"][0]["stable"]:
        measured = stage("Multi-sine in the nonlinear simulation")
        summary["measured"] = measure_free_impedance(linear, along, one_loop_open)
        measured(1.0)
    summary = to_json_data(summary)
    summary["verdict"] = report.verdict_sentences(summary)
    nyquist = {}
    for grip in GRIP_IMPEDANCES:
        loop = cut_loop.cut_loop(axis_with_grip(contact, grip), sampling)
        nyquist[grip] = -cut_loop.loop_response(loop, OMEGA, axis.delay)
    return summary, report.ReportCurves(contact, OMEGA, H, nyquist, maps)


def describe_origin_of_wall_stiffness(scenario: Scenario, is_wall_known: bool) -> str:
    if scenario.first_sheet_spring is not None:
        return "the leaf"
    if is_wall_known:
        return "the wall, in series with the tool"
    parts = () if scenario.surroundings is None else scenario.surroundings.parts
    names = " and ".join(type(part).__name__.lower() for part in parts)
    return "the paper's" + (f", because a {names} is not analysed" if names else "")


def sampling_of_scenario(scenario: Scenario) -> Sampling:
    rates, sensor = scenario.rates, scenario.wrist_sensor
    low_pass_hz = None if sensor.ideal else sensor.bandwidth_hz
    return Sampling(rates.hand_hz, rates.joint_control_hz, rates.sensor_hz, low_pass_hz)


def master_displacement_into_sheet_spring(scenario: Scenario) -> list[float]:
    """Return the master's displacement [m], in its base B, to a tip 5 mm in the sheet spring."""
    assert scenario.first_sheet_spring is not None
    scaling = scenario.kinematic_scaling
    goal = np.array(scenario.first_sheet_spring.position) - [0.0, 0.0, 5e-3]
    displacement = goal - NominalSlave(scenario.slave).p_WTip_start
    return list(scaling.R_WB.T @ displacement / scaling.translation_scale)


def close_all_loops(system: Linearization, scenario: Scenario) -> Linearization:
    return close_network_loop(system, scenario).close_loop("operator_wrench", "hand_wrench")


def close_feedback_of_other_directions(
    system: Linearization, scenario: Scenario, along: TaskDirection
) -> Linearization:
    """Return the linear model with loops closed, except the hand's in the task direction `along`.

    If `along` is parallel to no axis of the master's base B, the hand's loop remains open.
    """
    system = close_network_loop(system, scenario)
    (aligned,) = np.nonzero(np.abs(along.hand) > 1 - 1e-9)
    others = [axis for k, axis in enumerate(COMPONENT_NAMES) if len(aligned) and k != aligned[0]]
    return system.close_loop(
        [f"operator_wrench.{axis}" for axis in others], [f"hand_wrench.{axis}" for axis in others]
    )


def axis_with_grip(axis: OneAxis, grip: str) -> OneAxis:
    hand = GRIP_IMPEDANCES[grip]
    return dataclasses.replace(
        axis, hand_mass=hand.mass, hand_damping=hand.damping, hand_stiffness=hand.stiffness
    )


def summarise_diagram_stability(
    point: str, system: Linearization, axis: OneAxis, sampling: Sampling
) -> dict[str, Any]:
    """Return stability and slowest mode of the Diagram and of the one-axis model at a point."""
    loop = cut_loop.cut_loop(axis, sampling)
    stable = bool(cut_loop.count_unstable_multipliers(loop, axis.delay) == 0)
    return {
        "point": point,
        "states": system.num_states,
        **_slowest_mode(system, stable),
        # The count of unstable multipliers also includes those far from the unit circle.
        "one_axis": _slowest_mode(closed_axis_model(axis, sampling), stable) | {"stable": stable},
    }


def _slowest_mode(system: Linearization, stable: bool) -> dict[str, Any]:
    # `stable` replaces the multipliers of a model with too many states.
    if system.num_states > MAX_STATES:
        return {"stable": stable, "decay_1_per_s": None, "frequency_Hz": None}
    multiplier = complex(system.multipliers[0])
    return {
        "stable": abs(multiplier) < 1,
        "decay_1_per_s": float(-np.log(abs(multiplier)) / system.dt),
        "frequency_Hz": float(abs(np.angle(multiplier)) / system.dt / (2 * np.pi)),
    }


def with_mean_delays(H: Complex, scenario: Scenario) -> Complex:
    """Return H with the mean delay in both directions, as in one axis; h12 h21 is unchanged."""
    ahead, back = linearization.network_delay_periods(scenario)
    shift = np.exp(J_OMEGA * (ahead - back) / (2 * scenario.rates.hand_hz))
    h11, h12, h21, h22 = two_port.matrix_entries(H)
    return two_port.two_port_matrix(h11, h12 / shift, h21 * shift, h22)


def two_port_errors_of_axis(H: Complex, axis: OneAxis, sampling: Sampling) -> dict[str, Any]:
    """Return, up to 30 Hz, the largest errors of the continuous and sampled one-axis models.

    They are relative to the largest magnitude of each entry of H, which includes the hand's mass.
    """
    compared = OMEGA <= MAX_COMPARED_OMEGA_RAD_S
    with_hand_mass = dataclasses.replace(axis, device_mass=axis.device_mass + axis.hand_mass)

    def max_relative_deviations_from(other: Complex) -> dict[str, float]:
        largest = np.abs(other).max(axis=0)
        found = np.abs(H[compared] - other).max(axis=0) / np.where(largest > 0, largest, 1.0)
        return {f"h{i + 1}{j + 1}": float(found[i, j]) for i in range(2) for j in range(2)}

    closed_form = two_port.hybrid_matrix(with_hand_mass, J_OMEGA[compared])
    sampled = sampled_two_port(with_hand_mass, sampling, OMEGA[compared])
    models = {"closed_form": closed_form, "sampled": sampled}
    return {name: max_relative_deviations_from(model) for name, model in models.items()}


def margin_rows(axis: OneAxis, sampling: Sampling, own_wall: float) -> list[dict[str, Any]]:
    """Return stability margins by grip and wall: standard ones and the scenario's [N/m]."""
    rows = []
    omega = np.geomspace(1e-2, np.pi * sampling.hand_hz, 6000)
    walls = sorted({*MARGIN_WALL_STIFFNESSES_N_M, own_wall})
    for grip, wall in itertools.product(GRIP_IMPEDANCES, walls):
        held = dataclasses.replace(axis_with_grip(axis, grip), wall_stiffness=wall)
        loop = cut_loop.cut_loop(held, sampling)
        stable = bool(cut_loop.count_unstable_multipliers(loop, axis.delay) == 0)
        gain, phase = 1.0, 0.0
        if stable:
            response = cut_loop.loop_response(loop, omega, axis.delay)
            gain, phase = cut_loop.gain_and_phase_margin(response)
        rows.append(
            {
                "grip": grip,
                "wall_N_per_m": wall,
                "stable": stable,
                "gain": gain,
                "phase_deg": float(np.degrees(phase)),
                "round_trip_s": float(cut_loop.delay_margin(loop, 2 * axis.delay if stable else 0)),
            }
        )
    return rows


def absolute_stability_values(H: Complex, axis: OneAxis) -> dict[str, Any]:
    parameter = absolute_stability.llewellyn_parameter(H)
    worst = int(np.argmin(parameter))
    scaled, S = two_port.power_scaled_matrices(H, axis)
    return {
        "absolutely_stable": bool(absolute_stability.is_absolutely_stable(H).all()),
        "least_parameter": float(parameter[worst]),
        "at_Hz": float(OMEGA[worst] / (2 * np.pi)),
        "lacking_damping_Ns_per_m": float(absolute_stability.required_damping(H).max()),
        "passive": bool(absolute_stability.is_passive(scaled).all()),
        "scattering_norm": float(absolute_stability.scattering_norm(S).max()),
    }


def stiffest_stable_walls(H: Complex, axis: OneAxis, sampling: Sampling) -> dict[str, Any]:
    """Return the stiffest stable wall [N/m] for all hands from light to firm, and for each grip."""
    hands = absolute_stability.impedance_range_of_grips()
    limit = float(absolute_stability.stiffness_limit(H, OMEGA, hands).min())
    each = {
        grip: _find_max_stable_wall_stiffness(axis_with_grip(axis, grip), sampling)
        for grip in GRIP_IMPEDANCES
    }
    return {"grips": limit if min(each.values()) > 0 else 0.0, "each": each}


def _find_max_stable_wall_stiffness(axis: OneAxis, sampling: Sampling) -> float:
    stiffness = np.concatenate([[0.0], np.geomspace(10.0, 1e7, 1000)])
    walls: Any = {"wall_stiffness": stiffness, "wall_damping": 0.0}
    loop = cut_loop.cut_loop(dataclasses.replace(axis, **walls), sampling)
    (bad,) = np.nonzero(cut_loop.count_unstable_multipliers(loop, axis.delay))
    return float("inf") if len(bad) == 0 else float(stiffness[max(bad[0] - 1, 0)])


def transparency_values(H: Complex, axis: OneAxis, contact: OneAxis) -> dict[str, Any]:
    fitted = OMEGA <= _MAX_IMPEDANCE_FIT_OMEGA_RAD_S
    figures: dict[str, Any] = {}
    for name, one in (("free", axis), ("wall", contact)):
        environment = environment_impedance(one, J_OMEGA)
        displayed = two_port.transmitted_impedance(H, environment)
        ideal = two_port.ideal_impedance(axis, J_OMEGA, environment)
        noticed = two_port.is_difference_noticed(displayed, ideal)
        first = int(np.argmax(noticed)) if noticed.any() else len(noticed)
        figures[name] = {
            which: two_port.fit_apparent_impedance(impedance[fitted], OMEGA[fitted])._asdict()
            for which, impedance in (("felt", displayed), ("ideal", ideal))
        }
        figures[name]["unnoticed_to_Hz"] = float(OMEGA[first - 1] / (2 * np.pi)) if first else 0.0
    tracks = np.abs(H[:, 1, 0]) > axis.position_scale / np.sqrt(2)
    end = len(tracks) if tracks.all() else int(np.argmin(tracks))
    figures["tracking_bandwidth_Hz"] = float(OMEGA[max(end - 1, 0)] / (2 * np.pi))
    width = two_port.transmitted_z_width(H).decades
    figures["width_decades"] = {
        f"{hz:g} Hz": float(np.interp(2 * np.pi * hz, OMEGA, width)) for hz in (1.0, 5.0, 10.0)
    }
    stiffness = contact.wall_stiffness
    change = two_port.smallest_stiffness_change(H, OMEGA, stiffness)
    figures["smallest_stiffness_N_per_m"] = {
        "on the master, 1 Hz": float(np.interp(2 * np.pi, OMEGA, change)),
        "on the wall itself": two_port.WEBER_FRACTION * stiffness,
    }
    return figures


def virtual_wall_limits(axis: OneAxis, sampling: Sampling) -> dict[str, Any]:
    wall_damping, period = np.linspace(0.0, 60.0, 31), 1 / sampling.hand_hz
    mass, damping = axis.hand_mass + axis.device_mass, axis.hand_damping + axis.device_damping
    limits = {
        "wall_damping_Ns_per_m": wall_damping,
        "passive_N_per_m": passive_stiffness(axis.device_damping, wall_damping, period),
        "passive_in_the_hand_N_per_m": passive_stiffness(damping, wall_damping, period),
        "stable_in_the_hand_N_per_m": stable_stiffness(
            mass, damping, wall_damping, period, hand_stiffness=axis.hand_stiffness
        ),
    }
    walls = [dict(zip(limits, row, strict=True)) for row in np.array([*limits.values()]).T.tolist()]
    device = {"device_damping_Ns_per_m": axis.device_damping, "rate_Hz": sampling.hand_hz}
    return device | {"walls": walls}


def measure_free_impedance(
    scenario: Scenario, along: TaskDirection, system: Linearization
) -> dict[str, Any]:
    """Return the displayed impedance in free motion, simulated without Coulomb friction.

    Return also its relative differences from the linear model `system`.
    """
    frictionless = scenario.master.without_coulomb_friction_and_encoder_steps()
    smooth = replace(scenario.without_environment(), master=frictionless, slave__friction=[])
    estimate = true_load(scenario)
    if not scenario.wrist_sensor.ideal:
        estimate[:6] = scenario.wrist_sensor.offset
    found = measure_frequency_response(smooth, along, _PROBING_MULTI_SINE, load_estimate=estimate)
    # Held force: its component at the frequency itself, as in the two-port.
    step = 1j * found.omega / scenario.rates.hand_hz
    held = found.response("hand_force", "hand_velocity") * -np.expm1(-step) / step
    # The hand's mass moves with the stylus and belongs to the hand.
    displayed = held - 1j * found.omega * along.axis.hand_mass
    ratio = held / two_port_along(system, found.omega, along.hand, along.tool)[:, 0, 0]
    return {
        "frequency_Hz": found.omega / (2 * np.pi),
        "felt_re": displayed.real,
        "felt_im": displayed.imag,
        "coherence": found.coherence("hand_velocity", "hand_force"),
        "greatest_error": np.abs(np.abs(ratio) - 1).max(),
        "greatest_error_deg": np.abs(np.angle(ratio, deg=True)).max(),
    }


def parameter_maps(
    axis: OneAxis, contact: OneAxis, sampling: Sampling, stage: StartStage
) -> dict[str, dict[str, StabilityMap]]:
    n, tool = _NUM_POINTS_PER_MAP_AXIS, axis.tool_mass
    delay, sigma = np.linspace(0.0, 0.2, n), np.linspace(0.0, 2.0, n)
    walls = np.geomspace(100.0, 1e5, n)
    # The sensor's low-pass has to stay below half of its rate.
    slowest = 2.4 * (sampling.low_pass_hz or 0.0) * sampling.hand_hz / sampling.sensor_hz
    rate = np.geomspace(max(slowest, 100.0), max(2 * slowest, 10e3), n)
    parameters: dict[str, tuple[Any, ...]] = {
        "Delay and stiffness of the wall": (contact, "delay", delay, "wall_stiffness", walls),
        "Delay and σ, in free motion": (axis, "delay", delay, "sigma", sigma),
        "Delay and σ, on the wall": (contact, "delay", delay, "sigma", sigma),
        "Error of the estimated mass and σ, in free motion": (
            *(axis, "mass_error", np.linspace(-0.9, 4.0, n) * tool, "sigma", sigma),
        ),
        "Rate and stiffness of the wall": (contact, RATE_NAME, rate, "wall_stiffness", walls),
    }
    progress, found = stage("Maps"), {}
    for done, (title, (base, *grid)) in enumerate(parameters.items()):
        found[title] = {
            grip: stability_map(axis_with_grip(base, grip), sampling, *grid)
            for grip in GRIP_IMPEDANCES
        }
        progress((done + 1) / len(parameters))
    return found
