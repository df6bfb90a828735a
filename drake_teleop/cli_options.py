"""The kinds of values and the options that commands have in common."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

PATH = click.Path(path_type=Path)


class Number(click.FloatRange):
    """A finite number in a range: click's own lets "nan" and "inf" through."""

    name = "number"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number", param, ctx)
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


seed = click.option("--seed", type=click.IntRange(min=0), help="Instead of the scenario's seed.")
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
