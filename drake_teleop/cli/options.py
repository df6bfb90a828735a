"""Parameter types, and options that several commands share."""

from __future__ import annotations

import math
import os
import re
import sys
from collections.abc import Callable
from functools import partial, wraps
from inspect import cleandoc
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from drake_teleop.common.config import shorten_value
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import scenarios_dir, studies_dir
from drake_teleop.common.registry import REGISTRIES


class Utf8Path(click.Path):
    """Parameter type of paths; rejects empty paths and names that are not UTF-8."""

    def convert(self, value: Any, param: Any, ctx: Any) -> Any:
        path = super().convert(value, param, ctx)
        if value == "":  # a variable of the shell without value, not the working directory
            self.fail("the path is empty", param, ctx)
        try:
            str(path).encode()
        except UnicodeEncodeError:
            self.fail(f"{click.format_filename(path)!r} is not a UTF-8 name", param, ctx)
        return path


class ShippedOrPath(Utf8Path):
    """Parameter type: name of a shipped file, or path; the shell completes both."""

    def __init__(self, folder: Path, path_type: type) -> None:
        super().__init__(path_type=path_type)
        self._folder = folder

    def shell_complete(self, ctx: Any, param: Any, incomplete: str) -> list[CompletionItem]:
        names = sorted(path.stem for path in self._folder.glob("*.yaml"))
        fitting = [CompletionItem(name) for name in names if name.startswith(incomplete)]
        return fitting + super().shell_complete(ctx, param, incomplete)


UTF8_PATH_TYPE = Utf8Path(path_type=Path)
SCENARIO_NAME_OR_PATH_TYPE = ShippedOrPath(scenarios_dir(), str)
STUDY_NAME_OR_PATH_TYPE = ShippedOrPath(studies_dir(), Path)
path_option = partial(click.option, type=UTF8_PATH_TYPE)


HELP_SETTINGS = dict(help_option_names=["-h", "--help"], max_content_width=100, show_default=True)


_SHARED_OPTION_HELP = """
    --cluster: Dask scheduler that runs the processes; local: start one on this machine.
    --cutoff: Cutoff of the low-pass on all signals; zero-phase for logs, causal for live streams.
    --delay: Delay of the motion behind the wrench [s], or auto to estimate it.
    --free: Log of free motion with this load, for the threshold of contact.  [default: quiet parts
        of LOG]
    --gamma: Scale of the contact wrench.
    --gripper: identification.json of the gripper without the object, in the same sensor frame.
    --jobs: Number of parallel processes.  [default: one for each core]
    --load: identification.json of the load.
    --model: Model of the arm (URDF, SDF, MJCF); required if SOURCE contains joint angles, no poses.
    --motion: Source of the motion, if not SOURCE; same forms.
    --out: Output folder.
    --package-path: Folder to search for package:// files of the model; may be repeated.
    --quiet: Print no progress bars and no tables.
    --range: Range of the sensor, force [N] and torque [N m]; readings at its limits are not used.
    --real-time: Replay a log at its recorded speed.
    --seed: Seed of noise.  [default: the scenario's]
    --sensor-frame: Frame or link of the model at which the wrist sensor measures.
    --sensor-pose: Pose of the sensor in the frame of the streamed poses [m, deg].
    --sigma-inertia: Scale of the load's inertia alone.  [default: value of --sigma]
    --sigma-weight: Scale of the load's weight alone.  [default: value of --sigma]
    --yes: Start more than 100,000 runs without a question."""


def _parse_option_help(text: str) -> dict[str, str]:
    found = re.findall(r"^ {4}(--[\w-]+): ((?:.|\n {8})+)", text, re.M)
    return {name: meaning.replace("\n" + " " * 8, " ") for name, meaning in found}


class DocumentedCommand(click.Command):
    """Command that reads the help of its own options from `Options:` at the docstring's end."""

    def __init__(self, name: str | None, *, help: str | None = None, **settings: Any) -> None:
        text, _, listed = cleandoc(help or "").partition("\n\nOptions:")
        super().__init__(name, help=text, **settings)
        texts = _parse_option_help(_SHARED_OPTION_HELP) | _parse_option_help(listed)
        for each in self.params:
            if isinstance(each, click.Option):
                each.help = each.help or texts.get(each.opts[0])  # `python -OO` has no docstrings


class CommandGroup(click.Group):
    """Group whose decorator `command` makes a `DocumentedCommand`."""

    command_class = DocumentedCommand


class FiniteNumber(click.FloatRange):
    """Parameter type of finite numbers in a range; click's type accepts nan and inf."""

    name, _type_without_range = "number", click.FLOAT

    def convert(self: Any, value: Any, param: Any, ctx: Any) -> Any:
        number, low, high = self._type_without_range.convert(value, param, ctx), self.min, self.max
        if isinstance(number, float) and not math.isfinite(number):
            self.fail(f"{value} is not a finite number", param, ctx)
        if not low <= number <= high:
            limits = f"{shorten_value(low)} to {shorten_value(high)}"
            self.fail(f"{shorten_value(number)} is outside {limits}", param, ctx)
        if self.min_open and number == low:
            self.fail(f"{shorten_value(number)} is not above {shorten_value(low)}", param, ctx)
        return number


class IntegerInRange(click.IntRange):
    """Parameter type of integers in a range."""

    name, _type_without_range, convert = "integer", click.INT, FiniteNumber.convert


def float_option(
    *names: str, limits: tuple[float, float], excludes_min: bool = False, **settings: Any
) -> Any:
    return click.option(*names, type=FiniteNumber(*limits, min_open=excludes_min), **settings)


def int_option(name: str, limits: tuple[int, int], **settings: Any) -> Any:
    return click.option(name, type=IntegerInRange(*limits), **settings)


def choice_option(name: str, choices: list[str], default: str) -> Any:
    return click.option(name, type=click.Choice(choices), default=default)


class DelayOrAuto(click.ParamType):
    """Parameter type of a delay: seconds from -10 to 10, or "auto"."""

    name = "auto|SECONDS"

    def convert(self, value: Any, param: Any, ctx: Any) -> float | str:
        return "auto" if value == "auto" else FiniteNumber(-10, 10).convert(value, param, ctx)


FORCE_SCALE_TYPE = FiniteNumber(0, 100)
POSITIVE_TYPE = FiniteNumber(0, 1e5, min_open=True)


class CommaSeparated(click.ParamType):
    """Parameter type of values of type `item`, separated by commas."""

    def __init__(self, name: str, item: click.ParamType) -> None:
        self.name, self._item = f"{name},...", item

    def convert(self, value: Any, param: Any, ctx: Any) -> tuple[Any, ...]:
        if isinstance(value, tuple):
            return value
        return tuple(self._item.convert(part.strip(), param, ctx) for part in value.split(","))


NAME_LIST_TYPE = CommaSeparated("NAME", click.STRING)
POSITIVE_NUMBER_LIST_TYPE = CommaSeparated("number", POSITIVE_TYPE)


class RegisteredName(click.Choice):
    """Type of an option that takes a `shipped` name or one that the user registers as `kind`."""

    def __init__(self, kind: str, *shipped: str) -> None:
        super().__init__(shipped)
        self._shipped, self._kind = shipped, kind

    @property
    def choices(self) -> tuple[str, ...]:
        table = REGISTRIES.get(self._kind)
        new = () if table is None else (name for name in table if name not in table.shipped)
        return (*self._shipped, *new)

    @choices.setter
    def choices(self, value: tuple[str, ...]) -> None: ...


def output_folder(command_name: str) -> Callable[[Any], Any]:
    """Return a decorator for `--out DIR`; new folders that remain empty are removed at the end."""
    return click.option(
        "--out",
        type=UTF8_PATH_TYPE,
        default=Path("out") / command_name,
        metavar="DIR",
        callback=_schedule_empty_folder_removal,
    )


def _schedule_empty_folder_removal(ctx: click.Context, _: click.Parameter, folder: Path) -> Path:
    new = [each for each in (folder, *folder.parents) if not os.path.exists(each)]
    if new:
        ctx.call_on_close(lambda: _remove_empty_folders(new))
    return folder


def _remove_empty_folders(new_folders: list[Path]) -> None:
    inner = sorted(new_folders[0].rglob("*"), reverse=True)
    for folder in (*inner, *new_folders):
        if folder.is_symlink() or not folder.is_dir():
            return
        try:
            folder.rmdir()
        except OSError:  # it is not empty
            return


jobs_option = click.option(
    "--jobs", type=IntegerInRange(1, 4096), callback=lambda _ctx, _param, count: count or -1
)
seed_option = partial(click.option, "--seed", type=IntegerInRange(0, 2**32 - 1))
seed_with_default_0_option = seed_option(default=0, help="Random seed.")
dask_cluster_option = click.option("--cluster", metavar="ADDRESS")
quiet_option = click.option("--quiet", is_flag=True)
cutoff_option = click.option(
    "--cutoff", "cutoff_hz", type=POSITIVE_TYPE, default=30.0, metavar="HZ"
)
rate_option = partial(click.option, "--rate", "rate_hz", type=POSITIVE_TYPE, metavar="HZ")
range_option = click.option("--range", "sensor_range", type=POSITIVE_TYPE, nargs=2, metavar="N NM")
delay_option = click.option("--delay", type=DelayOrAuto(), default="auto")
sigma_option = click.option("--sigma", type=FORCE_SCALE_TYPE, default=0.0)
gamma_option = click.option("--gamma", type=FORCE_SCALE_TYPE, default=1.0)
load_file_option = partial(path_option, "--load")
gripper_file_option = path_option("--gripper")
free_motion_log_option = path_option("--free", metavar="LOG")
package_path_option = path_option("--package-path", "package_paths", multiple=True, metavar="DIR")
sensor_frame_option = partial(click.option, "--sensor-frame", metavar="NAME")
sensor_pose_option = click.option(
    "--sensor-pose", nargs=6, type=FiniteNumber(-1e3, 1e3), metavar="X Y Z ROLL PITCH YAW"
)


def refuse_given_options(*names: str, remedy: str) -> None:
    """Raise DrakeTeleopError if the user gave one of these options, which have no effect here."""
    context = click.get_current_context()
    for parameter in context.command.params:
        source = context.get_parameter_source(str(parameter.name))
        if parameter.name in names and source is click.core.ParameterSource.COMMANDLINE:
            raise DrakeTeleopError("has no effect here", where=parameter.opts[0], remedy=remedy)


def refuse_without_model(options: dict[str, object]) -> None:
    """Raise DrakeTeleopError if one of these options, name -> value, is given without --model."""
    for name, value in options.items():
        if value not in (None, ()):
            remedy = f"add --model or remove {name}"
            raise DrakeTeleopError("requires --model", where=name, remedy=remedy)


def confirm_at_terminal(question: str) -> bool:
    """Ask a question; return True for yes, False for no or without a terminal."""
    return sys.stdin.isatty() and click.confirm(question, err=True)


skip_run_count_question_option = click.option(
    "--yes", is_flag=True, callback=lambda _ctx, _param, is_set: is_set or confirm_at_terminal
)


def sigma_weight_and_inertia_options(command: Any) -> Any:
    for part in ("inertia", "weight"):
        command = click.option(f"--sigma-{part}", type=FORCE_SCALE_TYPE)(command)
    return command


def stream_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of a live SOURCE to a command, which gets the arm of --model as `arm`."""

    @wraps(command)
    def call_with_arm(
        *arguments: Any,
        model: Path | None,
        sensor_frame: str | None,
        package_paths: tuple[Path, ...],
        **options: Any,
    ) -> Any:
        arm = _read_arm_kinematics_from_options(model, sensor_frame, package_paths)
        return command(*arguments, arm=arm, **options)

    decorated: Callable[..., Any] = call_with_arm
    for option in (
        delay_option,
        cutoff_option,
        click.option("--real-time", is_flag=True),
        range_option,
        sensor_pose_option,
        package_path_option,
        sensor_frame_option(),
        path_option("--model"),
        click.option("--motion", metavar="SOURCE"),
    ):
        decorated = option(decorated)
    return decorated


def _read_arm_kinematics_from_options(
    model: Path | None, sensor_frame: str | None, package_paths: tuple[Path, ...]
) -> Any:
    if model is None:
        refuse_without_model({"--sensor-frame": sensor_frame, "--package-path": package_paths})
        return None
    if sensor_frame is None:
        remedy = "name the frame or link at which the sensor measures"
        raise DrakeTeleopError("is required with --model", where="--sensor-frame", remedy=remedy)
    from drake_teleop.station.slave.plant import read_arm_without_default_limits

    return read_arm_without_default_limits(model, sensor_frame, package_paths)
