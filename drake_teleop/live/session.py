"""Station that is simulated in slices and takes inputs between them."""

from __future__ import annotations

import dataclasses
import math
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.systems.analysis import InitializeParams, Simulator
from pydrake.systems.framework import Context, EventStatus

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import DRIVE_INPUTS_FILE_NAME
from drake_teleop.common.numeric import Array
from drake_teleop.common.progress import UpdateProgress
from drake_teleop.lab.identified_load import IdentifiedLoad, read_cached_load
from drake_teleop.live.hand import MakeExternalMasterSide, MakeLiveMasterSide
from drake_teleop.live.inputs import SLICE_MS, Inputs, read_inputs
from drake_teleop.live.record import (
    HAPTIC_DEVICE_FILE,
    LOAD_FILE,
    SCENARIO_FILE,
    BackgroundLog,
    SessionRecord,
    versions_and_file_digest,
)
from drake_teleop.live.scenarios import (
    CROSS_FADE_S,
    adapt_load_estimate,
    channel_fill_time_s,
    scenario_of_inputs,
)
from drake_teleop.live.station_swap import copy_station_state
from drake_teleop.station import simulation
from drake_teleop.station.result import SimulationResult
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.signals import LOG_BLOCK_NAME, SIGNALS, signal_with_size
from drake_teleop.station.station import GetBlock, MakeTeleopStation

#: Rows in a part of a log on disk, two seconds. Copying a longer part would delay a slice; each
#: part takes at least 10 ms of CPU.
_ROWS_PER_LOG_PART = 2000
# Duration of a change of scales [s]. A moving slider starts a ramp 60 times a second, and ramps
# start slowly: longer ones would not progress until the slider rests.
_FORCE_SCALE_RAMP_S = 0.05
# Shortest step of error control [s], for real time in contact. A third-order step is stable for
# vibrations up to 1.7 / step = 1.1 kHz; the ball on a leaf vibrates at up to 700 Hz.
_MIN_INTEGRATION_STEP_S = 2.5e-4
#: Largest increase of the rendered force after a change of channel [N].
_MAX_FORCE_RISE_N = 0.9
# Duration of short steps after a rejected one [s].
_SHORT_STEPS_DURATION_AFTER_REJECT_S = 4e-3
_DID_NOTHING_EVENT_STATUS = EventStatus.DidNothing()


def take_short_steps_after_rejection(simulator: Simulator, min_step_s: float) -> None:
    """Let the integrator take steps of `min_step_s` for 4 ms after each rejected step."""
    integrator = simulator.get_mutable_integrator()
    longest = integrator.get_maximum_step_size()
    min_step_s = min(min_step_s, longest)
    integrator.set_requested_minimum_step_size(min_step_s)
    integrator.set_throw_on_minimum_step_size_violation(False)
    # The monitor must not keep the simulator alive.
    station: Any = weakref.ref(simulator)
    rejected, until = 0, math.inf

    def select_step_mode(context: Context) -> EventStatus:
        nonlocal rejected, until
        integrator = station().get_mutable_integrator()
        number = integrator.get_num_step_shrinkages_from_error_control()
        if number != rejected:
            rejected, until = number, context.get_time() + _SHORT_STEPS_DURATION_AFTER_REJECT_S
            integrator.set_maximum_step_size(min_step_s)
            integrator.set_fixed_step_mode(True)
        elif context.get_time() >= until:
            until = math.inf
            integrator.set_maximum_step_size(longest)
            integrator.set_fixed_step_mode(False)
        return _DID_NOTHING_EVENT_STATUS

    simulator.set_monitor(select_step_mode)


def add_missing_signals(log: SimulationResult) -> SimulationResult:
    """Return the log with missing signals added: pose_received = pose_command, others zero."""
    n = len(log.t)
    missing = {"pose_received": log["pose_command"], "ports": np.zeros((n, 8))}
    missing |= dict.fromkeys(("contact", "contact_at_hand"), np.zeros((n, 1)))
    values = missing | {name: log[name] for name in log.signals}
    order = [name for name in SIGNALS if name in values]
    order += [name for name in values if name not in SIGNALS]
    known = {spec.name: spec for spec in log.specs}
    specs = [known.get(name) or signal_with_size(name, values[name].shape[-1]) for name in order]
    return SimulationResult(log.t, {name: values[name] for name in order}, specs)


class _Station:
    def __init__(
        self,
        scenario: Scenario,
        estimate: Array | None,
        load: IdentifiedLoad | None,
        number: int,
        *,
        device: bool,
    ) -> None:
        self.scenario = scenario
        make_master = MakeExternalMasterSide if device else MakeLiveMasterSide
        self.station = MakeTeleopStation(
            scenario,
            load_estimate=estimate,
            noise_floor=None if load is None else load.noise_floor,
            master=make_master(scenario, cross_fade=number > 0),
        )
        seeded = dataclasses.replace(scenario.simulation, seed=scenario.simulation.seed + number)
        self.simulator = simulation.MakeSimulator(self.station, seeded)
        if scenario.simulation.integrator == "runge_kutta3":  # has error control
            take_short_steps_after_rejection(self.simulator, _MIN_INTEGRATION_STEP_S)
        self.context = self.simulator.get_mutable_context()
        self.sink = self.station.GetSubsystemByName(LOG_BLOCK_NAME).FindMutableLog(self.context)
        self.columns = simulation.log_slices_of_signals(self.station)

    def block_and_context(self, name: str) -> tuple[Any, Context]:
        inner_side = self.station.GetSubsystemByName("master_side").GetSubsystemByName("inner_side")
        inside = inner_side.HasSubsystemNamed(name)
        block = inner_side.GetSubsystemByName(name) if inside else GetBlock(self.station, name)
        return block, block.GetMyMutableContextFromRoot(self.context)

    def signal_value(self, signal: str) -> Array:
        return np.array(self.station.GetOutputPort(signal).Eval(self.context))

    def set_clutch(self, is_engaged: bool) -> None:
        self.station.GetInputPort("clutch").FixValue(self.context, [float(is_engaged)])

    def take_over_state(self, replaced: _Station, has_new_channel: bool) -> float:
        """Copy the replaced station's state; cross-fade from its rendered force to the new one.

        Return the time [s] for which the clutch stays open: 0 without a new channel.
        """
        excluded = {"channel"} if has_new_channel else set()
        if replaced.scenario.wrist_sensor.ideal and not self.scenario.wrist_sensor.ideal:
            excluded.add("wrist_sensor")  # an ideal one keeps the old filters of its predecessor
        if not self.scenario.load_estimator.enabled:
            excluded.add("load_estimator")  # its configured load differs
        copy_station_state(replaced.station, replaced.context, self.station, self.context, excluded)
        if replaced.scenario.wrist_sensor != self.scenario.wrist_sensor:
            sensor, context = self.block_and_context("wrist_sensor")
            sensor.reset_queue(context)
        wait_s = channel_fill_time_s(self.scenario) if has_new_channel else 0.0
        cross_fade, context = self.block_and_context("cross_fade")
        rendered = replaced.signal_value("force_to_master")
        cross_fade.StartFade(context, self.context.get_time() + wait_s, CROSS_FADE_S, rendered)
        if has_new_channel:
            cross_fade.LimitForce(context, _MAX_FORCE_RISE_N + float(np.linalg.norm(rendered[:3])))
        impedances = replaced.scenario.operator.hand, self.scenario.operator.hand
        if impedances[0] != impedances[1]:
            hand, context = self.block_and_context("live_hand")
            hand.KeepWrench(context, *impedances)
        if not has_new_channel:
            return 0.0
        name = "pose_command" if replaced.scenario.has_no_network_or_passivity else "pose_received"
        command = replaced.signal_value(name)
        scaling, context = self.block_and_context("kinematic_scaling")
        scaling.OpenClutch(context, command)
        if not self.scenario.has_no_network_or_passivity:
            channel, context = self.block_and_context("channel")
            side = self.station.GetSubsystemByName("slave_side")
            pose = side.GetOutputPort("pose_slave").Eval(side.GetMyContextFromRoot(self.context))
            channel.Restart(context, command, pose, wait_s)
        return wait_s + CROSS_FADE_S


class Session:
    """Simulated station whose hand follows inputs; `ms` is the simulated time [ms].

    Args:
        load: identified load; None if it is estimated online.
        log: folder of the log; None keeps rows in memory until `new_rows` returns them.
        record: folder of scenario, load and inputs; None for none.
        device: whether the inputs are the positions of a haptic device.
    """

    def __init__(
        self,
        scenario: Scenario,
        load: IdentifiedLoad | None = None,
        *,
        log: Path | None = None,
        record: Path | None = None,
        device: bool = False,
    ) -> None:
        self.scenario, self._load, self._device = scenario, load, device
        self.inputs, self.ms = Inputs.from_scenario(scenario), 0
        self._start = np.array(scenario.master.position)
        self._station_count, self._rows_read, self._channel_filled_at_ms = 1, 0, 0
        estimate = None if load is None else load.estimate
        self._station = _Station(scenario, estimate, load, 0, device=device)
        self._record: SessionRecord | None = None
        if record is not None:
            self._record = SessionRecord(record, scenario, load, self.inputs, device=device)
        self._on_disk: BackgroundLog | None = None
        if log is not None:
            self._on_disk = BackgroundLog(log, self._station.simulator, 0.0, add_missing_signals)
        self._earlier_rows: list[SimulationResult] = []
        self._station.simulator.Initialize()

    def apply_inputs(self, inputs: Inputs) -> None:
        """Apply and record the inputs; a change of `station_choices` replaces the station."""
        before = self.inputs
        if inputs == before:
            return
        if inputs.station_choices != before.station_choices:
            self._swap_station(inputs)
        self.inputs = inputs
        if inputs.hand_pose_and_held != before.hand_pose_and_held:
            hand, context = self._station.block_and_context("live_hand")
            hand.SetTarget(context, inputs.intended_pose(self._start))
        if inputs.clutch != before.clutch or inputs.station_choices != before.station_choices:
            self._station.set_clutch(bool(inputs.clutch) and self.ms >= self._channel_filled_at_ms)
        if inputs.force_scales != before.force_scales:
            scaling, context = self._station.block_and_context("force_scaling")
            scaling.SetScales(context, **inputs.force_scales, duration=_FORCE_SCALE_RAMP_S)
        if self._record is not None:
            self._record.write(self.ms, inputs)

    def _swap_station(self, inputs: Inputs) -> None:
        scenario = scenario_of_inputs(self.scenario, self._load, inputs)
        scenario.check()
        estimate = adapt_load_estimate(self.scenario, self._load, scenario)
        station = _Station(scenario, estimate, self._load, self._station_count, device=self._device)
        has_new_channel = inputs.channel_and_method_inputs != self.inputs.channel_and_method_inputs
        wait_s = station.take_over_state(self._station, has_new_channel)
        if wait_s:
            self._channel_filled_at_ms = self.ms + math.ceil(1e3 * wait_s)
        if self._on_disk is not None:
            self._on_disk.write_and_clear_rows()
            self._on_disk.switch_simulator(station.simulator)
        else:
            self._earlier_rows.append(self._recorded_signals())
        station.simulator.Initialize(InitializeParams(suppress_initialization_events=True))
        station.sink.Clear()  # the previous station has recorded this row
        self._station, self._rows_read, self._station_count = station, 0, self._station_count + 1

    @property
    def is_channel_filling(self) -> bool:
        """Whether the clutch is open until a new channel delivers packets."""
        return self.ms < self._channel_filled_at_ms

    def advance(self, ms: int = SLICE_MS) -> None:
        end = self.ms + ms
        if self.ms < self._channel_filled_at_ms <= end:
            self._simulate_until(self._channel_filled_at_ms)
            self._station.set_clutch(bool(self.inputs.clutch))
        self._simulate_until(end)
        if self._on_disk is not None and self._on_disk.num_unwritten_rows() >= _ROWS_PER_LOG_PART:
            self._on_disk.write_and_clear_rows()
            self._rows_read = 0

    def _simulate_until(self, ms: int) -> None:
        self.ms = ms
        # The same product as Drake's event times, see `simulate`.
        simulation.advance_without_garbage_collection(self._station.simulator, 1e-3 * ms)

    def new_rows(self) -> dict[str, Array]:
        """Return the log's rows since the last call: signal -> (n, k), and "t" (n,) [s]."""
        sink, start = self._station.sink, self._rows_read
        data, times = sink.data()[:, start:].T.copy(), sink.sample_times()[start:]
        rows = {name: data[:, part] for name, part in self._station.columns.items()}
        rows["t"] = times.copy()
        self._rows_read += len(times)
        if self._on_disk is None:
            sink.Clear()
            self._rows_read = 0
            self._earlier_rows.clear()
        return rows

    def contact_force(self) -> float:
        """Return the last contact force, scaled for the hand [N]; 0 without a sensor signal."""
        part, sink = self._station.columns.get("contact_wrench_S"), self._station.sink
        if part is None or not sink.num_samples():
            return 0.0
        force = sink.data()[part.start : part.start + 3, -1]
        return self.inputs.force_scales["force_scale"] * math.sqrt(float(force @ force))

    def inputs_at_stylus(self) -> Inputs:
        """Return the inputs of a hand that holds the stylus at its present pose."""
        return self.inputs.with_hand_at_pose(self._station.signal_value("pose_master"), self._start)

    def device_wrench(self) -> Array:
        """Return the wrench (6,) for the haptic device [N, N m]."""
        return self._station.signal_value("force_to_master")

    def force_above_limit(self) -> float:
        """Return the reduction of the force by the limit after a channel change [N]."""
        if self._station_count == 1:
            return 0.0
        cross_fade, context = self._station.block_and_context("cross_fade")
        return float(cross_fade.force_above_limit(context))

    def write_record_and_log(self) -> None:
        if self._record is not None:
            self._record.write(self.ms, self.inputs)
        if self._on_disk is not None:
            self._on_disk.write_and_keep_rows()
            self._on_disk.wait_until_written()

    def _recorded_signals(self) -> SimulationResult:
        return add_missing_signals(simulation.read_recorded_signals(self._station.simulator, 0.0))

    def log(self) -> SimulationResult:
        parts = [*self._earlier_rows, self._recorded_signals()]
        values = {name: np.concatenate([p[name] for p in parts]) for name in parts[0].signals}
        t = np.concatenate([part.t for part in parts])
        return SimulationResult(t, values, parts[0].specs)

    def close(self) -> None:
        record, self._record = self._record, None
        try:
            if record is not None:
                record.close(self.ms, self.inputs)
        finally:
            if record is None or self.ms:
                self.write_record_and_log()


@dataclass(frozen=True, eq=False)
class RecordedDrive:
    """Recorded live session.

    Attributes:
        changes: times [ms] and inputs of each change; the last is the end.
        device: whether a haptic device moved the hand.
    """

    scenario: Scenario
    load: IdentifiedLoad | None
    changes: Sequence[tuple[int, Inputs]]
    device: bool = False
    folder: Path = Path()

    def repeat(
        self, progress: UpdateProgress, log: Path | None = None, slice_ms: int = SLICE_MS
    ) -> SimulationResult:
        """Simulate the session again, in slices of at most `slice_ms`; return its log."""
        session = Session(self.scenario, self.load, log=log, device=self.device)
        end = self.changes[-1][0]
        for ms, inputs in self.changes:
            while session.ms < ms:
                session.advance(min(slice_ms, ms - session.ms))
                progress(session.ms / end)
            session.apply_inputs(inputs)
        session.close()
        return session.log() if log is None else SimulationResult.scan_parquet(log)


def read_drive(folder: str | Path) -> RecordedDrive:
    folder = Path(folder)
    scenario = LoadScenario(folder / SCENARIO_FILE)
    changes = read_inputs(folder / DRIVE_INPUTS_FILE_NAME, versions_and_file_digest(scenario))
    load = read_cached_load(folder / LOAD_FILE)
    known = load is None or (load.estimate.shape == (16,) and np.isfinite(load.estimate).all())
    is_required = not scenario.load_estimator.enabled or (folder / LOAD_FILE).exists()
    if not known or (load is None and is_required):
        what = "is not an identified load (16 finite parameters), or is missing"
        remedy = "record the session again"
        raise DrakeTeleopError(what, where=str(folder / LOAD_FILE), remedy=remedy)
    driven = replace(scenario, simulation__duration=1e-3 * changes[-1][0])
    return RecordedDrive(driven, load, changes, (folder / HAPTIC_DEVICE_FILE).exists(), folder)
