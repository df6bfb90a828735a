"""The kinds of values and the options that commands have in common."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
from click.shell_completion import CompletionItem

from drake_teleop.resources import scenarios_dir, studies_dir


class Shipped(click.Path):
    """What is shipped by name, or a file; a shell that is asked to completes both."""

    def __init__(self, folder: Path, path_type: type) -> None:
        super().__init__(path_type=path_type)
        self._folder = folder

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        names = sorted(path.stem for path in self._folder.glob("*.yaml"))
        fitting = [CompletionItem(name) for name in names if name.startswith(incomplete)]
        return fitting + super().shell_complete(ctx, param, incomplete)


PATH = click.Path(path_type=Path)
SCENARIO = Shipped(scenarios_dir(), str)
STUDY = Shipped(studies_dir(), Path)


def _check_range(
    kind: click.FloatRange | click.IntRange,
    number: float,
    param: click.Parameter | None,
    ctx: click.Context | None,
) -> None:
    """Refuses what is outside, in words: click's own would be `x>=0`."""
    low, high = kind.min, kind.max
    if high is not None and not (low or 0) <= number <= high:
        kind.fail(f"{number:g} is outside {low or 0:g} to {high:g}", param, ctx)
    if low is not None and (number < low or (kind.min_open and number == low)):
        text = (
            f"{number:g} is not above {low:g}" if kind.min_open else f"{number:g} is below {low:g}"
        )
        kind.fail(text, param, ctx)


class Number(click.FloatRange):
    """A finite number in a range: click's own lets "nan" and "inf" through."""

    name = "number"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        number: float = click.FLOAT.convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number", param, ctx)
        _check_range(self, number, param, ctx)
        return number


class Whole(click.IntRange):
    """A whole number in a range."""

    name = "integer"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        number: int = click.INT.convert(value, param, ctx)
        _check_range(self, number, param, ctx)
        return number


class Delay(click.ParamType):
    """Seconds, or "auto"."""

    name = "auto|SECONDS"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float | str:
        return "auto" if value == "auto" else Number().convert(value, param, ctx)


def out(command: str) -> Callable[[Any], Any]:
    """`--out DIR`, by default out/COMMAND."""
    default = Path("out") / command
    return click.option("--out", type=PATH, default=default, show_default=True, metavar="DIR")


seed = click.option("--seed", type=Whole(min=0), help="Instead of the scenario's seed.")
quiet = click.option("--quiet", is_flag=True, help="No progress bars, no tables.")
cutoff = click.option(
    "--cutoff",
    "cutoff_hz",
    type=Number(min=0, min_open=True),
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


class Names(click.ParamType):
    """Names with commas between them."""

    name = "NAME,..."

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, ...]:
        if isinstance(value, tuple):
            return value
        return tuple(name.strip() for name in value.split(","))


class PositiveNumbers(click.ParamType):
    """Positive numbers with commas between them."""

    name = "number,..."

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        if isinstance(value, tuple):
            return value
        number = Number(min=0, min_open=True)
        return tuple(number.convert(part, param, ctx) for part in value.split(","))
