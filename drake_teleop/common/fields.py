"""Fields of scenarios and studies, for help texts, references and schemas."""

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
    """Description of a field.

    Attributes:
        kind: "number", "whole number", "true or false", "word" or "block", of the innermost items.
        lists: number of enclosing lists, 0 for one value.
        length: of the list; None if any.
        optional: whether it may be null.
        unit: "1" for a dimensionless quantity; empty if it is no quantity.
        low, high: the closed range of a quantity.
        choices: the allowed words; empty: any.
        blocks: the allowed dataclasses of a block, selected by a tag such as !Touch.
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
        """Range with unit, or choices, or kinds of block."""
        if self.unit:
            unit = "" if self.unit == "1" else f" {self.unit}"
            return f"{self.low:.7g} to {self.high:.7g}{unit}"
        if self.choices:
            return ", ".join(self.choices)
        return " or ".join(block.__name__ for block in self.blocks)

    @property
    def text(self) -> str:
        """Line of a help text."""
        metadata = [self.range] if self.range else []
        if self.default is None or self.kind != "block":
            metadata.append(f"default {_shown(self.default)}")
        return f"{self.name}: {self.meaning}" + (f" ({'; '.join(metadata)})" if metadata else "")


def settings(block: _Class) -> _Class:
    """Make a dataclass refuse unknown attributes and list its fields in its help."""
    block.__setattr__ = _set_checked_attribute  # type: ignore[assignment]
    wrap = TextWrapper(width=96, initial_indent=" " * 4, subsequent_indent=" " * 8)
    lines = [wrap.fill(entry.text) for entry in fields_of(block)]
    block.__doc__ = "\n".join([cleandoc(block.__doc__ or ""), "", "Attributes:", *lines, ""])
    return block


def _set_checked_attribute(self: Any, name: str, value: Any) -> None:
    if name not in self.__dataclass_fields__:
        check_name(type(self), name, f"{type(self).__name__}.{name}")
    object.__setattr__(self, name, value)


def fields_of(config: Any) -> list[FieldInfo]:
    """Return the fields of a settings dataclass or of an instance.

    For an inner block call this with its `default`, which depends on the place.
    """
    return [_field_info(entry, config) for entry in dataclasses.fields(config)]


def _field_info(entry: dataclasses.Field[Any], config: Any) -> FieldInfo:
    hint: Any = entry.type
    lists, items, optional = kind_of(hint)
    blocks = tuple(item for item in items if item not in KINDS)
    metadata = entry.metadata
    return FieldInfo(
        name=entry.name,
        kind="block" if blocks else KINDS[items[0]].removeprefix("a "),
        lists=lists,
        length=metadata.get("length"),
        optional=optional,
        default=_default(entry) if isinstance(config, type) else getattr(config, entry.name),
        unit=metadata.get("unit", ""),
        low=metadata.get("low"),
        high=metadata.get("high"),
        choices=metadata.get("choices", ()),
        blocks=blocks,
        meaning=metadata.get("doc") or _first_line(blocks[0]),
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
