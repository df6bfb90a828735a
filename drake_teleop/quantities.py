"""Dataclass fields that know their unit and their plausible range, and the check that uses them.

A scenario's blocks declare their parameters with `quantity`, so that one line says default, unit,
range and meaning, and a value that cannot be right is refused where it stands.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import types
import typing
from collections.abc import Iterator, Sequence
from typing import Any

from drake_teleop.errors import DrakeTeleopError


def quantity(default: Any, unit: str, low: float, high: float, doc: str) -> Any:
    """A dataclass field holding a number or a list of numbers.

    Args:
        default: the default value, in `unit`; a list makes a vector of that length.
        unit: SI unit, "1" if it has none.
        low, high: the closed range in which a value is plausible.
        doc: what it is, with frame and source.
    """
    metadata = {"unit": unit, "low": low, "high": high, "doc": doc}
    if isinstance(default, list):
        metadata["length"] = len(default)
        return dataclasses.field(default_factory=lambda: list(default), metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def choice(default: str, choices: Sequence[str], doc: str) -> Any:
    """A dataclass field holding one of a few words."""
    return dataclasses.field(default=default, metadata={"choices": tuple(choices), "doc": doc})


def plain(default: Any, doc: str) -> Any:
    """A dataclass field holding a flag, a word, a whole number, or a list of these or of blocks."""
    if isinstance(default, list):
        return dataclasses.field(default_factory=lambda: list(default), metadata={"doc": doc})
    return dataclasses.field(default=default, metadata={"doc": doc})


def check_structure(schema: type, data: Any, where: str) -> None:
    """Checks parsed YAML against a dataclass before it is loaded.

    Args:
        schema: the dataclass.
        data: what the YAML parser made of the file (mappings, sequences, scalars; the tag of a
            variant under the key "_tag").
        where: the place for the message, as `file` or `file:field`.

    Raises:
        DrakeTeleopError: for an unknown field, or a value of the wrong kind.
    """
    if not isinstance(data, dict):
        raise DrakeTeleopError(
            f"expected a mapping of fields, found {data!r}",
            where=where,
            remedy=f"the fields are {', '.join(_names(schema))}",
        )
    hints = typing.get_type_hints(schema)
    for key, value in data.items():
        if key == "_tag":
            continue
        place = f"{where}.{key}" if ":" in where else f"{where}:{key}"
        if key not in hints:
            near = difflib.get_close_matches(str(key), _names(schema), n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"fields: {', '.join(_names(schema))}"
            raise DrakeTeleopError("there is no such field", where=place, remedy=hint)
        _check_kind(hints[key], value, place)


def check_ranges(config: Any, where: str) -> None:
    """Checks every field of a dataclass (and of the dataclasses inside it) against its range.

    Raises:
        DrakeTeleopError: naming the field, its unit and the range, for a value that is outside,
            not finite, of the wrong length or not among the choices.
    """
    for field, value in _fields(config):
        place = f"{where}.{field.name}" if ":" in where else f"{where}:{field.name}"
        if "choices" in field.metadata:
            if value not in field.metadata["choices"]:
                allowed = ", ".join(field.metadata["choices"])
                raise DrakeTeleopError(
                    f"'{value}' is not known", where=place, remedy=f"choose one of {allowed}"
                )
        elif "unit" in field.metadata and value is not None:
            _check_range(field.metadata, value, place)
        for index, item in enumerate(value if isinstance(value, list) else [value]):
            if dataclasses.is_dataclass(item):
                check_ranges(item, f"{place}[{index}]" if isinstance(value, list) else place)


def _check_range(metadata: Any, value: Any, place: str) -> None:
    numbers = value if isinstance(value, list) else [value]
    length = metadata.get("length")
    if length is not None and len(numbers) != length:
        raise DrakeTeleopError(
            f"has {len(numbers)} numbers", where=place, remedy=f"give {length} numbers"
        )
    low, high = metadata["low"], metadata["high"]
    unit = "" if metadata["unit"] == "1" else f" {metadata['unit']}"
    for number in numbers:
        if not math.isfinite(number) or not low <= number <= high:
            raise DrakeTeleopError(
                f"{number:g}{unit} is outside {low:g} to {high:g}{unit}",
                where=place,
                remedy=f"check the value and its unit ({metadata['doc']})",
            )


def _fields(config: Any) -> Iterator[tuple[dataclasses.Field[Any], Any]]:
    for field in dataclasses.fields(config):
        yield field, getattr(config, field.name)


def _names(schema: type) -> list[str]:
    return [field.name for field in dataclasses.fields(schema)]


def _check_kind(hint: Any, value: Any, place: str) -> None:
    """Descends into nested dataclasses and lists; refuses words where numbers are wanted."""
    origin = typing.get_origin(hint)
    options = typing.get_args(hint) if origin in (typing.Union, types.UnionType) else (hint,)
    if value is None and type(None) in options:
        return
    options = tuple(option for option in options if option is not type(None))
    classes = (option for option in options if isinstance(option, type))
    variants = {option.__name__: option for option in classes if dataclasses.is_dataclass(option)}
    if variants:
        tag = value.get("_tag", "").lstrip("!") if isinstance(value, dict) else ""
        if tag and tag not in variants:
            raise DrakeTeleopError(
                f"'!{tag}' is not known", where=place, remedy=f"use one of !{', !'.join(variants)}"
            )
        check_structure(variants.get(tag) or next(iter(variants.values())), value, place)
    elif typing.get_origin(options[0]) is list:
        if not isinstance(value, list):
            raise DrakeTeleopError(f"expected a list, found {value!r}", where=place)
        for index, item in enumerate(value):
            _check_kind(typing.get_args(options[0])[0], item, f"{place}[{index}]")
    elif options[0] is float and (isinstance(value, bool) or not _is_number(value)):
        raise DrakeTeleopError(
            f"expected a number, found '{value}'",
            where=place,
            remedy="write the number alone; its unit is in the field's name or documentation",
        )
    elif options[0] is int and not isinstance(value, int):
        raise DrakeTeleopError(f"expected a whole number, found '{value}'", where=place)
    elif options[0] is bool and not isinstance(value, bool):
        raise DrakeTeleopError(f"expected true or false, found '{value}'", where=place)
    elif options[0] is str and not isinstance(value, str):
        raise DrakeTeleopError(f"expected a word, found {value!r}", where=place)


def _is_number(value: Any) -> bool:
    try:
        float(value)
    except (TypeError, ValueError):
        return False
    return True
