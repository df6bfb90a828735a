"""Printed and generated descriptions of scenario fields match the code."""

from __future__ import annotations

import json
import runpy
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from pydrake.common.yaml import yaml_load

from drake_teleop.cli.main import main
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import scenarios_dir
from drake_teleop.station import scenario_reference
from drake_teleop.station.channel.network import NetworkConfig
from drake_teleop.station.environment.slot import Slot
from drake_teleop.station.operator.operator import MinimumJerk, Sine
from drake_teleop.station.operator.task import Press
from drake_teleop.station.scenario import (
    LoadScenario,
    Scenario,
    ScenarioFromData,
    ScenarioNames,
    replace,
)
from drake_teleop.station.scenario_reference import to_commented_yaml, write_scenario
from drake_teleop.station.sensor.presets import PRESETS

DOCS = Path(__file__).parents[1] / "docs"
REFERENCE = runpy.run_path(str(DOCS / "make_reference.py"))
reference_page, json_schema = REFERENCE["reference_page"], REFERENCE["scenario_schema"]


def loaded(text: str) -> Scenario:
    return ScenarioFromData(yaml_load(data=text), "printed.yaml")


def uncomment_block(text: str, head: str) -> str:
    """Return the text with one commented block activated."""
    lines = text.splitlines()
    (first,) = (i for i, line in enumerate(lines) if line.startswith(f"{head}  #"))
    mark = head[: head.index("#") + 1]
    end = first + 1
    while end < len(lines) and lines[end].startswith(f"{mark}   "):
        end += 1
    lines[first:end] = [line.replace("# ", "", 1) for line in lines[first:end]]
    return "\n".join(lines)


def test_docs_equal_the_generated_reference() -> None:
    """`python docs/make_reference.py` writes them."""
    assert (DOCS / "scenario.md").read_text(encoding="utf-8") == reference_page()
    assert (DOCS / "scenario.schema.json").read_text(encoding="utf-8") == json_schema()


def test_every_link_in_the_reference_leads_to_a_block() -> None:
    links = {part.partition(")")[0] for part in reference_page().split("](#")[1:]}
    titles = [line[3:] for line in reference_page().splitlines() if line.startswith("## ")]
    # GitHub's anchors: lower case, without points, colons and exclamation marks.
    anchors = [title.lower().translate({ord(" "): "-", **dict.fromkeys(map(ord, ".:!"))})
               for title in titles]  # fmt: skip
    assert len(anchors) == len(links)
    assert set(anchors) == links


@pytest.mark.parametrize("name", ScenarioNames())
def test_a_printed_scenario_loads_back(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["scenario", name])
    assert stop.value.code == 0
    assert loaded(capsys.readouterr().out) == LoadScenario(name)


def test_a_file_with_a_preset_keeps_it() -> None:
    scenario = loaded("wrist_sensor: {preset: ati_gamma_imu, force_noise: 0.125}")
    again = loaded(to_commented_yaml(scenario))
    assert again == scenario
    assert again.wrist_sensor.preset == "ati_gamma_imu"


def test_preset_can_be_changed_in_the_printed_scenario() -> None:
    text = to_commented_yaml(Scenario()).replace("preset: custom", "preset: ati_gamma_imu")
    assert loaded(text).wrist_sensor == PRESETS["ati_gamma_imu"]


def test_commented_blocks_can_be_activated() -> None:
    text = to_commented_yaml(Scenario())
    assert loaded(uncomment_block(text, "# slot:")).slot == Slot()
    assert loaded(uncomment_block(text, "  # task: !Press")).operator.task == Press()
    assert loaded(uncomment_block(text, "  # intent:")).operator.intent == [MinimumJerk(), Sine()]
    assert loaded(uncomment_block(text, "  # backward:")).channel.backward == NetworkConfig()


def test_shipped_scenarios_are_listed_without_a_name(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["scenario"])
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ScenarioNames()


def parse_without_tags(text: str) -> Any:
    """Parse the text without tags, which schemas do not support."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(inner) for key, inner in value.items() if key != "_tag"}
        return [plain(item) for item in value] if isinstance(value, list) else value

    return plain(yaml_load(data=text))


SCHEMA = jsonschema.Draft202012Validator(json.loads(json_schema()))


@pytest.mark.quick_cases(3)
@pytest.mark.parametrize("name", ScenarioNames())
def test_schema_accepts_shipped_scenarios(name: str) -> None:
    jsonschema.Draft202012Validator.check_schema(SCHEMA.schema)
    SCHEMA.validate(parse_without_tags((scenarios_dir() / f"{name}.yaml").read_text()))


def test_schema_accepts_every_field() -> None:
    SCHEMA.validate(parse_without_tags(to_commented_yaml(Scenario())))


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("force_scaling: {sgima: 0.5}", ["force_scaling"]),
        ("force_scaling: {sigma: half}", ["force_scaling", "sigma"]),
        ("force_scaling: {sigma: -1}", ["force_scaling", "sigma"]),
        ("simulation: {duration: null}", ["simulation", "duration"]),
        ("simulation: {seed: 0.5}", ["simulation", "seed"]),
        ("simulation: {integrator: euler}", ["simulation", "integrator"]),
        ("slave: {position: [0.5, 0.0]}", ["slave", "position"]),
        ("slave: {position: [0.5, 0.0, 9.0]}", ["slave", "position", 2]),
        ("load_estimator: {enabled: 1}", ["load_estimator", "enabled"]),
        ("operator: {task: {force: 1000.0}}", ["operator", "task"]),
        ("slot: 1", ["slot"]),
    ],
)
def test_schema_rejects_what_the_library_rejects(text: str, field: list[str | int]) -> None:
    with pytest.raises(DrakeTeleopError):
        loaded(text)
    (error,) = SCHEMA.iter_errors(parse_without_tags(text))
    assert list(error.absolute_path) == field


def test_scenario_that_reads_back_differently_is_not_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = LoadScenario("free_motion_force")
    scenario.slave.model = "arm.sdf #2.sdf"
    write_scenario(tmp_path / "whole.yaml", scenario)
    unquoted = to_commented_yaml(scenario).replace("'arm.sdf #2.sdf'", "arm.sdf #2.sdf")
    assert unquoted != to_commented_yaml(scenario)
    monkeypatch.setattr(scenario_reference, "to_commented_yaml", lambda _: unquoted)
    with pytest.raises(DrakeTeleopError, match="YAML cannot represent the scenario's block slave;"):
        write_scenario(tmp_path / "cut.yaml", scenario)
    assert not (tmp_path / "cut.yaml").exists()


def test_written_paths_are_those_of_the_working_directory(tmp_path, monkeypatch) -> None:
    (tmp_path / "out").mkdir()
    monkeypatch.chdir(tmp_path)
    scenario = replace(Scenario(), slave__model="arm.urdf", channel__trace="ping.csv")
    write_scenario(Path("out/scenario.yaml"), scenario)
    found = LoadScenario(Path("out/scenario.yaml"))
    read = [found.slave.model, found.channel.trace]
    assert read == [str(tmp_path / name) for name in ("arm.urdf", "ping.csv")]
