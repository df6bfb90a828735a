"""Logs with an orientation only: the unknown acceleration of S is no error of the description."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from known_motion import GRAVITY_W
from planted import good, written
from scipy.spatial.transform import Rotation
from test_causes_remedies import COM, INERTIA, MASS, NOISE, OFFSETS, Record, turned

from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.logs.processing import IdentifiedLog, check_log, identify_log
from drake_teleop.logs.read.reading import read_log


def identify(folder: Path, record: Record) -> IdentifiedLog:
    """Identify the load from wrench and orientation."""
    record.imu_at = None
    path = record.write(folder)
    description = yaml.safe_load(path.read_text())
    del description["pose"]["position"]
    path.write_text(yaml.safe_dump(description))
    return identify_log(path)


def turning_about(place: np.ndarray, noise_factor: float = 1.0) -> Record:
    """Return a record in which a point of S at `place` [m] rests."""
    record = Record.simulate(seconds=16.0)
    w, alpha = record.motion.omega, record.motion.alpha

    def acceleration_of(r: np.ndarray) -> np.ndarray:
        return np.cross(alpha, r) + np.cross(w, np.cross(w, r))

    force = MASS * (acceleration_of(COM - place) - turned(record.motion, GRAVITY_W))
    spin = alpha @ INERTIA + np.cross(w, w @ INERTIA)
    noise = noise_factor * NOISE * np.random.default_rng(2).normal(size=(len(w), 6))
    record.wrench = np.hstack([force, np.cross(COM, force) + spin]) + OFFSETS + noise
    return record


def assert_nothing_is_certain_and_wrong(found: IdentifiedLog, torque_factor: float = 1.0) -> None:
    load, known = found.identification, found.identification.identifiable
    assert not {"torque factor", "pose frame"} & {x.name for x in (*found.causes, *found.findings)}
    scale = np.repeat([1.0, torque_factor, 1.0, torque_factor], [3, 3, 1, 9])
    phi = phi_from_mass_com_inertia(MASS, COM, INERTIA)
    error = np.abs(np.hstack([load.offsets, load.phi]) - scale * np.hstack([OFFSETS, phi]))
    assert (error < 4.0 * np.sqrt(np.diag(load.covariance)))[known].all()


@pytest.mark.slow
@pytest.mark.quick_cases(1)
@pytest.mark.parametrize("torque_factor", [1.0, 100.0, 0.01])
def test_unknown_translation_corrects_neither_torque_unit_nor_pose_frame(
    tmp_path: Path, torque_factor: float
) -> None:
    record = Record.simulate(seconds=16.0)
    record.wrench[:, 3:] *= torque_factor
    found = identify(tmp_path, record)
    assert_nothing_is_certain_and_wrong(found, torque_factor)
    assert found.delay_source == "undetermined"
    assert [x.name for x in check_log(tmp_path / "log.yaml").findings] == ["acceleration"]


@pytest.mark.parametrize("has_position", [True, False])
@pytest.mark.parametrize("has_accelerometer", [True, False])
def test_acceleration_is_unknown_without_position_and_accelerometer(
    tmp_path: Path, has_position: bool, has_accelerometer: bool
) -> None:
    path = written(tmp_path, good(), imu=has_accelerometer)
    description = yaml.safe_load(path.read_text())
    if not has_position:
        del description["pose"]["position"]
    path.write_text(yaml.safe_dump(description))
    assert read_log(path).is_acceleration_unknown == (not has_position and not has_accelerometer)


@pytest.mark.slow
@pytest.mark.quick_cases(2)
@pytest.mark.parametrize(
    ("place", "noise_factor"), [(COM, 0.1), ([0.0, 0.1, -0.3], 1.0), ([0.5, 0.0, 0.2], 1.0)]
)
def test_rotation_about_another_point_does_not_give_a_wrong_load(
    tmp_path: Path, place: np.ndarray, noise_factor: float
) -> None:
    found = identify(tmp_path, turning_about(np.array(place), noise_factor))
    assert_nothing_is_certain_and_wrong(found)


def test_load_is_identified_if_the_sensor_turns_about_its_origin(tmp_path: Path) -> None:
    found = identify(tmp_path, turning_about(np.zeros(3)))
    assert_nothing_is_certain_and_wrong(found)
    assert found.identification.identifiable.all() and found.findings == ()


@pytest.mark.slow
def test_stated_gain_errors_do_not_explain_an_unknown_translation(tmp_path: Path) -> None:
    record = Record.simulate(seconds=16.0)
    record.wrench_lines = {"gain_std": 0.01}
    assert_nothing_is_certain_and_wrong(identify(tmp_path, record))


@pytest.mark.slow
def test_oblique_rotation_of_the_sensor_is_not_named_as_a_permutation_of_axes(
    tmp_path: Path,
) -> None:
    record = Record.simulate(seconds=16.0)
    record.turn = Rotation.from_euler("z", -46.0, degrees=True).as_matrix()
    record.wrench *= -1.0
    found = identify(tmp_path, record)
    assert [x.message.partition(";")[0] for x in found.causes] == [
        "the wrench has the opposite sign"
    ]
