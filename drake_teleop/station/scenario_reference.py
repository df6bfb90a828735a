"""Commented YAML of scenarios, generated from the dataclasses."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
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

_YAML_FILE_HEADING = """\
# Each field has its value, [the permitted values] and its meaning. Omitted fields have their
# defaults. Lines that begin with # are fields and blocks that this scenario does not use; remove
# the # to use them.
"""


def to_commented_yaml(scenario: Scenario) -> str:
    """Return the scenario as YAML text; a comment explains each field."""
    return _YAML_FILE_HEADING + "\n".join(_yaml_of_block(scenario)) + "\n"


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

    A DrakeTeleopError is raised if YAML cannot represent a text of the scenario.
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


def allowed_values(entry: FieldInfo) -> str:
    words = entry.limits_or_choices if entry.unit or entry.choices else entry.kind
    if entry.list_depth:
        words = f"{entry.length or 'any number'} of {words}"
    if entry.is_mapping:
        words = f"mapping of names to {words}"
    return f"{words}, or null" if entry.optional else words


def comment_of_field(entry: FieldInfo) -> str:
    return f"[{allowed_values(entry)}] {entry.meaning}" if entry.kind != "block" else entry.meaning


def _yaml_of_block(config: Any) -> list[str]:
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
            lines += _yaml_of_nested_block(entry)
            continue
        line = f"{starts[entry.name]:{column}}  # {comment_of_field(entry)}"
        of_preset = preset is not None and entry.default == getattr(preset, entry.name)
        lines.append(f"# {line}" if of_preset and entry.name != "preset" else line)
    return lines


def _yaml_of_nested_block(entry: FieldInfo) -> list[str]:
    if entry.default:
        return _yaml_of_field(entry, entry.default)
    blocks = [block() for block in entry.blocks]
    if entry.list_depth:
        return _prefix_all("# ", _yaml_of_field(entry, blocks))
    return [line for block in blocks for line in _prefix_all("# ", _yaml_of_field(entry, block))]


def _yaml_of_field(entry: FieldInfo, value: Any) -> list[str]:
    if not entry.list_depth:
        head = f"{entry.name}:{_yaml_tag(entry, value)}  # {entry.meaning}"
        return [head, *_prefix_all("  ", _yaml_of_block(value))]
    lines = [f"{entry.name}:  # {entry.meaning}"]
    for item in value:
        lines += [f"  -{_yaml_tag(entry, item)}", *_prefix_all(" " * 4, _yaml_of_block(item))]
    return lines


def _yaml_tag(entry: FieldInfo, config: Any) -> str:
    return f" !{type(config).__name__}" if len(entry.blocks) > 1 else ""


def _prefix_all(prefix: str, lines: list[str]) -> list[str]:
    return [prefix + line for line in lines]
