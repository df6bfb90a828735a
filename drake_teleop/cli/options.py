"""Parameter types and options that commands have in common."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.quantities import in_short
from drake_teleop.common.resources import scenarios_dir, studies_dir


class Named(click.Path):
    """Path whose name is UTF-8, which all libraries accept."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the path, or fail with one line."""
        path = super().convert(value, param, ctx)
        try:
            str(path).encode()
        except UnicodeEncodeError:
            self.fail(f"{click.format_filename(path)!r} is no name in UTF-8", param, ctx)
        return path


class Shipped(Named):
    """Name of a shipped file, or a path; the shell completes both."""

    def __init__(self, folder: Path, path_type: type) -> None:
        super().__init__(path_type=path_type)
        self._folder = folder

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Return the completions of an incomplete word."""
        names = sorted(path.stem for path in self._folder.glob("*.yaml"))
        fitting = [CompletionItem(name) for name in names if name.startswith(incomplete)]
        return fitting + super().shell_complete(ctx, param, incomplete)


PATH = Named(path_type=Path)
SCENARIO = Shipped(scenarios_dir(), str)
STUDY = Shipped(studies_dir(), Path)


def _check_range(
    kind: click.FloatRange | click.IntRange,
    number: float,
    param: click.Parameter | None,
    ctx: click.Context | None,
) -> None:
    """Fail with words for a number out of range; click writes `x>=0`."""
    low, high = kind.min, kind.max
    if high is not None and not (low or 0) <= number <= high:
        text = f"{in_short(number)} is outside {in_short(low or 0)} to {in_short(high)}"
        kind.fail(text, param, ctx)
    if low is not None and (number < low or (kind.min_open and number == low)):
        relation = "not above" if kind.min_open else "below"
        kind.fail(f"{in_short(number)} is {relation} {in_short(low)}", param, ctx)


class Number(click.FloatRange):
    """Finite number in a range; click's type accepts nan and inf."""

    name = "number"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Return the number, or fail with one line."""
        number: float = click.FLOAT.convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number", param, ctx)
        _check_range(self, number, param, ctx)
        return number


class Whole(click.IntRange):
    """Integer in a range."""

    name = "integer"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Return the number, or fail with one line."""
        number: int = click.INT.convert(value, param, ctx)
        _check_range(self, number, param, ctx)
        return number


class Delay(click.ParamType):
    """Seconds, or "auto"."""

    name = "auto|SECONDS"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float | str:
        """Return the number or "auto", or fail with one line."""
        return "auto" if value == "auto" else Number(-10, 10).convert(value, param, ctx)


def out(command: str) -> Callable[[Any], Any]:
    """Return the option `--out DIR`; a command that fails leaves no empty folder there."""
    return click.option(
        "--out",
        type=PATH,
        default=Path("out") / command,
        show_default=True,
        metavar="DIR",
        callback=_not_left_empty,
    )


def _not_left_empty(ctx: click.Context, _: click.Parameter, folder: Path) -> Path:
    new = [each for each in (folder, *folder.parents) if not os.path.exists(each)]
    if new:
        ctx.call_on_close(lambda: _remove_empty(new))
    return folder


def _remove_empty(new: list[Path]) -> None:
    """Remove the folders if they contain only empty folders, innermost first."""
    inner = sorted(new[0].rglob("*"), reverse=True)
    for folder in (*inner, *new):
        if folder.is_symlink() or not folder.is_dir():
            return
        try:
            folder.rmdir()
        except OSError:  # it is not empty
            return


_SEED = Whole(0, 2**32 - 1)
seed = click.option("--seed", type=_SEED, help="Instead of the scenario's seed.")
seed_0 = click.option("--seed", type=_SEED, default=0, show_default=True)
jobs = click.option(
    "--jobs", type=Whole(1, 4096), help="Processes at once.  [default: one for each core]"
)
quiet = click.option("--quiet", is_flag=True, help="No progress bars, no tables.")
cutoff = click.option(
    "--cutoff",
    "cutoff_hz",
    type=Number(0, 1e5, min_open=True),
    default=30.0,
    show_default=True,
    metavar="HZ",
    help="Zero-phase low-pass on all signals.",
)
delay = click.option(
    "--delay",
    type=Delay(),
    default="auto",
    show_default=True,
    help="Motion behind the wrench, in seconds, or estimated.",
)


def stream(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of a live SOURCE; those of the model become the argument `arm`."""

    @wraps(command)
    def with_arm(
        *arguments: Any,
        model: Path | None,
        sensor_frame: str | None,
        package_paths: tuple[Path, ...],
        **options: Any,
    ) -> Any:
        arm = _arm(model, sensor_frame, package_paths)
        return command(*arguments, arm=arm, **options)

    decorated: Callable[..., Any] = with_arm
    for option in (
        delay,
        cutoff,
        click.option("--real-time", is_flag=True, help="Replay a log in its own time."),
        click.option(
            "--range",
            "largest",
            type=Number(0, 1e5, min_open=True),
            nargs=2,
            metavar="N NM",
            help="Of the sensor: what is at its ends is not used, and nothing above it goes out.",
        ),
        click.option(
            "--sensor-pose",
            nargs=6,
            type=Number(-1e3, 1e3),
            metavar="X Y Z ROLL PITCH YAW",
            help="Of the sensor in the frame whose poses come [m, deg].",
        ),
        click.option(
            "--package-path",
            "package_paths",
            type=PATH,
            multiple=True,
            metavar="DIR",
            help="Where package:// addresses of the model are looked up; may be repeated.",
        ),
        click.option("--sensor-frame", metavar="NAME", help="Its frame or link with the sensor."),
        click.option(
            "--model", type=PATH, help="The arm, if its joints tell the motion: URDF, SDF, MJCF."
        ),
        click.option("--motion", metavar="SOURCE", help="Who tells the motion, if not SOURCE."),
    ):
        decorated = option(decorated)
    return decorated


def _arm(model: Path | None, sensor_frame: str | None, package_paths: tuple[Path, ...]) -> Any:
    if model is None:
        if sensor_frame is not None or package_paths:
            name = "--package-path" if sensor_frame is None else "--sensor-frame"
            raise DrakeTeleopError("needs --model", where=name)
        return None
    if sensor_frame is None:
        raise DrakeTeleopError(
            "the model does not say where the sensor is",
            where="--sensor-frame",
            remedy="name the frame or link at which it measures",
        )
    from drake_teleop.station.slave.joint_poses import arm_of

    return arm_of(model, sensor_frame, package_paths)


gripper = click.option(
    "--gripper",
    type=PATH,
    help="The identification.json of the gripper without the object, in the same sensor frame.",
)


free = click.option(
    "--free",
    type=PATH,
    metavar="LOG",
    help="Free motion with this load, which sets the threshold of contact."
    "  [default: what is quiet in LOG]",
)


def ask(question: str) -> bool:
    """Return the answer of a user at a terminal; False without a terminal."""
    return sys.stdin.isatty() and click.confirm(question, err=True)


yes = click.option("--yes", is_flag=True, help="Begin, also if there are more than 100,000 runs.")


class Names(click.ParamType):
    """Names separated by commas."""

    name = "NAME,..."

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, ...]:
        """Return the names."""
        if isinstance(value, tuple):
            return value
        return tuple(name.strip() for name in value.split(","))


class PositiveNumbers(click.ParamType):
    """Positive numbers separated by commas."""

    name = "number,..."

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        """Return the numbers, or fail with one line."""
        if isinstance(value, tuple):
            return value
        number = Number(0, 1e5, min_open=True)
        return tuple(number.convert(part, param, ctx) for part in value.split(","))
