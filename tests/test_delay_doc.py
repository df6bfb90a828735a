"""docs/delay.md: its scenarios load, and its table is what its script prints."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from drake_teleop.scenario import LoadScenario

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs" / "delay.md").read_text(encoding="utf-8")


def test_its_scenarios_load(tmp_path):
    blocks = re.findall("```yaml\n(.*?)```", TEXT, re.S)
    assert len(blocks) == 2
    for k, block in enumerate(blocks):
        path = tmp_path / f"{k}.yaml"
        path.write_text(block)
        scenario = LoadScenario(str(path))
        scenario.check()
        assert scenario.passivity.method == "ledger"
        assert scenario.channel.lines()[0].delay == 0.05


def figures(row: str) -> tuple[list[bool], list[float]]:
    """Whether it is said to be unstable over each network, and what does not depend on luck."""
    *columns, free_force = row.split("|")[2:-1]
    felt, energy = columns[::2], columns[1::2]
    steady = [float(free_force)]
    for force, joule in zip(felt, energy, strict=True):
        mean, deviation = (float(x) for x in re.findall(r"-?\d+\.\d+", force))
        # What swings or chatters depends on the last bit.
        if "unstable" not in force and deviation < 0.05:
            steady += [mean, float(joule)]
    return ["unstable" in force for force in felt], steady


@pytest.mark.slow
def test_its_table_is_what_its_script_prints(capsys):
    (script,) = re.findall("```python\n(.*?)```", TEXT, re.S)
    exec(compile(script, "delay.md", "exec"), {})
    printed = capsys.readouterr().out.splitlines()
    methods = [row.split("|")[1] for row in printed]
    written = [row for row in TEXT.splitlines() if row.count("|") == 9 and "±" in row]
    assert [row.split("|")[1] for row in written] == methods
    for row, expected in zip(written, printed, strict=True):
        (unstable, said), (is_unstable, found) = figures(row), figures(expected)
        assert unstable == is_unstable
        np.testing.assert_allclose(said, found, atol=0.02)
