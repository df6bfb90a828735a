"""Compiled code follows its sources between files, and is shared safely."""

from __future__ import annotations

import os
import pickle
import re
import subprocess
import sys
from importlib import import_module, invalidate_caches
from pathlib import Path
from types import SimpleNamespace

import numba
import numpy as np
import pytest

import drake_teleop
from drake_teleop.common import compiled as _compiled
from drake_teleop.common import vectors

# `inner` reads a constant of another file, a module's function, one that comes after it, and
# one that becomes part of its caller.
FILES = {
    "numbers": "NUMBER = 1.0\nTABLE = np.zeros(2)\nSTEP = slice(0, 2)",
    "far": "from .parts import part\n\n@njit(cache=True)\ndef far(x):\n    return part(x)",
    "parts": "@register_jitable\ndef part(x):\n    return x",
    "inner": """
from .numbers import NUMBER, STEP, TABLE
from . import far

@njit(cache=True)
def inner(x):
    return far.far(x) + NUMBER + TABLE[STEP].sum() + _late(x)

@njit(cache=True)
def _late(x, also=0.0):
    return 0.0 * x + also
""",
    "outer": "from .inner import inner\n\n@njit(cache=True)\ndef outer(x):\n    return inner(x)",
    "other": "@njit(cache=True)\ndef other(x):\n    return 100.0",
}
HEAD = """import numpy as np
from numba.extending import register_jitable
from drake_teleop.common.compiled import njit
"""


def _write(folder: Path, changes: dict[str, tuple[str, str]] | None = None) -> None:
    for name, content in FILES.items():
        old, new = (changes or {}).get(name, ("", ""))
        assert old in content
        (folder / f"{name}.py").write_text(HEAD + content.replace(old, new) + "\n")


def _answers(monkeypatch) -> dict[str, tuple[float, int]]:
    """Return results in a new process, and the number of compilations."""
    for name in [name for name in sys.modules if name.split(".")[0] == "edited_package"]:
        del sys.modules[name]
    invalidate_caches()
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # file times have whole seconds
    found = {}
    for name in ("outer", "other"):
        function = getattr(import_module(f"edited_package.{name}"), name)
        found[name] = (function(0.0), sum(function.stats.cache_misses.values()))
    return found


@pytest.fixture
def package(tmp_path, monkeypatch):
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.syspath_prepend(str(tmp_path))
    folder = tmp_path / "edited_package"
    folder.mkdir()
    (folder / "__init__.py").touch()
    _write(folder)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "old", "new", "expected"),
    [
        ("numbers", "1.0", "2.0", 2.0),
        ("numbers", "zeros", "ones", 3.0),
        ("numbers", "slice(0, 2)", "slice(0, 0)", 1.0),
        ("far", "part(x)", "part(x) + 4.0", 5.0),
        ("parts", "return x", "return x + 6.0", 7.0),
        ("inner", "NUMBER +", "NUMBER -", 1.0),
        ("inner", "also=0.0", "also=7.0", 8.0),
        ("inner", "+ also", "+ also + np.pi", 1.0 + np.pi),
        ("outer", "inner(x)", "inner(x + 1.0)", 2.0),
        ("outer", "cache=True", "cache=True, error_model='numpy'", 1.0),
    ],
)
def test_edit_recompiles_only_dependent_functions(package, monkeypatch, file, old, new, expected):
    _write(package, {"numbers": ("zeros(2)", "array([0.0, 0.0])")})
    assert _answers(monkeypatch) == {"outer": (1.0, 1), "other": (100.0, 1)}
    assert _answers(monkeypatch) == {"outer": (1.0, 0), "other": (100.0, 0)}
    _write(package, {file: (old, new)})
    assert _answers(monkeypatch) == {"outer": (expected, 1), "other": (100.0, 0)}


def test_uncompiled_lines_do_not_affect_the_cache(package, monkeypatch):
    _answers(monkeypatch)
    comment = ("@njit", "# A comment, and a function of Python.\ndef f():\n    pass\n\n@njit")
    _write(package, {name: comment for name in ("far", "inner", "outer", "other")})
    assert _answers(monkeypatch) == {"outer": (1.0, 0), "other": (100.0, 0)}


@pytest.mark.parametrize("chosen", [False, True])
def test_code_of_old_sources_is_removed(package, monkeypatch, chosen):
    folder = package / "__pycache__"
    if chosen:
        folder = package.parent / "chosen"
        monkeypatch.setattr(numba.config, "CACHE_DIR", str(folder))  # or NUMBA_CACHE_DIR

    def files():
        return {path.name for path in folder.rglob("outer.outer.*.nbc")}

    _answers(monkeypatch)
    before = files()
    _write(package, {"numbers": ("1.0", "2.0")})
    _answers(monkeypatch)
    assert len(before) == len(files()) == 1
    assert files().isdisjoint(before)


def test_code_of_another_signature_is_not_loaded(package, monkeypatch):
    _answers(monkeypatch)
    (found,) = package.parent.rglob("other.other.*.nbc")
    function = import_module("edited_package.other").other
    function(1)  # an integer: a second file
    (second,) = set(package.parent.rglob("other.other.*.nbc")) - {found}
    second.write_bytes(found.read_bytes())
    del sys.modules["edited_package.other"]
    function = import_module("edited_package.other").other
    assert function(1) == 100.0
    assert sum(function.stats.cache_misses.values()) == 1


def test_untraceable_references_raise(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "reads_a_list.py").write_text(
        HEAD + "LIST = [1]\n\n@njit(cache=True)\ndef f():\n    return LIST[0]\n"
    )
    with pytest.raises(TypeError, match=r"uses \[1\], whose changes"):
        import_module("reads_a_list").f()


_call = _compiled.make_call_at_address((numba.float64[::1],))
_call_other = _compiled.make_call_at_address((numba.float64[::1], numba.float64))


@_compiled.njit()
def _doubles(x):
    x[0] *= 2.0


@_compiled.njit()
def _refuses(x):
    raise ValueError("x")


@_compiled.njit()
def _calls(address, x):
    _call(address, x)
    x[0] += 1.0


def test_call_at_calls_functions_and_propagates_exceptions():
    doubles, refuses = (
        _compiled.address_of_function(function, (numba.float64[::1],))
        for function in (_doubles, _refuses)
    )
    x = np.array([3.0])
    _calls(doubles, x)
    assert x[0] == 7.0
    with pytest.raises(ValueError, match=r"^x$"):
        _calls(refuses, x)
    assert x[0] == 7.0
    assert len(_calls.signatures) == 1, "the caller was compiled for each of them"


def test_other_argument_types_recompile_the_caller():
    assert _compiled._text_for_fingerprint(_call) != _compiled._text_for_fingerprint(_call_other)


def test_borrowing_function_fills_arrays_and_its_callee_allocates():
    @_compiled.njit()
    def makes(x, out):
        new = np.full(out.shape[0], 2.0)
        for k in range(out.shape[0]):
            out[k] = new[k] * x[k]

    @_compiled.njit(omits_reference_counting=True)
    def omits_reference_counting(pair, out):
        for row in range(len(out)):
            makes(pair[0][1:], out[row])

    x, out = np.arange(4.0), np.zeros((2, 3))
    before = sys.getrefcount(x), sys.getrefcount(out)
    for _ in range(3):
        omits_reference_counting((x, x), out)
    assert out.tolist() == [[2.0, 4.0, 6.0]] * 2
    assert (sys.getrefcount(x), sys.getrefcount(out)) == before


def test_borrowing_function_cannot_allocate():
    @_compiled.njit(omits_reference_counting=True)
    def makes(x):
        x[:] = np.zeros(x.shape[0])

    with pytest.raises(numba.NumbaError, match="No implementation of function"):
        makes(np.ones(3))


def test_package_uses_only_this_njit():
    own = re.compile(r"^from drake_teleop\.common\.compiled import .*\bnjit$", re.MULTILINE)
    for path in Path(drake_teleop.__file__).parent.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        if path.name != "compiled.py" and "@njit" in text:
            assert own.search(text), path


# Two processes: each reads before the other has written, and `first` begins to write before
# `second` and ends after it.
SIDE_BY_SIDE = """
import os, sys, time
from pathlib import Path

me, argument = sys.argv[1], eval(sys.argv[2])
replace, calls = os.replace, 0

def wait_for(mark):
    end = time.monotonic() + 60.0
    while not Path(mark).exists():
        assert time.monotonic() < end
        time.sleep(0.001)

def in_turns(source, target, **options):
    global calls
    if not str(target).endswith((".nbc", ".nbi")):
        return replace(source, target, **options)
    calls += 1
    Path(f"{me} has compiled").touch()
    if calls == 1:
        wait_for("second has compiled" if me == "first" else "first has written")
    elif me == "first":
        wait_for("second has ended")
    replace(source, target, **options)
    Path(f"{me} has written").touch()

os.replace = in_turns
os.rename = in_turns
from shared import double

print(double(argument))
Path(f"{me} has ended").touch()
"""


@pytest.mark.slow
def test_two_parallel_first_runs_store_the_right_code(tmp_path):
    """The result of `double(1.5)` stays 2 after such runs with numba's own cache."""
    (tmp_path / "shared.py").write_text(
        HEAD + "\n@njit(cache=True)\ndef double(x):\n    return x + x\n"
    )
    (tmp_path / "side_by_side.py").write_text(SIDE_BY_SIDE)

    environment = {key: os.environ[key] for key in os.environ if key != "NUMBA_CACHE_DIR"}
    environment["PYTHONPATH"] = str(Path(drake_teleop.__file__).parents[1])

    def start(*arguments: str) -> subprocess.Popen:
        program = [sys.executable, *arguments]
        pipe = subprocess.PIPE
        return subprocess.Popen(program, cwd=tmp_path, env=environment, stdout=pipe, text=True)

    both = [
        start("side_by_side.py", name, argument)
        for name, argument in (("first", "3"), ("second", "1.5"))
    ]
    assert [process.communicate()[0] for process in both] == ["6\n", "3.0\n"]
    later = start(
        "-c",
        "from shared import double\n"
        "print(double(3), double(1.5), sum(double.stats.cache_misses.values()))",
    )
    assert later.communicate()[0] == "6 3.0 0\n"


def test_no_cache_without_a_writable_folder(monkeypatch):
    def nowhere(*_):
        raise RuntimeError("cannot cache function: no locator available")

    monkeypatch.setattr(_compiled.FunctionCache, "__init__", nowhere)
    assert _compiled.njit(cache=True)(vectors.cross)._cache.cache_path is None


def test_full_disk_raises_no_error(tmp_path):
    files = _compiled._CacheFiles(tmp_path / "absent", _compiled.njit()(vectors.cross))
    files.save("key", "code")
    assert files.load("key") is None


@_compiled.njit()
def _kept(x):
    return x


def test_untrusted_cache_file_is_not_loaded(tmp_path):
    """Loading a pickle executes code."""
    files, planted = _compiled._CacheFiles(tmp_path, _kept), tmp_path / "planted"
    files.save("key", 3)
    (path,) = tmp_path.glob("*.nbc")
    assert files.load("key") == 3
    path.write_bytes(pickle.dumps(Planted(planted)))
    path.chmod(0o666)
    assert files.load("key") is None and not planted.exists()
    owner = Path(_compiled.__file__).stat().st_uid
    for uid, ours in ((os.getuid(), True), (0, True), (owner, True), (owner + 12345, False)):
        assert _compiled._is_trusted_file(SimpleNamespace(st_uid=uid, st_mode=0o100664)) == ours


def test_cache_file_is_not_writable_by_others(tmp_path):
    earlier = os.umask(0)
    try:
        _compiled._CacheFiles(tmp_path, _kept).save("key", 3)
    finally:
        os.umask(earlier)
    assert [path.stat().st_mode & 0o777 for path in tmp_path.iterdir()] == [0o644]


class Planted:
    """Pickle that creates a folder when it is loaded."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __reduce__(self):
        return os.mkdir, (str(self._path),)
