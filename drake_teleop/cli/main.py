"""The command line (long: all commands and their options). It imports heavy things when needed."""

from __future__ import annotations

import atexit
import gc
import os
import signal
import sys
import warnings
from pathlib import Path
from typing import Any

import click

from drake_teleop.cli import options as option
from drake_teleop.common.errors import DrakeTeleopError, one_line
from drake_teleop.common.version import __version__


@click.group(context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100})
@click.version_option(__version__, prog_name="drake-teleop")
def cli() -> None:
    """Bilateral teleoperation with non-contact force scaling: simulate it, and use it on logs.

    Every command with --out writes its figures by name into DIR/summary.json. A command whose input
    cannot be used exits with status 2 and one error line.

    The Tab key completes commands, options, names and files in bash (zsh, fish: likewise) after
    eval "$(_DRAKE_TELEOP_COMPLETE=bash_source drake-teleop)"
    """


@cli.command()
@option.out("reproduce")
@option.seed
@option.quiet
def reproduce(out: Path, seed: int | None, quiet: bool) -> int:
    """Repeat the paper's experiments.

    Writes the paper's figures and numbers next to ours, a replay and report.html. The exit status
    is 1 if a number is not as accepted.
    """
    from drake_teleop.lab.reproduction.report import unaccepted
    from drake_teleop.lab.reproduction.reproduce import reproduce_command

    lines = unaccepted(reproduce_command(out, seed=seed, quiet=quiet))
    for line in lines:
        click.echo(line, err=True)
    return 1 if lines else 0


@cli.command()
@click.argument("scenario", type=option.SCENARIO, required=False)
@click.option(
    "--inputs", type=option.PATH, metavar="DIR", help="Repeat a recorded drive, to the same bytes."
)
@option.out("run")
@option.seed
@click.option("--fresh", is_flag=True, help="Identify the load anew, also if it is in the cache.")
@option.quiet
def run(
    scenario: str | None,
    inputs: Path | None,
    out: Path,
    seed: int | None,
    fresh: bool,
    quiet: bool,
) -> None:
    """Simulate one scenario, or repeat a drive.

    SCENARIO is the name of a shipped one or a YAML file. Writes its log, its pictures and its film
    in 3D. The load that it identifies first is kept in the user's cache folder, or in
    $DRAKE_TELEOP_CACHE_DIR.
    """
    from drake_teleop.lab.run import run_command

    if (scenario is None) == (inputs is None):
        raise click.UsageError("give a SCENARIO, or --inputs with the folder of a drive")
    drive = None
    if inputs is not None:
        from drake_teleop.live.session import read_drive

        drive = read_drive(inputs)
    run_command(scenario, out, drive=drive, seed=seed, fresh=fresh, quiet=quiet)


@cli.command()
@click.argument("scenario", type=option.SCENARIO, default="contact_transition")
@click.option("--record", type=option.PATH, metavar="DIR", help="Record the drive in this folder.")
@click.option(
    "--port",
    type=option.Whole(0, 65535),
    default=0,
    show_default="any that is free",
    help="Of 127.0.0.1, for the page.",
)
@click.option("--no-browser", is_flag=True, help="Print the page's address, and open no browser.")
@click.option(
    "--device",
    metavar="ADDRESS",
    help="A haptic device is the hand: udp://127.0.0.1:PORT or haply://localhost:10001.",
)
@click.option(
    "--study", metavar="FILE", help="A blind experiment with people, in place of SCENARIO."
)
@click.option(
    "--results",
    type=option.PATH,
    default=Path("out/experiment"),
    show_default=True,
    metavar="DIR",
    help="Of --study: the same folder goes on where it stopped.",
)
@click.option(
    "--participant",
    type=option.Whole(1, 9999),
    show_default="who is not done, or the next",
    help="Of --study: whose turn it is.",
)
@click.option(
    "--simulated",
    type=option.Whole(0, 9999),
    default=0,
    help="Of --study: so many simulated participants, without a page.",
)
def drive(
    scenario: str,
    record: Path | None,
    port: int,
    no_browser: bool,
    device: str | None,
    study: str | None,
    results: Path,
    participant: int | None,
    simulated: int,
) -> None:
    """Drive a station live in the browser.

    SCENARIO is the name of a shipped one or a YAML file; its operator gives the grip alone. One
    page, on this machine: the hand by mouse, keys, touch or gamepad, which vibrates in contact;
    forces, sigma, gamma and eta while you press. `run --inputs DIR` repeats what was recorded.
    With --study, a shipped experiment or a YAML file, the page asks participants what they feel.
    """
    if study is not None:
        from drake_teleop.cli.experiment import experiment_command

        experiment_command(
            study,
            results,
            participant=participant,
            simulated=simulated,
            port=port,
            browser=not no_browser,
            device=device,
        )
        return
    from drake_teleop.live.server import drive_command

    drive_command(scenario, record=record, port=port, browser=not no_browser, device=device)


@cli.command("scenario")
@click.argument("name", type=option.SCENARIO, required=False)
def print_scenario(name: str | None) -> None:
    """Print a scenario with every field, to start from.

    NAME is a shipped one or a YAML file; without it, the shipped ones are listed. Each field comes
    with its range and its meaning: drake-teleop scenario press > mine.yaml
    """
    from drake_teleop.station.scenario import LoadScenario, ScenarioNames
    from drake_teleop.station.scenario_reference import commented

    if name is not None:
        click.echo(commented(LoadScenario(name)), nl=False)
        return
    for shipped in ScenarioNames():
        click.echo(f"{shipped:20} {LoadScenario(shipped).description}")


@cli.command()
@click.argument("folder", type=option.PATH)
@click.option(
    "--scenario", metavar="SCENARIO", help="Of the log.  [default: the one that lies beside it]"
)
@option.out("replay")
@option.quiet
def replay(folder: Path, scenario: str | None, out: Path, quiet: bool) -> None:
    """Show a logged run in 3D.

    FOLDER is what `run` or `reproduce` wrote, or one log (.parquet) in it. Writes a film for each
    log, one HTML file that any browser shows without a network.
    """
    from drake_teleop.station.replay import replay_command

    replay_command(folder, out, scenario=scenario, quiet=quiet)


@cli.command()
@click.argument("log", type=option.PATH)
@option.gripper
@click.option(
    "--method",
    type=click.Choice(["ordinary", "whitened", "robust", "consistent"]),
    default="consistent",
    show_default=True,
    help="Least squares; rows by their noise; also without knocks; also of a possible body.",
)
@option.out("identify")
@option.cutoff
@option.delay
@option.quiet
def identify(
    log: Path,
    gripper: Path | None,
    method: str,
    out: Path,
    cutoff_hz: float,
    delay: float | str,
    quiet: bool,
) -> None:
    """Identify the load on the sensor from a log.

    LOG is a canonical log (.csv, .parquet) or a log description (.yaml). Finds the load's mass,
    centre of mass and inertia, the sensor's offsets and the delay, and says how sure each one is.
    """
    from drake_teleop.cli.logs import identify_command

    identify_command(
        log,
        out,
        gripper=gripper,
        method=method,
        cutoff_hz=cutoff_hz,
        delay=delay,
        quiet=quiet,
    )


@cli.command()
@click.argument("log", type=option.PATH)
@click.option(
    "--load", type=option.PATH, required=True, help="The identification.json of the load."
)
@option.gripper
@click.option(
    "--sigma",
    type=option.Number(0, 100),
    default=0.0,
    show_default=True,
    help="Scale of the non-contact wrench; of the gripper's, if there is one.",
)
@click.option(
    "--sigma-object",
    type=option.Number(0, 100),
    help="Scale of the object's non-contact wrench, with --gripper.  [default: sigma]",
)
@click.option(
    "--gamma",
    type=option.Number(0, 100),
    default=1.0,
    show_default=True,
    help="Scale of the contact wrench.",
)
@click.option("--eta", type=option.Number(0, 1), help="Part of a gripped object that is kept.")
@click.option(
    "--causal",
    type=click.Choice(["delayed", "predicted"]),
    help="Also as a loop would have had it: with its low-pass's lag, or predicted over it.",
)
@click.option(
    "--causal-tare",
    "causal_tare_s",
    type=option.Number(0, 36000, min_open=True),
    metavar="SECONDS",
    help="With --causal: an untouched start that the offsets are of.  [default: the load file's]",
)
@option.free
@option.out("eliminate")
@option.cutoff
@option.delay
@option.quiet
def eliminate(
    log: Path,
    load: Path,
    gripper: Path | None,
    sigma: float,
    sigma_object: float | None,
    gamma: float,
    eta: float | None,
    causal: str | None,
    causal_tare_s: float | None,
    free: Path | None,
    out: Path,
    cutoff_hz: float,
    delay: float | str,
    quiet: bool,
) -> None:
    """Eliminate or scale non-contact forces in a log.

    LOG is a canonical log (.csv, .parquet) or a log description (.yaml). Writes the log of the
    contact wrench, or of the scaled one.
    """
    from drake_teleop.cli.logs import eliminate_command

    eliminate_command(
        log,
        load,
        out,
        gripper=gripper,
        sigma=sigma,
        sigma_object=sigma_object,
        gamma=gamma,
        eta=eta,
        causal=causal,
        causal_tare_s=causal_tare_s,
        free=free,
        cutoff_hz=cutoff_hz,
        delay=delay,
        quiet=quiet,
    )


@cli.command()
@click.argument("log", type=option.PATH)
@click.option(
    "--load",
    type=option.PATH,
    help="The identification.json of the load.  [default: identified from LOG itself]",
)
@option.free
@click.option(
    "--statistic",
    type=click.Choice(["level", "cusum", "glr"]),
    default="level",
    show_default=True,
    help="Of the wrench over its noise floor: plain, its cumulative sum, likelihood ratio.",
)
@option.out("detect")
@option.cutoff
@option.delay
@option.quiet
def detect(
    log: Path,
    load: Path | None,
    free: Path | None,
    statistic: str,
    out: Path,
    cutoff_hz: float,
    delay: float | str,
    quiet: bool,
) -> None:
    """Find contact in a log.

    LOG is a canonical log (.csv, .parquet) or a log description (.yaml). The load's own wrench is
    eliminated; the noise floor of what is left rises when the motion is fast.
    """
    from drake_teleop.cli.logs import detect_command

    detect_command(
        log,
        out,
        load=load,
        free=free,
        statistic=statistic,
        cutoff_hz=cutoff_hz,
        delay=delay,
        quiet=quiet,
    )


@cli.command()
@click.argument("log", type=option.PATH)
@option.out("inspect")
@option.quiet
def inspect(log: Path, out: Path, quiet: bool) -> None:
    """Say what is in a log and what is suspicious in it.

    LOG is a canonical log, a log description (.yaml), or a table of any columns, for which a draft
    description is written. Rates, gaps, noise, saturation and suspected errors of convention.
    """
    from drake_teleop.logs.inspection import inspect_command

    inspect_command(log, out, quiet=quiet)


@cli.command()
@click.argument("source")
@click.option(
    "--load", type=option.PATH, required=True, help="The identification.json of the load."
)
@click.option("--out", "sink", default="-", metavar="SINK", help="Where to.  [default: stdout]")
@click.option(
    "--sigma",
    type=option.Number(0, 100),
    default=0.0,
    show_default=True,
    help="Scale of the non-contact wrench.",
)
@click.option(
    "--gamma",
    type=option.Number(0, 100),
    default=1.0,
    show_default=True,
    help="Scale of the contact wrench.",
)
@click.option(
    "--rate",
    "rate_hz",
    type=option.Number(0, 1e5, min_open=True),
    metavar="HZ",
    help="Of the wrenches; a log, a UR and a NetBox tell their own.",
)
@click.option("--predicted", is_flag=True, help="Extrapolate over the low-pass's lag.")
@click.option("--watch", is_flag=True, help="Flag contact, and another load than the known one.")
@click.option(
    "--free",
    type=option.PATH,
    metavar="LOG",
    help="Flag contact by the noise floor of this log of free motion, as `detect` does.",
)
@click.option("--tare", is_flag=True, help="Set the offsets at the start, untouched and at rest.")
@click.option(
    "--control",
    type=option.Whole(1, 65535),
    metavar="PORT",
    help="Of 127.0.0.1, for the word `tare` by UDP.",
)
@option.stream
def compensate(source: str, load: Path, sink: str, **options: Any) -> None:
    """Take the load out of a live wrench.

    SOURCE is udp://[HOST]:PORT, rtde://HOST, netft://HOST, zenoh://HOST/TOPIC, - for lines of JSON
    on stdin, or replay:LOG; SINK is udp://HOST:PORT, zenoh://HOST/TOPIC, foxglove://, - for stdout,
    or a .csv, .parquet or .mcap file. What cannot be trusted is zero, with a flag. --cutoff is
    causal here; --delay is of the motion behind the wrench, auto: as the load file says. Until the
    source ends, or Ctrl-C.
    """
    from drake_teleop.robots.compensate import compensate_command

    compensate_command(source, load, sink, **options)


@cli.command()
@click.argument("source")
@click.option(
    "--until",
    default="mass 0.5 %, com 0.5 mm, inertia 5 %",
    show_default=True,
    metavar="TOLERANCE",
    help="What is to be known, and how well; what is left out is not asked.",
)
@click.option(
    "--seconds",
    type=option.Number(1, 36000),
    default=120.0,
    show_default=True,
    help="Of the record, at most.",
)
@option.stream
@option.out("calibrate")
@option.quiet
def calibrate(source: str, out: Path, **options: Any) -> int:
    """Identify a load from a live stream, guided.

    SOURCE is as for `compensate`. Move the tool by hand or by the motion of `excite`, and touch
    nothing. It ends when all that is asked is known, and writes the log, and what `identify` says
    of it. The exit status is 1 if it ended before.
    """
    from drake_teleop.cli.calibrate import calibrate_command

    summary = calibrate_command(source, out, **options)
    return 0 if summary["all_known"] else 1


@cli.command()
@click.argument("identification", type=option.PATH)
@click.option(
    "--to",
    required=True,
    type=click.Choice(
        [
            "ur",
            "franka",
            "xarm",
            "kth",
            "ft_tools",
            "ros2-admittance",
            "bota",
            "urdf",
            "sdf",
            "mjcf",
        ]
    ),
    help="Whose format.",
)
@click.option(
    "--sensor-pose",
    nargs=6,
    type=option.Number(-1e3, 1e3),
    metavar="X Y Z ROLL PITCH YAW",
    help="Of the sensor in the flange [m, deg].  [default: the values are in the sensor's frame]",
)
@click.option(
    "--sign",
    type=click.Choice(["-1", "1"]),
    default="-1",
    show_default=True,
    help="As in the log's description: -1 if the sensor reports what the load exerts on it.",
)
def export(identification: Path, to: str, sensor_pose: tuple[float, ...] | None, sign: str) -> None:
    """Say a load in a robot's own words.

    Prints the load of an identification.json in the format, the units and the frame of a robot, of
    a compensation or of a model, and on stderr what it drops and what is not identified.
    """
    from drake_teleop.load.identification import Identification
    from drake_teleop.robots.export import export as export_load

    found = Identification.load(identification)
    text, warnings = export_load(found, to, sensor_pose=sensor_pose, sign=int(sign))
    for warning in warnings:
        click.echo(f"warning: {warning}", err=True)
    click.echo(text, nl=False)


@cli.command("sample-log")
@option.seed_0
@option.out("sample-log")
@option.quiet
def sample_log(seed: int, out: Path, quiet: bool) -> None:
    """Write a simulated log to try these commands on.

    Wrench and pose of an arm with a gripper, in free motion and touched three times, as two
    recorders with their own clocks, rates and units wrote them, and what is in them (truth.json).
    """
    from drake_teleop.logs.sample import sample_log_command

    sample_log_command(out, seed=seed, quiet=quiet)


@cli.command()
@click.argument("scenario", type=option.SCENARIO)
@click.option(
    "--direction",
    type=click.Choice(["x", "y", "z"]),
    default="z",
    show_default=True,
    help="Of the task, an axis of the world.",
)
@option.out("analyze")
@option.quiet
def analyze(scenario: str, direction: str, out: Path, quiet: bool) -> None:
    """Analyse stability and transparency of a scenario.

    SCENARIO is the name of a shipped one or a YAML file. Linearises the station itself: margins,
    passivity, felt impedance, maps over two parameters. Writes pictures and report.html.
    """
    from drake_teleop.lab.analysis.analyze import analyze_command

    analyze_command(scenario, out, direction=direction, quiet=quiet)


@cli.command("compare-passivity")
@click.option("--networks", type=option.Names(), help="Presets.  [default: lan to lunar]")
@click.option("--methods", type=option.Names(), help="Methods.  [default: all]")
@click.option(
    "--scenario",
    default="contact_transition",
    show_default=True,
    help="Whose station it is: a shipped one's, or a YAML file's.",
)
@option.jobs
@option.out("compare-passivity")
@option.seed_0
@option.quiet
def compare_passivity(
    networks: tuple[str, ...] | None,
    methods: tuple[str, ...] | None,
    scenario: str,
    jobs: int | None,
    out: Path,
    seed: int,
    quiet: bool,
) -> None:
    """Compare passivity methods over networks with delay.

    The whole station swings freely and presses on a leaf, soft and stiff; in one degree of freedom
    the hand lets go and taps, and round trips grow. Writes a decision table, pictures, report.html.
    """
    from drake_teleop.lab.comparison import compare_passivity as study

    study.compare_command(
        out,
        networks=networks or study.NETWORKS,
        methods=methods or study.METHODS,
        scenario=scenario,
        seed=seed,
        jobs=jobs or -1,
        quiet=quiet,
    )


@cli.command()
@click.argument("study", type=option.STUDY)
@option.jobs
@click.option(
    "--cluster",
    metavar="ADDRESS",
    help="Of a Dask scheduler, which has the processes; or local, for one on this machine.",
)
@option.yes
@option.out("study")
@option.quiet
def study(
    study: Path, jobs: int | None, cluster: str | None, yes: bool, out: Path, quiet: bool
) -> None:
    """Run a scenario over a design of its fields.

    STUDY is a YAML file: factors, design, repeats, measures; or the name of one that is shipped.
    Writes one table with a row for each run, and pictures. If it was stopped or killed, the same
    command goes on where it was.
    """
    from drake_teleop.lab.studies.study import study_command

    study_command(study, out, jobs=jobs or -1, cluster=cluster, quiet=quiet, yes=yes or option.ask)


@cli.command("scaling-study")
@option.jobs
@click.option(
    "--cluster",
    metavar="ADDRESS",
    help="Of a Dask scheduler, which has the processes; or local, for one on this machine.",
)
@click.option("--repeats", type=option.Whole(1, 10**6), help="Seeds of each point.  [default: 12]")
@option.yes
@option.out("scaling-study")
@option.quiet
def scaling_study(
    jobs: int | None, cluster: str | None, repeats: int | None, yes: bool, out: Path, quiet: bool
) -> None:
    """Answer how to scale forces, for a simulated operator.

    Studies its tasks over sigma, gamma and eta, in about 1000 runs. If it was stopped or
    killed, the same command goes on where it was.
    """
    from drake_teleop.lab.studies.scaling_study import scaling_study_command

    scaling_study_command(
        out,
        jobs=jobs or -1,
        cluster=cluster,
        repeats=repeats,
        yes=yes or option.ask,
        quiet=quiet,
    )


@cli.command()
@click.argument("scenario", type=option.SCENARIO, default="identification")
@click.option("--model", type=option.PATH, help="Another arm: URDF, SDF, MJCF or .dmd.yaml.")
@click.option("--sensor-frame", metavar="NAME", help="Its frame or link with the sensor.")
@click.option(
    "--package-path",
    "package_paths",
    type=option.PATH,
    multiple=True,
    metavar="DIR",
    help="Where its package:// addresses are looked up; may be repeated.",
)
@click.option(
    "--acceleration",
    type=option.PositiveNumbers(),
    default=(),
    help="Limits of its joints in rad/s^2, one for all or one for each.",
)
@click.option(
    "--payload",
    type=option.Number(0, 1e4, min_open=True),
    metavar="KG",
    help="Its heaviest load.  [default: what the model holds beyond the sensor, and 30 %]",
)
@click.option(
    "--criterion",
    type=click.Choice(["kappa_w10", "kappa10", "kappa16", "A16", "D16"]),
    default="kappa_w10",
    show_default=True,
    help="Condition numbers (whitened; plain SI; with offsets), or predicted errors.",
)
@click.option(
    "--period", type=option.Number(0.5, 600), default=6.0, show_default=True, metavar="SECONDS"
)
@click.option(
    "--harmonics", type=option.Whole(2, 20), help="Of each joint.  [default: 5, with --until 3]"
)
@click.option(
    "--until",
    metavar="TOLERANCE",
    help='The shortest motion instead that reaches, say, "mass 0.5 %, com 0.5 mm, inertia 5 %".',
)
@click.option(
    "--time",
    "seconds",
    type=option.Number(0, 1e6, min_open=True),
    metavar="SECONDS",
    help="CPU time of the optimiser.  [default: four starts, the same on every machine]",
)
@option.seed_0
@option.out("excite")
@option.quiet
def excite(
    scenario: str,
    model: Path | None,
    sensor_frame: str | None,
    package_paths: tuple[Path, ...],
    acceleration: tuple[float, ...],
    payload: float | None,
    criterion: str,
    period: float,
    harmonics: int | None,
    until: str | None,
    seconds: float | None,
    seed: int,
    out: Path,
    quiet: bool,
) -> None:
    """Design a motion that shows all of a load.

    For the slave of SCENARIO, or with --model for another arm with SCENARIO's sensor. A Fourier
    series from rest to rest, optimised, and checked against every limit and for collisions. Watch
    it in 3D, excitation.html, before a robot runs it.
    """
    from drake_teleop.cli.excitation import excite_command

    excite_command(
        scenario,
        out,
        model=model,
        sensor_frame=sensor_frame,
        package_paths=package_paths,
        acceleration=acceleration,
        payload=payload,
        criterion=criterion,
        period=period,
        harmonics=harmonics,
        until=until,
        seconds=seconds,
        seed=seed,
        quiet=quiet,
    )


@cli.command()
@click.argument("folder", type=option.PATH)
@click.option("--arm", required=True, type=option.PATH, help="Its URDF, SDF, MJCF or .dmd.yaml.")
@click.option(
    "--sensor-frame",
    required=True,
    metavar="NAME",
    help="Frame or link of the model at which the wrist sensor measures.",
)
@click.option(
    "--package-path",
    "package_paths",
    type=option.PATH,
    multiple=True,
    help="Where its package:// addresses are looked up; may be repeated.",
)
@click.option(
    "--tool",
    type=option.PATH,
    help="Its model.  [default: what the arm's model has beyond the sensor, or a stand-in]",
)
@click.option("--device", default="phantom_premium_15", show_default=True, metavar="NAME")
@click.option("--sensor", metavar="PRESET", help="Of the wrist sensor.")
@option.quiet
def new(
    folder: Path,
    arm: Path,
    sensor_frame: str,
    package_paths: tuple[Path, ...],
    tool: Path | None,
    device: str,
    sensor: str | None,
    quiet: bool,
) -> None:
    """Begin a station with an arm of your own.

    Writes FOLDER/station.yaml, a short commented scenario: where the arm starts, scales that fit
    the device, a wall below the tool. Then runs it once, into FOLDER/first_run.
    """
    from drake_teleop.lab.new_station import new_command

    new_command(
        folder,
        arm,
        sensor_frame,
        package_paths=package_paths,
        tool=tool,
        device=device,
        sensor=sensor,
        quiet=quiet,
    )


def main(arguments: list[str] | None = None) -> None:
    """Runs the command line and exits: 0, 2 for unusable input, 130 for Ctrl-C or `kill`.

    A drive that the user ends so has status 0.

    Also 1, if `reproduce` finds a number that is not as accepted.
    """
    signal.signal(signal.SIGTERM, _terminate)
    atexit.register(gc.freeze)  # the last search for garbage takes a second with Drake's objects
    with warnings.catch_warnings():
        # They are for those who write programs. What a user has to know of a result this package
        # never says so: it stands in the summary, and is printed from there.
        if not sys.warnoptions:
            warnings.simplefilter("ignore")
            os.environ["PYTHONWARNINGS"] = "ignore"  # of the processes of a study
        status = _run(arguments)
    sys.exit(status if isinstance(status, int) else 0)


def _run(arguments: list[str] | None) -> Any:
    """What the command returns, or the exit status of what it ended with."""
    try:
        return cli.main(arguments, prog_name="drake-teleop", standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
        return 2
    except click.ClickException as error:
        return _fail(error.format_message())
    except DrakeTeleopError as error:
        return _fail(str(error))
    except (click.Abort, KeyboardInterrupt) as interrupt:
        # click makes an Abort of a KeyboardInterrupt; what was kept is told by its cause.
        click.echo(f"interrupted: {interrupt.__cause__ or ''}".removesuffix(": "), err=True)
        return 130
    except OSError as error:
        return _fail(f"{error.filename}: {error.strerror}" if error.filename else str(error))


def _terminate(number: int, frame: Any) -> None:
    raise KeyboardInterrupt("SIGTERM")


def _fail(message: str) -> int:
    click.echo(one_line(f"error: {message}"), err=True)
    return 2
