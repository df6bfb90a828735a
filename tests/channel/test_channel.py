"""The channel block in the station: a pure delay without a method, energy, safe state."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import PassThrough

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.station.channel import channel
from drake_teleop.station.channel.channel import SLAVE_METHOD_MEMORY_SLICE, Channel, step_channel
from drake_teleop.station.channel.network import PRESETS, NetworkConfig
from drake_teleop.station.channel_side import (
    MakeChannel,
    _passivity_with_mass_and_encoder_step,
    slave_to_master_power_unit_scale,
)
from drake_teleop.station.operator.operator import OperatorConfig, Sine
from drake_teleop.station.passivity.ledger import LedgerConfig
from drake_teleop.station.passivity.memory import LAST_PORT_WRENCH, LOAD_WRENCH
from drake_teleop.station.passivity.methods import PassivityConfig
from drake_teleop.station.passivity.safe_state import RESUME_TIME_S, STOP_TIME_S
from drake_teleop.station.scaling.force_scaling import ForceScalingConfig
from drake_teleop.station.scaling.kinematic_scaling import KinematicScalingConfig
from drake_teleop.station.scenario import Scenario, replace
from drake_teleop.station.simulation import simulate
from drake_teleop.station.slave.plant import AddSlavePlant, start_pose
from drake_teleop.station.slave.slave_config import Slave
from drake_teleop.station.station import MakeTeleopStation


@pytest.fixture(scope="module")
def load_estimate():
    arm = AddSlavePlant(DiagramBuilder(), Slave(), None).arm
    return np.concatenate([np.zeros(6), arm.phi_load])


@pytest.mark.parametrize("model", ["phantom_premium_15", "omega_6", "omega_7", "geomagic_touch"])
@pytest.mark.parametrize("share", [0.5, 3.0])
def test_method_is_limited_to_the_force_and_torque_of_the_device(model, share):
    scenario = Scenario()
    scenario.master.model = model
    device = scenario.master.device(0.0, 0.0)
    force, torque = device.parameters.peak_force, min(device.parameters.peak_torque)
    own = PassivityConfig(method="wave", force_limit=share * force, torque_limit=share * torque)
    limited = _passivity_with_mass_and_encoder_step(replace(scenario, passivity=own))
    assert limited.method == "wave"
    assert limited.force_limit == pytest.approx(min(share, 1.0) * force)
    assert limited.torque_limit == pytest.approx(min(share, 1.0) * torque)


def test_ledger_has_the_encoder_steps_of_the_device():
    """Steps: omega_6 0.01 mm and 0.09 deg, geomagic_touch 0.055 mm; a given value is kept."""
    scenario = Scenario()
    steps = {}
    for model in ("phantom_premium_15", "omega_6", "geomagic_touch"):
        scenario.master.model = model
        steps[model] = _passivity_with_mass_and_encoder_step(scenario).ledger.encoder_step
    assert steps["phantom_premium_15"] == [0.0, 0.0]
    np.testing.assert_allclose(steps["omega_6"], [1e-5, np.radians(0.09)])
    assert steps["geomagic_touch"][0] == pytest.approx(5.5e-5, rel=0.02)
    scenario.passivity = PassivityConfig(ledger=LedgerConfig(encoder_step=[2e-4, 1e-3]))
    assert _passivity_with_mass_and_encoder_step(scenario).ledger.encoder_step == [2e-4, 1e-3]


@pytest.mark.parametrize(
    ("gamma", "force_scale", "rendered"),
    [(0.5, 0.1, 0.05), (0.0, 0.1, 0.1), (0.5, 0.0, 0.5), (0.0, 0.0, 1.0)],
)
def test_slave_power_is_scaled_by_the_rendered_share_over_the_motion(gamma, force_scale, rendered):
    """A scale of motion of 0 counts as 1, as does a gamma or force scale of 0."""
    for scales, expected in (((4.0, 0.5), (4.0, 0.5)), ((2.0, 0.0), (2.0, 1.0))):
        scenario = replace(
            Scenario(),
            force_scaling=ForceScalingConfig(gamma=gamma, force_scale=force_scale),
            kinematic_scaling=KinematicScalingConfig(*scales),
        )
        found = slave_to_master_power_unit_scale(scenario)
        np.testing.assert_allclose(found, rendered / np.array(expected))


def moving(**changes: object) -> Scenario:
    """Return a hand that swings up and down and rotates a little, from 0.6 s on."""
    sine = Sine(
        t_start=0.6,
        duration=10.0,
        ramp=0.4,
        frequency=2.0,
        translation=[0.01, 0.0, 0.03],
        rotation=[0.0, 0.2, 0.1],
    )
    base = replace(
        Scenario(),
        simulation__duration=0.8,
        simulation__settle=0.6,
        wrist_sensor__ideal=True,
        operator=OperatorConfig(grip="firm", intent=[sine]),
        rates__log_hz=2000.0,
    )
    return replace(base, **changes)


def run(scenario: Scenario, load_estimate: np.ndarray):
    return simulate(MakeTeleopStation(scenario, load_estimate=load_estimate), scenario.simulation)


@pytest.mark.slow
@pytest.mark.parametrize("steps", [1, 40])
def test_channel_without_method_delays_both_directions(steps, load_estimate):
    """Outputs are delayed inputs up to rounding; samples and log are at 2 kHz."""
    result = run(moving(channel__delay=steps / 2000), load_estimate)
    np.testing.assert_allclose(
        result["pose_received"][steps:], result["pose_command"][:-steps], atol=1e-12
    )
    # The expected force at the hand is -F' / 17.5, rotated into B.
    rendered_force = np.linalg.norm(result["scaled_wrench_S"][:, :3], axis=1) / 17.5
    shown = np.linalg.norm(result["force_to_master"][:, :3], axis=1)
    np.testing.assert_allclose(shown[steps:], rendered_force[:-steps], atol=1e-9)
    assert rendered_force.max() > 0.1


@pytest.mark.parametrize("channel", [Channel(), Channel(network="ideal")])
def test_ideal_network_without_method_changes_no_signal(channel):
    side = MakeChannel(moving(channel=channel))
    assert [type(block) for block in side.GetSystems()] == [PassThrough, PassThrough]
    assert not side.HasInputPort("hand_wrench_E") and not side.HasOutputPort("ports")


@pytest.mark.parametrize(("name", "limit"), [("force_limit", 2.0), ("torque_limit", 0.01)])
def test_own_limit_holds_with_an_ideal_network_and_without_method(name, limit):
    scenario = moving(**{f"passivity__{name}": limit})
    assert not scenario.has_no_network_or_passivity
    side, wrench = MakeChannel(scenario), [0.0, 6.0, 0.0, 0.0, 0.05, 0.0]
    simulator = Simulator(side)
    start = start_pose(scenario.slave)
    values = {"pose_command": start, "pose_slave": start, "wrench_B": wrench, "saturated": [0.0]}
    for port, value in (values | {"hand_wrench_E": np.zeros(6)}).items():
        side.GetInputPort(port).FixValue(simulator.get_mutable_context(), value)
    simulator.AdvanceTo(0.6)
    rendered = side.GetOutputPort("wrench_to_master").Eval(simulator.get_context())
    assert rendered[1] == pytest.approx(min(wrench[1], scenario.passivity.force_limit))
    assert rendered[4] == pytest.approx(min(wrench[4], scenario.passivity.torque_limit))


def test_ports_contain_the_work_of_the_hand(load_estimate):
    """Compare with the sum over the logged force and motion of the stylus."""
    result = run(moving(channel__delay=0.01), load_estimate)
    force, twist = result["force_to_master"], result["pose_command"][:, 4:]
    work = np.cumsum(np.sum(force[:-1, :3] * np.diff(twist, axis=0), axis=1))
    # The sums of the block in a row of the log end one step earlier.
    counted = -(result["ports"][:, 0] - result["ports"][1, 0])
    np.testing.assert_allclose(counted[2:], work[:-1], atol=1e-12)
    assert np.abs(work).max() > 1e-4


@pytest.mark.slow
def test_load_wrench_is_transformed_as_the_wrench():
    """The base is rotated and the scales are unequal."""
    scaling = KinematicScalingConfig(0.5, 0.2, alignment=[0.3, -0.4, 1.9])
    scenario = moving(kinematic_scaling=scaling, passivity=PassivityConfig(method="ledger"))
    side, wrench = MakeChannel(scenario), np.arange(1.0, 7.0)
    assert side.HasInputPort("load_wrench_B")
    block = side.GetSubsystemByName("channel")
    context = block.CreateDefaultContext()
    pose = np.array([1.0, 0.0, 0.0, 0.0, *scenario.slave.position])
    inputs = {"pose_command": pose, "pose_slave": pose, "hand_wrench_E": np.zeros(6)}
    inputs |= {"saturated": [0.0], "wrench_B": wrench, "load_wrench_B": 0.5 * wrench}
    for name, value in inputs.items():
        block.GetInputPort(name).FixValue(context, value)
    ends = block.EvalUniquePeriodicDiscreteUpdate(context).value(2)
    held = ends[SLAVE_METHOD_MEMORY_SLICE][LAST_PORT_WRENCH]
    assert np.linalg.norm(held[:3]) == pytest.approx(np.linalg.norm(wrench[:3]) / 0.5)
    np.testing.assert_allclose(ends[SLAVE_METHOD_MEMORY_SLICE][LOAD_WRENCH], 0.5 * held, atol=1e-15)


def test_packets_in_transit_belong_to_the_context():
    """Two contexts from the same instant each receive their own packets."""
    block = MakeChannel(moving(channel__delay=0.01)).GetSubsystemByName("channel")
    pose = np.array([1.0, 0.0, 0.0, 0.0, 0.1, 0.2, 0.3])

    def steps(context: Context, number: int, wrench: float) -> None:
        for name in ("pose_command", "pose_slave"):
            block.GetInputPort(name).FixValue(context, pose)
        for name, value in (("hand_wrench_E", 0.0), ("wrench_B", wrench)):
            block.GetInputPort(name).FixValue(context, np.full(6, value))
        block.GetInputPort("saturated").FixValue(context, [0.0])
        for _ in range(number):
            context.SetDiscreteState(block.EvalUniquePeriodicDiscreteUpdate(context))

    def rendered_force(context: Context) -> np.ndarray:
        return block.GetOutputPort("wrench_received").Eval(context)

    one, alone = block.CreateDefaultContext(), block.CreateDefaultContext()
    steps(one, 800, 1.0)
    other = one.Clone()
    for _ in range(40):
        steps(one, 1, 0.6)
        steps(other, 1, 0.3)
    steps(alone, 800, 1.0)
    steps(alone, 40, 0.3)
    assert rendered_force(one)[0] > 1.2 * rendered_force(alone)[0] > 0.0
    np.testing.assert_array_equal(rendered_force(other), rendered_force(alone))


def test_directions_may_differ():
    channel = Channel(delay=0.1, backward=NetworkConfig(delay=0.2))
    assert [line.delay for line in channel.networks_of_directions()] == [0.1, 0.2]
    assert Channel(network="lunar").networks_of_directions() == (PRESETS["lunar"], PRESETS["lunar"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"channel": Channel(network="lan", delay=0.1)},
            r"channel\.network.*cannot be combined with delay; ",
        ),
        (
            {"channel": Channel(rate_hz=10.0, timeout=0.15)},
            r"channel\.timeout.*below two packet intervals",
        ),
        (
            {"channel": Channel(backward=NetworkConfig(loss=0.9, burst_loss=0.5))},
            r"channel\.backward\.loss: mean loss 0\.9 is above",
        ),
        (
            {"channel": Channel(loss=0.8, burst_loss=0.3, backward=NetworkConfig())},
            r"channel\.loss: mean loss 0\.8 is above",
        ),
    ],
)
def test_invalid_channel_is_rejected(changes, message, load_estimate):
    with pytest.raises(DrakeTeleopError, match=message):
        MakeTeleopStation(replace(Scenario(), **changes), load_estimate=load_estimate)


@pytest.mark.slow
def test_temporary_failure_of_the_wrist_sensor_stops_the_station_smoothly(
    monkeypatch, load_estimate
):
    """The wrench is NaN from 0.2 to 0.4 s while the hand moves."""
    scenario = moving(
        channel__delay=0.01,
        simulation__duration=1.2,
        rates__log_hz=1000.0,
    )
    sound = run(scenario, load_estimate)

    def failing(method, pose, wrench_B, *rest):
        ends = rest[-4]
        failed = 2 * 800 <= ends[0] < 2 * 1000  # at 2 kHz, after 0.6 s of settling
        step_channel(method, pose, np.full(6, np.nan) if failed else wrench_B, *rest)

    monkeypatch.setattr(channel, "step_channel", failing)
    result = run(scenario, load_estimate)
    for name in result:
        values = result[name][:, :4] if name == "ports" else result[name]  # then the ages
        assert np.isfinite(values).all(), name
    t, force = result.t, np.linalg.norm(result["force_to_master"][:, :3], axis=1)
    position = result["pose_received"][:, 4:]
    safe = (t > 0.2 + 0.01 + STOP_TIME_S + 0.005) & (t < 0.4)
    assert force[safe].max() < 1e-12
    assert np.ptp(position[safe], axis=0).max() < 1e-12
    # Later the hand receives the full inertia of the tool, which vibrates also without the failure.
    resumed = t[1:] < 0.4 + 0.01 + RESUME_TIME_S
    assert np.abs(np.diff(result["force_to_master"][:, :3], axis=0))[resumed].max() < 0.5
    fastest = np.abs(np.diff(sound["pose_received"][:, 4:], axis=0)).max()
    assert np.abs(np.diff(position, axis=0)).max() < 2.0 * fastest
    again = t > 1.1
    np.testing.assert_allclose(position[again], sound["pose_received"][again, 4:], atol=2e-3)
    assert force[again].max() > 0.1


def test_the_timeout_follows_from_the_worse_of_both_directions():
    """1.5 silences of a packet every 0.2 s, from 0.1 s to 1 s, unless configured."""
    slow = NetworkConfig(rate_hz=5.0)
    for one in (Channel(rate_hz=5.0, backward=NetworkConfig()), Channel(backward=slow)):
        assert one.timeout_s(1e-3) == pytest.approx(0.3)
    waits = [Channel(network=name).timeout_s(5e-4) for name in PRESETS]
    assert waits[:3] == [0.1] * 3
    assert waits == sorted(waits) and waits[-1] < 0.5
    assert Channel(rate_hz=1.0).timeout_s(1e-3) == 1.0
    assert Channel(rate_hz=5.0, timeout=0.4).timeout_s(1e-3) == 0.4
