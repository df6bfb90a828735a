"""Leader arm in joint mode: two arms with equal kinematics and different sizes."""

from __future__ import annotations

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import models_dir
from drake_teleop.lab.analysis.linearization import linearize
from drake_teleop.lab.identification import true_load
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.master.data_sheets import Master
from drake_teleop.station.master.leader_model import Leader
from drake_teleop.station.operator.operator import Sine
from drake_teleop.station.scaling.kinematic_scaling import JointCoupling
from drake_teleop.station.scenario import LoadScenario, replace
from drake_teleop.station.simulation import simulate
from drake_teleop.station.slave.arm import jacobian, pose_into
from drake_teleop.station.slave.inverse_kinematics import IkStatus
from drake_teleop.station.slave.joint_commands import LeaderJointFollower
from drake_teleop.station.slave.plant import NominalSlave
from drake_teleop.station.slave.slave_config import Slave, Tool
from drake_teleop.station.station import MakeTeleopStation

HOME = [0.2, -0.6, 1.9, 0.3, 0.5, -0.2]
FILE = models_dir() / "leader_arm.urdf"
SCALE, FORCE = 2.0, 0.25  # lengths, slave over leader; forces, leader over slave


@pytest.fixture(scope="module")
def scenario(tmp_path_factory):
    """Return a scenario whose slave is the leader's model, twice as large."""
    path = tmp_path_factory.mktemp("arms") / "slave.urdf"

    def larger(match):
        return f'xyz="{" ".join(f"{SCALE * float(x):g}" for x in match[1].split())}"'

    origins = re.sub(r'(?<=<origin )xyz="([^"]*)"', larger, FILE.read_text())
    path.write_text(re.sub('effort="[^"]*"', 'effort="50"', origins))
    leader = Leader(file=str(FILE), hand_frame="hand", home=HOME, leads="joints")
    tool = Tool(mass=0.3, com=[0.01, -0.02, 0.04])
    slave = Slave(model=str(path), sensor_frame="hand", home=HOME, tool=tool)
    return replace(
        LoadScenario("free_motion_force"),
        slave=slave,
        master=Master(model="leader", leader=leader),
        wrist_sensor__ideal=True,
        force_scaling__sigma=0.5,
        force_scaling__force_scale=FORCE,
        simulation__settle=0.0,
        simulation__duration=0.1,
        operator__intent=[],
    )


def run(scenario):
    station = MakeTeleopStation(scenario, load_estimate=true_load(scenario))
    return simulate(station, scenario.simulation, progress=False)


@pytest.mark.slow
def test_each_slave_joint_follows_its_leader_joint(scenario):
    move = Sine(duration=1.0, ramp=0.02, frequency=4.0, translation=[0.03, 0.02, 0.03],
                rotation=[0.2, -0.1, 0.3])  # fmt: skip
    result = run(replace(scenario, operator__intent=[move]))
    slave = result["joint_command"]
    np.testing.assert_allclose(slave, result["master_state"][:, :6], rtol=0, atol=1e-12)
    assert np.ptp(slave, axis=0).min() > 1e-3
    assert (result["ik_status"] == IkStatus.OK).all()
    # The pose is S where the joints shall be, twice as far from the base as the hand.
    moved = result["pose_command"][-1, 4:] - result["pose_command"][0, 4:]
    hand = result["pose_master"][-1, 4:] - result["pose_master"][0, 4:]
    np.testing.assert_allclose(moved, SCALE * hand, rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_rendered_load_is_scaled_by_sigma_in_tool_axes(scenario):
    """J^T of the leader equals that of the slave except for its size."""
    result = run(scenario)
    felt, measured = (result[name][-1].copy() for name in ("force_to_master", "measured_wrench_S"))
    slave, device = NominalSlave(scenario.slave), scenario.master.device(0.0, 0.0)
    q, X_WS, J = np.array(result["joint_position"][-1]), np.empty(7), np.empty((6, 6))
    pose_into(slave.arm.table, q, X_WS)
    R_WS = Rotation.from_quat(X_WS[:4], scalar_first=True)
    for part in (slice(0, 3), slice(3, 6)):
        expected = -FORCE * 0.5 * R_WS.apply(measured[part])
        np.testing.assert_allclose(felt[part], expected, atol=0.01 * np.abs(expected).max())
    assert felt[2] == pytest.approx(-FORCE * 0.5 * 0.3 * 9.81, rel=0.05)
    jacobian(slave.arm.table, q, J)
    size = np.repeat([1.0 / SCALE, 1.0], 3)[:, None]
    np.testing.assert_allclose(device.jacobian(q), size * J, atol=1e-12)


def test_open_clutch_holds_and_closed_clutch_returns(scenario):
    slave = NominalSlave(scenario.slave)
    start = slave.start + np.linspace(-0.1, 0.2, 6)
    coupling = JointCoupling(slave.arm, start, np.array(HOME), 0.01)
    context = coupling.CreateDefaultContext()
    leads, clutch = coupling.GetInputPort("master_state"), coupling.GetInputPort("clutch")
    joints = coupling.GetOutputPort("leader_joints")
    away = np.append(np.array(HOME) + 0.1, np.zeros(6))
    for closed, expected in ((0.0, start), (1.0, start + 0.1), (0.0, start + 0.1)):
        leads.FixValue(context, away)
        clutch.FixValue(context, [closed])
        coupling.ExecuteInitializationEvents(context)
        np.testing.assert_allclose(joints.Eval(context), expected)
        leads.FixValue(context, np.append(HOME, np.zeros(6)))
    np.testing.assert_allclose(joints.Eval(context), start + 0.1)


def test_clutch_that_opens_while_the_leader_is_not_finite_holds_the_last_command(scenario):
    slave = NominalSlave(scenario.slave)
    coupling = JointCoupling(slave.arm, slave.start, np.array(HOME), 0.01)
    context = coupling.CreateDefaultContext()
    leads, clutch = coupling.GetInputPort("master_state"), coupling.GetInputPort("clutch")
    for leader, closed in ((0.1, 1.0), (0.1, 1.0), (np.nan, 1.0), (np.nan, 0.0)):
        leads.FixValue(context, np.append(np.array(HOME) + leader, np.zeros(6)))
        clutch.FixValue(context, [closed])
        coupling.ExecuteInitializationEvents(context)
    np.testing.assert_allclose(
        coupling.GetOutputPort("leader_joints").Eval(context), slave.start + 0.1
    )


def test_follower_respects_position_and_speed_limits(scenario):
    slave = NominalSlave(scenario.slave)
    follower = LeaderJointFollower(slave.arm, slave.start, 0.001)
    context = follower.CreateDefaultContext()
    port, command = follower.get_input_port(), follower.GetOutputPort("joint_command")
    port.FixValue(context, slave.arm.upper + 1.0)
    assert follower.GetOutputPort("ik_status").Eval(context)[0] == IkStatus.JOINT_LIMIT
    step = command.Eval(context) - slave.start
    np.testing.assert_allclose(step, 1e-3 * slave.arm.velocity_limit)
    port.FixValue(context, np.full(6, np.nan))
    assert follower.GetOutputPort("ik_status").Eval(context)[0] == IkStatus.BAD_POSE
    np.testing.assert_array_equal(command.Eval(context), slave.start)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"channel": Channel(delay=0.01)}, "leader.leads: a leader that commands joints requires"),
        ({"slave__sensor_frame": "wrist_2", "slave__home": HOME[:5]}, "6 joints, but the slave 5"),
    ],
)
def test_unsupported_joint_mode_is_rejected(scenario, change, expected):
    with pytest.raises(DrakeTeleopError, match=expected):
        MakeTeleopStation(replace(scenario, **change), load_estimate=true_load(scenario))


def test_analysis_rejects_joint_mode(scenario):
    with pytest.raises(DrakeTeleopError, match=r"master\.leader\.leads"):
        linearize(scenario, load_estimate=true_load(scenario))
