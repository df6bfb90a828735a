"""The README's log description and its two commands do what they say, word for word."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from known_motion import Motion, motion_at, quaternions

from drake_teleop.cli import main
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench

README = Path(__file__).parents[2] / "README.md"
PHI = phi_from_mass_com_inertia(1.7, [0.01, -0.02, 0.06], np.diag([0.004, 0.005, 0.003]))
OFFSETS = np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.3])


def block(language: str, start: str) -> str:
    (found,) = re.findall(f"```{language}\n({re.escape(start)}.*?)```", README.read_text(), re.S)
    return found


@pytest.fixture(scope="module")
def motion() -> Motion:
    return motion_at(np.arange(0.0, 8.0, 2e-3))


@pytest.mark.slow
def test_a_robots_log_as_in_the_readme(tmp_path, monkeypatch, capsys, motion):
    monkeypatch.chdir(tmp_path)
    wrench = OFFSETS + non_contact_wrench(motion.specific_force, motion.omega, motion.alpha, PHI)
    write("wrench.csv", "time Fx Fy Fz Tx Ty Tz", 1e3 * motion.t, -wrench)
    q = quaternions(motion.R_WS)[:, [1, 2, 3, 0]]
    write("tcp.csv", "time qx qy qz qw x y z", 1e3 * motion.t, q, 1e3 * motion.p_WS)
    Path("robot.yaml").write_text(block("yaml", "wrench:"))
    for command in block("sh", ".venv/bin/drake-teleop identify").splitlines():
        program, *arguments = shlex.split(command)
        assert program == ".venv/bin/drake-teleop"
        with pytest.raises(SystemExit) as stop:
            main(arguments)
        assert stop.value.code == 0, capsys.readouterr().err
    load = json.loads(Path("out/load/identification.json").read_text())
    assert load["mass"] == pytest.approx(1.7, abs=0.005)
    assert load["offsets"] == pytest.approx(OFFSETS, abs=0.05)
    summary = json.loads(Path("out/free/summary.json").read_text())
    assert summary["residual_rms"] < 0.02 * summary["raw_rms"]


def write(name: str, columns: str, *values: np.ndarray) -> None:
    pl.DataFrame(np.column_stack(values), schema=columns.split()).write_csv(name)
