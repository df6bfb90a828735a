"""Invalid and ambiguous YAML and JSON raise one line with file and field."""

from __future__ import annotations

import numpy as np
import polars as pl
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from drake_teleop.common.errors import MAX_ERROR_LINE_LENGTH, DrakeTeleopError, to_one_line
from drake_teleop.common.texts import parse_yaml, read_json, read_yaml, to_yaml_text
from drake_teleop.lab.studies.study import LoadStudy
from drake_teleop.load.identification import Identification
from drake_teleop.load.trajectory import FourierTrajectory
from drake_teleop.logs.check.draft import draft_description
from drake_teleop.logs.read.description import load_description
from drake_teleop.logs.read.table_files import read_table
from drake_teleop.station.master.data_sheets import Master
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.scenario_reference import write_scenario

ALIASES = "a: &a [1, 1]\n" + "\n".join(
    f"{to}: &{to} [{', '.join([f'*{of}'] * 20)}]" for of, to in zip("abcd", "bcde", strict=True)
)
ALL_READERS = {
    "a field twice": ("channel: {}\nchannel: {}", ":channel: is defined twice (line 2)"),
    "an inner field twice": ("a: {b: {c: 1, c: 2}}", ":a.b.c: is defined twice"),
    "a number for a name": ("3: 1", "a field's name must be a word, not '3'"),
    "a flag for a name": ("true: 1", "a field's name must be a word, not 'true'"),
    "a list for a name": ("[1, 2]: 1", "a field's name must be a word"),
    "octal": ("simulation: {duration: 010}", ":simulation.duration: '010' may be octal"),
    "400 digits": (f"a: {'9' * 400}", ":a: an integer of 400 digits is too long"),
    "an open end": ("[" * 2000, "nested too deeply"),
    "brackets": ("a: " + "[" * 2000 + "]" * 2000, "nested too deeply"),
    "braces": ("{a: " * 2000 + "1" + "}" * 2000, "nested too deeply"),
    "its own alias": ("a: &a [*a]", "nested too deeply"),
    "aliases of aliases": (ALIASES, "the file has more than 50000 values"),
    "the name of a tag": ("operator: {task: {_tag: 3}}", ":operator.task._tag: there is no such"),
    "code": ("a: !!python/object/apply:os.system [ls]", ":a: a list cannot have the tag"),
    "bytes": ("a: !!binary aGk=", ":a: 'aGk=' does not match the tag 'binary'"),
    "a word that is called a number": ("a: !!int x", ":a: 'x' does not match the tag 'int'"),
    "two documents": ("--- 1\n--- 2", "is not YAML (line 2"),
    "a character of control": (
        "a: 1\nb: \x00",
        "is not YAML (line 2 contains the character U+0000)",
    ),
    "another encoding": ("a: \xff", "is not UTF-8 text"),
}


def message(read, path, text: str) -> str:
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(DrakeTeleopError) as caught:
        read(path)
    line = str(caught.value)
    assert line.startswith(str(path))
    assert len(line) <= MAX_ERROR_LINE_LENGTH and len(line.splitlines()) == 1
    return line


@pytest.mark.parametrize(
    "read", [LoadScenario, LoadStudy, load_description, FourierTrajectory.load]
)
@pytest.mark.parametrize("name", ALL_READERS)
def test_ambiguous_yaml_raises(read, name, tmp_path):
    text, expected = ALL_READERS[name]
    assert expected in message(read, tmp_path / "x.yaml", text)


@pytest.mark.parametrize(
    "read", [LoadScenario, LoadStudy, load_description, FourierTrajectory.load]
)
def test_empty_file_raises(read, tmp_path):
    message(read, tmp_path / "x.yaml", "")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("_hidden: 1", ":_hidden: there is no such field"),
        ("<<: {seed: 1}", ":<<: there is no such field"),
        ("simulation: {duration: 1:30}", ":simulation.duration: expected a number, found '1:30'"),
        ("simulation: {duration: 0x10}", ":simulation.duration: expected a number"),
        ("simulation: {duration: 2001-01-01}", ":simulation.duration: expected a number"),
        ("simulation: {duration: 1e400}", ":simulation.duration: inf s is outside"),
        ("simulation: {seed: -1}", ":simulation.seed: -1 is outside 0 to 4294967295;"),
        ("simulation: {seed: 5000000000}", ":simulation.seed: 5000000000 is outside"),
        ("simulation: {seed: true}", ":simulation.seed: expected a whole number, found True"),
        ("wrist_sensor: {ideal: yes}", ":wrist_sensor.ideal: expected true or false, found 'yes'"),
        ("operator: {task: !Press [1]}", ":operator.task: a list cannot have the tag '!Press'"),
        ("", "found nothing"),
        ("true", "found True"),
        (f"wrist_sensor: {{preset: {'x' * 5000}}}", ":wrist_sensor.preset: 'xxx"),
        (f"operator: {'x' * 5000}", ":operator: expected a mapping"),
    ],
)
def test_invalid_scenario_raises(text, expected, tmp_path):
    assert expected in message(LoadScenario, tmp_path / "x.yaml", text)


STREAM = "wrench: {{file: w.csv, time: {}, force: {{columns: [a]}}, torque: {{columns: [b]}}}}\n{}"


@pytest.mark.parametrize(
    ("time", "more", "expected"),
    [
        ("{rate: true}", "", ":wrench.time.rate: "),
        ("{rate: '100'}", "", ":wrench.time.rate: "),
        ("{rate: 1:30}", "", ":wrench.time.rate: "),
        ("{rate: 100, my field: 1}", "", ":wrench.time.my field: unknown field"),
        ("{rate: 100}", "_x: 1", ":_x: unknown field"),
        ("{rate: 100}", "gravity: true", ":gravity: "),
    ],
)
def test_invalid_description_raises(time, more, expected, tmp_path):
    path = tmp_path / "x.yaml"
    assert expected in message(load_description, path, STREAM.format(time, more))


def test_trajectory_with_unknown_field_raises(tmp_path):
    path, joint = tmp_path / "x.yaml", "{q0: 0, rho: [1], delta: [1]%s}"
    path.write_text(f"frequency: 1\njoints: {{a: {joint % ''}}}")
    assert FourierTrajectory.load(path).period == 1.0
    text = f"frequency: 1\njoints: {{a: {joint % ', phase: 1'}}}"
    assert "there is no field 'phase'" in message(FourierTrajectory.load, path, text)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[" * 200_000, "nested too deeply"),
        ('{"phi": ' * 200_000, "nested too deeply"),
        ('{"phi": 1, "phi": 2}', ":phi: is defined twice"),
        ("", "is not JSON (line 1"),
        ("\xff", "is not UTF-8 text"),
    ],
)
def test_invalid_load_file_raises(text, expected, tmp_path):
    assert expected in message(Identification.load, tmp_path / "x.json", text)


@pytest.mark.parametrize(
    ("name", "old", "value"),
    [
        ("condition_number", "4.0", '"1"'),
        ("condition_number", "4.0", "true"),
        ("condition_number", "4.0", "9" * 400),
        ("delay_s", "0.0", "1e300"),
    ],
)
def test_nonnumeric_value_in_a_load_file_raises(name, old, value, tmp_path, identified):
    path = tmp_path / "x.json"
    identified.save(path)
    text = path.read_text()
    changed = text.replace(f'"{name}": {old}', f'"{name}": {value}')
    assert changed != text
    assert f":{name}: " in message(Identification.load, path, changed)


@pytest.fixture
def identified():
    ones = [1.0] * 16
    return Identification(
        phi=np.array([1.0, 0.1, 0.1, 0.1, 0.2, 0.0, 0.0, 0.2, 0.0, 0.2]),
        offsets=np.zeros(6),
        covariance=np.diag(ones),
        identifiable=np.zeros(16, bool),
        condition_number=4.0,
        delay_s=0.0,
        residual_rms=np.zeros(6),
        method="batch least squares",
        samples=100,
    )


def test_huge_file_is_not_read_completely(monkeypatch, tmp_path):
    monkeypatch.setattr("drake_teleop.common.texts._MAX_YAML_VALUES", 100)
    path = tmp_path / "x.yaml"
    expected = (
        "(line 201: the file has more than 100 values)"  # but not a bracket that is not closed
    )
    assert expected in message(read_yaml, path, "- 1\n" * 250 + "[")


def test_scalars_follow_yaml_1_2(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text(
        "[0, -3, 1e-3, .5, 5., -.inf, ~, null, true, FALSE, no, 1:30, '010', 1_000, 0o7, '', 0.010]"
    )
    words = ["no", "1:30", "010", "1_000", "0o7", ""]
    expected = [0, -3, 1e-3, 0.5, 5.0, -float("inf"), None, None, True, False, *words, 0.01]
    assert read_yaml(path) == expected
    assert [type(x) for x in read_yaml(path)] == [type(x) for x in expected]


def test_byte_order_mark_is_ignored(tmp_path):
    path = tmp_path / "x"
    path.write_bytes(b"\xef\xbb\xbf[1]")
    assert read_yaml(path) == read_json(path) == [1]


def test_overlong_integers_raise():
    with pytest.raises(DrakeTeleopError, match=r"simulation\.duration: 9999.* is outside"):
        replace(Scenario(), simulation__duration=10**400 - 1).check()


def test_shortened_line_keeps_beginning_and_end():
    line = to_one_line("begin\n" + "x" * 1000 + " \x1b[31m end")
    assert len(line) == MAX_ERROR_LINE_LENGTH
    assert line.startswith("begin x") and line.endswith("x ?[31m end")


@pytest.mark.parametrize(
    ("load", "name", "expected"),
    [
        (LoadScenario, "prees", "no scenario 'prees'; did you mean 'press'?"),
        (LoadScenario, "press.yml", "did you mean 'press'?"),
        (LoadScenario, "xyz", "give a YAML file or one of contact_transition, "),
        (LoadStudy, "scaling_tuch", "no study 'scaling_tuch'; did you mean 'scaling_touch'?"),
    ],
)
def test_misspelt_name_gets_a_suggestion(load, name, expected):
    with pytest.raises(DrakeTeleopError) as error:
        load(name)
    assert expected in str(error.value)


WORDS = st.one_of(
    st.text(max_size=40),
    st.sampled_from(["1e-3", "010", "0x1f", "1:30", "yes", "null", "~", ".inf", "<<", "=", "a #b"]),
    st.from_regex(r"[-+.0-9eE_:xob#,{}\[\]&*!|>'\"%@`~? ]{1,8}", fullmatch=True),
)
DATA = st.recursive(
    st.one_of(
        WORDS, st.booleans(), st.none(), st.integers(-(10**17), 10**17), st.floats(allow_nan=False)
    ),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.dictionaries(WORDS.filter(lambda w: w != "_tag"), inner, max_size=3),
    ),
    max_leaves=8,
)


@pytest.mark.slow
@given(DATA)
def test_written_yaml_is_read_back(data) -> None:
    """Read the text with this package and with YAML 1.1, whose numbers and booleans differ."""
    text = to_yaml_text(data, head=["a\nb: 1"])
    assert parse_yaml(text, "text") == data
    assert yaml.safe_load(text) == data


def test_comments_follow_their_fields() -> None:
    data = {"a": {"b": "x: #", "c": [1.5, 2]}, "b": [{"_tag": "!Wall", "b": "two\nlines"}]}
    text = to_yaml_text(data, head=["above"], comments={"a.b": "of a", "b": "of b"})
    lines = text.splitlines()
    assert lines[0] == "# above" and "  b: 'x: #'  # of a" in lines and "b:  # of b" in lines
    assert parse_yaml(text, "text", tagged=True) == data
    with pytest.raises(DrakeTeleopError, match="cannot be written"):
        to_yaml_text({"a": (1, 2)})


@pytest.mark.parametrize("word", ["1e-3", "010", "a\nb: 1", "x # y", "\x1b[31m", "!Touch {}"])
def test_written_scenario_is_read_back(tmp_path, word) -> None:
    path = tmp_path / "scenario.yaml"
    device = Master(model="haply_inverse3")
    scenario = replace(Scenario(), description=word, slave__sensor_frame=word, master=device)
    write_scenario(path, scenario)
    assert LoadScenario(path).description == word
    assert LoadScenario(path).slave.sensor_frame == word


def test_column_names_stay_inside_comments_of_a_draft(tmp_path) -> None:
    path = tmp_path / "x.parquet"
    names = ["t", "fx", "fy", "fz", "a\nimu: {file: /etc/passwd}\n#"]
    pl.DataFrame({name: np.arange(5.0) for name in names}).write_parquet(path)
    draft = parse_yaml(draft_description(read_table(path), tmp_path).text(), "draft")
    assert set(draft) == {"wrench"}
