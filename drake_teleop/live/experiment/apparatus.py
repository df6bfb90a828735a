"""Station and stimulus for a task of an experiment under a condition."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.lab.identified_load import IdentifiedLoad, identified_load
from drake_teleop.live.experiment import design
from drake_teleop.live.experiment.procedure import IntervalResult
from drake_teleop.live.inputs import INPUT_RANGES, UNCHANGED_CHOICE, Inputs
from drake_teleop.live.scenarios import adapt_load_estimate, live_scenario, scenario_of_inputs
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.operator.task import Insert
from drake_teleop.station.scenario import Scenario, replace
from drake_teleop.station.slave.arm import forward_kinematics
from drake_teleop.station.slave.plant import NominalSlave

_MAX_SCALE_INPUT_PERCENT = INPUT_RANGES["gamma"][1]  # %
# Averaging time of a contact force [s], and smallest force of a touch [N].
_FORCE_AVERAGING_TIME_S, _MIN_TOUCH_FORCE_N = 0.02, 0.5
# The tip is on the floor of the slot within this distance [m] for this time [s].
_MAX_SLOT_FLOOR_DISTANCE_M, _MIN_SLOT_FLOOR_TIME_S = 2e-3, 0.2


def identify_load_unless_estimated_online(scenario: Scenario) -> IdentifiedLoad | None:
    return None if scenario.load_estimator.enabled else identified_load(scenario)


@dataclass(frozen=True, eq=False)
class Apparatus:
    """Station for a task and a condition; `base`: scenario without the condition.

    `load_mass_at_hand`: mass of the load, or with `eta` of the object, scaled for the hand [kg].
    """

    task: design.Task
    condition: design.Condition
    scenario: Scenario
    load: IdentifiedLoad | None
    load_mass_at_hand: float
    base: Scenario

    def stimulus_scales(self, level: float, contact_force: float) -> dict[str, int]:
        """Return the inputs sigma, sigma_object and gamma [%] that render a stimulus.

        `level`: rendered contact force [N] or added mass [kg]; `contact_force`: expected force [N].
        """
        condition = self.condition
        share, gamma = 100.0 * condition.non_contact_scale, 100.0 * condition.gamma
        if isinstance(self.task, design.ContactDetection):
            gamma = max(1.0, gamma * level / contact_force) if level else 0.0
        elif isinstance(self.task, design.ApparentMass) and level:
            share += max(1.0, 100.0 * level / self.load_mass_at_hand)
        sigma = share if condition.eta is None else 0.0
        values = {"sigma": sigma, "sigma_object": share, "gamma": gamma}
        return {name: min(round(value), _MAX_SCALE_INPUT_PERCENT) for name, value in values.items()}

    def interval_result(
        self, target: float, inputs: dict[str, int], rows: IntervalLog
    ) -> IntervalResult:
        """Return the result of an interval from its log `rows` and its scales `inputs` [%].

        `target`: intended level; 0: no stimulus.
        """
        force = rows.largest_mean_contact_force()
        if isinstance(self.task, design.PegInSlot):
            time_s = rows.done_at or rows.time
            return IntervalResult(force_N=force, done=rows.done_at > 0.0, time_s=time_s)
        if isinstance(self.task, design.ContactDetection):
            level = force * inputs["gamma"] / (100.0 * self.condition.gamma)
            return IntervalResult(level if target else 0.0, force, valid=force > _MIN_TOUCH_FORCE_N)
        added = inputs["sigma_object"] / 100.0 - self.condition.non_contact_scale
        level = self.load_mass_at_hand * added
        return IntervalResult(level if target else 0.0, force)


def make_apparatus(
    task: design.Task, condition: design.Condition, scenario: Scenario, load: IdentifiedLoad | None
) -> Apparatus:
    setup = live_scenario(scenario)
    # The condition's sigma scales weight and inertia.
    changes: dict[str, object] = {f"force_scaling__sigma_{x}": None for x in ("weight", "inertia")}
    if condition.delay is not None:
        changes["channel"] = Channel(delay=condition.delay)
    elif condition.network != UNCHANGED_CHOICE:
        changes["channel"] = Channel(network=condition.network)
    if condition.method != UNCHANGED_CHOICE:
        changes["passivity__method"] = condition.method
    setup = replace(setup, contact_detection=None, **changes)
    mass = NominalSlave(setup.slave).arm.phi_load[0]
    if condition.eta is not None and setup.slave.payload.mass == 0.0:
        inputs = Inputs.from_scenario(setup).with_changes({"object": 1})
        with_object = scenario_of_inputs(setup, load, inputs)
        estimate = adapt_load_estimate(setup, load, with_object)
        if load is not None and estimate is not None:
            known = dataclasses.replace(load.identification, offsets=estimate[:6], phi=estimate[6:])
            load = dataclasses.replace(load, identification=known)
        setup = with_object
    setup.check()
    if condition.eta is not None:
        mass = setup.slave.payload.mass
    at_hand = setup.force_scaling.force_scale * setup.kinematic_scaling.translation_scale
    mass_at_hand = float(mass) * at_hand
    largest = mass_at_hand * (0.01 * _MAX_SCALE_INPUT_PERCENT - condition.non_contact_scale)
    if isinstance(task, design.ApparentMass) and largest < task.low:
        what = f"adds at most {largest:.3g} kg at the hand, below `low` of the task ({task.low:g})"
        remedy = "reduce sigma or `low`, or increase force_scale of the task's scenario"
        raise DrakeTeleopError(what, where=f"condition {condition.name!r}", remedy=remedy)
    return Apparatus(task, condition, setup, load, mass_at_hand, scenario)


class IntervalLog:
    """Forces and insertion time of an interval, from the log.

    Attributes:
        done_at: time at which the tool reached the slot's floor [s]; 0 before.
    """

    def __init__(self, scenario: Scenario, insert: Insert | None) -> None:
        self.time, self.done_at = 0.0, 0.0
        self._forces: list[Array] = []
        self._rendered: list[Array] = []
        self._dt = 1.0 / scenario.rates.log_hz
        self._slave, self._insert = NominalSlave(scenario.slave), insert
        self._on_floor: float | None = None

    def add_rows(self, rows: dict[str, Array]) -> None:
        if not len(rows["t"]):
            return
        self.time = float(rows["t"][-1])
        contact = rows.get("true_contact_wrench_W", np.zeros((len(rows["t"]), 6)))
        self._forces.append(np.linalg.norm(contact[:, :3], axis=1))
        self._rendered.append(rows["force_to_master"][:, :3])
        if self._insert is not None and not self.done_at:
            self._detect_arrival_at_slot_floor(self._insert, rows)

    def _detect_arrival_at_slot_floor(self, insert: Insert, rows: dict[str, Array]) -> None:
        arm, R_WS, p_WS = self._slave.arm, np.empty((3, 3)), np.empty(3)
        forward_kinematics(arm.table, rows["slave_state"][-1, : arm.num_joints], R_WS, p_WS)
        tip = p_WS + R_WS @ self._slave.tip - self._slave.p_WTip_start
        if tip[2] - insert.translation[2] + insert.depth > _MAX_SLOT_FLOOR_DISTANCE_M:
            self._on_floor = None
        elif self._on_floor is None:
            self._on_floor = self.time
        elif self.time - self._on_floor >= _MIN_SLOT_FLOOR_TIME_S:
            self.done_at = self._on_floor

    def largest_mean_contact_force(self) -> float:
        """Return the largest 20 ms mean of the contact force [N]."""
        return _largest_moving_mean(np.concatenate([np.zeros(1), *self._forces]), self._dt)

    def largest_rendered_force_change(self, after_s: float) -> float:
        """Return the largest 20 ms mean of the rendered force [N] minus that before `after_s`."""
        rendered = np.concatenate(self._rendered)
        start = round(after_s / self._dt)
        rest = rendered[round((after_s - 0.1) / self._dt) : start].mean(axis=0)
        return _largest_moving_mean(np.linalg.norm(rendered[start:] - rest, axis=1), self._dt)


def _largest_moving_mean(values: Array, dt: float) -> float:
    n = max(1, round(_FORCE_AVERAGING_TIME_S / dt))
    sums = np.concatenate([[0.0], np.cumsum(values)])
    means = (sums[n:] - sums[:-n]) / n
    return float(means.max()) if len(means) else float(values.max())
