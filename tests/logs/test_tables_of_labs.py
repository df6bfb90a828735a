"""Text and Excel tables of measuring programs: encoding, text above the table, units, sheets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from known_motion import quaternions
from planted import PHI, good
from xlsxwriter import Workbook

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.logs.inspection import inspect_command
from drake_teleop.logs.processing import identify_log
from drake_teleop.logs.read.table_files import read_table

NAMES = ["Time", "Fx", "Fy", "Fz", "Tx", "Ty", "Tz"]
PREAMBLES = {
    "none": [],
    "fields": ["Sensor: FT-300", "Serial number: 12345", "Date: 12.05.2024 14:30:05", ""],
    "padded": ["Sensor{s}FT-300{s}{s}{s}{s}{s}", "Rate{s}500{s}{s}{s}{s}{s}"],
    "numbers": ["Rate{s}500", "Range{s}300", "2024-05-12{s}14:30:05", "", ""],
    "comments": ["# recorder", "Calibration at 21 °C, gain ±2 µV", "# end"],
}
UNITS = {
    "none": None,
    "known": ["s", "N", "N", "N", "Nm", "Nm", "Nm"],
    "brackets": ["[ms]", "[counts]", "[counts]", "[counts]", "[N·mm]", "[N·mm]", "[N·mm]"],
}


def lab_table(
    preamble: str, units: str, separator: str, numbers: np.ndarray, end: str = "\n"
) -> str:
    lines = [line.format(s=separator) for line in PREAMBLES[preamble]]
    lines += [separator.join(row) for row in (NAMES, UNITS[units]) if row is not None]
    decimal = "," if separator == ";" else "."
    lines += [separator.join(f"{x:.6f}".replace(".", decimal) for x in row) for row in numbers]
    return end.join(lines) + end


@pytest.mark.parametrize(
    ("encoding", "end"),
    [("utf-8", "\n"), ("utf-8-sig", "\r\n"), ("cp1252", "\r\n"), ("utf-16", "\n")],
)
@pytest.mark.parametrize("separator", [";", ",", "\t"])
@pytest.mark.parametrize("preamble", PREAMBLES)
@pytest.mark.parametrize("units", UNITS)
def test_table_below_text_is_read(
    tmp_path: Path, preamble: str, units: str, separator: str, encoding: str, end: str
) -> None:
    numbers = np.round(np.random.default_rng(3).normal(size=(40, 7)), 6)
    text = lab_table(preamble, units, separator, numbers, end)
    path = tmp_path / "x.csv"
    path.write_bytes(text.encode(encoding))
    table = read_table(path)
    if UNITS[units] is None:
        assert list(table.columns) == NAMES
    else:
        pairs = zip(NAMES, UNITS[units] or (), strict=True)
        assert list(table.columns) == [f"{n} [{u.strip('[]')}]" for n, u in pairs]
    values = table.finite_numbers(list(table.columns), 7, "here")
    np.testing.assert_allclose(values, numbers, atol=1e-9)
    row = text.split(end)[table.line_in_file(4) - 1]  # row numbers are those of the file
    assert float(row.split(separator)[0].replace(",", ".")) == pytest.approx(numbers[4, 0])


@pytest.mark.parametrize("separator", [";", ",", "\t"])
@pytest.mark.parametrize("preamble", PREAMBLES)
def test_header_below_text_can_end_in_a_separator(
    tmp_path: Path, preamble: str, separator: str
) -> None:
    names = separator.join(NAMES)
    text = lab_table(preamble, "none", separator, np.random.default_rng(3).normal(size=(40, 7)))
    (tmp_path / "x.csv").write_text(text.replace(names, names + separator))
    assert [name for name in read_table(tmp_path / "x.csv").columns if name] == NAMES


@pytest.mark.parametrize("blank", ["", "\t" * 6, " \t "])
def test_blank_line_below_the_header_is_skipped(tmp_path: Path, blank: str) -> None:
    numbers = np.round(np.random.default_rng(3).normal(size=(40, 7)), 6)
    lines = lab_table("fields", "none", "\t", numbers).splitlines()
    lines.insert(len(PREAMBLES["fields"]) + 1, blank)
    (tmp_path / "x.csv").write_text("\n".join(lines))
    table = read_table(tmp_path / "x.csv")
    assert list(table.columns) == NAMES
    np.testing.assert_allclose(table.finite_numbers(NAMES, 7, "here"), numbers, atol=1e-9)


@pytest.mark.parametrize("name", ["Kraft x [°]", "Beschl. [m/s²]", "Zeit [µs]"])
def test_names_in_the_windows_code_page_are_read(tmp_path: Path, name: str) -> None:
    (tmp_path / "x.csv").write_bytes(f"{name};b\n1,5;2\n2,5;3\n".encode("cp1252"))
    assert list(read_table(tmp_path / "x.csv").columns) == [name, "b"]


@given(broken=st.integers(0, 39), cell=st.integers(0, 6), whole=st.booleans())
@settings(max_examples=30, deadline=None)
def test_no_row_within_the_numbers_is_dropped(
    tmp_path_factory: pytest.TempPathFactory, broken: int, cell: int, whole: bool
) -> None:
    numbers = np.round(np.random.default_rng(4).normal(size=(40, 7)), 6)
    lines = lab_table("fields", "none", ",", numbers).splitlines()
    row = len(PREAMBLES["fields"]) + 1 + broken
    cells = lines[row].split(",")
    lines[row] = ",".join("error" if whole or k == cell else x for k, x in enumerate(cells))
    path = tmp_path_factory.mktemp("x") / "x.csv"
    path.write_text("\n".join(lines))
    with pytest.raises(DrakeTeleopError, match=r"x\.csv"):
        read_table(path).finite_numbers(NAMES, 7, "here")


def recording(preamble: list[str], units: list[str], scale: list[float]) -> str:
    c = good()
    columns = [c["t"][:, None], c["force"], c["torque"], c["p"], quaternions(c["R"])]
    numbers = np.hstack(columns) * np.array(scale)
    names = [*NAMES, "x", "y", "z", "qw", "qx", "qy", "qz"]
    rows = [*preamble, "\t".join(names), "\t".join(units)]
    return "\n".join([*rows, *("\t".join(f"{x:.7g}" for x in row) for row in numbers)])


@pytest.mark.slow
def test_row_of_units_gives_the_units_of_the_draft(tmp_path: Path) -> None:
    units = ["ms", *["kN"] * 3, *["N·mm"] * 3, *["mm"] * 3, *["-"] * 4]
    scale = [1e3, *[1e-3] * 3, *[1e3] * 3, *[1e3] * 3, *[1.0] * 4]
    text = recording(["Prüfstand: 7", "Messrate: 500 1/s", ""], units, scale)
    (tmp_path / "x.txt").write_bytes(text.encode("cp1252"))
    summary = inspect_command(tmp_path / "x.txt", tmp_path / "out", quiet=True)
    draft = yaml.safe_load((tmp_path / "out" / "draft.yaml").read_text())
    found = [draft["wrench"][x]["unit"] for x in ("time", "force", "torque")]
    assert [*found, draft["pose"]["position"]["unit"]] == ["ms", "kN", "N mm", "mm"]
    assert summary["findings"] == []
    load = identify_log(tmp_path / "out" / "draft.yaml").identification
    assert load.mass == pytest.approx(PHI[0], rel=0.01)


def write_sheets(path: Path, sheets: dict[str, pl.DataFrame]) -> Path:
    with Workbook(path) as book:
        for name, frame in sheets.items():
            frame.write_excel(book, name)
        book.add_worksheet("empty")
    return path


def numbers_as_frame(rows: int, names: list[str]) -> pl.DataFrame:
    numbers = np.random.default_rng(1).normal(size=(rows, len(names)))
    return pl.DataFrame(numbers, schema=names)


@pytest.mark.parametrize("place", [0, 1, 2])
@pytest.mark.parametrize("rows", [30, 400])
def test_sheet_with_the_log_is_read_and_named(tmp_path: Path, place: int, rows: int) -> None:
    log = numbers_as_frame(rows, NAMES)
    others = {
        "Info": pl.DataFrame({"field": ["sensor", "date"], "value": ["FT-300", "2024-05-12"]}),
        "Mean values": numbers_as_frame(4, NAMES),
    }
    named = list(others.items())
    named.insert(place, ("Measurement", log))
    table = read_table(write_sheets(tmp_path / "x.xlsx", dict(named)))
    np.testing.assert_allclose(table.finite_numbers(NAMES, 7, ""), log.to_numpy(), rtol=1e-14)
    assert "the sheet 'Measurement' was read" in table.note
    assert "'Info'" in table.note and "'Mean values'" in table.note


@pytest.mark.parametrize("share", [0.6, 1.0, 1.5])
def test_two_similar_sheets_raise_one_error(tmp_path: Path, share: float) -> None:
    sheets = {"Run 1": numbers_as_frame(100, NAMES), "Notes": pl.DataFrame({"a": ["b"]})}
    sheets["Run 2"] = numbers_as_frame(round(100 * share), NAMES)
    path = write_sheets(tmp_path / "x.xlsx", sheets)
    with pytest.raises(DrakeTeleopError, match=r"x\.xlsx.*'Run .'.*'Run .'.*as a CSV file"):
        read_table(path)


@pytest.mark.slow
def test_commands_print_the_name_of_the_sheet(tmp_path: Path) -> None:
    c = good()
    columns = [c["t"][:, None], c["force"], c["torque"], c["p"], quaternions(c["R"])]
    names = [*NAMES, "x", "y", "z", "qw", "qx", "qy", "qz"]
    sheets = {"Info": pl.DataFrame({"a": ["b"]}), "Log": pl.DataFrame(np.hstack(columns), names)}
    path = write_sheets(tmp_path / "x.xlsx", sheets)
    summary = inspect_command(path, tmp_path / "out", quiet=True)
    assert [(x["name"], "'Log'" in x["message"]) for x in summary["findings"]] == [("sheet", True)]
    found = identify_log(tmp_path / "out" / "draft.yaml")
    assert any("the sheet 'Log' was read" in note for note in found.log.notes)
    assert found.identification.mass == pytest.approx(PHI[0], rel=0.01)


@pytest.mark.parametrize("row", [0, 7, 29])
def test_row_numbers_of_excel_files_are_those_of_the_sheet(tmp_path: Path, row: int) -> None:
    log = numbers_as_frame(30, NAMES).with_columns(pl.col(NAMES[1]).cast(pl.String))
    log[row, NAMES[1]] = "oops"
    table = read_table(write_sheets(tmp_path / "x.xlsx", {"Log": log}))
    with pytest.raises(DrakeTeleopError, match=f"'oops' in row {row + 2} is not a number"):
        table.finite_numbers([NAMES[1]], 1, "")
