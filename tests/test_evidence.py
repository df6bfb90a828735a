"""Page of evidence: its figures are those of the records, and each claim has a source."""

from __future__ import annotations

import dataclasses
import math
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))

import evidence  # noqa: E402
from evidence_claims import CLAIMS, RUNS, Claim, InTests  # noqa: E402

pytestmark = pytest.mark.checks

MEASURED = [claim for claim in CLAIMS if isinstance(claim, Claim)]
KNOWN = evidence.records()


def test_each_claim_is_made_somewhere_and_can_be_shown():
    pages = {claim.page for claim in CLAIMS if isinstance(claim, Claim | InTests)}
    assert [page for page in pages if not (ROOT / "docs" / page).is_file()] == []
    assert {claim.run for claim in MEASURED} == RUNS.keys()
    for command in RUNS.values():
        script = command.split()[0]
        assert script == "drake-teleop" or (ROOT / script).is_file(), command
    for claim in CLAIMS:
        if isinstance(claim, InTests):
            file, _, test = claim.test.partition("::")
            assert f"def {test}(" in (ROOT / file).read_text(encoding="utf-8")


def test_each_record_has_the_figures_and_is_of_the_command_that_is_told():
    assert KNOWN.keys() <= RUNS.keys()
    assert {name: record["command"] for name, record in KNOWN.items()} == {
        name: RUNS[name] for name in KNOWN
    }
    for claim in MEASURED:
        if claim.run in KNOWN:
            assert not math.isnan(claim.value(KNOWN[claim.run]["figures"])), claim.says


def test_readme_of_the_benchmarks_is_generated_from_the_records():
    assert evidence.README.read_text(encoding="utf-8") == evidence.readme()


def test_a_figure_beyond_its_bound_is_said_to_be_missed(monkeypatch):
    claim = next(claim for claim in MEASURED if claim.run in KNOWN)
    figure = claim.value(KNOWN[claim.run]["figures"])
    missed = dataclasses.replace(claim, least=figure + 1.0, most=math.inf)
    monkeypatch.setattr(evidence, "CLAIMS", (missed,))
    text = evidence.page()
    assert f"**{claim.text(KNOWN[claim.run]['figures'])}**" in text
    assert text.startswith("# Evidence") and "0 of 1 measured claims are met" in text
    assert f"- {claim.says}" in text.partition("## Not met")[2].partition("## Not shown")[0]
    assert "0 of 0 measured" not in text


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_meets_no_bound(value):
    claim = dataclasses.replace(MEASURED[0], figure=lambda _: value)
    assert not claim.met({})


@pytest.mark.parametrize(
    ("most", "bound"), [(1e-12, "≤ 1·10⁻¹² N"), (1000.0, "≤ 1000 N"), (0.0349, "≤ 0.0349 N")]
)
def test_numbers_are_written_as_people_write_them(most, bound):
    assert dataclasses.replace(MEASURED[0], unit="N", least=0.0, most=most).bound == bound
