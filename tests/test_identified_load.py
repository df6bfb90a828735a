"""Cache of identified loads: same bits, never outdated, robust to damaged files."""

from __future__ import annotations

import dataclasses
import os
from types import SimpleNamespace

import numpy as np
import pytest

from drake_teleop.lab import identified_load as module
from drake_teleop.lab.identified_load import CACHE_ENV_NAME, identified_load
from drake_teleop.lab.run import run_command, run_scenario
from drake_teleop.load.contact.noise_floor import NoiseFloor
from drake_teleop.load.identification import Identification
from drake_teleop.station.estimation.contact_detection import ContactDetectionConfig
from drake_teleop.station.scenario import LoadScenario, Scenario, replace
from drake_teleop.station.slave.plant import NominalSlave
from drake_teleop.station.slave.slave_config import Tool

# Load close to the tool's, with numbers that have no short decimal form.
RNG = np.random.default_rng(1)
COVARIANCE = np.diag(RNG.uniform(1e-9, 1e-7, 16))
COVARIANCE[9, 9] = np.inf
FOUND = Identification(
    phi=np.array([3.13, 0.01, 0.02, 0.3, 0.05, 0.0, 0.0, 0.05, 0.0, 0.01])
    + RNG.normal(0, 1e-9, 10),
    offsets=RNG.normal(0, 0.1, 6),
    covariance=COVARIANCE,
    identifiable=np.arange(16) != 9,
    condition_number=float(RNG.uniform(3, 4)),
    delay_s=0.0,
    residual_rms=RNG.uniform(0.1, 0.2, 6),
    method="recursive total least squares",
    samples=6001,
    degrees_of_freedom=np.where(np.arange(16) < 3, np.inf, 77.3),
)
FLOOR = NoiseFloor(
    RNG.uniform(0.1, 0.2, 6), np.eye(16) / 3, RNG.uniform(0, 1, (6, 2)), np.eye(6), np.full(6, 0.1)
)
DETECTS = replace(Scenario(), contact_detection=ContactDetectionConfig())


@pytest.fixture
def identifications(monkeypatch, tmp_path):
    """Return the list of identified scenarios; no simulation runs."""
    asked = []

    def identify(scenario, stage):
        asked.append(scenario)
        return SimpleNamespace(identification=FOUND, noise_floor=lambda arm: FLOOR)

    monkeypatch.setattr(module, "identify_load", identify)
    monkeypatch.setenv(CACHE_ENV_NAME, str(tmp_path / "cache"))
    return asked


def same_bits(a, b) -> bool:
    """Return whether two dataclasses have equal types and bytes."""
    return type(a) is type(b) and all(
        type(x) is type(y) and np.asarray(x).dtype == np.asarray(y).dtype
        and np.asarray(x).tobytes() == np.asarray(y).tobytes()
        for x, y in (
            (getattr(a, field.name), getattr(b, field.name)) for field in dataclasses.fields(a)
        )
    )  # fmt: skip


def test_cached_load_is_bit_equal(identifications):
    first, again = identified_load(DETECTS), identified_load(DETECTS)
    assert (first.from_cache, again.from_cache, len(identifications)) == (False, True, 1)
    assert same_bits(again.identification, FOUND)
    assert same_bits(again.noise_floor, FLOOR)
    assert again.estimate.tobytes() == np.concatenate([FOUND.offsets, FOUND.phi]).tobytes()


def test_fresh_replaces_the_cached_load(identifications):
    for fresh in (False, True, False):
        identified_load(Scenario(), fresh=fresh)
    assert len(identifications) == 2


@pytest.mark.parametrize(
    "change",
    [
        {"slave__payload": dataclasses.replace(Scenario().slave.payload, mass=1e-13)},
        {"slave__position": [0.55, 0.0, np.nextafter(0.45, 1)]},
        {"slave__position": [0.55, 0.0, float(np.nextafter(0.45, 1))]},
        {"wrist_sensor__ideal": True},
        {"motion_estimation__source": "encoders"},
        {"joint_control__position_bandwidth_hz": 12.5},
        {"rates__estimator_hz": 500.0},
        {"simulation__seed": 1},
        {"contact_detection": ContactDetectionConfig()},
    ],
    ids=lambda change: next(iter(change)),
)  # fmt: skip
def test_each_relevant_input_changes_the_cache_key(identifications, change):
    identified_load(Scenario())
    identified_load(replace(Scenario(), **change))
    assert len(identifications) == 2


def test_irrelevant_inputs_do_not_change_the_cache_key(identifications):
    identified_load(Scenario())
    assert identified_load(
        replace(Scenario(), operator__grip="firm", force_scaling__sigma=0.5, description="x")
    ).from_cache


def test_edited_sources_or_models_change_the_cache_key(identifications, tmp_path, monkeypatch):
    package, models = tmp_path / "package", tmp_path / "models"
    for folder, name in ((package / "room", "a.py"), (models, "tool.sdf")):
        folder.mkdir(parents=True)
        (folder / name).write_text("x = 1")
    hashes = [module._hash_source_files(package, models)]
    for path in (package / "room/a.py", models / "tool.sdf"):
        path.write_text("x = 2")
        hashes.append(module._hash_source_files(package, models))
    (package / "room/a.py").rename(package / "room/b.py")
    hashes.append(module._hash_source_files(package, models))
    assert len(set(hashes)) == 4
    for each in hashes:
        monkeypatch.setattr(module, "_SOURCE_FILES_HASH", each)
        identified_load(Scenario())
    assert len(identifications) == 4


def test_edited_included_model_changes_the_cache_key(identifications, tmp_path):
    tool = tmp_path / "tool.sdf"
    tool.write_text(
        '<sdf version="1.9"><model name="a"><include><uri>gripper.sdf</uri></include></model></sdf>'
    )
    scenario = replace(Scenario(), slave__tool=Tool(model=str(tool)))
    for mass in (1.0, 2.0):
        (tmp_path / "gripper.sdf").write_text(
            '<sdf version="1.9"><model name="gripper"><link name="body">'
            f"<inertial><mass>{mass}</mass></inertial></link></model></sdf>"
        )
        assert not identified_load(scenario).from_cache
        assert identified_load(scenario).from_cache
        assert np.isclose(NominalSlave(scenario.slave).arm.phi_load[0], mass)


def test_edited_mesh_of_mjcf_tool_changes_the_cache_key(identifications, tmp_path):
    (tmp_path / "meshes").mkdir()
    tool = tmp_path / "tool.xml"
    tool.write_text(
        '<mujoco><compiler meshdir="meshes"/><asset><mesh name="a" file="a.obj"/></asset>'
        '<worldbody><body><geom type="mesh" mesh="a"/></body></worldbody></mujoco>'
    )
    scenario, masses = replace(Scenario(), slave__tool=Tool(model=str(tool))), []
    for z in (0.1, 0.2):
        corners = f"v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 {z}\n"
        (tmp_path / "meshes/a.obj").write_text(f"{corners}f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
        assert not identified_load(scenario).from_cache
        assert identified_load(scenario).from_cache
        masses.append(NominalSlave(scenario.slave).arm.phi_load[0])
    assert np.isclose(masses[1], 2 * masses[0])


def damaged(content: bytes) -> dict[str, bytes]:
    middle = content.index(b"load.phi") + 200
    flipped = bytearray(content)
    flipped[middle] ^= 1
    return {
        "empty": b"",
        "cut": content[: len(content) // 2],
        "text": b"not an archive",
        "flipped": bytes(flipped),
    }


@pytest.mark.parametrize("what", ["empty", "cut", "text", "flipped"])
def test_a_damaged_file_is_ignored_and_renewed(identifications, tmp_path, what):
    identified_load(Scenario())
    (path,) = (tmp_path / "cache").iterdir()
    path.write_bytes(damaged(path.read_bytes())[what])
    assert not identified_load(Scenario()).from_cache
    assert same_bits(identified_load(Scenario()).identification, FOUND)
    assert len(identifications) == 2


def test_a_pickled_object_is_not_read(identifications, tmp_path):
    identified_load(Scenario())
    (path,) = (tmp_path / "cache").iterdir()
    with np.load(path) as archive:
        columns = dict(archive)
    np.savez(path, **columns | {"load.phi": columns["load.phi"].astype(object)})
    assert not identified_load(Scenario()).from_cache


def test_failed_write_leaves_no_file_and_is_no_error(identifications, tmp_path, monkeypatch):
    identified_load(Scenario())
    (path,) = (tmp_path / "cache").iterdir()

    def full(file, **columns):
        file.write(b"half of it")
        raise OSError("no space left on device")

    monkeypatch.setattr(np, "savez", full)
    assert not identified_load(Scenario(), fresh=True).from_cache
    assert list((tmp_path / "cache").iterdir()) == [path]
    assert identified_load(Scenario()).from_cache  # concurrent readers get the complete old file
    monkeypatch.setenv(CACHE_ENV_NAME, str(path))  # a file instead of a folder
    assert not identified_load(Scenario()).from_cache


def test_oldest_files_are_removed(identifications, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "MAX_CACHED_FILES", 2)
    for seed in range(3):
        identified_load(replace(Scenario(), simulation__seed=seed))
        for path in (tmp_path / "cache").iterdir():
            os.utime(path, ns=(path.stat().st_mtime_ns - 10**9,) * 2)
    assert len(list((tmp_path / "cache").iterdir())) == 2
    assert identified_load(replace(Scenario(), simulation__seed=2)).from_cache
    assert not identified_load(replace(Scenario(), simulation__seed=0)).from_cache


def test_tests_do_not_use_the_users_cache():
    from platformdirs import user_cache_path

    assert module.cache_folder() != user_cache_path("drake_teleop", appauthor=False)


@pytest.mark.slow
def test_run_reports_its_load_source_and_does_not_depend_on_it(identifications, tmp_path, capsys):
    path = tmp_path / "short.yaml"
    path.write_text("simulation: {duration: 0.02, settle: 0.0}")
    first = run_scenario(LoadScenario(path))
    assert first.load_source == "identified before the run"
    summary = run_command(path, tmp_path / "out")
    assert summary["load_source"] == "cache"
    assert "load: cache; --fresh repeats the identification" in capsys.readouterr().out
    for name, write in (
        ("log.parquet/row_0000000000.parquet", first.result.write_parquet),
        ("identification.json", first.identification.save),
    ):
        write(tmp_path / "first")
        assert (tmp_path / "first").read_bytes() == (tmp_path / "out" / name).read_bytes()
    assert run_scenario(LoadScenario(path), fresh=True).load_source == first.load_source
    assert len(identifications) == 2
