"""`drake-teleop analyze`: stability and transparency of a station at rest, along one direction."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import make_folder, output_folder, to_json_data, write_json
from drake_teleop.common.numeric import one_blas_thread
from drake_teleop.common.progress import StartStage, show_progress
from drake_teleop.lab.analysis import report, summary_values
from drake_teleop.lab.analysis.cut_loop import cut_loop, loop_response
from drake_teleop.lab.analysis.linear_model import COMPONENT_NAMES, Linearization
from drake_teleop.lab.analysis.linearization import close_network, hybrid_along, linearize
from drake_teleop.lab.analysis.period_map import Sampling
from drake_teleop.lab.analysis.task_direction import TaskDirection, task_direction
from drake_teleop.lab.analysis.two_port import absorb_impedances, hybrid_matrix
from drake_teleop.lab.identification import true_load
from drake_teleop.station.operator.operator import GRIP_IMPEDANCES
from drake_teleop.station.passivity.methods import PassivityConfig
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.slave.plant import NominalSlave

UNIT_VECTORS = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


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
    """Analyse a scenario without its passivity method; return summary and curves of the report."""
    with show_progress(progress) as stage, one_blas_thread():
        return _analyze_in_stages(scenario, direction, stage)


def _analyze_in_stages(
    scenario: Scenario, direction: str, stage: StartStage
) -> tuple[dict[str, Any], report.ReportCurves]:
    method = scenario.passivity.method
    linear = replace(scenario, passivity=PassivityConfig())
    estimate = true_load(scenario)
    along = task_direction(linear, UNIT_VECTORS[direction])
    sampling = sampling_of_scenario(linear)
    is_wall_known, omega = along.axis.wall_stiffness > 0.0, summary_values.OMEGA
    wall = (along.axis.wall_stiffness, along.axis.wall_damping) if is_wall_known else (5100.0, 0.0)
    axis = dataclasses.replace(along.axis, wall_stiffness=0.0, wall_damping=0.0)
    contact = dataclasses.replace(axis, wall_stiffness=wall[0], wall_damping=wall[1])

    progress = stage("Linearise the Diagram")
    free = linearize(linear.without_environment(), load_estimate=estimate)
    progress(0.5)
    points = [("free motion", free, axis)]
    if scenario.first_sheet_spring is not None:
        alone = replace(linear.without_environment(), sheet_spring=scenario.first_sheet_spring)
        depth = master_displacement_into_leaf(alone)
        pressed = linearize(alone, load_estimate=estimate, displacement=depth)
        points.append(("on the leaf", pressed, contact))
    progress(1.0)

    progress = stage("Two-port, margins, transparency")
    one_loop_open = close_other_directions(free, linear, along)
    with_hand = hybrid_along(one_loop_open, omega, along.hand, along.tool)
    H = absorb_impedances(with_hand, hand=-summary_values.S_AT_OMEGA * axis.hand_mass)
    closed_form = hybrid_matrix(axis, summary_values.S_AT_OMEGA)
    progress(0.3)
    summary: dict[str, Any] = {
        "direction": direction,
        "grip": scenario.operator.grip,
        "method": method,
        "delay_s": axis.delay,
        "wall_N_per_m": wall[0],
        "wall_is": describe_wall_source(scenario, is_wall_known),
        "axis": dataclasses.asdict(axis) | {"tool_coupling": along.tool_coupling},
        "diagram": [
            summary_values.summarise_diagram_stability(
                name, close_all_loops(system, linear), one_axis, sampling
            )
            for name, system, one_axis in points
        ],
        "two_port": summary_values.two_port_deviations(with_hand, axis, sampling),
        "margins": summary_values.margin_rows(axis, sampling, wall[0]),
        "absolute": summary_values.absolute_stability_values(H, axis),
        "bounded": summary_values.stiffest_stable_walls(H, axis, sampling),
        "transparency": summary_values.transparency_values(H, axis, wall),
        "z_width": summary_values.virtual_wall_limits(axis, sampling),
    }
    progress(1.0)
    maps = summary_values.parameter_maps(axis, wall, sampling, stage)
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
        summary["measured"] = summary_values.measure_free_impedance(linear, along, one_loop_open)
        measured(1.0)
    summary = to_json_data(summary)
    summary["verdict"] = report.verdict_sentences(summary)
    nyquist = {}
    for grip in GRIP_IMPEDANCES:
        loop = cut_loop(summary_values.axis_with_grip(contact, grip), sampling)
        nyquist[grip] = -loop_response(loop, omega, axis.delay)
    return summary, report.ReportCurves(axis, omega, H, closed_form, wall, nyquist, maps)


def describe_wall_source(scenario: Scenario, is_known: bool) -> str:
    """Return the source of the analysed wall stiffness as text."""
    if scenario.first_sheet_spring is not None:
        return "the leaf"
    if is_known:
        return "the wall, in series with the tool"
    parts = () if scenario.surroundings is None else scenario.surroundings.parts
    names = " and ".join(type(part).__name__.lower() for part in parts)
    return "the paper's" + (f", because a {names} is not analysed" if names else "")


def sampling_of_scenario(scenario: Scenario) -> Sampling:
    rates, sensor = scenario.rates, scenario.wrist_sensor
    low_pass_hz = None if sensor.ideal else sensor.bandwidth_hz
    return Sampling(rates.hand_hz, rates.joint_control_hz, rates.sensor_hz, low_pass_hz)


def master_displacement_into_leaf(scenario: Scenario) -> list[float]:
    """Return the master's displacement [m], in B, that commands the tip 5 mm into the leaf."""
    assert scenario.first_sheet_spring is not None
    scaling = scenario.kinematic_scaling
    if scaling.translation_scale == 0:
        what = "is 0, so that the slave cannot press on the leaf of the sheet spring"
        remedy = "choose a scale above 0, or remove the sheet spring (sheet_spring or !SheetSpring)"
        raise DrakeTeleopError(what, where="kinematic_scaling.translation_scale", remedy=remedy)
    goal = np.array(scenario.first_sheet_spring.position) - [0.0, 0.0, 5e-3]
    displacement = goal - NominalSlave(scenario.slave).start_tip
    return list(scaling.R_WB.T @ displacement / scaling.translation_scale)


def close_all_loops(system: Linearization, scenario: Scenario) -> Linearization:
    return close_network(system, scenario).close_loop("operator_wrench", "hand_wrench")


def close_other_directions(
    system: Linearization, scenario: Scenario, along: TaskDirection
) -> Linearization:
    """Return the model with all loops closed, except the loop of the hand along `along`.

    If `along` is parallel to no axis of B, the hand's loop remains open in all directions.
    """
    system = close_network(system, scenario)
    (aligned,) = np.nonzero(np.abs(along.hand) > 1 - 1e-9)
    others = [axis for k, axis in enumerate(COMPONENT_NAMES) if len(aligned) and k != aligned[0]]
    return system.close_loop(
        [f"operator_wrench.{axis}" for axis in others], [f"hand_wrench.{axis}" for axis in others]
    )
