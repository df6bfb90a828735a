"""Parquet files that would abort polars are refused; all good files are accepted."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.parquet_sizes import check_parquet_content_sizes, check_parquet_sizes
from drake_teleop.lab.studies.store import Store
from drake_teleop.logs.read.table_files import read_table
from drake_teleop.station.result import Signal, SimulationResult

NEGATIVE = Path(__file__).parent / "fuzz_cases" / "result-negative_size.parquet"
ROWS = 300
MIXED = pl.DataFrame(
    {
        "t": np.arange(ROWS) * 1e-3,
        "few": ["a", "bb", None] * (ROWS // 3),
        "truth": [True, False] * (ROWS // 2),
        "empty": [None] * ROWS,
        "lists": [[1.0] * (k % 3) for k in range(ROWS)],
        "structs": [{"a": k, "b": [k, None]} for k in range(ROWS)],
        "arrays": pl.Series([[1, 2, 3]] * ROWS, dtype=pl.Array(pl.Int64, 3)),
        "dates": pl.Series(range(ROWS)).cast(pl.Datetime),
    }
)


@pytest.mark.parametrize("compression", ["zstd", "snappy", "uncompressed"])
@pytest.mark.parametrize(
    "options", [{}, {"row_group_size": 70}, {"statistics": False}, {"data_page_size": 100}], ids=str
)
@pytest.mark.parametrize("rows", [0, 1, ROWS])
def test_good_files_pass(tmp_path, compression, options, rows):
    path = tmp_path / "good.parquet"
    MIXED.head(rows).write_parquet(path, compression=compression, **options)
    check_parquet_sizes(path)


@pytest.mark.parametrize("version", ["1.0", "2.0"])
@pytest.mark.parametrize("dictionary", [True, False])
def test_good_files_of_arrow_pass(tmp_path, version, dictionary):
    parquet = pytest.importorskip("pyarrow.parquet")
    path = tmp_path / "good.parquet"
    options = {"data_page_version": version, "use_dictionary": dictionary, "data_page_size": 500}
    parquet.write_table(MIXED.to_arrow(), path, write_page_index=True, **options)
    check_parquet_sizes(path)
    parquet.ParquetWriter(path, MIXED.to_arrow().schema).close()  # file without a row group
    check_parquet_sizes(path)


def _read_rows(path: Path) -> pl.DataFrame:
    folder = path.parent / "runs.parquet"
    folder.mkdir()
    path.rename(folder / "run_00000000.parquet")
    return Store(folder).read()


@pytest.mark.parametrize("read", [read_table, SimulationResult.read_parquet, _read_rows])
def test_every_reader_refuses_a_negative_number_of_values(
    tmp_path: Path, read: Callable[[Path], object]
) -> None:
    (tmp_path / "log.parquet").write_bytes(NEGATIVE.read_bytes())
    with pytest.raises(DrakeTeleopError, match="the number of values in a page of t is -21"):
        read(tmp_path / "log.parquet")


def test_the_part_of_a_log_that_is_damaged_is_named(tmp_path: Path) -> None:
    spec = Signal("x", ("x",), "1")
    for first in (0, 5):
        t = np.arange(first, first + 5.0)
        SimulationResult(t, {"x": t}, [spec]).write_part(tmp_path / "log", first)
    part = tmp_path / "log" / "row_0000000005.parquet"
    part.write_bytes(part.read_bytes()[:-30] + part.read_bytes()[-20:])
    with pytest.raises(DrakeTeleopError, match=r"row_0000000005\.parquet: .* the file is damaged"):
        SimulationResult.scan_parquet(tmp_path / "log")


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"PAR1", "does not end with PAR1, as a Parquet file"),
        (b"no table at all", "does not end with PAR1, as a Parquet file"),
        (b"PAR1" + b"\xff\xff\xff\x7fPAR1", "its footer is longer than the file"),
        (b"PAR1" + b"\x1c" * 100 + b"\x64\x00\x00\x00PAR1", "its metadata is nested too deeply"),
        (b"PAR1" + b"\x15" + b"\xff" * 20 + b"\x15\x00\x00\x00PAR1", "is too long"),
        (b"PAR1" + b"\x00" + b"\x01\x00\x00\x00PAR1", "its metadata cannot be read"),
    ],
)
def test_content_that_is_no_parquet_is_refused(content: bytes, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        check_parquet_content_sizes(content)


def test_an_empty_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.parquet").touch()
    with pytest.raises(ValueError, match="the file is empty"):
        check_parquet_sizes(tmp_path / "x.parquet")


_READ_EACH = """
import sys
from pathlib import Path
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.logs.read.table_files import read_table
path = Path(sys.argv[1])
good = path.read_bytes()
for place in range(len(good)):
    damaged = bytearray(good)
    damaged[place] ^= int(sys.argv[2])
    path.write_bytes(damaged)
    try:
        read_table(path)
    except DrakeTeleopError:
        pass
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("bits", "options"),
    [
        (0xFF, {}),
        (1, {"row_group_size": 8, "compression": "uncompressed"}),
    ],
)
def test_no_damaged_byte_ends_the_process(tmp_path: Path, bits: int, options: dict) -> None:
    """Change single bytes; the lowest bit of a number is its sign."""
    path = tmp_path / "x.parquet"
    MIXED.select("t", "few", "empty").head(20).write_parquet(path, **options)
    command = [sys.executable, "-c", _READ_EACH, str(path), str(bits)]
    subprocess.run(command, check=True, timeout=100)
