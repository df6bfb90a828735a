"""docs/delay.md and delay-figures.md: scenarios load; tables equal the records and the script."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drake_teleop.station.scenario import LoadScenario

pytestmark = pytest.mark.checks

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "docs" / "delay.md").read_text(encoding="utf-8")
FIGURES = (ROOT / "docs" / "delay-figures.md").read_text(encoding="utf-8")


def test_its_scenarios_load(tmp_path):
    blocks = re.findall("```yaml\n(.*?)```", TEXT, re.S)
    assert len(blocks) == 1
    for k, block in enumerate(blocks):
        path = tmp_path / f"{k}.yaml"
        path.write_text(block)
        scenario = LoadScenario(str(path))
        scenario.check()
        assert scenario.passivity.method == "ledger"
        assert scenario.channel.networks_of_directions()[0].delay == 0.05


def figures(row: str) -> tuple[list[bool], list[float]]:
    """Return the stability by network, and the figures that do not depend on the last bit."""
    *columns, free_force = row.split("|")[2:-1]
    felt, energy = columns[::2], columns[1::2]
    steady = [float(free_force)]
    for force, joule in zip(felt, energy, strict=True):
        mean, deviation = (float(x) for x in re.findall(r"-?\d+\.\d+", force))
        # Amplitudes of oscillation and chatter depend on the last bit.
        if "unstable" not in force and deviation < 0.05:
            steady += [mean, float(joule)]
    return ["unstable" in force for force in felt], steady


@pytest.mark.slow
def test_its_table_is_what_its_script_prints(capsys):
    (script,) = re.findall("```python\n(.*?)```", FIGURES, re.S)
    exec(compile(script, "delay-figures.md", "exec"), {})
    printed = capsys.readouterr().out.splitlines()
    methods = [row.split("|")[1] for row in printed]
    written = [row for row in FIGURES.splitlines() if row.count("|") == 9 and "±" in row]
    assert [row.split("|")[1] for row in written] == methods
    for row, expected in zip(written, printed, strict=True):
        (unstable, said), (is_unstable, found) = figures(row), figures(expected)
        assert unstable == is_unstable
        np.testing.assert_allclose(said, found, atol=0.02)


def table(page: str, head: str) -> dict[str, list[str]]:
    """Return first cell -> other cells of the rows below the row that begins with `head`."""
    _, _, below = (ROOT / page).read_text(encoding="utf-8").partition(f"\n{head}")
    rows = below.partition("\n\n")[0].splitlines()[2:]
    cells = ([cell.strip() for cell in row.split("|")[1:-1]] for row in rows)
    return {first.strip("`"): rest for first, *rest in cells}


def figures_of_record(name: str) -> Any:
    text = (ROOT / "benchmarks" / "records" / f"{name}.json").read_text(encoding="utf-8")
    return json.loads(text)["figures"]


def test_the_table_of_holds_is_what_the_record_says():
    written = table("docs/delay.md", "| method | stable of 162 |")
    found = {}
    for method, holds in figures_of_record("domain").items():
        told = ("stable", "good", "strong", "prompt")
        counts = [sum(row[what] for row in holds.values()) for what in told]
        felt = np.median([row["felt"] for row in holds.values() if row["good"]])
        found[method] = [*map(str, counts), f"{felt:.2f}"]
    assert written == found


def test_what_an_adversary_left_of_ledgers_energy_is_what_the_record_says():
    found = figures_of_record("adversary")["ledger"]
    least = ", ".join(f"{found[part]['actual']:.4f}" for part in ("random", "searched"))
    assert table("docs/delay.md", "| method | between the hand and |")["ledger"][-1] == least
