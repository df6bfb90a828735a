"""An experiment in virtual time, driven by messages of the page."""

from __future__ import annotations

import json

import numpy as np
import pytest

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.progress import show_no_progress
from drake_teleop.lab.identified_load import IdentifiedLoad
from drake_teleop.live.experiment.apparatus import IntervalLog, make_apparatus
from drake_teleop.live.experiment.design import (
    ApparentMass,
    Condition,
    ContactDetection,
    Experiment,
)
from drake_teleop.live.experiment.guided import (
    HAND_MOTION_INPUTS,
    GuidedExperiment,
    parse_experiment_message,
)
from drake_teleop.live.experiment.procedure import Procedure
from drake_teleop.live.experiment.store import TrialStore
from drake_teleop.live.inputs import Inputs
from drake_teleop.live.session import read_drive
from drake_teleop.load.identification import Identification
from drake_teleop.station.operator.task import Insert
from drake_teleop.station.scenario import LoadScenario, replace
from drake_teleop.station.slave.plant import NominalSlave

EXPERIMENT = Experiment(
    tasks=[ContactDetection(trials=1, practice=0, interval=0.5)],
    conditions=[Condition(name="secret", sigma=0.37)],
)


class Participant:
    """Participant with a clock who presses in each interval."""

    def __init__(self, folder) -> None:
        scenario = LoadScenario("contact_transition")
        place = [0.55, 0.0, 0.233]  # 6 mm below the tool
        scenario = replace(scenario, sheet_spring__position=place, wrist_sensor__ideal=True)
        phi = NominalSlave(scenario.slave).arm.phi_load
        truth = Identification(
            phi=phi, offsets=np.zeros(6), covariance=np.eye(16), identifiable=np.ones(16, bool),
            condition_number=1.0, delay_s=0.0, residual_rms=np.zeros(6),
            method="known", samples=0,
        )  # fmt: skip
        load = IdentifiedLoad(truth, None, from_cache=False)
        task, condition = EXPERIMENT.tasks[0], EXPERIMENT.conditions[0]
        self.now, self.folder, self.frames = 0.0, folder, []
        self.store = TrialStore(folder)
        self.procedure = Procedure(EXPERIMENT, 1, self.store)
        self.guided = GuidedExperiment(
            self.procedure,
            {(0, 0): make_apparatus(task, condition, scenario, load)},
            [lambda rows: {}],
            self.now,
        )
        self.guided.join(1, self.now)

    def send(self, client: int = 1, **message) -> None:
        self.guided.handle_message(client, json.dumps(message), self.now)

    def wait(self, phase: str, seconds: float = 3.0) -> None:
        """Simulate until a phase of the procedure."""
        end = self.now + seconds
        while self.procedure.phase != phase and self.now < end:
            self.now += 0.005
            frame = self.guided.tick(lambda: self.now)
            if frame is not None:
                self.frames.append(frame)
        assert self.procedure.phase == phase

    def begin(self) -> None:
        for _ in range(3):
            self.send(go=True)
        assert self.procedure.phase == "interval"


SCALED = replace(
    LoadScenario("touch"),
    kinematic_scaling__translation_scale=2.0,
    force_scaling__force_scale=0.1,
)


@pytest.mark.parametrize(
    ("condition", "shown"), [(Condition(sigma=0.2), 0.2), (Condition(eta=0.5), 0.5)]
)
def test_stimulus_and_measured_level_of_a_mass_agree(condition, shown):
    """The mass is that of the object with eta, else of the tool; both scales reduce it."""
    made = make_apparatus(ApparentMass(), condition, SCALED, None)
    payload = made.scenario.slave.payload.mass
    mass = payload if condition.eta else NominalSlave(SCALED.slave).arm.phi_load[0]
    assert payload > 0.0 or condition.eta is None
    assert made.load_mass_at_hand == pytest.approx(mass * 0.1 * 2.0)
    level = 0.3 * made.load_mass_at_hand
    inputs = made.stimulus_scales(level, 8.0)
    assert inputs["sigma_object"] == round(100 * (shown + 0.3)) and inputs["gamma"] == 100
    assert inputs["sigma"] == (0 if condition.eta else inputs["sigma_object"])
    assert made.stimulus_scales(0.0, 8.0)["sigma_object"] == round(100 * shown)
    rows = IntervalLog(SCALED, None)
    assert made.interval_result(level, inputs, rows).level == pytest.approx(level)
    assert made.interval_result(0.0, inputs, rows).level == 0.0


@pytest.mark.parametrize(
    ("changes", "condition", "low", "accepted"),
    [
        ({}, Condition(name="a", sigma=3.0), 0.004, False),
        ({}, Condition(name="a", sigma=2.99), 0.004, True),
        ({}, Condition(name="a", sigma=2.99), 0.1, False),
        ({}, Condition(name="a", eta=1.0), 0.1, True),
        ({"force_scaling__force_scale": 0.0}, Condition(name="a"), 0.004, False),
    ],
)
def test_condition_without_a_stimulus_of_mass_is_refused(changes, condition, low, accepted):
    """The scales of the load end at 300 %, so that a larger share leaves nothing to add."""
    scenario, task = replace(SCALED, **changes), ApparentMass(low=low, high=2.0 * low)
    if not accepted:
        said = r"^condition 'a': adds at most .* below `low` of the task"
        with pytest.raises(DrakeTeleopError, match=said):
            make_apparatus(task, condition, scenario, None)
        make_apparatus(ContactDetection(), condition, scenario, None)
        return
    made = make_apparatus(task, condition, scenario, None)
    inputs = made.stimulus_scales(low, 8.0)
    assert made.interval_result(low, inputs, IntervalLog(SCALED, None)).level > 0.5 * low


@pytest.mark.parametrize("own", [(1.0, None), (None, 0.3), (0.5, 2.0)])
@pytest.mark.parametrize("sigma", [0.0, 0.4])
def test_scale_of_the_condition_replaces_separate_scales_of_the_scenario(sigma, own):
    weight, inertia = own
    scenario = replace(
        SCALED, force_scaling__sigma_weight=weight, force_scaling__sigma_inertia=inertia
    )
    made = make_apparatus(ApparentMass(), Condition(sigma=sigma), scenario, None)
    inputs = Inputs.from_scenario(made.scenario).with_changes(made.stimulus_scales(0.0, 8.0))
    assert inputs.force_scales["sigma_weight"] is None
    assert inputs.force_scales["sigma_gripper"] == pytest.approx(sigma)


def test_stimulus_and_measured_level_of_a_contact_agree():
    made = make_apparatus(ContactDetection(), Condition(sigma=0.2, gamma=2.0), SCALED, None)
    assert made.stimulus_scales(0.0, 8.0) == {"sigma": 20, "sigma_object": 20, "gamma": 0}
    inputs = made.stimulus_scales(3.0, 8.0)
    assert inputs["gamma"] == 75  # 3/8 of 200 %
    for force, valid in ((6.0, True), (0.4, False)):
        rows = IntervalLog(SCALED, None)
        contact = np.tile([0.0, 0.0, -force, 1.0, 1.0, 1.0], (200, 1))
        t, shown = 1e-3 * np.arange(200), np.zeros((200, 6))
        rows.add_rows({"t": t, "true_contact_wrench_W": contact, "force_to_master": shown})
        result = made.interval_result(3.0, inputs, rows)
        assert result.level == pytest.approx(force * 3.0 / 8.0)
        assert (result.valid, result.force_N) == (valid, pytest.approx(force))


@pytest.mark.parametrize(("height", "done"), [(0.04, True), (0.037, False), (0.0, False)])
def test_peg_is_done_after_200_ms_on_the_floor(height, done):
    """The mouth of a slot of 40 mm is `height` above the tip."""
    slave = NominalSlave(SCALED.slave)
    rows = IntervalLog(SCALED, Insert(translation=[0.0, 0.0, height], depth=0.04))
    state = np.concatenate([slave.start, np.zeros(6)])
    for t in (0.1, 0.2, 0.29, 0.31):
        rows.add_rows(
            {"t": [t], "force_to_master": np.zeros((1, 6)), "slave_state": state[np.newaxis]}
        )
        assert rows.done_at == (0.1 if done and t > 0.3 else 0.0)


@pytest.mark.slow
def test_trial_from_consent_to_results_and_its_drives_repeat(tmp_path):
    person = Participant(tmp_path)
    person.send(answer=1)  # not in the phase of an answer
    person.begin()
    person.send(set={"z": -1500, "sigma": 300, "gamma": 0})
    person.wait("gap")
    person.wait("interval")
    person.send(set={"z": -2500})
    person.wait("answer")
    person.send(client=2, answer=1)  # spectator
    assert person.procedure.phase == "answer"
    person.send(answer=2)
    (row,) = person.store.read_rows(1)
    assert row.answer == 2 and row.force_N > 1.0 and row.level > 0.0
    assert person.procedure.phase == "end"
    person.guided.close()
    drive = read_drive(tmp_path / "drives" / "01" / "0000-1")
    assert all(inputs.sigma == 37 for ms, inputs in drive.changes[1:])
    assert drive.repeat(show_no_progress).t[-1] == pytest.approx(0.5, abs=0.03)
    messages = json.dumps(person.frames) + json.dumps(person.guided.hello_message())
    assert "secret" not in messages
    assert all(f["inputs"]["sigma"] == 0 and f["inputs"]["gamma"] == 100 for f in person.frames)
    forces = [f["f"] for f in person.frames]
    assert all(f[0] == f[1] == f[2] for f in forces)


@pytest.mark.slow
def test_trial_restarts_after_the_page_is_closed(tmp_path):
    person = Participant(tmp_path)
    person.begin()
    person.send(set={"z": -1500})
    person.wait("gap")
    person.guided.leave(1, person.now)
    assert (person.procedure.phase, person.procedure.interval) == ("ready", 1)
    person.send(client=2, go=True)  # participant has disconnected
    person.guided.join(3, person.now)
    person.send(client=3, go=True)
    assert person.procedure.phase == "interval" and person.store.participant_numbers() == []


@pytest.mark.slow
def test_10000_random_messages_change_only_permitted_inputs():
    rng = np.random.default_rng(0)
    pieces = [
        "{",
        "}",
        '"go"',
        '"answer"',
        ":",
        "true",
        "1",
        "3",
        "1.0",
        "null",
        ",",
        '"set"',
        "NaN",
    ]
    pieces += ['{"x":1e999}', '{"sigma":5}', '[[[["', "\u0000", '"drive"', "é", "-1e308", "[" * 200]
    heard = [
        parse_experiment_message("".join(rng.choice(pieces, rng.integers(1, 9))))
        for _ in range(10_000)
    ]
    for found in filter(None, heard):
        assert set(found) <= {"set", "drive", "go", "answer"}
        assert found.get("answer", 1) in (1, 2) and set(found.get("set", {})) <= set(
            HAND_MOTION_INPUTS
        )
    for bad in (
        b"{}",
        None,
        7,
        '{"answer": true}',
        '{"answer": 1.0}',
        '{"answer": 3}',
        '{"go": 1}',
    ):
        assert parse_experiment_message(bad) is None
    assert parse_experiment_message('{"set": {"sigma": 5, "x": 3}}') == {"set": {"x": 3}}
    assert parse_experiment_message('{"answer": 2}') == {"answer": 2}
