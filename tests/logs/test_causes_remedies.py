"""Lines that a cause states correct the description: the next fit is right and names no cause."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import permutations, product
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import yaml
from known_motion import GRAVITY_W, Motion, motion_at, quaternions
from scipy.spatial.transform import Rotation

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.load.batch.uncertainty import WRENCH_CHANNEL_NAMES
from drake_teleop.logs.causes.cause import Finding
from drake_teleop.logs.explained_log import (
    _correct_wrench_unit_or_torque_scale,
    add_corrected_fields,
    implausible_mass_message,
)
from drake_teleop.logs.processing import IdentifiedLog, check_log, identify_log
from drake_teleop.logs.read.reading import read_log

MASS, COM = 1.37, np.array([0.012, -0.021, 0.064])
INERTIA = 1e-3 * np.array([[4.1, 0.3, -0.2], [0.3, 3.6, 0.4], [-0.2, 0.4, 2.1]])
OFFSETS = np.array([3.2, -7.5, 12.1, 0.21, -0.33, 0.08])
NOISE = np.repeat([0.05, 0.003], 3)
PERMUTATIONS = [
    np.diag(signs) @ np.eye(3)[list(order)]
    for order in permutations(range(3))
    for signs in product([1.0, -1.0], repeat=3)
]


def slow(t: np.ndarray) -> Motion:
    """Return the known motion at half its speed."""
    fast = motion_at(0.5 * t)
    g_S = np.einsum("nji,j->ni", fast.R_WS, GRAVITY_W)
    s = 0.25 * (fast.specific_force + g_S) - g_S
    return Motion(t, fast.R_WS, fast.p_WS, s, 0.5 * fast.omega, 0.25 * fast.alpha)


def turned(motion: Motion, vector: np.ndarray) -> np.ndarray:
    return np.einsum("nji,j->ni", motion.R_WS, vector)


@dataclass
class Record:
    """Wrench in S and poses of a load, and the description that is written with them.

    With `imu_at`, an IMU at this place in S takes the place of the positions.
    """

    t: np.ndarray
    wrench: np.ndarray
    motion: Motion
    position: np.ndarray
    wrench_lines: dict[str, Any] = field(default_factory=dict)
    pose_lines: dict[str, Any] = field(default_factory=dict)
    imu_lines: dict[str, Any] = field(default_factory=dict)
    imu_at: np.ndarray | None = field(default_factory=lambda: np.zeros(3))
    turn: np.ndarray = field(default_factory=lambda: np.eye(3))  # from the motion's axes to S
    gravity: Any = 9.80665

    @classmethod
    def simulate(
        cls, gravity_W: np.ndarray = GRAVITY_W, seconds: float = 12.0, noise: float = 1.0
    ) -> Record:
        """Return a record by Newton's and Euler's laws about the centre of mass."""
        t = np.arange(0.0, seconds, 0.02)
        at, rng = slow(t), np.random.default_rng(1)
        w, alpha = at.omega, at.alpha
        s = at.specific_force + turned(at, GRAVITY_W - gravity_W)
        force = MASS * (s + np.cross(alpha, COM) + np.cross(w, np.cross(w, COM)))
        spin = alpha @ INERTIA + np.cross(w, w @ INERTIA)
        wrench = np.hstack([force, np.cross(COM, force) + spin]) + OFFSETS
        wrench += noise * NOISE * rng.normal(size=wrench.shape)
        return cls(t, wrench, at, at.p_WS + noise * 2e-5 * rng.normal(size=at.p_WS.shape))

    def without_weight(self, mass: float, com: Sequence[float]) -> None:
        force = -mass * turned(self.motion, GRAVITY_W)
        self.wrench -= np.hstack([force, np.cross(np.array(com), force)])

    def posed_at(self, place: np.ndarray) -> None:
        self.position = self.position + self.motion.R_WS @ place

    def described(self, sign: int, frame: np.ndarray, force: Any, torque: Any) -> None:
        """Write the same wrench with other lines of the description."""
        f, tau = self.wrench[:, :3] @ frame / sign / force, self.wrench[:, 3:] @ frame / sign
        self.wrench = np.hstack([f, tau / torque])
        self.wrench_lines = {
            "sign": sign,
            "frame": frame.tolist(),
            "force": {"columns": ["fx", "fy", "fz"], "scale": np.array(force).tolist()},
            "torque": {"columns": ["tx", "ty", "tz"], "scale": np.array(torque).tolist()},
        }

    def write(self, folder: Path) -> Path:
        q = quaternions(self.motion.R_WS @ self.turn)
        table = np.column_stack([self.t, self.wrench, q, self.position])
        names = ["t", "fx", "fy", "fz", "tx", "ty", "tz", "qw", "qx", "qy", "qz", "x", "y", "z"]
        pl.DataFrame(dict(zip(names, table.T, strict=True))).write_parquet(folder / "log.parquet")
        stream = {"file": "log.parquet", "time": {"column": "t"}}
        wrench = {"force": {"columns": names[1:4]}, "torque": {"columns": names[4:7]}}
        pose = {
            "orientation": {"columns": names[7:11], "form": "quaternion_wxyz"},
            "position": {"columns": names[11:]},
        }
        description = {
            "gravity": self.gravity,
            "wrench": stream | wrench | self.wrench_lines,
            "pose": stream | pose | self.pose_lines,
        }
        if self.imu_at is not None:
            at, r = self.motion, self.imu_at
            s = (
                at.specific_force
                + np.cross(at.alpha, r)
                + np.cross(at.omega, np.cross(at.omega, r))
            )
            imu = {"specific_force": s, "angular_velocity": at.omega}
            imu["angular_acceleration"] = at.alpha
            np.savez(folder / "imu.npz", t=self.t, **{k: x @ self.turn for k, x in imu.items()})
            streams = {name: {"columns": [name]} for name in imu}
            description["imu"] = stream | {"file": "imu.npz"} | streams | self.imu_lines
            del description["pose"]["position"]
        path = folder / "log.yaml"
        path.write_text(yaml.safe_dump(description))
        return path


def follow(path: Path, causes: Sequence[Finding]) -> int:
    """Write the lines that causes state into the description; return how many."""
    description = yaml.safe_load(path.read_text())
    lines = []
    for cause in causes:
        _, stated, text = cause.message.rpartition("; set ")
        lines += text.split(" and ") if stated else []
    for line in lines:
        name, value = line.split(": ", 1)
        *outer, last = name.split(".")
        at = description
        for key in outer:
            at = at.setdefault(key, {})
        at[last] = yaml.safe_load(value)
    path.write_text(yaml.safe_dump(description))
    return len(lines)


def assert_right(found: IdentifiedLog) -> None:
    """Check that nothing is named and that the load is within its interval."""
    assert [cause.name for cause in found.causes] == []
    assert found.findings == ()
    load = found.identification
    deviations = np.sqrt(np.diag(load.covariance))[6:10]
    assert (np.abs(load.phi[:4] - MASS * np.array([1.0, *COM])) < 4.0 * deviations).all()
    assert load.identifiable[6:10].all()


def tilted(degrees: float) -> Record:
    record = Record.simulate(Rotation.from_euler("y", degrees, degrees=True).apply(GRAVITY_W))
    return replace(record, imu_at=None)


def axes(Q: np.ndarray, sign: int, frame: np.ndarray) -> Record:
    record = Record.simulate()
    record.wrench = record.wrench @ np.kron(np.eye(2), Q).T
    record.described(sign, frame, 1.0, 1.0)
    return record


def torque(factor: float) -> Record:
    record = Record.simulate()
    record.wrench[:, 3:] *= factor
    record.described(-1, np.eye(3), 1e-4, [1e-5, -1e-5, 2e-5])
    return record


def gain(channel: int) -> Record:
    record = Record.simulate()
    record.wrench[:, channel] *= 1.03
    record.described(-1, PERMUTATIONS[9], [1.0, 2.0, -3.0], 0.1)
    return record


def displaced() -> Record:
    record = replace(Record.simulate(), imu_at=None)
    record.posed_at(np.array([0.13, -0.02, 0.05]))
    record.pose_lines = {"position_in_sensor": [0.03, 0.04, -0.05]}
    return record


def displaced_imu() -> Record:
    lines = {"position": [0.03, 0.04, -0.05]}
    return replace(Record.simulate(), imu_at=np.array([0.13, -0.02, 0.05]), imu_lines=lines)


def rotated() -> Record:
    """Describe all motion in axes that are rotated by `TURN`, the IMU's 5 cm from S."""
    place = np.array([0.0, 0.03, 0.04])
    record = replace(Record.simulate(), turn=TURN @ OBLIQUE, imu_at=place)
    record.imu_lines = {"frame": OBLIQUE.tolist(), "position": (TURN.T @ place).tolist()}
    record.pose_lines = {"rotation_in_sensor": OBLIQUE.tolist()}
    return record


def removed(share: float, com: np.ndarray, described: list[float] | None = None) -> Record:
    record = Record.simulate()
    record.without_weight(share * MASS, com)
    record.wrench_lines = {} if described is None else {"weight": described}
    return record


OBLIQUE = Rotation.from_rotvec([0.4, 0.3, -0.8]).as_matrix()
TURN = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
CASES: dict[str, tuple[str, Callable[[], Record]]] = {
    "mirrored": ("axes", lambda: axes(PERMUTATIONS[14], -1, OBLIQUE)),
    "wall": ("gravity direction", lambda: tilted(90.0)),
    "torque sign": ("torque factor", lambda: torque(-1.0)),
    "one torque": ("gain", lambda: gain(4)),
    "displaced": ("pose frame", displaced),
    "displaced imu": ("pose frame", displaced_imu),
    "rotated": ("sensor rotation", rotated),
    "weight": ("weight removed", lambda: removed(1.0, COM)),
    "payload": ("payload configured", lambda: removed(0.6, COM + 0.01, [0.2, 0.0, 0.01, 0.0])),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_nothing_is_named_after_following_the_line_of_a_cause(case: str, tmp_path: Path) -> None:
    name, make = CASES[case]
    path = make().write(tmp_path)
    causes = identify_log(path).causes
    assert [cause.name for cause in causes] == [name]
    assert follow(path, causes) > 0
    assert_right(identify_log(path))


@pytest.mark.parametrize("degrees", [3.0, 178.0])
def test_gravity_auto_finds_the_direction_and_states_it(degrees: float, tmp_path: Path) -> None:
    record = tilted(degrees)
    record.gravity = "auto"
    path = record.write(tmp_path)
    found = identify_log(path)
    assert_right(found)
    [note] = [note for note in found.log.notes if "gravity found" in note]
    gravity = yaml.safe_load(note.rpartition("gravity: ")[2])
    assert np.linalg.norm(gravity) == pytest.approx(9.80665, abs=1e-3)
    true = Rotation.from_euler("y", degrees, degrees=True).apply(GRAVITY_W)
    assert gravity == pytest.approx(true, abs=0.02)


@pytest.mark.parametrize("seed", range(16))
def test_lines_of_axes_factor_and_gain_compose_with_the_description(
    seed: int, tmp_path: Path
) -> None:
    rng = np.random.default_rng(seed)
    record = Record.simulate(seconds=1.0, noise=0.0)
    right = record.wrench.copy()
    causes = [
        Finding("torque factor", "k", values={"factor": float(rng.choice([-1.0, 10.0, -0.1]))})
    ]
    Q = PERMUTATIONS[rng.integers(48)]
    causes += [Finding("axes", "Q", values={"matrix": Q.tolist()})]
    factor = np.repeat([1.0, causes[0].values["factor"]], 3)
    record.wrench = record.wrench @ np.kron(np.eye(2), Q).T * factor
    frame = OBLIQUE
    if seed % 2:  # a channel is that of a column
        frame = PERMUTATIONS[rng.integers(48)]
        frame = frame * np.linalg.det(frame)
        channel = int(rng.integers(6))
        record.wrench[:, channel] *= 1.02
        values = {"channel": WRENCH_CHANNEL_NAMES[channel], "gain": 1.02}
        causes.append(Finding("gain", "g", values=values))
    scales = rng.choice([-2.0, 1e-4, 1.0], (2, 3))
    record.described(int(rng.choice([-1, 1])), frame, *scales)
    path = record.write(tmp_path)
    follow(path, add_corrected_fields(causes, read_log(path), by_pose=True))
    assert read_log(path).wrench == pytest.approx(right, rel=1e-5, abs=1e-4)


@pytest.mark.parametrize("scale", [1.0, 0.004, 0.0015])
@pytest.mark.parametrize("ratio", [1.02, 0.97, 30.0])
def test_line_of_a_wrong_clock_rate_has_six_digits(
    scale: float, ratio: float, tmp_path: Path
) -> None:
    record = Record.simulate(seconds=1.0)
    lines = {"time": {"column": "t", "scale": scale}}
    record.wrench_lines = record.pose_lines = record.imu_lines = lines
    log = read_log(record.write(tmp_path))
    [cause] = add_corrected_fields(
        [Finding("clock rate", "c", values={"ratio": ratio})], log, by_pose=True
    )
    assert set(cause.fields) == {f"{name}.time.scale" for name in ("wrench", "imu", "pose")}
    for value in cause.fields.values():
        assert value == pytest.approx(scale / ratio, rel=1e-5)


@pytest.mark.parametrize(
    ("force", "torque", "factor", "name", "value"),
    [
        ("N", "N m", 1e3, "wrench.torque.unit", "N mm"),
        ("N", "N m", 4.4482216, "wrench.force.unit", "lbf"),
        ("lbf", "N m", 1 / 4.4482216, "wrench.force.unit", "N"),
        ("N", "N mm", 1e-3, "wrench.torque.unit", "N m"),
        ("N", "N m", 3.0, "wrench.torque.scale", [2 / 3] * 3),
    ],
)
def test_unit_of_force_or_torque_follows_from_the_factor(force, torque, factor, name, value):
    fields = {"wrench.force.unit": force, "wrench.torque.unit": torque}
    fields |= {"wrench.force.scale": np.ones(3), "wrench.torque.scale": np.full(3, 2.0)}
    expected = fields | {name: value}
    _correct_wrench_unit_or_torque_scale(fields, factor)
    assert fields.keys() == expected.keys()
    for key in fields:
        assert fields[key] == pytest.approx(expected[key])


@pytest.mark.parametrize("seed", range(4))
def test_remedy_adds_the_weight_and_composes_the_pose_frame(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    record = Record.simulate(seconds=4.0, noise=0.0)
    right, place = record.wrench.copy(), record.position.copy()
    record.imu_at = None
    weight = rng.uniform(0.1, 0.5, 4)
    shift, known = rng.uniform(-0.2, 0.2, (2, 3))
    record.without_weight(weight[0], weight[1:] / weight[0])
    record.posed_at(shift + known)
    record.wrench_lines = {"weight": weight.tolist()}
    record.pose_lines = {"position_in_sensor": known.tolist()}
    causes = [Finding("pose frame", "r", values={"position_in_sensor": shift.tolist()})]
    path = record.write(tmp_path)
    follow(path, add_corrected_fields(causes, read_log(path), by_pose=True))
    log = read_log(path)
    assert log.posed is not None
    assert log.posed.poses.position == pytest.approx(place, abs=2e-5)
    assert log.wrench == pytest.approx(right, abs=0.01)


@pytest.mark.parametrize("late", [0.04, -0.06])
def test_restored_weight_has_the_direction_of_gravity_in_each_wrench(
    late: float, tmp_path: Path
) -> None:
    """The clock of the poses differs from that of the wrench."""
    record = replace(Record.simulate(seconds=4.0, noise=0.0), imu_at=None)
    right = record.wrench.copy()
    record.without_weight(0.4, [0.1, -0.2, 0.3])
    record.wrench_lines = {"weight": [0.4, 0.04, -0.08, 0.12]}
    record.pose_lines = {"time": {"column": "t", "offset": late}}
    log = read_log(record.write(tmp_path))
    rows = np.round(log.t / 0.02).astype(int)[5:-5]
    assert log.wrench[5:-5] == pytest.approx(right[rows], abs=0.01)


def test_a_canonical_table_and_base_axes_get_other_remedies(tmp_path: Path) -> None:
    record = Record.simulate(seconds=1.0)
    cause = Finding("axes", "D", values={"matrix": PERMUTATIONS[14].tolist()})
    log = read_log(record.write(tmp_path))
    [of_table] = add_corrected_fields([cause], replace(log, source="log.csv"), by_pose=True)
    assert "in a log description of this table" in of_table.message
    record.wrench_lines = {"frame": "base"}
    [of_base] = add_corrected_fields([cause], read_log(record.write(tmp_path)), by_pose=True)
    assert of_base.message == "D; correct the columns of wrench.force and wrench.torque"
    inverted = Finding("axes", "D", values={"matrix": (-np.eye(3)).tolist()})
    [of_sign] = add_corrected_fields([inverted], read_log(record.write(tmp_path)), by_pose=True)
    assert of_sign.message == "D; set wrench.sign: -1"


def test_counts_are_refused_with_the_scale_to_set(tmp_path: Path) -> None:
    record = Record.simulate(seconds=1.0)
    record.wrench *= 1e6
    path = record.write(tmp_path)
    with pytest.raises(DrakeTeleopError, match=r"raw counts, set wrench\.force\.scale"):
        read_log(path)
    record.wrench_lines = {
        "force": {"columns": ["fx", "fy", "fz"], "scale": 1e-6},
        "torque": {"columns": ["tx", "ty", "tz"], "scale": 1e-6},
    }
    assert np.abs(read_log(record.write(tmp_path)).wrench).max() < 100.0


def test_counts_of_two_scales_give_both_scales(tmp_path: Path) -> None:
    record = Record.simulate()
    record.wrench = np.round(record.wrench * np.repeat([1e4, 1e5], 3))
    path = record.write(tmp_path)
    found = identify_log(path)
    assert [cause.name for cause in found.causes] == ["torque factor"]
    [units] = [finding.message for finding in found.findings if finding.name == "units"]
    assert "1.37e+04 kg is implausible" in units
    assert "give" in units and "0.0001)" in units and "torque.scale to 0.1 times that" in units


@pytest.mark.parametrize("scale", [1.0, 10.0, -1e-3, [1e-3, 2e-3, -1e-3]])
@pytest.mark.parametrize("mass", [1370.0, -1.37e6])
def test_scale_for_a_load_of_a_few_kg_includes_the_given_scale(
    scale: Any, mass: float, tmp_path: Path
) -> None:
    record = Record.simulate(seconds=1.0)
    record.described(1, np.eye(3), scale, 1.0)
    message = implausible_mass_message(mass, [], read_log(record.write(tmp_path)))
    assert message is not None
    stated = yaml.safe_load(message.partition("is given by ")[2].partition(")")[0])
    np.testing.assert_allclose(float_list(stated), float_list(scale) * 1.37 / abs(mass), rtol=1e-5)


def float_list(value: Any) -> np.ndarray:
    """Return numbers (3,); PyYAML reads 1e-06 as a text."""
    return np.array(value, float) + np.zeros(3)


def test_inspect_and_repeated_fits_accept_a_removed_weight(tmp_path: Path) -> None:
    record = removed(1.0, COM)
    record.wrench_lines = {"weight": "removed"}
    path = record.write(tmp_path)
    assert check_log(path).findings == ()
    found = identify_log(path)
    assert_right(found)
    assert any("removed from the wrench is that of 1.3" in note for note in found.log.notes)


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ({"wrench": {"force": {"scale": 0}}}, "scale factor is below 1e-12 in magnitude"),
        ({"wrench": {"force": {"scale": [1, 2]}}}, "scale"),
        ({"wrench": {"force": {"scale": ".inf"}}}, "scale"),
        ({"wrench": {"weight": "gone"}}, "must be the word removed, or"),
        ({"wrench": {"weight": [1, 0, 0]}}, "weight"),
        ({"gravity": "up"}, "must be a number, three numbers"),
        ({"gravity": "auto", "wrench": {"weight": "removed"}}, "cannot be combined"),
        ({"pose": {"position_in_sensor": "auto"}, "gravity": "auto"}, "cannot be combined"),
        (
            {"pose": None, "imu": True, "gravity": "auto"},
            "gravity: auto requires a wrench and a pose alone",
        ),
        ({"pose": None, "imu": True, "wrench": {"weight": "removed"}}, "add pose"),
    ],
)
def test_a_wrong_line_is_refused_in_the_users_terms(
    lines: dict[str, Any], said: str, tmp_path: Path
) -> None:
    path = replace(Record.simulate(seconds=1.0), imu_at=None).write(tmp_path)
    description = yaml.safe_load(path.read_text())
    if lines.pop("imu", False):
        s, omega = {"columns": ["fx", "fy", "fz"]}, {"columns": ["tx", "ty", "tz"]}
        stream = {"file": "log.parquet", "time": {"column": "t"}}
        description["imu"] = stream | {"specific_force": s, "angular_velocity": omega}
    for name, value in lines.items():
        if isinstance(value, dict):
            for key, x in value.items():
                both = isinstance(x, dict)
                description[name][key] = description[name][key] | x if both else x
        else:
            description[name] = value
    path.write_text(yaml.safe_dump(description))
    with pytest.raises(DrakeTeleopError, match=said):
        read_log(path)


def test_static_poses_take_a_payload_and_refuse_a_removed_weight(tmp_path: Path) -> None:
    record = replace(Record.simulate(seconds=1.0, noise=0.0), imu_at=None)
    path = record.write(tmp_path)
    description = yaml.safe_load(path.read_text())
    static = {k: v for k, v in description.pop("wrench").items() if k != "time"}
    static["orientation"] = description.pop("pose")["orientation"]
    description["static"] = static
    logs = []
    for weight in (None, [0.5, 0.01, 0.02, 0.03]):
        path.write_text(yaml.safe_dump(description | {"static": static | {"weight": weight}}))
        logs.append(read_log(path))
    added = logs[1].wrench - logs[0].wrench
    force = -0.5 * turned(record.motion, GRAVITY_W)
    torque = np.cross(np.array([0.01, 0.02, 0.03]), force / 0.5)
    assert added == pytest.approx(np.hstack([force, torque]), abs=1e-9)
    path.write_text(yaml.safe_dump(description | {"static": static | {"weight": "removed"}}))
    with pytest.raises(DrakeTeleopError, match="cannot be used with static poses"):
        read_log(path)
