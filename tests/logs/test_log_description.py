from __future__ import annotations

import json
import re
import runpy
from pathlib import Path

import pytest
import yaml

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.logs.read.description import Description, load_description

DOCS = Path(__file__).parents[2] / "docs"
PAGE = DOCS / "log-description.md"
json_schema = runpy.run_path(str(DOCS / "make_reference.py"))["log_description_schema"]
SCHEMA = DOCS / "log-description.schema.json"
EXAMPLES = [
    example
    for page in (PAGE, DOCS / "logs.md")
    for example in re.findall(r"```yaml\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
]
THREE_INSTRUMENTS, AT_REST, *_ = EXAMPLES


@pytest.mark.parametrize("example", EXAMPLES)
def test_the_examples_of_the_page_are_valid(tmp_path: Path, example: str) -> None:
    path = tmp_path / "log.yaml"
    path.write_text(example, encoding="utf-8")
    description = load_description(path)
    streams = [s for s in (description.wrench, description.imu, description.static) if s]
    assert streams
    assert all(stream.file.parent == tmp_path for stream in streams)


def test_the_page_documents_every_field() -> None:
    page = PAGE.read_text(encoding="utf-8")
    assert len(EXAMPLES) == 5
    schema = Description.model_json_schema()
    fields = {name for entry in schema["$defs"].values() for name in entry["properties"]}
    units = {
        unit
        for entry in schema["$defs"].values()
        for unit in entry["properties"].get("unit", {}).get("enum", [])
    }
    for word in sorted(fields | units):
        assert re.search(rf"`([a-z_]+\.)?{re.escape(word)}`", page), word


BASE = yaml.safe_load(THREE_INSTRUMENTS)


@pytest.mark.parametrize(
    ("where", "value", "words"),
    [
        (("wrench", "forse"), {}, ["wrench.forse", "unknown field", "did you mean 'force'"]),
        (("zzz",), {}, ["zzz: unknown field", "the fields are gravity, wrench"]),
        (("wrench", "force", "unit"), "kilo", ["wrench.force.unit", "'N'", "'lbf'", "'kilo'"]),
        (("wrench", "time", "unit"), "hours", ["wrench.time.unit", "'hours'"]),
        (("wrench", "time", "rate"), 100.0, ["wrench.time", "either column or rate"]),
        (("wrench", "sign"), 2, ["wrench.sign", "1 or -1"]),
        (("wrench", "frame"), "tool", ["wrench.frame", "3x3 rotation matrix"]),
        (("imu", "frame"), [[0, 1, 0], [1, 0, 0], [0, 0, 1]], ["imu.frame", "not a rotation"]),
        (("imu", "frame"), [[2, 0, 0], [0, 1, 0], [0, 0, 1]], ["imu.frame", "not a rotation"]),
        (("imu", "position"), [0.1, 0.2], ["imu.position"]),
        (("imu", "position"), [0.1, 0.2, float("nan")], ["imu.position", "finite"]),
        (("imu", "position"), "somewhere", ["imu.position", "three numbers [m], or the word auto"]),
        (("wrench", "frame"), "auto", ["wrench.frame", "3x3 rotation matrix"]),
        (("imu", "specific_force"), None, ["imu", "give specific_force"]),
        (("pose", "frame"), "base", ["pose", "must be the word sensor"]),
        (("pose", "orientation", "form"), "angles", ["pose.orientation.form", "'matrix'"]),
        (("gravity",), "down", ["gravity"]),
        (("gravity",), -9.81, ["gravity", "the magnitude of gravity is -9.81: remove the sign"]),
        (("gravity",), 0, ["the largest component of gravity is 0"]),
        (("gravity",), [0, 0.0, 0], ["the largest component of gravity is 0"]),
        (("gravity",), [0, 0, -981], ["the largest component of gravity is 981"]),
        (("wrench",), None, ["no wrench"]),
        (("pose",), None, ["the angular velocity is missing", "imu.angular_velocity"]),
        (("wrench", "file"), None, ["wrench.file"]),
    ],
)
def test_errors_name_file_and_field(
    tmp_path: Path, where: tuple[str, ...], value: object, words: list[str]
) -> None:
    data = yaml.safe_load(THREE_INSTRUMENTS)
    place = data
    for key in where[:-1]:
        place = place[key]
    place[where[-1]] = value
    _expect_error(tmp_path, yaml.safe_dump(data), words)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("wrench: [", ["is not YAML"]),
        ("- 1", ["contains no fields"]),
        ("", ["contains no fields"]),
        ("static: {}", ["static.file: is missing", "add file"]),
        (yaml.safe_dump({"wrench": BASE["wrench"]}), ["without kinematics", "add imu or pose"]),
        (AT_REST + THREE_INSTRUMENTS.replace("gravity: 9.82 ", "#"), ["cannot be combined"]),
    ],
)
def test_invalid_description_file_raises_error(tmp_path: Path, text: str, words: list[str]) -> None:
    _expect_error(tmp_path, text, words)


def test_auto_without_the_required_streams_raises_error(tmp_path: Path) -> None:
    data = yaml.safe_load(THREE_INSTRUMENTS)
    omega = {"columns": ["wx", "wy", "wz"]}
    data["imu"] |= {"frame": "auto", "position": "auto", "angular_velocity": omega}
    path = tmp_path / "log.yaml"
    path.write_text(yaml.safe_dump(data))
    imu = load_description(path).imu
    assert imu and imu.is_mounting_auto and (imu.frame, imu.position) == ("auto", "auto")
    del data["pose"]
    _expect_error(tmp_path, yaml.safe_dump(data), ["imu.frame: auto", "add pose"])
    data["imu"]["frame"] = "sensor"
    del data["imu"]["specific_force"]
    _expect_error(tmp_path, yaml.safe_dump(data), ["imu", "require specific_force: add"])


@pytest.mark.parametrize("unused", [{"sign": -1}, {"position": [0.0, 0.0, 0.1]}])
def test_settings_of_a_missing_specific_force_raise_error(tmp_path: Path, unused: dict) -> None:
    data = yaml.safe_load(THREE_INSTRUMENTS)
    data["imu"]["angular_velocity"] = {"columns": ["wx", "wy", "wz"]}
    data["imu"].pop("specific_force", None)
    data["imu"] |= {"sign": 1, "position": [0.0, 0.0, 0.0], "frame": "sensor"}
    (tmp_path / "log.yaml").write_text(yaml.safe_dump(data))
    assert load_description(tmp_path / "log.yaml").imu
    data["imu"] |= unused
    _expect_error(tmp_path, yaml.safe_dump(data), ["imu", "sign, position, auto require"])


def test_missing_description_raises_error(tmp_path: Path) -> None:
    with pytest.raises(DrakeTeleopError, match="no such log description"):
        load_description(tmp_path / "log.yaml")


def _expect_error(folder: Path, text: str, words: list[str]) -> None:
    path = folder / "log.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(DrakeTeleopError) as error:
        load_description(path)
    message = str(error.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    for word in words:
        assert word in message


def test_shipped_schema_matches_the_code() -> None:
    assert json.loads(SCHEMA.read_text(encoding="utf-8")) == json.loads(json_schema())


def test_schema_contains_every_field_and_all_forms_of_gravity() -> None:
    schema = json.loads(json_schema())
    assert set(schema["properties"]) == set(Description.model_fields)
    assert schema["additionalProperties"] is False
    kinds = [form["type"] for form in schema["properties"]["gravity"]["anyOf"]]
    assert kinds == ["number", "array", "string"]
    assert "inverse" in schema["$defs"]["Orientation"]["properties"]


@pytest.mark.parametrize("given", [{"child_frame": "tool0"}, {"child_frame": "a", "topic": None}])
def test_child_frame_without_topic_is_refused(tmp_path: Path, given: dict) -> None:
    data = yaml.safe_load(EXAMPLES[0])
    data["pose"] |= given
    (tmp_path / "log.yaml").write_text(yaml.safe_dump(data))
    with pytest.raises(DrakeTeleopError, match="pose: child_frame requires a topic"):
        load_description(tmp_path / "log.yaml")


@pytest.mark.parametrize("example", [THREE_INSTRUMENTS, AT_REST])
def test_the_remedy_of_automatic_gravity_is_valid(tmp_path: Path, example: str) -> None:
    path = tmp_path / "log.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(example) | {"gravity": "auto"}))
    with pytest.raises(DrakeTeleopError, match="requires a wrench and a pose alone: give the vec"):
        load_description(path)
    path.write_text(yaml.safe_dump(yaml.safe_load(example) | {"gravity": [0, 1, -9.7]}))
    load_description(path)
