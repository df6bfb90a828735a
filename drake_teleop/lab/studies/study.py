"""`drake-teleop study STUDY.yaml`: one scenario over a design of its fields, as a table of runs.

A study file::

    scenario: contact_transition         # shipped, or a file beside the study's
    factors:
      - {field: force_scaling.sigma, values: [0.0, 0.5, 1.0]}
      - {field: force_scaling.gamma, low: 0.5, high: 2.0}
      - {field: wrist_sensor.preset, words: [ideal, jr3_85m35a3]}
    design: sobol
    samples: 64
    repeats: 3

A factor of one value sets a field for all runs; beside numbers there are words, flags (true, false)
and vectors. Every run follows the rule of `drake-teleop run`; runs with the same slave, sensor and
seed share one identification of the load (`identified_load.py`). An adaptive design looks for the
point whose `objective` is smallest, in batches that follow from the rows of those before.

The folder holds

============ =====================================================================================
study.json   all that the rows depend on
runs.parquet a folder of parts, one table: run (the key, its place in the design), point, repeat,
             seed, a column for each factor and each measure, and error: why a run failed; its
             measures are then null
summary.json runs, failed, and of each measure mean, least and largest
effects.csv  of each level of each factor: its successful runs, mean of each measure, effect (its
             difference from the mean of all levels), and half the widths of their 95 % intervals:
             over the seeds, and if the design is not factorial over the design; over how many
             combinations of the other factors' levels, how many were left out, and why a level has
             no value, see `effects.py`
pictures     main_effects, interactions of two factors, and the front of effort against task time
             and overshoot of the contact force, as far as the study has what they show
============ =====================================================================================

A study that was stopped or killed goes on where it was when the same command is given again. The
rows are the same bytes for any number of processes, here or on a cluster. A run that ends its
process is a failed run; only if there is one process for all does it end the study, too.
"""

from __future__ import annotations

import copy
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.yaml import yaml_dump, yaml_load_typed

from drake_teleop.common.errors import DrakeTeleopError, expect, meant
from drake_teleop.common.quantities import check_ranges, check_structure
from drake_teleop.common.resources import studies_dir
from drake_teleop.common.texts import read_yaml
from drake_teleop.common.writing import output_folder, write_json, write_table
from drake_teleop.lab.run import run_scenario
from drake_teleop.lab.studies.design import Factor, Study, Values
from drake_teleop.lab.studies.effects import effects
from drake_teleop.lab.studies.measures import measured
from drake_teleop.lab.studies.pictures import write_pictures
from drake_teleop.lab.studies.runs import ONCE, run_study
from drake_teleop.station.scenario import ReadScenario, Scenario, ScenarioFromData, ScenarioNames

if TYPE_CHECKING:
    import polars as pl

Array = NDArray[np.float64]


@dataclass(frozen=True)
class StationWork:
    """One run of the station: what `run_study` hands to the processes.

    Args:
        data: of the base scenario's file.
        where: the file's name for messages.
        measures: by name.
        threshold: force [N] of time_above_force_s.
    """

    data: Any
    where: str
    measures: Sequence[str]
    threshold: float

    def scenario(self, values: Values, seed: int) -> Scenario:
        """The scenario of one run."""
        changes = values | {"simulation.seed": seed}
        return ScenarioFromData(_changed(self.data, changes), self.where)

    def __call__(self, values: Values, seed: int) -> dict[str, float]:
        """The measures of one run, and what another run with its load would not wait for [s]."""
        scenario, start = self.scenario(values, seed), time.monotonic()
        run = run_scenario(scenario, progress=False)
        simulated = scenario.simulation.settle + float(run.result.t[-1])
        once = time.monotonic() - start - simulated / run.real_time_factor
        found = measured(run.result, scenario, self.measures, self.threshold)
        return found | {ONCE: max(once, 0.0)}


def study_command(
    path: str | Path,
    out: Path,
    *,
    jobs: int = -1,
    cluster: str | None = None,
    quiet: bool = False,
    progress: bool = True,
    repeats: int | None = None,
    yes: bool | Callable[[str], bool] = False,
) -> dict[str, Any]:
    """Runs a study, or what is left of it.

    Args:
        path: the study's file, or the name of one that is shipped.
        out: the folder.
        jobs: processes at once on this machine; -1: one for each core.
        cluster: address of a Dask scheduler instead, or "local" for one of this machine's own.
        quiet: no progress bar and no table.
        progress: False for no progress bar alone.
        repeats: instead of the file's.
        yes: whether more than 1e5 runs are meant; or what answers that, if there are so many.

    Returns:
        The summary, see the top of this module.

    Raises:
        DrakeTeleopError: for a bad file, too many runs, a folder of another study or that cannot
            be written, or Dask that is not installed.
        KeyboardInterrupt: saying what is kept.
    """
    study, path = LoadStudy(path), study_file(path)
    study.repeats = repeats or study.repeats
    study.check_size(str(path), yes)
    data, where = ReadScenario(_scenario_of(study, path))
    ScenarioFromData(data, where)
    for index, factor in enumerate(study.factors):
        _check_values(factor, f"{path}:factors[{index}]")
    work = StationWork(data, where, tuple(study.measures), study.force_threshold)
    shown = progress and not quiet
    rows = run_study(study, out, work, {"data": data}, jobs=jobs, cluster=cluster, progress=shown)
    summary = _summary(study, rows)
    with output_folder(out, kept=["runs.parquet"]):
        write_table(out / "effects.csv", effects(study, rows))
        write_pictures(study, rows, out)
        write_json(out / "summary.json", summary)
    if not quiet:
        _print(study, summary, out)
    return summary


def study_file(name_or_path: str | Path) -> Path:
    """The file of a study that is shipped, by its name, or the path as it is.

    Raises:
        DrakeTeleopError: if there is neither.
    """
    expect((str, Path), name_or_path, "study")
    shipped = studies_dir() / f"{name_or_path}.yaml"
    path = shipped if os.path.isfile(shipped) else Path(name_or_path)
    if not os.path.isfile(path):
        names = sorted(file.stem for file in studies_dir().glob("*.yaml"))
        raise DrakeTeleopError(
            f"there is no study '{name_or_path}'",
            remedy=meant(name_or_path, names, f"give a YAML file or one of {', '.join(names)}"),
        )
    return path


def LoadStudy(path: str | Path) -> Study:
    """Loads and checks a study's file; its factors are checked when the scenario is known.

    Args:
        path: or the name of one that is shipped.

    Raises:
        DrakeTeleopError: naming file and field of what is wrong.
    """
    path = study_file(path)
    data = read_yaml(path)
    check_structure(Study, data, str(path))
    study = yaml_load_typed(schema=Study, data=yaml_dump(data), defaults=Study())
    study.check(str(path))
    return study


def _scenario_of(study: Study, path: Path) -> str | Path:
    known = study.scenario in ScenarioNames()
    return study.scenario if known else path.parent / study.scenario


def _check_values(factor: Factor, where: str) -> None:
    """Checks each value by itself: whether it goes with the others is known in a run."""
    ranged = factor.low is not None and factor.high is not None
    for value in (factor.low, factor.high) if ranged else factor.listed():
        data = _changed({}, {factor.field: value})
        check_structure(Scenario, data, where)
        check_ranges(yaml_load_typed(schema=Scenario, data=yaml_dump(data)), where)


def _changed(data: Any, changes: dict[str, Any]) -> Any:
    """A copy of a scenario's data with some fields, `block.field`, changed or added."""
    data = copy.deepcopy(data)
    for name, value in changes.items():
        *blocks, last = name.split(".")
        inner = data
        for block in blocks:
            if not isinstance(inner.get(block), dict):
                inner[block] = {}
            inner = inner[block]
        # Fields that are whole numbers take no 3.0; those that are not take a 3.
        whole = isinstance(value, float) and value.is_integer()
        inner[last] = int(value) if whole else value
    return data


def _summary(study: Study, rows: pl.DataFrame) -> dict[str, Any]:
    figures = {}
    for name in study.measures:
        column = rows[name].drop_nulls()
        column = column.filter(column.is_finite())
        figures[name] = {"mean": column.mean(), "least": column.min(), "largest": column.max()}
    failed = rows["error"].drop_nulls()
    return {
        "description": study.description,
        "runs": rows.height,
        "points": rows.height // study.repeats,
        "failed": len(failed),
        "first_error": failed[0] if len(failed) else None,
        "measures": figures,
    }


def _print(study: Study, summary: dict[str, Any], out: Path) -> None:
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
        console.print("[bold yellow]warning:[/] the first one:", highlight=False)
        console.print(summary["first_error"], highlight=False, markup=False)
    console.print(f"written to {out}", highlight=False, markup=False)
