from __future__ import annotations

import struct
import subprocess
import sys
import zlib
from functools import partial
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from scipy.io import savemat
from scipy.sparse import eye_array

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.logs.read.canonical import Log, write_log
from drake_teleop.logs.read.reading import read_log
from drake_teleop.logs.read.table_files import read_table
from drake_teleop.logs.read.tables import decimal_resolution


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def test_csv_and_parquet_give_the_same_table(tmp_path: Path) -> None:
    frame = pl.DataFrame({"a": [1.0, 2.5], "b": [3, 4]})
    frame.write_csv(tmp_path / "x.csv")
    frame.write_parquet(tmp_path / "x.parquet")
    for name in ("x.csv", "x.parquet"):
        found = read_table(tmp_path / name).finite_numbers(["b", "a"], 2, "here")
        assert found.tolist() == [[3.0, 1.0], [4.0, 2.5]]


def test_npz_array_counts_as_several_columns(tmp_path: Path) -> None:
    matrices = np.arange(18.0).reshape(2, 3, 3)
    np.savez(tmp_path / "x.npz", R=matrices, t=np.arange(2.0))
    found = read_table(tmp_path / "x.npz").finite_numbers(["R"], 9, "here")
    assert found.tolist() == matrices.reshape(2, 9).tolist()
    parts = read_table(tmp_path / "x.npz").finite_numbers(["R[5]", "R[0]"], 2, "here")
    assert parts.tolist() == [[5.0, 0.0], [14.0, 9.0]]


@pytest.mark.parametrize("suffix", [".npz", ".mat", ".h5"])
@pytest.mark.parametrize("rows", [70, 3])
def test_arrays_with_a_column_per_sample_are_turned(tmp_path: Path, suffix: str, rows: int) -> None:
    """MATLAB users often store vectors as (3, N) and matrices as (4, 4, N)."""
    path, t = tmp_path / f"x{suffix}", np.arange(float(rows))
    F, T = np.arange(3.0 * rows).reshape(3, rows), np.arange(16.0 * rows).reshape(4, 4, rows)
    arrays = {"t": t, "F": F, "T": T, "square": np.eye(3), "usual": F.T.copy()}
    if suffix == ".npz":
        np.savez(path, **arrays)
    elif suffix == ".mat":
        savemat(path, arrays)
    else:
        h5py = pytest.importorskip("h5py")
        with h5py.File(path, "w") as file:
            for name, array in arrays.items():
                file[name] = array
    table = read_table(path)
    assert table.finite_numbers(["usual"], 3, "here").tolist() == F.T.tolist()
    if rows == 70:
        assert table.finite_numbers(["F"], 3, "here").tolist() == F.T.tolist()
        assert table.finite_numbers(["T[7]"], 1, "here")[:, 0].tolist() == T[1, 3].tolist()
    assert len(table.finite_numbers(["square"], 3, "here")) == 3


def test_array_with_samples_as_rows_stays_beside_a_short_vector(tmp_path: Path) -> None:
    F = np.arange(210.0).reshape(70, 3)
    np.savez(tmp_path / "x.npz", F=F, gravity=np.zeros(3))
    assert read_table(tmp_path / "x.npz").finite_numbers(["F"], 3, "here").tolist() == F.tolist()


def test_short_record_with_samples_as_rows_stays_beside_a_vector(tmp_path: Path) -> None:
    F = np.arange(18.0).reshape(3, 6)
    np.savez(tmp_path / "x.npz", t=np.arange(3.0), F=F, offset=np.zeros(6))
    assert read_table(tmp_path / "x.npz").finite_numbers(["F"], 6, "here").tolist() == F.tolist()


def test_columns_of_csv_without_header_are_named_by_number(tmp_path: Path) -> None:
    table = read_table(write(tmp_path / "x.csv", "1,2,3\n4,5,6\n"), header=False)
    assert table.finite_numbers([2, 0], 2, "here").tolist() == [[3.0, 1.0], [6.0, 4.0]]


@pytest.mark.parametrize(
    ("name", "text", "columns", "words"),
    [
        ("x.csv", "force_x,t\n1,2\n", ["forcex"], ["no column 'forcex'", "did you mean force_x"]),
        ("x.csv", "a,b\n1,2\n3,x7\n", ["b"], ["'x7' in row 3 is not a number", "x.csv:b"]),
        ("x.csv", "a,b\n1,2\n3,\n", ["b"], ["no finite number in 1 rows, the first is row 3"]),
        ("x.csv", "a,b\n1,2\n3,nan\n4,nan\n", ["b"], ["in 2 rows, the first is row 3"]),
        ("x.csv", "a,b\n1,2\n3,inf\n", ["b"], ["no finite number"]),
        ("x.csv", "a,b\n1,2\n3,4,5\n", ["b"], ["cannot be read"]),
        ("x.csv", "a,b\n1,2\n", ["a", "b"], ["lists 2 columns, but 1 are needed", "here:"]),
        ("x.csv", "a,b\n", ["a"], ["has no rows"]),
        ("x.csv", "", ["a"], ["cannot be read"]),
        ("x.parquet", "no parquet", ["a"], ["cannot be read", "valid .parquet"]),
        ("x.npz", "no npz", ["a"], ["cannot be read"]),
        ("x.xls", "", ["a"], ["no log format '.xls'", ".xlsx"]),
    ],
)
def test_errors_name_file_and_remedy(
    tmp_path: Path, name: str, text: str, columns: list[str], words: list[str]
) -> None:
    path = write(tmp_path / name, text)
    with pytest.raises(DrakeTeleopError) as error:
        read_table(path).finite_numbers(columns, 1, "here")
    for word in [*words, ";"]:
        assert word in str(error.value)


@pytest.mark.parametrize("row", [0, 2500])
@pytest.mark.parametrize("cell", ["2.5", "1e3", " 3", "+5", "nan", "", "Infinity", "9" * 25])
def test_column_types_do_not_depend_on_the_first_rows(tmp_path: Path, row: int, cell: str) -> None:
    """The first rows contain only integers here."""
    cells = [str(k) for k in range(3000)]
    cells[row] = cell
    table = read_table(write(tmp_path / "x.csv", "\n".join(["a,b", *(f"{c},7" for c in cells)])))
    expected = np.arange(3000.0)
    expected[row] = float(cell or "nan")
    np.testing.assert_array_equal(table.single_column("a", "here"), expected)


@pytest.mark.parametrize("row", [1, 2500])
@pytest.mark.parametrize("cell", ["x7", "2020-01-01", "true", "0x10"])
def test_error_names_the_row_of_a_cell_without_a_number(
    tmp_path: Path, row: int, cell: str
) -> None:
    cells = ["1.5"] * 3000
    cells[row] = cell
    table = read_table(write(tmp_path / "x.csv", "\n".join(["a,b", *(f"{c},7" for c in cells)])))
    with pytest.raises(DrakeTeleopError, match=rf"'{cell}' in row {row + 2} is not a number"):
        table.numbers_with_nan("a", "here")


def test_missing_file_raises_error(tmp_path: Path) -> None:
    with pytest.raises(DrakeTeleopError, match=r"none\.csv: no such file"):
        read_table(tmp_path / "none.csv")


def test_columns_of_different_length_raise_error(tmp_path: Path) -> None:
    np.savez(tmp_path / "x.npz", a=np.zeros(3), b=np.zeros(4))
    with pytest.raises(DrakeTeleopError, match=r"'b' of x\.npz has 4 rows where 3 are needed"):
        read_table(tmp_path / "x.npz").finite_numbers(["a", "b"], 2, "here")


@pytest.mark.parametrize(
    ("error", "raised"),
    [(pl.exceptions.PanicException("a bug\nof theirs"), DrakeTeleopError),
     (MemoryError(), DrakeTeleopError), (KeyboardInterrupt(), KeyboardInterrupt)],
)  # fmt: skip
def test_panic_in_polars_is_an_error_but_ctrl_c_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException, raised: type
) -> None:
    """A panic is no subclass of Exception."""

    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(pl, "read_csv", fail)
    with pytest.raises(raised) as found:
        read_table(write(tmp_path / "x.csv", "a\n1\n"))
    assert "\n" not in str(found.value)
    if raised is DrakeTeleopError:
        assert "x.csv: cannot be read: " in str(found.value)


LAB = "t,f\n0.5,1.25\n1.5,-2.0\n"


@pytest.mark.parametrize(
    "text",
    [
        LAB.replace(",", ";").replace(".", ","),  # spreadsheet with decimal commas
        LAB.replace(",", "\t"),
        "# recorder 3, 500 Hz\n\n" + LAB,
        "# " + LAB.replace(",", " "),  # numpy.savetxt
        "   t         f\n  0.5    1.25\n  1.5   -2.0\n",  # aligned columns
        "# t    f\n   5.0e-01   1.25e+00\n   1.5e+00  -2.0e+00 \n",
        '"t";"f, in N"\n0,5;1,25\n1,5;-2,0\n'.replace("f, in N", "f"),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("suffix", ["csv", "txt"])
def test_text_of_other_programs_is_read(
    tmp_path: Path, text: str, encoding: str, suffix: str
) -> None:
    path = tmp_path / f"x.{suffix}"
    path.write_bytes(text.encode(encoding))
    found = read_table(path).finite_numbers(["t", "f"], 2, "here")
    assert found.tolist() == [[0.5, 1.25], [1.5, -2.0]]


@pytest.mark.parametrize("form", ["4", "5"])
def test_matlab_variables_and_fields_are_columns(tmp_path: Path, form: str) -> None:
    t, force, turned = np.arange(4.0), np.arange(12.0).reshape(4, 3), np.arange(36.0)
    variables = {"t": t, "force": force, "rate": 500.0, "empty": np.zeros((0, 3))}
    if form == "5":
        pages = turned.reshape(4, 3, 3).transpose(1, 2, 0)  # order of rotm2quat
        variables["tool"] = {"R": pages, "name": "gripper", "imu": {"gyro": 2 * force}}
        structures = np.array([[(t,), (2 * t,)]], [("a", object)])
        cells = np.array([t, "x"], object)
        variables |= {"many": structures, "cells": cells, "z": 1j * t, "sparse": eye_array(3)}
    savemat(tmp_path / "x.mat", variables, format=form)
    table = read_table(tmp_path / "x.mat")
    assert (
        table.finite_numbers(["t", "force"], 4, "here").tolist()
        == np.column_stack([t, force]).tolist()
    )
    if form == "5":
        whole = {name for name in table.columns if "[" not in name}
        assert whole == {"t", "force", "tool.R", "tool.imu.gyro"}
        assert table.numbers_with_nan("tool.R[1]", "here")[:, 0].tolist() == turned[1::9].tolist()
        assert table.finite_numbers(["tool.R"], 9, "here").tolist() == turned.reshape(4, 9).tolist()
        assert table.finite_numbers(["tool.imu.gyro"], 3, "here").tolist() == (2 * force).tolist()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"no mat", "cannot be read"),
        (
            b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + b"\x89HDF\r\n\x1a\n",
            "cannot be read",
        ),
        (None, "save tables and timeseries"),
    ],
)
def test_error_of_a_mat_file_without_arrays_has_a_remedy(
    tmp_path: Path, content: bytes | None, words: str
) -> None:
    path = tmp_path / "x.mat"
    if content is None:
        savemat(path, {"name": "gripper"})
    else:
        path.write_bytes(content)
    with pytest.raises(DrakeTeleopError, match=words):
        read_table(path)


def test_unnamed_array_of_a_matlab_table_is_ignored(tmp_path: Path) -> None:
    savemat(path := tmp_path / "x.mat", {"t": np.arange(40.0)})
    data = bytearray(path.read_bytes())
    assert data[168:173] == b"\x01\0\x01\0t"
    data[168:176] = b"\x01" + bytes(7)
    path.write_bytes(data)
    with pytest.raises(DrakeTeleopError, match="save tables and timeseries"):
        read_table(path)


def test_types_and_byte_order_of_mat_files_are_respected(tmp_path: Path) -> None:
    numbers = np.arange(-3, 4)
    kinds = ["i1", "i2", "i4", "i8", "f4", "f8"]
    savemat(tmp_path / "x.mat", {kind: numbers.astype(kind) for kind in kinds})
    table = read_table(tmp_path / "x.mat")
    for kind in kinds:
        assert table.single_column(kind, "here").tolist() == numbers.tolist()
    # Big-endian, as written by old workstations.
    tag = partial(struct.pack, ">II")
    content = tag(6, 8) + struct.pack(">II", 6, 0) + tag(5, 8) + struct.pack(">ii", 3, 1)
    content += tag(1, 1) + b"t".ljust(8, b"\0") + tag(9, 24) + struct.pack(">3d", 0.5, 1.0, -2.0)
    head = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x01\x00MI"
    # An object, a string or a table before it, as MATLAB stores them.
    kept = tag(6, 8) + struct.pack(">II", 17, 0)
    for word in (b"s", b"MCOS", b"string"):
        kept += tag(1, len(word)) + word.ljust(8, b"\0")
    kept += tag(14, 0)
    variables = tag(14, len(kept)) + kept + tag(14, len(content)) + content
    (tmp_path / "y.mat").write_bytes(head + variables)
    table = read_table(tmp_path / "y.mat")
    assert list(table.columns) == ["t"]
    assert table.single_column("t", "here").tolist() == [0.5, 1.0, -2.0]


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize(("place", "value"), [(48, 0x77), (17, 0x0E), (53, 0x33), (-60, None)])
def test_damaged_mat_file_raises_error(
    tmp_path: Path, place: int, value: int | None, compressed: bool
) -> None:
    """Unknown type, missing imaginary part, wrong size and truncation.

    SciPy's reader crashes on the first two.
    """
    savemat(path := tmp_path / "x.mat", {"t": np.arange(40.0)})
    head, body = path.read_bytes()[:128], bytearray(path.read_bytes()[128:])
    if value is None:
        del body[place:]
    else:
        body[place] = value
    if compressed:
        packed = zlib.compress(bytes(body))
        body = bytearray(struct.pack("<II", 15, len(packed)) + packed)
    path.write_bytes(head + bytes(body))
    with pytest.raises(
        DrakeTeleopError, match=r"it is damaged or incomplete|the file has no arrays"
    ):
        read_table(path)


def test_a_comma_between_whole_numbers_separates(tmp_path: Path) -> None:
    table = read_table(write(tmp_path / "x.csv", "1,2\n3,4\n"), header=False)
    assert table.finite_numbers(["0", "1"], 2, "here").tolist() == [[1.0, 2.0], [3.0, 4.0]]


def test_row_numbers_in_errors_include_comment_lines(tmp_path: Path) -> None:
    table = read_table(write(tmp_path / "x.csv", "# a\n# b\nt,f\n0,1\n1,oops\n"))
    with pytest.raises(DrakeTeleopError, match="'oops' in row 5"):
        table.numbers_with_nan("f", "here")


@pytest.mark.parametrize(
    "stamps",
    [
        ["2026-03-01T12:00:00.25", "2026-03-01T12:00:00.5"],
        ["2026-03-01 12:00:00.25Z", "2026-03-01 12:00:00.5Z"],
        ["12:00:00.25", "12:00:00.5"],
    ],
)
def test_dates_and_times_of_day_are_seconds(tmp_path: Path, stamps: list[str]) -> None:
    text = "t,f\n" + "".join(f"{stamp},1\n" for stamp in stamps)
    t = read_table(write(tmp_path / "x.csv", text)).single_column("t", "here")
    assert t[1] - t[0] == pytest.approx(0.25, abs=1e-6)
    assert t[0] % 86400 == pytest.approx(43200.25, abs=1e-6)
    pl.DataFrame({"t": stamps}).write_csv(tmp_path / "y.csv")
    pl.read_csv(tmp_path / "y.csv", try_parse_dates=True).write_parquet(tmp_path / "y.parquet")
    assert read_table(tmp_path / "y.parquet").single_column("t", "here").tolist() == t.tolist()


def test_durations_of_matlab_are_seconds(tmp_path: Path) -> None:
    path = write(tmp_path / "x.csv", "t,f\n0.25 sec,1\n1.5 sec,2\n")
    assert read_table(path).single_column("t", "here").tolist() == [0.25, 1.5]


@pytest.mark.parametrize("stamp", ["01.03.2026 23:59:50,5", "2026-03-29_00-59-55"])
def test_error_of_other_dates_states_the_form(tmp_path: Path, stamp: str) -> None:
    path = write(tmp_path / "x.csv", f"t;f\n{stamp};1\n")
    with pytest.raises(DrakeTeleopError, match="write times in seconds, or as 2026-03-01T12:00"):
        read_table(path).single_column("t", "here")


@pytest.mark.parametrize(
    ("values", "step"),
    [
        ([1.25, -3.5], 0.01),
        ([12.0, 700.0], 1.0),
        ([0.1 + 0.2, 1.0 / 3.0], 0.0),
        ([16.448062, 1e-6], 1e-6),
        ([0.0, 0.0], 0.0),
        ([0.0, 0.7, 5.0], 0.1),
    ],
)
def test_decimal_step_is_the_quantization_of_printed_numbers(
    values: list[float], step: float
) -> None:
    assert decimal_resolution(np.array(values)) == pytest.approx(step)


PLAIN = "t,a\n0,1.5\n1,2.5\n"
SPELLINGS = {
    "empty lines at the end": f"{PLAIN}\n\n\n",
    "empty lines at the end, with CR": PLAIN.replace("\n", "\r\n") + "\r\n\r\n",
    "spaces at the end": f"{PLAIN}   \n \t\n",
    "separators at the end": f"{PLAIN},\n,\n",
    "semicolons at the end": "t;a\n0;1.5\n1;2.5\n;\n",
    "70 kB of empty lines": PLAIN + "\n" * 70_000,
    "the end of a file of DOS": f"{PLAIN}\x1a",
    "a file that was not filled": PLAIN + "\0" * 5000,
    "CR alone": PLAIN.replace("\n", "\r"),
    "CR alone, no end": PLAIN.replace("\n", "\r").rstrip(),
    "quoted decimal commas": 't,a\n"0,0","1,5"\n"1,0","2,5"\n',
    "quoted decimal commas, semicolons": 't;a\n"0,0";"1,5"\n"1,0";"2,5"\n',
    "some quoted decimal commas": 't,a\n0,"1,500"\n1,"2,5"\n',
    "small quoted decimal commas": 't,a\n"0,000","1,500"\n"1,000","2,500"\n',
}


@pytest.mark.parametrize("name", SPELLINGS)
def test_spreadsheet_formats_give_the_same_table(tmp_path: Path, name: str) -> None:
    path = tmp_path / "x.csv"
    path.write_bytes(SPELLINGS[name].encode())
    table = read_table(path)
    assert table.finite_numbers(["t", "a"], 2, "here").tolist() == [[0.0, 1.5], [1.0, 2.5]]


@pytest.mark.parametrize("cell", ["1_000", '"1,500"', "1_0.5", "_1", "1__0", "0x10", "\u0663"])
def test_ambiguous_number_raises_error(tmp_path: Path, cell: str) -> None:
    for text in (f"t,a\n0,{cell}\n1,2.5\n", f"t,a\n0,2.5\n1,{cell}\n", f"t,a\n0,{cell}\n"):
        with pytest.raises(DrakeTeleopError):
            read_table(write(tmp_path / "x.csv", text)).finite_numbers(["a"], 1, "here")


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_canonical_columns_in_capitals_are_found(tmp_path: Path, suffix: str) -> None:
    """Optional columns such as the angular acceleration are included."""
    log = sample_motion()
    path = tmp_path / f"x{suffix}"
    write_log(log, path)
    read = pl.read_csv if suffix == ".csv" else pl.read_parquet
    frame = read(path).rename(str.upper)
    (frame.write_csv if suffix == ".csv" else frame.write_parquet)(path)
    again = read_log(path)
    np.testing.assert_allclose(again.angular_acceleration, log.angular_acceleration, atol=1e-9)
    np.testing.assert_allclose(again.wrench, log.wrench, atol=1e-9)


def sample_motion() -> Log:
    t = 0.01 * np.arange(400)
    groups = [np.sin(np.outer(t, 1.0 + np.arange(k, k + n))) for k, n in ((0, 6), (6, 3), (9, 3))]
    return Log(t, *groups, np.cos(np.outer(t, np.arange(1.0, 4.0))))


def test_empty_array_is_ignored(tmp_path: Path) -> None:
    path = tmp_path / "x.npz"
    np.savez(path, t=np.arange(2.0), none=np.zeros(0), nothing=np.zeros((0, 3)))
    table = read_table(path)
    assert list(table.columns) == ["t"]
    with pytest.raises(DrakeTeleopError, match="has no column 'none'"):
        table.numbers_with_nan("none", "here")
    np.savez(path, none=np.zeros(0))
    with pytest.raises(DrakeTeleopError, match="has no rows"):
        read_table(path)


@pytest.mark.parametrize("shape", [(3,), (3, 2)])
def test_complex_array_raises_error(tmp_path: Path, shape: tuple[int, ...]) -> None:
    np.savez(tmp_path / "x.npz", a=np.ones(shape) + 1j)
    with pytest.raises(DrakeTeleopError, match="is not a number"):
        read_table(tmp_path / "x.npz").numbers_with_nan("a", "here")


FORKS = """
import multiprocessing, sys
from pathlib import Path
from drake_teleop.logs.read.table_files import read_table
from drake_teleop.station.result import SimulationResult

def rows(_):
    return read_table(Path(sys.argv[1])).rows

first = rows(0) if sys.argv[2] == "after" else 2
with multiprocessing.get_context("fork").Pool(1) as pool:
    try:
        print(pool.apply(rows, [1]) == first)
    except ValueError as error:
        print(error)
"""


@pytest.mark.slow
def test_reading_in_a_forked_process_raises_error(tmp_path: Path) -> None:
    path = write(tmp_path / "x.csv", PLAIN)
    for when, says in (("before", "True"), ("after", "forked after polars was used")):
        done = subprocess.run(
            [sys.executable, "-c", FORKS, str(path), when],
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert says in done.stdout, done.stderr


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("is_pose_first", [False, True])
@pytest.mark.parametrize("first_pose_row", [0, 1, 3])
def test_rows_that_end_in_empty_cells_keep_the_header(
    tmp_path: Path, separator: str, is_pose_first: bool, first_pose_row: int
) -> None:
    """Two streams share a table; most rows lack the cells of one of them."""
    order = slice(None, None, -1 if is_pose_first else 1)

    def line(first: str, *groups: list[str]) -> list[str]:
        return [first, *(cell for group in groups[order] for cell in group)]

    names = line("t", ["fx", "fy", "fz", "tx", "ty", "tz"], ["qw", "qx", "qy", "qz"])
    lines = [
        line(f"{row * 0.002:.3f}", [""] * 6, ["0.5"] * 4)
        if row % 5 == first_pose_row
        else line(f"{row * 0.002:.3f}", ["1.5"] * 6, [""] * 4)
        for row in range(40)
    ]
    text = "\n".join(separator.join(cells) for cells in [names, *lines])
    table = read_table(write(tmp_path / "x.csv", text))
    assert list(table.columns) == names
    np.testing.assert_allclose(table.single_column("t", ""), 0.002 * np.arange(40))


@pytest.mark.parametrize("rows", [50, 150, 2500])
@pytest.mark.parametrize(("early", "late"), [("0", "0.5"), ("[0, 1]", "[0.5, 1]")])
def test_json_lines_begin_with_integers_or_without_a_field(
    tmp_path: Path, rows: int, early: str, late: str
) -> None:
    lines = [f'{{"t": {k}, "f": {early}}}' for k in range(rows)]
    lines += [f'{{"t": {rows}, "f": {late}, "g": 2}}']
    table = read_table(write(tmp_path / "x.jsonl", "\n".join(lines)))
    assert table.numbers_with_nan("f", "")[-1, 0] == 0.5
    assert np.isnan(table.single_column("g", "")[:-1]).all()
