"""`export --to c99`: the C code has the bits of the compiled Python functions."""

from __future__ import annotations

import ctypes
import dataclasses
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from c_translator import C_HELPER_FUNCTIONS, TEMPLATE, Translator, with_translation
from shown import type_in

from drake_teleop.cli.main import main
from drake_teleop.common.compiled import njit
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.robots.compensation_step import TARE_EXCEEDS_DRIFT, TARE_WRENCH_VARIES
from drake_teleop.robots.controller.export import CFLAGS, kernel_files
from drake_teleop.robots.streams import Reading, ReadingFlag

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
import kernel

CC = shutil.which("cc") or ""
needs_cc = pytest.mark.skipif(not CC, reason="there is no C compiler here")
STRICT = [*CFLAGS, "-Wall", "-Wextra", "-pedantic", "-Werror"]


def status(arguments: list[str]) -> int:
    with pytest.raises(SystemExit) as end:
        main(arguments)
    return end.value.code


@pytest.fixture
def exported(tmp_path, monkeypatch) -> Path:
    """Return the folder that the command of docs/controller.md writes."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "out" / "load").mkdir(parents=True)
    kernel.LOAD.save(tmp_path / "out" / "load" / "identification.json")
    type_in("docs/controller.md", "drake-teleop export")
    return tmp_path / "out" / "c99"


def run_test(folder: Path) -> subprocess.CompletedProcess[str]:
    sources = map(str, folder.glob("*.c"))
    subprocess.run([CC, *STRICT, *sources, "-o", str(folder / "test")], check=True)
    return subprocess.run([folder / "test"], capture_output=True, text=True)


@pytest.mark.slow
@needs_cc
def test_shipped_test_passes_and_finds_a_changed_sign(exported):
    assert run_test(exported).returncode == 0
    source = exported / "wrench_compensator.c"
    text = source.read_text()
    assert "- (y * low_pass[4])" in text
    source.write_text(text.replace("- (y * low_pass[4])", "+ (y * low_pass[4])"))
    found = run_test(exported)
    assert found.returncode == 1 and "of 1000 readings differ" in found.stdout


@needs_cc
def test_the_vector_contains_each_flag(exported):
    text = (exported / "test_vector.h").read_text()
    flags = text[text.index("test_flags") :].partition("{")[2].partition("}")[0].split(", ")
    assert len(flags) == 1000
    expected = {
        0,
        ReadingFlag.SATURATED,
        ReadingFlag.NOT_FINITE,
        ReadingFlag.OUT_OF_RANGE,
        ReadingFlag.CLIPPED,
    }
    assert set(map(int, flags)) == expected
    header = (exported / "wrench_compensator.h").read_text()
    for flag in expected - {0}:
        assert f"WRENCH_COMPENSATOR_{flag.name} = {int(flag)}" in header


@needs_cc
@pytest.mark.slow
def test_output_has_the_bits_of_compensate_within_the_size_limit(tmp_path):
    rows = kernel.readings(20_000, seed=3)
    kernel.prepared(tmp_path, rows)
    found, _, size = kernel.replayed(tmp_path, [CC, *CFLAGS, "-Os"], [])
    assert found.tobytes() == kernel.compensated(rows).tobytes()
    assert {0, 1, 4, 8, 1024} <= set(found[:, 12].astype(int))
    assert size <= 4096
    undefined = ["nm", "-u", str(tmp_path / "wrench_compensator.o")]
    assert not subprocess.run(undefined, check=True, capture_output=True).stdout


def test_shipped_code_is_the_translation_of_the_python_functions():
    text = TEMPLATE.read_text()
    assert text == with_translation(text), "run: python tests/robots/c_translator.py"


TARE = """
#include <stdio.h>
#include "load.h"

int main(void) {
  static wrench_compensator c;
  double x[15], out[12];
  int k;
  wrench_compensator_init(&c, &wrench_compensator_load);
  wrench_compensator_tare(&c);
  while (scanf("%lf", x) == 1) {
    for (k = 1; k < 15; ++k) if (scanf("%lf", x + k) != 1) return 2;
    wrench_compensator_step(&c, x, x + 6, x + 9, x + 12, 0, out, out + 6);
  }
  printf("%d", c.tare_state);
  for (k = 0; k < 6; ++k) printf(" %.17g", c.settings.offsets[k]);
  return 0;
}
"""


@needs_cc
@pytest.mark.parametrize(
    ("noise", "shift", "reading", "state"),
    [
        (0.01, 0.5, 0, 0),
        (0.01, 0.5, 7, 4),
        (0.01, 6.0, 0, TARE_EXCEEDS_DRIFT),
        (1.0, 0.5, 0, TARE_WRENCH_VARIES),
    ],
    ids=["done", "runs after an invalid reading", "too far", "varies"],
)
def test_tare_equals_that_of_python(tmp_path, noise, shift, reading, state):
    loop = kernel.TARGET.make_compensator()
    count = int(loop.c_settings["tare_steps"])
    rows = np.zeros((count, 15))
    rows[:, 8] = 9.81
    rows[:, :6] = non_contact_wrench(*rows[0].reshape(5, 3)[2:], kernel.PHI) + kernel.OFFSETS
    rows[:, 0] += shift + noise * np.random.default_rng(1).normal(size=count)
    if reading:
        rows[reading, 4] = np.nan
    for k, row in enumerate(rows):
        loop.step(Reading(k, kernel.DT * k, row), kernel.DT * k)
    said = loop.tare()
    assert said.startswith("done") == (state == 0)
    for name, text in {**kernel_files(kernel.TARGET), "main.c": TARE}.items():
        (tmp_path / name).write_text(str(text))
    sources = [str(tmp_path / name) for name in ("main.c", "wrench_compensator.c")]
    subprocess.run([CC, *STRICT, *sources, "-o", str(tmp_path / "tare")], check=True)
    given = "\n".join(" ".join(map(repr, map(float, row))) for row in rows)
    found = subprocess.run([tmp_path / "tare"], input=given, capture_output=True, text=True)
    number, *offsets = found.stdout.split()
    assert int(number) == state
    assert list(map(float, offsets)) == loop.offsets.tolist()


@njit(cache=False)
def every_operation(x, n, y):
    a, b = x[:2], x[2:]
    for i in range(1, n):
        if i % 2 == 0 and not x[0] > 1.0:
            y[i] -= -a[i % 2] / b[0]
        else:
            y[i] = abs(b[1]) * (2.0 - 0.5)
    first, second = y[1], y[2]
    first, second = second, first
    pair = (first, second)
    first = 0.0
    y[1], y[2] = pair
    y[:1] = 3.0 + first
    return len(y) + n


@njit(cache=False)
def with_while(n):
    while n < 3:
        n += 1
    return n


@njit(cache=False)
def with_integer_division(n):
    return n / 2


@needs_cc
def test_each_supported_operation_has_the_result_of_python(tmp_path):
    c = Translator()
    c.translate_function(every_operation, x=(4,), n="int", y=("size",))
    text = c.text.replace("static int every", "int every")
    (tmp_path / "every.c").write_text(C_HELPER_FUNCTIONS.replace("static", "static inline") + text)
    library = tmp_path / "every.so"
    subprocess.run([CC, "-shared", "-fPIC", str(tmp_path / "every.c"), "-o", library], check=True)
    compiled = ctypes.CDLL(str(library)).every_operation
    for first in (0.5, 1.5):
        x, by_c, by_python = np.array([first, 0.3, 7.0, -2.0]), np.ones(5), np.ones(5)
        pointers = (array.ctypes.data_as(ctypes.c_void_p) for array in (x, by_c))
        start, end = pointers
        assert compiled(start, 5, end, 5) == every_operation(x, 5, by_python) == 10
        assert by_c.tolist() == by_python.tolist()


@njit(cache=False)
def with_new_parameter(n):
    n = 2
    return n


@pytest.mark.parametrize("function", [with_while, with_integer_division, with_new_parameter])
def test_unsupported_syntax_is_named(function):
    with pytest.raises(ValueError, match=rf"^{function.__name__}: .*cannot be translated"):
        Translator().translate_function(function, n="int")


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ((), "--rate: is missing, but required by c99"),
        (("--rate", "500", "--sensor-pose", *"000000"), "takes its values in the sensor's frame"),
    ],
)
def test_unusable_options_are_one_line(tmp_path, capsys, more, said):
    kernel.LOAD.save(tmp_path / "load.json")
    arguments = ["export", str(tmp_path / "load.json"), "--to", "c99", "--out", str(tmp_path / "o")]
    assert status([*arguments, *more]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize("to", ["c99", "fmu"])
@pytest.mark.parametrize("sign", ["-1", "1"])
def test_sign_without_effect_is_refused(tmp_path, capsys, to, sign):
    kernel.LOAD.save(tmp_path / "load.json")
    arguments = ["export", str(tmp_path / "load.json"), "--to", to, "--out", str(tmp_path / "o")]
    assert status([*arguments, "--rate", "500", "--sign", sign]) == 2
    assert "--sign: has no effect here; remove it, and give the code" in capsys.readouterr().err


def test_a_wrench_without_weight_is_refused(tmp_path, capsys):
    dataclasses.replace(kernel.LOAD, weight_removed=True).save(tmp_path / "load.json")
    assert status(["export", str(tmp_path / "load.json"), "--to", "c99", "--rate", "500"]) == 2
    assert "has removed the load's weight" in capsys.readouterr().err
