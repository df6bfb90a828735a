"""The command line: light imports, passing of options, one-line errors."""

from __future__ import annotations

import io
import re
import subprocess
import sys
import types
import warnings
from pathlib import Path

import click
import numpy as np
import pytest
from numba.core.errors import NumbaWarning

from drake_teleop.cli import main as cli
from drake_teleop.common.errors import MAX_ERROR_LINE_LENGTH, DrakeTeleopError

HEAVY = {"numpy", "scipy", "numba", "polars", "matplotlib", "pydrake", "jinja2", "pydantic", "yaml"}


def run_main(capsys, *arguments: str) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as stop:
        cli.main(list(arguments))
    captured = capsys.readouterr()
    return stop.value.code, captured.out, captured.err


@pytest.fixture
def install(monkeypatch):
    """Replace a command's module by one function."""

    def put(module: str, name: str, function) -> None:
        fake = types.ModuleType(module)
        setattr(fake, name, function)
        monkeypatch.setitem(sys.modules, module, fake)

    return put


@pytest.mark.parametrize("arguments", [["--help"], ["identify", "--help"], ["--version"]])
def test_help_imports_nothing_heavy(arguments):
    code = (
        "import sys\n"
        "from drake_teleop.cli.main import main\n"
        f"try: main({arguments!r})\n"
        "except SystemExit as stop: status = stop.code\n"
        "print('modules', status, *sorted({name.split('.')[0] for name in sys.modules}))\n"
    )
    answer = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    word, status, *modules = answer.stdout.splitlines()[-1].split()
    assert (word, status) == ("modules", "0")
    assert "click" in modules
    assert not HEAVY & set(modules)


@pytest.mark.parametrize(
    ("words", "expected"),
    [("run con", "contact_transition"), ("scenario id", "ideal_sensor"), ("analyze pr", "press"),
     ("excite fre", "free_motion_torque"), ("study scaling_p", "scaling_press"),
     ("run --fr", "--fresh")],
)  # fmt: skip
def test_the_shell_completes_names_and_options(capsys, monkeypatch, words, expected):
    monkeypatch.setenv("_DRAKE_TELEOP_COMPLETE", "bash_complete")
    monkeypatch.setenv("COMP_WORDS", f"drake-teleop {words}")
    monkeypatch.setenv("COMP_CWORD", "2")
    _, out, _ = run_main(capsys)
    assert f"plain,{expected}" in out.splitlines()
    if not words.split()[1].startswith("-"):
        assert f"file,{words.split()[1]}" in out.splitlines()


def test_each_option_of_each_command_has_a_help_text():
    for command in cli.cli.commands.values():
        options = [each for each in command.params if isinstance(each, click.Option)]
        assert [each.opts for each in options if not each.help] == []


def test_help_needs_no_docstrings():
    code = "from drake_teleop.cli.main import main; main(['run', '--help'])"
    command = [sys.executable, "-OO", "-B", "-c", code]
    assert "--inputs DIR" in subprocess.run(command, capture_output=True, text=True).stdout


def test_no_command_shows_the_help(capsys):
    status, _, _ = run_main(capsys)
    assert status == 2
    status, out, _ = run_main(capsys, "--help")
    assert status == 0
    for command in (
        "reproduce", "run", "identify", "eliminate", "inspect", "detect", "compare-passivity",
        "study", "scaling-study", "excite", "replay", "sample-log", "scenario", "export", "new",
        "compensate", "calibrate", "dataset", "tune", "ros2",
    ):  # fmt: skip
        assert f"  {command} " in out
    assert "..." not in out.split("Commands:")[1]  # every summary fits its line


@pytest.mark.parametrize(
    "arguments",
    [
        ["idntify", "log.csv"],
        ["identify", "log\udcff.csv"],
        ["identify", "log.csv", "--out", "out\udcff"],
        ["run", "mine\udcff.yaml"],
        ["identify"],
        ["identify", "log.csv", "--delay", "soon"],
        ["identify", "log.csv", "--delay", "nan"],
        ["identify", "log.csv", "--cutoff", "0"],
        ["eliminate", "log.csv"],
        ["eliminate", "log.csv", "--load", "x.json", "--sigma", "-1"],
        ["eliminate", "log.csv", "--load", "x.json", "--gamma", "inf"],
        ["eliminate", "log.csv", "--load", "x.json", "--eta", "1.5"],
        ["run"],
        ["run", "free_motion_force", "--seed", "-1"],
        ["reproduce", "--frobnicate"],
        ["excite", "--criterion", "kappa11"],
        ["excite", "--harmonics", "1"],
        ["excite", "--period", "0"],
        ["excite", "--model", "a.urdf", "--sensor-frame", "s", "--acceleration", "1,-2"],
    ],
)
def test_wrong_usage_is_one_error_line_and_status_2(capsys, arguments):
    status, out, err = run_main(capsys, *arguments)
    assert status == 2
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("option", "number", "says"),
    [
        ("--harmonics", "1", "1 is outside 2 to 20"),
        ("--harmonics", "21", "21 is outside 2 to 20"),
        ("--period", "1000", "1000 is outside 0.5 to 600"),
        ("--time", "0", "0 is not above 0"),
        ("--seed", "-3", "-3 is outside 0 to 4294967295"),
        ("--seed", "9" * 400, f"{'9' * 18}...{'9' * 19} is outside 0 to 4294967295"),
        ("--payload", "1e300", "1e+300 is outside 0 to 10000"),
        ("--acceleration", "1e300", "1e+300 is outside 0 to 100000"),
    ],
)
def test_number_out_of_range_is_reported_in_words(capsys, option, number, says):
    assert run_main(capsys, "excite", option, number)[2].endswith(f"'{option}': {says}\n")


@pytest.mark.parametrize(
    ("option", "number", "says"),
    [
        ("--delay", "1e300", "1e+300 is outside -10 to 10"),
        ("--sigma", "1e308", "1e+308 is outside 0 to 100"),
        ("--sigma-object", "101", "101 is outside 0 to 100"),
        ("--gamma", "-1e308", "-1e+308 is outside 0 to 100"),
        ("--cutoff", "1e300", "1e+300 is outside 0 to 100000"),
        ("--cutoff", "-1", "-1 is outside 0 to 100000"),
        ("--causal-tare", "1e9", "1e+09 is outside 0 to 36000"),
    ],
)
def test_options_refuse_impossible_numbers(capsys, option, number, says):
    err = run_main(capsys, "eliminate", "log.csv", "--load", "x.json", option, number)[2]
    assert err.endswith(f"'{option}': {says}\n")


@pytest.mark.parametrize(
    ("walls", "says"),
    [("0.5,0", "0 is not above 0"), ("nan", "nan is not a finite number"), ("soft", "'soft' is")],
)
def test_invalid_wall_of_tune_names_the_option(capsys, walls, says):
    assert f"'--walls': {says}" in run_main(capsys, "tune", "press", "--walls", walls)[2]


@pytest.mark.parametrize("option", ["--results", "--participant", "--simulated"])
def test_option_of_an_experiment_requires_one(capsys, option):
    assert run_main(capsys, "drive", "press", option, "3")[::2] == (
        2,
        f"error: {option}: has no effect here; add --study or remove it\n",
    )


@pytest.mark.parametrize(
    "words",
    [
        ("drive", "--study", "x.yaml", "--record", "x"),
        ("drive", "--study", "x.yaml", "--simulated", "1", "--participant", "2"),
        ("drive", "--study", "x.yaml", "--simulated", "1", "--no-browser"),
        ("excite", "--until", "mass 1 %", "--period", "5"),
    ],
)
def test_option_without_effect_in_this_mode_is_refused(capsys, words):
    option = next(word for word in reversed(words) if word.startswith("--"))
    status, _, err = run_main(capsys, *words)
    assert status == 2
    assert re.match(f"error: {option}: has no effect here; remove (it|{option})", err)


@pytest.mark.parametrize(
    "option", [("--out", "x"), ("--rate", "3"), ("--cutoff", "30"), ("--range", "3", "4")]
)
def test_printed_export_refuses_options_of_a_controller(capsys, option):
    status, _, err = run_main(capsys, "export", "load.json", "--to", "ur", *option)
    assert status == 2
    assert err.startswith(f"error: {option[0]}: has no effect here; remove it, as ur is printed")


@pytest.mark.parametrize("command", ["inspect", "run"])
def test_a_command_that_fails_leaves_no_empty_folder(capsys, tmp_path, command):
    there, out = tmp_path / "there", tmp_path / "new" / "inner"
    there.mkdir()
    for folder in (there, out):
        status, _, err = run_main(capsys, command, str(tmp_path / "x.csv"), "--out", str(folder))
        assert status == 2 and err.count("\n") == 1
    assert there.is_dir() and not (tmp_path / "new").exists()


def test_output_of_a_command_is_kept(capsys, tmp_path):
    log = tmp_path / "x.csv"
    log.write_text("a,b\n1,2\n")
    assert run_main(capsys, "inspect", str(log), "--quiet", "--out", str(tmp_path / "new"))[0] == 0
    assert (tmp_path / "new" / "summary.json").is_file()


def test_error_line_has_a_maximum_length(capsys):
    err = run_main(capsys, "run", "\x1b[31m" + "x" * 1000)[2]
    assert len(err) <= MAX_ERROR_LINE_LENGTH + len("\n") and err.isascii() and "\x1b" not in err


def test_python_warnings_are_not_printed(capsys, monkeypatch, recwarn):
    def names():
        np.float64(1e308) * np.float64(10.0)
        warnings.warn("slow", NumbaWarning, stacklevel=1)
        return []

    monkeypatch.setattr("drake_teleop.station.scenario.ScenarioNames", names)
    assert run_main(capsys, "scenario") == (0, "", "")
    assert not recwarn


@pytest.mark.parametrize(
    ("exception", "status", "message"),
    [
        (DrakeTeleopError("no such\nfield", where="a.yaml:x"), 2, "error: a.yaml:x: no such field"),
        (PermissionError(13, "Permission denied", "out/x"), 2, "error: out/x: Permission denied"),
        (OSError("disk on fire"), 2, "error: disk on fire"),
    ],
)
def test_invalid_input_is_one_error_line(capsys, install, exception, status, message):
    def fail(*arguments, **options):
        raise exception

    install("drake_teleop.lab.run", "run_command", fail)
    assert run_main(capsys, "run", "x") == (status, "", message + "\n")


def test_ctrl_c_is_status_130_and_no_traceback(capsys, install):
    def interrupt(*arguments, **options):
        raise KeyboardInterrupt

    install("drake_teleop.lab.run", "run_command", interrupt)
    status, out, err = run_main(capsys, "run", "x")
    assert (status, out, err.split()) == (130, "", ["interrupted"])


def test_programming_errors_keep_their_traceback(install):
    def mistake(*arguments, **options):
        raise TypeError("a bug")

    install("drake_teleop.lab.run", "run_command", mistake)
    with pytest.raises(TypeError, match="a bug"):
        cli.main(["run", "x"])


@pytest.mark.parametrize(("lines", "status"), [([], 0), (["Mass: beyond our bound"], 1)])
def test_unaccepted_number_has_status_1(capsys, install, lines, status):
    install(
        "drake_teleop.lab.reproduction.reproduce", "reproduce_command", lambda *_, **__: "figures"
    )
    install(
        "drake_teleop.lab.reproduction.report",
        "describe_values_outside_ranges",
        {"figures": lines}.get,
    )
    assert run_main(capsys, "reproduce") == (status, "", "".join(f"{x}\n" for x in lines))


@pytest.mark.parametrize(
    ("terminal", "typed", "status"),
    [(False, "y", 2), (True, "n", 2), (True, "", 2), (True, "y", 0)],
)
def test_many_runs_require_a_confirmation_at_a_terminal(
    tmp_path, capsys, monkeypatch, install, terminal, typed, status
):
    def study_command(path, out, *, yes, **options):
        if yes is not True and not yes("100,200 runs. Begin?"):
            raise DrakeTeleopError("100,200 runs are many")

    install("drake_teleop.lab.studies.study", "study_command", study_command)
    typing = io.StringIO(f"{typed}\n")
    typing.isatty = lambda: terminal
    monkeypatch.setattr("sys.stdin", typing)
    code, _, err = run_main(capsys, "study", "x.yaml")
    assert code == status
    assert ("Begin? [y/N]" in err) == terminal
    assert run_main(capsys, "study", "x.yaml", "--yes")[::2] == (0, "")


def test_options_reach_the_commands(capsys, install):
    calls = []

    def note(*arguments, **options):
        calls.append((arguments, options))

    install("drake_teleop.lab.run", "run_command", note)
    install("drake_teleop.lab.reproduction.reproduce", "reproduce_command", note)
    install(
        "drake_teleop.lab.reproduction.report", "describe_values_outside_ranges", lambda summary: []
    )
    install("drake_teleop.cli.logs", "identify_command", note)
    status, out, err = run_main(
        capsys, "run", "contact_transition", "--seed", "7", "--fresh", "--quiet"
    )
    assert (status, out, err) == (0, "", "")
    run_main(capsys, "reproduce", "--out", "out/r")
    run_main(capsys, "identify", "a.yaml", "--delay", "0.006")
    assert calls == [
        (
            ("contact_transition", Path("out/run")),
            {"drive": None, "seed": 7, "fresh": True, "quiet": True},
        ),
        ((Path("out/r"),), {"seed": None, "quiet": False}),
        (
            (Path("a.yaml"), Path("out/identify")),
            {
                "gripper": None,
                "method": "consistent",
                "cutoff_hz": 30.0,
                "delay": 0.006,
                "quiet": False,
            },
        ),
    ]


def test_eliminate_passes_the_scaling_law_on(capsys, install):
    calls = []
    install(
        "drake_teleop.cli.logs",
        "eliminate_command",
        lambda *arguments, **options: calls.append((arguments, options)),
    )
    run_main(
        capsys, "eliminate", "a.csv", "--load", "i.json", "--sigma", "0.5", "--gamma", "2",
        "--eta", "0.25", "--cutoff", "20",
    )  # fmt: skip
    assert calls == [
        (
            (Path("a.csv"), Path("i.json"), Path("out/eliminate")),
            {
                "gripper": None, "sigma": 0.5, "sigma_object": None, "gamma": 2.0, "eta": 0.25,
                "sigma_weight": None, "sigma_inertia": None, "offsets": "record",
                "untouched_s": None, "causal": None, "causal_tare_s": None, "free": None,
                "cutoff_hz": 20.0,
                "delay": "auto", "quiet": False,
            },
        )
    ]  # fmt: skip
