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

A factor of one value sets a field for all runs. Every run follows the rule of `drake-teleop run`;
runs with the same slave, sensor and seed share one identification of the load.

The folder holds

============ =====================================================================================
study.json   all that the rows depend on
runs.parquet a folder of parts, one table: run (the key, its place in the design), point, repeat,
             seed, a column for each factor and each measure, and error: why a run failed; its
             measures are then null
summary.json runs, failed, and of each measure mean, least and largest
============ =====================================================================================

A study that was stopped or killed goes on where it was when the same command is given again. The
rows are the same bytes for any number of processes, here or on a cluster.
"""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
import copy
import dataclasses
import hashlib
import itertools
import json
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import yaml
from numpy.typing import NDArray
from pydrake.common.yaml import yaml_dump, yaml_load, yaml_load_typed

from drake_teleop._version import __version__
from drake_teleop.errors import DrakeTeleopError
from drake_teleop.experiments.identification import identification_scenario, identify_load
from drake_teleop.experiments.progress import Progress, progress_bars
from drake_teleop.experiments.run import run_scenario
from drake_teleop.experiments.study_store import Store, open_store
from drake_teleop.quantities import check_ranges, check_structure, choice, quantity
from drake_teleop.result import SimulationResult
from drake_teleop.scenario import ReadScenario, Scenario, ScenarioFromData, ScenarioNames
from drake_teleop.simulation import simulate
from drake_teleop.station import MakeTeleopStation

if TYPE_CHECKING:
    import polars as pl

Array = NDArray[np.float64]
Values: TypeAlias = dict[str, float | str]
"""The factors' values of one point of the design, by field."""
Work: TypeAlias = Callable[[Values, int], dict[str, float]]
"""The measures of one run, from its factors' values and its seed."""

# A part of the store: what a kill costs, and what is handed to a process at once.
_LARGEST_CHUNK = 8
_CHUNKS = 64


def _peak(forces: Array) -> float:
    return float(np.linalg.norm(forces, axis=1).max(initial=0.0))


def _force_to_master(result: SimulationResult) -> Array:
    return result["force_to_master"][:, :3]


def _peak_contact_force(result: SimulationResult, threshold: float) -> float:
    if "true_contact_wrench_W" not in result:
        return 0.0
    return _peak(result["true_contact_wrench_W"][:, :3])


def _hand_work(result: SimulationResult, threshold: float) -> float:
    power = np.sum(result["hand_wrench_E"] * result["twist_master"], axis=1)
    return float(np.trapezoid(power, result.t))


def _time_above(result: SimulationResult, threshold: float) -> float:
    above = np.linalg.norm(_force_to_master(result), axis=1) > threshold
    return float(np.trapezoid(above.astype(float), result.t))


#: Measures of a run by name: of its signals and the study's `force_threshold` [N].
MEASURES: dict[str, Callable[[SimulationResult, float], float]] = {
    # Largest force that the device displays.
    "peak_force_to_master_N": lambda result, _: _peak(_force_to_master(result)),
    # Root of the mean of its square.
    "rms_force_to_master_N": lambda result, _: float(
        np.sqrt(np.mean(np.sum(_force_to_master(result) ** 2, axis=1)))
    ),
    # Largest force between tool and environment, the simulation's truth.
    "peak_contact_force_N": _peak_contact_force,
    # Integral of F.v and tau.omega: what the hand puts into the stylus.
    "hand_work_J": _hand_work,
    # How long the displayed force is above the threshold.
    "time_above_force_s": _time_above,
}


@dataclass
class Factor:
    """A field of the scenario that the study varies: by values, by words, or over a range."""

    field: str = ""
    """`block.field`, as it stands in a scenario file."""
    values: list[float] = dataclasses.field(default_factory=list)
    words: list[str] = dataclasses.field(default_factory=list)
    low: float | None = None
    high: float | None = None
    levels: int = quantity(3, "1", 2, 1000, "values between low and high in a factorial design")

    def listed(self) -> Sequence[float | str]:
        """The values of a factorial design."""
        if self.low is not None and self.high is not None:
            return [float(value) for value in np.linspace(self.low, self.high, self.levels)]
        return self.values or self.words

    def at(self, share: float) -> float | str:
        """The value at a share from 0 up to 1 of the way through the range or the list."""
        if self.low is not None and self.high is not None:
            return self.low + share * (self.high - self.low)
        listed = self.listed()
        return listed[int(share * len(listed))]

    def check(self, where: str) -> None:
        """Checks all that can be checked without the scenario.

        Raises:
            DrakeTeleopError: naming `where`.
        """
        ranged = [self.low is not None, self.high is not None]
        if [bool(self.values), bool(self.words), any(ranged)].count(True) != 1 or (
            any(ranged) and not all(ranged)
        ):
            raise DrakeTeleopError(
                "what it varies over is not clear",
                where=where,
                remedy="give either values, or words, or both low and high",
            )
        if self.low is not None and self.high is not None and not self.low < self.high:
            raise DrakeTeleopError(
                f"the range ends at {self.high:g}, before it begins", where=f"{where}.high"
            )
        if len(set(self.listed())) < len(self.listed()):
            raise DrakeTeleopError("a value stands there twice", where=where)


@dataclass
class Study:
    """What a study varies, by which design, and what it measures."""

    description: str = ""
    scenario: str = "contact_transition"
    """Name of a shipped one, or a YAML file; its path is relative to the study's file."""
    factors: list[Factor] = dataclasses.field(default_factory=list)
    design: str = choice(
        "factorial",
        ("factorial", "sobol"),
        "every combination of the values, or scrambled Sobol points",
    )
    samples: int = quantity(64, "1", 1, 2**20, "points of a Sobol design, a power of two")
    repeats: int = quantity(1, "1", 1, 1e6, "runs of each point, each with a seed of its own")
    seed: int = quantity(0, "1", 0, 1e9, "of the Sobol points, and of the first repeat")
    measures: list[str] = dataclasses.field(default_factory=lambda: list(MEASURES))
    force_threshold: float = quantity(1.0, "N", 0.0, 1e3, "of time_above_force_s")

    def check(self, where: str) -> None:
        """Checks all that can be checked without the scenario.

        Raises:
            DrakeTeleopError: naming `where` and the field.
        """
        check_ranges(self, where)
        for name in self.measures:
            if name not in MEASURES:
                raise DrakeTeleopError(
                    f"there is no measure '{name}'",
                    where=f"{where}:measures",
                    remedy=f"choose among {', '.join(MEASURES)}",
                )
        for index, factor in enumerate(self.factors):
            factor.check(f"{where}:factors[{index}]")
        fields = [factor.field for factor in self.factors]
        for index, name in enumerate(fields):
            place = f"{where}:factors[{index}].field"
            if name in fields[:index]:
                raise DrakeTeleopError(f"{name} is varied twice", where=place)
            if name == "simulation.seed":
                raise DrakeTeleopError(
                    "the seed is no factor", where=place, remedy="set repeats and seed"
                )
        if not self.factors:
            raise DrakeTeleopError("nothing is varied", where=f"{where}:factors")
        if self.design == "sobol" and self.samples & (self.samples - 1):
            raise DrakeTeleopError(
                f"{self.samples} Sobol points are not balanced",
                where=f"{where}:samples",
                remedy="give a power of two",
            )

    def points(self) -> list[Values]:
        """The design: the factors' values at each of its points."""
        names = [factor.field for factor in self.factors]
        if self.design == "factorial":
            combinations = itertools.product(*(factor.listed() for factor in self.factors))
            return [dict(zip(names, values, strict=True)) for values in combinations]
        from scipy.stats import qmc

        # A generator as `seed`: the keyword of every version, with the meaning of the new one.
        sobol = qmc.Sobol(len(names), seed=np.random.default_rng(self.seed))
        shares = sobol.random_base2(self.samples.bit_length() - 1)
        return [
            {factor.field: factor.at(u) for factor, u in zip(self.factors, point, strict=True)}
            for point in shares.tolist()
        ]

    def rows(self) -> list[dict[str, Any]]:
        """The runs, without their measures.

        All points have the same seeds: what differs between them is not the noise. Every second
        seed is left to the identification that goes before a run.
        """
        order = itertools.product(enumerate(self.points()), range(self.repeats))
        return [
            {"run": run, "point": point, "repeat": repeat, "seed": self.seed + 2 * repeat} | values
            for run, ((point, values), repeat) in enumerate(order)
        ]


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
        """The measures of one run."""
        result = _simulated(self.scenario(values, seed))
        return {name: MEASURES[name](result, self.threshold) for name in self.measures}


def study_command(
    path: Path,
    out: Path,
    *,
    jobs: int = -1,
    cluster: str | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Runs a study, or what is left of it.

    Args:
        path: the study's file.
        out: the folder.
        jobs: processes at once on this machine; -1: one for each core.
        cluster: address of a Dask scheduler instead, or "local" for one of this machine's own.
        quiet: no progress bar and no table.

    Returns:
        The summary, see the top of this module.

    Raises:
        DrakeTeleopError: for a bad file, a folder of another study, or Dask that is not installed.
        KeyboardInterrupt: saying what is kept.
    """
    study = LoadStudy(path)
    data, where = ReadScenario(_scenario_of(study, path))
    ScenarioFromData(data, where)
    for index, factor in enumerate(study.factors):
        _check_values(factor, f"{path}:factors[{index}]")
    work = StationWork(data, where, tuple(study.measures), study.force_threshold)
    rows = run_study(study, out, work, {"data": data}, jobs=jobs, cluster=cluster, quiet=quiet)
    summary = _summary(study, rows)
    text = json.dumps(summary, indent=2, allow_nan=False)
    (out / "summary.json").write_text(text + "\n", encoding="utf-8")
    if not quiet:
        _print(study, summary, out)
    return summary


def LoadStudy(path: str | Path) -> Study:
    """Loads and checks a study's file; its factors are checked when the scenario is known.

    Raises:
        DrakeTeleopError: naming file and field of what is wrong.
    """
    try:
        text = Path(path).read_text()
        data = yaml_load(data=text)
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise DrakeTeleopError(f"is not YAML ({error})", where=str(path)) from None
    check_structure(Study, data, str(path))
    study = yaml_load_typed(schema=Study, data=text, defaults=Study())
    study.check(str(path))
    return study


def run_study(
    study: Study,
    out: Path,
    work: Work,
    basis: dict[str, Any],
    *,
    jobs: int = -1,
    cluster: str | None = None,
    quiet: bool = True,
) -> "pl.DataFrame":
    """Runs what the folder does not hold yet of a study.

    Args:
        study: that was checked.
        out: the folder.
        work: one run; it goes to other processes, so it can be pickled.
        basis: what its results depend on beside the study, for JSON.
        jobs, cluster, quiet: as for `study_command`.

    Returns:
        All rows, sorted by run.

    Raises:
        DrakeTeleopError: as `study_command`, or if a process dies.
        KeyboardInterrupt: saying what is kept.
    """
    rows = study.rows()
    size = min(max(len(rows) // _CHUNKS, 1), _LARGEST_CHUNK)
    chunks = [rows[first : first + size] for first in range(0, len(rows), size)]
    digest = hashlib.sha256(json.dumps(rows).encode()).hexdigest()
    identity = dataclasses.asdict(study) | basis | {"design_sha256": digest, "version": __version__}
    schema = _schema(study, rows[0])
    with open_store(out, identity) as store:
        finished = store.finished()
        left = [chunk for chunk in chunks if chunk[0]["run"] not in finished]
        try:
            with progress_bars(quiet) as stage:
                told = _Told(stage("Study"), len(rows), sum(map(len, left)))
                for found in _run_chunks(work, study, left, jobs, cluster):
                    _keep(store, found, schema)
                    told.more(len(found))
        except KeyboardInterrupt as interrupt:
            kept = f"{out} keeps {told.done} of {len(rows)} runs; the same command goes on"
            raise KeyboardInterrupt(kept) from interrupt
        except BrokenExecutor as error:
            raise DrakeTeleopError(
                f"a process has died after {told.done} of {len(rows)} runs ({error})",
                where=str(out),
                remedy="the same command goes on; with fewer --jobs if memory was short",
            ) from error
        return store.read()


class _Told:
    """Tells the progress bar how many runs are done, and how long the others will take."""

    def __init__(self, progress: Progress, total: int, left: int) -> None:
        self._progress, self._total, self._left = progress, total, left
        self._start = time.monotonic()
        self.done = total - left
        progress(self.done / total, f"{self.done}/{total}")

    def more(self, runs: int) -> None:
        self.done += runs
        new = self._left - (self._total - self.done)
        seconds = (time.monotonic() - self._start) / new * (self._total - self.done)
        eta = f"{self.done}/{self._total}, {_duration(seconds)} left"
        self._progress(self.done / self._total, eta)


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"


def _run_chunks(
    work: Work,
    study: Study,
    chunks: Sequence[list[dict[str, Any]]],
    jobs: int,
    cluster: str | None,
) -> Iterator[list[dict[str, Any]]]:
    """The rows of each chunk with their measures, in the order in which they are done."""
    run = partial(_run_chunk, work, [factor.field for factor in study.factors])
    with _processes(jobs, cluster) as each:
        if chunks:
            # The first run compiles; side by side, processes would do that twice.
            yield run(chunks[0])
            yield from each(run, chunks[1:])


@contextmanager
def _processes(jobs: int, cluster: str | None) -> Iterator[Callable[..., Iterator[Any]]]:
    """A `map` in any order, over processes of this machine or Dask's workers."""
    if cluster is None:
        from joblib import Parallel, delayed

        parallel = Parallel(n_jobs=jobs, return_as="generator_unordered")
        yield lambda run, chunks: parallel(delayed(run)(chunk) for chunk in chunks)
        return
    try:
        # Not by joblib, whose backend for Dask waits for ever when a worker dies.
        from distributed import Client, KilledWorker, as_completed
    except ImportError:
        raise DrakeTeleopError(
            "Dask is not installed",
            where="--cluster",
            remedy="install it with the extra: pip install 'drake_teleop[cluster]'",
        ) from None
    local = {
        "n_workers": jobs if jobs > 0 else None,
        "threads_per_worker": 1,
        "dashboard_address": ":0",
    }
    try:
        client = Client(**local) if cluster == "local" else Client(cluster)
    except (OSError, ValueError) as error:
        raise DrakeTeleopError(
            f"no Dask scheduler answers at {cluster} ({error})", where="--cluster"
        ) from None
    try:
        with client:
            yield lambda run, chunks: (
                future.result() for future in as_completed(client.map(run, chunks, pure=False))
            )
    except KilledWorker as error:
        raise BrokenExecutor(str(error)) from error


def _run_chunk(
    work: Work, names: Sequence[str], rows: Sequence[dict[str, Any]]
) -> list[dict[str, Any]]:
    """The rows with their measures, or with the reason why a run has none."""
    found = []
    for row in rows:
        values = {name: row[name] for name in names}
        try:
            measures: dict[str, Any] = work(values, row["seed"])
        except DrakeTeleopError as error:
            measures = {"error": str(error)}
        except Exception as error:  # whatever it is, the other runs go on
            measures = {"error": " ".join(f"{type(error).__name__}: {error}".split())}
        found.append(row | measures)
    return found


def _keep(store: Store, rows: list[dict[str, Any]], schema: dict[str, Any]) -> None:
    import polars as pl

    columns = {name: [row.get(name) for row in rows] for name in schema}
    store.write(pl.DataFrame(columns, schema=schema))


def _schema(study: Study, row: dict[str, Any]) -> dict[str, Any]:
    import polars as pl

    types = {int: pl.Int64, float: pl.Float64, str: pl.String}
    columns = {name: types[type(value)] for name, value in row.items()}
    return columns | dict.fromkeys(study.measures, pl.Float64) | {"error": pl.String}


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


_estimates: dict[str, Array] = {}


def _simulated(scenario: Scenario) -> SimulationResult:
    """`run_scenario`, which identifies a load only once in a process."""
    if scenario.load_estimator.enabled:
        return run_scenario(scenario).result
    before = identification_scenario(scenario, scenario.simulation.seed + 1)
    if repr(before) not in _estimates:
        _estimates[repr(before)] = identify_load(before).estimate
    station = MakeTeleopStation(scenario, load_estimate=_estimates[repr(before)])
    return simulate(station, scenario.simulation)


def _summary(study: Study, rows: "pl.DataFrame") -> dict[str, Any]:
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
