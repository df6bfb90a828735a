"""Files of robot-learning datasets: episodes of LeRobot, robomimic, Zarr and folders of tables.

A copied dataset has two more columns in each episode; its other files are hard links if possible.
"""

from __future__ import annotations

import copy
import json
import os
import shutil
from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError, wrap_read_errors
from drake_teleop.common.files import make_folder, replace_file_on_success, write_table, write_text
from drake_teleop.common.numeric import Array
from drake_teleop.logs.read import table_files
from drake_teleop.logs.read.array_files import import_optional_module, read_hdf5, read_zarr
from drake_teleop.logs.read.canonical import WRENCH_COLUMNS
from drake_teleop.logs.read.table_files import array_columns
from drake_teleop.logs.read.tables import Table

CONTACT_WRENCH_COLUMN, IN_CONTACT_COLUMN = "observation.contact_wrench", "observation.in_contact"
_TABLE_SUFFIXES = (".csv", ".tsv", ".parquet")
_ZARR_METADATA_FILE_NAMES = (".zgroup", ".zattrs", ".zmetadata", "zarr.json")
_LEROBOT_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


class Episode(NamedTuple):
    """Episode: file, first row, number of rows (0: the whole file), and group in an HDF5 file."""

    name: str
    file: Path
    first_row: int
    rows: int
    group: str = ""


class ContactColumns(NamedTuple):
    """New columns of an episode: contact wrench (N, 6) and flags (N,) of contact."""

    contact_wrench: Array
    in_contact: NDArray[np.bool_]


class Dataset(NamedTuple):
    """Dataset of one kind: "lerobot", "hdf5", "zarr" or "tables"; `fps` is nan if unknown."""

    path: Path
    kind: str
    episodes: list[Episode]
    fps: float

    def read_episode(self, episode: Episode) -> Table:
        if self.kind == "tables":
            return table_files.read_table(episode.file)
        rows = slice(episode.first_row, episode.first_row + episode.rows)
        with wrap_read_errors(episode.file, "check that it is complete"):
            if self.kind == "lerobot":
                frame = _read_numeric_columns(episode.file, episode.file.stat().st_mtime_ns)
                columns = table_files.columns_of_frame(frame[rows])
            elif self.kind == "hdf5":
                columns = array_columns(read_hdf5(episode.file, group=episode.group), None)
            else:
                columns = array_columns(read_zarr(episode.file / "data", rows=rows), None)
            return Table(episode.file, columns, episode.first_row + 1)


@lru_cache(maxsize=1)
def _read_numeric_columns(file: Path, modified_ns: int) -> Any:
    """Return number and array columns of a Parquet file, cached by its modification time."""
    import polars as pl

    frame = pl.scan_parquet(file)
    types, nested = frame.collect_schema(), (pl.List, pl.Array)
    names = [name for name, x in types.items() if x.is_numeric() or isinstance(x, nested)]
    return frame.select(names).collect().lazy()


def open_dataset(path: Path) -> Dataset:
    if not path.exists():
        raise DrakeTeleopError("no such file or folder", where=str(path), remedy="check the path")
    with wrap_read_errors(path, "check that the dataset is complete"):
        if (path / "meta" / "info.json").is_file():
            found = _open_lerobot(path)
        elif path.suffix.lower() in (".hdf5", ".h5"):
            found = _open_hdf5(path)
        elif path.suffix.lower() == ".zarr":
            found = _open_zarr(path)
        else:
            files = sorted(p for p in path.glob("**/*") if p.suffix.lower() in _TABLE_SUFFIXES)
            episodes = [Episode(str(p.relative_to(path)), p, 0, 0) for p in files]
            found = Dataset(path, "tables", episodes, float("nan"))
    if not found.episodes:
        remedy = (
            "give a LeRobot folder, a robomimic .hdf5, a .zarr, or a folder of .csv or"
            " .parquet files, one for each episode"
        )
        raise DrakeTeleopError("the dataset contains no episodes", where=str(path), remedy=remedy)
    return found


def _open_lerobot(path: Path) -> Dataset:
    import polars as pl

    info = json.loads((path / "meta" / "info.json").read_text(encoding="utf-8"))
    episodes = []
    for file in sorted((path / "data").glob("**/*.parquet")):
        index = pl.read_parquet(file, columns=["episode_index"])["episode_index"].to_numpy()
        starts = np.flatnonzero(np.diff(index, prepend=-1))
        for first, last in zip(starts, [*starts[1:], len(index)], strict=True):
            name = f"episode {int(index[first])}"
            episodes.append(Episode(name, file, int(first), int(last - first)))
    return Dataset(path, "lerobot", episodes, float(info.get("fps", "nan")))


def _open_hdf5(path: Path) -> Dataset:
    names: list[str] = []
    settings: dict[str, Any] = {}
    with import_optional_module("h5py", path).File(path, "r") as file:
        if "data" in file:
            data = file["data"]
            names = sorted(data, key=lambda name: (len(name), name))
            settings = json.loads(data.attrs.get("env_args", "{}"))
        episodes = [Episode(name, path, 0, 0, f"data/{name}") for name in names]
    fps = settings.get("env_kwargs", {}).get("control_freq", "nan")
    return Dataset(path, "hdf5", episodes, float(fps))


def _open_zarr(path: Path) -> Dataset:
    ends = np.asarray(read_zarr(path / "meta")["episode_ends"], int)
    starts = [0, *ends[:-1]]
    episodes = [
        Episode(f"episode {k}", path, int(a), int(b - a))
        for k, (a, b) in enumerate(zip(starts, ends, strict=True))
    ]
    return Dataset(path, "zarr", episodes, float("nan"))


def write_dataset_copy(dataset: Dataset, out: Path, columns: Sequence[ContactColumns]) -> None:
    """Write a copy with new columns for each episode to `out`."""
    if dataset.kind == "hdf5":
        _write_hdf5_copy(dataset, out, columns)
        return
    written = {e.file for e in dataset.episodes} if dataset.kind != "zarr" else set()
    if dataset.kind == "lerobot":
        written |= {dataset.path / "meta" / name for name in ("info.json", "stats.json")}
    for file in sorted(p for p in dataset.path.glob("**/*") if p.is_file()):
        if file not in written:
            must_copy = dataset.kind == "zarr" and file.name in _ZARR_METADATA_FILE_NAMES
            _hard_link_or_copy(file, out / file.relative_to(dataset.path), must_copy=must_copy)
    if dataset.kind == "zarr":
        _add_columns_to_zarr(out, columns)
        return
    for path in dict.fromkeys(episode.file for episode in dataset.episodes):
        pairs = zip(dataset.episodes, columns, strict=True)
        part = _concatenate_contact_columns([new for episode, new in pairs if episode.file == path])
        target = out / path.relative_to(dataset.path)
        make_folder(target.parent)
        if path.suffix.lower() == ".parquet":
            _write_parquet_copy(path, target, part)
        else:
            _write_csv_copy(path, target, part)
    if dataset.kind == "lerobot":
        _write_lerobot_metadata(dataset.path / "meta", out / "meta", columns)


def _concatenate_contact_columns(columns: Sequence[ContactColumns]) -> ContactColumns:
    return ContactColumns(*(np.concatenate(parts) for parts in zip(*columns, strict=True)))


def _hard_link_or_copy(file: Path, target: Path, *, must_copy: bool) -> None:
    make_folder(target.parent)
    with replace_file_on_success(target) as temporary:
        temporary.unlink(missing_ok=True)
        with suppress(OSError):  # on another file system
            if not must_copy:
                os.link(file.resolve(), temporary)
                return
        shutil.copyfile(file, temporary)


def _write_parquet_copy(path: Path, target: Path, new: ContactColumns) -> None:
    import polars as pl

    frame = pl.read_parquet(path)
    wrench = pl.Series(CONTACT_WRENCH_COLUMN, np.ascontiguousarray(new.contact_wrench, np.float32))
    frame = frame.with_columns(wrench.arr.to_list(), pl.Series(IN_CONTACT_COLUMN, new.in_contact))
    kept = {k: v for k, v in pl.read_parquet_metadata(path).items() if k != "ARROW:schema"}
    if "huggingface" in kept:
        kept["huggingface"] = _add_features_to_huggingface_metadata(kept["huggingface"])
    write_table(target, frame, metadata=kept)


def _add_features_to_huggingface_metadata(text: str) -> str:
    data = json.loads(text)
    features = data.get("info", {}).get("features", {})
    lists = [x for x in features.values() if isinstance(x, dict) and "feature" in x]
    like: dict[str, Any] = copy.deepcopy(lists[0]) if lists else {"_type": "List"}
    number = {"dtype": "float32", "_type": "Value"}
    features[CONTACT_WRENCH_COLUMN] = like | {"feature": number, "length": -1}
    features[IN_CONTACT_COLUMN] = {"dtype": "bool", "_type": "Value"}
    return json.dumps(data)


def _write_csv_copy(path: Path, target: Path, new: ContactColumns) -> None:
    frame, first = table_files.read_csv(path, True)
    lines = path.read_bytes().splitlines(keepends=True)
    rows = [k for k in range(first - 1, len(lines)) if lines[k].strip()]
    head = first - 2
    is_header = head >= 0 and frame.columns[0].strip().encode() in lines[head]
    if len(rows) != len(frame) or len(frame) != len(new.in_contact) or not is_header:
        what = "columns can only be added to a file with a header and one line for each row"
        raise DrakeTeleopError(what, where=str(path), remedy="convert it to Parquet")
    texts = [line.decode("utf-8", "replace") for line in lines]
    separator = table_files.find_separator(texts[head])
    decimal = "," if table_files.has_decimal_commas(texts[first - 1 :], separator) else "."
    names = [f"{CONTACT_WRENCH_COLUMN}.{name}" for name in WRENCH_COLUMNS] + [IN_CONTACT_COLUMN]
    cells = np.column_stack([new.contact_wrench, new.in_contact])
    numbers = [[f"{x:.6g}".replace(".", decimal) for x in row] for row in cells]
    for k, values in [(head, names), *zip(rows, numbers, strict=True)]:
        text = lines[k].rstrip(b"\r\n")
        lines[k] = text + separator.join(["", *values]).encode() + lines[k][len(text) :]
    with replace_file_on_success(target) as temporary:
        temporary.write_bytes(b"".join(lines))


def _arrays_of_columns(new: ContactColumns) -> list[tuple[str, NDArray]]:
    wrench, flags = new.contact_wrench.astype(np.float32), new.in_contact.astype(bool)
    return [("contact_wrench", wrench), ("in_contact", flags)]


def _write_hdf5_copy(dataset: Dataset, out: Path, columns: Sequence[ContactColumns]) -> None:
    h5py = import_optional_module("h5py", dataset.path)
    make_folder(out.parent)
    with replace_file_on_success(out) as temporary:
        shutil.copyfile(dataset.path, temporary)
        with h5py.File(temporary, "r+") as file:
            for episode, new in zip(dataset.episodes, columns, strict=True):
                group = file[episode.group]
                group = group.get("obs", group)
                for name, values in _arrays_of_columns(new):
                    if name in group:
                        del group[name]
                    group[name] = values


def _add_columns_to_zarr(out: Path, columns: Sequence[ContactColumns]) -> None:
    zarr = import_optional_module("zarr", out)
    group, new = zarr.open_group(out / "data", mode="r+"), _concatenate_contact_columns(columns)
    for name, values in _arrays_of_columns(new):
        group.create_array(name, data=values, overwrite=True)
    if any((out / name).is_file() for name in (".zmetadata", "zarr.json")):
        root = zarr.open_group(out, mode="r").metadata
        if root.consolidated_metadata is not None:
            zarr.consolidate_metadata(out, zarr_format=root.zarr_format)


def _write_lerobot_metadata(source: Path, target: Path, columns: Sequence[ContactColumns]) -> None:
    info = json.loads((source / "info.json").read_text(encoding="utf-8"))
    wrench = {"dtype": "float32", "shape": [6], "names": list(WRENCH_COLUMNS)}
    info["features"][CONTACT_WRENCH_COLUMN] = wrench
    info["features"][IN_CONTACT_COLUMN] = {"dtype": "bool", "shape": [1], "names": None}
    make_folder(target)
    write_text(target / "info.json", json.dumps(info, indent=4, ensure_ascii=False))
    if not (source / "stats.json").is_file():
        return
    stats = json.loads((source / "stats.json").read_text(encoding="utf-8"))
    new = _concatenate_contact_columns(columns)
    with_quantiles = any("q50" in x for x in stats.values())
    for name, values in zip((CONTACT_WRENCH_COLUMN, IN_CONTACT_COLUMN), new, strict=True):
        x = values.astype(float).reshape(len(values), -1)
        x = x[np.isfinite(x).all(axis=1)]
        if not len(x):
            continue
        parts = {"min": x.min(0), "max": x.max(0), "mean": x.mean(0), "std": x.std(0)}
        if with_quantiles:
            parts |= {key: np.quantile(x, q, axis=0) for key, q in _LEROBOT_QUANTILES.items()}
        stats[name] = {key: y.tolist() for key, y in parts.items()} | {"count": [len(x)]}
    write_text(target / "stats.json", json.dumps(stats, indent=4, ensure_ascii=False))
