"""A leader arm as a haptic device: motion, rendered wrench, limits, file."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce, MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import models_dir
from drake_teleop.station.master.data_sheets import Master
from drake_teleop.station.master.device import AddDeviceAndForceDisplay
from drake_teleop.station.master.leader import _update_pose_and_twist
from drake_teleop.station.master.leader_model import Leader
from drake_teleop.station.master_side import MakeMasterSide
from drake_teleop.station.scenario import LoadScenario, Scenario, replace

PERIOD = 5e-4
HOME = [0.2, -0.6, 1.9, 0.3, 0.5, -0.2]
PLACE = [0.27, 0.0, 0.03]
HAND = (0.15, 2e-4)
LEADER = Leader(
    file=str(models_dir() / "leader_arm.urdf"),
    hand_frame="hand",
    home=HOME,
    base_rotation=[0.1, -0.2, 0.4],
)
F = np.array([0.8, -0.5, 0.6, 0.01, -0.02, 0.015])


def leader(hand=HAND, **changes):
    return dataclasses.replace(LEADER, **changes).device(PLACE, *hand)


class ConnectedLeader:
    """Connected device and display; one call is one period."""

    def __init__(self, device):
        builder = DiagramBuilder()
        self.block, self.display = AddDeviceAndForceDisplay(builder, PERIOD, device, device.home)
        builder.ExportInput(self.block.GetInputPort("hand_wrench_E"), "hand")
        builder.ExportInput(self.display.GetInputPort("wrench_command"), "command")
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        self.context, self.steps = self.simulator.get_mutable_context(), 0

    def step(self, hand, command):
        self.diagram.GetInputPort("hand").FixValue(self.context, hand)
        self.diagram.GetInputPort("command").FixValue(self.context, command)
        shown = self.displayed()
        self.simulator.AdvanceTo((self.steps + 0.5) * PERIOD)
        self.steps += 1
        return shown

    def displayed(self):
        context = self.display.GetMyContextFromRoot(self.context)
        return np.array(self.display.GetOutputPort("force_to_master").Eval(context))

    def get(self, port):
        context = self.block.GetMyContextFromRoot(self.context)
        return np.array(self.block.GetOutputPort(port).Eval(context))


def test_motion_equals_drakes_plant_of_the_file():
    """Equal torques and hand force; the hand has no mass here."""
    device = leader(hand=(0.0, 0.0), damping=[0.01])
    held = ConnectedLeader(device)
    plant = MultibodyPlant(0.0)
    LEADER.add_to_plant(plant)
    plant.Finalize()
    simulator = Simulator(plant)
    simulator.get_mutable_integrator().set_target_accuracy(1e-12)
    context, frame = simulator.get_mutable_context(), plant.GetFrameByName("hand")
    plant.SetPositions(context, HOME)
    plant.get_applied_generalized_force_input_port().FixValue(context, np.zeros(6))
    for k in range(30):
        hand = F * np.array([np.sin(0.3 * k), 1.0, np.cos(0.2 * k), 1.0, 1.0, np.sin(0.4 * k)])
        displayed = held.step(hand, -0.5 * F)
        J = plant.CalcJacobianSpatialVelocity(
            context,
            JacobianWrtVariable.kV,
            frame,
            np.zeros(3),
            plant.world_frame(),
            plant.world_frame(),
        )
        weight = -plant.CalcGravityGeneralizedForces(context)
        torque = weight + J.T @ np.concatenate([displayed[3:], displayed[:3]])
        plant.get_actuation_input_port().FixValue(context, torque)
        push = ExternallyAppliedSpatialForce()
        push.body_index = frame.body().index()
        push.p_BoBq_B = frame.GetFixedPoseInBodyFrame().translation()
        push.F_Bq_W = SpatialForce(hand[3:], hand[:3])
        plant.get_applied_spatial_force_input_port().FixValue(context, [push])
        # The leader adds its own damping to that of the model.
        for joint in map(plant.get_joint, plant.GetJointIndices()):
            if joint.num_velocities():
                joint.SetDampingVector(context, joint.default_damping_vector() + 0.01)
        simulator.AdvanceTo((k + 1) * PERIOD)
    expected = np.concatenate([plant.GetPositions(context), plant.GetVelocities(context)])
    np.testing.assert_allclose(held.get("state"), expected, rtol=0, atol=1e-9)
    assert np.abs(expected[:6] - HOME).max() > 1e-4
    X_BH = frame.CalcPoseInWorld(context)
    home = plant.CreateDefaultContext()
    plant.SetPositions(home, HOME)
    X_home = frame.CalcPoseInWorld(home)
    pose = held.get("pose_master")
    moved = X_BH.translation() - X_home.translation()
    np.testing.assert_allclose(pose[4:], PLACE + moved, atol=1e-9)
    turned = (X_BH.rotation() @ X_home.rotation().inverse()).ToQuaternion().wxyz()
    np.testing.assert_allclose(pose[:4], turned * np.sign(turned[0]), atol=1e-9)


def test_hand_holds_only_the_shown():
    """The hand carries neither the arm's weight nor its own, for any base orientation."""
    held = ConnectedLeader(leader(friction=[0.0]))
    for _ in range(40):
        np.testing.assert_allclose(held.step(-F, F), F, rtol=1e-12)
    np.testing.assert_allclose(held.get("state")[:6], HOME, atol=1e-12)
    heavy = ConnectedLeader(leader(weight_carried=0.0))
    for _ in range(40):
        heavy.step(np.zeros(6), np.zeros(6))
    assert heavy.get("twist_master")[2] < -0.01


@pytest.mark.parametrize("hand", [(0.2, 0.0), (0.0, 3e-3), (0.15, 2e-4)])
def test_hand_adds_its_mass_and_its_inertia_about_every_axis(hand):
    free, held = leader(hand=(0.0, 0.0)), leader(hand=hand)
    for away in (0.0, 0.4, -0.7):
        q = free.home + away * np.array([1.0, -0.5, 0.8, 1.2, -0.9, 2.0])
        J = free.jacobian(q)
        added = held.mass_matrix(q) - free.mass_matrix(q)
        np.testing.assert_allclose(added, J.T @ np.diag(np.repeat(hand, 3)) @ J, atol=1e-14)


def test_work_of_hand_and_motors_equals_energy_plus_friction():
    """Kinetic energy only, because the motors carry the weight."""
    device = leader(friction=[0.01], damping=[0.02])
    held, work, lost = ConnectedLeader(device), 0.0, 0.0
    before = np.zeros(12)
    for k in range(200):
        hand, command = 1.5 * F * np.sin(0.05 * k), -0.4 * F
        displayed = held.step(hand, command)
        twist = device.jacobian(before[:6]) @ before[6:]
        after = held.get("state")
        both = 0.5 * (twist + held.get("twist_master"))
        work += PERIOD * (hand + displayed) @ both
        v = 0.5 * (before[6:] + after[6:])
        lost += PERIOD * v @ (0.01 * np.tanh(v / 0.02) + (0.02 + 0.005) * v)
        before = after
    energy = 0.5 * before[6:] @ device.mass_matrix(before[:6]) @ before[6:]
    assert lost > 0.1 * work
    assert energy + lost == pytest.approx(work, rel=3e-3)


def test_wrench_is_limited_by_the_motors_and_logged():
    device = leader(torque_limit=[0.9])
    held = ConnectedLeader(device)
    shown = held.step(np.zeros(6), 5 * F)
    assert 0.05 < shown[0] / F[0] < 4.9
    np.testing.assert_allclose(shown / F, shown[0] / F[0], rtol=1e-9)  # it keeps its direction
    plant = MultibodyPlant(0.0)
    LEADER.add_to_plant(plant)
    plant.Finalize()
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, HOME)
    torque = device.jacobian(np.array(HOME)).T @ shown - plant.CalcGravityGeneralizedForces(context)
    assert np.abs(torque).max() == pytest.approx(0.9, rel=1e-9)


@pytest.mark.parametrize("peak_torque", [0.002, 0.006])
def test_torque_is_limited_to_the_peak(peak_torque):
    shown = ConnectedLeader(leader(peak_torque=peak_torque)).step(np.zeros(6), F)
    assert np.abs(shown[3:]).max() == pytest.approx(peak_torque, rel=1e-9)


@pytest.mark.parametrize("peak_force", [0.2, 0.5])
def test_force_is_limited_to_the_peak(peak_force):
    shown = ConnectedLeader(leader(peak_force=peak_force)).step(np.zeros(6), F)
    assert np.linalg.norm(shown[:3]) == pytest.approx(peak_force, rel=1e-9)


@pytest.mark.parametrize("peak_torque", [0.0, 0.002])
@pytest.mark.parametrize("requested", [0.02, 3.0, 40.0])
def test_torque_above_the_peak_does_not_reduce_the_force(peak_torque, requested):
    """Motors need no torque for what is not displayed."""
    wrench = np.array([3.0, -2.0, 1.0, requested, -requested, requested])
    shown = ConnectedLeader(leader(peak_torque=peak_torque)).step(np.zeros(6), wrench)
    np.testing.assert_allclose(shown[:3], wrench[:3], rtol=1e-12)
    assert np.abs(shown[3:]).max() == pytest.approx(peak_torque)


def test_joints_have_end_stops():
    held = ConnectedLeader(leader(hand=(0.2, 1e-3)))
    for _ in range(800):
        held.step(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.3]), np.zeros(6))
    q, device = held.get("state")[:6], leader()
    limits = device.arm.lower, device.arm.upper
    assert np.isfinite(q).all()
    assert (q > limits[0] - 0.1).all() and (q < limits[1] + 0.1).all()
    beyond = np.clip(q, *limits) + np.where(q > 0, 1e-9, -1e-9)
    assert device.flag_samples_at_end_stop(
        np.array([HOME, np.maximum(beyond, limits[1] + 1e-6)])
    ).tolist() == [
        False,
        True,
    ]


@pytest.mark.parametrize("joint", [0, 3, 5])
def test_quaternion_of_the_grip_is_continuous_over_two_turns(joint):
    device = leader()
    q, pose = device.home.copy(), device.forward_kinematics(device.home)
    for _ in range(80):
        q[joint] += 4 * np.pi / 80
        before = pose.copy()
        _update_pose_and_twist(device.arm.table, q, np.zeros(6), pose, np.empty(6))
        assert pose[:4] @ before[:4] > 0.9
    np.testing.assert_allclose(pose, device.forward_kinematics(device.home), atol=1e-12)


@pytest.mark.slow
def test_inverse_kinematics_and_matrices_are_consistent():
    device = leader()
    q = device.home + 0.1
    back = device.inverse_kinematics(device.forward_kinematics(q))
    np.testing.assert_allclose(
        device.forward_kinematics(back), device.forward_kinematics(q), atol=1e-7
    )
    np.testing.assert_allclose(
        device.forward_kinematics(device.home), [1, 0, 0, 0, *PLACE], atol=1e-12
    )
    M = device.mass_matrix(q)
    np.testing.assert_allclose(M, M.T, atol=1e-15)
    assert (np.linalg.eigvalsh(M - leader(hand=(0.0, 0.0)).mass_matrix(q)) > -1e-12).all()


def test_station_ports_and_file_path_relative_to_scenario(tmp_path):
    (tmp_path / "arm.urdf").write_bytes((models_dir() / "leader_arm.urdf").read_bytes())
    (tmp_path / "mine.yaml").write_text(
        f"master: {{model: leader, leader: {{file: arm.urdf, hand_frame: hand, home: {HOME}}}}}\n"
    )
    scenario = LoadScenario(tmp_path / "mine.yaml")
    side = MakeMasterSide(scenario)
    assert side.GetOutputPort("master_state").size() == 12
    pose = side.GetOutputPort("pose_master").Eval(side.CreateDefaultContext())
    np.testing.assert_allclose(pose, [1, 0, 0, 0, *scenario.master.position], atol=1e-12)
    assert scenario.master.without_coulomb_friction_and_encoder_steps().leader.friction == []


@pytest.mark.parametrize(
    ("leader", "said"),
    [
        (None, "master.leader: model: leader without a block leader is invalid"),
        (Leader(hand_frame="hand"), "master.leader.file: a leader arm requires a file"),
        (
            dataclasses.replace(LEADER, home=[0.0]),
            "master.leader.home: has 1 numbers, but the arm has 6 joints; give 6, for",
        ),
        (dataclasses.replace(LEADER, hand_frame="elbow"), "no frames are named 'elbow'"),
        (
            dataclasses.replace(LEADER, home=[9.0, *HOME[1:]]),
            "leader joint yaw would be at 9, outside its limits",
        ),
        (
            dataclasses.replace(LEADER, package_paths=["none"]),
            "the package folder none does not exist; correct --package-path, or package_paths in"
            " slave or master.leader",
        ),
        (dataclasses.replace(LEADER, friction=[1.0]), "the friction stops the haptic device"),
    ],
)
def test_invalid_leader_gives_one_error(leader, said):
    scenario = replace(Scenario(), master=Master(model="leader", leader=leader))
    with pytest.raises(DrakeTeleopError, match=re.escape(said)):
        MakeMasterSide(scenario)


@pytest.mark.parametrize("name", ["home", "friction", "damping", "torque_limit"])
def test_each_setting_of_a_leaders_joints_is_finite(name):
    with pytest.raises(DrakeTeleopError, match=f"Leader.{name}: nan .* is outside"):
        dataclasses.replace(LEADER, **{name: [np.nan]})
