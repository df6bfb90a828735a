"""Claims of README and docs, and the figure of the run that shows each, for `evidence.py`."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

FAST_EPISODES = ("30 fps", "50 fps")

RUNS = {
    "adversary": "benchmarks/adversary.py --method ledger --runs 10000 --json FILE",
    "adversary_drag": (
        "benchmarks/adversary.py --method ledger --runs 10000 --drag --imperfect --json FILE"
    ),
    "adversary_methods": "benchmarks/adversary.py --runs 900 --json FILE",
    "analysis": "benchmarks/analysis.py --json FILE",
    "calibrate": "benchmarks/calibrate.py --json FILE",
    "calibrate_poses": "benchmarks/calibrate.py --only poses --loads 50 --json FILE",
    "calls": "benchmarks/calls.py --json FILE",
    "compensate": "benchmarks/compensate.py --json FILE",
    "contact_detection": "benchmarks/contact_detection.py --json FILE",
    "dataset": "benchmarks/dataset.py 10 0 --json FILE",
    "domain": "benchmarks/domain.py --json FILE",
    "errors_in_variables": "benchmarks/errors_in_variables.py --json FILE",
    "foreign_analysis": "benchmarks/foreign_analysis.py --json FILE",
    "frequency_response": "benchmarks/frequency_response.py --json FILE",
    "half_mass": "benchmarks/half_mass.py --json FILE",
    "identification": "benchmarks/identification.py --json FILE",
    "kernel": "benchmarks/kernel.py --json FILE",
    "intervals": "benchmarks/intervals.py --json FILE",
    "inverse_kinematics": "benchmarks/inverse_kinematics.py --json FILE",
    "ledger_cells": "benchmarks/ledger_cells.py --cells 200 --seed 54 --json FILE",
    "ledger_in_station": "benchmarks/ledger_in_station.py --json FILE",
    "ledger_with_friction": (
        "benchmarks/ledger_in_station.py --network lan --friction 30 --damping 300 --json FILE"
    ),
    "literature": "benchmarks/literature.py --only mass detection architectures --json FILE",
    "literature_peg": "benchmarks/literature.py --only peg --json FILE",
    "live": "benchmarks/live.py --json FILE",
    "live_slices": "benchmarks/live.py --slices --seconds 3 --json FILE",
    "formats": "benchmarks/formats.py --json FILE",
    "dataset_long": "benchmarks/dataset.py 0 1000000 --tools 0 --json FILE",
    "dataset_checkers": "benchmarks/dataset_checkers.py --json FILE",
    "load_change": "benchmarks/load_change.py --json FILE",
    "mujoco_wrench": "benchmarks/mujoco_wrench.py --json FILE",
    "peers": "benchmarks/peers.py --json FILE",
    "peers_rls": "benchmarks/peers.py --loads 0 --rls 5 --json FILE",
    "planted_causes": "benchmarks/planted_causes.py --json FILE",
    "planted_causes_good": "benchmarks/planted_causes.py --set good --seeds 0-99 --json FILE",
    "planted_mistakes": "benchmarks/planted_mistakes.py --seed 9000 --json FILE",
    "pose_noise": (
        "benchmarks/pose_noise.py --runs 100 --no-present --only '125 Hz' '0.4 mrad, 500 Hz'"
        " 'AR 0.9' drift kHz gains TCP --json FILE"
    ),
    "realistic_sensor": "benchmarks/realistic_sensor.py --json FILE",
    "recovery": "benchmarks/recovery.py --networks 300 --json FILE",
    "live_changes": "benchmarks/live_changes.py --json FILE",
    "live_page": "benchmarks/live_page.py --json FILE",
    "repeated": "benchmarks/repeated.py --json FILE",
    "replayed": "benchmarks/replayed.py --json FILE",
    "reproduce": "drake-teleop reproduce --quiet --out FOLDER",
    "ros2": "benchmarks/ros2.py --json FILE",
    "study_shards": "benchmarks/study.py --shards 8 --runs 3600 --json FILE",
    "shortest": "benchmarks/shortest.py --json FILE",
    "station": "benchmarks/station.py --json FILE",
    "stations": (
        "benchmarks/stations.py --devices phantom_premium_15,geomagic_touch,omega_6,leader"
        " --json FILE"
    ),
    "tuning": ("benchmarks/tuning.py --stations 20 --jobs 1 --json FILE"),
}
"""Name of a record -> its command; FILE is the file of figures, FOLDER that of summary.json."""


@dataclass(frozen=True)
class Claim:
    """Claim with the figure that shows it."""

    section: str
    says: str
    where: str
    """Conditions: station, range and assumption."""
    page: str
    """Page of docs/ with the claim."""
    run: str
    """One of `RUNS`."""
    figure: Callable[[Any], float]
    """Function from the output of the run to the figure."""
    unit: str = ""
    least: float = -math.inf
    most: float = math.inf

    def value(self, figures: Any) -> float:
        """Return the figure in `unit`."""
        return float(self.figure(figures))

    def met(self, figures: Any) -> bool:
        """Return whether the figure is within the bounds; NaN is not."""
        return self.least <= self.value(figures) <= self.most

    def text(self, figures: Any) -> str:
        """Return the figure with its unit."""
        return _said(self.value(figures), self.unit)

    @property
    def bound(self) -> str:
        """Return the bounds with their unit."""
        if self.least == self.most:
            return _said(self.most, self.unit)
        parts = [
            f"{sign} {_said(x, self.unit)}"
            for sign, x in (("≥", self.least), ("≤", self.most))
            if math.isfinite(x) and (x != 0.0 or sign == "≤")  # magnitudes have no lower bound
        ]
        return " and ".join(parts)


@dataclass(frozen=True)
class InTests:
    """Claim that a test checks in every run of the tests."""

    section: str
    says: str
    where: str
    page: str
    test: str


@dataclass(frozen=True)
class NotShown:
    """Claim, or apparent claim, that no run shows."""

    section: str
    says: str
    why: str


def _said(value: float, unit: str) -> str:
    digits = f"{value:.0f}" if 100.0 <= abs(value) < 1e4 else f"{value:.3g}"
    if "e" in digits:
        mantissa, exponent = digits.split("e")
        digits = f"{mantissa}·10{str(int(exponent)).translate(_RAISED)}"
    return f"{digits} {unit}".strip()


_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def _rows(figures: Any, key: str, **such: Any) -> list[Any]:
    """Return a column of the rows with the values `such`, without missing values."""
    found = [
        row[key]
        for row in figures
        if row[key] is not None and all(row[name] == is_ for name, is_ in such.items())
    ]
    return found or [math.nan]


def _well_by_medium_grip(row: Any) -> bool:
    """Return whether a hold by a medium grip meets all criteria of `ledger_in_station.py`."""
    at_rest = row["stable"] and row["left_m"] <= 5e-3 and min(row["energy_J"]) >= -1e-6
    good = abs(row["felt_error"]) <= 0.1 and row["chatter_N"] <= 0.05
    return row["grip"] == "medium" and at_rest and good


def _cells_that_keep(criterion: str) -> Callable[[Any], float]:
    """Return the share [%] of the random cells that meet a criterion of `ledger_cells.py`."""

    def share(figures: Any) -> float:
        drawn = [row for row in figures["rows"] if isinstance(row["cell"], int)]
        return 100 * sum(criterion not in row["missed"] for row in drawn) / len(drawn)

    return share


def _of_domain(method: str, what: str) -> Callable[[Any], float]:
    return lambda f: sum(bool(row[what]) for row in f[method].values())


def _response(sigma: str, part: str) -> Callable[[Any], float]:
    return lambda f: max(
        x for name, x in f.items() if name.startswith(f"sigma {sigma}: ") and part in name
    )


LOAD, LOGS, PAPER = "The load", "A robot's log", "The paper's figures"
CONTACT, NETWORK, ANALYSIS = "Contact detection", "Over networks", "Stability and transparency"
PUBLISHED = "Published results, in simulation"
OWN, SPEED, LIVE = "Custom stations", "Computing time", "Live"
_DRIVEN_BY = ("pointer", "key", "stick")

OUTCOMES = ("right", "part", "wrong", "silent", "error")
GROUPS = ("offsets %", "mass %", "com %", "inertia %")

CLAIMS: tuple[Claim | InTests | NotShown, ...] = (
    # The paper
    Claim(
        *(PAPER, "Raw force in free motion is that of the paper's Fig. 6, 100 N"),
        *("scenario `free_motion_force`, measured at the wrist", "theory.md", "reproduce"),
        *(lambda f: f["free_force"]["peak_raw_N"], "N", 95.0, 105.0),
    ),
    Claim(
        *(PAPER, "With σ = 0.5 half of the load's force is displayed"),
        *("the same, ratio of forces to the master", "theory.md", "reproduce"),
        *(lambda f: f["free_force"]["half_ratio"], "", 0.49, 0.51),
    ),
    Claim(
        *(PAPER, "The residual after elimination is below the paper's 5 N"),
        *("largest component of the force, JR3 with its noise", "theory.md", "reproduce"),
        *(lambda f: f["free_force"]["residual_max_N"], "N", 0.0, 5.0),
    ),
    Claim(
        *(PAPER, "Without noise the residual is rounding"),
        *("ideal sensor, true load", "theory.md", "reproduce"),
        *(lambda f: f["ideal"]["residual_max_N"], "N", 0.0, 1e-9),
    ),
    Claim(
        *(PAPER, "A contact is detected that no threshold on the measured force detects (Fig. 8)"),
        *("scenario `contact_transition`; delay of the detection", "theory.md", "reproduce"),
        *(lambda f: 1e3 * (f["contact"]["detected_s"] - f["contact"]["true_s"]), "ms", 0.0, 5.0),
    ),
    InTests(
        *(PAPER, "The same seed gives the same bytes", "one machine", "running.md"),
        "tests/test_run.py::test_files_are_reproducible_for_a_seed",
    ),
    # The load
    InTests(
        *(LOAD, "One function computes single samples and records, logs and stations"),
        *("V φ and elimination, equal to the last bit", "theory.md"),
        "tests/load/test_compensation.py::test_one_sample_and_many_are_the_same_to_the_last_bit",
    ),
    Claim(
        *(
            LOAD,
            "Error of the mass, shipped identification",
            "JR3, median of 20 seeds",
            "sensor.md",
        ),
        "realistic_sensor",
        *(lambda f: f["identification"]["total"]["mass %"], "%", 0.0, 0.1),
    ),
    Claim(
        *(LOAD, "Error of the centre of mass", "the same", "sensor.md", "realistic_sensor"),
        *(lambda f: f["identification"]["total"]["com mm"], "mm", 0.0, 0.3),
    ),
    Claim(
        *(LOAD, "Error of the principal inertias", "the same", "sensor.md", "realistic_sensor"),
        *(lambda f: f["identification"]["total"]["inertia %"], "%", 0.0, 5.0),
    ),
    Claim(
        *(
            LOAD,
            "Its 95 % intervals contain the true value",
            "the same, 16 parameters",
            "sensor.md",
        ),
        "realistic_sensor",
        *(lambda f: f["identification"]["total"]["in 95 %"], "%", 90.0, 98.0),
    ),
    Claim(
        *(LOAD, "95 % intervals contain the true value, least over noise colours"),
        *("500 records, six colours, each of 16 parameters", "logs.md", "intervals"),
        *(lambda f: 100 * min(min(c["coverage"]) for c in f["colours"].values()), "%", 90.0, 98.0),
    ),
    Claim(
        *(LOAD, "A parameter that the motion does not excite is called identified"),
        *("poses, one axis, one pose; 500 records", "logs.md", "intervals"),
        lambda f: sum(n for counts in f["called identified"].values() for n in counts.values()),
        *("times", 0.0, 0.0),
    ),
    Claim(
        *(LOAD, "Bias by noisy accelerations that total least squares leaves"),
        *("JR3, 200 records of 1.5 s", "theory.md", "errors_in_variables"),
        *(lambda f: 100 * f["JR3"]["RTLS"]["bias_over_rls_max"], "%", 0.0, 10.0),
    ),
    Claim(
        *(LOAD, "False alarms of a changed load in free motion"),
        *("JR3, noisy accelerations, 500 motions", "theory.md", "load_change"),
        lambda f: 500 - f["JR3"]["free"]["highest"]["known"],
        *("of 500", 0.0, 0.0),
    ),
    # Logs
    Claim(
        *(LOGS, "95 % intervals contain the true value with noisy poses, worst kind of noise"),
        *("up to 0.2 mm / 0.4 mrad, 125 Hz to 1 kHz; 100 records each", "logs.md", "pose_noise"),
        lambda f: min(
            case[motion]["new"]["coverage_percent"]
            for name, case in f.items()
            if name not in ("runs", "seed") and "1 mm" not in name
            for motion in case
        ),
        *("%", 93.0, 97.0),
    ),
    Claim(
        *(LOGS, "Planted mistakes are named, with the line that corrects them"),
        *("30 kinds, two motions, poses, IMU, both", "logs.md", "planted_mistakes"),
        lambda f: 100 * f["total"]["named"][0] / f["total"]["named"][1],
        *("%", 95.0),
    ),
    Claim(
        *(LOGS, "The right cause of a misfit is named, and no other"),
        *("13 kinds, two motions, poses or IMU, 25 seeds", "logs.md", "planted_causes"),
        lambda f: (
            100 * f["figures"]["all"]["right"] / sum(f["figures"]["all"][x] for x in OUTCOMES)
        ),
        *("%", 95.0),
    ),
    Claim(
        *(LOGS, "Identified numbers that are wrong by 4 deviations and 2 % of their scale"),
        *("the same", "logs.md", "planted_causes"),
        *(lambda f: f["figures"]["all"]["false"], "", 0.0, 0.0),
    ),
    Claim(
        *(LOGS, "95 % intervals beside a cause contain the true value, worst group of parameters"),
        *("the same; offsets, mass, centre of mass, inertia", "logs.md", "planted_causes"),
        lambda f: max((f["figures"]["all"][x] for x in GROUPS), key=lambda x: abs(x - 95.0)),
        *("%", 93.0, 97.0),
    ),
    Claim(
        *(LOGS, "Causes named in good records"),
        *("three motions, poses or IMU, 600 records", "logs.md", "planted_causes_good"),
        lambda f: sum(f["figures"]["all"][x] for x in OUTCOMES[1:]),
        *("", 0.0, 0.0),
    ),
    Claim(
        *(LOGS, "Two commands lead from a file to the mass and the contact force"),
        "18 formats; largest error of the mass, after the words of YAML that the page states",
        *("log-description.md", "formats"),
        lambda f: max(abs(row.get("mass_error_%", math.inf)) for row in f["rows"]),
        *("%", 0.0, 1.0),
    ),
    Claim(
        *(LOGS, "and a contact force close to the sensor's noise"),
        *("the same; largest rms error over the noise of a channel", "log-description.md"),
        *("formats", lambda f: max(row["contact_rms_N"] for row in f["rows"]) / 0.08, "", 0.0, 1.2),
    ),
    Claim(
        *(LOGS, "Planted faults of episodes of a dataset are named"),
        *("20 kinds, 10 tools of 0.5 to 2 kg, 30 and 50 fps", "robot-learning.md", "dataset"),
        *(lambda f: min(f[x]["named_percent"] for x in FAST_EPISODES), "%", 95.0),
    ),
    Claim(
        *(LOGS, "Findings in clean episodes of a dataset"),
        *("the same, and 10 and 15 fps; 400 episodes", "robot-learning.md", "dataset"),
        *(lambda f: sum(x["false"] for x in f["cells"]), "", 0.0, 0.0),
    ),
    Claim(
        *(LOGS, "Residual force and torque of a dataset in free motion"),
        *("largest of 10 tools, 30 and 50 fps", "robot-learning.md", "dataset"),
        lambda f: max(f[x]["largest_residual_of_noise"] for x in FAST_EPISODES),
        *("times the sensor's noise", 0.0, 1.2),
    ),
    Claim(
        *(LOGS, "F1 of contact in a dataset, smallest"),
        *("the same; contact of more than 0.5 N", "robot-learning.md", "dataset"),
        *(lambda f: min(f[x]["least_contact_f1"] for x in FAST_EPISODES), "", 0.95),
    ),
    Claim(
        *(LOGS, "CPU time of a dataset of a million frames"),
        *("1,000 episodes at 30 fps, load identified", "robot-learning.md", "dataset_long"),
        *(lambda f: f["long"]["cpu_s"], "s", 0.0, 60.0),
    ),
    Claim(
        *(LOGS, "and its largest memory"),
        *("the same", "robot-learning.md", "dataset_long"),
        *(lambda f: f["long"]["peak_GB"], "GB", 0.0, 1.0),
    ),
    Claim(
        *(LOGS, "A dataset whose command was killed six times has the same bytes"),
        *("100 episodes; copies compared (1: equal)", "robot-learning.md", "dataset_long"),
        *(lambda f: f["killed"]["same_bytes"] * (f["killed"]["kills"] == 6), "", 1.0, 1.0),
    ),
    Claim(
        *(LOGS, "Planted faults that `dataset` names beside four published checkers"),
        "20 kinds, 30 fps; they report none, except three outliers",
        *("robot-learning.md", "dataset_checkers", lambda f: f["named_by_ours"], "", 19.0, 20.0),
    ),
    Claim(
        *(LOGS, "The most that one of the checkers reports of them"),
        *("robovet, lerobot-doctor, rdq, kalanos", "robot-learning.md", "dataset_checkers"),
        *(lambda f: max(f["named"].values()), "of 20"),
    ),
    Claim(
        *(LOGS, "The checkers judge the copies with our columns like the input"),
        *("21 datasets, each checker", "robot-learning.md", "dataset_checkers"),
        *(lambda f: min(f["same_verdict"].values()), "", 21.0, 21.0),
    ),
    Claim(
        *(LOGS, "Error of the mass after ten seconds of motion"),
        *("simulated arm, median of 30 loads", "logs.md", "peers"),
        *(lambda f: f["ours.mass_%"], "%", 0.0, 0.1),
    ),
    Claim(
        *(LOGS, "Error of plain least squares on the same log"),
        *("the same; our error is the bound", "logs.md", "peers"),
        *(lambda f: f["least squares.mass_%"] / f["ours.mass_%"], "times ours", 1.0),
    ),
    Claim(
        *(LOGS, "Error of force_torque_tools from static poses of the same duration"),
        *("the same; rest contains no inertia", "logs.md", "peers"),
        *(lambda f: f["kth.mass_%"] / f["ours.mass_%"], "times ours", 1.0),
    ),
    Claim(
        *(LOGS, "Error of its centre of mass, compared with `identify` on the same poses"),
        *("the same; from ten seconds of motion ours is 1.3 times theirs", "logs.md", "peers"),
        *(lambda f: f["kth.com_mm"] / f["ours at rest.com_mm"], "times ours", 0.999),
    ),
    Claim(
        *(LOGS, "Torque residual of that load in fast motion"),
        *("held-out motion, 30 Hz", "logs.md", "peers"),
        *(lambda f: f["kth.left_N_m"] / f["ours.left_N_m"], "times ours", 1.0),
    ),
    # Publications: their claim, and the figure of the simulation
    Claim(
        *(PUBLISHED, "Recursive least squares of gravity and bias removes over 95 % of the force"),
        *("arXiv 2604.23696; slow motion, median of 5 loads", "logs.md", "peers_rls"),
        *(lambda f: f["rls slow.removed_force_%"], "%", 95.0),
    ),
    Claim(
        *(PUBLISHED, "and over 91 % of the torque"),
        *("arXiv 2604.23696; the same", "logs.md", "peers_rls"),
        *(lambda f: f["rls slow.removed_torque_%"], "%", 91.0),
    ),
    Claim(
        *(PUBLISHED, "ours removes more of the torque of fast motion than it does"),
        *("no published figure; both in a hand's motion", "logs.md", "peers_rls"),
        *(lambda f: f["ours fast.removed_torque_%"] - f["rls fast.removed_torque_%"], "%", 0.0),
    ),
    Claim(
        *(PUBLISHED, "A delay of 25 ms makes a mass feel 10 % heavier: an admittance device"),
        *(
            "source only as a damaged copy, 6 kg; effort over speed, constant push of 0.3 s",
            "delay.md",
        ),
        *("literature", lambda f: f["mass"]["admittance_constant_25_ms_%"], "%", 7.0, 13.0),
    ),
    Claim(
        *(PUBLISHED, "and 50 ms 20 % heavier"),
        *("the same", "delay.md", "literature"),
        *(lambda f: f["mass"]["admittance_constant_50_ms_%"], "%", 15.0, 25.0),
    ),
    Claim(
        *(PUBLISHED, "the same 50 ms in a push that swells and fades"),
        *("half a sine of 0.3 s", "delay.md", "literature"),
        *(lambda f: f["mass"]["admittance_half_sine_50_ms_%"], "%", 15.0, 25.0),
    ),
    Claim(
        *(PUBLISHED, "the same 25 ms and the tool of the station, whose inertia is a force"),
        *("paper's station, σ = 1; no such publication", "delay.md", "literature"),
        *(lambda f: f["mass"]["station_constant_25_ms_%"], "%", 7.0, 13.0),
    ),
    Claim(
        *(
            PUBLISHED,
            "Inertial sensors notice a contact up to 50 % sooner than a momentum observer",
        ),
        *("arXiv 2505.08334; here wrist sensor, and observer with the true model", "detection.md"),
        *("literature", lambda f: f["detection"]["sooner_%"], "%", 0.0, 50.0),
    ),
    Claim(
        *(PUBLISHED, "within 3 to 39 ms"),
        *("arXiv 2505.08334; `contact_transition`", "detection.md", "literature"),
        *(lambda f: f["detection"]["ours_ms"], "ms", 0.0, 39.0),
    ),
    Claim(
        *(PUBLISHED, "Position errors grow with delay more than with loss"),
        *("T-RO 25(6), 2009; growth by 8 to 1088 ms over growth by 50 % loss", "delay.md"),
        *(
            "literature",
            lambda f: (
                f["architectures"]["position_by_delay"] / f["architectures"]["position_by_loss"]
            ),
            "",
            1.0,
        ),
    ),
    Claim(
        *(PUBLISHED, "No architecture is best over all channels"),
        *("the same; methods that are best in one of 15 cells", "delay.md", "literature"),
        *(lambda f: f["architectures"]["best_methods"], "", 2.0),
    ),
    Claim(
        *(PUBLISHED, "100 ms raise the largest force of an insertion"),
        *("Robotics 14(3) 34, 2025; `insert` with `ledger`, over that without", "delay.md"),
        *("literature_peg", lambda f: f["peg"]["force_ratio"], "", 1.0),
    ),
    Claim(
        *(PUBLISHED, "and not its completion time"),
        *("the same; time over that without", "delay.md", "literature_peg"),
        *(lambda f: f["peg"]["time_ratio"], "", 0.0, 1.1),
    ),
    Claim(
        *(ANALYSIS, "The best sigma_weight does not move if accelerated masses count as half"),
        *("simulated operator, 40 swings; smallest noticed force, difference", "choose.md"),
        *(
            "half_mass",
            lambda f: abs(f["best"]["by half"]["smallest_N"] - f["best"]["fully"]["smallest_N"]),
            *("N", 0.0, 0.05),
        ),
    ),
    # Tuning
    Claim(
        *(ANALYSIS, "A tuned station holds every draw in the stated set"),
        *("20 random stations, 500 draws, one axis: share of stations", "choose.md", "tuning"),
        *(lambda f: f["all_inside_in_axis"] / f["tuned"], "", 1.0),
    ),
    Claim(
        *(ANALYSIS, "and in the whole station"),
        *("the same, 4 draws: share of stations", "choose.md", "tuning"),
        *(lambda f: f["all_inside"] / f["tuned"], "", 1.0),
    ),
    Claim(
        *(ANALYSIS, "It fails with γ 20 % beyond the margin at the stiffest wall"),
        *("the same, whole station, all grips: share of stations", "choose.md", "tuning"),
        *(lambda f: f["outside_fails"] / f["tuned"], "", 0.9),
    ),
    Claim(
        *(ANALYSIS, "Draws beyond the set fail where `tune` states a failure, and else hold"),
        *("the same, 4 draws of other seeds: share of stations", "choose.md", "tuning"),
        *(lambda f: f["beyond_as_stated"] / f["tuned"], "", 0.9),
    ),
    Claim(
        *(ANALYSIS, "It detects smaller contact forces than the advice, or the advice fails"),
        *("the same, against `ledger` with γ = 1 and σ = 0: share of stations", "choose.md"),
        *("tuning", lambda f: f["better_than_advice"] / f["tuned"], "", 0.75),
    ),
    Claim(
        *(ANALYSIS, "and is never worse in both detected and rendered force"),
        *("the same: stations that are", "choose.md"),
        *("tuning", lambda f: f["worse_than_advice"], "", 0.0, 0.0),
    ),
    Claim(
        *(ANALYSIS, "The search takes three minutes on two cores"),
        *("the same, CPU time of the longest", "choose.md", "tuning"),
        *(lambda f: f["longest_cpu_s"], "s", 0.0, 360.0),
    ),
    # Contact
    Claim(
        *(CONTACT, "Contacts of 0.2 to 1 N are detected in fast free motion"),
        *("one false alarm in 100 windows of 0.3 s", "detection.md", "contact_detection"),
        lambda f: (
            100
            * _rows(f["table"], "0.2 to 1 N", wrench="eliminated", statistic="glr")[0]["noticed"]
        ),
        *("%", 95.0),
    ),
    Claim(
        *(CONTACT, "A threshold on the measured force detects fewer of them"),
        *("the same windows", "detection.md", "contact_detection"),
        lambda f: (
            100 * _rows(f["table"], "0.2 to 1 N", wrench="raw", statistic="level")[0]["noticed"]
        ),
        *("%", 0.0, 10.0),
    ),
    # Networks
    Claim(
        *(NETWORK, "`ledger` creates no energy at the slave's actual motion"),
        *("one axis, reserve 0.12 J, 10⁴ adversarial runs with search", "delay.md", "adversary"),
        *(lambda f: f["ledger"]["searched"]["actual"], "J", -1e-6),
    ),
    Claim(
        *(
            NETWORK,
            "`ledger` creates none without a reserve and with an inexact servo",
        ),
        *("the same, charged by drag, servo ±20 %, 3 ms lag, encoder, noise", "delay.md"),
        *("adversary_drag", lambda f: f["ledger"]["searched"]["actual"], "J", -1e-6),
    ),
    Claim(
        *(NETWORK, "`pspm` creates none with the configured servo"),
        *("one axis, 100 runs with search", "delay.md", "adversary_methods"),
        *(lambda f: f["pspm"]["searched"]["actual"], "J", -1e-6),
    ),
    Claim(
        *(NETWORK, "Without a method the energy has no bound"),
        *("the same adversary", "delay.md", "adversary_methods"),
        *(lambda f: f["none"]["searched"]["actual"], "J", -math.inf, -1.0),
    ),
    Claim(
        *(NETWORK, "`ledger` is at rest on walls, with every grip"),
        *("3 grips, 0.5 to 50 kN/m, 1 to 2600 ms: 162 holds, one axis", "delay.md", "domain"),
        *(_of_domain("ledger", "stable"), "of 162", 155.0),
    ),
    Claim(
        *(NETWORK, "and displays the contact force"),
        *("within 1 % and quiet, the same holds", "delay.md", "domain"),
        *(_of_domain("ledger", "good"), "of 162", 155.0),
    ),
    Claim(
        *(NETWORK, "and displays it soon, within 10 %"),
        *("two round trips and 0.5 s after the hand has pressed, the same", "delay.md", "domain"),
        *(_of_domain("ledger", "prompt"), "of 162", 155.0),
    ),
    Claim(
        *(NETWORK, "Every method recovers after the network has recovered"),
        *("300 random networks, one axis, all methods", "delay.md", "recovery"),
        lambda f: 100 * min(row["recovered"] / row["runs"] for row in f["rows"]),
        *("%", 100.0, 100.0),
    ),
    Claim(
        *(NETWORK, "The whole station with `ledger` is at rest on a leaf"),
        *("4 networks, 2 leaves, 3 grips, σ 0 and 1; noisy JR3", "delay.md", "ledger_in_station"),
        *(lambda f: f["cells"] - f["missed"]["stable"], "of 48", 48.0),
    ),
    Claim(
        *(NETWORK, "It displays the contact force within 10 %"),
        *("the same holds", "delay.md", "ledger_in_station"),
        *(lambda f: f["cells"] - f["missed"]["felt"], "of 48", 47.0),
    ),
    Claim(
        *(NETWORK, "and creates no energy at hand and actual motion"),
        *("least of translation and rotation, the same runs", "delay.md", "ledger_in_station"),
        *(lambda f: min(min(row["energy_J"]) for row in f["rows"]), "J", -1e-6),
    ),
    Claim(
        *(NETWORK, "It is at rest with friction in the arm and a damped leaf"),
        *("30 N at the tool, 300 N s/m; 12 holds over `lan`", "delay.md", "ledger_with_friction"),
        *(lambda f: f["cells"] - f["missed"]["stable"], "of 12", 11.0),
    ),
    Claim(
        *(NETWORK, "and meets all criteria, force steady within 0.05 N, with a medium grip"),
        *("`lan`, 2 leaves, σ 0 and 1", "delay.md", "ledger_with_friction"),
        *(lambda f: sum(map(_well_by_medium_grip, f["rows"])), "of 4", 4.0),
    ),
    Claim(
        *(NETWORK, "`ledger` creates no energy on slanted walls with friction"),
        *("200 random cells of the station, seed 54", "delay.md", "ledger_cells"),
        *(_cells_that_keep("energy"), "%", 100.0),
    ),
    Claim(
        *(NETWORK, "Random cells at rest"),
        *("the same cells", "delay.md", "ledger_cells"),
        *(_cells_that_keep("rest"), "%", 97.5),
    ),
    Claim(
        *(NETWORK, "Random cells that render the contact force within 10 %"),
        *("the same cells", "delay.md", "ledger_cells"),
        *(_cells_that_keep("vector"), "%", 95.0),
    ),
    Claim(
        *(NETWORK, "Random cells with at most 0.05 N rms above 5 Hz"),
        *("the same cells", "delay.md", "ledger_cells"),
        *(_cells_that_keep("quiet"), "%", 97.5),
    ),
    Claim(
        *(NETWORK, "Random cells with a let go below 0.3 m/s and 50 mm"),
        *("the same cells", "delay.md", "ledger_cells"),
        *(_cells_that_keep("let go"), "%", 100.0),
    ),
    NotShown(NETWORK, "Use by a person", "no person has tried it; the hand is simulated"),
    # Analysis
    Claim(
        *(
            ANALYSIS,
            "The linearised Diagram predicts the hand's force over its velocity, to within",
        ),
        *("σ = 0.5, 0.5 to 30 Hz, without Coulomb friction", "analysis.md", "frequency_response"),
        *(_response("0.5", "hand_force / hand_velocity, magnitude"), "%", 0.0, 1.0),
    ),
    Claim(
        *(ANALYSIS, "The apparent mass is σ m: for 0.5 of 3.13 kg"),
        *("the same multi-sine", "analysis.md", "frequency_response"),
        *(lambda f: f["sigma 0.5: apparent mass, kg"], "kg", 1.5337, 1.5963),
    ),
    Claim(
        *(ANALYSIS, "Delay margins differ from simulated stability limits by at most"),
        *("one axis, sampled; 12 walls and grips; round trip", "analysis.md", "analysis"),
        lambda f: (
            max(
                abs(row["sampled"] - row["simulated"])
                for row in f["margins"]
                if math.isfinite(row["sampled"]) and math.isfinite(row["simulated"])
            )
            * 1e3
        ),
        *("ms", 0.0, 1.0),
    ),
    Claim(
        *(ANALYSIS, "The one-axis model differs from the Diagram on other arms and devices by"),
        *("Panda and omega.6, UR5 and Touch, RX90; to 20 Hz", "analysis.md", "foreign_analysis"),
        lambda f: max(max(station["from the sampled axis, %"].values()) for station in f.values()),
        *("%", 0.0, 1.0),
    ),
    # Custom stations
    Claim(
        *(OWN, "Difference of the sensor's force from the plant's reaction port"),
        *("ideal sensor, all arms and devices, free and in contact", "station.md", "stations"),
        *(lambda f: max(_rows(f, "port_N")), "N", 0.0, 1e-12),
    ),
    Claim(
        *(OWN, "Difference from the force of MuJoCo, which reads the same URDF"),
        *("Panda and UR5, free motion, ideal sensor, MuJoCo 4.0.0", "station.md", "mujoco_wrench"),
        *(lambda f: max(f[arm]["force_off_N"] for arm in ("panda", "ur5")), "N", 0.0, 1e-9),
    ),
    Claim(
        *(OWN, "and of the torque"),
        *("the same", "station.md", "mujoco_wrench"),
        *(lambda f: max(f[arm]["torque_off_Nm"] for arm in ("panda", "ur5")), "N m", 0.0, 1e-9),
    ),
    Claim(
        *(OWN, "Error of the identified mass of such a station"),
        *("the same stations, from the samples of their sensor", "station.md", "stations"),
        *(lambda f: max(_rows(f, "mass_error_percent")), "%", 0.0, 0.1),
    ),
    Claim(
        *(OWN, "Residual of the elimination, of the peak measured force"),
        *("the same, free motion", "station.md", "stations"),
        *(lambda f: max(_rows(f, "left_percent", surroundings="free motion")), "%", 0.0, 1.5),
    ),
    Claim(
        *(OWN, "Displayed apparent mass differs from σ m / scale by"),
        *("the same, σ = 0.5", "station.md", "stations"),
        *(lambda f: max(_rows(f, "felt_error_percent")), "%", 0.0, 2.0),
    ),
    Claim(
        *(OWN, "Poses without a solution of the numeric inverse kinematics, reported"),
        *("10⁵ random poses of each of six arms", "station.md", "inverse_kinematics"),
        lambda f: max(
            arm["random"]["poses"] - arm["random"]["statuses"]["OK"] for arm in f.values()
        ),
        *("of 10⁵", 0.0, 10.0),
    ),
    Claim(
        *(OWN, "Error of the reported solutions"),
        *("largest error in position, the same poses", "station.md", "inverse_kinematics"),
        *(lambda f: max(arm["random"]["worst_m"] for arm in f.values()), "m", 0.0, 1e-8),
    ),
    Claim(
        *(OWN, "Difference from the closed form where one exists"),
        *("RX90, 2·10⁴ poses, same branch", "station.md", "inverse_kinematics"),
        *(lambda f: f["rx90"]["closed_form"]["largest_difference_rad"], "rad", 0.0, 1e-9),
    ),
    Claim(
        *(SPEED, "Time of a step of the numeric inverse kinematics, from Python"),
        *("following a motion, slowest of six arms", "station.md", "inverse_kinematics"),
        *(lambda f: max(arm["follow"]["median_us"] for arm in f.values()), "µs", 0.0, 30.0),
    ),
    # Cost
    Claim(
        *(SPEED, "Cost of the station over its bare plant"),
        *("free motion, CPU time", "station.md", "station"),
        *(lambda f: f["free_motion_over_bare"], "times", 0.0, 2.0),
    ),
    Claim(
        *(SPEED, "and in a contact"),
        *("`contact_transition`", "station.md", "station"),
        *(lambda f: f["contact_over_bare"], "times", 0.0, 3.0),
    ),
    Claim(
        *(SPEED, "Time of a sensor reading; its period is 125 µs"),
        *("the slowest preset, compiled", "sensor.md", "calls"),
        lambda f: 1e6 * max(v["seconds"] for k, v in f.items() if k.startswith("reading of")),
        *("µs", 0.0, 2.5),
    ),
    Claim(
        *(SPEED, "V φ of one sample from Python: time of pinocchio over ours"),
        *("the same wrench to 1e-9", "theory.md", "identification"),
        *(lambda f: f["wrench_pin_inertia_over_call"], "times", 1.0),
    ),
    # Live
    Claim(
        *(LIVE, "`compensate` keeps up with 1 kHz"),
        *("UDP from another process; 99 % of packets", "robot.md", "compensate"),
        *(lambda f: f["ours.1000_Hz.processing_p99_us"], "µs", 0.0, 1000.0),
    ),
    Claim(
        *(LIVE, "and its share of a core"),
        *("the same", "robot.md", "compensate"),
        *(lambda f: 100 * f["ours.1000_Hz.core"], "%", 0.0, 25.0),
    ),
    Claim(
        *(LIVE, "`calibrate` calls a wrong number identified"),
        *("100 loads by hand, and by `excite`'s motion; right gains", "robot.md", "calibrate"),
        lambda f: f["hand.wrong_at_the_end"] + f["excite.wrong_at_the_end"],
        *("numbers", 0.0, 0.0),
    ),
    Claim(
        *(LIVE, "Its 95 % intervals contain the true value when it stops, at least"),
        *("each number, the same loads", "robot.md", "calibrate"),
        lambda f: 100 * min(f["hand.coverage_least"], f["excite.coverage_least"]),
        *("%", 90.0, 98.0),
    ),
    Claim(
        *(LIVE, "Median time until mass and centre of mass are identified"),
        *("by hand, 0.5 % and 0.5 mm", "robot.md", "calibrate"),
        *(lambda f: f["hand.median_s"], "s", 0.0, 5.0),
    ),
    Claim(
        *(LIVE, "`calibrate` calls a wrong number identified, from a robot's poses"),
        *("50 loads by hand, 0.1 mm and 0.2 mrad; right gains", "robot.md", "calibrate_poses"),
        *(lambda f: f["poses.false_known"], "numbers", 0.0, 0.0),
    ),
    Claim(
        *(SPEED, "CPU time that a study in shards takes beyond one process"),
        *("8 shards, 3 killed and submitted again, a merge; 20 minutes", "cluster.md"),
        *("study_shards", lambda f: 100.0 * f["overhead_with_kills"], "%", -10.0, 2.0),
    ),
    Claim(
        *(
            LIVE,
            "Calibrations from ROS 2 topics with every true number inside its 99.98 % interval",
        ),
        *("50 hand-moved loads, nodes in other processes, 200 Hz", "robot.md", "ros2"),
        *(lambda f: f["calibrations.inside_all_intervals"], "of 50", 50.0, 50.0),
    ),
    Claim(
        *(LIVE, "Processing of a reading between ROS 2 topics, 99th percentile"),
        *("500 Hz, time of the thread, poses included", "robot.md", "ros2"),
        *(lambda f: f["processing_thread_p99_ms"], "ms", 0.0, 1.0),
    ),
    Claim(
        *(LIVE, "Numbers in which `compensate replay:LOG` differs from `eliminate --causal`"),
        *("all logs of the repository, in chunks of any size", "robot.md", "replayed"),
        *(lambda f: f["different"], "numbers", 0.0, 0.0),
    ),
    Claim(
        *(LIVE, "Readings in which the exported C code differs from `compensate` in any bit"),
        "10⁶, some invalid; gcc, clang, gcc for aarch64 in qemu, -O0 to -O3 and -Os, without fused"
        " multiply-add; WebAssembly in node",
        *("controller.md", "kernel"),
        lambda f: sum(v for k, v in f.items() if k.endswith(".different") and "fused" not in k),
        *("readings", 0.0, 0.0),
    ),
    Claim(
        *(LIVE, "Size of its object file"),
        *("gcc, x86-64, -Os; code and constants", "controller.md", "kernel"),
        *(lambda f: f["gcc.-Os.bytes"], "bytes", 0.0, 4096.0),
    ),
    Claim(
        *(LIVE, "Its time for a reading over that of the compiled Python kernel"),
        *("gcc, x86-64, -O2; both in a compiled loop", "controller.md", "kernel"),
        *(lambda f: f["gcc.-O2.ns"] / f["python.ns"], "times", 0.0, 1.5),
    ),
    InTests(
        *(LIVE, "FMUs of FMI 2.0 and 3.0 have the bits of `compensate`, one step later"),
        *("FMPy validates and simulates both", "controller.md"),
        "tests/robots/test_fmu.py::"
        "test_fmpy_validates_and_simulates_the_bits_of_compensate_one_step_later",
    ),
    InTests(
        *(LIVE, "The page of the site has the numbers of `eliminate --causal`"),
        *("the sample log, headless Chromium", "browser.md"),
        "tests/robots/test_browser_kernel.py::test_the_sample_log_has_the_numbers_of_eliminate",
    ),
    Claim(
        *(LIVE, "Residual force in NTNU's vibrations, live, without its mean"),
        *("30 Hz; zero-phase 0.316 N", "robot.md", "replayed"),
        *(lambda f: f["2-vibrations.own.live_N"], "N", 0.0, 0.35),
    ),
    Claim(
        *(LIVE, "Duration of `excite --until`, over the shortest of 20 seeds"),
        *("the station's arm, 0.1 %, 0.1 mm, 1 %", "robot.md", "shortest"),
        *(lambda f: f["longest_over_shortest"], "times", 0.0, 1.1),
    ),
    Claim(
        *(LIVE, "and its motion reaches the requested accuracy in"),
        *("50 simulated records", "robot.md", "shortest"),
        *(lambda f: 100 * f["reached"], "%", 93.0),
    ),
    Claim(
        *(LIVE, "Real-time factor of a drive"),
        *("60 s, sensor at 8 kHz, 60 frames/s", "live.md", "live"),
        *(lambda f: f["factor"], "", 0.999),
    ),
    Claim(
        *(LIVE, "and its share of a core"),
        *("60 s, sensor at 8 kHz, 60 frames/s", "live.md", "live"),
        *(lambda f: f["core_share"], "", 0.0, 0.6),
    ),
    Claim(
        *(LIVE, "CPU time of 99 % of the slices of 5 ms"),
        *("each method on each network", "live.md", "live_slices"),
        *(lambda f: max(f[name] for name in f if name.endswith("_p99_ms")), "ms", 0.0, 5.0),
    ),
    Claim(
        *(LIVE, "Numbers that differ when a drive with every change is repeated"),
        *("60 s, all inputs, slices of 1, 7, 1000 ms", "live.md", "repeated"),
        *(lambda f: sum(f[f"differ_{k}_ms"] for k in (1, 7, 1000)), "numbers", 0.0, 0.0),
    ),
    Claim(
        *(LIVE, "Median time until the page shows the input of pointer, key and stick"),
        *("idle machine, drawing off", "live.md", "live_page"),
        *(lambda f: max(f[f"{name}_p50_ms"] for name in _DRIVEN_BY), "ms", 0.0, 30.0),
    ),
    Claim(
        *(LIVE, "and 95th percentile"),
        *("idle machine, drawing off", "live.md", "live_page"),
        *(lambda f: max(f[f"{name}_p95_ms"] for name in _DRIVEN_BY), "ms", 0.0, 60.0),
    ),
    Claim(
        *(LIVE, "95th percentile of the time from a contact of 0.5 N to the gamepad's vibration"),
        *("idle machine, drawing off", "live.md", "live_page"),
        *(lambda f: f["vibration_p95_ms"], "ms", 0.0, 20.0),
    ),
    Claim(
        *(LIVE, "Motion of the arm when network and method change under a pressing tool"),
        *("each method on each network, and back", "live.md", "live_changes"),
        *(lambda f: max(f[name] for name in f if name.endswith("arm_moves_mm")), "mm", 0.0, 1.0),
    ),
    NotShown(
        LIVE, "`compensate` on a robot", "its sources were tried with recordings and mock peers"
    ),
    NotShown(
        LIVE, "A haptic device in the loop", "only a virtual device in another process was tried"
    ),
)
