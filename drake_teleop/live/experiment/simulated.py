"""Simulated participants: a noisy observer with a scripted hand."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from drake_teleop.live.experiment.apparatus import (
    Apparatus,
    IntervalLog,
    identify_load_unless_estimated_online,
    make_apparatus,
)
from drake_teleop.live.experiment.design import (
    ApparentMass,
    Experiment,
    PegInSlot,
    SimulatedParticipant,
)
from drake_teleop.live.experiment.procedure import (
    ANSWER_PHASE,
    END_PHASE,
    GAP_PHASE,
    INTERVAL_PHASE,
    IntervalResult,
    Procedure,
)
from drake_teleop.live.inputs import INPUT_UNIT_M, SLICE_MS
from drake_teleop.live.session import Session
from drake_teleop.station.operator.task import Insert
from drake_teleop.station.scenario import Scenario, replace
from drake_teleop.station.simulation import simulate
from drake_teleop.station.station import MakeTeleopStation
from drake_teleop.station.task_measures import task_measures

# Start of the hand's motion [s].
_HAND_MOTION_START_S = 0.4
_LOG_READ_PERIOD_MS = 200


def make_apparatuses(
    experiment: Experiment, scenarios: list[Scenario]
) -> dict[tuple[int, int], Apparatus]:
    apparatuses = {}
    for t, (task, scenario) in enumerate(zip(experiment.tasks, scenarios, strict=True)):
        load = identify_load_unless_estimated_online(scenario)
        for c, condition in enumerate(experiment.conditions):
            apparatuses[t, c] = make_apparatus(task, condition, scenario, load)
    return apparatuses


def with_noise_seed_of_interval(scenario: Scenario, procedure: Procedure) -> Scenario:
    number = 2 * procedure.num_completed_trials + procedure.interval
    rng = np.random.default_rng([procedure.experiment.seed, procedure.participant, number])
    return replace(scenario, simulation__seed=int(rng.integers(2**32)))


def simulate_participant(
    procedure: Procedure,
    apparatuses: dict[tuple[int, int], Apparatus],
    progress: Callable[[int, int], None],
) -> None:
    """Run the remaining trials; keys of `apparatuses`: indices of task and condition.

    After each phase, `progress` receives the numbers of finished and of all trials.
    """
    experiment, responses = procedure.experiment, [0.0, 0.0]
    while procedure.phase != END_PHASE:
        if procedure.phase == INTERVAL_PHASE:
            apparatus = apparatuses[procedure.trial.task, procedure.trial.condition]
            if isinstance(procedure.task, PegInSlot):
                result = _simulate_peg_insertion(apparatus, procedure)
            else:
                result, response = _simulate_response(apparatus, procedure)
                responses[procedure.interval - 1] = response
            procedure.finish_interval(result)
        elif procedure.phase == GAP_PHASE:
            procedure.start_second_interval()
        elif procedure.phase == ANSWER_PHASE:
            key = [experiment.seed, procedure.participant, procedure.num_completed_trials, 3]
            rng = np.random.default_rng(key)
            answer = answer_by_larger_response(experiment.simulated, responses, rng)
            procedure.store_answer(answer, 0.5)
        else:
            procedure.advance_phase()
        progress(procedure.num_completed_trials, len(procedure.trials))


def answer_by_larger_response(
    observer: SimulatedParticipant, responses: list[float], rng: np.random.Generator
) -> int:
    """Return the interval (1, 2) with the larger response [N] plus noise; in a lapse, guess."""
    if rng.random() < observer.lapse:
        return int(rng.integers(1, 3))
    noisy = [
        r + math.hypot(observer.noise, observer.weber * r) * rng.standard_normal()
        for r in responses
    ]
    return 1 if noisy[0] > noisy[1] else 2


def _simulate_response(apparatus: Apparatus, procedure: Procedure) -> tuple[IntervalResult, float]:
    task, observer = apparatus.task, procedure.experiment.simulated
    assert not isinstance(task, PegInSlot)
    session = Session(with_noise_seed_of_interval(apparatus.scenario, procedure), apparatus.load)
    stimulus = apparatus.stimulus_scales(procedure.current_level, procedure.expected_contact_force)
    rows = IntervalLog(apparatus.scenario, None)
    moves_sideways, length = isinstance(task, ApparentMass), task.interval - _HAND_MOTION_START_S
    while session.ms < 1e3 * task.interval:
        t = max(1e-3 * session.ms - _HAND_MOTION_START_S, 0.0)
        if moves_sideways:
            displacement = {"x": observer.sway * min(t, 1.0) * math.sin(2.0 * math.pi * t)}
        else:
            share = 0.5 * (1.0 - math.cos(2.0 * math.pi * t / length))
            displacement = {"z": -observer.reach * share}
        hand = {name: value / INPUT_UNIT_M for name, value in displacement.items()}
        session.apply_inputs(session.inputs.with_changes(stimulus | hand))
        session.advance(SLICE_MS)
        if session.ms % _LOG_READ_PERIOD_MS == 0:
            rows.add_rows(session.new_rows())
    rows.add_rows(session.new_rows())
    session.close()
    result = apparatus.interval_result(procedure.current_level, stimulus, rows)
    return result, rows.largest_rendered_force_change(_HAND_MOTION_START_S)


def _simulate_peg_insertion(apparatus: Apparatus, procedure: Procedure) -> IntervalResult:
    task, condition, base = apparatus.task, apparatus.condition, apparatus.base
    assert isinstance(task, PegInSlot) and isinstance(base.operator.task, Insert)
    scenario = replace(
        with_noise_seed_of_interval(apparatus.scenario, procedure),
        operator__task=base.operator.task,
        simulation__duration=task.timeout,
        simulation__settle=base.simulation.settle,
        simulation__end_with_task=True,
        force_scaling__sigma=condition.sigma,
        force_scaling__gamma=condition.gamma,
        force_scaling__eta=condition.eta,
    )
    scenario.check()
    estimate = None if apparatus.load is None else apparatus.load.estimate
    station = MakeTeleopStation(scenario, load_estimate=estimate)
    result = simulate(station, scenario.simulation, progress=False)
    measures = task_measures(result, scenario)
    done = measures["success"] > 0.0
    time_s = measures["task_time_s"] if done else task.timeout
    rows = IntervalLog(scenario, None)
    rows.add_rows({"t": result.t} | {name: result[name] for name in result.signals})
    return IntervalResult(force_N=rows.largest_mean_contact_force(), done=done, time_s=time_s)
