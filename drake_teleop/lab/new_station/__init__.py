"""`drake-teleop new DIR --arm FILE --sensor-frame NAME`: creation of a station with a custom arm.

It chooses start and scales, writes a commented scenario and a picture, and runs the scenario.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import make_folder, replace_file_on_success, write_picture
from drake_teleop.lab.new_station.picture import draw_start
from drake_teleop.lab.new_station.plan import StationPlan, plan_station
from drake_teleop.lab.new_station.text import round_to_four_significant_digits, scenario_text
from drake_teleop.lab.run import run_command
from drake_teleop.station.master.data_sheets import FIGURES, LEADER_NAME, PHANTOM_NAME
from drake_teleop.station.scenario import LoadScenario
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
    """Write `station.yaml` and `start.png` into a folder, run it into `first_run`.

    Args:
        tool: model file of the tool; None: the bodies beyond the sensor, or a placeholder.
        sensor: preset of the wrist sensor; None: the default sensor.

    Returns:
        The summary of the run.

    Raises:
        DrakeTeleopError: for an unusable model, an arm that cannot point its tool down, an unknown
            name, or an existing station.
    """
    scenario = folder / "station.yaml"
    if scenario.exists():
        raise DrakeTeleopError(
            "already exists", where=str(scenario), remedy="edit it, or give another folder"
        )
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
    write_picture(picture, draw_start(plan, f"{arm.stem}, sensor frame {sensor_frame}"))
    if not quiet:
        _print_plan(plan, scenario, picture)
    return run_command(scenario, folder / "first_run", quiet=quiet)


def _relative_path(folder: Path, path: Path) -> str:
    return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()


def _print_plan(plan: StationPlan, scenario: Path, picture: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"A station: {scenario}", title_justify="left", show_header=False)
    tool = "of the model" if plan.has_own_tool else "on the sensor"
    position = round_to_four_significant_digits(plan.place.position)
    for name, value in (
        ("Joints", f"{len(plan.joint_names)}: {', '.join(plan.joint_names)}"),
        ("Tool", f"{plan.tool_mass_kg:.4g} kg, {tool}"),
        ("Start", f"sensor at {position} m, tool down"),
        ("Reachable around it", plan.place.reachable_text),
        ("Scales", f"motion {plan.translation_scale:g}, force {plan.force_scale:g}"),
    ):
        table.add_row(name, value)
    console = Console()
    console.print(table)
    notes = [f"note: {plan.tool_axis_advice}"] if plan.tool_axis_advice else []
    notes += [f"assumed: {assumed}" for assumed in plan.assumptions]
    notes += [f"warning: {overlap}" for overlap in plan.overlap_warnings]
    notes += [f"picture of the start: {picture}"]
    for line in (*notes, "the first run takes about a minute on an idle computer"):
        console.print(line, highlight=False, markup=False, soft_wrap=True)
