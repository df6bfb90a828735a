"""Invalid scenarios and logs give one error line with file and field, and exit status 2."""

from __future__ import annotations

import json

import numpy as np
import pytest

from drake_teleop.cli.main import main

SCENARIOS = {
    "unknown block": ("wrist_senser: {ideal: true}", "wrist_sensor"),
    "unknown field": ("wrist_sensor: {force_nois: 1.0}", "force_noise"),
    "unit in the value": ("channel: {delay: 200 ms}", "channel.delay"),
    "milliseconds for seconds": ("channel: {delay: 200}", "channel.delay"),
    "millimetres for metres": ("slave: {position: [550, 0, 450]}", "slave.position"),
    "not a number": ("simulation: {duration: .nan}", "simulation.duration"),
    "negative": ("force_scaling: {sigma: -0.5}", "force_scaling.sigma"),
    "wrong length": ("wrist_sensor: {offset: [1, 2, 3]}", "wrist_sensor.offset"),
    "word for a number": ("rates: {sensor_hz: fast}", "rates.sensor_hz"),
    "number for a block": ("operator: 3", "operator"),
    "unknown word": ("operator: {grip: iron}", "operator.grip"),
    "unknown variant": ("operator: {intent: [!Circle {radius: 1}]}", "operator.intent[0]"),
    "bandwidth beyond the rate": ("rates: {sensor_hz: 1000}", "wrist_sensor.bandwidth_hz"),
    "unknown preset": ("wrist_sensor: {preset: jr3}", "wrist_sensor.preset"),
    "number for a word": ("wrist_sensor: {preset: 3}", "wrist_sensor.preset"),
    "axes that are no rotation": (
        "wrist_sensor: {R_SA: [1, 0, 0, 0, 1, 0, 0, 0, -1]}",
        "wrist_sensor.R_SA",
    ),
    "eta without a gripper": ("force_scaling: {sigma: 0, eta: 0.5}", "force_scaling.eta"),
    "out of reach": ("slave: {position: [1.4, 0, 0.4]}", "slave.position"),
    "master out of reach": ("master: {position: [0.0, 0.0, 0.45]}", "master"),
    "not a mapping": ("- 1\n- 2", "mapping"),
    "not YAML": ("simulation: {duration: [", "YAML"),
    "true for a number": ("simulation: {duration: true}", "simulation.duration"),
    "fixed steps too long for contact": (
        "{sheet_spring: {}, simulation: {integrator: runge_kutta2}}",
        "simulation.max_step",
    ),
    "two leaves": ("{sheet_spring: {}, environment: [!SheetSpring {}]}", "yaml:environment"),
    "a slot too deep": ("slot: {depth: 0.5}", "slot.depth"),
    "bandwidth beyond joint control": (
        "joint_control: {velocity_bandwidth_hz: 700}",
        "joint_control.velocity_bandwidth_hz",
    ),
    "negative seed of the sensor": ("wrist_sensor: {unit: -1}", "wrist_sensor.unit"),
    "contact point in millimetres": ("slave: {tip: [0, 0, 112]}", "slave.tip"),
    "centre of mass without a mass": ("slave: {tool: {com: [0, 0, 0.1]}}", "slave.tool.mass"),
    "gripper of negative mass": (
        "force_scaling: {gripper_phi: [-1, 0, 0, 0, 0, 0, 0, 0, 0, 0]}",
        "force_scaling.gripper_phi",
    ),
    "scale too small for a method": (
        "{kinematic_scaling: {rotation_scale: 1.0e-5}, passivity: {method: wave}}",
        "passivity.method",
    ),
    "fraction for the seed": ("simulation: {seed: 0.5}", "simulation.seed"),
}

HEADER = (
    "t,f_x,f_y,f_z,tau_x,tau_y,tau_z,s_x,s_y,s_z,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z"
)


def rows(count: int = 50) -> np.ndarray:
    table = np.random.default_rng(0).normal(size=(count, 16))
    table[:, 0] = np.arange(count) * 1e-3
    return table


def write(path, table, header=HEADER):
    np.savetxt(path, table, delimiter=",", header=header, comments="")


def with_entry(row: int, column: int, value: float) -> np.ndarray:
    table = rows()
    table[row, column] = value
    return table


LOGS = {
    "a missing column": (lambda p: write(p, rows()[:, :3], "t,f_x,f_y"), "f_z"),
    "time that stands still": (lambda p: write(p, rows() * [0.0, *15 * [1.0]]), "never increase"),
    "time that runs backwards": (lambda p: write(p, with_entry(20, 0, -1.0)), "t"),
    "NaN": (lambda p: write(p, with_entry(20, 5, np.nan)), "tau_y"),
    "words among the numbers": (
        lambda p: p.write_text(HEADER + "\n" + ",".join(["1", "fast"] + ["0"] * 14) + "\n"),
        "f_x",
    ),
    "too few samples": (lambda p: write(p, rows(2)), "sample"),
    "an empty file": (lambda p: p.write_text(""), "empty"),
    "not a table": (lambda p: p.write_bytes(bytes(range(256)) * 8), "log.csv"),
}


def error_line(arguments, capsys) -> str:
    with pytest.raises(SystemExit) as exit_info:
        main([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    assert exit_info.value.code == 2
    lines = captured.err.strip().splitlines()
    assert len(lines) == 1, captured.err
    assert lines[0].startswith("error: ")
    return lines[0]


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENARIOS)
def test_a_malformed_scenario(name, tmp_path, capsys):
    text, expected = SCENARIOS[name]
    path = tmp_path / "scenario.yaml"
    path.write_text(text)
    line = error_line(["run", path, "--out", tmp_path / "out", "--quiet"], capsys)
    assert expected in line
    if name not in ("out of reach", "master out of reach"):
        assert "scenario.yaml" in line


def test_run_keeps_its_scenario_and_a_recorded_drive(tmp_path, capsys):
    own, drive = tmp_path / "scenario.yaml", tmp_path / "drive"
    drive.mkdir()
    for path in (own, drive / "scenario.yaml", drive / "inputs.csv"):
        path.write_text("{}  # mine")
    line = error_line(["run", own, "--out", tmp_path], capsys)
    assert "contains the input scenario.yaml, which the results would replace; give an" in line
    line = error_line(["run", own, "--out", drive], capsys)
    assert "drive: contains a recorded live session, which the results would replace" in line
    assert {path.read_text() for path in tmp_path.rglob("*.*")} == {"{}  # mine"}


def test_empty_output_folder_is_not_the_working_directory(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "'--out': the path is empty" in error_line(["run", "press", "--out", ""], capsys)
    assert not list(tmp_path.iterdir())


def test_an_unknown_scenario_lists_the_known_ones(tmp_path, capsys):
    line = error_line(["run", "free_moton", "--out", tmp_path], capsys)
    assert "free_motion_force" in line


@pytest.mark.parametrize("name", LOGS)
def test_a_malformed_log(name, tmp_path, capsys):
    make, expected = LOGS[name]
    path = tmp_path / "log.csv"
    make(path)
    line = error_line(["identify", path, "--out", tmp_path / "out", "--quiet"], capsys)
    assert "log.csv" in line
    assert expected in line


def test_a_log_that_is_not_there(tmp_path, capsys):
    assert "absent.csv" in error_line(["identify", tmp_path / "absent.csv"], capsys)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("wrench: {file: w.csv}\nunits: {}", "units"),
        ("wrench: {file: w.csv, colums: {}}", "colums"),
        ("wrench: [1, 2]", "wrench"),
        ("{", "log.yaml"),
    ],
)
def test_a_malformed_description(text, expected, tmp_path, capsys):
    path = tmp_path / "log.yaml"
    path.write_text(text)
    line = error_line(["identify", path, "--out", tmp_path / "out"], capsys)
    assert expected in line


@pytest.mark.parametrize(
    "content", ["", "{", "[]", json.dumps({"phi": [1.0] * 9}), json.dumps({"phi": "heavy"})]
)
def test_a_malformed_load(content, tmp_path, capsys):
    log, load = tmp_path / "log.csv", tmp_path / "load.json"
    write(log, rows())
    load.write_text(content)
    line = error_line(["eliminate", log, "--load", load, "--out", tmp_path / "out"], capsys)
    assert "load.json" in line
