"""`drake-teleop reproduce`, Figs. 6, 7 and 8 (long: the paper's experiments in their order).

1. Identification (section IV) by the recursive estimator in the loop.
2. Figs. 6 and 7: free movements with sigma = 0; curves of all sigmas from the recorded samples.
3. The same movements with the plant's own reaction force (`reaction.py`).
4. Fig. 8: contact, and the same movement without the sheet spring.

The raw force can detect contact if a component or the norm leaves its range of the free movement.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from drake_teleop.common.arrays import Array
from drake_teleop.common.progress import Progress, Stage, show_progress
from drake_teleop.common.style import PAGE_DPI
from drake_teleop.common.writing import (
    make_folder,
    output_folder,
    write_json,
    write_picture,
    write_table,
    write_text,
)
from drake_teleop.lab.identification import (
    LoadIdentification,
    identification_scenario,
    identify_load,
    sensor_samples,
    slave_arm,
)
from drake_teleop.lab.reproduction.figures import contact_figure, scaling_figure
from drake_teleop.lab.reproduction.reaction import eliminated_reaction
from drake_teleop.lab.reproduction.report import (
    Comparison,
    ReportFigure,
    captions,
    compare_with_paper,
    flat,
    parameter_rows,
    write_report,
)
from drake_teleop.lab.reproduction.speed import MakeBarePlant, MakeMovingStation, cpu_seconds
from drake_teleop.lab.run_summary import FILTER_TAIL_S, in_contact
from drake_teleop.load.compensation import scaled_wrench
from drake_teleop.station.replay import write_replay
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.scenario_reference import write_scenario
from drake_teleop.station.simulation import simulate
from drake_teleop.station.station import MakeTeleopStation

Figures = dict[str, Any]

SIGMAS = (1.0, 0.5, 0.0)
_THRESHOLD_OVER_FREE = 1.5
# Slow motion of the replay; the contact lasts 40 ms.
_SLOW_MOTION = 8.0
_FORCE_Z, _TORQUE_X = 2, 3
_RAW_SIGNALS = ("f_x", "f_y", "f_z", "|f|")


@dataclass(frozen=True, eq=False)
class FreeMotion:
    """Free movement with its wrench for each sigma (N, 6)."""

    scenario: Scenario
    result: SimulationResult
    scaled: dict[float, Array]


@dataclass(frozen=True, eq=False)
class ContactMotion:
    """Contact transition, and the same movement without the sheet spring.

    Attributes:
        raw, calculated: (N, 6) F - F_o and contact wrench.
        contact: (N,) true contact.
        threshold: of the detection [N].
    """

    scenario: Scenario
    touched: SimulationResult
    free: SimulationResult
    raw: Array
    calculated: Array
    raw_free: Array
    calculated_free: Array
    contact: NDArray[np.bool_]
    threshold: float


def reproduce_command(
    out: Path, *, seed: int | None = None, quiet: bool = False, progress: bool = True
) -> Figures:
    """Repeat the paper's experiments; write figures, logs and a report into a folder.

    Returns:
        The summary, and the speed (not reproducible).
    """
    seed = seed or 0
    make_folder(out)  # fail early for a bad path
    with show_progress(progress and not quiet) as stage:
        # Each run has another seed.
        force, torque, contact = (
            _log_at_hand_rate(LoadScenario(name), seed + k)
            for k, name in enumerate(
                ("free_motion_force", "free_motion_torque", "contact_transition"), 1
            )
        )
        load = identify_load(identification_scenario(force, seed), stage)
        force_run = free_motion(force, load.estimate, stage("Fig. 6: vertical free motion"))
        torque_run = free_motion(torque, load.estimate, stage("Fig. 7: horizontal free motion"))
        ideal = [
            eliminated_reaction(scenario, stage(f"Fig. {number}: the same, ideal sensor"))
            for number, scenario in ((6, force), (7, torque))
        ]
        contact_run = contact_motion(contact, load.estimate, stage)
        summary = {
            "free_force": free_figures(force_run, ideal[0], _FORCE_Z, "N"),
            "free_torque": free_figures(torque_run, ideal[1], _TORQUE_X, "Nm"),
            "contact": contact_figures(contact_run),
            "identification": identification_figures(load, force),
        }
        session = {"speed": _speed(stage("Measure the speed"))}
        pictures = draw(force_run, torque_run, contact_run, summary)
        written = stage("Write figures, replay and report")
        with output_folder(out):
            _write(out, seed, summary, load, (force_run, torque_run, contact_run), pictures)
            write_json(out / "session.json", session)
            write_json(out / "summary.json", summary)
        written(1.0)
    if not quiet:
        _print(compare_with_paper(flat(summary)), out)
    return summary | session


def free_motion(scenario: Scenario, estimate: Array, progress: Progress) -> FreeMotion:
    """Run a free movement; calculate its wrench for each sigma."""
    result = _simulate(scenario, estimate, progress)
    return FreeMotion(
        scenario, result, {sigma: _scaled(result, estimate, sigma) for sigma in SIGMAS}
    )


def contact_motion(scenario: Scenario, estimate: Array, stage: Stage) -> ContactMotion:
    """Run the contact transition with and without the sheet."""
    touched = _simulate(scenario, estimate, stage("Fig. 8: contact transition"))
    without = _without_sheet(scenario)
    free = _simulate(without, estimate, stage("Fig. 8: the same without contact"))
    calculated_free = _scaled(free, estimate, 0.0)
    return ContactMotion(
        scenario=scenario,
        touched=touched,
        free=free,
        raw=_scaled(touched, estimate, 1.0),
        calculated=_scaled(touched, estimate, 0.0),
        raw_free=_scaled(free, estimate, 1.0),
        calculated_free=calculated_free,
        contact=in_contact(touched),
        threshold=_THRESHOLD_OVER_FREE * float(_force_norm(calculated_free).max()),
    )


def free_figures(run: FreeMotion, ideal: Array, component: int, unit: str) -> Figures:
    """Return the values of Figs. 6 and 7 for one component of the wrench.

    Args:
        ideal: (N, 6) from `eliminated_reaction`.
        unit: suffix of the names.
    """
    raw, half, rest = (run.scaled[sigma][:, component] for sigma in SIGMAS)
    vector = slice(0, 3) if component < 3 else slice(3, 6)
    scale = run.scenario.force_scaling.force_scale
    peak = float(np.abs(raw).max())
    return {
        f"peak_raw_{unit}": peak,
        f"peak_raw_master_{unit}": scale * peak,
        "half_ratio": _rms(half) / _rms(raw),
        f"residual_max_{unit}": float(np.abs(rest).max()),
        f"residual_rms_{unit}": _rms(rest),
        f"residual_norm_max_{unit}": _largest_norm(run.scaled[0.0][:, vector]),
        f"residual_ideal_max_{unit}": _largest_norm(ideal[:, vector]),
    }


def contact_figures(run: ContactMotion) -> Figures:
    """Return the values of Fig. 8."""
    t, force_norm = run.touched.t, _force_norm(run.calculated)
    detected = force_norm > run.threshold
    window = _contact_window(run)
    after = t > t[window][-1] if window.any() else np.zeros(len(t), dtype=bool)
    return {
        "true_s": _first_time(t, run.contact),
        "detected_s": _first_time(t, detected),
        "threshold_N": run.threshold,
        "raw_detectable": bool(raw_excess(run).max() > 0),
        "false_alarm_0_6_s": bool(detected[after].any()),
        "peak_contact_N": float(force_norm.max()),
        "peak_true_contact_N": _largest_norm(run.touched["true_contact_wrench_W"][:, :3]),
        "peak_inertial_N": _largest_norm((run.raw - run.calculated)[:, :3]),
        "duration_s": float(np.count_nonzero(run.contact) * (t[1] - t[0])),
        "largest_deflection_mm": 1e3 * float(np.abs(run.touched["sheet_state"][:, 0]).max()),
        "free_residual_norm_max_N": float(_force_norm(run.calculated_free).max()),
        "free_residual_norm_max_Nm": _largest_norm(run.calculated_free[:, 3:]),
    }


def raw_excess(run: ContactMotion) -> Array:
    """Return (4,) excess of f_x, f_y, f_z, |f| over the free range [N]."""
    touched, free = (
        np.column_stack([raw[:, :3], _force_norm(raw)])
        for raw in (run.raw[_contact_window(run)], run.raw_free)
    )
    if not len(touched):
        return np.full(len(_RAW_SIGNALS), -np.inf)
    return np.maximum(
        touched.max(axis=0) - free.max(axis=0), free.min(axis=0) - touched.min(axis=0)
    )


def identification_figures(load: LoadIdentification, scenario: Scenario) -> Figures:
    """Return errors and expected accuracy of the estimate."""
    error = load.estimate - _true_parameters(scenario)
    mass, moment = load.estimate[6], load.estimate[7:10]
    true_mass, true_moment = _true_parameters(scenario)[6], _true_parameters(scenario)[7:10]
    deviations = load.batch.standard_deviations
    return {
        "mass_kg": float(mass),
        "mass_error_percent": 100 * abs(float(error[6] / true_mass)),
        "com_error_mm": 1e3 * float(np.linalg.norm(moment / mass - true_moment / true_mass)),
        "inertia_error_max_g_m2": 1e3 * float(np.abs(error[10:]).max()),
        "offset_error_N": float(np.linalg.norm(error[:3])),
        "offset_error_Nm": float(np.linalg.norm(error[3:6])),
        "mass_std_percent": 100 * float(deviations[6] / mass),
        "recursive_against_batch_std": load.recursive_against_batch,
        "kappa_w10": load.kappa_w10,
        "duration_s": load.trajectory.period,
        "samples": load.batch.samples,
    }


def draw(
    force: FreeMotion, torque: FreeMotion, contact: ContactMotion, summary: Figures
) -> dict[str, Figure]:
    """Draw Figs. 6, 7 and 8."""
    pictures = {
        name: scaling_figure(
            run.result.t,
            [run.scaled[sigma][:, component] for sigma in SIGMAS],
            SIGMAS,
            symbol=symbol,
            unit=unit,
            downscaling=1 / run.scenario.force_scaling.force_scale,
        )
        for name, run, component, symbol, unit in (
            ("fig6", force, _FORCE_Z, "$f_z$", "N"),
            ("fig7", torque, _TORQUE_X, r"$\tau_x$", "N m"),
        )
    }
    detected = summary["contact"]["detected_s"]
    pictures["fig8"] = contact_figure(
        contact.touched.t,
        contact.raw[:, _FORCE_Z],
        contact.calculated[:, _FORCE_Z],
        symbol="$f_z$",
        contact=contact.contact,
        detected_s=math.nan if detected is None else detected,
        threshold=contact.threshold,
        turning_s=_reversal_without_contact(contact),
    )
    return pictures


def _log_at_hand_rate(scenario: Scenario, seed: int) -> Scenario:
    return replace(scenario, rates__log_hz=scenario.rates.hand_hz, simulation__seed=seed)


def _without_sheet(scenario: Scenario) -> Scenario:
    return replace(scenario, sheet_spring=None, simulation__seed=scenario.simulation.seed + 1)


def _simulate(scenario: Scenario, estimate: Array, progress: Progress) -> SimulationResult:
    station = MakeTeleopStation(scenario, load_estimate=estimate)
    return simulate(station, scenario.simulation, progress=progress)


def _true_parameters(scenario: Scenario) -> Array:
    return np.concatenate([scenario.wrist_sensor.offset, slave_arm(scenario).phi_load])


def _scaled(result: SimulationResult, estimate: Array, sigma: float) -> Array:
    wrench, s, omega, alpha = sensor_samples(result)
    return scaled_wrench(
        wrench,
        estimate[:6],
        s,
        omega,
        alpha,
        estimate[6:],
        np.zeros(10),
        sigma_gripper=sigma,
        sigma_object=sigma,
        gamma=1.0,
    )


def _speed(progress: Progress) -> Figures:
    scenario = LoadScenario("free_motion_force")
    cost = cpu_seconds(
        {"bare": MakeBarePlant(scenario), "station": MakeMovingStation(scenario)}, progress=progress
    )
    return {
        "real_time_factor": 1 / cost["station"],
        "cost_over_bare_plant": cost["station"] / cost["bare"],
    }


def _contact_window(run: ContactMotion) -> NDArray[np.bool_]:
    """Return (N,) from first contact to FILTER_TAIL_S after the last."""
    t = run.touched.t
    if not run.contact.any():
        return run.contact
    times = t[run.contact]
    return (t >= times[0]) & (t <= times[-1] + FILTER_TAIL_S)


def _reversal_without_contact(run: ContactMotion) -> float | None:
    t, force_norm = run.touched.t, _force_norm(run.raw)
    window = _contact_window(run)
    if not window.any():
        return None
    force_norm[t <= t[window][-1]] = 0.0
    return float(t[np.argmax(force_norm)])


def _force_norm(wrench: Array) -> Array:
    return np.linalg.norm(wrench[:, :3], axis=1)


def _largest_norm(vectors: Array) -> float:
    return float(np.linalg.norm(vectors, axis=1).max())


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _first_time(t: Array, happened: NDArray[np.bool_]) -> float | None:
    return float(t[np.argmax(happened)]) if happened.any() else None


def _write(
    out: Path,
    seed: int,
    summary: Figures,
    load: LoadIdentification,
    runs: tuple[FreeMotion, FreeMotion, ContactMotion],
    pictures: dict[str, Figure],
) -> None:
    force, torque, contact = runs
    make_folder(out / "logs")
    for name, result, scenario in (
        ("identification", load.result, identification_scenario(force.scenario, seed)),
        ("free_motion_force", force.result, force.scenario),
        ("free_motion_torque", torque.result, torque.scenario),
        ("contact_transition", contact.touched, contact.scenario),
        ("contact_transition_without_sheet", contact.free, _without_sheet(contact.scenario)),
    ):
        result.write_parquet(out / "logs" / f"{name}.parquet")
        write_scenario(out / "logs" / f"{name}.yaml", scenario)
    write_table(out / "logs" / "identification_sensor_log.parquet", load.result.sensor_log())
    load.identification.save(out / "identification.json")
    for name, picture in pictures.items():
        write_picture(out / f"{name}.png", picture, dpi=PAGE_DPI)
    write_replay(out / "replay.html", contact.touched, contact.scenario, slow_motion=_SLOW_MOTION)
    figures = flat(summary)
    write_text(out / "table.md", _markdown(compare_with_paper(figures)))
    write_report(
        out / "report.html",
        setup=_describe_setup(seed, force.scenario, load),
        summary=figures,
        figures=_captioned_figures(out, figures),
        parameters=parameter_rows(
            _true_parameters(force.scenario), load.estimate, load.batch.standard_deviations
        ),
        replay="replay.html",
    )


def _captioned_figures(out: Path, figures: Figures) -> list[ReportFigure]:
    titles = {
        "fig6": "Fig. 6: scaling and elimination of non-contact forces",
        "fig7": "Fig. 7: scaling and elimination of non-contact torques",
        "fig8": "Fig. 8: contact transition",
    }
    words = captions(figures)
    return [ReportFigure(title, out / f"{name}.png", words[name]) for name, title in titles.items()]


def _describe_setup(seed: int, scenario: Scenario, load: LoadIdentification) -> dict[str, str]:
    rates, scale = scenario.rates, scenario.force_scaling.force_scale
    return {
        "Seed": str(seed),
        "Rates": (
            f"wrist sensor {rates.sensor_hz:g} Hz, hand and channel {rates.hand_hz:g} Hz, joint "
            f"control {rates.joint_control_hz:g} Hz, load estimator {rates.estimator_hz:g} Hz"
        ),
        "Plant": (
            f"continuous, {scenario.simulation.integrator}, no step longer than a period of the "
            "joint control; the sensor samples inside the steps"
        ),
        "Excitation": (
            f"one period of {load.trajectory.period:g} s, {load.trajectory.rho.shape[1]} "
            f"harmonics, condition number {load.kappa_w10:.1f}"
        ),
        "Force scale": f"1/{1 / scale:g}, slave to master",
    }


def _markdown(rows: list[Comparison]) -> str:
    lines = ["| What | Paper | This run | | Accepted | Verdict |", "|---|---|---|---|---|---|"]
    lines += [
        f"| {row.what.replace('|', '&#124;')} | {row.paper} | {row.ours} | {row.origin} "
        f"| {row.accepted or '–'} | {row.verdict} |"
        for row in rows
    ]
    return "\n".join(lines) + "\n"


def _print(rows: list[Comparison], out: Path) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, pad_edge=False)
    table.add_column("What")
    table.add_column("Paper")
    table.add_column("This run", justify="right", no_wrap=True)
    table.add_column("", no_wrap=True)
    table.add_column("Verdict", no_wrap=True)
    colours = {"agrees": "green", "differs": "bold red", "": "dim"}
    for row in rows:
        verdict = f"[{colours[row.pill]}]{row.verdict}[/]"
        table.add_row(row.what, row.paper, row.ours, row.origin, verdict)
    console = Console()
    console.print(table)
    console.print(f"written to {out}; open {out / 'report.html'}", highlight=False, markup=False)
