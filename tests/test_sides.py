"""The three sides: documented ports, custom sides, external intent."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from operator_motion import intent_at
from pydrake.systems.framework import BasicVector, Diagram, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource

from drake_teleop.common.blocks import Fault
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.comparison.whole_station import injected_energy
from drake_teleop.lab.identification import true_load
from drake_teleop.load.contact.noise_floor import NoiseFloor
from drake_teleop.station.channel.channel import Channel
from drake_teleop.station.channel_side import MakeChannel
from drake_teleop.station.estimation.contact_detection import ContactDetectionConfig
from drake_teleop.station.master_side import MakeMasterSide
from drake_teleop.station.operator.operator import OperatorConfig, Sine
from drake_teleop.station.operator.task import Touch
from drake_teleop.station.scenario import LoadScenario, Scenario, Simulation, replace
from drake_teleop.station.signals import SIGNALS
from drake_teleop.station.simulation import MakeSimulator, simulate
from drake_teleop.station.slave_side import MakeSlaveSide
from drake_teleop.station.station import GetBlock, MakeTeleopStation
from drake_teleop.station.wiring import build_with_log

PAGE = (Path(__file__).parents[1] / "docs" / "station.md").read_text(encoding="utf-8")
ROWS = re.findall(r"^\| (\w+) \| `(\w+)` \| (in|out) \| (\d+) \| (.*?) \|", PAGE, re.M)
CODE = re.findall(r"```python\n(.*?)```", PAGE, re.S)
SHORT = Simulation(settle=0.0, duration=0.3)


def floor() -> NoiseFloor:
    rising, still = np.zeros((6, 2)), np.zeros(6)
    return NoiseFloor(
        np.ones(6), np.identity(16), rising, np.identity(6), still, free_maxima=np.ones(3)
    )


def sides(scenario: Scenario) -> dict[str, Diagram]:
    return {
        "master_side": MakeMasterSide(scenario),
        "channel": MakeChannel(scenario),
        "slave_side": MakeSlaveSide(scenario, load_estimate=np.ones(16), noise_floor=floor()),
    }


def ports(side: Diagram, direction: str) -> dict[str, int]:
    count = side.num_input_ports() if direction == "in" else side.num_output_ports()
    get = side.get_input_port if direction == "in" else side.get_output_port
    return {get(i).get_name(): get(i).size() for i in range(count)}


def written(name: str, direction: str, without: tuple[str, ...] = ()) -> dict[str, int]:
    return {
        port: int(size)
        for side, port, way, size, meaning in ROWS
        if side == name and way == direction and not any(word in meaning for word in without)
    }


@pytest.mark.parametrize("rate", [10.0, 25.0, 8000.0])
def test_sample_is_valid_for_two_periods_of_a_slow_sensor_or_50_ms(rate):
    scenario = replace(Scenario(), wrist_sensor__ideal=True, rates__sensor_hz=rate)
    block = MakeSlaveSide(scenario).GetSubsystemByName("force_scaling")
    context, oldest = block.CreateDefaultContext(), max(0.05, 2 / rate)
    context.SetTime(3.0)
    block.GetInputPort("load_estimate").FixValue(context, np.zeros(16))
    for age, fault in ((0.99 * oldest, Fault.NONE), (1.01 * oldest, Fault.OLD_SAMPLE)):
        block.GetInputPort("sample").FixValue(context, np.append(np.zeros(22), 3.0 - age))
        assert block.GetOutputPort("fault").Eval(context)[0] == fault


@pytest.mark.parametrize("direct", [True, False], ids=["direct", "network"])
def test_ports_equal_the_documented_ports(direct):
    scenario = replace(LoadScenario("contact_transition"), operator__task=Touch())
    absent = ("over a network",)
    if not direct:
        scenario = replace(scenario, channel=Channel(network="lan"))
        scenario = replace(scenario, contact_detection=ContactDetectionConfig())
        absent = ()
    else:
        absent = ("over a network", "with contact detection")
    for name, side in sides(scenario).items():
        assert ports(side, "in") == written(name, "in", absent)
        # The contract contains exactly the ports that are not signals.
        found, agreed = ports(side, "out"), written(name, "out", absent)
        assert {port: size for port, size in found.items() if port not in SIGNALS} == {
            port: size for port, size in agreed.items() if port not in SIGNALS
        }
        assert agreed.items() <= found.items()
        for port, size in found.items():
            assert port not in SIGNALS or size == len(SIGNALS[port].components)


@pytest.mark.slow
def test_custom_sides_of_the_docs_work(tmp_path, monkeypatch):
    """Run the custom master and the recorded slave of docs/station.md."""
    monkeypatch.chdir(tmp_path)
    names: dict = {}
    for block in CODE:
        exec(compile(block, "station.md", "exec"), names)
    recorded, result = names["recorded"], names["result"]
    t, start = result.t, np.array(names["scenario"].slave.position)
    circle = 0.01 * np.stack(
        [np.cos(2 * np.pi * t) - 1, np.sin(2 * np.pi * t), np.zeros_like(t)], axis=1
    )
    np.testing.assert_allclose(result["pose_command"][:, 4:], start + circle, atol=1e-12)
    assert list(result) == ["pose_command"]
    # The hand gets the force that was displayed when the log was recorded.
    simulator = MakeSimulator(names["replayed"], names["scenario"].simulation)
    simulator.AdvanceTo(0.4 + 1e-4)
    station = names["replayed"]
    master = station.GetSubsystemByName("master_side")
    context = master.GetMyContextFromRoot(simulator.get_context())
    felt = np.linalg.norm(recorded["force_to_master"][:401, :3], axis=1)
    assert master.GetOutputPort("largest_force").Eval(context)[0] == felt.max() > 1.0
    # The external intent has raised the stylus by nearly the intended distance.
    assert names["lifted"][6] - names["scenario"].master.position[2] == pytest.approx(
        0.02, abs=5e-3
    )


class Intent(LeafSystem):
    """The scenario's intent as an external block."""

    def __init__(self, segments, start) -> None:
        super().__init__()
        self._segments, self._start = segments, start
        time = {self.time_ticket()}
        self.DeclareVectorOutputPort("intended_pose", 7, self._pose, time)
        self.DeclareVectorOutputPort("intended_twist", 6, self._twist, time)

    def _pose(self, context, output: BasicVector) -> None:
        output.SetFromVector(intent_at(self._segments, self._start, context.get_time())[0][0])

    def _twist(self, context, output: BasicVector) -> None:
        output.SetFromVector(intent_at(self._segments, self._start, context.get_time())[1][0])


@pytest.mark.slow
def test_intent_from_port_equals_intent_of_scenario():
    sine = Sine(
        duration=10.0, ramp=0.05, frequency=3.0, translation=[0.01, 0.02, 0.015],
        rotation=[0.1, -0.2, 0.1],
    )  # fmt: skip
    scenario = replace(Scenario(), simulation=SHORT, operator=OperatorConfig(intent=[sine]))
    own = simulate(MakeTeleopStation(scenario), SHORT)

    idle = replace(scenario, operator=OperatorConfig())
    builder = DiagramBuilder()
    station = builder.AddNamedSystem("station", MakeTeleopStation(idle))
    start = np.array([1.0, 0.0, 0.0, 0.0, *scenario.master.position])
    intent = builder.AddSystem(Intent([sine], start))
    for name in ("intended_pose", "intended_twist"):
        builder.Connect(intent.GetOutputPort(name), station.GetInputPort(name))
    simulator = MakeSimulator(builder.Build(), SHORT)
    simulator.AdvanceTo(SHORT.duration)
    context = station.GetMyContextFromRoot(simulator.get_context())
    for name in ("pose_master", "force_to_master", "slave_state"):
        led = station.GetOutputPort(name).Eval(context)
        np.testing.assert_allclose(led, own[name][-1], rtol=0, atol=1e-12)
    assert np.abs(own["pose_master"][-1] - own["pose_master"][0]).max() > 1e-3


def test_intent_without_twist_lags_and_invalid_intent_is_rejected():
    station = MakeTeleopStation(Scenario())
    simulator = MakeSimulator(station, SHORT)
    context, port = simulator.get_mutable_context(), station.GetInputPort("intended_pose")
    # The norm of a quaternion has no meaning.
    port.FixValue(context, [2.0, 0.0, 0.0, 0.0, 0.27, 0.0, 0.05])
    intent = station.GetOutputPort("intent").Eval(context)
    np.testing.assert_array_equal(intent, [1.0, 0.0, 0.0, 0.0, 0.27, 0.0, 0.05])
    hand = station.GetOutputPort("hand_wrench_E").Eval(context)
    assert hand[2] == pytest.approx(0.02 * Scenario().operator.hand.stiffness)
    station.GetInputPort("intended_twist").FixValue(context, [0.0, 0.0, 0.5, 0.0, 0.0, 0.0])
    faster = station.GetOutputPort("hand_wrench_E").Eval(context)
    assert faster[2] - hand[2] == pytest.approx(0.5 * Scenario().operator.hand.damping)
    for bad in ([np.nan] * 7, [0.0] * 7):
        port.FixValue(context, bad)
        with pytest.raises(DrakeTeleopError, match="intended_pose"):
            station.GetOutputPort("hand_wrench_E").Eval(context)


class Silent(LeafSystem):
    """Side with ports of given sizes that output zeros."""

    def __init__(self, inputs: dict[str, int], outputs: dict[str, int]) -> None:
        super().__init__()
        for name, size in inputs.items():
            self.DeclareVectorInputPort(name, size)
        for name, size in outputs.items():
            self.DeclareVectorOutputPort(name, size, lambda context, output: None)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"master": ({"wrench_command": 6}, {})},
            "master_side: the block has no output port 'pose_c",
        ),
        (
            {"master": ({}, {"pose_command": 7})},
            "master_side: the block has no input port 'wrench_c",
        ),
        ({"master": ({"wrench_command": 6}, {"pose_command": 6})}, "'pose_command' has 6 .* 7"),
        (
            {"slave": ({"pose_command": 7}, {})},
            "slave_side: the block has no output port 'wrench_B'",
        ),
        ({"slave": ({"pose_command": 7}, {"wrench_B": 3})}, "'wrench_B' has 3 numbers.* 6"),
    ],
)
def test_side_without_required_port_gives_one_error(options, message):
    own = {name: Silent(*sizes) for name, sizes in options.items()}
    with pytest.raises(DrakeTeleopError, match=rf"{message}.*docs/station\.md"):
        MakeTeleopStation(Scenario(), **own)


def test_network_requires_more_ports_of_a_custom_slave():
    scenario = replace(Scenario(), channel=Channel(delay=0.01))
    slave = Silent({"pose_command": 7}, {"wrench_B": 6})
    with pytest.raises(
        DrakeTeleopError, match="slave_side: the block has no output port 'pose_slave'"
    ):
        MakeTeleopStation(scenario, slave=slave)
    whole = Silent({"pose_command": 7}, {"wrench_B": 6, "pose_slave": 7, "saturated": 1})
    assert "pose_received" in simulate(MakeTeleopStation(scenario, slave=whole), SHORT)


def test_blocks_are_found_in_all_sides():
    station = MakeTeleopStation(Scenario())
    for name in ("operator", "master_device", "slave_plant", "force_scaling", "monitor"):
        assert GetBlock(station, name).get_name() == name
    message = "^name: the station has no block 'slave_plan'; did you mean 'slave_plant'\\?$"
    with pytest.raises(DrakeTeleopError, match=message):
        GetBlock(station, "slave_plan")


def test_documented_causes_of_faults_are_those_of_the_code():
    rows = re.findall(r"^\| (\d) `(\w+)` \|", PAGE, re.M)
    assert rows == [(str(int(fault)), fault.name) for fault in Fault if fault != Fault.NONE]


@pytest.mark.parametrize("parts", [("measured_wrench_S",), ("measured_wrench_S", "sample_time")])
@pytest.mark.parametrize("combined", ["sample", "scaled_contact_and_fault"])
def test_log_of_a_side_with_combined_port_and_few_parts_is_right(combined, parts):
    names = {combined: 23, **dict.fromkeys(parts, 6), "slave_state": 12, "fault": 1}
    names |= {"sample_time": 1} if "sample_time" in parts else {}
    builder = DiagramBuilder()
    side = DiagramBuilder()
    for value, (name, size) in enumerate(names.items()):
        block = side.AddNamedSystem(name, ConstantVectorSource(np.full(size, 1.0 + value)))
        side.ExportOutput(block.get_output_port(), name)
    custom = builder.AddNamedSystem("slave_side", side.Build())
    station = build_with_log(builder, "station", (custom,), 1000.0)
    result = simulate(station, Simulation(settle=0.0, duration=0.002))
    assert set(result.signals) == names.keys() - {combined}
    for value, name in enumerate(names):
        if name != combined:
            np.testing.assert_array_equal(result[name], 1.0 + value)


def test_direct_wires_replace_an_ideal_channel():
    seen = replace(Scenario(), contact_detection=ContactDetectionConfig())
    far = replace(Scenario(), channel=Channel(delay=0.01))
    assert not MakeTeleopStation(Scenario()).HasSubsystemNamed("channel")
    assert MakeTeleopStation(far).HasSubsystemNamed("channel")
    station = MakeTeleopStation(seen, load_estimate=true_load(seen), noise_floor=floor())
    assert station.HasSubsystemNamed("channel") and station.HasOutputPort("contact_at_hand")


def test_direct_channel_passes_values_through():
    builder = DiagramBuilder()
    channel = builder.AddSystem(MakeChannel(Scenario()))
    pose, wrench = np.arange(1.0, 8.0), np.arange(-3.0, 3.0)
    for name, value in (("pose_command", pose), ("wrench_B", wrench)):
        source = builder.AddSystem(ConstantVectorSource(value))
        builder.Connect(source.get_output_port(), channel.GetInputPort(name))
    diagram = builder.Build()
    context = channel.GetMyContextFromRoot(diagram.CreateDefaultContext())
    for name, value in (("pose_to_slave", pose), ("wrench_to_master", wrench)):
        np.testing.assert_array_equal(channel.GetOutputPort(name).Eval(context), value)


class Follower(LeafSystem):
    """Controller that passes the pose command to the inverse kinematics of the slave."""

    def __init__(self, output: str = "pose_command", size: int = 7) -> None:
        super().__init__()
        entry = self.DeclareVectorInputPort("pose_command", 7)
        self.DeclareVectorOutputPort(
            output, size, lambda context, out: out.SetFromVector(entry.Eval(context)[:size])
        )


@pytest.mark.parametrize("torques", [False, True])
def test_contact_wrench_for_a_controller_requires_a_load_estimate(torques):
    outputs = {"joint_torque": 6} if torques else {"pose_command": 7}
    inputs = {"pose_command": 7, "contact_wrench_S": 6}
    message = "contact_wrench_S of the controller requires a load estimate, but there is none; pass"
    with pytest.raises(DrakeTeleopError, match=message):
        MakeSlaveSide(Scenario(), controller=Silent(inputs, outputs))
    for options in ({"load_estimate": np.ones(16)}, {}):
        scenario = replace(Scenario(), load_estimator__enabled=not options)
        MakeSlaveSide(scenario, controller=Silent(inputs, outputs), **options)


SHORT_RUN = {"simulation__settle": 0.0, "simulation__duration": 0.05, "force_scaling__sigma": 1.0}


def test_a_controller_that_passes_the_pose_on_changes_nothing():
    scenario = replace(LoadScenario("free_motion_force"), **SHORT_RUN)
    own = MakeTeleopStation(scenario, slave=MakeSlaveSide(scenario, controller=Follower()))
    results = [simulate(s, scenario.simulation) for s in (own, MakeTeleopStation(scenario))]
    for name in results[1]:
        np.testing.assert_array_equal(results[0][name], results[1][name])


def test_a_torque_that_is_no_number_keeps_the_arm_where_it_is():
    class Broken(LeafSystem):
        def __init__(self) -> None:
            super().__init__()
            self.DeclareVectorInputPort("pose_command", 7)
            self.DeclareVectorOutputPort(
                "joint_torque", 6, lambda _, out: out.SetFromVector([np.nan] * 6)
            )

    scenario = replace(LoadScenario("free_motion_force"), **SHORT_RUN)
    slave = MakeSlaveSide(scenario, controller=Broken())
    result = simulate(MakeTeleopStation(scenario, slave=slave), scenario.simulation)
    assert (result["joint_torque"] == result["joint_torque"][0]).all()
    assert np.ptp(result["slave_state"], axis=0).max() < 1e-3
    assert "joint_command" not in result.signals


@pytest.mark.parametrize(
    ("controller", "says"),
    [
        ("impedance", "controller: expected System, found 'impedance'; make a Drake system"),
        (
            Silent({"wrench_B": 6}, {}),
            "controller: the custom controller has no input port 'pose_command'",
        ),
        (
            Silent({"pose_command": 7}, {}),
            "controller: the custom controller has no output port 'joint_torque'",
        ),
        (Follower("joint_torque", 5), "its output port 'joint_torque' has 5 numbers"),
    ],
)
def test_a_controller_without_its_ports_is_one_line(controller, says):
    with pytest.raises(DrakeTeleopError, match=says):
        MakeSlaveSide(replace(Scenario(), force_scaling__sigma=1.0), controller=controller)


def test_a_custom_channel_takes_the_place_of_the_scenarios():
    """Use the channel of another scenario, which delays the command."""
    scenario = replace(LoadScenario("free_motion_force"), **SHORT_RUN)
    delayed = replace(scenario, channel__delay=0.02)
    stations = (
        MakeTeleopStation(scenario, channel=MakeChannel(delayed)),
        MakeTeleopStation(delayed),
    )
    own, expected = (simulate(station, scenario.simulation) for station in stations)
    np.testing.assert_array_equal(own["pose_received"], expected["pose_received"])
    with pytest.raises(
        DrakeTeleopError, match="channel: the block has no input port 'pose_command'"
    ):
        MakeTeleopStation(scenario, channel=Silent({}, {}))


@pytest.mark.slow
def test_example_controllers_press_a_wall_without_creating_energy():
    """Each controller has at most 40 lines; energy is that at the actual motion, 50 ms each way."""
    page = Path(__file__).parents[1] / "docs" / "controllers.md"
    blocks, names = re.findall(r"```python\n(.*?)```", page.read_text(), re.S), {}
    assert max(len(text.splitlines()) for text in blocks if text.startswith("class ")) <= 40
    exec(compile("\n".join(blocks), "controllers.md", "exec"), names)
    assert len(names["results"]) == 4
    for (_, method), (result, scenario) in names["results"].items():
        assert result["true_contact_wrench_W"][:, 2].max() > 10.0
        assert result["true_contact_wrench_W"][-1, 2] > 5.0  # the hand presses to the end
        # With the initial energy E0. `tdpa` has none and dissipates one hand period late.
        assert injected_energy(result, scenario).min() >= (-1e-6 if method == "tdpa" else 0.0)
