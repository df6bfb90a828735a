"""Excitations of the station's arm and of other arms: feasibility, check, identification."""

from __future__ import annotations

import dataclasses
import json
import re
import subprocess
import sys

import numpy as np
import polars as pl
import pytest
from arms import execute, write_sdf, write_urdf
from numba import njit
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia, UnitInertia
from shown import type_in

from drake_teleop.cli.excitation import _print_summary, draw_trajectory
from drake_teleop.cli.main import main
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import models_dir
from drake_teleop.lab.excitation import excite as excite_module
from drake_teleop.lab.excitation.check import check_motion, check_trajectory
from drake_teleop.lab.excitation.excite import excite, trajectory_sensor_motion
from drake_teleop.lab.excitation.limits import LIMIT_NAMES, link_motion_series, sensor_motion_series
from drake_teleop.lab.excitation.motion_replay import write_motion_replay
from drake_teleop.lab.excitation.optimizer import FeasibleIterate
from drake_teleop.lab.excitation.prediction import predicted_deviations, sensor_noise
from drake_teleop.lab.excitation.robot import Robot, RobotFromModel, RobotFromScenario
from drake_teleop.lab.excitation.shortest import design_shortest_motion
from drake_teleop.lab.identification import identify_load
from drake_teleop.load.identification import Identification
from drake_teleop.load.inertia import mass_com_inertia, phi_from_mass_com_inertia
from drake_teleop.load.normal_equations import identify
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.load.tolerance import parse_tolerance
from drake_teleop.load.trajectory import FourierTrajectory
from drake_teleop.station.replay_file import ReplayFile
from drake_teleop.station.scenario import LoadScenario, replace
from drake_teleop.station.sensor.motion_estimation import (
    MotionEstimationConfig,
    estimate_sample_into,
    fusion_gains,
    initialize_motion_estimator,
)
from drake_teleop.station.sensor.presets import PRESETS
from drake_teleop.station.sensor.sensor_chain import (
    NOISE_BLOCK_SIZE,
    SAMPLES_PER_NOISE_BLOCK,
    WristSensorConfig,
    initialize_sensor_chain,
    read_sensor_into,
    without_parts,
)
from drake_teleop.station.slave.arm import forward_kinematics
from drake_teleop.station.slave.models import ParseModel
from drake_teleop.station.slave.slave_config import Slave


@pytest.fixture(scope="module")
def slave() -> Robot:
    return RobotFromScenario(LoadScenario("identification"))


@pytest.fixture(scope="module")
def designed(slave):
    return excite(slave, starts=2)


@pytest.fixture(scope="module")
def short(slave):
    """Return a quick design, for tests that do not need its quality."""
    return excite(slave, starts=1, period=2.4, harmonics=2)


@pytest.fixture
def urdf(tmp_path):
    return write_urdf(tmp_path)


@pytest.mark.slow
def test_design_for_the_slave_has_a_good_criterion_within_all_limits(slave, designed):
    assert designed.values["kappa_w10"] < 4.3
    assert designed.criterion_history[-1, 1] == pytest.approx(
        designed.values["kappa_w10"], rel=0.01
    )
    _, qd, qdd = designed.trajectory.evaluate(np.array([0.0, 6.0]))
    np.testing.assert_allclose([qd, qdd], 0, atol=1e-12)
    names = {use.limit_name for use in designed.limit_uses}
    assert names == {
        "position", "velocity", "acceleration", "torque", "sensor", "workspace", "clearance"
    }  # fmt: skip
    assert all(0 < use.used_share <= 1 for use in designed.limit_uses)
    # A limit must be active, otherwise the optimum would be larger.
    assert designed.limit_uses[0].used_share > 0.97
    assert slave.limits.heaviest_phi[0] == pytest.approx(1.3 * 3.13)


@pytest.mark.slow
def test_trajectory_depends_on_the_seed_only(slave, short):
    again, other = (
        excite(slave, starts=1, period=2.4, harmonics=2, seed=seed).trajectory for seed in (0, 1)
    )
    np.testing.assert_array_equal(again.rho, short.trajectory.rho)
    assert not np.allclose(other.rho, again.rho, atol=1e-3)


@pytest.mark.slow
def test_executed_motion_respects_the_limits(slave):
    found = identify_load(LoadScenario("identification"))
    t, state = found.result.t, found.result["slave_state"]
    assert np.all(np.diff(t) < 1.001e-3)
    q, qd = state[:, :6], state[:, 6:]
    asked, _, _ = found.trajectory.evaluate(t)
    # The control follows the trajectory with a lag.
    assert 0.01 < np.abs(q - asked).max() < 0.2
    uses = check_motion(slave, t, q, qd, np.gradient(qd, t, axis=0))
    assert len(uses) == len(LIMIT_NAMES)
    assert all(use.used_share < 0.995 for use in uses)
    # Torque of the motors, and samples of the sensor.
    limits, wrench = slave.limits, found.result["measured_wrench_S"]
    assert np.all(np.abs(found.result["joint_torque"]) < limits.max_torques)
    norms = [np.linalg.norm(wrench[:, part], axis=1).max() for part in (slice(0, 3), slice(3, 6))]
    assert np.all(np.array(norms) < limits.max_sensor_norms[:2])
    assert not found.result["saturated"].any()


@pytest.mark.slow
def test_replay_shows_the_designed_motion(slave, short, tmp_path, monkeypatch):
    shown = {}

    class Canvas:
        def SetTransform(self, path, X, time=None):
            shown[path] = X

        def __getattr__(self, name):
            return lambda *arguments, **options: None

    frames = []

    def write(film, path, make_scene):
        show = make_scene(Canvas())
        for k in (0, 40):
            show(0.0, k)
            X_WB = shown[f"/arm/{int(slave.scene.sensor_frame.body().index())}"]
            frames.append(X_WB @ slave.scene.sensor_frame.GetFixedPoseInBodyFrame())
            q = short.trajectory.evaluate(film.times[k : k + 1])[0][0]
            R, p = np.empty((3, 3)), np.empty(3)
            forward_kinematics(slave.arm.table, q, R, p)
            np.testing.assert_allclose(frames[-1].translation(), p, atol=1e-9)
            np.testing.assert_allclose(frames[-1].rotation().matrix(), R, atol=1e-9)
        force, speed = film.displayed_numbers
        assert force.values.max() < slave.limits.max_sensor_norms[0]
        assert speed.values[0] < 0.05 < speed.values.max()
        assert film.slow_motion == 1.0

    monkeypatch.setattr(ReplayFile, "write", write)
    write_motion_replay(tmp_path / "film.html", short)
    assert np.linalg.norm(frames[1].translation() - frames[0].translation()) > 0.02


@njit
def record(constants, memory, estimator, remembered, table, truth, noise, samples):
    """Return a record through sensor chain and motion estimation."""
    reading = np.empty(truth.shape[1] - 2)
    for k in range(len(truth)):
        read_sensor_into(constants, memory, noise[k // SAMPLES_PER_NOISE_BLOCK], truth[k], reading)
        estimate_sample_into(estimator, remembered, table, reading, samples[k])


@pytest.mark.slow
@pytest.mark.parametrize("source", ["accelerometer", "fused", "encoders"])
def test_predicted_and_observed_scatter_agree(slave, short, source):
    """200 noisy records of one motion; the noise-free sensor input is calculated once."""
    sensor, motion, period = WristSensorConfig(), MotionEstimationConfig(source), 1 / 2000
    table, phi = slave.arm.table, slave.limits.heaviest_phi / 1.3
    t = np.arange(0.0, 2.4, period)
    joints = short.trajectory.evaluate(t)
    vectors = sensor_motion_series(link_motion_series(table, *joints))
    truth = np.hstack([non_contact_wrench(*vectors, phi), *vectors, joints[0]])
    constants, memory = initialize_sensor_chain(sensor, 6, period)
    estimator, remembered = initialize_motion_estimator(motion, sensor, 6, period)
    samples, found = np.empty((len(t), 22)), []
    rng = np.random.default_rng(0)
    for _ in range(200):
        noise = rng.standard_normal((len(t) // SAMPLES_PER_NOISE_BLOCK + 1, NOISE_BLOCK_SIZE))
        record(constants, memory.copy(), estimator, remembered.copy(), table, truth, noise, samples)
        wrench, s, omega, alpha = (samples[::2, part] for part in np.split(np.r_[:15], [6, 9, 12]))
        load = identify(wrench, s, omega, alpha, noise=sensor.wrench_std())
        found.append([*load.offsets, *load.phi])
    predicted = predicted_deviations(
        *vectors[:, ::2], 2 * period, sensor_noise(sensor, motion, 6, period), phi
    )
    np.testing.assert_allclose(np.std(found, axis=0, ddof=1), predicted, rtol=0.2)


@pytest.mark.slow
def test_prediction_uses_the_heaviest_load_and_the_sensor(slave, designed):
    motion = trajectory_sensor_motion(slave, designed.trajectory)
    predicted = predicted_deviations(*motion, 1e-3, slave.sensor_noise, slave.limits.heaviest_phi)
    np.testing.assert_allclose(designed.deviations, predicted, rtol=1e-12)
    # Deviations: encoders only < fused < accelerometer only.
    encoders, fused, accelerometer = (
        predicted_deviations(
            *motion,
            1e-3,
            sensor_noise(WristSensorConfig(), MotionEstimationConfig(source), 6, 1 / 8000),
            slave.limits.heaviest_phi,
        )
        for source in ("encoders", "fused", "accelerometer")
    )
    assert np.all(encoders < fused)
    assert np.all(fused < accelerometer)


@pytest.mark.slow
def test_check_finds_a_violation_of_each_limit(slave, short):
    """Each limit in turn is a little below its use by the same motion."""
    uses = {use.limit_name: use.used_share for use in short.limit_uses}
    limits = slave.limits
    # Without this clearance all pairs could be beyond the search distance.
    wide = dataclasses.replace(slave, limits=limits._replace(clearance=0.2))
    distance = (
        0.2
        / next(
            use for use in check_trajectory(wide, short.trajectory) if use.limit_name == "clearance"
        ).used_share
    )
    less = {
        "position": {"q_half": 0.99 * uses["position"] * limits.q_half},
        "velocity": {"velocity": 0.99 * uses["velocity"] * limits.velocity},
        "acceleration": {"acceleration": 0.99 * uses["acceleration"] * limits.acceleration},
        "torque": {"max_torques": 0.99 * uses["torque"] * limits.max_torques},
        "sensor": {"max_sensor_norms": 0.99 * uses["sensor"] * limits.max_sensor_norms},
        "workspace": {"box_half": 0.99 * uses["workspace"] * limits.box_half},
        "clearance": {"clearance": 1.01 * distance},
    }
    for name, changes in less.items():
        tight = dataclasses.replace(slave, limits=limits._replace(**changes))
        worst = check_trajectory(tight, short.trajectory)[0]
        assert (worst.limit_name, worst.used_share > 1, worst.used_share < 1.03) == (
            name,
            True,
            True,
        )


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("axis", range(3))
def test_check_finds_both_sides_of_the_box(slave, axis, side):
    limits, still = slave.limits, np.zeros((1, 6))
    aside = limits.box_middle + 5 * side * limits.box_half * np.eye(3)[axis]
    moved = dataclasses.replace(slave, limits=limits._replace(box_middle=aside))
    uses = check_motion(moved, np.zeros(1), still, still, still)
    use = next(use for use in uses if use.limit_name == "workspace")
    assert use.used_share > 2 and use.where == "xyz"[axis]


@pytest.mark.slow
def test_check_finds_self_collision_and_table_contact(slave):
    t = np.zeros((6, 2))
    for q, bodies in (
        ([0, -1.9, -2.4, 0, -1.5, 0], {"tool", "link_1", "base", "link_2", "link_6", "link_5"}),
        ([0, -2.2, 0.3, 0, 0, 0], {"world"}),
    ):
        worst = check_trajectory(slave, FourierTrajectory(np.array(q, float), t, t, 1.0))
        clearance = next(use for use in worst if use.limit_name == "clearance")
        assert clearance.used_share > 1
        assert bodies & set(clearance.where.split(" and "))


def test_shapes_that_touch_in_the_start_posture_are_excluded(urdf):
    """A shape larger than its link, such as the convex hull of a mesh."""
    text = urdf.read_text()
    assert text.count('size="0.2 0.2 0.1"') == 1
    slave = Slave(
        model=str(urdf),
        sensor_frame="l6",
        package_paths=[str(urdf.parent / "somewhere")],
        home=[0.0, 0.3, 1.4, 0.0, 1.4, 0.0],
    )
    free = RobotFromScenario(replace(LoadScenario("free_motion_force"), slave=slave))
    assert not any("no clearance required" in text for text in free.assumptions)
    urdf.write_text(text.replace('size="0.2 0.2 0.1"', 'size="0.6 0.6 1.6"'))
    found = RobotFromScenario(replace(LoadScenario("free_motion_force"), slave=slave))
    named = next(text for text in found.assumptions if "no clearance required" in text)
    assert "l0 and l3" in named and "l0 and l6" not in named
    assert "l0 and l2" not in named  # they touch in all postures
    still = FourierTrajectory(found.home_posture, np.zeros((1, 6)), np.zeros((1, 6)), 1.0)
    assert all(use.used_share < 1 for use in check_trajectory(found, still))
    assert len(found.limits.capsule_pairs) > 0  # other pairs


@pytest.mark.quick_cases(1)
@pytest.mark.slow
@pytest.mark.parametrize("name", ["contact_transition", "peg_in_slot"])
def test_environment_of_the_scenario_is_avoided(name):
    robot = RobotFromScenario(LoadScenario(name))
    found = excite(robot, starts=2, period=2.4, harmonics=2)
    assert all(use.used_share <= 1 for use in found.limit_uses)
    context = robot.scene.diagram.CreateDefaultContext()
    of_plant = robot.scene.plant.GetMyMutableContextFromRoot(context)
    of_scene = robot.scene.scene_graph.GetMyContextFromRoot(context)
    port = robot.scene.scene_graph.get_query_output_port()
    q = robot.scene.plant.GetPositions(of_plant)
    for t in np.linspace(0, 2.4, 100):
        q[robot.arm.position_index] = found.trajectory.evaluate(t)[0]
        robot.scene.plant.SetPositions(of_plant, q)
        assert not port.Eval(of_scene).HasCollisions()


@pytest.mark.slow
def test_readme_output(tmp_path, monkeypatch):
    (tmp_path / "models").symlink_to(models_dir())
    monkeypatch.chdir(tmp_path)
    type_in("README.md", ".venv/bin/drake-teleop excite")
    found = FourierTrajectory.load(tmp_path / "out" / "arm" / "excitation.yaml")
    assert found.period == 6.0 and (tmp_path / "out" / "arm" / "excitation.html").exists()


@pytest.mark.slow
def test_infeasible_design_writes_no_file(slave, tmp_path, capsys):
    box = slave.limits._replace(box_half=np.full(3, 0.01))
    with pytest.raises(DrakeTeleopError, match="no trajectory was found that respects all limits"):
        excite(dataclasses.replace(slave, limits=box), harmonics=2, starts=1)
    path = write_sdf(tmp_path)
    options = ["--sensor-frame", "wrist", "--payload", "60", "--harmonics", "2"]
    with pytest.raises(SystemExit) as stop:
        main(["excite", "--model", str(path), *options, "--quiet", "--out", str(tmp_path / "out")])
    assert stop.value.code == 2
    assert "respects all limits" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.quick_cases(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("limits", "said"),
    [
        ({"max_sensor_norms": np.ones(4)}, r"the best uses .* of the sensor limit \(.*--payload"),
        (
            {"acceleration": np.full(6, 1e-6)},
            "within all limits does not excite all parameters; limit use:",
        ),
    ],
)
def test_limits_without_a_useful_motion_are_an_error_with_the_limit(slave, limits, said):
    robot = dataclasses.replace(slave, limits=slave.limits._replace(**limits))
    with pytest.raises(DrakeTeleopError, match=said):
        excite(robot, harmonics=2, starts=1)


@pytest.mark.parametrize(
    "wrong", [{"harmonics": 1}, {"harmonics": 0}, {"period": 0.0}, {"period": -6.0}]
)
def test_series_without_motion_is_refused_before_the_search(slave, wrong):
    with pytest.raises(DrakeTeleopError, match=r"^excite: .* describe no motion; give 2 harm"):
        excite(slave, progress=False, **wrong)
    if "harmonics" in wrong:
        with pytest.raises(DrakeTeleopError, match=r"^excite: .* describe no motion; give 2 harm"):
            design_shortest_motion(slave, parse_tolerance("mass 1 %"), **wrong)


def test_arm_that_rotates_its_sensor_about_one_axis_is_an_error(tmp_path, capsys):
    limit = '<limit lower="-2" upper="2" effort="200" velocity="2"/></joint>'
    parts = ['<robot name="planar"><link name="l0"/>']
    for k in range(4):
        kind = "prismatic" if k == 2 else "revolute"
        parts.append(
            f'<link name="l{k + 1}"><inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01"'
            f' izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="j{k}"'
            f' type="{kind}"><parent link="l{k}"/><child link="l{k + 1}"/>'
            f'<origin xyz="0.2 0 0.05"/><axis xyz="0 0 1"/>{limit}'
        )
    path = tmp_path / "planar.urdf"
    path.write_text("".join([*parts, "</robot>"]))
    with pytest.raises(SystemExit) as stop:
        main(["excite", "--model", str(path), "--sensor-frame", "l4", "--out", str(tmp_path)])
    assert stop.value.code == 2
    message = " ".join(capsys.readouterr().err.split())
    assert "rotate the sensor about at most one axis" in message
    assert "load_estimate" in message and "--time" not in message


@pytest.mark.slow
def test_identification_refuses_an_unsuitable_trajectory(short):
    scenario = LoadScenario("identification")
    with pytest.raises(
        DrakeTeleopError, match=r"has a period of 2\.4 s, but the simulation lasts 6 s"
    ):
        identify_load(scenario, trajectory=short.trajectory)
    fitting = replace(scenario, simulation__duration=2.4)
    with pytest.raises(DrakeTeleopError, match=r"trajectory: uses 1\d\d\.\d% of the"):
        identify_load(fitting, trajectory=short.trajectory.with_scaled_amplitudes(1.1))
    with pytest.raises(DrakeTeleopError, match="has 5 joints, but the arm has 6"):
        less = {name: getattr(short.trajectory, name)[:5] for name in ("q0", "rho", "delta")}
        identify_load(fitting, trajectory=dataclasses.replace(short.trajectory, **less))


def test_missing_values_of_a_urdf_are_listed_as_assumptions(urdf):
    ranges = {"force_range": [300.0, 100.0, 200.0], "torque_range": [20.0, 30.0, 12.0]}
    sensor = WristSensorConfig(**ranges, acceleration_range=40.0, angular_acceleration_range=90.0)
    robot = RobotFromModel(urdf, "l6", sensor)
    np.testing.assert_allclose(robot.limits.max_sensor_norms, [90.0, 10.0, 40.0, 90.0])
    noise = robot.criterion_scales.wrench_noise
    assert noise == pytest.approx(sensor.wrench_std()[[0, 3]])
    assert robot.arm.joint_names == ("j1", "j2", "j3", "j4", "j5", "j6")
    words = "; ".join(robot.assumptions)
    assert "unlimited rotation for j4" in words
    assert "a speed limit of 3.142 rad/s for j5" in words
    assert "acceleration limits that reach full speed in 0.4 s (--acceleration) for all" in words
    assert "shapes are missing of l3, l4, l5: meshes were not found (--package-path" in words
    # 80 % of the model's limits; the load is gripper and finger plus 30 %.
    np.testing.assert_allclose(
        robot.limits.max_torques, 0.8 * np.array([200, 200, 150, 30, 30, 15])
    )
    np.testing.assert_allclose(robot.limits.acceleration[:2], [7.5, 6.25])
    assert robot.limits.heaviest_phi[0] == pytest.approx(1.3 * 0.9)
    found = RobotFromModel(
        urdf, "l6", WristSensorConfig(), package_paths=(urdf.parent / "somewhere",),
        acceleration=(5.0,), payload=3.0,
    )  # fmt: skip
    assert "shapes are missing of l4: meshes" in "; ".join(found.assumptions)
    np.testing.assert_array_equal(found.limits.acceleration, np.full(6, 5.0))
    # The rest of the payload is at 80 mm with a radius of gyration of 50 mm.
    rest = found.limits.heaviest_phi - robot.limits.heaviest_phi / 1.3
    inertia = 2.1 * 0.05**2 * 2 / 3 * np.eye(3)
    np.testing.assert_allclose(
        rest, phi_from_mass_com_inertia(2.1, [0.0, 0.0, 0.08], inertia), atol=1e-9
    )


def test_errors_of_fused_accelerations_pass_their_own_filters():
    sensor, fused, period = WristSensorConfig(), MotionEstimationConfig(source="fused"), 1e-3
    angular, linear = fusion_gains(fused, sensor, 6, period)
    noise = sensor_noise(sensor, fused, 6, period)
    of_s, of_alpha = (denominator for _, denominator in noise.motion_error_filters)
    np.testing.assert_allclose(of_s[1:] * period, linear)
    np.testing.assert_allclose(of_alpha[1:] * period, angular)
    assert np.abs(angular / linear - 1.0).max() > 0.1


def test_error_names_an_unreadable_mesh(urdf):
    parts = urdf.parent / "somewhere" / "parts"
    (parts / "forearm.obj").rename(parts / "forearm.dae")
    urdf.write_text(urdf.read_text().replace("forearm.obj", "forearm.dae"))
    robot = RobotFromModel(urdf, "l6", WristSensorConfig(), package_paths=(parts.parent,))
    words = "; ".join(robot.assumptions)
    assert "shapes are missing of l3: .dae meshes cannot be read (convert them to .obj" in words


def test_links_that_always_touch_are_excluded(urdf):
    """The two pairs are not adjacent, so Drake's own filter does not exclude them."""
    text = urdf.read_text()
    for shape in (
        '<mesh filename="package://absent/wrist.stl"/>',
        '<mesh filename="package://parts/wrist.stl"/>',
        '<cylinder radius="0.03" length="0.04"/>',
    ):
        text = text.replace(shape, '<sphere radius="0.15"/>')
    urdf.write_text(text)
    packages = (urdf.parent / "somewhere",)
    robot = RobotFromModel(urdf, "l6", WristSensorConfig(), package_paths=packages, payload=2.0)
    still = np.zeros((6, 2))
    uses = check_trajectory(robot, FourierTrajectory(robot.home_posture, still, still, 1.0))
    assert next(use for use in uses if use.limit_name == "clearance").used_share <= 1


@pytest.mark.parametrize(
    ("joint", "expected"),
    [
        ('"revolute"><mimic joint="j2"/>', "j3 moves with another joint"),
        ('"floating">', "j3 is a floating joint on l2"),
    ],
)
def test_chain_with_an_unsupported_joint_is_refused(urdf, joint, expected):
    text = urdf.read_text().replace('name="j3" type="revolute">', f'name="j3" type={joint}')
    urdf.write_text(text)
    with pytest.raises(DrakeTeleopError, match=expected):
        RobotFromModel(urdf, "l6", WristSensorConfig())


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('<parent link="l0"/>', '<parent link="l3"/>', "joints form a loop through l"),
        (
            '<child link="finger"/>',
            '<child link="l3"/>',
            "l3 is the child of two joints, j3 and slide",
        ),
        (
            'lower="0.1" upper="2.6"',
            'lower="2.6" upper="0.1"',
            "joint j3: lower limit 2.6 is above",
        ),
        (
            'lower="0.1" upper="2.6"',
            'lower="0.1" upper="x"',
            "joint j3: upper limit 'x' is not a number",
        ),
        (
            'lower="0.1" upper="2.6"',
            'lower="0.1" upper="0.1"',
            "j3 cannot move: both of its limits",
        ),
        ('velocity="2.5"', 'velocity="-2.5"', "joint j2: velocity limit -2.5 is negative"),
        ('<mass value="0.3"/>', '<mass value="-0.3"/>', "link l6: mass -0.3 kg is not between"),
    ],
)
def test_implausible_model_is_refused(urdf, old, new, expected):
    text = urdf.read_text()
    assert old in text
    urdf.write_text(text.replace(old, new, 1))
    with pytest.raises(DrakeTeleopError, match=expected):
        RobotFromModel(urdf, "l6", WristSensorConfig())


@pytest.mark.parametrize(("izz", "share"), [("15", "33.1"), ("-0.015", "25")])
def test_impossible_inertia_is_replaced_by_the_nearest(urdf, izz, share):
    urdf.write_text(urdf.read_text().replace('izz="0.015"', f'izz="{izz}"', 1))
    parsed = ParseModel(MultibodyPlant(0.0), urdf, "l6")
    (said,) = [text for text in parsed.assumptions if "inertia replaced" in text]
    assert said.startswith("warning: ") and said.endswith(f"of link l3 ({share} %)")


def test_impossible_inertia_of_sdf_base_is_left_out(tmp_path):
    path = write_sdf(tmp_path)
    path.write_text(path.read_text().replace("<izz>0.04</izz>", "<izz>4</izz>", 1))
    parsed = ParseModel(MultibodyPlant(0.0), path, "wrist")
    assert any(t.startswith("an impossible inertia") and "l0" in t for t in parsed.assumptions)


_LINKS = "".join(f"<link name='{name}'/>" for name in "abc")
_SDF = "<sdf version='1.7'><model name='m'>{}</model></sdf>"


def _joint(parent, child):
    ends = f"<parent>{parent}</parent><child>{child}</child>"
    return f"<joint name='{parent}{child[-1]}' type='fixed'>{ends}</joint>"


@pytest.mark.parametrize(
    ("ends", "expected"),
    [
        (("ab", "bc", "ca"), "a loop through b"),
        (("ab", "cb"), "b is the child of two joints, ab and cb"),
    ],
)
def test_included_models_are_checked(tmp_path, ends, expected):
    (tmp_path / "inside.sdf").write_text(_SDF.format(_LINKS + "".join(_joint(*e) for e in ends)))
    model = tmp_path / "model.sdf"
    model.write_text(_SDF.format(f"<include><uri>{tmp_path.as_uri()}/inside.sdf</uri></include>"))
    with pytest.raises(DrakeTeleopError, match=expected):
        ParseModel(MultibodyPlant(0.0), model, "c")


def test_nested_models_may_repeat_names(tmp_path):
    joints = _joint("a", "b") + _joint("b", "c")
    inside = [f"<model name='{name}'>{_LINKS}{joints}</model>" for name in ("n", "o")]
    inside += ["<link name='hand'/>", _joint("o::b", "hand"), _joint("n::c", "o::a")]
    model = tmp_path / "model.sdf"
    model.write_text(_SDF.format("".join(inside)))
    ParseModel(MultibodyPlant(0.0), model, "hand")


@pytest.mark.parametrize(
    "entity", ["<!DOCTYPE robot SYSTEM 'a.dtd'>", "<!DOCTYPE robot [<!ENTITY e SYSTEM 'a.txt'>]>"]
)
def test_undefined_xml_entity_is_refused(urdf, entity):
    urdf.write_text(entity + urdf.read_text().replace("</robot>", "&e;</robot>"))
    with pytest.raises(DrakeTeleopError, match=r"is not XML \(the entity e is not defined in"):
        ParseModel(MultibodyPlant(0.0), urdf, "l6")


def test_world_as_child_is_refused_only_in_the_chain(urdf):
    urdf.write_text(urdf.read_text().replace('"l6"', '"world"'))
    assumptions = ParseModel(MultibodyPlant(0.0), urdf, "l3").assumptions
    assert "left out, as it closes a loop or has no child: j6" in assumptions
    with pytest.raises(DrakeTeleopError, match="world is the child of j6"):
        ParseModel(MultibodyPlant(0.0), urdf, "world")


def test_late_error_of_drake_is_one_error(urdf, monkeypatch):
    def refused(_):
        raise RuntimeError("form one or more loops")

    monkeypatch.setattr("drake_teleop.station.slave.plant.finalize_without_limit_warnings", refused)
    with pytest.raises(DrakeTeleopError, match=r"arm\.urdf: cannot be read .*one or more loops"):
        RobotFromModel(urdf, "l6", WristSensorConfig())


def test_package_may_have_the_name_drake(tmp_path):
    (tmp_path / "drake").mkdir()
    (tmp_path / "drake" / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    shape = "<geometry><mesh><uri>package://drake/a.obj</uri></mesh></geometry>"
    model = tmp_path / "model.sdf"
    link = f"<link name='a'><collision name='c'>{shape}</collision></link>"
    model.write_text(_SDF.format(link))
    found = ParseModel(MultibodyPlant(0.0), model, "a")
    assert not any("shapes" in words for words in found.assumptions)


@pytest.mark.slow
def test_clearance_to_a_plane_is_checked(tmp_path):
    """A pendulum of 0.4 m above the floor."""
    model = tmp_path / "pendulum.xml"
    model.write_text("""<mujoco model="m"><worldbody><geom type="plane" size="0 0 1" pos="0 0 0.8"/>
    <body name="base" pos="0 0 1"><geom type="sphere" size="0.01" mass="1"/><body name="l1">
    <joint name="j1" axis="0 1 0" range="-180 180" limited="true"/>
    <geom type="capsule" size="0.02" fromto="0 0 0 0 0 0.4" mass="1"/></body></body>
    </worldbody></mujoco>""")
    robot = RobotFromModel(model, "l1", WristSensorConfig())
    for angle, is_free in ((0.0, True), (np.pi, False)):
        still = FourierTrajectory(np.array([angle]), np.zeros((1, 2)), np.zeros((1, 2)), 1.0)
        said = []
        uses = check_trajectory(robot, still, said.append)
        np.testing.assert_allclose(said, [0.0, 0.2, 0.4, 0.6, 0.8, 1.0, 1.0], rtol=1e-2)
        share = next(use for use in uses if use.limit_name == "clearance").used_share
        assert (share <= 1) == is_free


def test_drake_elements_are_read_with_any_namespace(tmp_path):
    path, plant = write_sdf(tmp_path), MultibodyPlant(0.0)
    path.write_text(path.read_text().replace('"drake.mit.edu"', f'"{tmp_path}"'))
    ParseModel(plant, path, "wrist")
    plant.Finalize()
    np.testing.assert_array_equal(plant.GetAccelerationUpperLimits(), 10.0 + 2.0 * np.arange(7))


def test_zero_range_and_zero_mass_are_replaced_by_assumptions(urdf):
    text = urdf.read_text().replace('lower="0.1" upper="2.6"', 'lower="0" upper="0"')
    nothing = re.sub(r'"0.3"/>(<inertia .*?/>)', '"0"/>', text, count=1)
    urdf.write_text(nothing)
    robot = RobotFromModel(urdf, "l6", WristSensorConfig())
    assert "no inertia of l6" in robot.assumptions
    assert any("unlimited rotation for j3" in words for words in robot.assumptions)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--sensor-frame", "nose"], "no frames are named 'nose'"),
        (
            ["--sensor-frame", "l6", "--acceleration", "1,2"],
            "has 2 numbers, but the arm",
        ),
        (["--sensor-frame", "l6", "--acceleration", "fast"], "--acceleration"),
        (["--sensor-frame", "l6", "--payload", "0.1"], "model contains 0.9 kg beyond the sensor"),
        (["--sensor-frame", "l6", "--payload", "1e-9"], "1e-09 kg is outside 0.001 to 10000 kg"),
        (["--sensor-frame", "l0"], "no joint moves l0"),
        ([], "--sensor-frame"),
    ],
)
def test_unusable_model_gives_one_error_line(urdf, tmp_path, capsys, options, expected):
    out = str(tmp_path / "out")
    with pytest.raises(SystemExit) as stop:
        main(["excite", "--model", str(urdf), *options, "--quiet", "--out", out])
    error = capsys.readouterr().err
    assert stop.value.code == 2
    assert error.startswith("error: ") and error.count("\n") == 1
    assert expected in error


@pytest.mark.parametrize("text", ["", "<robot", "<robot name='r'><link name='a'/>", "hello"])
@pytest.mark.parametrize("name", ["a.urdf", "a.sdf", "a.txt"])
def test_file_without_robot_gives_one_error_line(tmp_path, capsys, name, text):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(SystemExit) as stop:
        main(["excite", "--model", str(path), "--sensor-frame", "a", "--quiet"])
    assert stop.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1 and name in error


def test_summary_is_printed_without_markup(capsys, tmp_path):
    use = {"share": 0.5, "where": "joint_1", "t": 1.25}
    summary = {
        "meaning": {"E": "smallest eigenvalue"}, "criterion": "E", "E": 2.0,
        "limit_use": {"speed": use}, "predicted_std": {"f_x [N]": 0.01},
        "until": "mass 1 %", "period_s": 3.0, "reliable": 0.9, "assumed": ["[x] is at rest"],
    }  # fmt: skip
    _print_summary(summary, tmp_path)
    printed = capsys.readouterr().out
    assert "[bold]" not in printed and "\\" not in printed
    for words in ("t [s]", "f_x [N]", "50.0%", "mass 1 %", "assumed: [x] is at rest"):
        assert words in printed


def test_model_options_require_a_model(capsys, tmp_path):
    with pytest.raises(SystemExit) as stop:
        main(["excite", "--payload", "2", "--quiet", "--out", str(tmp_path)])
    assert (stop.value.code, capsys.readouterr().err) == (
        2,
        "error: --payload: requires --model; add --model or remove --payload\n",
    )


@pytest.fixture(
    scope="module",
    params=[
        pytest.param((write_urdf, "l6", 6), id="urdf"),
        pytest.param((write_sdf, "wrist", 7), id="sdf", marks=pytest.mark.slow),
    ],
)
def other_arm(request, tmp_path_factory):
    """Return an arm, its trajectory from the command line, and its execution with 1.2 kg."""
    write, frame, joints = request.param
    folder = tmp_path_factory.mktemp("arm")
    path, out = write(folder), folder / "excite"
    options = ["--sensor-frame", frame, "--payload", "2.5", "--period", "4", "--harmonics", "4"]
    with pytest.raises(SystemExit) as stop:
        main(["excite", "--model", str(path), *options, "--quiet", "--out", str(out)])
    assert stop.value.code == 0
    load = SpatialInertia(
        1.2, [0.02, -0.01, 0.09], UnitInertia(0.0135, 0.0125, 0.004, 2e-4, -1e-3, 5e-4)
    )
    return out, joints, execute(path, frame, pl.read_csv(out / "trajectory.csv"), load)


@pytest.mark.slow
def test_files_for_other_arms(other_arm):
    out, joints, recording = other_arm
    summary = json.loads((out / "summary.json").read_text())
    assert all(use["share"] <= 1 for use in summary["limit_use"].values())
    assert (out / "excitation.png").stat().st_size > 20_000
    assert 1e6 < (out / "excitation.html").stat().st_size < 4e6
    table = pl.read_csv(out / "trajectory.csv")
    assert table.shape == (4001, 1 + 3 * joints)
    q = table.select([f"q_j{k + 1}" for k in range(joints)]).to_numpy()
    trajectory = FourierTrajectory.load(out / "excitation.yaml")
    np.testing.assert_allclose(trajectory.evaluate(table["t"].to_numpy())[0], q, atol=1e-12)
    # Executed with tracking errors.
    executed = recording.q[200:-200]
    assert 1e-4 < np.abs(executed - q).max() < 0.01


def write_canonical(folder, t, readings, recording):
    """Write wrench and IMU with one clock."""
    rng = np.random.default_rng(1)
    omega = recording.truth[:, 9:12] + 2e-3 * rng.standard_normal((len(t), 3))
    parts = {
        "f": readings[:, :3], "tau": readings[:, 3:6],
        "s": readings[:, 6:9], "omega": omega, "alpha": readings[:, 9:12],
    }  # fmt: skip
    columns = {
        f"{name}_{axis}": values[:, k]
        for name, values in parts.items()
        for k, axis in enumerate("xyz")
    }
    pl.DataFrame({"t": t} | columns).write_csv(folder / "log.csv")
    return folder / "log.csv"


def write_described(folder, t, readings, recording):
    """Write the opposite wrench, and the controller's pose at 500 Hz."""
    names = ["fx", "fy", "fz", "tx", "ty", "tz"]
    pl.DataFrame({"t": t} | dict(zip(names, -readings[:, :6].T, strict=True))).write_csv(
        folder / "wrench.csv"
    )
    names = ["qw", "qx", "qy", "qz", "x", "y", "z"]
    pose = recording.pose[::2] + 2e-6 * np.random.default_rng(1).standard_normal((len(t[::2]), 7))
    pl.DataFrame({"t": t[::2]} | dict(zip(names, pose.T, strict=True))).write_csv(
        folder / "pose.csv"
    )
    (folder / "log.yaml").write_text(
        "gravity: 9.81\n"
        "wrench: {file: wrench.csv, time: {column: t}, force: {columns: [fx, fy, fz]},"
        " torque: {columns: [tx, ty, tz]}, sign: -1}\n"
        "pose: {file: pose.csv, time: {column: t}, position: {columns: [x, y, z]},"
        " orientation: {columns: [qw, qx, qy, qz], form: quaternion_wxyz}}\n"
    )
    return folder / "log.yaml"


@pytest.mark.quick_cases(1)
@pytest.mark.slow
@pytest.mark.parametrize("write_log", [write_canonical, write_described])
def test_identified_load_of_another_arm_is_true(other_arm, write_log, tmp_path):
    """Design, execution, noisy measurement, log file, identification."""
    _, joints, recording = other_arm
    sensor = dataclasses.replace(
        without_parts(PRESETS["ati_gamma_imu"], "place", "latency"), acceleration_offset=[0.0] * 6
    )
    constants, memory = initialize_sensor_chain(sensor, joints, 1e-3)
    rng = np.random.default_rng(0)
    readings = np.empty((len(recording.t), 13 + joints))
    for k, truth in enumerate(recording.truth):
        if k % SAMPLES_PER_NOISE_BLOCK == 0:
            noise = rng.standard_normal(NOISE_BLOCK_SIZE)
        read_sensor_into(constants, memory, noise, truth, readings[k])
    log = write_log(tmp_path, recording.t, readings, recording)
    with pytest.raises(SystemExit) as stop:
        main(["identify", str(log), "--out", str(tmp_path / "load"), "--quiet"])
    assert stop.value.code == 0
    found = Identification.load(tmp_path / "load" / "identification.json")
    assert found.identifiable.all()
    # Differentiated poses add errors of about the stated size.
    deviations = found.standard_deviations[6:] * (1.0 if write_log is write_canonical else 2.0)
    assert np.abs((found.phi - recording.phi) / deviations).max() < 3.9  # 99.9 % for all ten
    mass, com, inertia = mass_com_inertia(recording.phi)
    assert found.mass == pytest.approx(mass, rel=2e-3)
    np.testing.assert_allclose(found.com, com, atol=3e-4)
    np.testing.assert_allclose(found.inertia_com, inertia, atol=0.05 * np.trace(inertia) / 2)


@pytest.mark.slow
@pytest.mark.parametrize("found", ["none", "far from the start"])
def test_small_motions_about_the_start_replace_designs_that_fail(slave, short, monkeypatch, found):
    """No design at all, and one whose posture is beyond the joint limits."""
    high = slave.limits.q_middle + 1.5 * slave.limits.q_half
    bad = FeasibleIterate(1.0, 10, 0, 3.0, dataclasses.replace(short.trajectory, q0=high))
    designs = [] if found == "none" else [bad]
    monkeypatch.setattr(excite_module.optimizer, "minimise_criterion", lambda *_, **__: designs)
    small = excite(slave, period=2.4, harmonics=2, progress=False)
    np.testing.assert_array_equal(small.trajectory.q0, slave.home_posture)
    assert small.limit_uses[0].used_share <= 1.0 and small.criterion_history.shape == (
        len(designs),
        2,
    )
    assert np.isfinite(small.deviations[:10]).all()


def test_picture_of_a_shortest_motion_states_its_period(short):
    figure = draw_trajectory(dataclasses.replace(short, criterion="period"))
    assert figure.axes[3].get_title("left") == "Criterion period: least value 2.4"


@pytest.mark.slow
def test_coaxial_shapes_of_two_links_take_little_time(tmp_path):
    """Drake takes 0.1 s for one distance: 150 s of CPU for all postures, 3 s for the first."""
    model = tmp_path / "arm.xml"
    model.write_text("""<mujoco model="m"><worldbody><body name="base" pos="0 0 1">
    <geom type="sphere" size="0.01" mass="1"/><body name="l1">
    <joint name="j1" axis="0 0 1" range="-90 90" limited="true"/>
    <geom type="capsule" size="0.08" fromto="0 0 -0.06 0 0 0.06" mass="1"/><body name="l2">
    <joint name="j2" axis="0 0 1" range="-90 90" limited="true"/>
    <geom type="sphere" size="0.01" pos="0.3 0 0" mass="1"/><body name="l3">
    <joint name="j3" axis="0 0 1" range="-90 90" limited="true"/>
    <geom type="capsule" size="0.06" fromto="0 0 -0.005 0 0 0.005" mass="1"/>
    <geom type="capsule" size="0.03" fromto="0.2 0 -0.1 0.2 0 0.1" mass="1"/></body></body></body>
    </body></worldbody></mujoco>""")
    code = f"""
import resource
from pathlib import Path
from drake_teleop.lab.excitation.robot import RobotFromModel
from drake_teleop.station.sensor.sensor_chain import WristSensorConfig
resource.setrlimit(resource.RLIMIT_CPU, (60, 60))
limits = RobotFromModel(Path({str(model)!r}), "l3", WristSensorConfig()).limits
print(len(limits.capsule_radius), len(limits.capsule_pairs))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout.split()) == (0, ["6", "0"])
