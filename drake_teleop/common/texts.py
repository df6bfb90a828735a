"""Conversion of YAML and JSON files to plain data and back.

YAML has the core schema of version 1.2: `1:30` and `yes` are strings, `1e-3` is a number. Repeated
keys and huge files are errors. Tags never execute code.
"""

from __future__ import annotations

import json
import math
import re
import reprlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from drake_teleop.common.errors import DrakeTeleopError, field_location, to_one_line

_MAX_YAML_VALUES = 50_000  # including repetitions by aliases
_MAX_BRACKET_NESTING = 50  # nested brackets
_MAX_INTEGER_DIGITS = 18  # digits, always within 64 bits

_TAG_PREFIX = "tag:yaml.org,2002:"
_YAML_CORE_SCHEMA = (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?[0-9]+", list("-+0123456789")),
    (
        "float",
        r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
        list("-+.0123456789"),
    ),
)


class _YamlLoader(yaml.SafeLoader):
    yaml_implicit_resolvers: dict[Any, Any] = {}  # noqa: RUF012  (as PyYAML declares it)

    def fetch_flow_collection_start(self, TokenClass: Any) -> None:
        # PyYAML scans thousands of brackets before it creates nodes.
        if self.flow_level >= _MAX_BRACKET_NESTING:
            raise yaml.scanner.ScannerError(None, None, "nested too deeply", self.get_mark())
        super().fetch_flow_collection_start(TokenClass)

    def compose_node(self, parent: Any, index: Any) -> Any:
        # Refuses more than _MAX_YAML_VALUES values, to stop reading a huge file early.
        self.nodes = getattr(self, "nodes", 0) + 1
        if self.nodes > 2 * _MAX_YAML_VALUES:  # names are nodes too
            what = f"the file has more than {_MAX_YAML_VALUES} values"
            raise yaml.composer.ComposerError(None, None, what, self.get_mark())
        return super().compose_node(parent, index)


class _YamlDumper(yaml.SafeDumper):
    def ignore_aliases(self, data: Any) -> bool:
        return True

    def represent_text(self, text: str) -> Any:
        return self.represent_scalar(f"{_TAG_PREFIX}str", text, None if text.isprintable() else '"')

    def represent_tagged_mapping(self, data: dict[str, Any]) -> Any:
        tag = data.get("_tag", f"{_TAG_PREFIX}map")
        return self.represent_mapping(tag, [item for item in data.items() if item[0] != "_tag"])


_YamlDumper.add_representer(str, _YamlDumper.represent_text)
_YamlDumper.add_representer(dict, _YamlDumper.represent_tagged_mapping)
_SCALAR_PATTERNS = {kind: re.compile(rf"(?:{pattern})\Z") for kind, pattern, _ in _YAML_CORE_SCHEMA}
for _kind, _, _first in _YAML_CORE_SCHEMA:
    for _side in (_YamlLoader, _YamlDumper):
        _side.add_implicit_resolver(_TAG_PREFIX + _kind, _SCALAR_PATTERNS[_kind], _first)


def read_yaml(path: str | Path, *, tagged: bool = False) -> Any:
    """Return a YAML file's data; with `tagged`, tags become keys "_tag" instead of errors."""
    return parse_yaml(read_text(path), str(path), tagged=tagged)


def parse_yaml(text: str, where: str, *, tagged: bool = False) -> Any:
    try:
        node = yaml.compose(text, _YamlLoader)
        return None if node is None else _YamlNodeConverter(tagged).convert_node(node, where)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f"line {mark.line + 1}: " if mark else ""
        what = f"is not YAML ({line}{error.problem or error.context})"
        raise DrakeTeleopError(what, where=where) from None
    except yaml.reader.ReaderError as error:
        number, code = text.count("\n", 0, error.position) + 1, int(error.character)
        what = f"is not YAML (line {number} contains the character U+{code:04X})"
        raise DrakeTeleopError(what, where=where, remedy="save it as UTF-8 text") from None
    except RecursionError:
        remedy = "use fewer levels of lists and mappings"
        raise DrakeTeleopError("is nested too deeply", where=where, remedy=remedy) from None


def to_yaml_text(
    data: Any, *, head: Sequence[str] = (), comments: Mapping[str, str] | None = None
) -> str:
    """Return YAML text that `read_yaml` reads as the same data.

    `head` are comment lines at the top; `comments` maps "field.inner" to a comment after the field.
    """
    lines, place, left = [f"# {to_one_line(text)}" for text in head], list[str](), comments or {}
    for line in format_yaml_value(data, flow=None).splitlines():
        inner = line.lstrip(" ")
        place[(len(line) - len(inner)) // 2 :] = [inner.partition(":")[0]]
        comment = left.get(".".join(place), "")
        lines.append(f"{line}  # {comment}" if comment else line)
    text = "\n".join(lines) + "\n"
    if parse_yaml(text, "YAML", tagged=True) != data:
        what = f"{reprlib.repr(data)} cannot be written"
        raise DrakeTeleopError(what, where="YAML", remedy="use numbers, texts, lists and mappings")
    return text


def format_yaml_value(value: Any, flow: bool | None = True) -> str:
    """Return a value as YAML in one line; without `flow`, nested mappings have several lines."""
    options: dict[str, Any] = {"Dumper": _YamlDumper, "allow_unicode": True, "sort_keys": False}
    text: str = yaml.dump(value, default_flow_style=flow, width=math.inf, **options)
    return text.removesuffix("...\n").strip("\n")


def read_json(path: str | Path) -> Any:
    """Return the data of a JSON file; raise DrakeTeleopError if invalid or if a key repeats."""
    where, text = str(path), read_text(path)

    def check_unique_fields(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for name, value in pairs:
            if name in found:
                place = field_location(where, name)
                raise DrakeTeleopError("is defined twice", where=place, remedy="remove one of both")
            found[name] = value
        return found

    def integer_or_float(digits: str) -> float:
        return int(digits) if len(digits) <= _MAX_INTEGER_DIGITS else float(digits)

    try:
        return json.loads(text, object_pairs_hook=check_unique_fields, parse_int=integer_or_float)
    except json.JSONDecodeError as error:
        what = f"is not JSON (line {error.lineno}: {error.msg})"
        raise DrakeTeleopError(what, where=where) from None
    except RecursionError:
        remedy = "use fewer levels of lists and objects"
        raise DrakeTeleopError("is nested too deeply", where=where, remedy=remedy) from None


def read_text(path: str | Path) -> str:
    try:
        return Path(path).read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        what = f"is not UTF-8 text (byte {error.start})"
        raise DrakeTeleopError(what, where=str(path), remedy="save it as UTF-8 text") from None
    except OSError as error:
        raise DrakeTeleopError(f"cannot be read ({error.strerror})", where=str(path)) from None


class _YamlNodeConverter:
    def __init__(self, tagged: bool) -> None:
        self._tagged = tagged
        self._values = 0

    def convert_node(self, node: Any, where: str) -> Any:
        self._values += 1
        if self._values > _MAX_YAML_VALUES:
            raise _error_at_node(f"the file has more than {_MAX_YAML_VALUES} values", node, where)
        if isinstance(node, yaml.MappingNode):
            return self._convert_mapping(node, where)
        if isinstance(node, yaml.SequenceNode):
            if node.tag != f"{_TAG_PREFIX}seq":
                what = f"a list cannot have the tag {_quote_value(node.tag)}"
                raise _error_at_node(what, node, where)
            return [self.convert_node(item, f"{where}[{i}]") for i, item in enumerate(node.value)]
        return _convert_scalar(node, where)

    def _convert_mapping(self, node: Any, where: str) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode) or key.tag != f"{_TAG_PREFIX}str":
                what = f"a field's name must be a word, not {_quote_value(key.value)}"
                raise _error_at_node(what, key, where)
            field = field_location(where, key.value)
            if key.value in found:
                raise _error_at_node("is defined twice", key, field)
            if key.value == "_tag":
                remedy = "select a type by a YAML tag: !Type {...}"
                raise _error_at_node("there is no such field", key, field, remedy)
            found[key.value] = self.convert_node(value, field)
        if node.tag not in (f"{_TAG_PREFIX}map", "!"):  # ! is YAML's non-specific tag
            if not self._tagged:
                what = f"the tag {_quote_value(node.tag)} is not allowed here"
                raise _error_at_node(what, node, where, "remove the tag")
            found["_tag"] = node.tag
        return found


def _convert_scalar(node: Any, where: str) -> Any:
    kind, text = node.tag.removeprefix(_TAG_PREFIX), node.value
    if kind == "str":
        return text
    if kind not in _SCALAR_PATTERNS or not _SCALAR_PATTERNS[kind].match(text):
        what = f"{_quote_value(text)} does not match the tag {_quote_value(node.tag)}"
        raise _error_at_node(what, node, where)
    if kind == "null":
        return None
    if kind == "bool":
        return text.lower() == "true"
    if kind == "float":
        return float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))
    digits = text.lstrip("+-")
    if digits.startswith("0") and digits != "0":
        remedy = f"write {digits.lstrip('0') or 0}, or '{text}' in quotes for a word"
        raise _error_at_node(f"{_quote_value(text)} may be octal or decimal", node, where, remedy)
    if len(digits) > _MAX_INTEGER_DIGITS:
        what = f"an integer of {len(digits)} digits is too long (maximum: {_MAX_INTEGER_DIGITS})"
        raise _error_at_node(what, node, where)
    return int(text)


def _error_at_node(what: str, node: Any, where: str, remedy: str = "") -> DrakeTeleopError:
    line = node.start_mark.line + 1
    return DrakeTeleopError(f"{what} (line {line})", where=where, remedy=remedy)


def _quote_value(text: Any) -> str:
    return reprlib.repr(text.removeprefix(_TAG_PREFIX) if isinstance(text, str) else "a list")
