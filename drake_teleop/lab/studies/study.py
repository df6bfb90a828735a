"""`drake-teleop study STUDY.yaml`: runs of one scenario over a design of its fields."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from drake_teleop.common.config import check_all_field_values, with_absolute_paths
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import output_folder, studies_dir, write_json, write_table
from drake_teleop.common.texts import read_yaml
from drake_teleop.lab.run import run_scenario
from drake_teleop.lab.studies.design import FactorValues, Study
from drake_teleop.lab.studies.effects import main_effects_table
from drake_teleop.lab.studies.measures import evaluate_measures
from drake_teleop.lab.studies.runs import SETUP_TIME_S_KEY, run_study
from drake_teleop.lab.studies.store import parse_shard
from drake_teleop.station import scenario as scenarios

if TYPE_CHECKING:
    import polars as pl


@dataclass(frozen=True)
class StationRunFunction:
    """Picklable function that executes one run of the station for a study.

    Args:
        scenario_data: content of the scenario file.
        scenario_file: name of that file, for messages.
        force_threshold_N: threshold [N] of the measure time_above_force_s.
    """

    scenario_data: Any
    scenario_file: str
    measures: Sequence[str]
    force_threshold_N: float

    def scenario(self, values: FactorValues, seed: int) -> scenarios.Scenario:
        changes = values | {"simulation.seed": seed}
        return scenarios.ScenarioFromData(
            _copy_with_changed_fields(self.scenario_data, changes), self.scenario_file
        )

    def __call__(self, values: FactorValues, seed: int) -> dict[str, float]:
        scenario, start = self.scenario(values, seed), time.monotonic()
        run = run_scenario(scenario, progress=False)
        simulated = scenario.simulation.settle + float(run.result.t[-1])
        one_time_s = time.monotonic() - start - simulated / run.real_time_factor
        found = evaluate_measures(run.result, scenario, self.measures, self.force_threshold_N)
        return found | {SETUP_TIME_S_KEY: max(one_time_s, 0.0)}


def study_command(
    path: str | Path,
    out: Path,
    *,
    jobs: int = -1,
    cluster: str | None = None,
    executor: Executor | None = None,
    shard: str | None = None,
    merge: bool = False,
    quiet: bool = False,
    progress: bool = True,
    repeats: int | None = None,
    yes: bool | Callable[[str], bool] = False,
) -> dict[str, Any]:
    """Run the remaining runs of a study; write summary, effects and pictures; return the summary.

    `shard` "K/N" is every N-th group of runs; `merge` collects the rows of all shards and runs
    nothing; `yes`: consent to more than 1e5 runs, or a function that asks.
    """
    for first, second, both in (
        ("shard", "merge", shard and merge),
        ("cluster", "executor", cluster and executor is not None),
    ):
        if both:
            what = f"the options {first} and {second} cannot be combined"
            raise DrakeTeleopError(what, where="study", remedy="remove one of them")
    study, path = LoadStudy(path), scenarios.find_shipped_file("study", path, studies_dir())
    study.repeats = study.repeats if repeats is None else repeats
    study.check_num_runs(str(path), yes)
    known = study.scenario in scenarios.ScenarioNames()
    data, where = scenarios.ReadScenarioData(
        study.scenario if known else path.parent / study.scenario, f"{path}:scenario"
    )
    scenario = scenarios.ScenarioFromData(data, where)
    files = [*scenario.slave.model_files(), *scenarios.referenced_files(scenario)]
    for index, factor in enumerate(study.factors):
        ranged = factor.low is not None and factor.high is not None
        for value in (factor.low, factor.high) if ranged else factor.level_values():
            changed = _copy_with_changed_fields(data, {factor.field: value})
            place = f"{path}:factors[{index}]"
            config = scenarios.settings_without_range_check(scenarios.Scenario, changed, place)
            check_all_field_values(config, place)
            files += scenarios.referenced_files(with_absolute_paths(config, Path(where).parent))
    digests = [sha256(file.read_bytes()).hexdigest() for file in dict.fromkeys(files)]
    work = StationRunFunction(data, where, tuple(study.measures), study.force_threshold)
    shown = progress and not quiet
    rows = run_study(
        study, out, work, {"data": data, "files": digests}, jobs=jobs, cluster=cluster,
        executor=executor, shard=shard, merge=merge, progress=shown,
    )  # fmt: skip
    summary = _summarise_measures(study, rows)
    out = parse_shard(shard).folder(out) if shard else out
    with output_folder(out, valid_after_failure=["runs.parquet"]):
        if not shard:
            from drake_teleop.lab.studies.pictures import write_pictures

            write_table(out / "effects.csv", main_effects_table(study, rows))
            write_pictures(study, rows, out)
        write_json(out / "summary.json", summary)
    if not quiet:
        _print_summary(study, summary, out)
    return summary


def LoadStudy(path: str | Path) -> Study:
    """Return the study in a file or of a shipped name, checked without its scenario."""
    path = scenarios.find_shipped_file("study", path, studies_dir())
    study = scenarios.settings_without_range_check(Study, read_yaml(path), str(path))
    study.check(str(path))
    return study


def _copy_with_changed_fields(data: Any, changes: dict[str, Any]) -> Any:
    data = copy.deepcopy(data)
    for name, value in changes.items():
        *blocks, last = name.split(".")
        inner = data
        for block in blocks:
            inner[block] = inner[block] if isinstance(inner.get(block), dict) else {}
            inner = inner[block]
        # Integer fields reject 3.0; float fields accept 3.
        whole = isinstance(value, float) and value.is_integer()
        inner[last] = int(value) if whole else value
    return data


def _summarise_measures(study: Study, rows: pl.DataFrame) -> dict[str, Any]:
    figures = {}
    for name in study.measures:
        column = rows[name].drop_nulls()
        column = column.filter(column.is_finite())
        figures[name] = {"mean": column.mean(), "least": column.min(), "largest": column.max()}
    failed = rows["error"].drop_nulls()
    return {
        "description": study.description,
        "runs": rows.height,
        "points": rows["point"].n_unique(),
        "failed": len(failed),
        "first_error": failed[0] if len(failed) else None,
        "measures": figures,
    }


def _print_summary(study: Study, summary: dict[str, Any], out: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("", "mean", "least", "largest")
    for name, figures in summary["measures"].items():
        table.add_row(name, *("" if v is None else f"{v:.4g}" for v in figures.values()))
    console = Console()
    console.print(study.description or study.scenario, style="bold", markup=False)
    console.print(table)
    console.print(f"{summary['runs']} runs, {summary['failed']} failed", highlight=False)
    if summary["failed"]:
        console.print("[bold yellow]warning:[/] first error:", highlight=False)
        console.print(summary["first_error"], highlight=False, markup=False)
    console.print(f"written to {out}", highlight=False, markup=False)
