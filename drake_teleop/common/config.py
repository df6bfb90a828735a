"""Dataclass fields with unit, plausible range and meaning; checks of their values."""

from __future__ import annotations

import dataclasses
import functools
import numbers
import os
import reprlib
import types
import typing
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from inspect import cleandoc
from pathlib import Path
from textwrap import TextWrapper
from typing import Any, NamedTuple, TypeVar

from drake_teleop.common.errors import DrakeTeleopError, field_location, suggest_name
from drake_teleop.common.registry import Registry

TYPE_NAMES = {float: "a number", int: "a whole number", bool: "true or false", str: "a word"}
"""Name of each value type in messages."""
_ARE_ASSIGNMENTS_CHECKED = ContextVar("checks_assignments", default=True)


def quantity(
    default: Any, unit: str, low: float, high: float, doc: str, *, length: int | None = None
) -> Any:
    """Return a dataclass field for a number, list or mapping of numbers, like its default.

    `unit` is an SI unit, "1" if dimensionless; each number must be from `low` to `high`. A list
    has the length of its default. Default [] allows any length, default None `length` numbers.
    """
    metadata = {"unit": unit, "low": low, "high": high, "doc": doc, "length": length}
    if isinstance(default, list) and default:
        metadata["length"] = len(default)
    return _make_field_with_default(default, metadata)


def _make_field_with_default(default: Any, metadata: dict[str, Any]) -> Any:
    if isinstance(default, (list, dict)):
        return dataclasses.field(default_factory=lambda: type(default)(default), metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def choice(
    default: str, choices: Sequence[str], doc: str, registry: Registry[Any] | None = None
) -> Any:
    """Return a dataclass field for one of the words `choices` or of the names in `registry`."""
    metadata = {"choices": tuple(choices), "doc": doc, "registry": registry}
    return dataclasses.field(default=default, metadata=metadata)


def plain(
    default: Any, doc: str, registry: Registry[Any] | None = None, *, is_path: bool = False
) -> Any:
    """Return a dataclass field without unit or choices: flag, word, integer, list or mapping.

    With `is_path` the texts are paths, which `with_absolute_paths` resolves.
    """
    return _make_field_with_default(default, {"doc": doc, "registry": registry, "is_path": is_path})


def with_absolute_paths(config: Any, folder: Path) -> Any:
    """Return a copy of a dataclass whose paths, relative to `folder`, are absolute, at any depth.

    Default paths of shipped models remain, unless `folder` contains a file of this name.
    """

    def resolve_paths(value: Any, field: dataclasses.Field[Any]) -> Any:
        if isinstance(value, list):
            return [resolve_paths(item, field) for item in value]
        if dataclasses.is_dataclass(value):
            return with_absolute_paths(value, folder)
        if not field.metadata.get("is_path") or not value:
            return value
        path = (folder / value).resolve()
        return value if value == field.default and not os.path.isfile(path) else str(path)

    changes = {}
    for entry in dataclasses.fields(config):
        value = getattr(config, entry.name)
        if (resolved := resolve_paths(value, entry)) != value:
            changes[entry.name] = resolved
    return dataclasses.replace(config, **changes) if changes else config


def shorten_value(value: Any) -> str:
    if value is None:
        return "nothing"
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        return reprlib.repr(value)
    # All digits of a seed; a longer integer is shortened in the middle.
    return reprlib.repr(int(value)) if isinstance(value, numbers.Integral) else f"{value:g}"


def check_structure(schema: type, data: Any, where: str, *, tagged: bool = False) -> None:
    """Raise DrakeTeleopError if parsed YAML does not fit the fields and types of a dataclass.

    `where` is the place in messages; `tagged` allows a YAML tag, as the key "_tag".
    """
    if not isinstance(data, dict):
        what = f"expected a mapping of fields, found {shorten_value(data)}"
        remedy = f"the fields are {', '.join(_field_names(schema))}"
        raise DrakeTeleopError(what, where=where, remedy=remedy)
    if "_tag" in data and not tagged:
        what = f"the tag {data['_tag']} is not allowed here"
        raise DrakeTeleopError(what, where=where, remedy="remove the tag")
    kinds = _field_types(schema)
    for key, value in data.items():
        if key == "_tag":
            continue
        place = field_location(where, key)
        check_field_name(schema, key, place)
        _check_value_type(kinds[key], value, place, from_file=True)


def check_field_name(schema: type, name: Any, where: str) -> None:
    names = _field_names(schema)
    if name not in names:
        remedy = suggest_name(name, names, f"fields: {', '.join(names)}")
        raise DrakeTeleopError("there is no such field", where=where, remedy=remedy)


def check_field(schema: type, name: str, value: Any, where: str) -> None:
    """Raise DrakeTeleopError, for the place `where`, if the field does not allow the value."""
    check_field_name(schema, name, where)
    entry = schema.__dataclass_fields__[name]  # type: ignore[attr-defined]
    if not entry.init and value != entry.default:
        what = f"{shorten_value(value)} has no effect in Python (only in files)"
        raise DrakeTeleopError(what, where=where, remedy=entry.metadata["in_python"])
    _check_field_value(entry, _read_field_type(entry, _type_hints(schema)[name]), value, where)


def check_all_field_values(config: Any, where: str) -> None:
    """Raise DrakeTeleopError if any value in a dataclass, at any depth, is not allowed."""
    kinds = _field_types(config.__class__)
    for field in dataclasses.fields(config):
        value, place = getattr(config, field.name), field_location(where, field.name)
        _check_field_value(field, kinds[field.name], value, place)
        for item_place, item in _locate_list_items(value, place):
            if dataclasses.is_dataclass(item):
                check_all_field_values(item, item_place)


def _locate_list_items(value: Any, where: str) -> list[tuple[str, Any]]:
    if isinstance(value, list):
        return [(f"{where}[{index}]", item) for index, item in enumerate(value)]
    return [(where, value)]


def _check_field_value(field: Any, kind: FieldType, value: Any, where: str) -> None:
    metadata = field.metadata
    _check_value_type(kind, value, where, from_file=False)
    if "choices" in metadata:
        words, registry = metadata["choices"], metadata.get("registry")
        if registry is not None:
            registry.check(value, where, *words)
        elif value not in words:
            remedy = suggest_name(value, words, f"choose one of {', '.join(words)}")
            raise DrakeTeleopError(f"'{value}' is not known", where=where, remedy=remedy)
    elif "unit" in metadata and value is not None:
        _check_quantity_range(metadata, value, where)


def _check_quantity_range(metadata: Any, value: Any, where: str) -> None:
    if isinstance(value, dict):
        for name, number in value.items():
            _check_quantity_range(metadata, number, f"{where}.{name}")
        return
    values = value if isinstance(value, list) else [value]
    length = metadata.get("length")
    if length is not None and len(values) != length:
        what = f"has {len(values)} numbers"
        raise DrakeTeleopError(what, where=where, remedy=f"give {length} numbers")
    low, high = metadata["low"], metadata["high"]
    unit = "" if metadata["unit"] == "1" else f" {metadata['unit']}"
    for number in values:
        if not low <= number <= high:  # also false for NaN
            limits = f"{shorten_value(low)} to {shorten_value(high)}{unit}"
            what = f"{shorten_value(number)}{unit} is outside {limits}"
            remedy = f"check the value and its unit ({metadata['doc']})"
            raise DrakeTeleopError(what, where=where, remedy=remedy)


def _field_types(schema: type) -> dict[str, FieldType]:
    hints, entries = _type_hints(schema), dataclasses.fields(schema)
    return {entry.name: _read_field_type(entry, hints[entry.name]) for entry in entries}


@functools.cache
def _type_hints(schema: type) -> dict[str, Any]:
    return typing.get_type_hints(schema)


def _read_field_type(entry: dataclasses.Field[Any], hint: Any) -> FieldType:
    registry, kind = entry.metadata.get("registry"), parse_type_hint(hint)
    if registry is None or "choices" in entry.metadata:
        return kind
    return kind._replace(items=tuple(registry.values()))


def _field_names(schema: type) -> list[str]:
    return [field.name for field in dataclasses.fields(schema)]


class FieldType(NamedTuple):
    """Parsed type hint: `list[A | B] | None` has list depth 1, items (A, B) and is optional.

    `is_mapping` is True for `dict[str, A]`.
    """

    list_depth: int
    items: tuple[Any, ...]
    optional: bool
    is_mapping: bool = False


@functools.cache
def parse_type_hint(hint: Any) -> FieldType:
    if typing.get_origin(hint) is list:
        inner = parse_type_hint(typing.get_args(hint)[0])
        return FieldType(inner.list_depth + 1, inner.items, False)
    if typing.get_origin(hint) is dict:
        return FieldType(0, parse_type_hint(typing.get_args(hint)[1]).items, False, is_mapping=True)
    if typing.get_origin(hint) not in (typing.Union, types.UnionType):
        return FieldType(0, (hint,), False)
    options = tuple(option for option in typing.get_args(hint) if option is not type(None))
    inner = parse_type_hint(options[0]) if len(options) == 1 else FieldType(0, options, False)
    return inner._replace(optional=len(options) < len(typing.get_args(hint)))


def _check_value_type(kind: FieldType, value: Any, where: str, *, from_file: bool) -> None:
    first = kind.items[0]
    if value is None and kind.optional:
        return
    if kind.is_mapping:
        if not isinstance(value, dict) or "_tag" in value:
            raise _make_type_error("names with values", value, where, "write {name: value}")
        for name, item in value.items():
            inner = kind._replace(is_mapping=False)
            _check_value_type(inner, item, f"{where}.{name}", from_file=from_file)
    elif kind.list_depth:
        if not isinstance(value, list):
            raise _make_type_error("a list", value, where, "write it in brackets: [...]")
        inner = FieldType(kind.list_depth - 1, kind.items, False)
        for index, item in enumerate(value):
            _check_value_type(inner, item, f"{where}[{index}]", from_file=from_file)
    elif first in TYPE_NAMES:
        if not _is_value_of_type(first, value, from_file=from_file):
            remedy = "write the number alone; its unit is in the field's name or documentation"
            remedy = remedy if first is float else ""
            raise _make_type_error(TYPE_NAMES[first], value, where, remedy)
    elif from_file:
        several = len(kind.items) > 1
        check_structure(_class_of_yaml_tag(kind.items, value, where), value, where, tagged=several)
    elif not isinstance(value, kind.items):
        fields = ", ".join(_field_names(first))
        remedy = f"pass {first.__name__}(...) with fields {fields}"
        expected = " or ".join(block.__name__ for block in kind.items)
        raise _make_type_error(expected, value, where, remedy)


def _class_of_yaml_tag(blocks: tuple[type, ...], value: Any, where: str) -> type:
    names = [block.__name__ for block in blocks]
    tag = str(value.get("_tag", "")).removeprefix("!") if isinstance(value, dict) else ""
    if tag and tag not in names:
        remedy = suggest_name(tag, names, f"use one of !{', !'.join(names)}")
        raise DrakeTeleopError(f"'!{tag}' is not known", where=where, remedy=remedy)
    return blocks[names.index(tag) if tag else 0]


def _is_value_of_type(kind: type, value: Any, *, from_file: bool) -> bool:
    if isinstance(value, bool) and kind is not bool:
        return False
    required = {int: numbers.Integral, float: numbers.Real}.get(kind, kind)
    numeric_text = kind is float and from_file and _is_convertible_to_float(value)
    return isinstance(value, required) or numeric_text


def _is_convertible_to_float(value: Any) -> bool:
    try:
        float(value)
    except (TypeError, ValueError, OverflowError):
        return False
    return True


def _make_type_error(expected: str, found: Any, where: str, remedy: str = "") -> DrakeTeleopError:
    shown = f"'{found}'" if isinstance(found, str) else reprlib.repr(found)
    return DrakeTeleopError(f"expected {expected}, found {shown}", where=where, remedy=remedy)


_DataclassT = TypeVar("_DataclassT", bound=type)


@dataclass(frozen=True)
class FieldInfo:
    """Description of a dataclass field.

    Attributes:
        kind: "number", "whole number", "true or false", "word" or "block" (a dataclass); of the
            items of a list or mapping.
        list_depth: number of nested lists, 0 for one value.
        is_mapping: True if the value maps names to items.
        unit: "1" for a dimensionless quantity; empty if the field is no quantity.
        low, high: range of a quantity, limits included.
        choices: the allowed words; empty if all are allowed.
        blocks: the allowed dataclasses of a block, selected by a tag such as !Touch.
    """

    name: str
    kind: str
    list_depth: int
    length: int | None
    optional: bool
    default: Any
    unit: str
    low: float | None
    high: float | None
    choices: tuple[str, ...]
    blocks: tuple[type, ...]
    meaning: str
    is_mapping: bool = False

    @property
    def limits_or_choices(self) -> str:
        if self.unit:
            unit = "" if self.unit == "1" else f" {self.unit}"
            return f"{_format_limit(self.low)} to {_format_limit(self.high)}{unit}"
        if self.choices:
            return ", ".join(self.choices)
        return " or ".join(block.__name__ for block in self.blocks)

    @property
    def docstring_entry(self) -> str:
        metadata = [self.limits_or_choices] if self.limits_or_choices else []
        if self.default is None or self.kind != "block":
            metadata.append(f"default {_format_value(self.default)}")
        return f"{self.name}: {self.meaning}" + (f" ({'; '.join(metadata)})" if metadata else "")


def settings(block: _DataclassT) -> _DataclassT:
    """Decorate a dataclass: check values at assignment, and list the fields in its docstring.

    The dataclass's module must not import `annotations` from `__future__`: Drake reads the types.
    """
    block.__setattr__ = _set_checked_attribute  # type: ignore[assignment]
    block.__str__ = _describe_non_default_fields  # type: ignore[assignment]
    wrap = TextWrapper(width=96, initial_indent=" " * 4, subsequent_indent=" " * 8)
    lines = [wrap.fill(entry.docstring_entry) for entry in fields_of(block)]
    block.__doc__ = "\n".join([cleandoc(block.__doc__ or ""), "", "Attributes:", *lines, ""])
    return block


def _describe_non_default_fields(self: Any) -> str:
    return "\n  ".join([type(self).__name__, *_lines_of_non_default_fields(self)])


def _lines_of_non_default_fields(config: Any) -> Iterator[str]:
    for entry in dataclasses.fields(config):
        value = getattr(config, entry.name)
        if value == _default_value(entry):
            continue
        blocks = _locate_list_items(value, entry.name)
        if not blocks or not dataclasses.is_dataclass(blocks[0][1]):
            yield f"{entry.name}: {_format_value(value)}"
            continue
        for place, block in blocks:
            yield f"{place}: {type(block).__name__}"
            yield from (f"  {line}" for line in _lines_of_non_default_fields(block))


def _set_checked_attribute(self: Any, name: str, value: Any) -> None:
    place = f"{type(self).__name__}.{name}"
    # Drake's `yaml_load_typed` sets an optional field to float(), list() etc. before the value of
    # the file. Such a value is checked again when a station is made.
    is_created = getattr(self, name, value) is None and not value
    if _ARE_ASSIGNMENTS_CHECKED.get() and not is_created:
        check_field(type(self), name, value, place)
    else:
        check_field_name(type(self), name, place)
    object.__setattr__(self, name, value)


@contextmanager
def unchecked_assignments() -> Iterator[None]:
    token = _ARE_ASSIGNMENTS_CHECKED.set(False)
    try:
        yield
    finally:
        _ARE_ASSIGNMENTS_CHECKED.reset(token)


def fields_of(config: Any) -> list[FieldInfo]:
    return [_describe_field(entry, config) for entry in dataclasses.fields(config)]


def _describe_field(entry: dataclasses.Field[Any], config: Any) -> FieldInfo:
    lists, items, optional, is_mapping = _read_field_type(entry, entry.type)
    blocks = tuple(item for item in items if item not in TYPE_NAMES)
    metadata = entry.metadata
    choices = *metadata.get("choices", ()), *(metadata.get("registry") or ())
    first_line = ((blocks[0].__doc__ if blocks else "") or "").partition("\n")[0]
    return FieldInfo(
        name=entry.name,
        kind="block" if blocks else TYPE_NAMES[items[0]].removeprefix("a "),
        list_depth=lists,
        length=metadata.get("length"),
        optional=optional,
        default=_default_value(entry) if isinstance(config, type) else getattr(config, entry.name),
        unit=metadata.get("unit", ""),
        low=metadata.get("low"),
        high=metadata.get("high"),
        choices=choices if "choices" in metadata else (),
        blocks=blocks,
        meaning=metadata.get("doc") or first_line.rstrip("."),
        is_mapping=is_mapping,
    )


def _default_value(entry: dataclasses.Field[Any]) -> Any:
    if entry.default_factory is not dataclasses.MISSING:
        return entry.default_factory()
    return entry.default


def _format_value(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_format_value, value))}]"
    return f"{value:.6g}" if isinstance(value, float) else repr(value)


def _format_limit(limit: float | None) -> str:
    return f"{limit:.7g}" if isinstance(limit, float) else str(limit)
