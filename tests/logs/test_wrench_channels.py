"""One channel with the opposite sign, mixed axes, and motion that contradicts the wrench."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from planted import Columns, written
from scipy.spatial.transform import Rotation
from test_sensor_filter import record

from drake_teleop.logs.check.wrench_channels import wrench_channel_finding
from drake_teleop.logs.processing import identify_log
from drake_teleop.logs.read.reading import read_log

CHANNELS = ("f_x", "f_y", "f_z", "tau_x", "tau_y", "tau_z")


def negate(columns: Columns, channel: int) -> Columns:
    columns[("force", "torque")[channel // 3]][:, channel % 3] *= -1.0
    return columns


def turn_into_base_axes(columns: Columns, part: str) -> Columns:
    columns[part] = np.einsum("nij,nj->ni", columns["R"], columns[part])
    return columns


@pytest.mark.parametrize("imu", [True, False])
@pytest.mark.parametrize("channel", range(6))
def test_channel_with_opposite_sign_is_named(tmp_path: Path, channel: int, imu: bool) -> None:
    path = written(tmp_path, negate(record(None), channel), imu=imu, pose=not imu)
    finding = wrench_channel_finding(read_log(path, bandwidth_hz=15.0), None, 0.0)
    assert finding is not None and finding.name == "channel sign"
    assert finding.values["part"] == CHANNELS[channel]


@pytest.mark.parametrize("channel", [1, 5])
def test_correction_that_implies_a_negative_mass_is_not_named(tmp_path: Path, channel: int) -> None:
    columns = negate(record(None), channel)
    columns |= {name: -columns[name] for name in ("force", "torque")}
    path = written(tmp_path, columns, imu=False)
    assert wrench_channel_finding(read_log(path, bandwidth_hz=15.0), None, 0.0) is None


@pytest.mark.parametrize("part", ["force", "torque"])
def test_part_in_base_axes_is_named(tmp_path: Path, part: str) -> None:
    path = written(tmp_path, turn_into_base_axes(record(None), part), imu=False)
    finding = wrench_channel_finding(read_log(path, bandwidth_hz=15.0), None, 0.0)
    assert finding is not None and finding.name == "mixed axes"
    assert finding.values["part"] == part


@pytest.mark.parametrize("drift_N", [0.0, 3.0])
def test_correct_wrench_has_no_channel_finding(tmp_path: Path, drift_N: float) -> None:
    path = written(tmp_path, record(None, drift_N), imu=False)
    assert wrench_channel_finding(read_log(path, bandwidth_hz=15.0), None, 0.0) is None


@pytest.mark.quick_cases(1)
@pytest.mark.slow
@pytest.mark.parametrize(("channel", "imu"), [(3, True), (1, False)])
def test_nothing_is_identified_with_a_channel_of_opposite_sign(
    tmp_path: Path, channel: int, imu: bool
) -> None:
    columns = negate(record(None), channel)
    identified = identify_log(written(tmp_path, columns, imu=imu, pose=not imu))
    assert [finding.name for finding in identified.findings] == ["channel sign"]
    assert not identified.identification.identifiable.any()


@pytest.mark.quick_cases(1)
@pytest.mark.slow
@pytest.mark.parametrize("part", ["force", "torque"])
def test_nothing_is_identified_with_a_part_in_base_axes(tmp_path: Path, part: str) -> None:
    columns = turn_into_base_axes(record(None), part)
    identified = identify_log(written(tmp_path, columns, imu=False))
    assert [finding.name for finding in identified.findings] == ["mixed axes"]
    assert not identified.identification.identifiable.any()


@pytest.mark.quick_cases(1)
@pytest.mark.slow
@pytest.mark.parametrize("stride", [5, 9])
def test_nothing_is_identified_from_euler_angles_averaged_across_180_deg(
    tmp_path: Path, stride: int
) -> None:
    columns = record(None)
    half_turn = Rotation.from_euler("z", 180, degrees=True)
    angles = (half_turn * Rotation.from_matrix(columns["R"])).as_euler("xyz")
    t = columns["t"]
    averaged = [np.interp(t, t[::stride], x[::stride]) for x in angles.T]
    columns["R"] = Rotation.from_euler("xyz", np.stack(averaged, axis=1)).as_matrix()
    columns["p"] = columns["p"] @ half_turn.as_matrix().T
    identified = identify_log(written(tmp_path, columns, imu=False))
    assert identified.findings
    assert not identified.identification.identifiable[6:].any()


@pytest.mark.quick_cases(1)
@pytest.mark.slow
@pytest.mark.parametrize("limit", [0.5, 0.4])
def test_nothing_is_identified_with_a_saturated_gyroscope_beside_poses(
    tmp_path: Path, limit: float
) -> None:
    columns = record(None)
    largest = limit * np.abs(columns["omega"]).max()
    columns["omega"] = np.clip(columns["omega"], -largest, largest)
    identified = identify_log(written(tmp_path, columns))
    assert identified.findings
    assert not identified.identification.identifiable[6:].any()


@pytest.mark.slow
@pytest.mark.parametrize(("unit", "rotated"), [("deg/s", False), ("rad/s", True)])
def test_nothing_is_identified_with_a_wrong_gyroscope_beside_poses(
    tmp_path: Path, unit: str, rotated: bool
) -> None:
    columns = record(None)
    if rotated:
        columns = turn_into_base_axes(columns, "omega")
    path = written(tmp_path, columns)
    document = yaml.safe_load(path.read_text())
    document["imu"]["angular_velocity"]["unit"] = unit
    path.write_text(yaml.safe_dump(document))
    identified = identify_log(path)
    assert identified.findings
    found = ["imu.angular_velocity.unit: rad/s" in x.message for x in identified.findings]
    assert any(found) != rotated
    assert not identified.identification.identifiable.any()
