"""Write the parts of docs/ about fields of scenarios and log descriptions, from the code.

Usage: `python docs/make_reference.py`.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from drake_teleop.common.config import FieldInfo, fields_of
from drake_teleop.common.texts import format_yaml_value
from drake_teleop.logs.read.description import Description
from drake_teleop.station.scenario import Scenario
from drake_teleop.station.scenario_reference import allowed_values, comment_of_field

DOCS = Path(__file__).parent

_SCENARIO_PAGE_HEAD = """\
# Every field of a scenario

A scenario is a YAML file; a field that is not in the file has its default. This page is made from
the code (`python docs/make_reference.py`).

- `drake-teleop scenario press > mine.yaml` writes the shipped scenario `press` with every field,
  its range and its meaning, as a template; `drake-teleop run mine.yaml` runs the file.
- Files are read as YAML 1.2: `1e-3` is a number, `yes` and `1:30` are words. A repeated field, an
  unknown field, and a number such as `010` are errors.
- [scenario.schema.json](scenario.schema.json) is the JSON schema. Copy it beside your scenario: an
  editor with this schema completes and checks the fields, for instance with the first line
  `# yaml-language-server: $schema=scenario.schema.json`. Configure the editor for tags like
  `!Touch`, which select the kind of a block: in VS Code
  `"yaml.customTags": ["!Touch mapping", ...]`.

Frames: W is the world, z up; B the base of the master, E its stylus; S the wrist sensor, A its
accelerometers. `p_WS` is the position of S's origin in W, `R_SA` the rotation of A in S. Equations
and sections are those of the paper; "estimate" marks a value of this project, not of the paper.
"""


def reference_page() -> str:
    """Return the scenario reference in Markdown: a table of fields, ranges, meanings per block."""
    return _SCENARIO_PAGE_HEAD + "".join(_sections_of_page(Scenario(), ""))


def scenario_schema() -> str:
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "Scenario"}
    return json.dumps(schema | _object_schema(Scenario()), indent=1) + "\n"


def _sections_of_page(config: Any, path: str) -> Iterator[str]:
    entries = fields_of(config)
    yield "\n| field | default | takes | meaning |\n|---|---|---|---|\n"
    for entry in entries:
        default = (
            format_yaml_value(entry.default) if entry.kind != "block" or not entry.default else ""
        )
        takes = _links_to_blocks(entry, path) if entry.kind == "block" else allowed_values(entry)
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
    schema["description"] = comment_of_field(entry)
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


def log_description_schema() -> str:
    schema: dict[str, Any] = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    schema |= Description.model_json_schema()
    # With a topic, only the file is required.
    for name in ("Wrench", "Imu", "Pose"):
        stream = schema["$defs"][name]
        without = [field for field in stream["required"] if field != "file"]
        stream |= {"required": ["file"], "anyOf": [{"required": ["topic"]}, {"required": without}]}
    for name in ("Force", "Torque", "Acceleration", "AngularVelocity", "Position"):
        del schema["$defs"][name]["required"]
    return json.dumps(schema, indent=2) + "\n"


def main() -> None:
    texts = {
        "scenario.md": reference_page(),
        "scenario.schema.json": scenario_schema(),
        "log-description.schema.json": log_description_schema(),
    }
    for name, text in texts.items():
        (DOCS / name).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
