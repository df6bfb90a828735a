"""Recipes of docs/extend.md."""

from __future__ import annotations

import dataclasses
import os
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from shown import type_in

from drake_teleop.cli.main import main
from drake_teleop.common.config import fields_of
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.registry import REGISTRIES, Registry, register_from_script
from drake_teleop.lab.identification import true_load
from drake_teleop.live.inputs import Inputs, csv_header, csv_row, read_inputs
from drake_teleop.live.scenarios import scenario_of_inputs
from drake_teleop.load.batch.methods import identify_batch
from drake_teleop.load.identification import Identification
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.read.table_files import TABLE_READERS
from drake_teleop.robots.connections import SINKS, SOURCES, open_sink, open_source
from drake_teleop.robots.export import export_load
from drake_teleop.robots.lines import JsonLineSource
from drake_teleop.station.environment.solids import Box, Wall
from drake_teleop.station.master.data_sheets import FIGURES
from drake_teleop.station.passivity.methods import (
    METHODS,
    PassivityConfig,
    PassivityMethod,
    step_addresses,
)
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import ENVIRONMENTS, LoadScenario, Scenario, ScenarioFromData
from drake_teleop.station.simulation import simulate
from drake_teleop.station.slave.plant import NominalSlave
from drake_teleop.station.station import MakeTeleopStation

pytestmark = pytest.mark.checks

ROOT = Path(__file__).parents[1]
RECIPES = (ROOT / "docs" / "extend.md").read_text(encoding="utf-8")
PHI = np.array([3.0, 0.1, -0.2, 0.3, 0.05, 0.0, 0.001, 0.06, 0.002, 0.02])


def block(first_line: str) -> str:
    (text,) = re.findall(rf"^```\w+\n# {re.escape(first_line)}\n(.*?)^```$", RECIPES, re.M | re.S)
    return text


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return a folder with the files of the page; remove the registered parts afterwards."""
    for name in ("parts.py", "share.yaml"):
        (tmp_path / name).write_text(block(name))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DRAKE_TELEOP_REGISTER", "")
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield tmp_path
    for table in REGISTRIES.values():
        for name in set(table) - set(table.shipped):
            table.remove(name)
    sys.modules.pop("parts", None)


def record(path: Path) -> None:
    """Write a log of free motion in the format of the page."""
    t = np.arange(0.0, 8.0, 2e-3)
    phases = np.outer(t, [3.1, 2.3, 4.7, 1.7, 2.9, 3.7, 5.3, 4.1, 1.3]) + np.arange(9.0)
    s, omega, alpha = np.split(np.sin(phases) * np.repeat([9.0, 2.0, 15.0], 3), 3, axis=1)
    wrench = np.arange(6.0) + non_contact_wrench(s, omega, alpha, PHI)
    np.column_stack([t, wrench, s, omega, alpha]).tofile(path)


@pytest.mark.slow
def test_the_command_line_runs_registered_parts_and_refuses_removed_ones(folder, capsys):
    record(folder / "log.f64")
    type_in("docs/extend.md", "drake-teleop --register parts.py parts")
    out = capsys.readouterr().out
    for line in ("share*", "data_sheet*", "Table*", ".f64*", "kilograms*"):
        assert line in out
    log = SimulationResult.read_parquet(folder / "out" / "run" / "log.parquet")
    np.testing.assert_allclose(log["true_contact_wrench_W"][0, 2], 2e5 * 1e-4, rtol=0.05)
    assert np.abs(log["force_to_master"]).max() > 0.0
    found = Identification.load(folder / "out" / "identify" / "identification.json")
    assert found.method == "data sheet's least squares"
    np.testing.assert_allclose(found.phi, PHI, atol=1e-3)
    recorded = folder / "out" / "run" / "scenario.yaml"
    assert "method: share" in recorded.read_text() and "!Table" in recorded.read_text()
    ENVIRONMENTS.remove("Table")
    with pytest.raises(
        DrakeTeleopError, match=r"environment\[0\]: '!Table' is not known; use one of"
    ):
        LoadScenario(recorded)
    METHODS.remove("share")
    TABLE_READERS.remove(".f64")
    for arguments, says in (
        (["run", str(recorded), "--out", "again"], "'!Table' is not known; use one of"),
        (["identify", "log.f64"], "log.f64: format '.f64' is not known; give a canonical log"),
    ):
        with pytest.raises(SystemExit):
            main(arguments)
        message = capsys.readouterr().err
        assert message.count("\n") == 1 and says in message


def test_a_scenario_with_a_removed_method_names_it(folder):
    register_from_script(folder / "parts.py")
    scenario = LoadScenario(folder / "share.yaml")
    METHODS.remove("share")
    with pytest.raises(DrakeTeleopError, match=r"passivity\.method: there is no passivity method"):
        MakeTeleopStation(scenario)


@pytest.mark.slow
def test_the_registered_share_scales_the_wrench(folder):
    """A share of 1 renders the wrench of no method, a share of 0 renders none."""
    register_from_script(folder / "parts.py")

    def force(**passivity):
        data = {
            "simulation": {"duration": 0.02, "settle": 0.0},
            "passivity": passivity,
            "channel": {"network": "lan"},
        }
        scenario = ScenarioFromData(data, "test.yaml")
        return simulate(MakeTeleopStation(scenario), scenario.simulation)["force_to_master"]

    nothing = force(method="none")
    assert np.abs(nothing).max() > 1.0  # weight of the tool
    np.testing.assert_array_equal(force(method="share", registered={"share": 1.0}), nothing)
    assert (force(method="share", registered={"share": 0.0}) == 0.0).all()


def test_parameters_of_a_registered_method_are_checked(folder):
    register_from_script(folder / "parts.py")
    for values, says in (
        ({"share": 2.0}, r"mine:passivity\.registered\.share: 2 is outside 0 to 1"),
        ({"shar": 0.5}, r"there is no such field; did you mean 'share'"),
    ):
        config = Scenario(passivity=PassivityConfig(method="share", registered=values))
        with pytest.raises(DrakeTeleopError, match=says):
            config.check("mine")
    with pytest.raises(DrakeTeleopError, match="method 'tdpa' has no registered parameters"):
        PassivityConfig(method="tdpa", registered={"share": 0.5}).check("mine")


def test_a_live_session_records_the_registered_name(folder):
    before = Inputs().with_changes({"method": 99}).method
    register_from_script(folder / "parts.py")
    inputs = Inputs().with_changes({"method": 99})
    assert inputs.method == before + 1
    assert scenario_of_inputs(Scenario(), None, inputs).passivity.method == "share"
    path = folder / "inputs.csv"
    path.write_text(csv_header() + csv_row(0, inputs) + csv_row(10, inputs))
    assert ",share," in path.read_text() and read_inputs(path)[0][1] == inputs
    METHODS.remove("share")
    with pytest.raises(DrakeTeleopError, match="has the unknown method 'share'"):
        read_inputs(path)


def test_export_source_and_sink_by_their_registered_names(folder):
    register_from_script(folder / "parts.py")
    rng = np.random.default_rng(1)
    s, omega, alpha = rng.normal(size=(3, 200, 3)) * [[[9.0]], [[2.0]], [[5.0]]]
    wrench = np.arange(6.0) + non_contact_wrench(s, omega, alpha, PHI)
    found = identify_batch(wrench, s, omega, alpha, method="data_sheet").identification
    assert export_load(found, "kilograms")[0] == "3.000\n"
    sink, source = object(), JsonLineSource(0, 0.002)
    SINKS.register("serial", lambda address: sink)
    SOURCES.register("serial", lambda address, rate_hz, joints: source)
    assert open_sink("serial://tty0") is sink
    assert open_source("serial://tty0", None, rate_hz=500.0) is source
    SINKS.remove("serial")
    with pytest.raises(
        DrakeTeleopError, match=r"serial://tty0: is not the address of a sink; give .*udp://"
    ):
        open_sink("serial://tty0")


def test_a_registry_refuses_shipped_and_impossible_names():
    table = Registry("colour of a test", {"red": 1})
    try:
        assert table.register("blue", 2) == 2 and table["blue"] == 2
        table.register("blue", 3)
        assert table["blue"] == 3
        table.remove("blue")
        for wrong in (
            lambda: table["blue"],
            lambda: table.remove("blue"),
            lambda: table.remove("red"),
            lambda: table.register("red", 2),
            lambda: table.register("a,b", 2),
        ):
            with pytest.raises(DrakeTeleopError, match="colour of a test"):
                wrong()
        with pytest.raises(
            DrakeTeleopError, match=r"here: there is no .* 'rid'; did you mean 'red'"
        ):
            table.check("rid", "here")
    finally:
        del REGISTRIES["colour of a test"]


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("parts.txt", "", "is not a Python file"),
        ("missing.py", None, "is not a Python file"),
        ("my.parts.py", "", "is not a Python file; give .*, without another dot"),
        ("json.py", "", "has the name of the module"),
        ("broken.py", "1 / 0", "cannot be imported: ZeroDivisionError: division by zero"),
    ],
)
def test_a_file_that_registers_nothing_is_one_line(folder, name, text, says):
    if text is not None:
        (folder / name).write_text(text)
    with pytest.raises(DrakeTeleopError, match=says):
        register_from_script(folder / name)


def test_a_file_is_registered_by_any_form_of_its_path(folder):
    (folder / "sub").mkdir()
    for path in (folder / "sub" / ".." / "parts.py", folder / "parts.py"):
        register_from_script(path)
    assert "share" in METHODS
    assert os.environ["DRAKE_TELEOP_REGISTER"] == str(folder / "parts.py")


def test_another_process_registers_the_same_parts_when_a_name_is_unknown(folder):
    register_from_script(folder / "parts.py")
    METHODS.remove("share")
    assert "share" not in METHODS  # registered once, then removed
    del sys.modules["parts"]
    assert "share" in METHODS and str(folder) in os.environ["DRAKE_TELEOP_REGISTER"]


def test_an_arm_a_device_and_a_wall_are_ten_lines(tmp_path):
    """`run` needs no other file."""
    (text,) = re.findall(r"^```yaml\n(slave:.*?)^```$", RECIPES, re.M | re.S)
    assert len(text.splitlines()) <= 10
    shutil.copy(ROOT / "models" / "leader_arm.urdf", tmp_path / "arm.urdf")
    (tmp_path / "mine.yaml").write_text(text)
    scenario = LoadScenario(tmp_path / "mine.yaml")
    station = MakeTeleopStation(scenario, load_estimate=true_load(scenario))
    scenario.simulation.settle, scenario.simulation.duration = 0.0, 0.02
    result = simulate(station, scenario.simulation, progress=False)
    slave = NominalSlave(scenario.slave)
    assert slave.arm.joint_names[0] == "yaw" and slave.arm.phi_load[0] == pytest.approx(0.1)
    assert scenario.master.device(0.0, 0.0).mass_matrix(np.zeros(6))[0, 0] == pytest.approx(0.12)
    assert result["true_contact_wrench_W"].shape == (21, 6)
    assert np.abs(result["measured_wrench_S"][:, :3]).max() > 0.5


@pytest.mark.parametrize(
    ("table", "part", "said"),
    [
        (
            FIGURES,
            {"friction": 0.2},
            "device: 'own' is {'friction': 0.2}, not a valid part;"
            " register an object of class DeviceFigures",
        ),
        (
            ENVIRONMENTS,
            dict,
            "environment: 'own' is <class 'dict'>, not a valid part; register a class derived from",
        ),
        (ENVIRONMENTS, Wall(), "register a class derived from Environment"),
    ],
)
def test_part_of_another_type_is_not_registered(table, part, said):
    with pytest.raises(DrakeTeleopError, match=re.escape(said)):
        table.register("own", part)
    assert "own" not in table


def test_step_that_is_not_compiled_is_an_error(monkeypatch):
    def own_step(*arguments):
        """Do nothing."""

    monkeypatch.setitem(METHODS, "own", PassivityMethod(own_step, own_step))
    with pytest.raises(
        DrakeTeleopError, match=r"own_step: is not compiled; decorate it with @njit"
    ):
        step_addresses("own")


def test_environment_with_plain_fields_is_described():
    cup = dataclasses.make_dataclass("Cup", [("depth", float, 0.1)], bases=(Box,))
    assert fields_of(cup)[-1].name == "depth"
