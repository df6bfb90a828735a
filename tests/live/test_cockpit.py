"""Frames of the page from rows of the log."""

from __future__ import annotations

import numpy as np
import pytest

from drake_teleop.common.blocks import FAULT_WARNINGS, Fault
from drake_teleop.lab.identification import slave_arm
from drake_teleop.live.cockpit import PageValueCalculator
from drake_teleop.live.inputs import INPUT_RANGES, Inputs
from drake_teleop.live.session import Session
from drake_teleop.station.slave.arm import forward_kinematics
from drake_teleop.station.slave.inverse_kinematics import IkStatus

N = 6  # joints


@pytest.fixture
def rows(scenario, load):
    """Return rows of a station at rest without warnings."""
    session = Session(scenario, load)
    session.advance()
    rows = session.new_rows()
    assert PageValueCalculator(scenario).page_values(rows, Inputs())["words"] == []
    return rows


def words(scenario, rows, inputs=Inputs()):  # noqa: B008 (it does not change)
    return PageValueCalculator(scenario).page_values(rows, inputs)["words"]


def test_joints_at_their_limits_are_named(scenario, rows):
    arm = slave_arm(scenario)
    speeds, torques = arm.velocity_limit, arm.effort_limit
    rows["slave_state"][0, N + 1], rows["slave_state"][2, N + 3] = -speeds[1], speeds[3]
    rows["joint_torque"][1, 5] = 0.9995 * torques[5]
    assert torques[5] < torques[0]
    assert words(scenario, rows) == [
        "joint 2, 4 at the limit of its speed",
        "joint 6 at the limit of its torque",
    ]
    rows["slave_state"][:, N:] = 0.99 * speeds
    rows["joint_torque"][:] = -0.99 * torques
    assert words(scenario, rows) == []


@pytest.mark.slow
def test_limits_faults_and_silence_are_reported_in_words(scenario, rows):
    peak = scenario.master.device(0.0, 0.0).parameters.peak_force
    strongest = f"the device renders its largest force, {peak:g} N"
    for name, change, said in (
        ("ik_status", IkStatus.OUT_OF_REACH, "the arm cannot reach the position of the hand"),
        ("saturated", 1.0, "the wrist sensor is saturated"),
        ("force_to_master", [0, 0, -peak, 0, 0, 0], strongest),
        ("hand_wrench_E", [0, 60, 0, 0, 0, 0], "the simulated hand pulls with its largest force"),
        ("ports", [0, 0, 0, 0, 0, 0.06, 0, 0], "the network delivers no packets"),
        ("fault", float(Fault.HAND_WRENCH), FAULT_WARNINGS[Fault.HAND_WRENCH]),
    ):
        found = {key: values.copy() for key, values in rows.items()}
        found.setdefault(name, np.zeros((len(rows["t"]), np.size(change))))[1] = change
        assert words(scenario, found) == [said]
    edge = Inputs(y=INPUT_RANGES["y"][0])
    assert words(scenario, rows, edge) == ["the hand is at the edge of its box, 0.3 m wide"]


@pytest.mark.slow
def test_forces_are_at_the_hands_scale_without_sensor_offset(scenario, rows):
    n = len(rows["t"])
    for name, first, last in (
        ("measured_wrench_S", [13.0, 0.0, 4.0], [10.0, 5.0, 12.0]),
        ("contact_wrench_S", [0.0, 0.0, 0.0], [0.0, -6.0, 8.0]),
        ("force_to_master", [0.0, 1.0, 0.0], [2.0, 0.0, 0.0]),
    ):
        rows[name] = np.zeros((n, 6))
        rows[name][0, :3], rows[name][1:, :3] = first, last
    rows["load_estimate"] = np.tile([10.0, *np.zeros(15)], (n, 1))
    frame = PageValueCalculator(scenario).page_values(rows, Inputs(force_scale=50_000))
    assert frame["f"] == [[2.5, 6.5], [0.0, 5.0], [1.0, 2.0]] and frame["contact"]


@pytest.mark.parametrize("p_SC", [[0.0, 0.0, 0.0], [0.1, -0.05, 0.2]])
@pytest.mark.parametrize("joints", [[5], [3, 4, 5], range(N)])
def test_work_on_a_contact_is_force_times_displacement_of_its_point(scenario, rows, joints, p_SC):
    """A constant force at a point C of the tool; the joints rotate by up to 0.3 rad."""
    arm, count, f_W = slave_arm(scenario), 400, np.array([3.0, -5.0, 8.0])
    R_WS, p_WS = np.empty((3, 3)), np.empty(3)
    found = {name: np.repeat(values[:1], count, axis=0) for name, values in rows.items()}
    found["t"], places = 1e-3 * np.arange(count), []
    found["contact_wrench_S"] = np.zeros((count, 6))
    for k in range(count):
        for joint in joints:
            found["slave_state"][k, joint] += 0.3 * k / count / (1 + joint % 2)
        forward_kinematics(arm.table, found["slave_state"][k, :N], R_WS, p_WS)
        places.append(p_WS + R_WS @ p_SC)
        f_S = R_WS.T @ f_W
        found["contact_wrench_S"][k] = *f_S, *np.cross(p_SC, f_S)
    frame = PageValueCalculator(scenario).page_values(found, Inputs())
    expected = f_W @ (places[-1] - places[0])
    assert frame["energy"][1] == pytest.approx(expected, abs=2e-3 + 5e-3 * abs(expected))
    assert frame["tool"] == pytest.approx(p_WS, abs=1e-5)
