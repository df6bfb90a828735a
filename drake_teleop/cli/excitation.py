"""`drake-teleop excite`: an excitation trajectory for the station's slave or another arm."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drake_teleop.cli.options import refuse_without_model
from drake_teleop.common import files
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.progress import show_progress
from drake_teleop.common.style import BLACK, BLUE, COLOURS, GREY, Picture, plot_style
from drake_teleop.lab.excitation import shortest
from drake_teleop.lab.excitation.check import CHECK_RATE_HZ
from drake_teleop.lab.excitation.excite import Excitation, excite, trajectory_sensor_motion
from drake_teleop.lab.excitation.motion_replay import write_motion_replay
from drake_teleop.lab.excitation.robot import RobotFromModel, RobotFromScenario
from drake_teleop.load.identification import PARAMETER_NAMES, PARAMETER_UNITS
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.load.tolerance import parse_tolerance
from drake_teleop.station.scenario import LoadScenario

#: Meaning of each printed criterion.
CRITERION_TEXTS = {
    "kappa_w10": "condition number, ten columns, rows whitened, columns scaled by L = {L:.3g} m",
    "kappa10": "condition number, ten columns, plain V in SI units",
    "kappa16": "condition number, sixteen columns with offsets, SI units",
    "A16": "rms of predicted errors over acceptable ones",
    "D16": "geometric mean of predicted errors over acceptable ones",
}


def excite_command(
    scenario: str | Path,
    out: Path,
    *,
    model: Path | None = None,
    sensor_frame: str | None = None,
    package_paths: tuple[Path, ...] = (),
    acceleration: tuple[float, ...] = (),
    payload: float | None = None,
    until: str | None = None,
    criterion: str = "kappa_w10",
    period: float = 6.0,
    harmonics: int | None = None,
    seconds: float | None = None,
    seed: int = 0,
    quiet: bool = False,
    progress: bool = True,
) -> dict[str, Any]:
    """Design, check and write an excitation trajectory; return its results.

    Args:
        model: model file of another arm with the scenario's sensor; None: the scenario's arm.
        sensor_frame: name of the sensor's frame, required with `model`.
        until: required accuracy of the load; replaces criterion, period [s] and CPU time `seconds`.
        quiet: True hides progress bars and tables; `progress` False hides only the bars.
    """
    tolerance = None if until is None else parse_tolerance(until)
    setup = LoadScenario(scenario)
    files.make_folder(out)  # fail early for a bad path
    with show_progress(progress and not quiet) as stage:
        read = stage("Read the robot")
        if model is None:
            refuse_without_model({
                "--sensor-frame": sensor_frame, "--package-path": package_paths,
                "--acceleration": acceleration, "--payload": payload,
            })  # fmt: skip
            robot = RobotFromScenario(setup)
        elif sensor_frame is None:
            what = "is required with --model, which does not contain the sensor's position"
            remedy = "name the frame or link at which the sensor measures"
            raise DrakeTeleopError(what, where="--sensor-frame", remedy=remedy)
        else:
            robot = RobotFromModel(
                model,
                sensor_frame,
                setup.wrist_sensor,
                estimation=setup.motion_estimation,
                sensor_hz=setup.rates.sensor_hz,
                package_paths=package_paths,
                acceleration=acceleration,
                payload=payload,
            )
        read(1.0)
        reached: dict[str, Any] = {}
        if tolerance is None:
            found = excite(
                robot,
                criterion=criterion,
                period=period,
                harmonics=5 if harmonics is None else harmonics,
                seed=seed,
                seconds=seconds,
                progress=stage,
            )
        else:
            report = stage("Shorten the motion")
            result = shortest.design_shortest_motion(
                robot,
                tolerance,
                harmonics=3 if harmonics is None else harmonics,
                seed=seed,
                progress=lambda done, best: report(done, f"{best:.3g} s" if best < np.inf else ""),
            )
            report(1.0)
            found = result.excitation
            names, shares = tolerance.required_entry_names, result.errors_over_tolerances.tolist()
            reached = {"until": str(tolerance), "reached": dict(zip(names, shares, strict=True))}
            reached |= {"reliable": shortest.PROBABILITY_ALL_WITHIN_TOLERANCE}
    summary = summarize_excitation(found) | reached | {"seed": seed}
    session = {"design_s": found.design_cpu_time_s}
    with files.output_folder(out):
        files.write_table(out / "trajectory.csv", trajectory_table(found))
        found.trajectory.save(out / "excitation.yaml", robot.arm.joint_names)
        files.write_picture(out / "excitation.png", draw_trajectory(found))
        write_motion_replay(out / "excitation.html", found)
        files.write_json(out / "session.json", session)
        files.write_json(out / "summary.json", summary)
    if not quiet:
        _print_summary(summary, out)
    return summary | session


def summarize_excitation(excitation: Excitation) -> dict[str, Any]:
    robot, trajectory = excitation.robot, excitation.trajectory
    names = [name.replace(" c_", "_c") for name in PARAMETER_NAMES]
    return {
        "robot": robot.name,
        "criterion": excitation.criterion,
        **excitation.values,
        "meaning": {
            name: CRITERION_TEXTS[name].format(L=robot.criterion_scales.length)
            for name in excitation.values
        },
        "period_s": trajectory.period,
        "harmonics": trajectory.rho.shape[1],
        "limit_use": {
            use.limit_name: {"share": use.used_share, "where": use.where, "t": use.time_s}
            for use in excitation.limit_uses
        },
        "predicted_std": {
            f"{name} [{unit}]": float(std)
            for name, unit, std in zip(names, PARAMETER_UNITS, excitation.deviations, strict=True)
        },
        "noise": {
            "force [N]": robot.criterion_scales.wrench_noise[0],
            "torque [N m]": robot.criterion_scales.wrench_noise[1],
        },
        "heaviest_load_kg": float(robot.limits.heaviest_phi[0]),
        "assumed": list(robot.assumptions),
    }


def trajectory_table(excitation: Excitation) -> pl.DataFrame:
    """Return the table of trajectory.csv: joint motion at 1 kHz from 0 to the period, inclusive."""
    period = excitation.trajectory.period
    t = np.linspace(0, period, round(period * CHECK_RATE_HZ) + 1)
    columns = {"t": t}
    joints = excitation.trajectory.evaluate(t)
    for symbol, values in zip(("q", "qd", "qdd"), joints, strict=True):
        for name, of_joint in zip(excitation.robot.arm.joint_names, values.T, strict=True):
            columns[f"{symbol}_{name}"] = of_joint
    return pl.DataFrame(columns)


def draw_trajectory(excitation: Excitation) -> Figure:
    with plot_style():
        figure = Picture(figsize=(9, 8))
        joints, forces, torques, progress = figure.subplots(4, 1, height_ratios=(3, 2, 2, 2))
        _draw_joint_angles(joints, excitation)
        _draw_heaviest_load_wrench(forces, torques, excitation)
        progress.step(*excitation.criterion_history.T, where="post", color=BLUE)
        # With --until, the criterion is the period.
        least = excitation.values.get(excitation.criterion, excitation.trajectory.period)
        progress.set_title(f"Criterion {excitation.criterion}: least value {least:.4g}")
        progress.set(xlabel="evaluations", yscale="log")
    return figure


def _draw_joint_angles(axes: Axes, excitation: Excitation) -> None:
    period = excitation.trajectory.period
    t = np.linspace(0, period, 1000)
    q = np.degrees(excitation.trajectory.evaluate(t)[0])
    for k, name in enumerate(excitation.robot.arm.joint_names):
        colour, style = COLOURS[k % len(COLOURS)], ("-", "--")[k // len(COLOURS) % 2]
        axes.plot(t, q[:, k], style, color=colour, label=name)
    axes.set(title=f"Joint angles of {excitation.robot.name} [deg]", xlim=(0, period))
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))


def _draw_heaviest_load_wrench(force_axes: Axes, torque_axes: Axes, excitation: Excitation) -> None:
    limits = excitation.robot.limits
    s, omega, alpha = trajectory_sensor_motion(excitation.robot, excitation.trajectory)
    wrench = non_contact_wrench(s, omega, alpha, limits.heaviest_phi)
    t = np.arange(len(wrench)) / CHECK_RATE_HZ
    for axes, part, limit, unit in (
        (force_axes, wrench[:, :3], limits.max_sensor_norms[0], "N"),
        (torque_axes, wrench[:, 3:], limits.max_sensor_norms[1], "N m"),
    ):
        axes.plot(t, part, linewidth=0.9, label=list("xyz"))
        axes.plot(t, np.linalg.norm(part, axis=1), color=GREY, label="norm")
        axes.axhline(limit, color=BLACK, linestyle=":", label="limit")
        title = f"{'Force' if unit == 'N' else 'Torque'} at the sensor, heaviest load [{unit}]"
        axes.set(title=title, xlim=(0, excitation.trajectory.period))
    force_axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    torque_axes.set_xlabel("t [s]")


def _print_summary(summary: dict[str, Any], out: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    show = partial(console.print, highlight=False, markup=False)
    values = Table("criterion", "value", "meaning")
    for name, meaning in summary["meaning"].items():
        marked = f"[bold]{name}[/]" if name == summary["criterion"] else name
        values.add_row(marked, f"{summary[name]:.4g}", meaning)
    uses = Table("limit, checked at 1 kHz", "use", "where", r"t \[s]")
    for name, use in summary["limit_use"].items():
        uses.add_row(name, f"{use['share']:.1%}", use["where"], f"{use['t']:.3f}")
    deviations = Table("parameter", "predicted standard deviation")
    for name, value in summary["predicted_std"].items():
        deviations.add_row(name.replace("[", r"\["), f"{value:.2g}")
    for part in (values, uses, deviations):
        console.print(part)
    if "until" in summary:
        show(
            f"a motion of {summary['period_s']:.3g} s reaches {summary['until']}"
            f" in {summary['reliable']:.0%} of the records, if only sensor noise disturbs them"
        )
    for words in summary["assumed"]:
        show(f"assumed: {words}")
    show(f"written to {out}; watch {out / 'excitation.html'} before a robot runs it")
