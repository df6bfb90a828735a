"""One-axis parameters of a scenario against its models."""

import numpy as np
import phantom_arrays as arrays
import pytest

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.analysis.analyze import describe_origin_of_wall_stiffness
from drake_teleop.lab.analysis.linearization import network_delay_periods
from drake_teleop.lab.analysis.task_direction import OneAxisFromScenario, task_direction
from drake_teleop.lab.identification import slave_arm
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.channel.network import NetworkConfig
from drake_teleop.station.environment.sheet_spring import SheetSpring
from drake_teleop.station.environment.solids import Block, Wall
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.slave.arm import forward_kinematics
from drake_teleop.station.slave.joint_control import mass_matrix
from drake_teleop.station.slave.plant import NominalSlave
from drake_teleop.station.slave.slave_config import Payload


def test_device_mass_if_only_the_inner_link_moves():
    """Vertical force at q = 0: M22 over the link's length squared, with wrist and motor."""
    scenario = replace(Scenario(), master__position=[0.215, 0.0, -0.17])
    axis = OneAxisFromScenario(scenario, (0, 0, 2.0))
    assert axis.device_mass == pytest.approx(arrays.mass_matrix(np.zeros(6))[1, 1] / 0.215**2)
    assert axis.device_damping == pytest.approx(scenario.master.friction.viscous[1] / 0.215**2)


def test_axis_has_the_parameters_of_the_scenario():
    scenario = replace(
        Scenario(),
        channel=Channel(delay=0.02, backward=NetworkConfig(delay=0.04)),
        sheet_spring=SheetSpring(thickness=0.001),
        force_scaling__sigma_inertia=0.5,
        kinematic_scaling__translation_scale=2.0,
        operator__grip="firm",
    )
    estimate = np.concatenate([np.zeros(6), slave_arm(scenario).phi_load])
    estimate[6] += 0.1
    axis = task_direction(scenario, (1, 0, 0), load_estimate=estimate).axis
    assert (axis.hand_mass, axis.hand_stiffness, axis.sigma, axis.position_scale) == (
        *(0.5, 700.0, 0.5, 2.0),
    )
    assert axis.delay == pytest.approx(0.03)
    assert axis.tool_mass == pytest.approx(3.13)
    assert axis.mass_error == pytest.approx(0.1)
    assert axis.wall_stiffness == scenario.sheet_spring.stiffness
    assert OneAxisFromScenario(replace(scenario, sheet_spring=None), (1, 0, 0)).wall_stiffness == 0


@pytest.mark.parametrize(
    ("forward", "backward", "delay", "periods"),
    [
        ({"delay": 0.02, "playout": 0.05}, {"delay": 0.02}, 0.035, (100, 40)),
        ({"delay": 0.06, "playout": 0.05}, {"playout": 0.01}, 0.035, (120, 20)),
        ({"trace": "0.04"}, {"trace": "0.03", "playout": 0.1}, 0.07, (80, 200)),
        # Half a period more than 2 and 3 periods, as the network rounds.
        ({"delay": 1.25e-3}, {"delay": 1.75e-3}, 1.5e-3, (3, 4)),
    ],
)
def test_delay_is_the_age_at_which_the_network_delivers(
    tmp_path, forward, backward, delay, periods
):
    lines = []
    for settings in (forward, backward):
        if constant := settings.get("trace"):
            path = tmp_path / f"{constant}.csv"
            path.write_text(f"time,delay\n0,{constant}\n1,{constant}\n")
            settings = settings | {"trace": str(path)}
        lines.append(settings)
    channel = Channel(**lines[0], backward=NetworkConfig(**lines[1]))
    scenario = replace(Scenario(), channel=channel)
    assert OneAxisFromScenario(scenario, (0, 0, 1)).delay == pytest.approx(delay)
    assert network_delay_periods(scenario) == periods


@pytest.mark.parametrize(
    ("things", "stiffness", "what"),
    [
        ([Wall(stiffness=2e4)], 1 / (1 / 2e4 + 1 / 4e5), "the wall, in series with the tool"),
        ([SheetSpring(), Wall()], SheetSpring().stiffness, "the leaf"),
        ([Wall(), Block()], 0.0, "the paper's, because a wall and block is not analysed"),
    ],
)
def test_wall_stiffness_and_description_of_environments(things, stiffness, what):
    scenario = replace(Scenario(), environment=things)
    found = OneAxisFromScenario(scenario, (0, 0, 1)).wall_stiffness
    assert found == pytest.approx(stiffness)
    assert describe_origin_of_wall_stiffness(scenario, found > 0.0) == what


@pytest.mark.parametrize("direction", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, -2, 0.5)])
def test_free_slave_is_lighter_than_a_guided_one(direction):
    """A force along the tool causes little rotation."""
    task = task_direction(LoadScenario("free_motion_force"), direction)
    assert np.linalg.norm(task.tool[:3]) == pytest.approx(1.0)
    assert np.linalg.norm(task.tool[3:]) <= 0.2 + 1e-12
    assert 3.13 * task.tool_coupling < task.axis.slave_mass
    if direction == (0, 0, 1):
        assert task.tool_coupling == pytest.approx(1.0, abs=1e-3)


def test_masses_agree_with_jacobians_by_finite_differences():
    """The payload is beside the axis of the tool, and the direction is oblique."""
    payload = Payload(mass=2.0, com=[0.08, -0.05, 0.1])
    scenario = replace(LoadScenario("free_motion_force"), slave__payload=payload)
    slave, n_W = NominalSlave(scenario.slave), np.array([1.0, -2.0, 0.5]) / np.sqrt(5.25)
    arm = slave.arm

    def tip_and_com(q):
        R, p = np.empty((3, 3)), np.empty(3)
        forward_kinematics(arm.table, q, R, p)
        return np.array([p + R @ slave.tip, p + R @ arm.phi_load[1:4] / arm.phi_load[0]])

    steps = 1e-6 * np.eye(6)
    J = np.array([tip_and_com(slave.start + x) - tip_and_com(slave.start - x) for x in steps])
    of_tip, of_com = np.einsum("jpi,i->pj", J / 2e-6, n_W)
    rate = np.linalg.solve(mass_matrix(arm, slave.start), of_tip)
    task = task_direction(scenario, n_W)
    assert task.axis.slave_mass == pytest.approx(1.0 / (of_tip @ rate), rel=1e-6)
    assert task.tool_coupling == pytest.approx((of_com @ rate) / (of_tip @ rate), rel=1e-6)


def test_master_direction_follows_the_alignment():
    turned = replace(Scenario(), kinematic_scaling__alignment=[0.0, 0.0, np.pi / 2])
    task = task_direction(turned, (0, 1, 0))
    assert task.hand[:3] == pytest.approx([1, 0, 0], abs=1e-12)


def test_invalid_direction_or_pose_raises():
    with pytest.raises(DrakeTeleopError, match="cannot reach this displacement"):
        far = replace(Scenario(), kinematic_scaling__translation_scale=20.0)
        task_direction(far, (0, 0, 1), displacement=(0.05, 0, 0.05))
    eta = replace(
        Scenario(),
        force_scaling__sigma=0.0,
        force_scaling__eta=0.5,
        force_scaling__gripper_phi=[1.0] + [0.0] * 9,
    )
    with pytest.raises(DrakeTeleopError, match=r"force_scaling\.eta"):
        task_direction(eta, (0, 0, 1))
