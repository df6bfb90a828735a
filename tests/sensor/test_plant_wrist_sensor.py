"""The wrist sensor on a user's own plant, against the plant's reaction forces and V phi."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Box,
    ProximityProperties,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    PrismaticJoint,
    RotationalInertia,
    SpatialInertia,
    UnitInertia,
    WeldJoint,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from drake_teleop import AddWristSensor
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.regressor import LOST_SAMPLE_FLAG_THRESHOLD, non_contact_wrench
from drake_teleop.station.sensor.presets import PRESETS
from drake_teleop.station.sensor.sensor_chain import (
    DISABLED_PART_VALUES,
    WristSensorConfig,
    without_parts,
)

ARM = Path(__file__).parents[2] / "docs" / "gallery" / "arm.urdf"
TOOL = SpatialInertia.MakeFromCentralInertia(
    1.3, [0.01, -0.02, 0.07], RotationalInertia(0.004, 0.005, 0.003)
)
Q = [0.2, -0.6, 1.9, 0.3, 0.5, -0.2]
V = [0.5, -1.0, 0.8, 1.5, -1.2, 2.0]
TORQUE = [5.0, -30.0, -12.0, 2.0, -1.0, 0.5]
TURNED = RigidTransform(RollPitchYaw(0.4, -0.7, 1.1), [0.01, 0.03, -0.02])
MOTION = ("specific_force_S", "angular_velocity_S", "angular_acceleration_S")


def arm(builder, time_step, sampled=True, base=None, wall=None, X_FTool=None):
    """Return a plant with arm and tool, and the weld between them, not finalized."""
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step)
    if time_step:
        plant.SetUseSampledOutputPorts(sampled)
    Parser(plant).AddModels(str(ARM))
    for joint in ("pan", "lift", "elbow", "wrist_1", "wrist_2", "wrist_3"):
        plant.AddJointActuator(joint, plant.GetJointByName(joint))
    foot = plant.GetFrameByName("base")
    if base is None:
        plant.WeldFrames(plant.world_frame(), foot)
    elif base == "floating":
        chassis = plant.AddRigidBody("chassis", foot.model_instance(), TOOL)
        plant.WeldFrames(foot, chassis.body_frame())
    else:
        plant.AddJoint(PrismaticJoint("rails", plant.world_frame(), foot, [0.6, 0.0, 0.8]))
    instance = plant.AddModelInstance("gripper")
    tool = plant.AddRigidBody("gripper_body", instance, TOOL)
    X = RigidTransform([0, 0, 0.045]) if X_FTool is None else X_FTool
    weld = plant.AddJoint(WeldJoint("wrist", plant.GetFrameByName("sensor"), tool.body_frame(), X))
    if wall is not None:
        soft, hard = ProximityProperties(), ProximityProperties()
        AddContactMaterial(5.0, 2e4, CoulombFriction(0.3, 0.3), soft)
        AddContactMaterial(5.0, 2e4, CoulombFriction(0.3, 0.3), hard)
        if wall == "hydroelastic":
            AddCompliantHydroelasticProperties(0.03, 1e6, soft)
            AddRigidHydroelasticProperties(0.5, hard)
        ball, box, X_WWall = Sphere(0.1), Box(4.0, 4.0, 1.0), RigidTransform([0.0, 0.0, 0.09])
        plant.RegisterCollisionGeometry(tool, RigidTransform(), ball, "ball", soft)
        plant.RegisterCollisionGeometry(plant.world_body(), X_WWall, box, "wall", hard)
    return plant, weld


def moving(time_step=0.0, config=None, frame=None, without_gravity=None, **options):
    """Return a running Diagram with the sensor at the wrist; constant torques drive the arm."""
    sensor_options = {k: options.pop(k) for k in ("period", "model_instance") if k in options}
    builder = DiagramBuilder()
    plant, weld = arm(builder, time_step, **options)
    if without_gravity:
        plant.set_gravity_enabled(plant.GetModelInstanceByName(without_gravity), False)
    if frame is not None:
        sensor_frame = plant.GetFrameByName("sensor")
        frame = plant.AddFrame(FixedOffsetFrame("S", sensor_frame, frame))
    plant.Finalize()
    sensor = AddWristSensor(builder, plant, frame or weld, config, **sensor_options)
    torque = builder.AddSystem(ConstantVectorSource(TORQUE))
    builder.Connect(torque.get_output_port(), plant.get_actuation_input_port())
    simulator = Simulator(builder.Build())
    own = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    joints = plant.GetModelInstanceByName("arm")
    rest = [plant.GetPositions(own, joints), plant.GetVelocities(own, joints)]
    rest[0][-6:], rest[1][-6:] = Q, V
    plant.SetPositions(own, joints, rest[0])
    plant.SetVelocities(own, joints, rest[1])
    simulator.Initialize()
    return SimpleNamespace(
        plant=plant, weld=weld, S=frame or weld.frame_on_parent(), sensor=sensor,
        simulator=simulator, context=own,
    )  # fmt: skip


def reading(run, name):
    context = run.sensor.GetMyContextFromRoot(run.simulator.get_context())
    return run.sensor.GetOutputPort(name).Eval(context)


def phi(run):
    """Return the tool's inertial parameters about So in S, from Drake."""
    tool = run.plant.GetBodyByName("gripper_body").index()
    M = run.plant.CalcSpatialInertia(run.context, run.S, [tool])
    inertia = M.CalcRotationalInertia().CopyToFullMatrix3()
    return np.array([M.get_mass(), *M.get_mass() * M.get_com(), *inertia[np.triu_indices(3)]])


def reaction(run, X_WS, X_WJc):
    """Return the weld's reaction about So, in S."""
    F_Jc = run.plant.get_reaction_forces_output_port().Eval(run.context)[
        list(run.plant.GetJointIndices()).index(run.weld.index())
    ]
    R_SJc = X_WS.rotation().inverse() @ X_WJc.rotation()
    f, tau = R_SJc @ F_Jc.translational(), R_SJc @ F_Jc.rotational()
    p_SoJc_S = X_WS.inverse() @ X_WJc.translation()
    return np.concatenate([f, tau + np.cross(p_SoJc_S, f)])


def compare(run, tolerance, instants, period=1e-3):
    """Compare the samples of some instants with the weld's reaction; return the largest force."""
    largest = 0.0
    after = run.plant.time_step() > 0 and run.plant.has_sampled_output_ports()
    for k in instants:
        if k > 0:  # otherwise Drake handles the events of the present instant
            run.simulator.AdvanceTo(k * period)
        poses = [frame.CalcPoseInWorld(run.context) for frame in (run.S, run.weld.frame_on_child())]
        positions = run.plant.GetPositions(run.context)
        before = None if after else reaction(run, *poses)
        run.simulator.AdvanceTo(k * period + 1e-7)
        expected = reaction(run, *poses) if after else before
        measured = reading(run, "measured_wrench_S")
        np.testing.assert_allclose(measured, expected, rtol=0, atol=tolerance)
        np.testing.assert_array_equal(reading(run, "joint_position"), positions)
        assert reading(run, "sample_time")[0] == pytest.approx(k * period, abs=1e-12)
        assert reading(run, "status") == [0.0]
        largest = max(largest, np.abs(measured[:3]).max())
    return largest


def load_wrench(run):
    return non_contact_wrench(*(reading(run, name) for name in MOTION), phi(run))


PLANTS = {
    "continuous": ({}, 1e-12),
    "discrete": ({"time_step": 1e-3}, 1e-9),
    "unsampled": ({"time_step": 1e-3, "sampled": False}, 1e-9),
}


@pytest.mark.parametrize("kind", PLANTS)
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"frame": TURNED, "X_FTool": RigidTransform(RollPitchYaw(1.0, 0.2, -2.0), [0.1, 0.0, 0.2])},
        {"base": "rails"},
        {"base": "floating"},
    ],
    ids=["arm", "turned", "rails", "floating"],
)
def test_wrench_equals_reaction_and_v_phi_in_free_motion(kind, options):
    plant, tolerance = PLANTS[kind]
    run = moving(**plant, **options)
    for k in (0, 1, 2, 57):
        assert compare(run, tolerance, [k]) > 1.0
        wrench = reading(run, "measured_wrench_S")
        np.testing.assert_allclose(load_wrench(run), wrench, rtol=0, atol=max(tolerance, 1e-11))


def wall_force_W(run):
    results = run.plant.get_contact_results_output_port().Eval(run.context)
    if results.num_hydroelastic_contacts():
        force = results.hydroelastic_contact_info(0).F_Ac_W().translational()
    else:
        force = results.point_pair_contact_info(0).contact_force()
    return force * np.sign(force[2])  # the wall pushes upwards


@pytest.mark.parametrize("kind", PLANTS)
@pytest.mark.parametrize("contact", ["point", "hydroelastic"])
def test_wrench_contains_the_contact_of_the_tool(kind, contact):
    plant, tolerance = PLANTS[kind]
    run = moving(wall=contact, **plant)
    assert compare(run, tolerance, [3, 4]) > 1.0
    run.simulator.AdvanceTo(5e-3)
    R_WS, expected = run.S.CalcPoseInWorld(run.context).rotation().matrix(), None
    if kind != "discrete":
        expected = wall_force_W(run)
    run.simulator.AdvanceTo(5e-3 + 1e-7)
    if kind == "discrete":  # its contact results are those of the last step
        expected = wall_force_W(run)
    contact_S = (load_wrench(run) - reading(run, "measured_wrench_S"))[:3]
    assert expected[2] > 20.0
    np.testing.assert_allclose(R_WS @ contact_S, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("sampled", [True, False])
@pytest.mark.parametrize("steps", [2, 5])
def test_samples_of_several_time_steps_belong_to_the_instant_of_the_sample(sampled, steps):
    run = moving(time_step=1e-3, sampled=sampled, period=steps * 1e-3)
    assert run.sensor.period == pytest.approx(steps * 1e-3)
    compare(run, 1e-9, [0, 1, 2, 7], steps * 1e-3)
    held = reading(run, "measured_wrench_S").copy()
    run.simulator.AdvanceTo(8 * steps * 1e-3 - 5e-4)
    np.testing.assert_array_equal(reading(run, "measured_wrench_S"), held)


def test_samples_are_right_after_the_state_is_set_at_a_later_time():
    """A second Initialize pairs the new state, at a time that is not zero."""
    run = moving(time_step=1e-3)
    run.simulator.AdvanceTo(0.0105)
    run.plant.SetVelocities(run.context, np.zeros(6))
    run.simulator.Initialize()
    compare(run, 1e-9, [11, 12])


def test_joint_position_is_that_of_one_model_instance():
    run = moving(base="floating")
    builder = DiagramBuilder()
    plant, weld = arm(builder, 0.0, base="rails")
    plant.Finalize()
    gripper = plant.GetModelInstanceByName("gripper")
    sensor = AddWristSensor(builder, plant, weld, model_instance=gripper)
    assert run.sensor.GetOutputPort("joint_position").size() == 6 + 7
    assert sensor.GetOutputPort("joint_position").size() == 0
    assert sensor.GetOutputPort("sample").size() == 17


def test_a_weld_from_tool_to_arm_gives_the_wrench_on_the_tool():
    """Parent and child are a convention of the model; S stays on the arm."""
    builder = DiagramBuilder()
    plant = builder.AddSystem(MultibodyPlant(0.0))
    Parser(plant).AddModels(str(ARM))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
    tool = plant.AddRigidBody("tool", plant.AddModelInstance("gripper"), TOOL)
    frame, flange = tool.body_frame(), plant.GetFrameByName("sensor")
    weld = plant.AddJoint(WeldJoint("wrist", frame, flange, RigidTransform([0, 0, -0.045])))
    plant.Finalize()
    sensor = AddWristSensor(builder, plant, weld)
    twin = moving()
    simulator = Simulator(builder.Build())
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    plant.SetPositions(context, Q)
    plant.SetVelocities(context, V)
    torque = plant.get_applied_generalized_force_input_port()
    torque.FixValue(context, TORQUE)
    for each in (simulator, twin.simulator):
        each.AdvanceTo(1e-4)
    wrench = sensor.GetOutputPort("measured_wrench_S")
    wrench = wrench.Eval(sensor.GetMyContextFromRoot(simulator.get_context()))
    np.testing.assert_allclose(wrench, reading(twin, "measured_wrench_S"), rtol=0, atol=1e-12)


@pytest.mark.parametrize("off", ["gripper", "arm"])
def test_specific_force_has_no_gravity_if_the_tool_has_none(off):
    """V phi equals the wrench with and without gravity."""
    run = moving(without_gravity=off)
    run.simulator.AdvanceTo(1e-4)
    wrench = reading(run, "measured_wrench_S")
    np.testing.assert_allclose(load_wrench(run), wrench, rtol=0, atol=1e-11)


def test_a_conversion_to_other_scalars_is_one_line():
    sensor = moving().sensor
    for convert in (sensor.ToAutoDiffXd, sensor.ToSymbolic):
        with pytest.raises(DrakeTeleopError, match=r"^PlantWristSensor: .* for double only; .*$"):
            convert()


def test_outputs_before_the_first_sample_are_flagged():
    run = moving(time_step=1e-3)
    assert reading(run, "status") == [LOST_SAMPLE_FLAG_THRESHOLD]
    run.simulator.AdvanceTo(1e-4)
    assert reading(run, "status") == [0.0]


def record(run, name, count, period):
    rows = []
    for k in range(count):
        run.simulator.AdvanceTo((k + 0.5) * period)
        rows.append(reading(run, name).copy())
    return np.array(rows)


def test_sample_has_all_parts_side_by_side():
    run = moving(config=PRESETS["jr3_85m35a3"], period=125e-6)
    run.simulator.AdvanceTo(0.002)
    names = ("measured_wrench_S", *MOTION, "status", "joint_position", "sample_time")
    parts = np.concatenate([reading(run, name) for name in names])
    np.testing.assert_array_equal(reading(run, "sample"), parts)
    assert parts.shape == (6 + 9 + 1 + 6 + 1,)


@pytest.mark.parametrize("preset", ["jr3_85m35a3", "bota_sensone"])
def test_a_preset_has_its_noise_and_offset(preset):
    config = without_parts(PRESETS[preset], "low_pass", "drift", "random_walk", "calibration")
    run = at_rest(config)
    wrench = record(run, "measured_wrench_S", 600, 1e-3)
    truth = -9.81 * 1.3 * np.array([0.0, 0.0, -1.0])
    np.testing.assert_allclose(wrench.std(axis=0), config.wrench_std(), rtol=0.15)
    mean = wrench[:, :3].mean(axis=0) - config.offset[:3]
    np.testing.assert_allclose(mean, truth, atol=6 * config.wrench_std()[:3].max() / np.sqrt(600))


def test_saturation_is_flagged_and_limited():
    config = without_parts(WristSensorConfig(force_range=[200.0, 200.0, 5.0]), "low_pass", "noise")
    run = at_rest(config)
    run.simulator.AdvanceTo(2.5e-3)
    assert reading(run, "status") == [1.0]
    assert reading(run, "measured_wrench_S")[2] == 5.0


def test_latencies_of_all_paths_meet_in_one_instant():
    """V phi equals the wrench in motion, although the accelerations are 3 samples late."""
    config = without_parts(WristSensorConfig(), *DISABLED_PART_VALUES)
    config.acceleration_latency = 3e-3
    run = moving(config=config)
    run.simulator.AdvanceTo(0.0405)
    wrench = reading(run, "measured_wrench_S")
    np.testing.assert_allclose(load_wrench(run), wrench, rtol=0, atol=1e-11)
    ideal = moving()
    ideal.simulator.AdvanceTo(0.0375)
    np.testing.assert_allclose(wrench, reading(ideal, "measured_wrench_S"), atol=1e-12)
    np.testing.assert_allclose(
        reading(run, "joint_position"), reading(ideal, "joint_position"), atol=1e-12
    )


def at_rest(config):
    """Return a running Diagram with a tool that hangs on a sensor below the ceiling."""
    builder = DiagramBuilder()
    plant = builder.AddSystem(MultibodyPlant(1e-3))
    tool = plant.AddRigidBody("tool", TOOL)
    weld = plant.AddJoint(
        WeldJoint("mount", plant.world_frame(), tool.body_frame(), RigidTransform())
    )
    plant.Finalize()
    sensor = AddWristSensor(builder, plant, weld, config)
    simulator = Simulator(builder.Build())
    return SimpleNamespace(sensor=sensor, simulator=simulator)


def test_two_sensors_in_one_diagram_read_their_own_weld():
    builder = DiagramBuilder()
    plant, weld = arm(builder, 1e-3)
    foot = plant.GetJointByName("world_welds_to_base")
    plant.Finalize()
    quiet = without_parts(WristSensorConfig(saturates=False), "low_pass")
    sensors = [
        AddWristSensor(builder, plant, weld, quiet),
        AddWristSensor(builder, plant, foot, quiet, name="foot_sensor"),
    ]
    diagram = builder.Build()
    simulator = Simulator(diagram)
    own = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    plant.get_actuation_input_port().FixValue(own, np.zeros(6))
    simulator.AdvanceTo(0.0015)
    weight = [
        np.linalg.norm(
            sensor.GetOutputPort("measured_wrench_S").Eval(
                sensor.GetMyContextFromRoot(simulator.get_context())
            )[:3]
            - quiet.offset[:3]
        )
        for sensor in sensors
    ]
    assert weight[0] < 20.0 < 60.0 < weight[1]
    assert diagram.HasSubsystemNamed("wrist_sensor_noise")
    assert diagram.HasSubsystemNamed("foot_sensor_noise")


def test_input_not_finite_gives_no_sample():
    run = moving()
    run.simulator.AdvanceTo(1.5e-3)
    before = reading(run, "measured_wrench_S").copy()
    run.plant.SetVelocities(run.context, np.full(6, 1e9))
    context = run.sensor.GetMyMutableContextFromRoot(run.simulator.get_mutable_context())
    values = run.sensor.AllocateDiscreteVariables()
    values.SetFrom(context.get_discrete_state())
    run.sensor._take_sample_if_due(context, values)
    context.SetDiscreteState(values)
    assert reading(run, "status")[0] > LOST_SAMPLE_FLAG_THRESHOLD
    np.testing.assert_array_equal(reading(run, "measured_wrench_S"), before)


def refused(change):
    """Return the message for a changed call."""
    builder = DiagramBuilder()
    plant, weld = arm(builder, 1e-3)
    case = SimpleNamespace(builder=builder, plant=plant, weld=weld, place=None, options={})
    change(case)
    if case.place is None:
        case.place = weld
    if not plant.is_finalized() and not case.options.pop("unfinished", False):
        plant.Finalize()
    with pytest.raises(DrakeTeleopError) as caught:
        AddWristSensor(case.builder, plant, case.place, **case.options)
    return str(caught.value)


def second_tool(case, mass=1.0):
    instance = case.plant.AddModelInstance("second")
    body = case.plant.AddRigidBody(
        "second_tool", instance, SpatialInertia(mass, [0.0] * 3, UnitInertia(0.0, 0.0, 0.0))
    )
    flange = case.plant.GetFrameByName("sensor")
    return case.plant.AddJoint(
        WeldJoint("second_weld", flange, body.body_frame(), RigidTransform())
    )


REFUSED = {
    "not finalized": (
        lambda c: c.options.update(unfinished=True),
        "plant 'plant' is not finalized; call plant.Finalize() first",
    ),
    "other builder": (lambda c: setattr(c, "builder", DiagramBuilder()), "not in this builder"),
    "a hinge": (
        lambda c: setattr(c, "place", c.plant.GetJointByName("elbow")),
        "joint 'elbow' is revolute, not a weld; weld the tool to the arm",
    ),
    "no weld": (
        lambda c: setattr(c, "place", c.plant.GetFrameByName("forearm")),
        "the body 'forearm' of frame 'forearm' has no weld beyond it",
    ),
    "frame of the tool": (
        lambda c: setattr(c, "place", c.plant.GetFrameByName("gripper_body")),
        "the body 'gripper_body' of frame 'gripper_body' has no weld beyond it",
    ),
    "two welds": (
        lambda c: setattr(c, "place", second_tool(c) and c.plant.GetFrameByName("sensor")),
        "several welds beyond it: 'wrist', 'second_weld'; pass the WeldJoint",
    ),
    "no mass": (
        lambda c: setattr(c, "place", second_tool(c, 0.0)),
        "the tool beyond joint 'second_weld' has no mass; give a body of the tool",
    ),
    "other plant": (
        lambda c: setattr(c, "place", moving().weld),
        "joint or frame 'wrist' belongs to another plant",
    ),
    "a name": (lambda c: setattr(c, "place", "wrist"), "expected Joint or Frame, found 'wrist'"),
    "name of a preset": (
        lambda c: c.options.update(config="jr3_85m35a3"),
        "AddWristSensor: config: expected WristSensorConfig, found 'jr3_85m35a3'; take one of",
    ),
    "no configuration": (
        lambda c: c.options.update(config={}),
        "AddWristSensor: config: expected WristSensorConfig, found {}",
    ),
    "half steps": (
        lambda c: c.options.update(period=1.5e-3),
        "period: sampling period 0.0015 s is no multiple of the plant's time step 0.001 s",
    ),
    "too fast": (lambda c: c.options.update(period=1e-4), "such as 0.001 s"),
    "no period": (
        lambda c: c.options.update(period=-1.0),
        "a sampling period of -1.0 s is not positive",
    ),
    "bandwidth": (
        lambda c: c.options.update(config=WristSensorConfig()),
        "AddWristSensor.bandwidth_hz: bandwidth 500 Hz is too near half the sensor's rate "
        "(1000 Hz)",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_error_states_the_reason_of_a_refused_call(name):
    change, expected = REFUSED[name]
    assert expected in refused(change)
