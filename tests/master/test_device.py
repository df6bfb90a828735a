"""Kinematics, dynamics and end stops of the Phantom."""

from __future__ import annotations

import numpy as np
import phantom_arrays as arrays
import pytest
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.master import device, dynamics, phantom
from drake_teleop.station.master.data_sheets import Master, PhantomJointFriction
from drake_teleop.station.master.force_display import initial_display_state

NO_FRICTION = PhantomJointFriction(coulomb=[0.0] * 6, viscous=[0.0] * 6)


def random_postures(count: int, seed: int = 0) -> np.ndarray:
    """Return postures inside all joint limits, including the five-bar's."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(phantom.JOINT_LOWER_RAD, phantom.JOINT_UPPER_RAD, (40 * count, 6))
    lower, upper = phantom.Q2_MINUS_Q3_RANGE_RAD
    allowed = (q[:, 1] - q[:, 2] > lower) & (q[:, 1] - q[:, 2] < upper)
    return q[allowed][:count]


def parameters(hand_mass=0.0, hand_inertia=0.0, friction=NO_FRICTION) -> np.ndarray:
    return Master(friction=friction).device(hand_mass, hand_inertia).parameters


def acceleration(q, v, wrench, torque, parameters) -> np.ndarray:
    vdot = np.empty(6)
    phantom.joint_acceleration_into(q, v, wrench, torque, parameters, np.empty((2, 6, 6)), vdot)
    return vdot


def main_mass_matrix(q) -> np.ndarray:
    """Return the mass matrix (3, 3) of the main axes without wrist, motors and hand."""
    M = np.empty((6, 6))
    phantom._mass_matrix_of_joints_1_to_3_into(q, M)
    return M[:3, :3]


def main_gravity(q) -> np.ndarray:
    """Return the gravity torque (3,) of the main axes without wrist."""
    return np.array(
        [
            0.0,
            phantom._JOINT_2_GRAVITY_N_M * np.cos(q[1]),
            phantom._JOINT_3_GRAVITY_N_M * np.sin(q[2]),
        ]
    )


def potential_energy(q) -> float:
    """Return the potential energy of device and wrist [J]."""
    weight = phantom.WRIST_MASS_KG * phantom.GRAVITY_M_S2
    height = (phantom._JOINT_2_GRAVITY_N_M + weight * phantom.L1) * np.sin(q[1])
    return height - (phantom._JOINT_3_GRAVITY_N_M + weight * phantom.L2) * np.cos(q[2])


def energy(state, hand_mass=0.0, hand_inertia=0.0) -> float:
    q, v = state[:6], state[6:]
    M = arrays.mass_matrix(q, hand_mass, hand_inertia)
    return 0.5 * v @ M @ v + potential_energy(q)


def advance(state, wrench, torque, parameters, period, steps) -> np.ndarray:
    state, work, stages = state.copy(), np.empty((2, 6, 6)), np.empty((3, 12))
    for _ in range(steps):
        dynamics.step_device(state, wrench, torque, parameters, period, work, stages)
    return state


def rotation(pose) -> np.ndarray:
    return RotationMatrix(Quaternion(pose[:4])).matrix()


def test_main_axes_equal_the_closed_forms_of_the_literature():
    l1, l2, l3, l5, l6 = 0.215, 0.170, 0.0325, -0.0368, 0.0527
    ma, mc, mbe, mdf, g = 0.0202, 0.0249, 0.2359, 0.1906, 9.81
    Ia_xx, Ia_yy, Ia_zz = 0.4864e-4, 0.001843e-4, 0.4864e-4
    Ic_xx, Ic_yy, Ic_zz = 0.959e-4, 0.959e-4, 0.0051e-4
    Ibe_xx, Ibe_yy, Ibe_zz = 11.09e-4, 10.06e-4, 0.591e-4
    Idf_xx, Idf_yy, Idf_zz = 7.11e-4, 0.629e-4, 6.246e-4
    Ibase_yy = 11.87e-4
    for q in random_postures(100):
        _, q2, q3 = q[:3]
        expected = np.zeros((3, 3))
        expected[0, 0] = (
            (4 * Ia_yy + 4 * Ia_zz + 8 * Ibase_yy + 4 * Ibe_yy + 4 * Ibe_zz + 4 * Ic_yy
             + 4 * Ic_zz + 4 * Idf_yy + 4 * Idf_zz + 4 * l1**2 * ma + l2**2 * ma
             + l1**2 * mc + 4 * l3**2 * mc) / 8
            + (4 * Ibe_yy - 4 * Ibe_zz + 4 * Ic_yy - 4 * Ic_zz + l1**2 * (4 * ma + mc)) / 8
            * np.cos(2 * q2)
            + (4 * Ia_yy - 4 * Ia_zz + 4 * Idf_yy - 4 * Idf_zz - l2**2 * ma - 4 * l3**2 * mc) / 8
            * np.cos(2 * q3)
            + l1 * (l2 * ma + l3 * mc) * np.cos(q2) * np.sin(q3)
        )  # fmt: skip
        expected[1, 1] = Ibe_xx + Ic_xx + l1**2 * (ma + mc / 4)
        expected[2, 2] = Ia_xx + Idf_xx + l2**2 * ma / 4 + l3**2 * mc
        expected[1, 2] = expected[2, 1] = -l1 * (l2 * ma + l3 * mc) * np.sin(q2 - q3) / 2
        gravity = [
            0.0,
            g / 2 * (2 * l1 * ma + 2 * l5 * mbe + l1 * mc) * np.cos(q2),
            g / 2 * (l2 * ma + 2 * l3 * mc - 2 * l6 * mdf) * np.sin(q3),
        ]
        np.testing.assert_allclose(main_mass_matrix(q), expected, atol=1e-15)
        np.testing.assert_allclose(main_gravity(q), gravity, atol=1e-15)


def test_stylus_is_level_and_points_to_operator_at_home():
    np.testing.assert_allclose(
        arrays.forward_kinematics(phantom.HOME_POSTURE_RAD),
        [1, 0, 0, 0, 0.215, 0, -0.170],
        atol=1e-15,
    )


def test_forward_kinematics_is_the_product_of_its_axes():
    for q in random_postures(100):
        pose = arrays.forward_kinematics(q)
        Rx, Ry, Rz = (
            RotationMatrix.MakeXRotation,
            RotationMatrix.MakeYRotation,
            RotationMatrix.MakeZRotation,
        )
        expected = Rz(q[0]) @ Ry(-q[2]) @ Rz(q[3]) @ Ry(q[4]) @ Rx(q[5])
        np.testing.assert_allclose(rotation(pose), expected.matrix(), atol=1e-14)
        in_plane = [0.215 * np.cos(q[1]) + 0.17 * np.sin(q[2]), 0.0,
                    0.215 * np.sin(q[1]) - 0.17 * np.cos(q[2])]  # fmt: skip
        np.testing.assert_allclose(pose[4:], Rz(q[0]) @ in_plane, atol=1e-15)


def test_jacobian_is_the_derivative_of_the_pose():
    step = 1e-6
    for q in random_postures(50):
        numeric = np.empty((6, 6))
        R = rotation(arrays.forward_kinematics(q))
        for k in range(6):
            ahead = arrays.forward_kinematics(q + step * np.eye(6)[k])
            behind = arrays.forward_kinematics(q - step * np.eye(6)[k])
            numeric[:3, k] = (ahead[4:] - behind[4:]) / (2 * step)
            cross = (rotation(ahead) - rotation(behind)) / (2 * step) @ R.T
            numeric[3:, k] = cross[2, 1], cross[0, 2], cross[1, 0]
        np.testing.assert_allclose(arrays.jacobian(q), numeric, atol=1e-9)


def test_inverse_kinematics_returns_the_joint_angles():
    for q in random_postures(300):
        reach = 0.215 * np.cos(q[1]) + 0.17 * np.sin(q[2])
        if reach < 0.01 or abs(q[4]) > 1.56:
            continue  # the other branch of the yaw or of the wrist
        np.testing.assert_allclose(
            phantom.inverse_kinematics(arrays.forward_kinematics(q)), q, atol=1e-9
        )


@pytest.mark.parametrize(
    ("position", "message"),
    [
        ([0.5, 0.0, 0.0], "cannot reach"),
        ([0.384, 0.0, 0.0], "q2 - q3"),
        ([0.05, 0.0, 0.0], "joint 3"),
    ],
)
def test_start_pose_out_of_reach_is_rejected(position, message):
    with pytest.raises(DrakeTeleopError, match=message):
        phantom.inverse_kinematics(np.array([1.0, 0, 0, 0, *position]))


def test_mass_matrix_is_positive_definite_over_the_workspace():
    for q in random_postures(2000):
        M = arrays.mass_matrix(q)
        np.testing.assert_array_equal(M, M.T)
        assert np.linalg.eigvalsh(M)[0] > 1e-5


def test_hand_adds_only_its_kinetic_energy():
    rng = np.random.default_rng(1)
    for q in random_postures(20):
        v = rng.normal(size=6)
        twist = arrays.jacobian(q) @ v
        added = arrays.mass_matrix(q, 0.3, 2e-4) - arrays.mass_matrix(q)
        expected = 0.3 * twist[:3] @ twist[:3] + 2e-4 * twist[3:] @ twist[3:]
        assert v @ added @ v == pytest.approx(expected, rel=1e-12)


def test_wrist_is_a_point_mass_and_three_rotating_links():
    rng = np.random.default_rng(2)
    for q in random_postures(20):
        v = rng.normal(size=6)
        J = arrays.jacobian(q)
        main = np.zeros((6, 6))
        main[:3, :3] = main_mass_matrix(q)
        motors = np.array([13.3, 11.2, 11.2]) ** 2 * 1.08e-6
        expected = v @ main @ v + motors @ v[:3] ** 2 + 0.15 * np.sum((J[:3] @ v) ** 2)
        for last in (4, 5, 6):
            expected += 5e-5 * np.sum((J[3:, :last] @ v[:last]) ** 2)
        assert v @ arrays.mass_matrix(q) @ v == pytest.approx(expected, rel=1e-12)


def test_gravity_is_the_gradient_of_the_potential_energy():
    step = 1e-5
    for q in random_postures(20):
        gradient = [
            (potential_energy(q + step * e) - potential_energy(q - step * e)) / (2 * step)
            for e in np.eye(6)
        ]
        np.testing.assert_allclose(arrays.gravity_torque(q), gradient, atol=1e-9)
        wrist = arrays.gravity_torque(q)[:3] - main_gravity(q)
        np.testing.assert_allclose(wrist, 0.15 * 9.81 * arrays.jacobian(q)[2, :3], atol=1e-15)


def test_coriolis_follows_from_the_mass_matrix():
    """Compare with numerically differentiated Christoffel symbols, with hand and wrist."""
    rng = np.random.default_rng(3)
    hand = (0.25, 2e-4)
    step = 1e-5
    for q in 0.9 * random_postures(30, seed=4):
        v = rng.normal(size=6)
        dM = np.array(
            [
                (arrays.mass_matrix(q + step * e, *hand) - arrays.mass_matrix(q - step * e, *hand))
                / (2 * step)
                for e in np.eye(6)
            ]
        )
        coriolis = np.einsum("ikj,i,j->k", dM, v, v) - 0.5 * np.einsum("kij,i,j->k", dM, v, v)
        wrench, torque = rng.normal(size=6), rng.normal(size=6)
        vdot = acceleration(q, v, wrench, torque, parameters(*hand))
        balance = (
            arrays.mass_matrix(q, *hand) @ vdot
            + coriolis
            + arrays.gravity_torque(q)
            - torque
            - arrays.jacobian(q).T @ wrench
        )
        np.testing.assert_allclose(balance, 0, atol=1e-9)


def free_state() -> np.ndarray:
    return np.array([0.1, 0.3, 0.2, -0.4, 0.3, 0.2, 0.6, -0.9, 0.8, 3.0, -2.0, 4.0])


def test_energy_is_conserved_in_free_motion_to_fourth_order():
    drift = []
    for steps in (50, 100):
        after = advance(free_state(), np.zeros(6), np.zeros(6), parameters(), 0.1 / steps, steps)
        drift.append(abs(energy(after) - energy(free_state())))
    assert drift[0] < 1e-6
    assert 10 < drift[0] / drift[1] < 60  # 16 or 32: fourth order or better
    at_hand_rate = advance(free_state(), np.zeros(6), np.zeros(6), parameters(), 5e-4, 200)
    assert energy(at_hand_rate) == pytest.approx(energy(free_state()), abs=1e-9)


def test_friction_dissipates_energy():
    friction = parameters(friction=PhantomJointFriction())
    torque = np.zeros(6)
    state = free_state()
    for _ in range(200):
        after = advance(state, np.zeros(6), torque, friction, 5e-4, 1)
        assert energy(after) < energy(state)
        state = after


def test_energy_balance_with_held_inputs():
    """A constant torque and a constant force in B have potentials, so the balance is exact."""
    rng = np.random.default_rng(5)
    hand = (0.25, 2e-4)
    torque = 0.1 * rng.normal(size=6) * [1, 1, 1, 0.02, 0.02, 0.02]
    wrench = np.array([*rng.normal(size=3), 0, 0, 0])
    start = free_state()
    after = advance(start, wrench, torque, parameters(*hand), 5e-4, 200)
    path = arrays.forward_kinematics(after[:6])[4:] - arrays.forward_kinematics(start[:6])[4:]
    work = wrench[:3] @ path + torque @ (after[:6] - start[:6])
    gained = energy(after, *hand) - energy(start, *hand)
    assert abs(work) > 1e-2
    assert gained == pytest.approx(work, abs=1e-9)


def test_hand_wrench_equals_its_joint_torque():
    """Virtual work: F at E and J^T F at the joints give equal accelerations."""
    rng = np.random.default_rng(6)
    for q in random_postures(20):
        v, wrench = rng.normal(size=6), rng.normal(size=6)
        by_hand = acceleration(q, v, wrench, np.zeros(6), parameters())
        by_motor = acceleration(q, v, np.zeros(6), arrays.jacobian(q).T @ wrench, parameters())
        np.testing.assert_allclose(by_hand, by_motor, rtol=1e-9, atol=1e-9)


# q2 = -124 and q3 = 214 degrees are beyond the range of the other link in the five-bar.
STOPS = [(0, -1), (0, 1), (1, 1), (2, -1), (3, -1), (3, 1), (4, -1), (4, 1), (5, -1), (5, 1)]


@pytest.mark.parametrize(("joint", "side"), STOPS)
def test_joint_stops_at_its_limit(joint, side):
    limit = (phantom.JOINT_UPPER_RAD if side > 0 else phantom.JOINT_LOWER_RAD)[joint]
    q = phantom.HOME_POSTURE_RAD.copy()
    q[joint] = limit - side * 0.02
    if joint in (1, 2):
        q[3 - joint] = limit - side * 0.1  # the other link follows inside the five-bar's range
    push = side * np.array([2.0, 2.0, 2.0, 0.05, 0.05, 0.05]) * np.eye(6)[joint]
    friction = parameters(friction=PhantomJointFriction())
    state, farthest = np.concatenate([q, np.zeros(6)]), 0.0
    for _ in range(2000):
        torque = push + arrays.gravity_torque(state[:6])
        if joint in (1, 2):
            torque[3 - joint] += 20 * (q[3 - joint] - state[3 - joint]) - 0.5 * state[9 - joint]
        state = advance(state, np.zeros(6), torque, friction, 5e-4, 1)
        farthest = max(farthest, side * (state[joint] - limit))
    assert 0 < farthest < 0.05
    assert 0 < side * (state[joint] - limit) < 0.02
    assert np.all(np.abs(state[6:]) < 0.05)


@pytest.mark.parametrize(("joint", "side"), STOPS)
def test_end_stop_pushes_but_never_pulls(joint, side):
    q = phantom.HOME_POSTURE_RAD.copy()
    q[joint] = (phantom.JOINT_UPPER_RAD if side > 0 else phantom.JOINT_LOWER_RAD)[
        joint
    ] + side * 0.01
    if joint in (1, 2):
        q[3 - joint] = q[joint] - side * 0.1
    back = []
    for rate in (-10.0, -0.01, 0.0, 0.01, 10.0):  # out of the stop and into it
        # No joint alone has a Coriolis force on itself.
        v = side * rate * np.eye(6)[joint]
        held = acceleration(q, v, np.zeros(6), arrays.gravity_torque(q), parameters())
        back.append(-side * (arrays.mass_matrix(q) @ held)[joint])
    assert back[0] == pytest.approx(0.0, abs=1e-9)
    assert 0.0 < back[1] < back[2] < back[3] < back[4]
    assert back[3] - back[2] == pytest.approx(back[2] - back[1])  # damped alike both ways


def test_the_five_bar_stops_at_its_limits():
    friction = parameters(friction=PhantomJointFriction())
    for side, limit in ((1, np.radians(65)), (-1, np.radians(-55))):
        state = np.zeros(12)
        for _ in range(3000):
            torque = arrays.gravity_torque(state[:6])
            torque[1] += 0.5 * side
            torque[2] -= 0.5 * side
            state = advance(state, np.zeros(6), torque, friction, 5e-4, 1)
        assert state[1] - state[2] == pytest.approx(limit, abs=0.01)


def simulate(q_initial, duration, motor_torque):
    builder = DiagramBuilder()
    master = builder.AddSystem(device.MasterDevice(5e-4, Master().device(0.1, 1e-4), q_initial))
    for port in ("hand_wrench_E", "drive"):
        builder.ExportInput(master.GetInputPort(port), port)
    for port in ("state", "pose_master", "twist_master"):
        builder.ExportOutput(master.GetOutputPort(port), port)
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    diagram.GetInputPort("hand_wrench_E").FixValue(context, np.zeros(6))
    drive = np.append(motor_torque, initial_display_state(q_initial, parameters())[6:])
    diagram.GetInputPort("drive").FixValue(context, drive)
    simulator.AdvanceTo(duration)
    return {
        port: diagram.GetOutputPort(port).Eval(context).copy()
        for port in ("state", "pose_master", "twist_master")
    }


def test_gravity_compensation_holds_the_device_still():
    q = np.array([0.2, 0.3, 0.1, 0.1, -0.2, 0.3])
    result = simulate(q, 0.2, arrays.gravity_torque(q))
    np.testing.assert_allclose(result["state"], [*q, *np.zeros(6)], atol=1e-12)


def test_ports_agree_with_the_state():
    q = np.array([0.2, 0.3, 0.1, 0.1, -0.2, 0.3])
    result = simulate(q, 0.05, np.zeros(6))
    q, v = result["state"][:6], result["state"][6:]
    assert np.linalg.norm(v) > 0.1
    np.testing.assert_allclose(result["pose_master"], arrays.forward_kinematics(q), atol=1e-15)
    np.testing.assert_allclose(result["twist_master"], arrays.jacobian(q) @ v, atol=1e-14)


def test_long_period_or_start_beyond_limit_is_rejected():
    with pytest.raises(DrakeTeleopError, match=r"rates\.hand_hz"):
        device.MasterDevice(2e-3, Master().device(0.1, 1e-4), phantom.HOME_POSTURE_RAD)
    with pytest.raises(DrakeTeleopError, match="joint 1"):
        device.MasterDevice(5e-4, Master().device(0.1, 1e-4), np.array([2.0, 0, 0, 0, 0, 0]))


@pytest.mark.parametrize(("name", "slope"), [("viscous", 1.0), ("coulomb", 0.01)])
def test_friction_too_large_for_the_step_is_rejected(name, slope):
    """The last wrist joint has 1.5e-4 kg m^2: a step of 0.5 ms allows 0.6 N m s."""

    def make_device(last):
        friction = PhantomJointFriction(**{name: [*[0.0] * 5, slope * last]})
        model = Master(friction=friction).device(0.1, 1e-4)
        device.MasterDevice(5e-4, model, phantom.HOME_POSTURE_RAD)

    make_device(0.5)
    with pytest.raises(DrakeTeleopError, match=r"master\.friction"):
        make_device(0.7)


def test_serial_joint_angles_are_relative_to_the_inner_link():
    q = np.array([[0.1, 0.2, 0.5, 0.4, 0.5, 0.6], [0.0, -0.3, 0.1, 0.0, 0.0, 0.0]])
    expected = [[0.1, 0.2, 0.3, 0.4, 0.5, 0.6], [0.0, -0.3, 0.4, 0.0, 0.0, 0.0]]
    np.testing.assert_allclose(phantom.serial_joint_angles(q), expected, atol=1e-15)
