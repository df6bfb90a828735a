"""Result of a simulation: named signals with units, plots and Parquet files."""

from __future__ import annotations

import difflib
import html
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import numpy as np

from drake_teleop.common import errors
from drake_teleop.common.errors import DrakeTeleopError, expect_type
from drake_teleop.common.files import LOG_PARTS_GLOB, log_part_path, make_folder, write_table
from drake_teleop.common.numeric import Array, float_array
from drake_teleop.common.parquet_sizes import check_parquet_sizes

if TYPE_CHECKING:
    import pandas as pd
    import polars as pl
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike, NDArray

_SIGNAL_METADATA_KEY = "drake_teleop.signals"
# Longer curves are drawn as minimum and maximum of blocks.
_MAX_CURVE_POINTS = 20_000
# Columns of the canonical log (README, "Logs") for each signal.
_SENSOR_LOG_COLUMNS_OF_SIGNAL = {
    "sample_time": ("t",),
    "measured_wrench_S": ("f_x", "f_y", "f_z", "tau_x", "tau_y", "tau_z"),
    "specific_force_S": ("s_x", "s_y", "s_z"),
    "angular_velocity_S": ("omega_x", "omega_y", "omega_z"),
    "angular_acceleration_S": ("alpha_x", "alpha_y", "alpha_z"),
}


@dataclass(frozen=True)
class Signal:
    """Description of a recorded signal.

    Args:
        name: name of the signal's port, such as "measured_wrench_S".
        components: name of each of the k components ("f_x", ...).
        units: unit of each component, or one string for all ("1" for dimensionless).
    """

    name: str
    components: tuple[str, ...]
    units: str | tuple[str, ...]
    description: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "components", tuple(self.components))
        units = self.units
        units = (units,) * len(self.components) if isinstance(units, str) else tuple(units)
        object.__setattr__(self, "units", units)
        for text in (self.name, self.description, *self.components, *units):
            expect_type(str, text, "signal")
        if len(units) != len(self.components):
            what = f"the signal has {len(self.components)} components, but {len(units)} units"
            remedy = "give one unit, or one per component"
            raise DrakeTeleopError(what, where=self.name, remedy=remedy)

    @property
    def columns(self) -> list[str]:
        """Column names in a table, such as "measured_wrench_S.f_x"."""
        return [f"{self.name}.{component}" for component in self.components]


class SimulationResult:
    """Recorded signals of one simulation, sampled at common times.

    ``result["measured_wrench_S"]`` is an (N, k) array; ``result["measured_wrench_S.f_x"]`` and
    ``result["t"]`` are (N,) columns; ``result[10:20]`` is a result with these rows. ``len(result)``
    and iteration refer to the signals' names. Arrays are read-only.

    Args:
        t: (N,) sample times [s].
        signals: arrays by name, (N, k), or (N,) for one component.
        specs: description of each signal, in the order of the signals.
    """

    def __init__(
        self, t: ArrayLike, signals: Mapping[str, ArrayLike], specs: Sequence[Signal]
    ) -> None:
        self._t = _read_only_view(float_array("t", t))
        if self._t.ndim != 1:
            what = f"has shape {self._t.shape} instead of (N,)"
            raise DrakeTeleopError(what, where="t", remedy="give one time per row")
        self._specs = {spec.name: spec for spec in specs}
        names = ["t", *self._specs, *(column for spec in self.specs for column in spec.columns)]
        if len(set(names)) < len(names):
            what = f"the name '{max(names, key=names.count)}' occurs more than once"
            raise DrakeTeleopError(what, where="specs", remedy="use unique names; t is the time")
        self._columns = {c: (s.name, i) for s in self.specs for i, c in enumerate(s.columns)}
        if self._specs.keys() != signals.keys():
            odd = sorted(self._specs.keys() ^ signals.keys())
            what = f"only one of `signals` and `specs` contains {', '.join(odd)}"
            raise DrakeTeleopError(what, where="signals", remedy="give each signal one spec")
        self._values: Mapping[str, Array]
        if isinstance(signals, _SignalsOnDisk):
            self._values = signals
        else:
            self._values = {name: self._checked_values(name, signals[name]) for name in self._specs}

    def _checked_values(self, name: str, values: ArrayLike) -> Array:
        array = float_array(name, values)
        shape = (len(self._t), len(self._specs[name].components))
        if array.ndim == 1:
            array = array[:, np.newaxis]
        if array.shape != shape:
            what = f"has shape {array.shape} instead of {shape} (times, components)"
            remedy = "give a row per time and a column per component"
            raise DrakeTeleopError(what, where=name, remedy=remedy)
        return _read_only_view(array)

    @property
    def t(self) -> Array:
        """Sample times (N,) [s]."""
        return self._t

    @property
    def signals(self) -> tuple[str, ...]:
        """Names of the signals."""
        return tuple(self._specs)

    @property
    def specs(self) -> tuple[Signal, ...]:
        """Descriptions of the signals, in the order of `signals`."""
        return tuple(self._specs.values())

    @property
    def units(self) -> dict[str, dict[str, str]]:
        """Unit per signal and component: ``units["measured_wrench_S"]["f_x"] == "N"``."""
        return {s.name: dict(zip(s.components, s.units, strict=True)) for s in self.specs}

    @overload
    def __getitem__(self, name: str) -> Array: ...

    @overload
    def __getitem__(self, name: slice) -> SimulationResult: ...

    def __getitem__(self, name: str | slice) -> Array | SimulationResult:
        if isinstance(name, slice):
            rows = {each: self._values[each][name] for each in self.signals}
            return SimulationResult(self._t[name], rows, self.specs)
        if name == "t":
            return self._t
        if (found := self._columns.get(name)) is not None:
            return self._values[found[0]][:, found[1]]
        try:
            return self._values[name]
        except KeyError:
            names = self._ipython_key_completions_()
            near = difflib.get_close_matches(str(name), names, n=3) or self.signals
            raise KeyError(f"there is no signal {name!r}; there are {', '.join(near)}") from None

    def __contains__(self, name: object) -> bool:
        return name == "t" or name in self._specs or name in self._columns

    def __iter__(self) -> Iterator[str]:
        return iter(self._specs)

    def __len__(self) -> int:
        return len(self._specs)

    def _ipython_key_completions_(self) -> list[str]:
        return ["t", *self._specs, *self._columns]

    def to_pandas(self) -> pd.DataFrame:
        """Return the samples as a pandas data frame, with the columns of `to_dataframe`."""
        try:
            return self.to_dataframe().to_pandas()
        except ModuleNotFoundError as error:
            what = f"{error.name or 'a library'} is not installed, but pandas frames require it"
            remedy = errors.remedy_to_install_extra("notebook")
            raise DrakeTeleopError(what, where="to_pandas", remedy=remedy) from None

    def to_dataframe(self) -> pl.DataFrame:
        """Return a polars data frame with ``t`` and a column ``signal.component`` per component."""
        import polars as pl

        columns = {"t": self._t}
        for spec in self.specs:
            columns |= dict(zip(spec.columns, self._values[spec.name].T, strict=True))
        return pl.DataFrame(columns)

    def sensor_log(self) -> pl.DataFrame:
        """Return the wrist sensor's samples as a log for `identify` and `eliminate`.

        Columns ``t``, ``f_x`` ... ``tau_z``, ``s_x`` ..., ``omega_x`` ..., ``alpha_x`` ... in S and
        SI units; the wrench is that on the load. Each sampling instant ``t`` has one row.
        """
        import polars as pl

        missing = [name for name in _SENSOR_LOG_COLUMNS_OF_SIGNAL if name not in self]
        if missing:
            what = f"the result contains no {', '.join(missing)} (a sensor log needs these signals)"
            remedy = "record the wrist sensor's signals"
            raise DrakeTeleopError(what, where="sensor log", remedy=remedy)
        columns: dict[str, Array] = {}
        for name, names in _SENSOR_LOG_COLUMNS_OF_SIGNAL.items():
            columns |= dict(zip(names, self[name].T, strict=True))
        return pl.DataFrame(columns).unique("t", keep="first", maintain_order=True)

    def write_parquet(self, path: str | Path) -> None:
        """Write the samples to a file, with names, units and descriptions as metadata.

        Equal data give equal bytes.
        """
        self._write_parquet_file(Path(path))

    def _write_parquet_file(self, path: Path, temporary_base: Path | None = None) -> None:
        specs = [asdict(spec) for spec in self.specs]
        # Fixed row groups: polars' default may depend on the number of threads.
        metadata = {_SIGNAL_METADATA_KEY: json.dumps(specs)}
        table = self.to_dataframe()
        write_table(
            path, table, temporary_base=temporary_base, metadata=metadata, row_group_size=2**16
        )

    def write_part(self, folder: Path, first_row: int) -> None:
        """Write this result as one part of a longer log, in the format of `write_parquet`.

        A part with the same `first_row` is replaced, except by an empty result.

        Args:
            folder: folder of the log.
            first_row: index of this result's first row in the whole log.
        """
        part = log_part_path(folder, first_row)
        if len(self.t) or not part.exists():
            make_folder(folder)
            self._write_parquet_file(part, temporary_base=folder)

    @classmethod
    def read_parquet(cls, path: str | Path) -> SimulationResult:
        """Return the result in a file of `write_parquet` or a folder of `simulate`."""
        on_disk = cls.scan_parquet(path)
        return cls(on_disk.t, {name: on_disk[name] for name in on_disk}, on_disk.specs)

    @classmethod
    def scan_parquet(cls, path: str | Path) -> SimulationResult:
        """Return the result as `read_parquet`, but read a signal from the disk at each access."""
        import polars as pl

        expect_type((str, Path), path, "result")
        path = Path(path)
        remedy = "give what SimulationResult.write_parquet or drake-teleop run wrote"
        parts = _files_of_log(path)
        for part in parts:
            with errors.wrap_read_errors(part, remedy, "is not a simulation result"):
                check_parquet_sizes(part)
        with errors.wrap_read_errors(path, remedy, "is not a simulation result"):
            text = pl.read_parquet_metadata(parts[0])[_SIGNAL_METADATA_KEY]
            specs = [Signal(**entry) for entry in json.loads(text)]
            t = _read_columns(path, ["t"])[:, 0]
        return cls(t, _SignalsOnDisk(path, specs), specs)

    def plot(self, *names: str, contact: ArrayLike | None = None) -> Figure:
        """Plot signals over time, one subplot per signal and unit.

        Args:
            names: signals, or columns such as "contact_wrench_S.f_z"; default: all signals.
            contact: (N,) booleans; times in contact are shaded.
        """
        from drake_teleop.common.style import Picture, plot_style, shade_contact

        panels = [panel for name in names or self.signals for panel in self._panels_per_unit(name)]
        with plot_style():
            figure = Picture(figsize=(8.0, 0.6 + 1.9 * len(panels)))
            rows = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
            for axes, (name, unit, indices) in zip(rows, panels, strict=True):
                components, values = self._specs[name].components, self._values[name]
                for index in indices:
                    axes.plot(*_row_extremes(self._t, values[:, index]), label=components[index])
                if contact is not None:
                    shade_contact(axes, self._t, contact)
                axes.set_title(name)
                axes.set_ylabel(unit if unit != "1" else "")
                axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
                axes.margins(x=0)
            rows[-1].set_xlabel("t [s]")
        return figure

    def _panels_per_unit(self, name: str) -> list[tuple[str, str, list[int]]]:
        if name in self._columns:
            signal, index = self._columns[name]
            return [(signal, self._specs[signal].units[index], [index])]
        if name == "t":
            raise KeyError("'t' is the abscissa of every plot; give the names of signals")
        if name not in self._specs:
            self[name]  # a KeyError with a suggestion
        units = self._specs[name].units
        groups = groupby(range(len(units)), key=lambda index: units[index])
        return [(name, unit, list(indices)) for unit, indices in groups]

    def _time_range_text(self) -> str:
        if not len(self._t):
            return "no samples"
        return f"{len(self._t)} samples, {self._t[0]:g} to {self._t[-1]:g} s"

    def __repr__(self) -> str:
        width = max((len(name) for name in self.signals), default=0)
        lines = [f"SimulationResult: {self._time_range_text()}"]
        for spec in self.specs:
            text = f"  {spec.name:{width}}  {_components_and_units_text(spec)}  {spec.description}"
            lines.append(text.rstrip())
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        left, rows = " style='text-align:left'", ""
        for spec in self.specs:
            texts = spec.name, _components_and_units_text(spec), spec.description
            name, components, description = map(html.escape, texts)
            rows += f"<tr><td{left}><code>{name}</code></td><td{left}>{components}</td>"
            rows += f"<td{left}>{description}</td></tr>"
        titles = "signal", "components [unit]", "what it is"
        head = "".join(f"<th{left}>{title}</th>" for title in titles)
        table = f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"
        return f"<b>SimulationResult</b>: {self._time_range_text()}{table}"


class _SignalsOnDisk(dict[str, Any]):
    """Signals on disk: `[name]` reads an array (N, k), other methods give column names."""

    def __init__(self, path: Path, specs: Sequence[Signal]) -> None:
        super().__init__((spec.name, spec.columns) for spec in specs)
        self._path = path

    def __getitem__(self, name: str) -> Array:
        columns = super().__getitem__(name)
        with errors.wrap_read_errors(self._path, "make the log again"):
            return _read_only_view(_read_columns(self._path, columns))


def _row_extremes(t: Array, values: Array) -> tuple[Array, Array]:
    length = 2 * len(t) // _MAX_CURVE_POINTS
    if length < 2:
        return t, values
    starts = np.arange(0, len(t), length)
    extremes = [ufunc.reduceat(values, starts) for ufunc in (np.minimum, np.maximum)]
    return np.repeat(t[starts], 2), np.ravel(extremes, order="F")


def _components_and_units_text(spec: Signal) -> str:
    pairs = zip(spec.components, spec.units, strict=True)
    groups = groupby(pairs, key=lambda pair: pair[1])
    return ", ".join(f"{', '.join(c for c, _ in pairs)} [{unit}]" for unit, pairs in groups)


def _files_of_log(path: Path) -> list[Path]:
    return sorted(path.glob(LOG_PARTS_GLOB)) or [path]


def _read_columns(path: Path, columns: list[str]) -> Array:
    import polars as pl

    errors.refuse_polars_in_forked_process()
    table = pl.read_parquet(_files_of_log(path), columns=columns)
    if not all(dtype.is_numeric() for dtype in table.dtypes):
        raise ValueError(f"columns {', '.join(columns)} do not contain numbers")
    return table.to_numpy()


def _read_only_view(array: NDArray[Any]) -> NDArray[Any]:
    view = array.view()
    view.flags.writeable = False
    return view
