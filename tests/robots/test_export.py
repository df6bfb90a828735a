"""`export`: what independent parsers read out of each format is the load that went in."""

from __future__ import annotations

import dataclasses
import json
import re

import numpy as np
import pytest
import yaml
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from drake_teleop.cli import cli, main
from drake_teleop.errors import DrakeTeleopError
from drake_teleop.load.identification import Identification
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.robots.export import FORMATS, STANDARD_GRAVITY, export

MASS, COM = 1.7, np.array([0.012, -0.034, 0.091])
INERTIA = np.array([[4.1e-3, 3e-4, -2e-4], [3e-4, 5.2e-3, 1e-4], [-2e-4, 1e-4, 3.3e-3]])
OFFSETS = np.array([1.5, -2.5, 3.5, 0.1, -0.2, 0.3])
X_FS = RigidTransform(RollPitchYaw(np.radians([20.0, -35.0, 110.0])), [0.01, -0.02, 0.045])
POSE = ("0.01", "-0.02", "0.045", "20", "-35", "110")
TURNED = {"R_FS": X_FS.rotation().matrix(), "p_FoSo_F": X_FS.translation()}

FOUND = Identification(
    phi=phi_from_mass_com_inertia(MASS, COM, INERTIA),
    offsets=OFFSETS,
    covariance=1e-12 * np.eye(16),
    identifiable=np.ones(16, dtype=bool),
    condition_number=5.0,
    delay_s=0.0,
    residual_rms=np.ones(6),
    method="batch least squares",
    samples=100,
)


def in_flange() -> tuple[np.ndarray, np.ndarray]:
    """Centre of mass and inertia about it, in F."""
    R = X_FS.rotation().matrix()
    return X_FS @ COM, R @ INERTIA @ R.T


@pytest.mark.parametrize("name", ["urdf", "sdf", "mjcf"])
def test_drake_reads_the_models(name):
    text, warnings = export(FOUND, name, **TURNED)
    assert warnings == []
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString(text, {"mjcf": "xml"}.get(name, name))
    read = plant.GetBodyByName("load").default_spatial_inertia()
    com, inertia = in_flange()
    assert read.get_mass() == pytest.approx(MASS, rel=1e-12)
    np.testing.assert_allclose(read.get_com(), com, atol=1e-12)
    about_centre = read.Shift(read.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
    np.testing.assert_allclose(about_centre, inertia, atol=1e-11)


def test_a_ur_gets_its_six_in_its_order():
    text, _ = export(FOUND, "ur", **TURNED)
    mass, com, six = re.fullmatch(
        r"set_target_payload\((.*?), \[(.*?)\], \[(.*?)\]\)\n", text
    ).groups()
    com, six = (np.array(part.split(","), dtype=float) for part in (com, six))
    expected, i = in_flange()
    assert float(mass) == MASS
    np.testing.assert_allclose(com, expected, atol=1e-12)
    np.testing.assert_allclose(
        six, [i[0, 0], i[1, 1], i[2, 2], i[0, 1], i[0, 2], i[1, 2]], atol=1e-12
    )


def test_a_franka_gets_columns_and_the_centre():
    read = json.loads(export(FOUND, "franka", **TURNED)[0])
    com, inertia = in_flange()
    assert read["mass"] == MASS
    np.testing.assert_allclose(read["centerOfMass"], com, atol=1e-12)
    np.testing.assert_allclose(np.reshape(read["inertia"], (3, 3), "F"), inertia, atol=1e-12)
    np.testing.assert_array_equal(np.reshape(read["transformation"], (4, 4), "F"), np.eye(4))


def test_an_xarm_gets_millimetres_and_is_told_what_it_drops():
    text, warnings = export(FOUND, "xarm", **TURNED)
    com = re.search(r"\[(.*)\]\)", text)[1].split(",")
    np.testing.assert_allclose(np.array(com, dtype=float), 1e3 * in_flange()[0], atol=1e-9)
    assert "no place for the inertia" in warnings[0] and text.startswith(f"# {warnings[0]}\n")


@pytest.mark.parametrize("sign", [-1, 1])
def test_compensations_take_off_what_the_sensor_reads(sign):
    """Of any attitude: the reading is sign times what the sensor exerts on the load, Eq. (1)."""
    g = X_FS.rotation().matrix()[2] * -9.81
    held = np.concatenate([-MASS * g, np.cross(COM, -MASS * g)]) + OFFSETS
    reading = sign * held
    tools = yaml.safe_load(export(FOUND, "ft_tools", sign=sign)[0])
    offset = np.array([*tools["force_offset"], *tools["torque_offset"]])
    weight = tools["mass"] * g
    # As ft_tools has it: the load pulls at the sensor.
    left = (
        reading - offset - np.concatenate([weight, np.cross(tools["sensor_frame_to_com"], weight)])
    )
    if sign == -1:
        np.testing.assert_allclose(left, 0.0, atol=1e-12)
    kth = yaml.safe_load(export(FOUND, "kth", sign=sign)[0])
    np.testing.assert_allclose(kth["bias"], sign * OFFSETS, atol=1e-15)
    np.testing.assert_allclose(kth["gripper_com_pose"][:3], COM, atol=1e-12)
    assert kth["gripper_mass"] == MASS
    bota = json.loads(export(FOUND, "bota", sign=sign)[0])["payload_compensator_config"]
    assert list(bota["payload_properties"]["bias"].values()) == pytest.approx(sign * OFFSETS)
    assert bota["payload_properties"]["inertia"]["Ixz"] == pytest.approx(INERTIA[0, 2])
    ros = yaml.safe_load(export(FOUND, "ros2-admittance")[0])
    centre = ros["admittance_controller"]["ros__parameters"]["gravity_compensation"]["CoG"]
    assert centre["force"] == pytest.approx(MASS * STANDARD_GRAVITY)
    np.testing.assert_allclose(centre["pos"], COM, atol=1e-12)


def test_what_is_not_identified_is_not_to_be_entered():
    unsure = dataclasses.replace(FOUND, identifiable=np.arange(16) != 10, covariance=np.eye(16))
    for name, told in (("ur", True), ("xarm", False)):
        text, warnings = export(unsure, name)
        assert any(w.startswith("I_xx is not identified") for w in warnings) == told
        assert ("I_xx" in text) == told
    assert not any("f_ox" in text for text in export(unsure, "ur")[1])


def test_what_cannot_be_is_one_line():
    nobody = dataclasses.replace(FOUND, phi=FOUND.phi * [1, 1, 1, 1, -1, 1, 1, 1, 1, 1])
    with pytest.raises(DrakeTeleopError, match=r"no body has these values.*consistent"):
        export(nobody, "urdf")
    assert any("no body" in text for text in export(nobody, "ur")[1])
    with pytest.raises(DrakeTeleopError, match="the sign of the wrench is wrong"):
        export(dataclasses.replace(FOUND, phi=-FOUND.phi), "ur")
    with pytest.raises(DrakeTeleopError, match="kth takes its values in the sensor's frame"):
        export(FOUND, "kth", **TURNED)
    with pytest.raises(DrakeTeleopError, match=r"'kuka' is no target.*ur, franka"):
        export(FOUND, "kuka")


def test_the_command(tmp_path, capsys):
    FOUND.save(tmp_path / "load.json")
    for name in FORMATS:
        pose = () if FORMATS[name].of_sensor else ("--sensor-pose", *POSE)
        with pytest.raises(SystemExit) as exit:
            main(["export", str(tmp_path / "load.json"), "--to", name, *pose])
        assert exit.value.code == 0
        printed = capsys.readouterr()
        text, warnings = export(FOUND, name, **({} if FORMATS[name].of_sensor else TURNED))
        numbers = re.compile(r"-?\d+\.\d+(?:e-\d+)?")
        np.testing.assert_allclose(
            [float(n) for n in numbers.findall(printed.out)],
            [float(n) for n in numbers.findall(text)],
            atol=1e-12,
        )
        assert printed.err.splitlines() == [f"warning: {text}" for text in warnings]
    (choice,) = (p.type for p in cli.commands["export"].params if p.name == "to")
    assert tuple(choice.choices) == tuple(FORMATS)
