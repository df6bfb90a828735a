"""`drake-teleop new DIR --arm FILE --sensor-frame NAME`: creation of a station with a custom arm.

The command chooses start and scales, writes a commented scenario and a picture, and runs it.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import make_folder, replace_file_on_success, write_picture
from drake_teleop.common.texts import to_yaml_text
from drake_teleop.lab.new_station.picture import draw_start_posture
from drake_teleop.lab.new_station.plan import (
    SWING_HZ,
    StationPlan,
    plan_station,
    round_to_four_significant_digits,
)
from drake_teleop.lab.run import run_command
from drake_teleop.station.environment.solids import Wall
from drake_teleop.station.master.data_sheets import FIGURES, LEADER_NAME, PHANTOM_NAME, Master
from drake_teleop.station.scenario import LoadScenario, Rates
from drake_teleop.station.sensor.presets import PRESETS


def new_command(
    folder: Path,
    arm: Path,
    sensor_frame: str,
    *,
    package_paths: tuple[Path, ...] = (),
    tool: Path | None = None,
    device: str = PHANTOM_NAME,
    sensor: str | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Write `station.yaml` and `start.png` into `folder`, run the station, return its summary.

    Args:
        package_paths: folders for package:// paths in model files.
        tool: model file of the tool; None: the bodies beyond the sensor, or a rod with a ball.
        sensor: preset of the wrist sensor; None: the default sensor.
    """
    scenario = folder / "station.yaml"
    if scenario.exists():
        remedy = "edit it, or give another folder"
        raise DrakeTeleopError("already exists", where=str(scenario), remedy=remedy)
    for kind, name, known in (
        ("device", device, (PHANTOM_NAME, *FIGURES)),
        ("sensor", sensor, (None, *PRESETS)),
    ):
        if name not in known:
            remedy = f"choose one of {', '.join(filter(None, known))}"
            if name == LEADER_NAME:
                remedy += "; add a leader arm to station.yaml afterwards, as master.leader"
            raise DrakeTeleopError(f"there is no {kind} {name!r}", where=f"--{kind}", remedy=remedy)
    plan = plan_station(arm, sensor_frame, package_paths, tool, device)
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    make_folder(folder)
    slave_data: dict[str, Any] = {"model": _relative_path(folder, arm)}
    if package_paths:
        slave_data["package_paths"] = [_relative_path(folder, path) for path in package_paths]
    slave_data["sensor_frame"] = sensor_frame
    tool_path = None if tool is None else _relative_path(folder, tool)
    try:
        text = scenario_text(plan, slave_data, tool_path, device, sensor)
        with replace_file_on_success(scenario) as unfinished:
            unfinished.write_text(text, encoding="utf-8")
            slave = LoadScenario(unfinished).slave
            read = [slave.path, *slave.package_folders]
            read += [slave.tool.path] if tool and slave.tool else []
            given = [path.resolve() for path in (arm, *package_paths, *([tool] if tool else ()))]
            if read != given or slave.sensor_frame != sensor_frame:
                what = "does not describe the given models, whose names YAML cannot contain"
                remedy = "use simpler names of files and frames"
                raise DrakeTeleopError(what, where=str(scenario), remedy=remedy)
    except BaseException:
        for each in made:
            with suppress(OSError):
                each.rmdir()
        raise
    picture = folder / "start.png"
    write_picture(picture, draw_start_posture(plan, f"{arm.stem}, sensor frame {sensor_frame}"))
    if not quiet:
        _print_plan(plan, scenario, picture)
    return run_command(scenario, folder / "first_run", quiet=quiet)


def scenario_text(
    plan: StationPlan, slave: dict[str, Any], tool: str | None, device: str, sensor: str | None
) -> str:
    """Return the commented scenario as YAML; `slave`: its model, package_paths and sensor_frame."""
    s, swing, place = plan.translation_scale, plan.swing_amplitude_m, plan.place
    down = 1.5 * swing + min(0.01, swing / 4.0)  # at most 10 mm into the wall
    if place.is_set_by_position:
        slave["position"] = round_to_four_significant_digits(place.position)
    else:
        slave["home"] = place.home
    comments = {
        "slave.position": f"sensor at the start, {plan.direction_at_start} [m]",
        "slave.home": f"joints at the start, {plan.direction_at_start} [rad, m]",
        "slave.tip": "contact point, p_STip [m]",
        "slave.torque_limits": "the limits of the model cannot hold the arm",
        "kinematic_scaling": f"the arm can move {place.reachable_text}",
        "force_scaling": "sigma 1 displays the whole load of the tool; force_scale: see analyze",
        "operator.intent": "hand motion: up and down, then down onto the wall",
        "rates": "rates of the device",
    }
    if tool is not None:
        slave["tool"] = {"model": tool}
    elif plan.stand_in_tool is None:
        slave["tool"], comments["slave.tool"] = None, "the bodies of the model beyond the sensor"
    else:
        slave["tool"] = {"mass": plan.stand_in_tool.mass, "com": plan.stand_in_tool.com}
        slave["tool"] |= {"shapes": [{"_tag": "!Ball"} | vars(plan.stand_in_tool.shapes[0])]}
        comments["slave.tool"] = "a stand-in: write the model file or the numbers of your tool here"
    if plan.weak_joints:
        slave["torque_limits"] = dict.fromkeys(plan.weak_joints, float("inf"))
    if plan.tip_S:
        slave["tip"] = round_to_four_significant_digits(plan.tip_S)
    up, press = (round_to_four_significant_digits([0.0, 0.0, z / s]) for z in (swing, -down))
    swing_motion = {"_tag": "!Sine", "t_start": 0.2, "duration": 2.6, "ramp": 0.5}
    swing_motion |= {"frequency": SWING_HZ, "translation": up}
    press_motion = {"_tag": "!MinimumJerk", "t_start": 3.2, "duration": 1.2, "translation": press}
    wall = plan.wall
    wall_data = {"_tag": "!Wall", "position": wall.position, "stiffness": wall.stiffness}
    wall_data |= {} if wall.size == Wall().size else {"size": wall.size}
    own = Master(model=device).sampling_period_if_slower_than_hand(Rates().hand_hz)
    names = ("hand_hz", "joint_control_hz")
    rates = {} if own is None else {"rates": dict.fromkeys(names, 1 / own)}
    data = {
        "description": f"{Path(slave['model']).stem} commanded by {device}",
        "simulation": {"duration": 5.0, "settle": 0.8},
        **rates,
        "slave": slave,
        "master": {"model": device},
        **({"wrist_sensor": {"preset": sensor}} if sensor else {}),
        "kinematic_scaling": {"translation_scale": s},
        "force_scaling": {"sigma": 0.0, "force_scale": plan.force_scale},
        "environment": [wall_data],
        "operator": {"grip": "medium", "intent": [swing_motion, press_motion]},
    }
    head = "Made by drake-teleop new. All fields and defaults: drake-teleop scenario station.yaml"
    return to_yaml_text(data, head=[head], comments=comments)


def _relative_path(folder: Path, path: Path) -> str:
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()


def _print_plan(plan: StationPlan, scenario: Path, picture: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"New station: {scenario}", title_justify="left", show_header=False)
    tool = "of the model" if plan.has_own_tool else "on the sensor"
    joint_names = plan.posture_shapes.arm.joint_names
    position = round_to_four_significant_digits(plan.place.position)
    for name, value in (
        ("Joints", f"{len(joint_names)}: {', '.join(joint_names)}"),
        ("Tool", f"{plan.tool_mass_kg:.4g} kg, {tool}"),
        ("Start", f"sensor at {position} m, {plan.direction_at_start}"),
        ("Reachable from there", plan.place.reachable_text),
        ("Scales", f"motion {plan.translation_scale:g}, force {plan.force_scale:g}"),
    ):
        table.add_row(name, value)
    console = Console()
    console.print(table)
    notes = [f"note: {plan.tool_axis_advice}"] if plan.tool_axis_advice else []
    notes += [f"assumed: {assumed}" for assumed in plan.assumptions]
    notes += [f"warning: {overlap}" for overlap in plan.overlap_warnings]
    notes += [f"picture of the start: {picture}"]
    for line in (*notes, "the first run takes one to two minutes on an idle computer"):
        console.print(line, highlight=False, markup=False, soft_wrap=True)
