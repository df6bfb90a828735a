"""Named causes of a misfit, with values and times, on small logs with known truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from drake_teleop.load.identification import Identification, natural_scales
from drake_teleop.logs.processing import IdentifiedLog, eliminate_log, identify_log
from drake_teleop.robots.compensator import Compensator
from drake_teleop.robots.replay_log import ReplayLogSource

CASES = Path(__file__).parents[3] / "shared" / "cases" / "logs"
COM = np.array([0.012, -0.021, 0.064])
PHI = np.array([1.37, *(1.37 * COM), 10.32e-3, 0.645e-3, -1.252e-3, 9.41e-3, 2.241e-3, 2.89e-3])
OFFSETS = -np.array([3.2, -7.5, 12.1, 0.21, -0.33, 0.08])
TRUTH = np.concatenate([OFFSETS, PHI])
GRIPPER = 0.95

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not CASES.is_dir(), reason="recordings that the project does not ship"),
]


def described(
    folder: Path, name: str, scale: tuple[float, float] = (1.0, 1.0), sign: int = -1
) -> Path:
    file = str(CASES / f"{name}.csv")
    time = {"column": "time"}
    wrench = {
        "force": {"columns": ["Fx", "Fy", "Fz"], "scale": scale[0]},
        "torque": {"columns": ["Tx", "Ty", "Tz"], "scale": scale[1]},
        "sign": sign,
    }
    pose = {
        "orientation": {"columns": ["qw", "qx", "qy", "qz"], "form": "quaternion_wxyz"},
        "position": {"columns": ["x", "y", "z"]},
    }
    streams: dict[str, Any] = {"wrench": wrench, "pose": pose}
    for stream in streams.values():
        stream |= {"file": file, "time": time}
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump({"gravity": 9.81, **streams}))
    return path


def cause_names(found: IdentifiedLog) -> list[str]:
    return [cause.name for cause in found.causes]


def is_consistent_with_truth(found: IdentifiedLog) -> bool:
    """Return whether the mass is identified and no identified parameter is significantly wrong."""
    load = found.identification
    error = np.abs(np.concatenate([load.offsets, load.phi]) - TRUTH)
    wrong = (error > 4.0 * load.standard_deviations) & (error > 0.02 * natural_scales(PHI))
    return bool(load.identifiable[6] and not (wrong & load.identifiable).any())


@pytest.mark.slow
def test_factor_of_ten_in_the_torque_is_named(tmp_path: Path) -> None:
    found = identify_log(described(tmp_path, "02_onrobot_counts"))
    assert cause_names(found) == ["torque factor"]
    assert found.causes[0].values["factor"] == 10.0
    assert found.identification.phi[:4] == pytest.approx(1e4 * PHI[:4], rel=3e-3)
    counts = identify_log(described(tmp_path, "02_onrobot_counts", (1e-4, 1e-5)))
    assert cause_names(counts) == [] and is_consistent_with_truth(counts)


@pytest.mark.slow
def test_tilted_base_is_named(tmp_path: Path) -> None:
    found = identify_log(described(tmp_path, "03_base_tilt3"))
    assert cause_names(found) == ["gravity direction"] and is_consistent_with_truth(found)
    assert found.causes[0].values["gravity"] == pytest.approx([0.513, 0.0, -9.797], abs=0.02)


@pytest.mark.slow
def test_load_grasped_in_the_middle_is_named(tmp_path: Path) -> None:
    found = identify_log(described(tmp_path, "04_grasp_midway"))
    assert cause_names(found) == ["load change"] and is_consistent_with_truth(found)
    assert found.causes[0].start_s == pytest.approx(8.0, abs=0.05)
    before, after = found.loads
    assert before.phi[0] == pytest.approx(1.37, abs=0.003)
    assert after.phi[0] == pytest.approx(1.97, abs=0.003)
    com = after.phi[1:4] / after.phi[0]
    assert com == pytest.approx([0.010, -0.015, 0.095], abs=3e-4)


@pytest.mark.slow
def test_bare_flange_has_only_offsets(tmp_path: Path) -> None:
    found = identify_log(described(tmp_path, "05_nothing_attached"))
    assert cause_names(found) == ["no load"]
    assert found.identification.identifiable.tolist() == [True] * 6 + [False] * 10
    error = found.identification.offsets - OFFSETS
    assert (np.abs(error) < 4.0 * found.identification.standard_deviations[:6]).all()


@pytest.mark.slow
def test_drift_of_a_warming_sensor_is_named(tmp_path: Path) -> None:
    found = identify_log(described(tmp_path, "09_warmup_drift"))
    assert cause_names(found) == ["drift"]
    assert found.identification.mass == pytest.approx(1.37, abs=0.003)


@pytest.mark.slow
def test_contact_in_most_of_the_record_is_named(tmp_path: Path) -> None:
    found = identify_log(described(tmp_path, "11_wiping"))
    assert cause_names(found) == ["contact"] and is_consistent_with_truth(found)
    assert found.causes[0].start_s == pytest.approx(2.5, abs=0.1)
    assert found.causes[0].stop_s == pytest.approx(37.5, abs=0.1)


@pytest.mark.slow
def test_contact_and_the_opposite_sign_are_named(tmp_path: Path) -> None:
    found = identify_log(described(tmp_path, "11_wiping", sign=1))
    assert cause_names(found) == ["axes", "contact"]
    assert found.causes[0].fields == {"wrench.sign": -1}
    assert found.identification.phi[:4] == pytest.approx(PHI[:4], rel=0.02)


@pytest.mark.slow
def test_weight_removed_by_the_robot_is_named() -> None:
    found = identify_log(CASES / "14_weight_removed_30hz.csv")
    assert cause_names(found) == ["weight removed"]
    deviation = found.identification.standard_deviations[6]
    assert abs(found.identification.mass - GRIPPER) < 3.0 * deviation < 0.1


@pytest.mark.parametrize(("name", "said"), [("15_free_30hz", []), ("16_touched_30hz", ["contact"])])
def test_load_of_a_gripper_is_identified_at_30_hz(name: str, said: list[str]) -> None:
    found = identify_log(CASES / f"{name}.csv")
    assert sorted({*cause_names(found)}) == said
    assert found.identification.mass == pytest.approx(GRIPPER, abs=0.005)


@pytest.mark.slow
def test_eliminate_subtracts_inertia_alone_where_the_weight_is_removed(tmp_path: Path) -> None:
    log = CASES / "14_weight_removed_30hz.csv"
    load = identify_log(log).identification
    load.save(tmp_path / "load.json")
    read = Identification.load(tmp_path / "load.json")
    assert read.weight_removed
    left = eliminate_log(log, read)
    both = eliminate_log(log, replace(read, weight_removed=False))
    rms = [np.sqrt((x.contact[~x.edge, :3] ** 2).sum(axis=1).mean()) for x in (left, both)]
    assert rms[0] < 0.25 and rms[1] > 5.0 * rms[0]
    source = ReplayLogSource(log, read)
    compensator, rms = Compensator(read, source.dt), []
    while (readings := source.read(0.0)) is not None:
        rms += [compensator.step(x, x.t).contact[:3] for x in readings]
    assert np.sqrt((np.array(rms)[10:-10] ** 2).sum(axis=1).mean()) < 0.7
