"""Tasks of the simulated operator in the whole station."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RollPitchYaw
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.noise import random_normal
from drake_teleop.lab.identification import true_load
from drake_teleop.station import master_side
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.channel.network import NetworkConfig
from drake_teleop.station.master.data_sheets import PhantomJointFriction
from drake_teleop.station.operator import decision
from drake_teleop.station.operator.decision import (
    OUTCOME_INDEX,
    PHASE_INDEX,
    PHASE_OVER,
    PHASE_SEARCHING_SLOT,
    PHASE_STOPPING,
    STATE_SIZE,
)
from drake_teleop.station.operator.minimum_jerk import add_planned_motion_into, plan_move
from drake_teleop.station.operator.operator import Operator
from drake_teleop.station.operator.perception import (
    CONTACT_NOTICED_INDEX,
    Perception,
    perceive_contact,
)
from drake_teleop.station.operator.task import (
    Insert,
    Movement,
    Press,
    Reach,
    Touch,
    check_target_beyond_standoff,
)
from drake_teleop.station.scenario import LoadScenario, Scenario, Simulation, replace
from drake_teleop.station.simulation import simulate
from drake_teleop.station.slave.plant import NominalSlave
from drake_teleop.station.station import MakeTeleopStation
from drake_teleop.station.task_measures import (
    detection_delay,
    task_measures,
    true_contact_force_magnitudes,
)
from drake_teleop.station.wiring import build_with_log

#: Rates of a study: the operator notices no difference.
FAST = {
    "rates__sensor_hz": 2000.0,
    "rates__hand_hz": 1000.0,
    "rates__joint_control_hz": 1000.0,
    "wrist_sensor__ideal": True,
}


def run(name: str, **changes):
    """Run the scenario with the true load."""
    scenario = replace(LoadScenario(name), **(FAST | changes))
    estimate = true_load(scenario)
    station = MakeTeleopStation(scenario, load_estimate=estimate)
    result = simulate(station, scenario.simulation)
    return result, task_measures(result, scenario)


def with_task(task, **changes):
    return {"operator__task": task} | changes


@pytest.fixture(scope="module")
def touch():
    return {sigma: run("touch", force_scaling__sigma=sigma) for sigma in (0.0, 1.0)}


@pytest.fixture(scope="module")
def reach():
    return run("reach")


@pytest.mark.slow
def test_reaching_ends_in_the_target(reach):
    result, measures = reach
    assert measures["success"] == 1.0
    assert 0.5 < measures["task_time_s"] < 2.0
    state = result["task_state"]
    ended = np.argmax(state[:, OUTCOME_INDEX] != 0.0)
    assert (state[ended:, PHASE_INDEX] == PHASE_OVER).all()
    assert np.isnan(measures["detection_time_s"]) and measures["contact_force_overshoot_N"] == 0.0


@pytest.mark.slow
def test_smaller_target_takes_longer():
    """Fitts' law: motor noise requires corrections."""
    mean = {}
    for width in (0.003, 0.02):
        task = Reach(translation=[0.0, 0.08, -0.06], width=width)
        times = [
            run("reach", **with_task(task, simulation__seed=seed))[1]["task_time_s"]
            for seed in (1, 2)
        ]
        mean[width] = np.mean(times)
    assert mean[0.003] > mean[0.02] + 0.3


def test_hand_motion_uses_alignment_and_motion_scale():
    result, measures = run(
        "reach",
        kinematic_scaling__alignment=[0.0, 0.0, -0.7],
        kinematic_scaling__translation_scale=1.5,
    )
    assert measures["success"] == 1.0
    way = result["pose_master"][-1, 4:] - result["pose_master"][0, 4:]
    assert np.linalg.norm(way) == pytest.approx(0.1 / 1.5, rel=0.1)


def test_perceived_force_is_split_along_and_across_the_axis(monkeypatch):
    """The base is rotated about all axes, and the force is scaled down."""
    R_WB = RollPitchYaw(0.4, -0.9, 1.3).ToRotationMatrix().matrix()
    task = Press(translation=[0.03, -0.02, -0.06])
    training = decision.OperatorTraining(R_WB, 1.5, 0.3, 0.0, 0.0, 0)
    person = decision.pack_operator_parameters(training, Perception(), Movement())
    # In Python, to avoid compilation.
    monkeypatch.setattr(
        decision,
        "_contact_force_at_tool_along_approach",
        decision._contact_force_at_tool_along_approach.py_func,
    )
    force_W = np.array([3.0, -5.0, 8.0])
    packed, felt = decision.pack_task_parameters(task), 0.3 * R_WB.T @ force_W
    axis = np.array(task.translation) / np.linalg.norm(task.translation)
    assert decision._contact_force_at_tool_along_approach(packed, person, felt) == pytest.approx(
        -force_W @ axis
    )
    across, size = decision._lateral_contact_force_W_and_norm.py_func(packed, person, felt)
    np.testing.assert_allclose(across, force_W - (force_W @ axis) * axis, atol=1e-12)
    assert size == pytest.approx(np.linalg.norm(across))


@pytest.mark.parametrize(("length", "duration"), [(0.3, None), (1e-4, 0.2)])
def test_submovement_respects_acceleration_and_minimum_duration(monkeypatch, length, duration):
    training = decision.OperatorTraining(np.eye(3), 1.5, 0.3, 0.0, 0.0, 0)
    movement = Movement(acceleration=2.0, shortest=0.2, noise=0.0)
    person, plans = decision.pack_operator_parameters(training, Perception(), movement), []
    monkeypatch.setattr(decision, "_tool_to_hand_motion", decision._tool_to_hand_motion.py_func)
    monkeypatch.setattr(decision, "_normal_random_number", lambda *_: 0.0)
    monkeypatch.setattr(decision, "plan_move", lambda *plan: plans.append(plan))
    took = decision._plan_submovement.py_func(
        person, None, 0, 1.0, np.array([0.0, 1.5 * length, 0.0])
    )
    _, time, planned, change, _ = plans[0]
    np.testing.assert_allclose(change, [0.0, length, 0.0])
    # x = L (10 u^3 - 15 u^4 + 6 u^5), of which the second derivative has this maximum.
    u = np.linspace(0.0, 1.0, 10001)
    peak = length / took**2 * np.max(60 * u - 180 * u**2 + 120 * u**3)
    assert (time, planned) == (1.0, took)
    assert peak <= 2.0 + 1e-6
    assert took == duration if duration else peak == pytest.approx(2.0, rel=1e-6)


@pytest.mark.slow
def test_run_depends_only_on_the_seed(reach):
    again, _ = run("reach")
    other, _ = run("reach", simulation__seed=5)
    assert np.array_equal(again["hand_wrench_E"], reach[0]["hand_wrench_E"])
    assert not np.array_equal(other["hand_wrench_E"], reach[0]["hand_wrench_E"])


@pytest.mark.slow
def test_vision_has_the_delay_of_the_network():
    """One movement reaches a large target; the operator sees it after both delays."""
    task = with_task(Reach(translation=[0.0, 0.08, -0.06], width=0.04))
    near, far = (
        run("reach", channel__delay=delay, **task)[1]["task_time_s"] for delay in (0.05, 0.2)
    )
    assert far - near == pytest.approx(2 * 0.15, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("there", "back"), [(0.03, 0.22), (0.22, 0.03)])
def test_unequal_delays_add_to_one_round_trip(there, back):
    task = with_task(Reach(translation=[0.0, 0.08, -0.06], width=0.04))
    lines = Channel(delay=there, backward=NetworkConfig(delay=back))
    differ, same = (
        run("reach", channel=channel, **task)[1]["task_time_s"]
        for channel in (lines, Channel(delay=0.125))
    )
    assert differ == pytest.approx(same, abs=0.02)


@pytest.mark.slow
def test_hand_stops_after_contact_detection(touch):
    for result, measures in touch.values():
        assert measures["success"] == 1.0
        # The press begins after the reaction time.
        assert 0.16 < measures["detection_time_s"] < 0.5
        assert measures["false_notices"] == 0
        # It has stopped: the motion of the tool in the leaf is constant.
        force = true_contact_force_magnitudes(result)
        assert force[-1] > 0.5 and np.ptp(force[-200:]) < 2.0
        # It decelerates, and rests for 0.3 s, the default.
        stopping = result.t[result["task_state"][:, PHASE_INDEX] == PHASE_STOPPING]
        assert np.ptp(stopping) > decision.STOP_DURATION_S + 0.29
        # The run ends with the task.
        assert 0.0 <= result.t[-1] - measures["task_time_s"] < 0.03


@pytest.mark.slow
def test_rendered_weight_raises_threshold_and_slows_approach(touch):
    """The threshold rises with the rendered weight at sigma = 1, and the approach is slower."""
    without, with_load = touch[0.0][1], touch[1.0][1]
    assert with_load["task_time_s"] > without["task_time_s"]
    assert with_load["effort_Ns"] > 2 * without["effort_Ns"]
    limit = [run["task_state"][-1, decision.FORCE_THRESHOLD_INDEX] for run, _ in touch.values()]
    assert limit[0] == pytest.approx(0.06, abs=0.005)
    assert limit[1] == pytest.approx(0.1 * 3.13 * 9.81 / 17.5, rel=0.1)


@pytest.mark.slow
def test_search_finds_the_slot_after_an_aim_error():
    """The chamfers are 4 mm wide; a larger aim error lands beside them."""
    task = Insert(translation=[0.0, 0.0085, -0.02], depth=0.04)
    result, measures = run("insert", **with_task(task))
    assert measures["success"] == 1.0
    assert (result["task_state"][:, PHASE_INDEX] == PHASE_SEARCHING_SLOT).any()
    # It touched the top first: with the force of a push, above the mouth.
    assert measures["detection_time_s"] < 0.5


@pytest.mark.slow
def test_operator_gives_up_without_contact():
    result, measures = run("touch", force_scaling__gamma=0.0, sheet_spring=None)
    assert measures["success"] == 0.0 and np.isnan(measures["task_time_s"])
    assert np.isnan(measures["detection_time_s"])
    assert result["task_state"][-1, OUTCOME_INDEX] <= 0.0


@pytest.mark.slow
def test_set_force_is_held():
    """Device friction, which hides 1 N at the tool, is zero."""
    smooth = {"master__friction": PhantomJointFriction([0.0] * 6, [5e-4] * 3 + [5e-5] * 3)}
    task = Press(translation=[0.0, 0.0, -0.08], force=12.0, tolerance=1.2)
    _, measures = run("press", **with_task(task, **smooth), force_scaling__gamma=1.6)
    assert measures["task_time_s"] < 5.5
    # The Weber fraction is a standard deviation.
    assert measures["press_error_N"] < (0.1 + 2 * 0.1) * 12.0


@pytest.mark.slow
def test_press_is_given_up_after_timeout():
    task = Press(translation=[0.0, 0.0, -0.08], timeout=1.0)
    result, measures = run("press", **with_task(task, simulation__duration=1.5))
    assert measures["success"] == 0.0
    assert result["task_state"][-1, OUTCOME_INDEX] == -1.0


@pytest.mark.slow
def test_papers_contact_is_detected_without_false_detection():
    """Fig. 8 without inertia: the touch of 50 ms is detected, the fast motion before is not."""
    scenario = LoadScenario("contact_transition")
    changes = FAST | {"simulation__settle": 0.0, "simulation__duration": 1.7}
    scenario = replace(scenario, **changes)
    estimate = true_load(scenario)
    result = simulate(MakeTeleopStation(scenario, load_estimate=estimate), scenario.simulation)
    hand, velocity = result["hand_wrench_E"][:, :3], result["twist_master"][:, :3]
    mass = scenario.operator.hand.mass
    noticed = (
        perceive_contact(result.t, hand, velocity, Perception(), mass, 1.0)[
            :, CONTACT_NOTICED_INDEX
        ]
        > 0.0
    )
    touching = true_contact_force_magnitudes(result) > 0.0
    assert not noticed[: np.argmax(touching)].any()
    assert detection_delay(result.t, touching, noticed) < 0.03


def test_movements_are_continuous_to_acceleration():
    memory, time, rng = decision.initial_memory(), 0.0, np.random.default_rng(3)
    expected = np.zeros(3)

    def planned_motion(at):
        pose, twist = np.zeros(7), np.zeros(6)
        add_planned_motion_into(memory, at, pose, twist)
        return pose[4:], twist[:3]

    for _ in range(5):
        change, length = rng.normal(size=3) * 0.1, rng.uniform(0.2, 0.5)
        now, _ = planned_motion(time)
        before = planned_motion(time - 1e-6), planned_motion(time)
        plan_move(memory, time, length, change, np.zeros(3))
        after = planned_motion(time), planned_motion(time + 1e-6)
        for place_or_speed in (0, 1):
            slope_before = (before[1][place_or_speed] - before[0][place_or_speed]) / 1e-6
            slope_after = (after[1][place_or_speed] - after[0][place_or_speed]) / 1e-6
            np.testing.assert_allclose(slope_after, slope_before, atol=2e-3)
        np.testing.assert_allclose(after[0][0], before[1][0], atol=1e-14)
        expected = now + change
        np.testing.assert_allclose(planned_motion(time + length)[0], expected, atol=1e-14)
        time += 0.7 * length  # the next one begins before the end of this one
    np.testing.assert_allclose(planned_motion(time + 1.0)[0], expected, atol=1e-14)
    np.testing.assert_allclose(planned_motion(time + 1.0)[1], 0.0, atol=1e-13)


def test_the_operators_noise_is_normal():
    key = np.uint64(12345)
    draws = np.array([random_normal(key, k) for k in range(20000)])
    assert abs(draws.mean()) < 4 / np.sqrt(len(draws))
    assert draws.std() == pytest.approx(1.0, abs=0.03)
    assert (np.abs(draws) > 1.96).mean() == pytest.approx(0.05, abs=0.01)
    assert abs(np.mean(draws[1:] * draws[:-1])) < 0.03


def test_invalid_force_is_rejected_when_assigned():
    with pytest.raises(DrakeTeleopError, match=r"^Press\.force: -1 N is outside"):
        Press(force=-1.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (with_task(Reach(width=0.4)), r"operator\.task\.translation: the target is 0\.1 m from"),
        (with_task(Insert(translation=[0.0, 0.0, -0.01])), r"operator\.task\.translation"),
        (with_task(Touch(standoff=0.3)), r"operator\.task\.translation"),
        (with_task(Reach(), kinematic_scaling__translation_scale=0.0), "translation_scale"),
    ],
)
def test_impossible_task_is_rejected(changes, message):
    with pytest.raises(DrakeTeleopError, match=message):
        replace(Scenario(), **changes).check()


def test_target_beyond_its_radius_is_accepted():
    check_target_beyond_standoff(Reach(translation=[0.0, 0.03, 0.0], width=0.04), "task")
    with pytest.raises(DrakeTeleopError, match=r"within its radius or standoff of 0\.02 m"):
        check_target_beyond_standoff(Reach(translation=[0.0, 0.019, 0.0], width=0.04), "task")


class _Outcome(LeafSystem):
    """Block with the signal task_state, whose outcome is 1 from `time` [s] on."""

    def __init__(self, time):
        super().__init__()

        def calculate(context, output):
            output[OUTCOME_INDEX] = float(context.get_time() >= time)

        self.DeclareVectorOutputPort("task_state", STATE_SIZE, calculate)


@pytest.mark.parametrize("log_hz", [1.0, 7.0, 30.0, 50.0, 1000.0])
@pytest.mark.parametrize("time", [0.02, 0.333, 1.001])
@pytest.mark.parametrize("on_disk", [False, True])
def test_log_of_a_run_that_ends_with_its_task_contains_the_outcome(tmp_path, log_hz, time, on_disk):
    builder = DiagramBuilder()
    side = builder.AddSystem(_Outcome(time))
    station = build_with_log(builder, "station", [side], log_hz)
    simulation = Simulation(duration=5.0, settle=0.0, end_with_task=True)
    result = simulate(station, simulation, log=tmp_path / "log" if on_disk else None)
    logged = result["task_state"][:, OUTCOME_INDEX]
    assert logged[-1] == 1.0
    assert result.t[-1] < time + 0.02 + 1.0 / log_hz


def test_measures_need_a_task_and_samples(reach):
    with pytest.raises(DrakeTeleopError, match=r"operator\.task"):
        task_measures(reach[0], Scenario())
    with pytest.raises(DrakeTeleopError, match=r"no samples; increase simulation\.duration"):
        task_measures(reach[0][:0], LoadScenario("reach"))


def test_training_contains_scales_and_delays_of_the_station(monkeypatch):
    monkeypatch.setattr(master_side, "Operator", lambda *given: given)
    scenario = replace(
        LoadScenario("touch"),
        channel=Channel(delay=0.02, backward=NetworkConfig(delay=0.05)),
        kinematic_scaling__translation_scale=2.0,
        kinematic_scaling__alignment=[0.1, -0.2, 0.3],
        force_scaling__gamma=0.5,
        force_scaling__force_scale=0.1,
        simulation__seed=7,
    )
    _, _, training, _, tip = master_side._make_operator(scenario, np.eye(7)[0])
    assert (training.translation_scale, training.force_gain, training.seed) == (2.0, 0.05, 7)
    assert (training.forward_delay_s, training.backward_delay_s) == (0.02, 0.05)
    R_WB = RollPitchYaw(0.1, -0.2, 0.3).ToRotationMatrix().matrix()
    np.testing.assert_allclose(training.R_WB, R_WB)
    slave = NominalSlave(scenario.slave)
    np.testing.assert_array_equal(tip, [*slave.tip, *slave.p_WTip_start])


@pytest.mark.parametrize(("forward", "backward"), [(0.02, 0.1), (0.3, 0.0), (0.0, 0.0)])
@pytest.mark.parametrize(("vision", "reaction"), [(0.2, 0.1), (0.05, 0.4)])
def test_each_delay_of_the_operator_has_its_own_use(forward, backward, vision, reaction):
    """View and feeling are late by a queue; the effect of a movement comes after a round trip."""
    training = decision.OperatorTraining(np.eye(3), 1.0, 0.5, forward, backward, 0)
    senses = Perception(vision_delay=vision, reaction_time=reaction)
    person = decision.pack_operator_parameters(training, senses, Movement())
    round_trip = forward + backward + decision._STATION_REACTION_TIME_S
    assert person.vision_delay == pytest.approx(vision + round_trip)
    assert person.force_delay == pytest.approx(reaction + round_trip)
    config = replace(Scenario(), operator__task=Reach(), operator__perception=senses).operator
    arm = NominalSlave(Scenario().slave).arm
    block = Operator(config, np.eye(7)[0], training, arm, np.zeros(6))
    context = block.CreateDefaultContext()
    sizes = [context.get_discrete_state(k).size() for k in range(5)]
    # A value that is stored now is used after all others of its queue.
    rows = np.rint(np.array([vision + backward, reaction]) / decision.DECISION_PERIOD_S) + 1
    np.testing.assert_array_equal(sizes[3:], rows * [3, 5])
