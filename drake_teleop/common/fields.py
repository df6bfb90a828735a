"""The fields of scenarios and studies as a list: what each is called, takes and means.

Help texts, references and schemas are made from it, so that each says what the checks do.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from inspect import cleandoc
from textwrap import TextWrapper
from typing import Any, TypeVar

from drake_teleop.common.quantities import KINDS, check_name, kind_of

_Class = TypeVar("_Class", bound=type)


@dataclass(frozen=True)
class FieldInfo:
    """What is known of a field.

    Attributes:
        name: as it stands in a file.
        kind: "number", "whole number", "true or false", "word" or "block", of the innermost items.
        lists: how many lists lie around it: 0 for one value, 1 for a list of them.
        length: of the list; None if it may be any, or is none.
        optional: whether it may be null.
        default: what it is if nothing is said; of an instance, what it is there.
        unit: "1" for none; empty if it is no quantity.
        low, high: the closed range of a quantity.
        choices: the words that may stand there; none: any.
        blocks: for a block the dataclasses that may stand there; a tag such as !Touch tells which
            of several is meant.
        meaning: one line or more for people.
    """

    name: str
    kind: str
    lists: int
    length: int | None
    optional: bool
    default: Any
    unit: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]
    blocks: tuple[type, ...]
    meaning: str

    @property
    def range(self) -> str:
        """The range with the unit, or the choices, or the kinds of block, for people."""
        if self.unit:
            unit = "" if self.unit == "1" else f" {self.unit}"
            return f"{self.low:.7g} to {self.high:.7g}{unit}"
        if self.choices:
            return ", ".join(self.choices)
        return " or ".join(block.__name__ for block in self.blocks)

    @property
    def text(self) -> str:
        """Its line of a help text."""
        known = [self.range] if self.range else []
        if self.default is None or self.kind != "block":
            known.append(f"default {_shown(self.default)}")
        return f"{self.name}: {self.meaning}" + (f" ({'; '.join(known)})" if known else "")


def settings(block: _Class) -> _Class:
    """Makes a dataclass of settings refuse what is no field of it, and its help tell the fields.

    Written above `@dataclass`. Reading a field costs what it did.
    """
    block.__setattr__ = _set_known  # type: ignore[assignment]
    wrap = TextWrapper(width=96, initial_indent=" " * 4, subsequent_indent=" " * 8)
    lines = [wrap.fill(entry.text) for entry in fields_of(block)]
    block.__doc__ = "\n".join([cleandoc(block.__doc__ or ""), "", "Attributes:", *lines, ""])
    return block


def _set_known(self: Any, name: str, value: Any) -> None:
    if name not in self.__dataclass_fields__:
        check_name(type(self), name, f"{type(self).__name__}.{name}")
    object.__setattr__(self, name, value)


def fields_of(config: Any) -> list[FieldInfo]:
    """The fields of a block of a scenario or a study, in their order.

    For what stands inside a block, ask again with its `default`: the same block may have other
    defaults at another place.

    Args:
        config: a dataclass of `quantity`, `choice`, `plain` and blocks, or an instance of one.
    """
    return [_info(entry, config) for entry in dataclasses.fields(config)]


def _info(entry: dataclasses.Field[Any], config: Any) -> FieldInfo:
    hint: Any = entry.type
    lists, items, optional = kind_of(hint)
    blocks = tuple(item for item in items if item not in KINDS)
    known = entry.metadata
    return FieldInfo(
        name=entry.name,
        kind="block" if blocks else KINDS[items[0]].removeprefix("a "),
        lists=lists,
        length=known.get("length"),
        optional=optional,
        default=_default(entry) if isinstance(config, type) else getattr(config, entry.name),
        unit=known.get("unit", ""),
        low=known.get("low"),
        high=known.get("high"),
        choices=known.get("choices", ()),
        blocks=blocks,
        meaning=known.get("doc") or _first_line(blocks[0]),
    )


def _default(entry: dataclasses.Field[Any]) -> Any:
    if entry.default_factory is not dataclasses.MISSING:
        return entry.default_factory()
    return entry.default


def _shown(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_shown, value))}]"
    return f"{value:.6g}" if isinstance(value, float) else repr(value)


def _first_line(block: type) -> str:
    return (block.__doc__ or "").partition("\n")[0].rstrip(".")
