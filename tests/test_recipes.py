"""The recipes of docs/extend.md, followed in a copy of the package."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from drake_teleop.lab.identification import true_load
from drake_teleop.station.scenario import LoadScenario
from drake_teleop.station.simulation import simulate
from drake_teleop.station.slave.plant import NominalSlave
from drake_teleop.station.station import MakeTeleopStation

pytestmark = pytest.mark.checks

ROOT = Path(__file__).parents[1]
RECIPES = (ROOT / "docs" / "extend.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(# drake_teleop/.*?|--- .*?)^```$", RECIPES, re.M | re.S)


def follow(package: Path) -> None:
    """Writes the files of the recipes, and their lines below the lines that they name."""
    for text in blocks("python"):
        first, _, rest = text.partition("\n")
        new = package / first.removeprefix("# ")
        assert not new.exists()
        new.write_text(rest)
    for text in blocks("diff"):
        first, *lines = text.splitlines()
        file = package / first.removeprefix("--- ")
        source = file.read_text()
        for before, line in zip(lines[::2], lines[1::2], strict=True):
            assert before[0] == " " and line[0] == "+"
            assert source.count(f"\n{before[1:]}\n") == 1
            source = source.replace(f"\n{before[1:]}\n", f"\n{before[1:]}\n{line[1:]}\n")
        file.write_text(source)


@pytest.fixture(scope="module")
def copy(tmp_path_factory) -> Path:
    """A checkout with a method, an estimator and an environment more; compiled code goes along."""
    folder = tmp_path_factory.mktemp("checkout")
    for part in ("drake_teleop", "models"):
        shutil.copytree(ROOT / part, folder / part)
    follow(folder)
    return folder


def run(copy: Path, script: str) -> None:
    # Compiled without optimising, which takes half of the time: a method is part of the channel.
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=copy,
        env=os.environ | {"NUMBA_OPT": "0"},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr[-3000:]


def test_there_is_a_recipe_for_each_kind_of_part():
    assert len(blocks("python")) == len(blocks("diff")) == 3


def test_an_arm_a_device_and_a_wall_are_ten_lines(tmp_path):
    """With them `run` has all it wants."""
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


@pytest.mark.slow
def test_a_station_with_the_new_method(copy):
    """All of the wrench is what there is without a method, none of it is none."""
    run(
        copy,
        """
import numpy as np
from drake_teleop.station.passivity.methods import METHODS
from drake_teleop.station.scenario import ScenarioFromData
from drake_teleop.station.simulation import simulate
from drake_teleop.station.station import MakeTeleopStation

assert "share" in METHODS

def force(**passivity):
    data = {
        "simulation": {"duration": 0.02, "settle": 0.0},
        "passivity": passivity,
        "channel": {"network": "lan"},
    }
    scenario = ScenarioFromData(data, "test.yaml")
    return simulate(MakeTeleopStation(scenario), scenario.simulation)["force_to_master"]

nothing, all_of_it = force(method="none"), force(method="share", share={"share": 1.0})
assert np.abs(nothing).max() > 1.0  # the tool's weight
np.testing.assert_array_equal(all_of_it, nothing)
assert (force(method="share", share={"share": 0.0}) == 0.0).all()
""",
    )


DRIVE = """
from pathlib import Path
from drake_teleop.live.inputs import Inputs
from drake_teleop.live.scenarios import live_scenario
from drake_teleop.live.session import Session, read_drive
from drake_teleop.common.progress import silent
from drake_teleop.station.passivity.methods import METHODS
from drake_teleop.station.scenario import ScenarioFromData

folder = Path({folder!r})
assert METHODS.index("tdpa") == {tdpa}
if {tdpa} == 2:
    data = {{"passivity": {{"method": "wave"}}, "channel": {{"network": "lan"}}}}
    scenario = live_scenario(ScenarioFromData(data, "test.yaml"))
    session = Session(scenario, log=folder / "log.parquet", record=folder)
    inputs = session.inputs
    for ms in range(0, 60, 10):
        inputs = inputs.changed({{"z": -20 * ms}})
        session.apply(inputs.changed({{"method": {tdpa}}} if ms >= 30 else {{}}))
        session.advance(10)
    session.close()
else:
    read_drive(folder).repeat(silent(""), folder / "again.parquet")
    names = [sorted((folder / name).iterdir()) for name in ("log.parquet", "again.parquet")]
    one, other = ([path.read_bytes() for path in paths] for paths in names)
    assert one == other and len(b"".join(one)) > 10_000
"""


@pytest.mark.slow
def test_a_recorded_drive_is_the_same_after_a_method_is_entered_first(copy, tmp_path):
    first = tmp_path / "checkout"
    shutil.copytree(copy, first)
    methods = first / "drake_teleop" / "station" / "passivity" / "methods.py"
    line = "    share: ShareConfig = field(default_factory=ShareConfig)\n"
    source = methods.read_text().replace(line, "", 1)
    wave = "    wave: WaveConfig ="
    methods.write_text(source.replace(wave, line + wave, 1))
    drive = str(tmp_path / "drive")
    run(copy, DRIVE.format(folder=drive, tdpa=2))
    assert ",tdpa," in (tmp_path / "drive" / "inputs.csv").read_text()
    run(first, DRIVE.format(folder=drive, tdpa=3))


@pytest.mark.slow
def test_an_identification_with_the_new_estimator(copy):
    run(
        copy,
        """
import numpy as np
from drake_teleop.load.batch.data_sheet import NOISE
from drake_teleop.load.batch.methods import identify_batch
from drake_teleop.load.identification import Identification
from drake_teleop.load.regressor import non_contact_wrench

rng = np.random.default_rng(1)
s, omega, alpha = rng.normal(size=(3, 200, 3)) * [[[9.0]], [[2.0]], [[5.0]]]
phi = np.array([3.0, 0.1, -0.2, 0.3, 0.05, 0.0, 0.001, 0.06, 0.002, 0.02])
offsets = np.arange(6.0)
result = identify_batch(offsets + non_contact_wrench(s, omega, alpha, phi), s, omega, alpha,
                        method="data_sheet")
np.testing.assert_allclose(result.identification.phi, phi, atol=1e-10)
np.testing.assert_allclose(result.identification.offsets, offsets, atol=1e-9)
np.testing.assert_array_equal(result.noise, NOISE)
result.identification.save("identification.json")
loaded = Identification.load("identification.json")
assert loaded.method == "least squares with the data sheet's noise"
""",
    )


@pytest.mark.slow
def test_a_station_with_the_new_environment(copy):
    """The tip begins 0.1 mm deep in the table, which pushes it up with k x."""
    run(
        copy,
        """
import numpy as np
from drake_teleop.station.scenario import ScenarioFromData
from drake_teleop.station.simulation import simulate
from drake_teleop.station.station import MakeTeleopStation

data = {
    "simulation": {"duration": 0.01, "settle": 0.0},
    "environment": [{"_tag": "!Table", "position": [0.55, 0.0, 0.45 - 0.2 + 1e-4 - 0.01]}],
}
scenario = ScenarioFromData(data, "test.yaml")
result = simulate(MakeTeleopStation(scenario), scenario.simulation)
np.testing.assert_allclose(result["true_contact_wrench_W"][0, :3], [0, 0, 2e5 * 1e-4], atol=1e-6)
assert "sheet_state" not in result.signals
""",
    )
