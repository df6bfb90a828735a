"""How large a force do 560 faults in the running station display to the operator?

`python benchmarks/faults.py [--json FILE] [--each N]`. The tool presses on a leaf; the displayed
force is 1 to 1.5 N, and the hand moves by 4 mm. Ten stations have all methods, or no channel.
Faults come at a random time, with random length (one sample to 0.35 s) and size, the same in every
run. Numbers are not finite or far too large; samples freeze or have a wrong time; a sensor
saturates; packets are lost, late or out of order; the load estimate is wrong; scales change. The
force at the hand, at 2 kHz, must be

- finite, and within the device's peak force (37.5 N);
- without a step above 0.5 N from one sample to the next;
- zero from `channel.timeout` (0.1 s) and 50 ms after the beginning of the fault until its end, if
  the fault leaves the station without a wrench for the hand.

One fault is excluded: without a channel, a command that is not a pose for more than one sample. No
block stores the last command there, and the slave moves to the next command as fast as it can.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import InitializeParams, Simulator
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, LeafSystem

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.identification import true_load
from drake_teleop.load.regressor import SAMPLE_TIME_INDEX
from drake_teleop.station import master_side as master
from drake_teleop.station import slave_side as slave
from drake_teleop.station import station as station_module
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.master.phantom import PEAK_FORCE_N
from drake_teleop.station.operator.operator import MinimumJerk, Sine
from drake_teleop.station.passivity.methods import METHODS
from drake_teleop.station.passivity.safe_state import STOP_TIME_S
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.simulation import (
    MakeSimulator,
    advance_without_garbage_collection,
    read_recorded_signals,
)
from drake_teleop.station.station import GetBlock, MakeTeleopStation

Array = NDArray[np.float64]
Change = Callable[[Array, float], None]

STATIONS = ("no channel", *METHODS)
BEFORE, END = 0.6, 1.25  # s, common start of all runs of a station, and their end
DELAY, TIMEOUT = 0.005, 0.1  # s
STEP = 0.5  # N
RANGE = 60.0  # N, range of the sensor: it saturates at a force that a hand can hold
LATE = 2 * DELAY + 0.01  # s, delay of a packet for the round trip, and steps
STATE = ("slave_plant", "arm_state")
#: Wires (system, port, system) by their signal.
PLACES: dict[str, tuple[tuple[str, str, str], ...]] = {
    "sensor": ((*STATE, "wrist_sensor"),),
    "encoders": tuple(
        (*STATE, to) for to in ("wrist_sensor", "joint_control", "forward_kinematics")
    ),
    "sample": (("wrist_sample", "y0", "force_scaling"),),
    "load": (("load_estimator", "load_estimate", "force_scaling"),),
    "wrench": (("slave_side", "wrench_B", "*"),),
    "pose": (("slave_side", "pose_slave", "channel"),),
    "command": (("master_side", "pose_command", "*"),),
    "hand": (("master_side", "hand_wrench_E", "channel"),),
    "device": (
        ("master_device", "for_display", "force_display"),
        ("master_device", "pose_master", "kinematic_scaling"),
    ),
}
CHANNEL_ONLY = ("pose", "hand")


class Tap(LeafSystem):
    """Block that passes on its input, changed by `change`."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.change: Change | None = None
        self._entry = self.DeclareVectorInputPort("in", size)
        self.DeclareVectorOutputPort("out", size, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        numbers = np.array(self._entry.Eval(context))
        if self.change is not None:
            self.change(numbers, context.get_time())
        output.SetFromVector(numbers)


Taps = dict[str, list[Tap]]


@contextmanager
def _tapped() -> Iterator[Taps]:
    """Insert a tap into each wire of `PLACES` of stations that are built in this context."""
    taps: Taps = {place: [] for place in PLACES}

    class Builder(DiagramBuilder):
        def Connect(self, source: Any, target: Any) -> None:
            ends = (source.get_system().get_name(), source.get_name())
            wire = (*ends, target.get_system().get_name())
            places = [
                place
                for place, wires in PLACES.items()
                if wire in wires or ((*ends, "*") in wires and wire[2] != "log_input")
            ]
            if places:
                tap = self.AddSystem(Tap(source.size()))
                super().Connect(source, tap.get_input_port())
                source = tap.get_output_port()
                for place in places:
                    taps[place].append(tap)
            super().Connect(source, target)

    modules = (station_module, master, slave)
    for module in modules:
        module.DiagramBuilder = Builder  # type: ignore[attr-defined]
    try:
        yield taps
    finally:
        for module in modules:
            module.DiagramBuilder = DiagramBuilder  # type: ignore[attr-defined]


def pressing(name: str, trace: Path | None = None) -> Scenario:
    """Return the scenario of one of `STATIONS`, with the delays of `trace` if it is given."""
    scenario = replace(
        LoadScenario("contact_transition"),
        simulation__settle=0.0,
        simulation__duration=END,
        rates__log_hz=2000.0,
        operator__intent=[
            MinimumJerk(t_start=0.02, duration=0.38, translation=[0.0, 0.0, -0.1]),
            Sine(t_start=0.4, duration=5.0, ramp=0.1, frequency=1.0, translation=[0.0, 0.0, 4e-3]),
        ],
        kinematic_scaling__rotation_scale=0.1,
        sheet_spring__thickness=0.001,
        wrist_sensor__force_range=[RANGE] * 3,
    )
    if name == "no channel":
        return scenario
    line = {"delay": DELAY} if trace is None else {"trace": str(trace)}
    channel = Channel(timeout=TIMEOUT, **line)  # type: ignore[arg-type]
    return replace(scenario, passivity__method=name, channel=channel)


def tapped_station(scenario: Scenario) -> tuple[Diagram, Taps]:
    """Return the station with its true load, and its taps by `PLACES`."""
    load = true_load(scenario)
    load[:6] = scenario.wrist_sensor.offset
    with _tapped() as taps:
        return MakeTeleopStation(scenario, load_estimate=load), taps


@dataclass(frozen=True)
class Fault:
    """Fault with its place, time and size.

    Args:
        kind: one of `KINDS`.
        place: one of `PLACES`; empty for faults without a place.
        start, length: [s].
        index: number of the component.
        size: in the unit of the kind.
    """

    kind: str
    place: str
    start: float
    length: float
    index: int
    size: float

    @property
    def end(self) -> float:
        """Time of the end [s]."""
        return self.start + self.length

    @property
    def blinds(self) -> bool:
        """Whether the station has no wrench for the hand during the fault."""
        return self.kind not in ("saturated", "wrong load", "scales", "delayed", "out of order")

    def now(self, time: float) -> bool:
        """Return whether the fault is present."""
        return self.start - 1e-9 <= time < self.end - 1e-9


def draw(kind: str, direct: bool, rng: np.random.Generator) -> Fault:
    """Return a random fault of that kind."""
    places = {
        "nan": [p for p in PLACES if not (direct and p in CHANNEL_ONLY)],
        "spike": ["sample", "load", "wrench", "command"] + ([] if direct else [*CHANNEL_ONLY]),
        "frozen": ["sample"],
        "clock": ["sample"],
        "saturated": ["sensor"],
        "wrong load": ["load"],
    }
    place = str(rng.choice(places.get(kind, [""])))
    length = float(rng.choice([5e-4, rng.uniform(2e-3, 0.06), rng.uniform(0.16, 0.35)]))
    if place == "command" and direct:
        length = 5e-4
    start = float(np.round(rng.uniform(BEFORE + 0.01, BEFORE + 0.1) * 2000) / 2000)
    sizes = {
        "nan": rng.choice([np.nan, np.inf, -np.inf]),
        "spike": rng.choice([-1, 1]) * 10 ** rng.uniform(7, 12),
        "clock": rng.choice([-1, 1]) * rng.uniform(0.1, 100),
        "saturated": rng.uniform(1.2, 3.0),
        "wrong load": rng.uniform(0.5, 1.5),
        "delayed": rng.uniform(0.02, 0.3),
        "out of order": rng.uniform(0.02, 0.3),
        "scales": rng.uniform(0.0, 1.0),
    }
    index = int(rng.integers(6))
    return Fault(kind, place, start, length, index, float(sizes.get(kind, 0.0)))


#: Number of each kind among the 56 faults of a station; without a channel there is no network.
KINDS = {
    "nan": 18, "spike": 10, "frozen": 5, "clock": 4, "saturated": 3, "wrong load": 3, "scales": 3,
    "lost": 4, "delayed": 3, "out of order": 3,
}  # fmt: skip
NETWORK = ("lost", "delayed", "out of order")


def change_of(fault: Fault, station: Diagram) -> Change:
    """Return the function by which the fault changes the numbers on its wires."""
    held: list[Array] = []
    sensor = GetBlock(station, "wrist_sensor")
    offset = np.array(sensor.offset)
    limit = RANGE * fault.size

    def change(x: Array, time: float) -> None:
        if fault.kind == "saturated":  # up and down, as quickly as a push grows
            u = np.clip(min(time - fault.start, fault.end - time) / 0.05, 0.0, 1.0)
            sensor.offset[:] = offset
            sensor.offset[fault.index % 3] += u * limit
        elif fault.kind == "wrong load":
            x[6:] *= 1.0 + (fault.size - 1.0) * np.clip((time - fault.start) / 0.1, 0.0, 1.0)
        elif not fault.now(time):
            return
        elif fault.kind == "frozen":
            held.append(x.copy())
            x[:] = held[0]
        elif fault.kind == "clock":
            x[SAMPLE_TIME_INDEX] += fault.size
        else:
            x[fault.index] = fault.size

    return change


def trace_of(fault: Fault, folder: Path) -> Path:
    """Return the recorded delays of a network with the fault, for both directions."""
    late = f"{fault.size:.4f}"
    during = {"lost": "", "delayed": late, "out of order": late}[fault.kind]
    rows = [f"0,{DELAY}", f"{fault.start:.4f},{during}", f"{fault.end:.4f},{DELAY}", f"60,{DELAY}"]
    if fault.kind == "out of order":  # every other millisecond is late
        times = np.arange(fault.start, fault.end - 5e-4, 1e-3)
        pairs = [f"{t:.4f},{(late, DELAY)[k % 2]}" for k, t in enumerate(times)]
        rows[1:2] = pairs
    path = folder / "trace.csv"
    path.write_text("\n".join(["time,delay", *rows]) + "\n", encoding="utf-8")
    return path


class Running:
    """Station that presses; each fault starts from a copy of its state."""

    def __init__(self, name: str) -> None:
        self.scenario = pressing(name)
        self.station, self.taps = tapped_station(self.scenario)
        simulator = MakeSimulator(self.station, self.scenario.simulation)
        simulator.Initialize()
        advance_without_garbage_collection(simulator, BEFORE)
        self._context = simulator.get_context().Clone()

    def run(self, fault: Fault) -> SimulationResult:
        """Simulate from `BEFORE` on with the fault."""
        simulator: Simulator = MakeSimulator(self.station, self.scenario.simulation)
        simulator.reset_context(self._context.Clone())
        simulator.Initialize(InitializeParams(suppress_initialization_events=True))
        offset = np.array(GetBlock(self.station, "wrist_sensor").offset)
        change = change_of(fault, self.station) if fault.place else None
        for tap in self.taps.get(fault.place, []):
            tap.change = change
        try:
            advance_without_garbage_collection(simulator, fault.start)
            if fault.kind == "scales":
                block = GetBlock(self.station, "force_scaling")
                block.SetScales(
                    block.GetMyMutableContextFromRoot(simulator.get_mutable_context()),
                    sigma_gripper=fault.size,
                    sigma_object=fault.size,
                    gamma=1.0 - 0.5 * fault.size,
                    force_scale=self.scenario.force_scaling.force_scale * (1.0 + fault.size),
                )
            advance_without_garbage_collection(simulator, END)
        finally:
            for tap in self.taps.get(fault.place, []):
                tap.change = None
            GetBlock(self.station, "wrist_sensor").offset[:] = offset
        return read_recorded_signals(simulator, 0.0)


def over_the_network(name: str, fault: Fault) -> SimulationResult:
    """Simulate with the fault in the network."""
    with tempfile.TemporaryDirectory() as folder:
        scenario = pressing(name, trace_of(fault, Path(folder)))
        station, _ = tapped_station(scenario)
        simulator = MakeSimulator(station, scenario.simulation)
        simulator.Initialize()
        advance_without_garbage_collection(simulator, END)
        return read_recorded_signals(simulator, 0.0)


@dataclass
class Count:
    """Results of some faults: largest force, step, and force without a valid wrench [N]."""

    faults: int = 0
    largest: float = 0.0
    step: float = 0.0
    blind: float = 0.0
    not_finite: int = 0
    too_large: int = 0
    stepped: int = 0
    not_zero: int = 0
    raised: int = 0

    @property
    def failed(self) -> int:
        """Number of failed criteria."""
        return self.not_finite + self.too_large + self.stepped + self.not_zero + self.raised

    def add(self, fault: Fault, result: SimulationResult | None) -> bool:
        """Count one fault; return whether it met all criteria."""
        before = self.failed
        self.faults += 1
        if result is None:
            self.raised += 1
            return False
        t, force = result.t, result["force_to_master"][:, :3]
        felt, later = np.linalg.norm(force, axis=1), t > fault.start - 0.01
        largest = float(felt[later].max())
        step = float(np.linalg.norm(np.diff(force, axis=0), axis=1)[later[1:]].max())
        # Samples are too old after half of the timeout, and earlier packets still arrive.
        blind = (t > fault.start + TIMEOUT + STOP_TIME_S + LATE) & (t < fault.end - 1e-3)
        left = float(felt[blind].max(initial=0.0)) if fault.blinds else 0.0
        self.not_finite += not np.isfinite(force).all()
        self.too_large += not largest <= PEAK_FORCE_N * (1 + 1e-12)
        self.stepped += not step <= STEP
        self.not_zero += not left <= 1e-9
        self.largest = max(self.largest, largest)
        self.step, self.blind = max(self.step, step), max(self.blind, left)
        return self.failed == before


def faults_of(name: str, each: int) -> list[Fault]:
    """Return `each` faults of all kinds for a station, the same in every run."""
    rng, direct = np.random.default_rng([2009, STATIONS.index(name)]), name == "no channel"
    kinds = {kind: n for kind, n in KINDS.items() if not (direct and kind in NETWORK)}
    total = sum(kinds.values())
    names = [kind for kind, n in kinds.items() for _ in range(math.ceil(n * each / total))]
    rng.shuffle(names)
    return [draw(kind, direct, rng) for kind in names[:each]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="file for the figures")
    parser.add_argument("--each", type=int, default=56, help="faults for each station")
    parser.add_argument(
        "--station", choices=STATIONS, action="append", help="station (default: all)"
    )
    arguments = parser.parse_args()
    rows: dict[str, Count] = {}
    for name in arguments.station or STATIONS:
        running = Running(name)
        for fault in faults_of(name, arguments.each):
            try:
                network = fault.kind in NETWORK
                result = over_the_network(name, fault) if network else running.run(fault)
            except (DrakeTeleopError, RuntimeError) as error:
                print(f"{name}: {fault}: {error}", file=sys.stderr)
                result = None
            rows.setdefault(name, Count()).add(fault, result)
            if not rows.setdefault(fault.kind, Count()).add(fault, result):
                print(f"{name}: {fault}", file=sys.stderr)
    print(f"{'':14s} faults  largest  step  blind  failed")
    for name, row in rows.items():
        figures = f"{row.faults:6d} {row.largest:8.2f} {row.step:5.2f} {row.blind:6.0e}"
        print(f"{name:14s} {figures} {row.failed:7d}")
    if arguments.json:
        table = {name: vars(row) | {"failed": row.failed} for name, row in rows.items()}
        arguments.json.write_text(json.dumps(table, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
