"""Random cells of the whole station with `ledger`: slanted walls, friction, edges, letting go.

`python benchmarks/ledger_cells.py --cells N --seed S [--jobs J] [--json FILE] [--method M ...]`
draws cell i from (S, i). FILE keeps finished cells, so an interrupted run continues. The hand
presses
on a wall, rubs and rests, or taps; it rests, retracts, presses again and lets go.

Criteria of each cell:

energy    hand and actual motion, plus E_0: at least -1e-6 J, for translation and rotation each
rest      in the last second of the hold, hand and slave move by at most 0.5 mm peak to peak
vector    mean rendered force without the load's weight, against the scaled contact force: within
          10 % (0.05 N at least), from 1 s and two round trips after the hand's intent rests
quiet     rendered force above 5 Hz in the same second: at most 0.05 N rms
let go    along the contact force: at most 0.3 m/s, and 50 mm within 2 s
left      slave and hand differ by at most 5 mm, 2 s and two round trips after the retreat
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
import tempfile
import time
from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from inverse_kinematics import described
from joblib import Parallel, delayed
from numpy.typing import NDArray

from drake_teleop.common.files import models_dir
from drake_teleop.lab.comparison.compare_passivity import base_scenario
from drake_teleop.lab.comparison.one_dof import AT_HAND, AT_SLAVE
from drake_teleop.lab.comparison.whole_station import (
    start_energy,
    station_energies,
    work_of_displayed_load_wrench,
)
from drake_teleop.lab.identification import slave_arm, true_load
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.channel.network import PRESETS, mean_delay
from drake_teleop.station.environment.solids import Box, Surface, Wall
from drake_teleop.station.master.data_sheets import FIGURES, Master
from drake_teleop.station.operator.operator import (
    GRIP_IMPEDANCES,
    MinimumJerk,
    OperatorConfig,
    Sine,
)
from drake_teleop.station.oscillation import high_pass_above_5_hz
from drake_teleop.station.passivity.methods import METHODS, PassivityConfig
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import Scenario, replace
from drake_teleop.station.simulation import (
    MakeSimulator,
    advance_without_garbage_collection,
    read_recorded_signals,
)
from drake_teleop.station.slave.arm import forward_kinematics
from drake_teleop.station.slave.plant import NominalSlave
from drake_teleop.station.slave.slave_config import Ball, Slave, Tool
from drake_teleop.station.station import MakeTeleopStation

Array = NDArray[np.float64]

NETWORKS = ("lan", "wan", "internet", "geostationary", "lunar", "lossy trace")
DEVICES = ("phantom_premium_15", "geomagic_touch", "omega_6")
ACTIONS, SHAPES = ("press", "rub", "taps"), ("wall", "wall", "wall", "edge", "corner")
#: Arm -> file, S, start [m], mass of the tool [kg] and largest contact force [N].
ARMS: dict[str, tuple[str, str, list[float], float, float]] = {
    "rx90": ("", "sensor", [0.55, 0.0, 0.45], 0.0, 350.0),
    "panda": ("panda_description/urdf/panda.urdf", "panda_link8", [0.5, 0.0, 0.45], 1.5, 60.0),
    "xarm7": ("xarm_description/urdf/xarm7.urdf", "link7", [0.35, 0.0, 0.35], 1.0, 40.0),
}
SETTLE, GAP, MOVE, HELD = 0.5, 0.012, 0.8, 1.0  # s, m, s, s
BALL_STIFFNESS, BALL_RADIUS, PEAK_SHARE, MAX_DEPTH = 4e5, 0.012, 0.8, 0.02  # N/m, m, 1, m
ENERGY, REST, VECTOR, LEAST_FORCE, QUIET = -1e-6, 5e-4, 0.1, 0.05, 0.05  # J, m, 1, N, N
SPEED, TRAVEL, LEFT = 0.3, 0.05, 5e-3  # m/s, m, m
CRITERIA = ("energy", "rest", "vector", "quiet", "let go", "left")


@dataclasses.dataclass(frozen=True)
class Drawn:
    """Conditions of a cell; angles [rad], stiffness [N/m], force of the press at the hand [N]."""

    arm: str
    device: str
    network: str
    shape: str
    tilt: float
    azimuth: float
    friction: float
    stiffness: float
    action: str
    force: float
    grip: str
    frequency: float
    sigma: float
    gamma: float


def draw(seed: int, index: int) -> Drawn:
    """Return the conditions of cell `index`."""
    rng = np.random.default_rng([seed, index])
    choose = lambda names: names[rng.integers(len(names))]  # noqa: E731
    available = tuple(ARMS) if described() is not None else ("rx90",)
    arm = choose(available) if rng.random() < 0.6 else "rx90"
    device, network, shape = choose(DEVICES), choose(NETWORKS), choose(SHAPES)
    tilt, azimuth = math.radians(45.0) * rng.random(), 2 * math.pi * rng.random()
    friction, stiffness = 0.5 * rng.random(), 1e3 * 50.0 ** rng.random()
    action, sigma, gamma = choose(ACTIONS), choose((0.0, 0.5, 1.0)), 1.0 + 2.0 * rng.random()
    force, frequency = 20.0 ** rng.random(), 1.0 + rng.random()
    scale = gamma / 17.5
    master = Master(model=device, figures=FIGURES.get(device))
    peak = master.device(0.0, 0.0).parameters.peak_force
    force = min(force, PEAK_SHARE * peak, scale * ARMS[arm][4], scale * stiffness * MAX_DEPTH)
    grips = [name for name, hand in GRIP_IMPEDANCES.items() if force / hand.stiffness < 0.04]
    return Drawn(
        arm,
        device,
        network,
        shape,
        tilt,
        azimuth,
        friction,
        stiffness,
        action,
        float(force),
        choose(grips),
        frequency,
        sigma,
        gamma,
    )


@cache
def lossy_trace() -> str:
    """Write a trace with a queue of 60 to 160 ms and bursts of loss; return its file."""
    rng, rows = np.random.default_rng(1), 60_000
    queue, bad, lines = 0.0, False, ["time,delay"]
    for k in range(rows):
        queue += -0.005 * queue + 0.002 * rng.normal()
        bad = rng.random() > 1 / 60 if bad else rng.random() < 1 / 400
        delay = "" if bad else f"{0.06 + min(abs(queue), 0.1):.4f}"
        lines.append(f"{1e-3 * k:.3f},{delay}")
    path = Path(tempfile.mkdtemp(prefix="drake_teleop_")) / "lossy.csv"
    path.write_text("\n".join(lines) + "\n")
    return str(path)


def channel_of(network: str) -> Channel:
    """Return the channel of a name in `NETWORKS`."""
    if network in PRESETS:
        return Channel(network=network)
    return Channel(trace=lossy_trace())


@cache
def slave_of(arm: str) -> Slave:
    """Return the arm with a ball; its friction of 0.5 allows 0.5 in contact (RX90)."""
    file, frame, position, mass, _ = ARMS[arm]
    if not file:
        text = (models_dir() / "tool.sdf").read_text()
        path = Path(tempfile.mkdtemp(prefix="drake_teleop_")) / "tool.sdf"
        for name in ("mu_dynamic", "mu_static"):
            text = text.replace(f"<drake:{name}>0.2<", f"<drake:{name}>0.5<")
        path.write_text(text)
        return Slave(tool=Tool(model=str(path)))
    tool = Tool(mass=mass, com=[0.01, 0.0, 0.06], shapes=[Ball(BALL_RADIUS, [0.0, 0.0, 0.188])])
    model = str(described() / file)
    return Slave(model=model, sensor_frame=frame, position=position, tool=tool)


def surface(drawn: Drawn) -> dict[str, float]:
    """Return the surface whose contact with the ball has the drawn stiffness and friction."""
    own = 0.5 if drawn.arm == "rx90" else 0.2
    friction = min(drawn.friction * own / max(2 * own - drawn.friction, 1e-9), 2.0)
    stiffness = drawn.stiffness * BALL_STIFFNESS / (BALL_STIFFNESS - drawn.stiffness)
    return {"stiffness": stiffness, "friction": friction}


@dataclasses.dataclass(frozen=True)
class Times:
    """Times of the task after settling [s]."""

    press: float
    act: float
    rest: float
    judged: float
    retreat: float
    left: float
    again: float
    let_go: float
    end: float


def times_of(drawn: Drawn, round_trip: float) -> Times:
    """Return the times of a cell."""
    press = 0.3 + round_trip
    act = press + MOVE
    rest = act + {"press": 0.0, "rub": 2.0, "taps": 3.0 + MOVE}[drawn.action]
    judged = rest + 1.0 + 2 * round_trip
    retreat = judged + HELD
    left = retreat + MOVE + 2.0 + 2 * round_trip
    again = left + 0.1
    let_go = again + MOVE + 1.0 + round_trip
    return Times(press, act, rest, judged, retreat, left, again, let_go, let_go + 2.0 + round_trip)


def scenario_of(drawn: Drawn, seed: int) -> tuple[Scenario, Times]:
    """Return the scenario of a cell without passivity method, and its times."""
    slave, channel = slave_of(drawn.arm), channel_of(drawn.network)
    times = times_of(drawn, sum(mean_delay(line) for line in channel.networks_of_directions()))
    base = replace(base_scenario("contact_transition", seed), slave=slave, wrist_sensor__ideal=True)
    nominal = NominalSlave(slave)
    tip = nominal.p_WTip_start - [0.0, 0.0, GAP]
    beside = np.array([math.cos(drawn.azimuth), math.sin(drawn.azimuth)])
    if drawn.shape == "wall":
        normal = [*(math.sin(drawn.tilt) * beside), math.cos(drawn.tilt)]
        position = tip + BALL_RADIUS * (np.array([0.0, 0.0, 1.0]) - normal)
        thing: Any = Wall(position=position.tolist(), normal=normal, **surface(drawn))
    else:
        # The ball is beyond the edge, so that the contact force has the drawn tilt.
        offset = BALL_RADIUS * math.sin(drawn.tilt) * np.abs(beside)
        offset = offset if drawn.shape == "corner" else np.array([np.linalg.norm(offset), 0.0])
        size = np.array([0.2, 0.2, 0.1])
        centre = tip - 0.5 * size
        centre[:2] -= offset
        if drawn.shape == "edge":
            centre[1] = tip[1]
        thing = Box(position=centre.tolist(), size=size.tolist(), **surface(drawn))
    scale = drawn.gamma / 17.5
    depth = GAP + drawn.force * (
        1 / GRIP_IMPEDANCES[drawn.grip].stiffness + 1 / min(scale * drawn.stiffness, 1000.0)
    )
    moves: list[MinimumJerk | Sine] = []

    def move(start: float, vertical: float) -> None:
        moves.append(MinimumJerk(SETTLE + start, MOVE, [0.0, 0.0, vertical]))

    if drawn.action == "taps":
        move(times.press, -GAP)
        moves.append(
            Sine(SETTLE + times.act, 3.0, 0.3, drawn.frequency, translation=[0.0, 0.0, 0.012])
        )
        move(times.rest - MOVE, GAP - depth)
    else:
        move(times.press, -depth)
    if drawn.action == "rub":
        reach = 0.008 if drawn.shape == "wall" else 0.002
        moves.append(
            Sine(SETTLE + times.act, 2.0, 0.4, 1.0, translation=[*(reach * beside[::-1]), 0.0])
        )
    move(times.retreat, depth)
    move(times.again, -depth)
    scenario = replace(
        base,
        simulation=dataclasses.replace(base.simulation, settle=SETTLE, duration=times.end),
        operator=OperatorConfig(grip=drawn.grip, intent=moves),
        master=Master(model=drawn.device, figures=FIGURES.get(drawn.device)),
        channel=channel,
        environment=[thing],
        force_scaling__sigma=drawn.sigma,
        force_scaling__gamma=drawn.gamma,
    )
    return scenario, times


def simulated(scenario: Scenario, times: Times) -> SimulationResult:
    """Run a cell; the hand lets go, so that the device is alone."""
    station = MakeTeleopStation(scenario, load_estimate=true_load(scenario))
    simulator = MakeSimulator(station, scenario.simulation)
    simulator.Initialize()
    advance_without_garbage_collection(simulator, 1e-3 * round(1e3 * (SETTLE + times.let_go)))
    master = station.GetSubsystemByName("master_side")
    master.GetSubsystemByName("operator")._impedance[:] = 0.0
    device = master.GetSubsystemByName("master_device")
    device._constants[0]["hand_mass"] = 0.0
    advance_without_garbage_collection(simulator, 1e-3 * round(1e3 * (SETTLE + times.end)))
    return read_recorded_signals(simulator, SETTLE)


def measured(result: SimulationResult, scenario: Scenario, times: Times) -> dict[str, Any]:
    """Return the figures of a cell."""
    t, scaling = result.t, scenario.force_scaling
    weight = scaling.sigma * scaling.force_scale * float(true_load(scenario)[6]) * 9.81
    rendered = result["force_to_master"][:, :3] + [0.0, 0.0, weight]
    contact = scaling.force_scale * scaling.gamma * result["true_contact_wrench_W"][:, :3]
    arm = slave_arm(scenario)
    R, slave = np.empty((3, 3)), np.empty((len(t), 3))
    for k, q in enumerate(result["slave_state"][:, : arm.num_joints]):
        forward_kinematics(arm.table, np.ascontiguousarray(q), R, slave[k])
    hand = result["pose_command"][:, 4:]
    held = (t >= times.judged) & (t < times.judged + HELD)
    pressed = contact[held].mean(axis=0)
    error = float(np.linalg.norm(rendered[held].mean(axis=0) - pressed))
    energies = station_energies(result, scenario)
    energy = energies[:, AT_HAND] + energies[:, AT_SLAVE] + start_energy(scenario)
    if scaling.sigma > 0.0:
        energy += work_of_displayed_load_wrench(result, scenario)
    at = int(np.searchsorted(t, times.let_go))
    before = contact[at - 20 : at].mean(axis=0)
    out = before / max(float(np.linalg.norm(before)), 1e-9)
    free = (hand[at : at + 2000] - hand[at]) @ out
    away = int(np.searchsorted(t, times.left))
    fast = high_pass_above_5_hz(t[held], rendered[held])
    return {
        "pressed_N": float(np.linalg.norm(pressed)),
        "energy_J": float(energy.min()),
        "motion_m": float(max(np.ptp(x[held], axis=0).max() for x in (hand, slave))),
        "error_N": error,
        "fast_N": float(np.sqrt((fast**2).sum(axis=1).mean())),
        "let_go_N": float(np.linalg.norm(before)),
        "speed_m_per_s": float(np.diff(free[::5]).max()) / 5e-3,
        "travel_m": float(free.max()),
        "left_m": float(np.linalg.norm(hand[away] - slave[away])),
    }


def missed(row: dict[str, Any]) -> list[str]:
    """Return the criteria that a cell fails."""
    allowed = max(VECTOR * row["pressed_N"], LEAST_FORCE)
    kept = (
        row["energy_J"] >= ENERGY,
        row["motion_m"] <= REST,
        row["error_N"] <= allowed,
        row["fast_N"] <= QUIET,
        row["speed_m_per_s"] <= SPEED and row["travel_m"] <= TRAVEL,
        row["left_m"] <= LEFT,
    )
    return [name for name, well in zip(CRITERIA, kept, strict=True) if not well]


def run_cell(seed: int, index: int, method: str, known: str | None, slip: float) -> dict[str, Any]:
    """Run one cell; return its conditions, figures and failed criteria."""
    Surface.slip_speed = slip  # type: ignore[method-assign, assignment]
    drawn = KNOWN[known] if known else draw(seed, index)
    scenario, times = scenario_of(drawn, seed + index)
    scenario = replace(scenario, passivity=PassivityConfig(method=method))
    began = time.process_time()
    row = {"cell": known or index, "method": method} | dataclasses.asdict(drawn)
    row |= measured(simulated(scenario, times), scenario, times)
    return row | {"missed": missed(row), "cpu_s": time.process_time() - began}


def _fault(**changes: Any) -> Drawn:
    plain = Drawn(
        arm="rx90",
        device="phantom_premium_15",
        network="internet",
        shape="wall",
        tilt=0.0,
        azimuth=0.0,
        friction=0.2,
        stiffness=1e4,
        action="press",
        force=4.0,
        grip="medium",
        frequency=1.5,
        sigma=0.0,
        gamma=1.0,
    )
    return dataclasses.replace(plain, **changes)


_SLANT = math.radians(24.0)
KNOWN = {
    "slanted, friction, rub": _fault(tilt=_SLANT, friction=0.3, action="rub"),
    "slanted, lan": _fault(tilt=_SLANT, friction=0.3, action="rub", network="lan"),
    "20 N, let go": _fault(force=19.0, grip="firm", stiffness=2e4),
    "taps, 600 ms": _fault(network="geostationary", stiffness=2e4, action="taps", frequency=2.0),
}
"""Faults that earlier searches found."""


def print_row(row: dict[str, Any]) -> None:
    """Print a cell in one line."""
    name = (
        f"{row['cell']!s:>3} {row['arm']:5} {row['device'][:7]} {row['network'][:8]:8}"
        f" {row['grip']:6} {row['shape']:6} {math.degrees(row['tilt']):2.0f}"
        f" mu {row['friction']:.2f} {1e-3 * row['stiffness']:4.1f}k {row['action']:5}"
        f" s {row['sigma']:g} g {row['gamma']:.1f}"
    )
    print(
        f"{name}|{row['pressed_N']:6.2f} N|{row['energy_J']:8.4f}|{1e3 * row['motion_m']:7.2f}"
        f"|{100 * row['error_N'] / max(row['pressed_N'], 0.5):6.1f} %|{row['fast_N']:6.3f}"
        f"|{row['let_go_N']:5.1f} N {row['speed_m_per_s']:5.2f} {1e3 * row['travel_m']:4.0f}"
        f"|{1e3 * row['left_m']:6.2f}|{row['cpu_s']:4.0f} s| {', '.join(row['missed'])}",
        flush=True,
    )


def main(arguments: list[str] | None = None) -> int:
    """Run the cells and print them; return 1 if a cell fails a criterion."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, default=200, help="number of cells (default: 200)")
    parser.add_argument("--seed", type=int, default=0, help="seed of all cells (default: 0)")
    parser.add_argument("--only", type=int, nargs="+", help="run only the cells with these numbers")
    parser.add_argument("--jobs", type=int, default=1, help="number of processes (default: 1)")
    parser.add_argument("--method", nargs="+", choices=METHODS, default=["ledger"])
    parser.add_argument("--slip", type=float, default=1e-3, help="slip speed of friction [m/s]")
    parser.add_argument("--known", action="store_true", help="run the known faults instead")
    parser.add_argument("--json", type=Path, help="file of the cells; finished ones are kept")
    asked = parser.parse_args(arguments)
    rows: list[dict[str, Any]] = []
    if asked.json and asked.json.exists():
        rows = json.loads(asked.json.read_text())["rows"]
    cells: list[Any] = list(KNOWN) if asked.known else asked.only or list(range(asked.cells))
    done = {(row["method"], row["cell"]) for row in rows}
    cases = [
        (asked.seed, 0 if asked.known else cell, method, cell if asked.known else None, asked.slip)
        for cell in cells
        for method in asked.method
        if (method, cell) not in done
    ]
    for row in rows:
        print_row(row)
    found = Parallel(n_jobs=asked.jobs, return_as="generator_unordered")(
        delayed(run_cell)(*case) for case in cases
    )
    for row in found:
        print_row(row)
        rows.append(row)
        if asked.json:
            part = asked.json.with_suffix(".part")
            part.write_text(json.dumps({"seed": asked.seed, "rows": rows}, indent=1) + "\n")
            part.replace(asked.json)
    for method in asked.method:
        own = [row for row in rows if row["method"] == method]
        failed = Counter(name for row in own for name in row["missed"])
        counts = ", ".join(f"{name} {len(own) - failed[name]}" for name in CRITERIA)
        print(f"{method}, of {len(own)}: {counts}; all {sum(not row['missed'] for row in own)}")
    return int(any(row["missed"] for row in rows))


if __name__ == "__main__":
    import ledger_cells  # processes of `--jobs` find the functions by this name

    sys.exit(ledger_cells.main())
