from __future__ import annotations

import json
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import yaml
from known_motion import motion_at, quaternions
from planted import good, written
from scipy.spatial.transform import Rotation
from scipy.special import stdtrit

from drake_teleop.cli.logs import eliminate_command, identify_command
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.identification import Identification
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.logs.contact import robust_offsets
from drake_teleop.logs.processing import eliminate_log, identify_log
from drake_teleop.logs.read.canonical import WRENCH_COLUMNS, Log, write_log
from drake_teleop.logs.read.description import STANDARD_GRAVITY
from drake_teleop.logs.read.reading import read_log

PHI = phi_from_mass_com_inertia(3.13, [0.01, -0.02, 0.12], np.diag([0.02, 0.018, 0.006]))
OFFSETS = np.array([3.0, -2.0, 7.0, 0.1, 0.2, -0.3])
NAMES_OF_INERTIA = ["I_xx", "I_xy", "I_xz", "I_yy", "I_yz", "I_zz"]


def simulated(
    path: Path,
    *,
    contact: np.ndarray | None = None,
    noise: float = 0.0,
    delay_s: float = 0.0,
    sign: float = 1.0,
) -> Path:
    """Write a canonical log, 4 s at 1 kHz, of a load PHI on a sensor with OFFSETS."""
    t = np.arange(0, 4, 1e-3)
    now, then = motion_at(t), motion_at(t - delay_s)
    wrench = non_contact_wrench(now.specific_force, now.omega, now.alpha, PHI) + OFFSETS
    wrench += noise * np.random.default_rng(7).normal(size=wrench.shape) * [1, 1, 1, 0.1, 0.1, 0.1]
    if contact is not None:
        wrench += contact
    write_log(Log(t, sign * wrench, then.specific_force, then.omega, then.alpha), path)
    return path


def push(t: np.ndarray) -> np.ndarray:
    """Return (N, 6): a contact in the last 1.2 s of 4."""
    force = np.where(t > 2.8, 12 * np.sin(np.pi * (t - 2.8) / 1.2) ** 2, 0.0)
    return np.outer(force, [0.3, 0, -1, 0, 0.05, 0])


@pytest.fixture(scope="module")
def load(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("load")
    identify_command(simulated(folder / "log.parquet", noise=0.1), folder, quiet=True)
    return folder / "identification.json"


def test_identify_recovers_a_noise_free_load(tmp_path: Path) -> None:
    found = identify_log(simulated(tmp_path / "log.parquet"), cutoff_hz=None, delay=0.0)
    np.testing.assert_allclose(found.identification.phi, PHI, atol=1e-8)
    np.testing.assert_allclose(found.identification.offsets, OFFSETS, atol=1e-8)
    assert found.delay_source == "given"


@pytest.mark.slow
def test_identify_finds_delay_and_load_in_a_noisy_log(tmp_path: Path) -> None:
    log = simulated(tmp_path / "log.parquet", noise=0.3, delay_s=0.0062)
    summary = identify_command(log, tmp_path / "out", quiet=True)
    assert summary["delay_s"] == pytest.approx(0.0062, abs=3e-4)
    assert summary["delay_source"] == "estimated"
    assert summary["mass"] == pytest.approx(3.13, rel=2e-3)
    np.testing.assert_allclose(summary["com"], [0.01, -0.02, 0.12], atol=5e-4)
    np.testing.assert_allclose(summary["offsets"][:3], OFFSETS[:3], atol=0.05)
    assert summary["not_identifiable"] == []


@pytest.mark.slow
@pytest.mark.pictures
def test_identify_writes_its_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = simulated(tmp_path / "log.csv", noise=0.1)
    summary = identify_command(log, tmp_path / "a" / "b")
    out = tmp_path / "a" / "b"
    assert json.loads((out / "summary.json").read_text()) == summary
    assert (out / "fit.png").stat().st_size > 10_000
    loaded = Identification.load(out / "identification.json")
    assert loaded.phi.tolist() == summary["phi"]
    printed = capsys.readouterr().out
    assert "mass" in printed and "3.13" in printed
    identify_command(log, out, quiet=True)
    assert capsys.readouterr().out == ""


@pytest.mark.slow
def test_stated_gain_errors_increase_the_deviations_with_an_imu(tmp_path: Path) -> None:
    path = written(tmp_path, good(), pose=False)
    exact = identify_log(path).identification
    described = yaml.safe_load(path.read_text())
    described["wrench"]["gain_std"] = 0.01
    path.write_text(yaml.safe_dump(described))
    stated = identify_log(path).identification
    np.testing.assert_array_equal(stated.phi, exact.phi)
    assert exact.standard_deviations[6] < 1e-3 * exact.mass
    assert 5e-3 * exact.mass < stated.standard_deviations[6] < 3e-2 * exact.mass


@pytest.mark.slow
def test_inverted_sign_is_named_and_the_load_is_right(tmp_path: Path) -> None:
    found = identify_log(simulated(tmp_path / "log.parquet", sign=-1.0))
    (cause,) = found.causes
    assert cause.name == "axes" and "wrench.sign: -1" in cause.message
    assert found.identification.mass == pytest.approx(3.13, rel=0.01)


@pytest.mark.slow
def test_rotation_about_one_axis_does_not_determine_the_inertias(tmp_path: Path) -> None:
    t = np.arange(0, 6, 2e-3)
    angle = 0.5 * np.pi * (1 - np.cos(np.pi * t / 6))
    rate, acceleration = np.gradient(angle, t), np.gradient(np.gradient(angle, t), t)
    s = 9.81 * np.stack([np.sin(angle), 0 * t, np.cos(angle)], axis=1)
    omega, alpha = (np.outer(x, [0.0, 1, 0]) for x in (rate, acceleration))
    wrench = non_contact_wrench(s, omega, alpha, PHI)
    wrench += np.random.default_rng(3).normal(size=wrench.shape) * [0.1, 0.1, 0.1, 0.05, 0.05, 0.05]
    write_log(Log(t, wrench, s, omega, alpha), tmp_path / "log.parquet")
    found = identify_command(tmp_path / "log.parquet", tmp_path, delay=0.0, quiet=True)
    # omega and alpha are along y: only the middle column of the inertia has an effect.
    assert {"I_xx", "I_xz", "I_zz"} <= set(found["not_identifiable"])
    assert {"m", "m c_x", "m c_z"} <= set(found["identifiable"])
    assert found["phi_std"][4] is None


@pytest.mark.slow
def test_eliminate_returns_the_contact(tmp_path: Path, load: Path) -> None:
    t = np.arange(0, 4, 1e-3)
    log = simulated(tmp_path / "log.parquet", contact=push(t), noise=0.1)
    summary = eliminate_command(log, load, tmp_path, quiet=True)
    table = pl.read_parquet(tmp_path / "contact_wrench.parquet")
    contact = table.select([f"contact_{c}" for c in WRENCH_COLUMNS]).to_numpy()
    error = contact - push(table["t"].to_numpy())
    assert np.abs(error[:, :3]).max() < 0.3
    assert np.abs(error[:, 3:]).max() < 0.03
    assert summary["raw_rms"] > 20 > 13 > summary["residual_peak"] > 12
    assert 0.6 < summary["tare_fraction"] < 0.75
    assert not any("has the same sensor offsets" in note for note in summary["notes"])
    assert summary["gravity_only_rms"] is None
    free = table["t"].to_numpy() < 2.7
    assert np.sqrt(np.mean(np.sum(contact[free, :3] ** 2, axis=1))) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("tare", [None, 0.5])
def test_causal_wrench_is_independent_of_later_samples(
    tmp_path: Path, load: Path, tare: float | None
) -> None:
    t = np.arange(0, 4, 1e-3)
    late = push(t)
    late[t > 3.5] += [5.0, 0, 0, 0, 0, 1]
    before, after = (
        eliminate_log(
            simulated(tmp_path / f"{name}.parquet", contact=contact, noise=0.1),
            *(load,),
            delay=0.0,
            causal="delayed",
            causal_tare_s=tare,
        ).causal
        for name, contact in (("a", None), ("b", late))
    )
    assert before is not None and after is not None
    past = t < 2.8
    np.testing.assert_array_equal(before.contact[past], after.contact[past])
    np.testing.assert_array_equal(before.scaled[past], after.scaled[past])
    expected = Identification.load(load).offsets if tare is None else OFFSETS
    np.testing.assert_allclose(after.offsets, expected, atol=0.02)
    # The result is the push, delayed by the filter's lag.
    np.testing.assert_allclose(after.contact[3200:3400], push(t - after.lag_s)[3200:3400], atol=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("span", [(0.3, 0.7), (1.2, 1.9)])
def test_wrench_without_weight_has_its_own_offsets(
    span: tuple[float, float], tmp_path: Path, load: Path
) -> None:
    """The inertial wrench of the span is part of them."""
    path, t = simulated(tmp_path / "log.parquet"), np.arange(0, 4, 1e-3)
    names = ("q_w", "q_x", "q_y", "q_z")
    turns = dict(zip(names, quaternions(motion_at(t).R_WS).T, strict=True))
    pl.read_parquet(path).with_columns(**turns).write_parquet(path)
    known = Identification.load(load)
    found = eliminate_log(path, known, delay=0.0, cutoff_hz=None, untouched_s=span)
    log, rest = found.log, np.zeros((len(found.log), 3))
    left = log.wrench - non_contact_wrench(-log.gravity, rest, rest, known.phi)
    inside = (log.t >= span[0]) & (log.t <= span[1])
    assert np.linalg.norm((left - found.offsets)[inside, :3].mean(axis=0)) > 0.5
    np.testing.assert_allclose(found.gravity_only, left - left[inside].mean(axis=0), atol=1e-9)


def test_tare_requires_enough_samples(tmp_path: Path, load: Path) -> None:
    log = simulated(tmp_path / "log.parquet")
    for seconds in (1e-3, 9.0):
        with pytest.raises(DrakeTeleopError, match=r"causal_tare_s: the first .* of 4000 samples"):
            eliminate_log(log, load, delay=0.0, causal="delayed", causal_tare_s=seconds)
    with pytest.raises(DrakeTeleopError, match="give causal as well"):
        eliminate_log(log, load, delay=0.0, causal_tare_s=0.5)


@pytest.mark.pictures
@pytest.mark.slow
def test_eliminate_writes_its_files(
    tmp_path: Path, load: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = simulated(tmp_path / "log.parquet", noise=0.1)
    summary = eliminate_command(log, load, tmp_path)
    assert json.loads((tmp_path / "summary.json").read_text()) == summary
    assert (tmp_path / "contact_wrench.png").stat().st_size > 10_000
    assert "less the non-contact wrench" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(("sigma", "gamma"), [(0.0, 1.0), (1.0, 1.0), (0.5, 2.0), (1.5, 0.0)])
def test_scaling_law_on_a_log(tmp_path: Path, load: Path, sigma: float, gamma: float) -> None:
    log = simulated(tmp_path / "log.parquet", contact=push(np.arange(0, 4, 1e-3)))
    found = eliminate_log(log, load, sigma=sigma, gamma=gamma)
    expected = gamma * found.contact + sigma * found.non_contact
    np.testing.assert_allclose(found.scaled, expected, atol=1e-9)
    np.testing.assert_allclose(found.contact + found.non_contact, found.measured, atol=1e-9)


@pytest.mark.slow
def test_separate_scales_of_weight_and_inertia_on_a_log(tmp_path: Path, load: Path) -> None:
    t = np.arange(0, 4, 1e-3)
    now = motion_at(t)
    gravity = np.einsum("nji,j->ni", now.R_WS, [0.0, 0.0, -STANDARD_GRAVITY])
    wrench = non_contact_wrench(now.specific_force, now.omega, now.alpha, PHI) + OFFSETS
    log = tmp_path / "log.parquet"
    write_log(Log(t, wrench, now.specific_force, now.omega, now.alpha), log)
    turn = Rotation.from_matrix(now.R_WS).as_quat(scalar_first=True).T
    columns = [pl.Series(f"q_{axis}", values) for axis, values in zip("wxyz", turn, strict=True)]
    pl.read_parquet(log).with_columns(columns).write_parquet(log)
    options = {"cutoff_hz": None, "delay": 0.0}
    found = eliminate_log(log, load, sigma=0.5, sigma_weight=0.2, gamma=2.0, **options)
    rest = np.zeros_like(gravity)
    weight = non_contact_wrench(-gravity, rest, rest, found.phi)
    expected = 2.0 * found.contact + 0.5 * found.non_contact - 0.3 * weight
    np.testing.assert_allclose(found.scaled, expected, atol=1e-9)
    both = eliminate_log(log, load, sigma_weight=0.5, sigma_inertia=0.5, gamma=2.0, **options)
    same = eliminate_log(log, load, sigma=0.5, gamma=2.0, **options)
    np.testing.assert_array_equal(both.scaled, same.scaled)


@pytest.mark.parametrize(
    ("scales", "message"),
    [
        ({"sigma_weight": 0.5}, "gravity in the sensor frame: is unknown.*add an orientation"),
        ({"sigma_inertia": 101.0}, "sigma_inertia: 101 is outside 0 to 100"),
        ({"eta": 0.5, "sigma_weight": 0.0}, "eta requires sigma = 0"),
    ],
)
def test_unusable_scales_of_weight_and_inertia_are_rejected(
    tmp_path: Path, load: Path, scales: dict[str, float], message: str
) -> None:
    with pytest.raises(DrakeTeleopError, match=message):
        eliminate_log(simulated(tmp_path / "log.parquet"), load, **scales)


@pytest.mark.slow
def test_eta_renders_a_fraction_of_the_object(tmp_path: Path, load: Path) -> None:
    log = simulated(tmp_path / "log.parquet")
    kept = eliminate_log(log, load, eta=0.25).scaled
    np.testing.assert_allclose(kept, eliminate_log(log, load, sigma=0.25).scaled, atol=1e-12)
    with pytest.raises(DrakeTeleopError, match="eta"):
        eliminate_log(log, load, eta=0.25, sigma=0.5)
    with pytest.raises(DrakeTeleopError, match="sigma"):
        eliminate_log(log, load, sigma=-1.0)


@pytest.mark.slow
def test_offsets_are_estimated_from_the_record(tmp_path: Path, load: Path) -> None:
    drift = np.array([0.3, -0.2, 0.5, 0.01, 0.02, -0.01])
    log = simulated(tmp_path / "log.parquet", contact=np.tile(drift, (4000, 1)), noise=0.1)
    summary = eliminate_command(log, load, tmp_path, quiet=True)
    np.testing.assert_allclose(summary["tare"], drift, atol=0.02)
    kept = eliminate_log(log, load, tare=False)
    np.testing.assert_allclose(kept.contact.mean(axis=0), drift, atol=0.02)


@pytest.mark.slow
def test_delay_of_the_load_file_is_used_at_rest(tmp_path: Path, load: Path) -> None:
    t = np.arange(0, 2, 1e-3)
    rest = np.zeros((len(t), 3))
    s = rest + np.array([0, 0, 9.81])
    write_log(Log(t, non_contact_wrench(s, rest, rest, PHI), s, rest, rest), tmp_path / "log.csv")
    found = eliminate_log(tmp_path / "log.csv", load)
    assert found.delay_source == "load"
    assert found.delay_s == Identification.load(load).delay_s


def test_robust_offsets_ignore_a_contact() -> None:
    rng = np.random.default_rng(11)
    residual = OFFSETS + 0.1 * rng.normal(size=(5000, 6))
    free, share = robust_offsets(residual)
    np.testing.assert_allclose(free, residual.mean(axis=0), atol=1e-3)
    assert share > 0.99
    residual[3000:] += 5 * np.sin(np.linspace(0, 3, 2000))[:, None] + 1
    touched, share = robust_offsets(residual)
    np.testing.assert_allclose(touched, OFFSETS, atol=0.01)
    assert share == pytest.approx(0.6, abs=0.01)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, "cannot be read"),
        ("{", "is not JSON"),
        ("{}", ":phi: is missing"),
        ('{"phi": [1, 2]}', ":offsets: is missing"),
    ],
)
def test_invalid_load_file_raises(tmp_path: Path, text: str | None, words: str) -> None:
    log, load_file = simulated(tmp_path / "log.parquet"), tmp_path / "load.json"
    if text is not None:
        load_file.write_text(text)
    with pytest.raises(DrakeTeleopError, match=words) as error:
        eliminate_command(log, load_file, tmp_path / "out", quiet=True)
    assert "load.json" in str(error.value)
    assert not (tmp_path / "out").exists()


def test_error_of_a_table_of_others_has_a_remedy(tmp_path: Path) -> None:
    pl.DataFrame({"time": [0.0, 0.1], "fx": [1.0, 2.0]}).write_csv(tmp_path / "log.csv")
    with pytest.raises(
        DrakeTeleopError, match=r"log\.csv: is not a canonical log.*`drake-teleop insp"
    ):
        identify_log(tmp_path / "log.csv")


def test_delay_must_be_seconds_or_auto(tmp_path: Path) -> None:
    with pytest.raises(DrakeTeleopError, match="neither seconds nor auto"):
        identify_log(simulated(tmp_path / "log.parquet"), delay="soon")


# Real records


def describe_poses(folder: Path, data: Path, pose: dict[str, Any], sign: int = -1) -> Path:
    static = {
        "file": str(data / "0-calibration_fts-accel.csv"),
        "force": {"columns": ["fx", "fy", "fz"], "unit": "N"},
        "torque": {"columns": ["tx", "ty", "tz"], "unit": "N m"},
        "sign": sign,
    }
    path = folder / "poses.yaml"
    path.write_text(yaml.safe_dump({"gravity": 9.82085, "static": static | pose}))
    return path


def describe_record(folder: Path, data: Path, record: str) -> Path:
    time = {"column": "t", "unit": "us"}
    description = {
        "gravity": 9.82085,
        "wrench": {
            "file": str(data / f"{record}_wrench.csv"),
            "time": time,
            "force": {"columns": ["fx", "fy", "fz"], "unit": "N"},
            "torque": {"columns": ["tx", "ty", "tz"], "unit": "N m"},
            "sign": -1,
        },
        "imu": {
            "file": str(data / f"{record}_accel.csv"),
            "time": time,
            "specific_force": {
                "columns": ["ax", "ay", "az"],
                "unit": "g",
                "bias": [-0.0037, 0.0088, 0.0771],
            },
            "frame": [[0, -1, 0], [0, 0, 1], [-1, 0, 0]],
        },
        "pose": {
            "file": str(data / f"{record}_orientations.csv"),
            "time": time,
            "orientation": {
                "columns": [f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)],
                "form": "matrix",
            },
        },
    }
    path = folder / f"{record}.yaml"
    path.write_text(yaml.safe_dump(description))
    return path


GRAVITY = {"gravity": {"columns": ["gx", "gy", "gz"], "unit": "m/s^2"}}
ROTATION = {
    "orientation": {
        "columns": [f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)],
        "form": "matrix",
    }
}


THREE_POSES = """\
fx,fy,fz,tx,ty,tz,qx,qy,qz,qw
1.540818,-2.051113,16.448062,-0.178911,-0.111051,-0.080353,1,0,0,0
1.488645,-15.448753,2.995688,0.959860,0.049332,-0.242332,0.70710678,0,0,0.70710678
1.459600,-2.004639,-10.457004,0.381843,0.211758,-0.080239,0,0,0,1
"""


@pytest.mark.parametrize(("decimals", "least"), [(6, 0.0), (2, 0.01), (1, 0.1)])
def test_three_poses_are_not_exact(tmp_path: Path, decimals: int, least: float) -> None:
    """Three points of 1.37 kg at (12, -21, 64) mm, whose forces may be rounded."""
    table = pl.read_csv(StringIO(THREE_POSES))
    table.with_columns(pl.col("fx", "fy", "fz").round(decimals)).write_csv(tmp_path / "poses.csv")
    static = {
        "file": "poses.csv",
        "force": {"columns": ["fx", "fy", "fz"]},
        "torque": {"columns": ["tx", "ty", "tz"]},
        "orientation": {"columns": ["qx", "qy", "qz", "qw"], "form": "quaternion_xyzw"},
        "sign": -1,
    }
    path = tmp_path / "poses.yaml"
    path.write_text(yaml.safe_dump({"static": static}))
    summary = identify_command(path, tmp_path, quiet=True)
    load = identify_log(path).identification
    degrees = load.degrees_of_freedom
    assert degrees[6] == pytest.approx(5) and degrees[7:10] == pytest.approx(np.full(3, 3))
    for value, truth, deviation, freedom in (
        (summary["mass"], 1.37, summary["mass_std"], 5),
        *zip(summary["com"], [0.012, -0.021, 0.064], summary["com_std"], [3] * 3, strict=True),
    ):
        assert abs(value - truth) < stdtrit(freedom, 0.995) * deviation
    assert summary["com_std"][2] > 5e-5 and (decimals < 6 or summary["com_std"][2] < 2e-4)
    assert (np.array(summary["offsets_std"][:3]) > least / np.sqrt(12 * 3)).all()
    assert read_log(path).resolution == pytest.approx((10.0**-decimals, 1e-6))
    static["force"]["scale"] = [-0.5, 2.0, 1.0]
    path.write_text(yaml.safe_dump({"static": static}))
    assert read_log(path).resolution == pytest.approx((2.0 * 10.0**-decimals, 1e-6))


@pytest.mark.slow
@pytest.mark.parametrize("pose", [GRAVITY, ROTATION])
def test_ntnu_poses_give_mass_centre_and_offsets(
    ntnu: Path, tmp_path: Path, pose: dict[str, Any]
) -> None:
    summary = identify_command(describe_poses(tmp_path, ntnu, pose), tmp_path, quiet=True)
    assert summary["mass"] == pytest.approx(0.93231, abs=5e-6)
    assert summary["com"][2] == pytest.approx(0.043896, abs=5e-7)
    # The README's offsets have the sensor's own sign, this result that of Eq. (1).
    readings = [9.0765, -1.0181, 9.9848, 0.4325, -0.6916, -0.1570]
    np.testing.assert_allclose(summary["offsets"], -np.array(readings), atol=6e-5)
    assert summary["not_identifiable"] == NAMES_OF_INERTIA
    assert summary["delay_source"] == "static"
    with pytest.raises(
        DrakeTeleopError, match=r"sign of the wrench is inverted; set static\.sign: -1"
    ):
        identify_log(describe_poses(tmp_path, ntnu, pose, sign=1))


@pytest.mark.quick_cases(1)
@pytest.mark.slow
@pytest.mark.parametrize(
    ("record", "residual", "gravity_only"),
    [("1-baseline", 0.30, 0.58), ("2-vibrations", 0.32, 0.78)],
)
def test_ntnu_records_without_their_non_contact_force(
    ntnu: Path, tmp_path: Path, record: str, residual: float, gravity_only: float
) -> None:
    identify_command(describe_poses(tmp_path, ntnu, GRAVITY), tmp_path, quiet=True)
    log = describe_record(tmp_path, ntnu, record)
    summary = eliminate_command(log, tmp_path / "identification.json", tmp_path, quiet=True)
    assert summary["delay_source"] == "estimated"
    assert summary["delay_s"] == pytest.approx(0.006, abs=0.001)
    assert summary["residual_rms"] <= residual
    assert summary["gravity_only_rms"] == pytest.approx(gravity_only, abs=0.02)
    assert np.abs(summary["tare"][:3]).max() < 0.5
    # A hammer taps the robot four times in the second record, which has no contact either. One tap
    # disturbs it more than the noise of the record predicts.
    assert [round(c["start_s"], 1) for c in summary["contacts"]] == (
        [4.2] if record == "2-vibrations" else []
    )

    own = identify_command(log, tmp_path / "own", quiet=True)
    assert own["not_identifiable"] == NAMES_OF_INERTIA
    assert own["delay_s"] == pytest.approx(0.006, abs=0.001)
    # The hammer causes no contact.
    assert own["mass"] == pytest.approx(0.93231, rel=0.005)
    assert own["physically_consistent"]
    assert own["com"][2] == pytest.approx(0.0439, abs=3e-4)
