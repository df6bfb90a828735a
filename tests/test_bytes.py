"""Commands write the same bytes in any environment; benchmarks/bytes.py tries more of them."""

from __future__ import annotations

import importlib.util
import itertools
import json
from pathlib import Path
from types import ModuleType

import pytest
from matplotlib.figure import Figure

from drake_teleop.station.replay_file import ReplayFile

pytestmark = pytest.mark.checks

# The load is estimated during the run, so no identification precedes it.
SCENARIO = """
simulation: {duration: 0.05, settle: 0.02}
operator:
  grip: firm
  intent: [!Sine {duration: 10.0, ramp: 0.1, frequency: 3.0, translation: [0.01, 0.01, 0.02]}]
load_estimator: {enabled: true}
"""
STUDY = """
scenario: quick.yaml
factors: [{field: force_scaling.sigma, values: [0.5]}]
"""


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    path = Path(__file__).parents[1] / "benchmarks" / "bytes.py"
    spec = importlib.util.spec_from_file_location("bench_bytes", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


# The benchmark renders pictures; this takes longest.
NO_PICTURES = """
from matplotlib.figure import Figure
from drake_teleop.station.replay_file import ReplayFile
painted = Figure.savefig
Figure.savefig = lambda _, path, **options: painted(Figure(figsize=(0.1, 0.1)), path, **options)
ReplayFile._record_scene_html = lambda self, make_scene: "<body></body>"
"""


@pytest.mark.slow
def test_two_surroundings_that_have_nothing_in_common(benchmark, tmp_path, monkeypatch):
    """Compare this process with one of other threads, folder and locale."""
    (tmp_path / "quick.yaml").write_text(SCENARIO)
    (tmp_path / "study.yaml").write_text(STUDY)
    commands = {
        "run": ("run", str(tmp_path / "quick.yaml")),
        "study": ("study", str(tmp_path / "study.yaml"), "--jobs", "1"),
        "sample_log": ("sample-log",),
        "identify": ("identify", "out/sample_log/free.yaml"),
        "excite": ("excite", "--period", "1", "--harmonics", "2"),
    }
    others = tuple(values[-1] for values in benchmark.SURROUNDINGS.values())
    program = NO_PICTURES + benchmark.IN_ONE_PROCESS
    found = benchmark.written(others, commands, tmp_path / "there", program)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for kind, name in ((Figure, "savefig"), (ReplayFile, "_record_scene_html")):
        monkeypatch.setattr(kind, name, getattr(kind, name))  # so that the test can restore it
    monkeypatch.setattr("sys.argv", ["", json.dumps(benchmark.typed(commands))])
    exec(program, {})
    here = benchmark.digests(Path("out"))
    assert len(here) > 25
    assert {
        name for name in here.keys() | found.keys() if here.get(name) != found.get(name)
    } == set()


def test_a_file_that_differs_or_is_missing_is_found(benchmark, tmp_path, monkeypatch):
    found = iter(({"run/a": "1", "run/b": "1"}, {"run/a": "2", "run/b": "1"}, {"run/a": "1"}))
    monkeypatch.setattr(benchmark, "written", lambda *_: next(found))
    combinations = [("1",), ("2",), ("4",)]
    figures = benchmark.compared(combinations, {"run": (), "study": ()}, tmp_path)
    assert figures["run_differ"] == ["run/a (2)", "run/b (4)"]
    assert figures["study_differ"] == []


def test_each_two_values_meet(benchmark):
    everything = list(itertools.product("123", "ab", "xy", "+-"))
    chosen = benchmark.pairwise(everything)
    assert len(chosen) < 9
    for pair in set().union(*map(benchmark.pairs, everything)):
        assert any(pair in benchmark.pairs(each) for each in chosen)
