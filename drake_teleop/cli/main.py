"""Commands of `drake-teleop` (long: one file for all commands)."""

from __future__ import annotations

import atexit
import gc
import os
import sys
import warnings
from pathlib import Path
from typing import Any

import click

from drake_teleop.cli import options as option
from drake_teleop.common.errors import DrakeTeleopError, to_one_line
from drake_teleop.common.interruption import INTERRUPTED_EVENT, install_interrupt_handlers
from drake_teleop.common.version import __version__


@click.group(cls=option.CommandGroup, context_settings=option.HELP_SETTINGS)
@click.version_option(__version__, prog_name="drake-teleop")
@option.path_option(
    "--register",
    "registration_scripts",
    multiple=True,
    metavar="FILE",
    help="Python file that registers your own parts (docs/extend.md); may be repeated.",
)
def cli(registration_scripts: tuple[Path, ...]) -> None:
    """Bilateral teleoperation with non-contact force scaling: simulate it, or use it on logs.

    Every command with --out writes its results (name: value) into DIR/summary.json. A command with
    invalid input exits with status 2 and one error line.

    The Tab key completes commands and names in bash (zsh, fish: zsh_source, fish_source) after
    eval "$(_DRAKE_TELEOP_COMPLETE=bash_source drake-teleop)"
    """
    for script in registration_scripts:
        from drake_teleop.common.registry import register_from_script

        register_from_script(script)


@cli.command()
@option.output_folder("reproduce")
@option.seed_option()
@option.quiet_option
def reproduce(out: Path, **options: Any) -> int:
    """Repeat the paper's experiments.

    Writes figures and numbers of the paper (Kubus, Weidauer, Wahl 2009) and of the simulation, a
    3D replay and report.html. The exit status is 1 if a number is outside its accepted range.
    """
    from drake_teleop.lab.reproduction.report import describe_values_outside_ranges
    from drake_teleop.lab.reproduction.reproduce import reproduce_command

    lines = describe_values_outside_ranges(reproduce_command(out, **options))
    for line in lines:
        click.echo(line, err=True)
    return 1 if lines else 0


@cli.command()
@click.argument("scenario", type=option.SCENARIO_NAME_OR_PATH_TYPE, required=False)
@option.path_option("--inputs", metavar="DIR")
@option.output_folder("run")
@option.seed_option()
@click.option("--fresh", is_flag=True)
@option.quiet_option
def run(scenario: str | None, inputs: Path | None, out: Path, **options: Any) -> None:
    """Simulate one scenario, or repeat a session of `drive`.

    SCENARIO is a shipped name or a YAML file. Writes the log, pictures and a 3D replay. The load is
    identified first and kept in the user's cache folder, or in $DRAKE_TELEOP_CACHE_DIR.

    Options:
        --inputs: Folder of `drive --record`; repeat this session with identical results.
        --fresh: Identify the load again; ignore the cache.
    """
    from drake_teleop.lab.run import run_command

    if (scenario is None) == (inputs is None):
        raise click.UsageError("give either SCENARIO, or --inputs and a folder of `drive --record`")
    drive = None
    if inputs is not None:
        from drake_teleop.live.session import read_drive

        drive = read_drive(inputs)
    run_command(scenario, out, drive=drive, **options)


@cli.command()
@click.argument("scenario", type=option.SCENARIO_NAME_OR_PATH_TYPE, default="contact_transition")
@option.path_option("--record", metavar="DIR")
@option.int_option("--port", limits=(0, 65535), default=0, show_default="any free port")
@click.option("--no-browser", is_flag=True)
@click.option("--device", metavar="ADDRESS")
@click.option("--study", metavar="FILE")
@option.path_option("--results", default=Path("out/experiment"), metavar="DIR")
@option.int_option(
    "--participant", limits=(1, 9999), show_default="first unfinished participant, or a new one"
)
@option.int_option("--simulated", limits=(0, 9999), default=0, show_default=False)
def drive(
    scenario: str,
    record: Path | None,
    no_browser: bool,
    study: str | None,
    results: Path,
    participant: int | None,
    simulated: int,
    **options: Any,
) -> None:
    """Drive a station live in the browser.

    SCENARIO is a shipped name or a YAML file; you move the hand of its operator, whose grip
    remains simulated. A page on this machine moves the hand by mouse, keys, touch or gamepad (which
    vibrates in contact), and shows forces, sigma, gamma and eta. `run --inputs DIR` repeats a
    recorded session. With --study (name or YAML file) participants compare two intervals per trial.

    Options:
        --record: Record the session in DIR.
        --port: TCP port of the page on localhost.
        --no-browser: Print the page's address; open no browser.
        --device: Haptic device of the operator: udp://127.0.0.1:PORT or haply://localhost:10001.
        --study: Experiment with participants; SCENARIO is then unused.
        --results: Folder for results of --study; the same folder continues an experiment.
        --participant: Number of the participant of --study.
        --simulated: Number of participants to simulate in --study; 0: people, on the page.
    """
    options["browser"] = not no_browser
    if study is None:
        names = ("results", "participant", "simulated")
        option.refuse_given_options(*names, remedy="add --study or remove it")
        from drake_teleop.live.server import run_drive_command

        run_drive_command(scenario, record=record, **options)
        return
    option.refuse_given_options("record", remedy="remove --record; give the folder as --results")
    if simulated:
        unused = ("participant", "port", "no_browser", "device")
        option.refuse_given_options(*unused, remedy="remove it or --simulated")
    from drake_teleop.cli.experiment import experiment_command

    experiment_command(study, results, participant=participant, simulated=simulated, **options)


@cli.command("scenario")
@click.argument("name", type=option.SCENARIO_NAME_OR_PATH_TYPE, required=False)
def print_scenario(name: str | None) -> None:
    """Print a scenario with every field, as a template.

    NAME is a shipped name or a YAML file; without it, the shipped names are listed. Each field has
    its range and its meaning: drake-teleop scenario press > mine.yaml
    """
    from drake_teleop.station.scenario import LoadScenario, ScenarioNames
    from drake_teleop.station.scenario_reference import to_commented_yaml

    if name is not None:
        click.echo(to_commented_yaml(LoadScenario(name)), nl=False)
        return
    for shipped in ScenarioNames():
        click.echo(f"{shipped:20} {LoadScenario(shipped).description}")


@cli.command()
def parts() -> None:
    """List the names of all methods, formats and other parts.

    --register FILE adds your own parts: drake-teleop --register mine.py parts
    """
    from drake_teleop.cli.logs import print_registered_names

    print_registered_names()


@cli.command()
@click.argument("folder", type=option.UTF8_PATH_TYPE)
@click.option("--scenario", metavar="SCENARIO")
@option.output_folder("replay")
@option.quiet_option
def replay(folder: Path, out: Path, **options: Any) -> None:
    """Show a logged run in 3D.

    FOLDER is the output of `run` or `reproduce`, or one log (.parquet) in it. Writes a 3D replay of
    each log: one HTML file that any browser shows without a network.

    Options:
        --scenario: Scenario of the log.  [default: YAML file beside it]
    """
    from drake_teleop.station.replay import replay_command

    replay_command(folder, out, **options)


@cli.command()
@click.argument("log", type=option.UTF8_PATH_TYPE)
@option.gripper_file_option
@click.option(
    "--method",
    type=option.RegisteredName("estimator", "ordinary", "whitened", "robust", "consistent"),
    default="consistent",
)
@option.output_folder("identify")
@option.cutoff_option
@option.delay_option
@option.quiet_option
def identify(log: Path, out: Path, **options: Any) -> None:
    """Identify the load on the sensor from a log.

    LOG is a canonical log (.csv, .parquet) or a log description (.yaml). Estimates the load's mass,
    centre of mass and inertia, the sensor's offsets and the delay, each with its uncertainty.

    Options:
        --method: Least squares; whitened: weighted by noise; robust: also without disturbed
            samples; consistent: also possible for a rigid body.
    """
    from drake_teleop.cli.logs import identify_command

    identify_command(log, out, **options)


@cli.command()
@click.argument("log", type=option.UTF8_PATH_TYPE)
@option.load_file_option(required=True)
@option.gripper_file_option
@option.sigma_option
@click.option("--sigma-object", type=option.FORCE_SCALE_TYPE)
@option.sigma_weight_and_inertia_options
@option.gamma_option
@option.float_option("--eta", limits=(0, 1))
@option.choice_option("--offsets", ["record", "load"], "record")
@option.float_option("--untouched", "untouched_s", limits=(0, 36000), nargs=2, metavar="START STOP")
@click.option("--causal", type=click.Choice(["delayed", "predicted"]))
@option.float_option(
    "--causal-tare", "causal_tare_s", limits=(0, 36000), excludes_min=True, metavar="SECONDS"
)
@option.free_motion_log_option
@option.output_folder("eliminate")
@option.cutoff_option
@option.delay_option
@option.quiet_option
def eliminate(log: Path, load: Path, out: Path, **options: Any) -> None:
    """Eliminate or scale non-contact forces in a log.

    LOG is a canonical log (.csv, .parquet) or a log description (.yaml). Writes a table of the
    contact wrench and the scaled wrench.

    Options:
        --sigma-object: With --gripper: scale of the object's non-contact wrench.  [default: value
            of --sigma]
        --eta: With --gripper: eliminate the gripper's wrench, scale the object's; no other scales.
        --offsets: Source of the sensor offsets: LOG (record) or the load file (load).
        --untouched: Start and end of a contact-free part of LOG that determines the offsets [s].
            [default: the whole LOG]
        --causal: Add the result of a causal low-pass; delayed: late by its lag; predicted:
            extrapolated over the lag.
        --causal-tare: With --causal: length of the contact-free start of LOG that determines the
            offsets [s].  [default: offsets of the load file]
        --sigma: Scale of the non-contact wrench; with --gripper, of the gripper's.
    """
    from drake_teleop.cli.logs import eliminate_command

    eliminate_command(log, load, out, **options)


@cli.command()
@click.argument("log", type=option.UTF8_PATH_TYPE)
@option.load_file_option()
@option.free_motion_log_option
@option.choice_option("--statistic", ["level", "cusum", "glr"], "level")
@option.output_folder("detect")
@option.cutoff_option
@option.delay_option
@option.quiet_option
def detect(log: Path, out: Path, **options: Any) -> None:
    """Find contact in a log.

    LOG is a canonical log (.csv, .parquet) or a log description (.yaml). The load's own wrench is
    eliminated; noise of the remaining wrench is modelled as rising with the acceleration.

    Options:
        --statistic: Level, cumulative sum or likelihood ratio of the wrench, relative to its noise.
        --load: identification.json of the load.  [default: identified from LOG itself]
    """
    from drake_teleop.cli.logs import detect_command

    detect_command(log, out, **options)


@cli.command()
@click.argument("log", type=option.UTF8_PATH_TYPE)
@click.argument("others", type=option.UTF8_PATH_TYPE, nargs=-1)
@option.output_folder("inspect")
@option.quiet_option
def inspect(log: Path, others: tuple[Path, ...], out: Path, quiet: bool) -> None:
    """List the contents and suspicious parts of a log.

    LOG is a canonical log, a log description (.yaml), or a table of any columns, for which a draft
    description is written; OTHERS are further tables of the same recording. Reports rates, gaps,
    noise, saturation and suspicious signs, axes and units.
    """
    from drake_teleop.logs.inspection import inspect_command

    inspect_command(log, out, others=others, quiet=quiet)


@cli.command()
@click.argument("path", type=option.UTF8_PATH_TYPE)
@option.load_file_option()
@click.option("--identify", is_flag=True)
@option.path_option("--description", metavar="FILE")
@option.jobs_option
@option.output_folder("dataset")
@option.quiet_option
def dataset(path: Path, out: Path, **options: Any) -> None:
    """Add contact wrenches to a robot-learning dataset.

    PATH is a LeRobot folder, a robomimic file (.hdf5), a .zarr, or a folder with a table for each
    episode. Needs --load or --identify. Writes a copy with contact wrench and contact flags, and a
    verdict for each episode. After an interruption, repeat the command.

    Options:
        --identify: Identify the load from all episodes.
        --description: Log description, for all episodes, without `file`.  [default: drafted from
            the episodes]
    """
    from drake_teleop.logs.dataset.dataset import dataset_command

    dataset_command(path, out, **options)


@cli.command()
@click.argument("source")
@option.load_file_option(required=True)
@click.option("--out", "sink", default="-", show_default=False, metavar="SINK")
@option.sigma_option
@option.sigma_weight_and_inertia_options
@option.gamma_option
@option.rate_option()
@click.option("--predicted", is_flag=True)
@click.option("--watch", is_flag=True)
@option.path_option("--free", metavar="LOG")
@click.option("--tare", is_flag=True)
@option.int_option("--control", limits=(1, 65535), metavar="PORT")
@option.stream_options
def compensate(source: str, load: Path, sink: str, **options: Any) -> None:
    """Remove the load from a live wrench.

    SOURCE is udp://[HOST]:PORT, posed://[HOST]:PORT, rtde://HOST, netft://HOST, ros2://TOPIC,
    zenoh://HOST/TOPIC, - for lines of JSON on stdin, or replay:LOG; SINK is udp://HOST:PORT,
    ros2://TOPIC, zenoh://HOST/TOPIC, foxglove://, - for stdout, or a .csv, .parquet or .mcap file.
    Invalid wrenches are zero, with a flag. --delay is the delay of the motion behind the wrench;
    auto starts with the value in the load file. The command ends with
    the source or with Ctrl-C.

    Options:
        --out: Destination of the results.  [default: stdout]
        --predicted: Extrapolate the results over the low-pass lag.
        --watch: Flag contact, and a change of the load.
        --free: Log of free motion, whose noise sets the threshold of contact flags.
        --tare: Tare at the start: keep the tool free, at rest.
        --control: UDP port on localhost that accepts the request `tare`.
        --sigma: Scale of the non-contact wrench.
        --rate: Rate of the wrenches; not needed for replay:, rtde:// and netft://.
    """
    from drake_teleop.robots.compensate import run_compensate_command

    run_compensate_command(source, load, sink, **options)


@cli.command()
@click.argument("source")
@click.argument("sink")
@option.load_file_option(required=True)
@option.sigma_option
@option.sigma_weight_and_inertia_options
@option.gamma_option
@option.rate_option(required=True)
@click.option("--watch", is_flag=True)
@option.stream_options
@option.output_folder("ros2")
@click.pass_context
def ros2(ctx: click.Context, source: str, load: Path, sink: str, out: Path, **options: Any) -> None:
    """Remove the load from a live wrench, as a ROS 2 node.

    SOURCE and SINK are ros2://TOPIC as for `compensate`. The node /drake_teleop has the services
    tare, load and calibrate, and the parameters sigma, gamma, sigma_weight, sigma_inertia, load,
    until and seconds. Flags are on /diagnostics. Calibrations are written to --out.

    Options:
        --watch: Flag contact, and a change of the load.
        --sigma: Scale of the non-contact wrench.
        --rate: Rate of the wrenches.
    """
    from drake_teleop.robots.ros2_node import run_ros2_command

    def make_calibrate_arguments(until: str, seconds: float) -> list[str]:
        words = ["calibrate", source, "--until", until, "--seconds", str(seconds), "--quiet"]
        words += ["--out", str(out)]
        given = {"--cutoff": "cutoff_hz", "--delay": "delay", "--model": "model"}
        given |= {"--sensor-frame": "sensor_frame", "--motion": "motion"}
        given |= {"--range": "sensor_range", "--sensor-pose": "sensor_pose"}
        for name, parameter in given.items():
            if (value := ctx.params[parameter]) is not None:
                words += [name, *map(str, value if isinstance(value, tuple) else [value])]
        for path in ctx.params["package_paths"]:
            words += ["--package-path", str(path)]
        return words

    run_ros2_command(source, load, sink, out, calibrate=make_calibrate_arguments, **options)


@cli.command()
@click.argument("source")
@click.option("--until", default="mass 0.5 %, com 0.5 mm, inertia 5 %", metavar="TOLERANCE")
@option.float_option("--seconds", limits=(1, 36000), default=120.0)
@option.stream_options
@option.output_folder("calibrate")
@option.quiet_option
def calibrate(source: str, out: Path, **options: Any) -> int:
    """Identify a load from a live stream, with guidance.

    SOURCE is as for `compensate`. Move the tool manually or by the motion of `excite`, without
    contact. The command ends when all tolerances are reached; it writes the log and the results of
    `identify`. The exit status is 1 if the time ends before.

    Options:
        --until: Required accuracy; mass, com or inertia may be left out.
        --seconds: Maximum duration of the recording [s].
    """
    from drake_teleop.cli.calibrate import calibrate_command

    return 0 if calibrate_command(source, out, **options)["all_known"] else 1


_CONTROLLER_EXPORT_FORMATS = ("c99", "fmu", "ros2_filter")
_EXPORT_FORMAT_OPTION_TYPE = option.RegisteredName(
    "export format",
    *("ur", "franka", "xarm", "kth", "ft_tools", "ros2-admittance", "bota", "urdf", "sdf", "mjcf"),
    *_CONTROLLER_EXPORT_FORMATS,
)


@cli.command()
@click.argument("identification", type=option.UTF8_PATH_TYPE)
@click.option("--to", required=True, type=_EXPORT_FORMAT_OPTION_TYPE)
@option.sensor_pose_option
@option.choice_option("--sign", ["-1", "1"], "-1")
@option.rate_option()
@option.cutoff_option
@option.range_option
@option.output_folder("export")
def export(
    identification: Path, to: str, sensor_pose: tuple[float, ...] | None, sign: str, **options: Any
) -> None:
    """Write a load for a robot, model or controller.

    Prints the load of an identification.json in the format, units and frame of a robot, another
    load compensation or a model. c99, fmu and ros2_filter write a controller into --out, which
    compensates the load with --rate, --cutoff and --range. Values that are dropped or not
    identified are listed on stderr.

    Options:
        --to: Robot or file format.
        --sign: -1 if the sensor measures the wrench that the load exerts on it, else 1.
        --sensor-pose: Pose of the sensor in the flange [m, deg].  [default: same frames]
        --rate: Rate of the sensor's readings; required by c99, fmu and ros2_filter.
    """
    from drake_teleop.load.identification import Identification

    if to in ("c99", "fmu"):
        remedy = "remove it, and give the code the wrench of the sensor on the load"
        option.refuse_given_options("sign", remedy=remedy)
    elif to not in _CONTROLLER_EXPORT_FORMATS:
        remedy = f"remove it, as {to} is printed; for a file, redirect the output: > FILE"
        option.refuse_given_options("out", "rate_hz", "cutoff_hz", "sensor_range", remedy=remedy)
    found = Identification.load(identification)
    if to in _CONTROLLER_EXPORT_FORMATS:
        from drake_teleop.robots.controller.export import export_controller

        notes = export_controller(found, to, sensor_pose=sensor_pose, sign=int(sign), **options)
        text = ""
    else:
        from drake_teleop.robots.export import export_load

        text, notes = export_load(found, to, sensor_pose=sensor_pose, sign=int(sign))
    for note in notes:
        click.echo(f"warning: {note}", err=True)
    click.echo(text, nl=False)


@cli.command("sample-log")
@option.seed_with_default_0_option
@option.output_folder("sample-log")
@option.quiet_option
def sample_log(out: Path, **options: Any) -> None:
    """Write a simulated log to try these commands on.

    The log contains wrench and pose of an arm with a gripper, in free motion and with three
    contacts, from two recorders with different clocks, rates and units. The true values are in
    truth.json.
    """
    from drake_teleop.logs.sample import sample_log_command

    sample_log_command(out, **options)


@cli.command()
@click.argument("scenario", type=option.SCENARIO_NAME_OR_PATH_TYPE)
@option.choice_option("--direction", ["x", "y", "z"], "z")
@option.output_folder("analyze")
@option.quiet_option
def analyze(scenario: str, out: Path, **options: Any) -> None:
    """Analyse stability and transparency of a scenario.

    SCENARIO is a shipped name or a YAML file. Linearises the station: margins, passivity, rendered
    impedance, maps over two parameters. Writes pictures and report.html.

    Options:
        --direction: Direction of the task, an axis of the world frame.
    """
    from drake_teleop.lab.analysis.analyze import analyze_command

    analyze_command(scenario, out, **options)


@cli.command("compare-passivity")
@click.option("--networks", type=option.NAME_LIST_TYPE)
@click.option("--methods", type=option.NAME_LIST_TYPE)
@click.option("--scenario", default="contact_transition")
@option.jobs_option
@option.output_folder("compare-passivity")
@option.seed_with_default_0_option
@option.quiet_option
def compare_passivity(
    networks: tuple[str, ...] | None, methods: tuple[str, ...] | None, out: Path, **options: Any
) -> None:
    """Compare passivity methods over networks with delay.

    The station moves freely and presses on a soft and a stiff sheet spring. In a model with one
    degree of freedom the hand lets go or taps, at increasing round-trip times. Writes a
    decision table, pictures and report.html.

    Options:
        --networks: Network presets.  [default: all but ideal]
        --methods: Passivity methods.  [default: all]
        --scenario: Scenario of the station: a shipped name or a YAML file.
    """
    from drake_teleop.lab.comparison.compare_passivity import NETWORKS, compare_command

    compare_command(out, networks=networks or NETWORKS, methods=methods, **options)


@cli.command()
@click.argument("scenario", type=option.SCENARIO_NAME_OR_PATH_TYPE)
@click.option("--hands", type=option.NAME_LIST_TYPE)
@click.option("--walls", type=option.POSITIVE_NUMBER_LIST_TYPE)
@click.option("--network")
@option.choice_option("--task", ["press", "touch", "insert"], "press")
@option.jobs_option
@option.output_folder("tune")
@option.quiet_option
def tune(
    scenario: str,
    out: Path,
    hands: tuple[str, ...] | None,
    walls: tuple[float, ...] | None,
    **options: Any,
) -> None:
    """Choose passivity method and force scales for a station.

    SCENARIO is a shipped name or a YAML file. Finds the settings with the smallest detectable
    contact force that are stable for --hands and --walls. Writes tuned.yaml and report.html.
    After an interruption, repeat the command.

    Options:
        --hands: Grips of the operator.  [default: light,firm]
        --walls: Wall stiffnesses [kN/m].  [default: 0.5,20]
        --network: Network preset.  [default: that of the scenario]
        --task: Task of the operator, which sets the required stability margin of gamma.
    """
    from drake_teleop.lab.tuning.tune import tune as tune_station

    hands, walls = hands or ("light", "firm"), walls or (0.5, 20.0)
    tune_station(scenario, out, hands=hands, walls=walls, **options)


@cli.command()
@click.argument("study", type=option.STUDY_NAME_OR_PATH_TYPE)
@option.jobs_option
@option.dask_cluster_option
@click.option("--shard", metavar="K/N")
@click.option("--merge", is_flag=True)
@option.skip_run_count_question_option
@option.output_folder("study")
@option.quiet_option
def study(study: Path, out: Path, **options: Any) -> None:
    """Run a scenario for varied values of its fields.

    STUDY is a YAML file with factors, design, repeats and measures, or a shipped name. Writes one
    table with a row for each run, and pictures. After an interruption, repeat the command.

    Options:
        --shard: Run only part K of N, e.g. 3/8; see docs/cluster.md.
        --merge: Collect the runs of all shards in --out.
    """
    from drake_teleop.lab.studies.study import study_command

    study_command(study, out, **options)


@cli.command("scaling-study")
@option.jobs_option
@option.dask_cluster_option
@option.int_option("--repeats", limits=(1, 10**6))
@option.skip_run_count_question_option
@option.output_folder("scaling-study")
@option.quiet_option
def scaling_study(out: Path, **options: Any) -> None:
    """Find the best force scales for a simulated operator.

    Simulates the operator's tasks for combinations of sigma, gamma and eta, in 1200 runs.
    After an interruption, repeat the command.

    Options:
        --repeats: Runs per combination.  [default: 12]
    """
    from drake_teleop.lab.studies.scaling_study import scaling_study_command

    scaling_study_command(out, **options)


@cli.command()
@click.argument("scenario", type=option.SCENARIO_NAME_OR_PATH_TYPE, default="identification")
@option.path_option("--model")
@option.sensor_frame_option()
@option.package_path_option
@click.option("--acceleration", type=option.POSITIVE_NUMBER_LIST_TYPE, default=())
@option.float_option("--payload", limits=(0, 1e4), excludes_min=True, metavar="KG")
@option.choice_option("--criterion", ["kappa_w10", "kappa10", "kappa16", "A16", "D16"], "kappa_w10")
@option.float_option("--period", limits=(0.5, 600), default=6.0, metavar="SECONDS")
@option.int_option("--harmonics", limits=(2, 20))
@click.option("--until", metavar="TOLERANCE")
@option.float_option("--time", "seconds", limits=(0, 1e6), excludes_min=True, metavar="SECONDS")
@option.seed_with_default_0_option
@option.output_folder("excite")
@option.quiet_option
def excite(scenario: str, out: Path, **options: Any) -> None:
    """Design a motion that excites all parameters of a load.

    The motion is for the slave of SCENARIO, or with --model for another arm with SCENARIO's sensor.
    It is a Fourier series from rest to rest, optimised and checked against every limit and for
    collisions. Check the 3D replay, excitation.html, before a robot runs the motion.

    Options:
        --model: Other arm: URDF, SDF, MJCF or .dmd.yaml.
        --acceleration: With --model: acceleration limits [rad/s^2], one for all joints or one for
            each.
        --payload: With --model: heaviest load of the sensor [kg].  [default: 130 % of the model's
            mass beyond the sensor]
        --criterion: Condition number (kappa_w10: whitened; kappa10: SI units; kappa16: with
            offsets) or predicted errors (A16: rms; D16: geometric mean).
        --period: Duration of one period of the motion.
        --harmonics: Number of harmonics.  [default: 5; 3 with --until]
        --until: Find the shortest motion for an accuracy such as "mass 0.5 %, com 0.5 mm, inertia 5
            %".
        --time: CPU time of the optimiser.  [default: time for four starts, with reproducible
            results]
    """
    if options["until"] is not None:
        option.refuse_given_options("criterion", "period", "seconds", remedy="remove it or --until")
    from drake_teleop.cli.excitation import excite_command

    excite_command(scenario, out, **options)


@cli.command()
@click.argument("folder", type=option.UTF8_PATH_TYPE)
@option.path_option("--arm", required=True)
@option.sensor_frame_option(required=True)
@option.package_path_option
@option.path_option("--tool")
@click.option("--device", default="phantom_premium_15", metavar="NAME")
@click.option("--sensor", metavar="PRESET")
@option.quiet_option
def new(folder: Path, arm: Path, sensor_frame: str, **options: Any) -> None:
    """Create a station with your own arm.

    Writes FOLDER/station.yaml, a short commented scenario: start of the arm, scales that fit the
    device, a wall below the tool. Then simulates it once, into FOLDER/first_run.

    Options:
        --arm: Arm model: URDF, SDF, MJCF or .dmd.yaml.
        --tool: Model of the tool.  [default: the arm's model beyond the sensor, or a default tool]
        --device: Preset of the master's haptic device.
        --sensor: Preset of the wrist sensor.
    """
    from drake_teleop.lab.new_station import new_command

    new_command(folder, arm, sensor_frame, **options)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit with status 0, 2 (invalid input) or 130 (Ctrl-C, SIGTERM).

    `reproduce` and `calibrate` can have status 1. A live session that the user ends has status 0.
    """
    install_interrupt_handlers()
    atexit.register(gc.freeze)  # the last collection takes 1 s with Drake's objects
    with warnings.catch_warnings():
        # Warnings are for programmers; those for users are in the summary and printed from there.
        if not sys.warnoptions:
            warnings.simplefilter("ignore")
            os.environ["PYTHONWARNINGS"] = "ignore"  # for the processes of a study
        try:
            status = _run_and_get_exit_status(arguments)
        finally:
            INTERRUPTED_EVENT.clear()
    sys.exit(status if isinstance(status, int) else 0)


def _run_and_get_exit_status(arguments: list[str] | None) -> Any:
    try:
        return cli.main(arguments, prog_name="drake-teleop", standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:
        click.echo(error.format_message())
        return 2
    except click.ClickException as error:
        return _print_error(error.format_message())
    except DrakeTeleopError as error:
        return _print_error(str(error))
    except (click.Abort, KeyboardInterrupt) as interrupt:
        # click raises Abort from a KeyboardInterrupt, which contains the message.
        click.echo(f"interrupted: {interrupt.__cause__ or ''}".removesuffix(": "), err=True)
        return 130
    except OSError as error:
        return _print_error(f"{error.filename}: {error.strerror}" if error.filename else str(error))


def _print_error(message: str) -> int:
    click.echo(to_one_line(f"error: {message}"), err=True)
    return 2
