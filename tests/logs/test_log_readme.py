"""Commands of the README for logs, run on the sample log."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
from shown import type_in

from drake_teleop.logs.sample import sample_log_command

ROOT = Path(__file__).parents[2]


def yaml_block(page: str, start: str) -> str:
    text = (ROOT / page).read_text(encoding="utf-8")
    (found,) = re.findall(f"```yaml\n({re.escape(start)}.*?)```", text, re.S)
    return found


def contents(path: str) -> Any:
    return json.loads(Path(path).read_text())


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Return the folder in which the README's commands have been run."""
    folder = tmp_path_factory.mktemp("readme")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        type_in("README.md", ".venv/bin/drake-teleop sample-log")
    return folder


@pytest.fixture(autouse=True)
def in_folder(folder, monkeypatch):
    monkeypatch.chdir(folder)


@pytest.mark.slow
def test_description_equals_that_of_the_docs():
    shown = yaml_block("docs/logs.md", "# A gripper")
    assert Path("out/sample/free.yaml").read_text() == shown


@pytest.mark.slow
def test_only_finding_of_the_sample_is_the_lag_of_its_pose():
    assert [found["name"] for found in contents("out/inspect/summary.json")["findings"]] == ["lag"]


@pytest.mark.slow
def test_readme_commands_identify_the_load():
    truth, load = contents("out/sample/truth.json"), contents("out/load/identification.json")
    assert all(load["identifiable"])
    for name, value in {"mass": 5e-4, "com": 1e-4, "delay_s": 3e-4}.items():
        assert load[name] == pytest.approx(truth[name], abs=value)
    assert load["inertia_com"] == [pytest.approx(row, abs=5e-5) for row in truth["inertia_com"]]
    assert load["offsets"][:3] == pytest.approx(truth["offsets"][:3], abs=5e-3)
    assert load["offsets"][3:] == pytest.approx(truth["offsets"][3:], abs=5e-4)


@pytest.mark.slow
def test_result_contains_only_the_touches():
    truth = contents("out/sample/truth.json")["contacts"]
    free = contents("out/load/summary.json")["residual_rms_force"]
    assert free < 0.1  # N, of the sensor's noise after the low-pass
    assert max(peak["peak_N"] for peak in truth) < contents("out/touched/summary.json")["raw_rms"]
    found = contents("out/detect/summary.json")["contacts"]
    assert len(found) == len(truth)
    for contact, touch in zip(found, truth, strict=True):
        assert contact["peak_N"] == pytest.approx(touch["peak_N"], rel=0.03)
        assert contact["push"] == pytest.approx(touch["push"], abs=0.03)
        # The low-pass of 30 Hz widens a touch by up to half a period.
        assert contact["start_s"] == pytest.approx(touch["start_s"], abs=0.5 / 30.0 + 0.004)
        assert contact["stop_s"] == pytest.approx(touch["stop_s"], abs=0.06)


@pytest.mark.slow
def test_export_prints_the_call_for_a_ur_robot(capsys):
    type_in("docs/robot.md", "drake-teleop export")
    mass, com, inertia = re.findall(
        r"set_target_payload\((.*?), \[(.*?)\], \[(.*?)\]\)", capsys.readouterr().out
    )[0]
    load = contents("out/load/identification.json")
    assert float(mass) == pytest.approx(load["mass"], rel=1e-5)
    x, y, z = load["com"]  # rotated by 45 degrees and shifted along the axis
    moved = [(x - y) / 2**0.5, (x + y) / 2**0.5, z + 0.045]
    assert [float(word) for word in com.split(",")] == pytest.approx(moved, abs=1e-6)
    assert len(inertia.split(",")) == 6


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bytes(tmp_path):
    def bytes_of(folder: Path) -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in folder.iterdir()}

    shipped = bytes_of(Path("out/sample"))
    assert sum(map(len, shipped.values())) < 1e6
    sample_log_command(tmp_path, quiet=True)
    assert bytes_of(tmp_path) == shipped
    sample_log_command(tmp_path, seed=1, quiet=True)
    other = bytes_of(tmp_path)
    same = {name for name in shipped if other[name] == shipped[name]}
    assert same == {"free.yaml", "touched.yaml", "truth.json"}


def test_printed_commands_name_files_of_any_folder(tmp_path, capsys):
    sample_log_command(tmp_path / "a b", quiet=False)
    lines = [line for line in capsys.readouterr().out.splitlines() if "  drake-teleop" in line]
    words = [word for line in lines for word in shlex.split(line) if word.startswith(str(tmp_path))]
    assert len(lines) == 4 and len(words) == 5
    assert all(Path(word).is_file() for word in words)
