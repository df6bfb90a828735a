"""`export`: independent parsers read the exported load back."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from drake_teleop.cli.main import cli, main
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.identification import Identification
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.logs.read.canonical import Log, write_log
from drake_teleop.robots.compensate import run_compensate_command
from drake_teleop.robots.controller.export import export_controller
from drake_teleop.robots.export import FORMATS, STANDARD_GRAVITY_M_S2, export_load

MASS, COM = 1.7, np.array([0.012, -0.034, 0.091])
INERTIA = np.array([[4.1e-3, 3e-4, -2e-4], [3e-4, 5.2e-3, 1e-4], [-2e-4, 1e-4, 3.3e-3]])
OFFSETS = np.array([1.5, -2.5, 3.5, 0.1, -0.2, 0.3])
X_FS = RigidTransform(RollPitchYaw(np.radians([20.0, -35.0, 110.0])), [0.01, -0.02, 0.045])
POSE = ("0.01", "-0.02", "0.045", "20", "-35", "110")
TURNED = {"sensor_pose": tuple(map(float, POSE))}

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
    """Return centre of mass and inertia about it, in F."""
    R = X_FS.rotation().matrix()
    return X_FS @ COM, R @ INERTIA @ R.T


Values = tuple[float, np.ndarray, np.ndarray | None]
"""Mass, centre of mass, and inertia about it, if the format contains one."""


def tensor(xx: float, yy: float, zz: float, xy: float, xz: float, yz: float) -> np.ndarray:
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def by_drake(text: str, kind: str) -> Values:
    plant = MultibodyPlant(0.0)
    Parser(plant).AddModelsFromString(text, kind)
    read = plant.GetBodyByName("load").default_spatial_inertia()
    about_centre = read.Shift(read.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
    return read.get_mass(), read.get_com(), about_centre


def by_mujoco(text: str) -> Values:
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_string(text)
    k = model.body("load").id
    R = np.empty(9)
    mujoco.mju_quat2Mat(R, model.body_iquat[k])
    R = R.reshape(3, 3)
    return model.body_mass[k], model.body_ipos[k], R @ np.diag(model.body_inertia[k]) @ R.T


def numbers(text: str) -> list[float]:
    return [float(x) for x in re.findall(r"-?\d+\.\d+(?:e-\d+)?", text)]


def by_ur(text: str) -> Values:
    mass, x, y, z, *six = numbers(text)
    return mass, np.array([x, y, z]), tensor(*six)


def by_franka(text: str) -> Values:
    read = json.loads(text)
    return read["mass"], read["centerOfMass"], np.reshape(read["inertia"], (3, 3), "F")


def by_xarm(text: str) -> Values:
    mass, *com = numbers(text.splitlines()[-1])
    return mass, 1e-3 * np.array(com), None


def by_kth(text: str) -> Values:
    read = yaml.safe_load(text)
    return read["gripper_mass"], read["gripper_com_pose"][:3], None


def by_ft_tools(text: str) -> Values:
    read = yaml.safe_load(text)
    return read["mass"], read["sensor_frame_to_com"], None


def by_admittance(text: str) -> Values:
    told = yaml.safe_load(text)["admittance_controller"]["ros__parameters"]
    centre = told["gravity_compensation"]["CoG"]
    return centre["force"] / STANDARD_GRAVITY_M_S2, centre["pos"], None


def by_bota(text: str) -> Values:
    read = json.loads(text)["payload_compensator_config"]["payload_properties"]
    six = (read["inertia"][f"I{axes}"] for axes in ("xx", "yy", "zz", "xy", "xz", "yz"))
    return read["mass"], [read["com"][axis] for axis in "xyz"], tensor(*six)


READERS = {
    "ur": by_ur,
    "franka": by_franka,
    "xarm": by_xarm,
    "kth": by_kth,
    "ft_tools": by_ft_tools,
    "ros2-admittance": by_admittance,
    "bota": by_bota,
    "urdf": lambda text: by_drake(text, "urdf"),
    "sdf": lambda text: by_drake(text, "sdf"),
    "mjcf": lambda text: by_drake(text, "xml"),
}


def test_every_target_has_a_reader():
    assert READERS.keys() == FORMATS.keys()


@pytest.mark.parametrize("name", [*READERS, "mjcf by MuJoCo"])
def test_exported_load_is_read_back(name):
    """Relative error 1e-9, with a rotated and shifted sensor where allowed."""
    target, _, other = name.partition(" ")
    of_sensor = FORMATS[target].of_sensor
    text, warnings = export_load(FOUND, target, **({} if of_sensor else TURNED))
    assert FORMATS[target].inertia == (not any("no field for" in text for text in warnings))
    mass, com, inertia = (by_mujoco if other else READERS[target])(text)
    com_0, inertia_0 = (COM, INERTIA) if of_sensor else in_flange()
    assert mass == pytest.approx(MASS, rel=1e-9)
    np.testing.assert_allclose(com, com_0, rtol=0.0, atol=1e-9 * 0.1)
    assert (inertia is not None) == FORMATS[target].inertia
    if inertia is not None:
        np.testing.assert_allclose(inertia, inertia_0, rtol=0.0, atol=1e-9 * 5e-3)


def test_ur_and_xarm_export_a_function_call():
    text, _ = export_load(FOUND, "ur", **TURNED)
    assert re.fullmatch(r"set_target_payload\([^,]+, \[([^,]+, ){2}[^,]+\], \[.*\]\)\n", text)
    text, warnings = export_load(FOUND, "xarm", **TURNED)
    assert "no field for the inertia" in warnings[0] and text.startswith(f"# {warnings[0]}\n")


def test_franka_exports_the_identity_transformation():
    read = json.loads(export_load(FOUND, "franka", **TURNED)[0])
    np.testing.assert_array_equal(np.reshape(read["transformation"], (4, 4), "F"), np.eye(4))


@pytest.mark.parametrize("sign", [-1, 1])
def test_exported_compensation_cancels_the_reading(sign):
    """The reading is sign times the wrench of sensor on load, Eq. (1)."""
    g = X_FS.rotation().matrix()[2] * -9.81
    held = np.concatenate([-MASS * g, np.cross(COM, -MASS * g)]) + OFFSETS
    reading = sign * held
    tools = yaml.safe_load(export_load(FOUND, "ft_tools", sign=sign)[0])
    offset = np.array([*tools["force_offset"], *tools["torque_offset"]])
    weight = tools["mass"] * g
    # ft_tools uses the wrench of the load on the sensor.
    left = (
        reading - offset - np.concatenate([weight, np.cross(tools["sensor_frame_to_com"], weight)])
    )
    if sign == -1:
        np.testing.assert_allclose(left, 0.0, atol=1e-12)
    kth = yaml.safe_load(export_load(FOUND, "kth", sign=sign)[0])
    np.testing.assert_allclose(kth["bias"], sign * OFFSETS, atol=1e-15)
    bota = json.loads(export_load(FOUND, "bota", sign=sign)[0])["payload_compensator_config"]
    assert list(bota["payload_properties"]["bias"].values()) == pytest.approx(sign * OFFSETS)


def test_unidentified_values_cause_warnings():
    unsure = dataclasses.replace(FOUND, identifiable=np.arange(16) != 10, covariance=np.eye(16))
    for name, told in (("ur", True), ("xarm", False)):
        text, warnings = export_load(unsure, name)
        assert any(w.startswith("I_xx is not identified") for w in warnings) == told
        assert ("I_xx" in text) == told
    assert not any("f_ox" in text for text in export_load(unsure, "ur")[1])


def test_inconsistent_load_and_wrong_target_raise_one_line():
    nobody = dataclasses.replace(FOUND, phi=FOUND.phi * [1, 1, 1, 1, -1, 1, 1, 1, 1, 1])
    with pytest.raises(DrakeTeleopError, match=r"not physically consistent.*consistent"):
        export_load(nobody, "urdf")
    assert any("not physically consistent" in text for text in export_load(nobody, "ur")[1])
    with pytest.raises(DrakeTeleopError, match="the sign of the wrench is wrong"):
        export_load(dataclasses.replace(FOUND, phi=-FOUND.phi), "ur")
    with pytest.raises(DrakeTeleopError, match="kth takes its values in the sensor's frame"):
        export_load(FOUND, "kth", **TURNED)
    with pytest.raises(DrakeTeleopError, match=r"there is no export format 'kuka'.*ur, franka"):
        export_load(FOUND, "kuka")


def test_command_prints_text_and_warnings(tmp_path, capsys):
    FOUND.save(tmp_path / "load.json")
    for name in FORMATS:
        pose = () if FORMATS[name].of_sensor else ("--sensor-pose", *POSE)
        with pytest.raises(SystemExit) as exit:
            main(["export", str(tmp_path / "load.json"), "--to", name, *pose])
        assert exit.value.code == 0
        printed = capsys.readouterr()
        text, warnings = export_load(FOUND, name, **({} if FORMATS[name].of_sensor else TURNED))
        numbers = re.compile(r"-?\d+\.\d+(?:e-\d+)?")
        np.testing.assert_allclose(
            [float(n) for n in numbers.findall(printed.out)],
            [float(n) for n in numbers.findall(text)],
            atol=1e-12,
        )
        assert printed.err.splitlines() == [f"warning: {text}" for text in warnings]
    (choice,) = (p.type for p in cli.commands["export"].params if p.name == "to")
    assert tuple(choice.choices) == (*FORMATS, "c99", "fmu", "ros2_filter")


@pytest.mark.parametrize("to", sorted(FORMATS))
def test_removed_weight_is_not_subtracted_again(to) -> None:
    weightless = dataclasses.replace(FOUND, weight_removed=True)
    if FORMATS[to].of_sensor:
        with pytest.raises(DrakeTeleopError, match=f"{to} would subtract it once more"):
            export_load(weightless, to)
    else:
        assert export_load(weightless, to) == export_load(FOUND, to)


def test_controller_code_and_compensate_warn_of_a_load_that_is_not_identified(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also of its mass."""
    identifiable = np.repeat([True, False], [6, 10])
    unsure = dataclasses.replace(FOUND, identifiable=identifiable, covariance=1e6 * np.eye(16))
    warnings = export_controller(unsure, "c99", tmp_path / "c", rate_hz=500.0)
    for start in ("m, m c_x, m c_y, m c_z of the load are not identified", "I_xx, I_xy"):
        assert any(text.startswith(start) for text in warnings)
    unsure.save(tmp_path / "load.json")
    log = Log(0.01 * np.arange(50.0), np.zeros((50, 6)), *np.ones((3, 50, 3)))
    write_log(log, tmp_path / "log.csv")
    out = str(tmp_path / "out.csv")
    run_compensate_command(f"replay:{tmp_path / 'log.csv'}", tmp_path / "load.json", out)
    assert "warning: m, m c_x, m c_y, m c_z of the load" in capsys.readouterr().err
