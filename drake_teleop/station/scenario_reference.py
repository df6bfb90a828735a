"""Reference page, JSON schema and commented YAML of scenarios, generated from the dataclasses."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from drake_teleop.common.config import FieldInfo, fields_of, with_absolute_paths
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import write_text
from drake_teleop.common.texts import format_yaml_value, parse_yaml
from drake_teleop.station.scenario import Scenario, ScenarioFromData
from drake_teleop.station.sensor.presets import PRESETS
from drake_teleop.station.sensor.sensor_chain import WristSensorConfig

_MAX_COMMENT_COLUMN = 34  # column of the comments, unless a value is longer

_YAML_FILE_HEAD = """\
# Each field has its value, [the permitted values] and its meaning. Omitted fields have their
# defaults. Lines that begin with # are fields and blocks that this scenario does not use; remove
# the # to use them.
"""

_REFERENCE_PAGE_HEAD = """\
# Every field of a scenario

A scenario is a YAML file; what it leaves out keeps the default that stands here. This page is made
from the code (`python docs/make_reference.py`).

- `drake-teleop scenario press > mine.yaml` writes the shipped scenario `press` with every field,
  its range and its meaning, as a starting point; `drake-teleop run mine.yaml` runs it.
- Files are read as YAML 1.2: `1e-3` is a number, `yes` and `1:30` are words. A field that stands
  there twice, or that nothing reads, is an error, and so is `010`.
- [scenario.schema.json](scenario.schema.json) is the JSON schema: an editor that knows it (for
  instance by a first line `# yaml-language-server: $schema=scenario.schema.json`) completes and
  checks the fields. Configure such an editor for tags like `!Touch`, which say what kind of
  block follows: in VS Code `"yaml.customTags": ["!Touch mapping", ...]`.

Frames: W is the world, z up; B the base of the master, E its end; S the wrist sensor, A its
accelerometers. `p_WS` is the position of S's origin in W, `R_SA` the rotation of A in S. Equations
and sections are those of the paper; (E) marks an estimate of ours, where the paper gives no figure.
"""


def to_commented_yaml(scenario: Scenario) -> str:
    """Return the scenario as YAML text; a comment explains each field."""
    return _YAML_FILE_HEAD + "\n".join(_block_lines(scenario)) + "\n"


def _texts_in(value: Any) -> list[str]:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = [getattr(value, field.name) for field in dataclasses.fields(value)]
    if isinstance(value, dict):
        value = [*value, *value.values()]
    if isinstance(value, (list, tuple)):
        return [word for each in value for word in _texts_in(each)]
    return [str(value)] if isinstance(value, (str, Path)) and str(value) else []


def write_scenario(path: Path, scenario: Scenario, heading: Sequence[str] = ()) -> None:
    """Write every field of a scenario to a YAML file, with the lines `heading` as comment.

    A DrakeTeleopError is raised if reading the file would not give the same scenario.
    """
    scenario = with_absolute_paths(scenario, Path.cwd())
    text = "".join(f"# {line}\n" for line in heading) + to_commented_yaml(scenario)
    where = str(path)
    found = ScenarioFromData(parse_yaml(text, where, tagged=True), where)
    if found != scenario and _texts_in(found) != _texts_in(scenario):
        names = [field.name for field in dataclasses.fields(scenario)]
        lost = [n for n in names if _texts_in(getattr(found, n)) != _texts_in(getattr(scenario, n))]
        what = f"YAML cannot represent the scenario's block {' and '.join(lost)}"
        raise DrakeTeleopError(what, where=where, remedy="use printable texts, numbers and lists")
    write_text(path, text)


def reference_page() -> str:
    """Return the scenario reference in Markdown: a table of fields, ranges, meanings per block."""
    return _REFERENCE_PAGE_HEAD + "".join(_sections_of_page(Scenario(), ""))


def json_schema() -> str:
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "Scenario"}
    return json.dumps(schema | _object_schema(Scenario()), indent=1) + "\n"


def _allowed_values(entry: FieldInfo) -> str:
    words = entry.range if entry.unit or entry.choices else entry.kind
    if entry.list_depth:
        words = f"{entry.length or 'any number'} of {words}"
    if entry.is_mapping:
        words = f"mapping of names to {words}"
    return f"{words}, or null" if entry.optional else words


def _comment_of_field(entry: FieldInfo) -> str:
    return f"[{_allowed_values(entry)}] {entry.meaning}" if entry.kind != "block" else entry.meaning


def _block_lines(config: Any) -> list[str]:
    entries = fields_of(config)
    starts = {entry.name: f"{entry.name}: {format_yaml_value(entry.default)}"
              for entry in entries if entry.kind != "block"}  # fmt: skip
    column = min(_MAX_COMMENT_COLUMN, max(map(len, starts.values()), default=0))
    preset = None
    if isinstance(config, WristSensorConfig):
        preset = PRESETS.get(config.preset, WristSensorConfig())
    lines = []
    for entry in entries:
        if entry.kind == "block":
            lines += _inner_block_lines(entry)
            continue
        line = f"{starts[entry.name]:{column}}  # {_comment_of_field(entry)}"
        of_preset = preset is not None and entry.default == getattr(preset, entry.name)
        lines.append(f"# {line}" if of_preset and entry.name != "preset" else line)
    return lines


def _inner_block_lines(entry: FieldInfo) -> list[str]:
    if entry.default:
        return _field_lines(entry, entry.default)
    blocks = [block() for block in entry.blocks]
    if entry.list_depth:
        return _prefix_lines("# ", _field_lines(entry, blocks))
    return [line for block in blocks for line in _prefix_lines("# ", _field_lines(entry, block))]


def _field_lines(entry: FieldInfo, value: Any) -> list[str]:
    if not entry.list_depth:
        head = f"{entry.name}:{_tag_of_block(entry, value)}  # {entry.meaning}"
        return [head, *_prefix_lines("  ", _block_lines(value))]
    lines = [f"{entry.name}:  # {entry.meaning}"]
    for item in value:
        lines += [f"  -{_tag_of_block(entry, item)}", *_prefix_lines(" " * 4, _block_lines(item))]
    return lines


def _tag_of_block(entry: FieldInfo, config: Any) -> str:
    return f" !{type(config).__name__}" if len(entry.blocks) > 1 else ""


def _prefix_lines(prefix: str, lines: list[str]) -> list[str]:
    return [prefix + line for line in lines]


def _sections_of_page(config: Any, path: str) -> Iterator[str]:
    entries = fields_of(config)
    yield "\n| field | default | takes | meaning |\n|---|---|---|---|\n"
    for entry in entries:
        default = (
            format_yaml_value(entry.default) if entry.kind != "block" or not entry.default else ""
        )
        takes = _links_to_blocks(entry, path) if entry.kind == "block" else _allowed_values(entry)
        cells = (f"`{entry.name}`", default, takes, entry.meaning)
        yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |\n"
    for entry in entries:
        for title, block in _titles_of_blocks(entry, path):
            yield f"\n## {title}\n"
            inner = entry.default if isinstance(entry.default, block) else block()
            first_paragraph, _, _ = (type(inner).__doc__ or "").partition("\n\n")
            yield f"\n{' '.join(first_paragraph.split())}\n"
            yield from _sections_of_page(inner, f"{path}{entry.name}.")


def _titles_of_blocks(entry: FieldInfo, path: str) -> list[tuple[str, type]]:
    several = len(entry.blocks) > 1
    return [
        (f"{path}{entry.name}{f': !{block.__name__}' if several else ''}", block)
        for block in entry.blocks
    ]


def _links_to_blocks(entry: FieldInfo, path: str) -> str:
    several = len(entry.blocks) > 1
    links = []
    for title, block in _titles_of_blocks(entry, path):
        anchor = re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-")
        links.append(f"[{f'!{block.__name__}' if several else 'block'}](#{anchor})")
    return f"{'list of ' * entry.list_depth}{', '.join(links)}{', or null' * entry.optional}"


def _object_schema(config: Any) -> dict[str, Any]:
    properties = {entry.name: _field_schema(entry) for entry in fields_of(config)}
    return {"type": "object", "additionalProperties": False, "properties": properties}


def _field_schema(entry: FieldInfo) -> dict[str, Any]:
    forms = [_item_schema(entry, item) for item in entry.blocks or (None,)]
    schema: dict[str, Any] = forms[0] if len(forms) == 1 else {"anyOf": forms}
    for _ in range(entry.list_depth):
        schema = {"type": "array", "items": schema}
    if entry.is_mapping:
        schema = {"type": "object", "additionalProperties": schema}
    if entry.length is not None:
        schema |= {"minItems": entry.length, "maxItems": entry.length}
    if entry.optional:
        schema = {"anyOf": [schema, {"type": "null"}]}
    schema["description"] = _comment_of_field(entry)
    if entry.kind != "block":
        schema["default"] = entry.default
    return schema


def _item_schema(entry: FieldInfo, block: type | None) -> dict[str, Any]:
    if block is not None:
        return _object_schema(entry.default if isinstance(entry.default, block) else block())
    if entry.choices:
        return {"enum": list(entry.choices)}
    types = {"number": "number", "whole number": "integer", "true or false": "boolean"}
    schema: dict[str, Any] = {"type": types.get(entry.kind, "string")}
    if entry.unit:
        limits = {"minimum": entry.low, "maximum": entry.high}
        schema |= {name: limit for name, limit in limits.items() if limit not in (None, math.inf)}
    return schema
