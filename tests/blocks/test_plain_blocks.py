"""Blocks with plain ports give the numbers of the station's blocks."""

from __future__ import annotations

import gc
import weakref
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydrake.autodiffutils import ExtractGradient, InitializeAutoDiff
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, RevoluteJoint, SpatialInertia
from pydrake.symbolic import Evaluate, MakeVectorVariable
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
from rendered_wrench import wrench_to_master

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import models_dir
from drake_teleop.load.compensation import contact_wrench, scaled_wrench
from drake_teleop.load.contact.detection import HELD_SQUARES_START
from drake_teleop.load.contact.noise_floor import NoiseFloor
from drake_teleop.load.regressor import non_contact_wrench, wrench_of_load
from drake_teleop.station import blocks
from drake_teleop.station.channel.channel import Channel, TeleopChannel
from drake_teleop.station.channel.network import NetworkConfig
from drake_teleop.station.estimation import contact_detection, load_estimator
from drake_teleop.station.estimation.load_estimator import LoadEstimatorConfig
from drake_teleop.station.master.force_display import initial_display_state, step_display
from drake_teleop.station.master.leader_model import Leader
from drake_teleop.station.passivity import packet as fields
from drake_teleop.station.passivity.methods import METHODS, PassivityConfig
from drake_teleop.station.passivity.packet import PACKET_SIZE
from drake_teleop.station.scaling.force_scaling import ForceScaling, ForceScalingConfig
from drake_teleop.station.scaling.kinematic_scaling import KinematicScalingConfig
from drake_teleop.station.scenario import Scenario
from drake_teleop.station.sensor.plant_wrist_sensor import AddWristSensor
from drake_teleop.station.slave.arm import forward_kinematics
from drake_teleop.station.slave.plant import NominalSlave
from drake_teleop.station.slave.slave_config import Slave

T = 1e-3
START = np.array([1.0, 0.0, 0.0, 0.0, 0.4, 0.0, 0.3])
PHI = np.array([2.0, 0.02, -0.04, 0.3, 0.06, 0.001, -0.002, 0.06, 0.003, 0.01])
OFFSETS = np.array([1.0, -2.0, 3.0, 0.1, 0.2, -0.1])
GRAVITY_W = np.array([0.0, 0.0, -9.81])
MOTION = ("specific_force_S", "angular_velocity_S", "angular_acceleration_S")
CONFIG = ForceScalingConfig(sigma_weight=0.5, sigma_inertia=0.2, gamma=1.5, force_scale=0.1)


def floor() -> NoiseFloor:
    parts = np.full(6, 0.1), np.zeros((16, 16)), np.zeros((6, 2)), np.eye(6), np.zeros(6)
    return NoiseFloor(*parts, free_maxima=np.full(3, 30.0))


EXAMPLES = {
    "NonContactWrench": blocks.NonContactWrench,
    "WrenchScaling": blocks.WrenchScaling,
    "LoadEstimator": lambda: blocks.LoadEstimator(np.ones(6), T),
    "ContactDetector": lambda: blocks.ContactDetector(floor(), T),
    "KinematicScaling": lambda: blocks.KinematicScaling(KinematicScalingConfig(), T, START),
    "NetworkChannel": lambda: blocks.NetworkChannel(2, T),
    "PassivityAtMaster": lambda: blocks.PassivityAtMaster(PassivityConfig(), T, START),
    "PassivityAtSlave": lambda: blocks.PassivityAtSlave(PassivityConfig(), T, START),
    "ForceDisplay": lambda: blocks.ForceDisplay(Scenario().master.device(0.0, 0.0), T),
}
"""Each block, as a user makes it."""


GENERIC = ("NonContactWrench", "WrenchScaling")


def rotations(count: int, rng: np.random.Generator) -> np.ndarray:
    q, _r = np.linalg.qr(rng.normal(size=(count, 3, 3)))
    return q * np.linalg.det(q)[:, None, None]


def fixed(block, **values):
    """Return the context of a block with fixed inputs."""
    context = block.CreateDefaultContext()
    for name, value in values.items():
        block.GetInputPort(name).FixValue(context, np.ravel(value))
    return context


def output(block, context, name):
    return block.GetOutputPort(name).Eval(context)


def random_inputs(rng, R_WS):
    values = {name: 4 * rng.normal(size=3) for name in MOTION}
    return values | {
        "measured_wrench_S": 30 * rng.normal(size=6),
        "load_estimate": np.concatenate([OFFSETS, PHI]),
        "R_WS": R_WS,
    }


def test_wrench_blocks_equal_the_functions_for_all_scalar_types():
    rng = np.random.default_rng(0)
    for R_WS in rotations(20, rng):
        values = random_inputs(rng, R_WS)
        motion, wrench = [values[name] for name in MOTION], values["measured_wrench_S"]
        only = dict(zip(MOTION, motion, strict=True))
        scaled = scaled_wrench(
            wrench, OFFSETS, *motion, PHI, np.zeros(10), gravity=R_WS.T @ GRAVITY_W, gamma=1.5,
            sigma_gripper=0.0, sigma_object=0.0, sigma_weight=0.5, sigma_inertia=0.2,
        )  # fmt: skip
        expected = {
            "contact_wrench_S": contact_wrench(wrench, OFFSETS, *motion, PHI),
            "scaled_wrench_S": scaled,
            "wrench_to_master": wrench_to_master(scaled, R_WS, np.eye(3), 0.1, 0.1),
        }
        load, scaling = blocks.NonContactWrench(PHI), blocks.WrenchScaling(CONFIG)
        for convert in (lambda b: b, lambda b: b.ToAutoDiffXd(), lambda b: b.ToSymbolic()):
            block = convert(load)
            found = output(block, fixed(block, **only), "non_contact_wrench_S")
            total = non_contact_wrench(*motion, PHI)
            np.testing.assert_allclose(numbers(found), total, atol=1e-12, rtol=1e-12)
            block = convert(scaling)
            context = fixed(block, **values)
            for name, wanted in expected.items():
                found = numbers(output(block, context, name))
                np.testing.assert_allclose(found, wanted, atol=1e-12, rtol=1e-12)


def numbers(values) -> np.ndarray:
    if values.dtype == float:
        return values
    is_autodiff = hasattr(values[0], "value")
    return np.array([x.value() if is_autodiff else x.Evaluate() for x in values])


def test_compiled_and_generic_mathematics_are_equal_over_many_samples():
    rng = np.random.default_rng(1)
    s, omega, alpha = 5 * rng.normal(size=(3, 10_000, 3))
    generic = np.array(
        [np.concatenate(wrench_of_load(*each, PHI))
         for each in zip(s, omega, alpha, strict=True)]
    )  # fmt: skip
    compiled = non_contact_wrench(s, omega, alpha, PHI)
    np.testing.assert_allclose(generic, compiled, rtol=1e-12, atol=1e-12)


def test_gradient_of_the_elimination_equals_finite_differences():
    rng = np.random.default_rng(2)
    values = random_inputs(rng, rotations(1, rng)[0])
    block = blocks.WrenchScaling(CONFIG)
    double, auto = block, block.ToAutoDiffXd()
    for name in values:
        x = np.ravel(values[name])
        context = fixed(auto, **values | {name: InitializeAutoDiff(x)})
        gradient = ExtractGradient(output(auto, context, "wrench_to_master").reshape(-1, 1))
        for k in range(x.size):
            steps = [x + h * np.eye(x.size)[k] for h in (1e-6, -1e-6)]
            ends = [
                output(double, fixed(double, **values | {name: step}), "wrench_to_master")
                for step in steps
            ]
            np.testing.assert_allclose(gradient[:, k], (ends[0] - ends[1]) / 2e-6, atol=1e-6)


def test_symbolic_wrench_contains_the_variables():
    block = blocks.NonContactWrench([2.0, *np.zeros(9)]).ToSymbolic()
    a = MakeVectorVariable(3, "s")
    values = dict.fromkeys(MOTION[1:], np.zeros(3)) | {MOTION[0]: a}
    found = output(block, fixed(block, **values), "non_contact_wrench_S")
    assert [str(x) for x in found[:2]] == ["(2 * s(0))", "(2 * s(1))"]
    at = dict(zip(a, [1.0, 2.0, 3.0], strict=True))
    np.testing.assert_allclose(Evaluate(found, at).ravel(), [2, 4, 6, 0, 0, 0])


def test_load_is_an_input_or_a_parameter():
    block, values = blocks.NonContactWrench(PHI), {name: np.ones(3) for name in MOTION}
    by_port = output(block, fixed(block, **values, load=2 * PHI), "non_contact_wrench_S")
    context = fixed(block, **values)
    by_parameter = output(block, context, "non_contact_wrench_S")
    np.testing.assert_allclose(by_port, 2 * by_parameter)
    context.get_mutable_numeric_parameter(0).SetFromVector(3 * PHI)
    found = output(block, context, "non_contact_wrench_S")
    np.testing.assert_allclose(found, 3 * by_parameter)


def test_missing_orientation_is_one_line():
    rng = np.random.default_rng(3)
    values = random_inputs(rng, np.eye(3))
    del values["R_WS"]
    block = blocks.WrenchScaling(CONFIG)
    with pytest.raises(DrakeTeleopError, match=r"gravity in S: is unknown.*; connect R_WS"):
        output(block, fixed(block, **values), "scaled_wrench_S")
    block = blocks.WrenchScaling()
    with pytest.raises(DrakeTeleopError, match="wrench_to_master: the input port R_WS"):
        output(block, fixed(block, **values), "wrench_to_master")
    assert np.isfinite(output(block, fixed(block, **values), "scaled_wrench_S")).all()


def stepped(block, rows, name):
    """Return an output after each row of inputs, held for a period."""
    simulator, found = Simulator(block), []
    context = simulator.get_mutable_context()
    for k, values in enumerate(rows):
        for port, value in values.items():
            block.GetInputPort(port).FixValue(context, np.ravel(value))
        simulator.AdvanceTo(k * T + 0.5 * T)
        found.append(output(block, context, name).copy())
    return np.array(found)


def samples(rng, count):
    """Return samples for the plain ports, and for the port `sample` of the station."""
    arm = NominalSlave(Slave()).arm
    q, names = np.array([0.3, -0.5, -1.5, 0.2, -0.9, 1.0]), ("measured_wrench_S", *MOTION)
    plain, fused = [], []
    for k in range(count):
        motion = rng.normal(size=(3, 3)) + np.outer([1, 0, 0], [0, 0, 9.81])
        wrench = non_contact_wrench(*motion, PHI) + OFFSETS + 0.1 * rng.normal(size=6)
        wrench[0] += 20.0 * (k > count // 2)
        invalid = [float(k % 13 == 5)]
        plain.append(dict(zip(names, (wrench, *motion), strict=True)) | {"saturated": invalid})
        fused.append({"sample": np.concatenate([wrench, *motion, invalid, q, [k * T]])})
    return arm, q, plain, fused


@pytest.mark.parametrize("method", ["rls", "rtls"])
def test_load_estimator_equals_that_of_the_station(method):
    _, _, plain, fused = samples(np.random.default_rng(4), 60)
    config = load_estimator.LoadEstimatorConfig(enabled=True, method=method)
    size, found = len(fused[0]["sample"]), []
    for std in (np.zeros(9), np.repeat([0.2, 0.1, 0.3], 3)):
        station = load_estimator.LoadEstimator(config, np.ones(6), std, T, size, np.zeros(16))
        block = blocks.LoadEstimator(np.ones(6), T, motion_std=std, config=config)
        found.append(stepped(block, plain, "load_estimate"))
        np.testing.assert_array_equal(found[-1], stepped(station, fused, "load_estimate"))
    assert found[0][20, 6] == pytest.approx(2.0, abs=0.3)
    # Only total least squares uses the noise of the motion.
    assert (found[0] != found[1]).any() == (method == "rtls")


def test_contact_detector_equals_that_of_the_station():
    arm, q, plain, fused = samples(np.random.default_rng(5), 60)
    R_WS, p_WS = np.empty((3, 3)), np.empty(3)
    forward_kinematics(arm.table, q, R_WS, p_WS)
    estimate = {"load_estimate": np.concatenate([OFFSETS, PHI])}
    config = contact_detection.ContactDetectionConfig()
    station = contact_detection.ContactDetection(config, floor(), arm, T)
    block = blocks.ContactDetector(floor(), T)
    found = stepped(block, [row | estimate | {"R_WS": R_WS} for row in plain], "contact")
    expected = stepped(station, [row | estimate for row in fused], "contact")
    np.testing.assert_array_equal(found, expected)
    assert not found[:25].any() and found[-1] == 1.0


@pytest.mark.parametrize("seed", range(4))
def test_contact_detectors_remove_gravity_from_the_specific_force(seed):
    """The acceleration raises the noise floor; its square is held in the memory."""
    rng = np.random.default_rng(seed)
    arm, _, (plain,), (fused,) = samples(rng, 1)
    q, R_WS, p_WS = rng.uniform(-2.0, 2.0, 6), np.empty((3, 3)), np.empty(3)
    forward_kinematics(arm.table, q, R_WS, p_WS)
    fused["sample"][16:22] = q
    config, estimate = contact_detection.ContactDetectionConfig(), np.append(OFFSETS, PHI)
    noise_floor = replace(floor(), per_acceleration=np.full((6, 2), 0.1))
    station = contact_detection.ContactDetection(config, noise_floor, arm, T)
    square = np.sum((plain["specific_force_S"] + R_WS.T @ GRAVITY_W) ** 2)
    for block, values in (
        (station, fused),
        (blocks.ContactDetector(noise_floor, T), plain | {"R_WS": R_WS}),
    ):
        context = fixed(block, load_estimate=estimate, **values)
        memory = block.EvalUniquePeriodicDiscreteUpdate(context).get_value(1)
        assert memory[HELD_SQUARES_START] == pytest.approx(square, rel=1e-12)


@pytest.mark.parametrize("method", ["rls", "rtls"])
@pytest.mark.parametrize("bad", [np.nan, -np.inf, 1e9])
@pytest.mark.parametrize("name", ["measured_wrench_S", "angular_velocity_S"])
def test_load_estimator_skips_an_invalid_sample(method, bad, name):
    """The estimate is that without this sample."""
    _, _, rows, _ = samples(np.random.default_rng(4), 30)
    found = []
    for row in (rows[20] | {"saturated": [1.0]}, rows[20] | {name: [bad, *rows[20][name][1:]]}):
        config = load_estimator.LoadEstimatorConfig(enabled=True, method=method)
        block = blocks.LoadEstimator(np.ones(6), T, motion_std=np.full(9, 0.01), config=config)
        found.append(stepped(block, [*rows[:20], row, *rows[21:]], "load_estimate"))
    assert np.isfinite(found[0]).all() and np.ptp(found[0][20:], axis=0).any()
    np.testing.assert_array_equal(found[1], found[0])


@pytest.mark.parametrize("bad", [np.nan, 1e9])
@pytest.mark.parametrize("name", ["R_WS", "specific_force_S", "load_estimate"])
def test_contact_detector_skips_an_invalid_sample(bad, name):
    _, _, rows, _ = samples(np.random.default_rng(5), 60)
    rows = [row | {"load_estimate": [*OFFSETS, *PHI], "R_WS": np.eye(3).ravel()} for row in rows]
    flags = []
    for port in ("measured_wrench_S", name):
        row = rows[27] | {port: np.full(np.size(rows[27][port]), bad)}
        block = blocks.ContactDetector(replace(floor(), per_acceleration=np.full((6, 2), 0.01)), T)
        flags.append(stepped(block, [*rows[:27], row, *rows[28:]], "contact"))
    np.testing.assert_array_equal(flags[1], flags[0])
    assert not flags[1][:25].any() and flags[1][-1] == 1.0


def test_wrench_scaling_keeps_the_settings_with_which_it_was_built():
    config = ForceScalingConfig(sigma=0.5, force_scale=0.1, gripper_phi=list(0.5 * PHI))
    block = blocks.WrenchScaling(config)
    values = random_inputs(np.random.default_rng(8), np.eye(3))
    before = output(block, fixed(block, **values), "wrench_to_master")
    config.sigma, config.force_scale, config.gripper_phi[0] = 0.0, 1.0, 0.0
    for each in (block, block.ToAutoDiffXd()):
        found = output(each, fixed(each, **values), "wrench_to_master")
        np.testing.assert_allclose(numbers(found), before, rtol=1e-12)


def test_force_display_equals_the_display_of_the_station():
    master, rng = Scenario().master, np.random.default_rng(6)
    device = master.device(0.0, 0.0)
    q = device.inverse_kinematics(np.array([1.0, 0.0, 0.0, 0.0, *master.position]))
    rows = [
        {"wrench_command": 10 * rng.normal(size=6), "joint_position": q + 0.01 * k}
        for k in range(40)
    ]
    rows[20]["wrench_command"] = np.full(6, np.nan)
    # The outputs are of the period that follows the update at its start.
    found = stepped(blocks.ForceDisplay(device, T, q), rows, "joint_torque")
    memory, J, expected = initial_display_state(q, device.parameters), np.zeros((6, 6)), []
    for row in rows:
        for _ in range(2):
            drive, memory[:6] = np.zeros(len(memory)), row["joint_position"]
            step_display(row["wrench_command"], memory, device.packed_parameters, T, J, drive)
            if _ == 0:
                memory = drive.copy()
        expected.append(drive[:6])
    np.testing.assert_array_equal(found, expected)


def test_force_display_rejects_a_leader_arm():
    """Motor torques of an arm depend on more joints than the block's input contains."""
    arm = Leader(file=str(models_dir() / "leader_arm.urdf"), hand_frame="hand")
    with pytest.raises(DrakeTeleopError, match=r"ForceDisplay: device: expected HapticDevice"):
        blocks.ForceDisplay(arm.device([0.3, 0.0, 0.0], 0.0, 0.0), T)


def test_load_estimator_checks_its_settings():
    config = LoadEstimatorConfig(enabled=True, watch=True)
    with pytest.raises(DrakeTeleopError, match=r"load_estimator\.method: 'rls' ignores the noise"):
        blocks.LoadEstimator(np.ones(6), T, config=config)


DOCS = Path(__file__).parents[2] / "docs" / "blocks.md"


def ports(block, kind) -> str:
    count, get = getattr(block, f"num_{kind}_ports")(), getattr(block, f"get_{kind}_port")
    return ", ".join(f"`{get(k).get_name()}` {get(k).size()}" for k in range(count))


def test_table_of_blocks_equals_the_actual_ports():
    rows = [line for line in DOCS.read_text().splitlines() if line.startswith("| `")]
    found = {row.split("`")[1]: [cell.strip() for cell in row.split("|")[2:6]] for row in rows}
    assert {*found} == {*EXAMPLES}
    for name, (inputs, outputs, rate, scalars) in found.items():
        block = EXAMPLES[name]()
        assert (name, inputs, outputs) == (name, ports(block, "input"), ports(block, "output"))
        events = block.GetUniquePeriodicDiscreteUpdateAttribute()
        assert rate == ("continuous" if events is None else "`period`")
        try:
            others = bool(block.ToAutoDiffXd() and block.ToSymbolic())
        except (DrakeTeleopError, RuntimeError):
            others = False
        assert scalars == ("double, AutoDiffXd, Expression" if others else "double")


@pytest.mark.parametrize("name", [name for name in EXAMPLES if name not in GENERIC])
def test_impossible_conversion_raises_one_line(name):
    block = EXAMPLES[name]()
    for convert in (block.ToAutoDiffXd, block.ToSymbolic):
        with pytest.raises(DrakeTeleopError, match=rf"^{name}: .* for double only; .*$"):
            convert()


def packet_of_slave(force: float, **changed: float) -> np.ndarray:
    packet = np.zeros(PACKET_SIZE + 1)
    packet[fields.POSE], packet[fields.WRENCH.start] = START, force
    packet[fields.SENDER_INPUTS_FINITE] = packet[-1] = 1.0
    for name, value in changed.items():
        packet[getattr(fields, name)] = value
    return packet


@pytest.mark.slow
@pytest.mark.parametrize("field", ["CONTACT_FLAG", "WRENCH", "POSE"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_packet_that_is_not_finite_starts_the_safe_state(field, bad):
    """The force is 0 at once, and then grows by at most 37.5 N in 0.5 s."""
    block = blocks.PassivityAtMaster(PassivityConfig(), T, START)
    rows = [{"received": packet_of_slave(10.0), "pose_command": START}] * 700
    rows[600] = rows[600] | {"received": packet_of_slave(10.0, **{field: bad})}
    force = stepped(block, rows, "wrench_to_master")[:, 0]
    told = np.flatnonzero(force[550:] == 0.0) + 550
    assert force[550] == 10.0 and len(told) > 0
    # The output between two updates is one step ahead.
    assert np.diff(force[told[0] :]).max() < 2 * 37.5 * T / 0.5 + 1e-12
    assert 5.0 < force[-1] < 10.0


@pytest.mark.slow
@pytest.mark.parametrize("field", ["CONTACT_FLAG", "WRENCH", "POSE"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_slave_brakes_smoothly_after_a_packet_that_is_not_finite(field, bad):
    """The received hand moves with 0.1 m/s; the bad packet is number 300."""
    block, rows = blocks.PassivityAtSlave(PassivityConfig(), T, START), []
    for k in range(400):
        packet = packet_of_slave(0.0)
        packet[fields.POSE.start + 4] += 1e-4 * k
        rows.append({"received": packet, "wrench_B": np.zeros(6), "pose_slave": START})
    rows[300]["received"][getattr(fields, field)] = bad
    steps = np.diff(stepped(block, rows, "pose_to_slave")[:, 4])
    assert steps[299:320].max() <= steps[298] * 1.001  # it does not jump to the next pose
    assert np.abs(np.diff(steps[290:])).max() < 2e-5  # 1.4e-4 without brake
    assert 0.0 <= steps[320] < 0.8 * steps[298]


@pytest.mark.parametrize(("contact", "flag"), [(np.nan, 0.0), (0.0, 0.0), (1.0, 1.0)])
def test_contact_flag_of_a_packet_is_0_or_1(contact, flag):
    block = blocks.PassivityAtSlave(PassivityConfig(), T, START)
    zeros = {"received": np.zeros(PACKET_SIZE + 1), "wrench_B": np.zeros(6)}
    context = fixed(block, **zeros, pose_slave=START, contact=[contact])
    packet = output(block, context, "packet")
    assert packet[fields.CONTACT_FLAG] == flag and packet[fields.SENDER_INPUTS_FINITE] == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_ends_and_networks_equal_the_channel_of_the_station(method):
    """Some silences are longer than the timeout."""
    line = NetworkConfig(delay=0.004, jitter=0.5, loss=0.1, duplicate=0.1)
    passivity, scales = PassivityConfig(method=method), np.array([2.0, 1.0])
    if method == "ledger":
        passivity = PassivityConfig(
            method=method, slave_mass=[10.0, 0.1], servo_stiffness=[2e5, 2e3],
            servo_damping=[4e3, 40.0],
        )  # fmt: skip
    names = (
        "pose_command",
        "wrench_B",
        "hand_wrench_E",
        "pose_slave",
        "saturated",
        "load_wrench_B",
    )
    (R_WB,), timeout = rotations(1, np.random.default_rng(6)), 0.003
    channel = TeleopChannel(
        Channel(delay=0.004, jitter=0.5, loss=0.1, duplicate=0.1, timeout=timeout), passivity,
        R_WB, scales, 0.1, START, T, 7,
    )  # fmt: skip
    builder = DiagramBuilder()
    same = dict(R_WB=R_WB, scales=scales, force_scale=0.1, timeout=timeout)
    master = builder.AddSystem(blocks.PassivityAtMaster(passivity, T, START, **same))
    slave = builder.AddSystem(blocks.PassivityAtSlave(passivity, T, START, **same))
    there, back = (
        builder.AddSystem(blocks.NetworkChannel(PACKET_SIZE, T, line, seed=7, direction=k))
        for k in range(2)
    )
    for source, port, target in (
        (master, "arriving", there), (slave, "received", back)
    ):  # fmt: skip
        builder.Connect(source.GetOutputPort("packet"), target.GetInputPort("packet"))
        other = slave if source is master else master
        builder.Connect(target.GetOutputPort(port), other.GetInputPort("received"))
    for name in names:
        end = master if name in ("pose_command", "hand_wrench_E") else slave
        builder.ExportInput(end.GetInputPort(name), name)
    for end, name in ((master, "wrench_to_master"), (slave, "pose_to_slave")):
        builder.ExportOutput(end.GetOutputPort(name), name)
    apart = builder.Build()
    rng, rows, pose = np.random.default_rng(8), [], START.copy()
    for k in range(120):
        pose = pose + np.concatenate([np.zeros(4), 1e-4 * rng.normal(size=3)])
        late = START if k < 10 else rows[k - 10]["pose_command"]
        wrench = np.concatenate([2 * rng.normal(size=3), 0.01 * rng.normal(size=3)])
        values = (pose, wrench, 0.5 * wrench, late, [float(k == 50)], 0.2 * wrench)
        rows.append(dict(zip(names, values, strict=True)))
    for one, two in (("wrench_received", "wrench_to_master"), ("pose_received", "pose_to_slave")):
        found, expected = stepped(apart, rows, two), stepped(channel, rows, one)
        np.testing.assert_allclose(found, expected, atol=1e-12)
    assert np.ptp(expected[:, 4:], axis=0).max() > 1e-5


@pytest.mark.parametrize("name", ["pose_command", "pose_slave", "wrench_B"])
def test_an_end_without_a_required_input_raises(name):
    block = EXAMPLES["PassivityAtMaster" if name == "pose_command" else "PassivityAtSlave"]()
    ports = {"pose_command": START, "pose_slave": START, "wrench_B": np.zeros(6)}
    ports = {"received": np.zeros(PACKET_SIZE + 1)} | ports
    given = {k: v for k, v in ports.items() if k != name and block.HasInputPort(k)}
    with pytest.raises(RuntimeError, match=name):
        output(block, fixed(block, **given), "packet")
    output(block, fixed(block, **given, **{name: ports[name]}), "packet")


@pytest.mark.parametrize("scale", [{"scales": (1.0, 0.0)}, {"force_scale": 0.0}])
@pytest.mark.parametrize("method", METHODS)
def test_scale_0_leaves_finite_numbers_at_both_ends(method, scale):
    for end in (blocks.PassivityAtMaster, blocks.PassivityAtSlave):
        block = end(PassivityConfig(method=method), T, START, **scale)
        ports = {"pose_command": START, "pose_slave": START, "wrench_B": np.ones(6)}
        ports = {"received": np.zeros(PACKET_SIZE + 1)} | ports
        context = fixed(block, **{k: v for k, v in ports.items() if block.HasInputPort(k)})
        assert np.isfinite(output(block, context, "packet")).all()


def test_network_delays_by_whole_periods():
    block = blocks.NetworkChannel(2, T, NetworkConfig(delay=0.003))
    rows = [{"packet": [k + 1.0, -k]} for k in range(8)]
    found = stepped(block, rows, "received")
    np.testing.assert_array_equal(found[:, 0], [0, 0, 1, 2, 3, 4, 5, 6])
    np.testing.assert_array_equal(found[:, 2], [0, 0, 1, 1, 1, 1, 1, 1])
    with pytest.raises(
        DrakeTeleopError, match="silence: 'zero' requires packets of a passivity method"
    ):
        blocks.NetworkChannel(2, T, NetworkConfig(silence="zero"))


def test_every_block_has_an_example():
    assert {*EXAMPLES} == {name for name in blocks.__all__ if not name.endswith("_")}


@pytest.mark.parametrize("name", EXAMPLES)
def test_blocks_are_freed(name):
    block = EXAMPLES[name]()
    gone = weakref.ref(block)
    block.CreateDefaultContext()
    del block
    gc.collect()
    assert gone() is None


def beside_a_plant(name: str, time_step: float):
    """Return block, sensor and simulator of a Diagram with a swinging arm of two joints."""
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("plant", MultibodyPlant(time_step))
    end = plant.world_frame()
    for k in range(2):
        link = plant.AddRigidBody(f"link_{k}", SpatialInertia.SolidSphereWithMass(2.0, 0.1))
        plant.AddJoint(RevoluteJoint(f"joint_{k}", end, link.body_frame(), [k, 1 - k, 0.0]))
        offset = FixedOffsetFrame(f"end_{k}", link.body_frame(), RigidTransform([0.2, 0.0, 0.1]))
        end = plant.AddFrame(offset)
    gripper = plant.AddRigidBody("gripper", SpatialInertia.SolidSphereWithMass(2.0, 0.1))
    weld = plant.WeldFrames(end, gripper.body_frame())
    plant.Finalize()
    sensor = AddWristSensor(builder, plant, weld, period=T)
    block = builder.AddNamedSystem(name, EXAMPLES[name]())
    phi = np.array([2.0, 0, 0, 0, 8e-3, 0, 0, 8e-3, 0, 8e-3])  # 2/5 m r^2
    values = {"load_estimate": np.concatenate([np.zeros(6), phi]), "load": phi, "clutch": [1.0]}
    values |= {"R_WS": np.eye(3).ravel()} | dict.fromkeys(
        ("pose_master", "pose_command", "pose_slave"), START
    )
    for k in range(block.num_input_ports()):
        port = block.get_input_port(k)
        if sensor.HasOutputPort(port.get_name()) and port.get_name() != "joint_position":
            source = sensor.GetOutputPort(port.get_name())
        else:
            value = values.get(port.get_name(), np.zeros(port.size()))
            source = builder.AddSystem(ConstantVectorSource(value)).get_output_port()
        builder.Connect(source, port)
    return block, sensor, Simulator(builder.Build())


@pytest.mark.parametrize("time_step", [0.0, T], ids=["continuous plant", "discrete plant"])
@pytest.mark.parametrize("name", EXAMPLES)
def test_a_block_works_beside_a_plant(name, time_step):
    block, sensor, simulator = beside_a_plant(name, time_step)
    simulator.AdvanceTo(0.05)
    context = block.GetMyContextFromRoot(simulator.get_context())
    found = {
        port.get_name(): port.Eval(context)
        for port in map(block.get_output_port, range(block.num_output_ports()))
    }
    assert found and all(np.isfinite(value).all() for value in found.values())
    measured = output(sensor, sensor.GetMyContextFromRoot(simulator.get_context()), "sample")[:6]
    assert np.linalg.norm(measured[:3]) > 5.0
    if name == "NonContactWrench":
        np.testing.assert_allclose(found["non_contact_wrench_S"], measured, atol=1e-9)
    elif name == "WrenchScaling":
        np.testing.assert_allclose(found["contact_wrench_S"], 0.0, atol=1e-9)
    elif name == "LoadEstimator":
        assert np.abs(found["load_estimate"]).max() > 0.1  # load after these samples


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_script_sets_and_reads_state_parameters_and_inputs(name):
    block = EXAMPLES[name]()
    context = block.CreateDefaultContext()
    vectors = [
        context.get_mutable_discrete_state(k) for k in range(context.num_discrete_state_groups())
    ]
    vectors += [
        context.get_mutable_numeric_parameter(k)
        for k in range(context.num_numeric_parameter_groups())
    ]
    for vector in vectors:
        value = vector.CopyToVector() + 0.5
        vector.SetFromVector(value)
        np.testing.assert_array_equal(vector.value(), value)
    for k in range(block.num_input_ports()):
        port = block.get_input_port(k)
        port.FixValue(context, 0.1 * np.arange(port.size()))
        np.testing.assert_array_equal(port.Eval(context), 0.1 * np.arange(port.size()))
    assert vectors or name == "WrenchScaling"  # all settings are in the constructor


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_saved_context_continues_in_another_block(name):
    """All memory of a block is in its Context."""
    rng, block, twin = np.random.default_rng(9), EXAMPLES[name](), EXAMPLES[name]()
    ports = [block.get_input_port(k) for k in range(block.num_input_ports())]
    rows = [
        {port.get_name(): 1 + rng.normal(size=port.size()) for port in ports} for _ in range(60)
    ]

    def advance(simulator, k):
        context = simulator.get_mutable_context()
        for port, value in rows[k].items():
            simulator.get_system().GetInputPort(port).FixValue(context, value)
        simulator.AdvanceTo((k + 0.5) * T)
        system = simulator.get_system()
        outputs = (system.get_output_port(i) for i in range(system.num_output_ports()))
        return np.concatenate([port.Eval(context) for port in outputs])

    first, second = Simulator(block), Simulator(twin)
    for k in range(30):
        advance(first, k)
    saved, context = first.get_context(), second.get_mutable_context()
    groups, changed = range(saved.num_discrete_state_groups()), []
    for k in groups:
        changed += (context.get_discrete_state(k).value() != saved.get_discrete_state(k).value(),)
        context.SetDiscreteState(k, saved.get_discrete_state(k).CopyToVector())
    assert np.concatenate(changed).any() if groups else name in GENERIC
    context.SetTime(saved.get_time())
    for k in range(30, 60):
        np.testing.assert_array_equal(advance(second, k), advance(first, k))


@pytest.mark.slow
def test_plain_and_joined_ports_give_the_same_scaled_wrench_over_many_samples():
    """10^4 random samples: `WrenchScaling` against the `ForceScaling` of the station."""
    rng = np.random.default_rng(6)
    arm = NominalSlave(Slave()).arm
    plain, joined = blocks.WrenchScaling(CONFIG), ForceScaling(CONFIG, arm, np.eye(3))
    estimate, R_WS, p_WS = np.concatenate([OFFSETS, PHI]), np.empty((3, 3)), np.empty(3)
    one, two = plain.CreateDefaultContext(), joined.CreateDefaultContext()
    plain.GetInputPort("load_estimate").FixValue(one, estimate)
    joined.GetInputPort("load_estimate").FixValue(two, estimate)
    names = ("contact_wrench_S", "scaled_wrench_S", "wrench_to_master")
    found, expected = np.empty((2, 10_000, 18))
    for k in range(10_000):
        values = [20 * rng.normal(size=6), *(4 * rng.normal(size=(3, 3)))]
        q = rng.uniform(-2.0, 2.0, 6)
        forward_kinematics(arm.table, q, R_WS, p_WS)
        for name, value in zip(("measured_wrench_S", *MOTION), values, strict=True):
            plain.GetInputPort(name).FixValue(one, value)
        plain.GetInputPort("R_WS").FixValue(one, R_WS.ravel())
        joined.GetInputPort("sample").FixValue(two, np.concatenate([*values, [0.0], q, [0.0]]))
        found[k] = np.concatenate([output(plain, one, name) for name in names])
        ports = *names[:2], "wrench_B"
        expected[k] = np.concatenate([output(joined, two, name) for name in ports])
    assert np.isfinite(expected).all() and np.abs(expected).max() > 100.0
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
