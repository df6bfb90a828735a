"""Command `drake-teleop sample-log`: simulated log of a gripper on an arm like a UR5e.

free.yaml is free motion, touched.yaml has contacts, truth.json the true values.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.files import output_folder, write_json, write_table, write_text
from drake_teleop.common.numeric import Array
from drake_teleop.common.rotations import rotation_matrices
from drake_teleop.load.inertia import phi_from_mass_com_inertia
from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.load.trajectory import FourierTrajectory
from drake_teleop.logs.read.description_fields import SI_VALUE_OF_UNIT, STANDARD_GRAVITY

TRUE_MASS_KG, TRUE_COM_S = 0.95, np.array([0.004, -0.011, 0.058])
TRUE_INERTIA_COM = np.array([[1.4e-3, 5e-5, 0.0], [5e-5, 1.9e-3, -8e-5], [0.0, -8e-5, 9e-4]])
"""Mass [kg], centre of mass [m] and inertia [kg m^2] of the gripper in S, similar to a Robotiq
2F-85."""
FINGERTIP_POSITION_S = np.array([0.0, 0.0, 0.17])  # m
TRUE_SENSOR_OFFSETS = np.array(
    [[4.2, -6.1, 11.3, 0.21, -0.14, 0.05], [4.5, -6.0, 10.9, 0.21, -0.15, 0.05]]
)
"""(2, 6) offsets of the sensor in the two records [N, N m], with drift between them."""
WRENCH_NOISE_STD = np.repeat([0.08, 0.003], 3)  # N, N m
POSE_DELAY_S = 0.013
POSE_CLOCK_OFFSET_S = 48213.4
"""Time of the controller's clock at the sensor's time 0 [s]."""

WRENCH_HZ, POSE_HZ = 500.0, 125.0
MOTION_PERIOD_S, REST_AT_ENDS_S = 8.0, 0.5
_MAX_CLOCK_JITTER_S = 5e-5

# UR5e, Denavit-Hartenberg parameters of the manufacturer: d, a [m], alpha [rad].
_LINK_OFFSETS_M = 0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996
_LINK_LENGTHS_M = 0.0, -0.425, -0.3922, 0.0, 0.0, 0.0
_LINK_TWISTS_RAD = np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0
HOME_ANGLES_RAD = np.array([0.3, -1.7, 1.9, -1.8, -1.5, 0.4])  # gripper down, in front of the arm
_FOURIER_AMPLITUDES_RAD = np.array([0.8, 0.4, 0.45, 1.0, 1.0, 1.3])
_NUM_MOTION_HARMONICS = 6
TRUE_LOAD = phi_from_mass_com_inertia(TRUE_MASS_KG, TRUE_COM_S, TRUE_INERTIA_COM)
"""Load phi (10,) of the gripper."""


@dataclass(frozen=True)
class FingertipPush:
    """Push at the fingertips, a half sine over `start_s` to `stop_s` on the sensor's clock.

    `push_W` (3,) is its peak on the gripper, in the world [N].
    """

    start_s: float
    stop_s: float
    push_W: tuple[float, float, float]

    def wrench_S(self, t: Array, R_WS: Array) -> Array:
        """Return the wrench (N, 6) on the gripper about So, in S [N, N m]."""
        share = np.clip((t - self.start_s) / (self.stop_s - self.start_s), 0, 1)
        force = np.outer(np.sin(np.pi * share), self.push_W)
        force_S = np.einsum("nji,nj->ni", R_WS, force)
        return np.hstack([force_S, np.cross(FINGERTIP_POSITION_S, force_S)])


FINGERTIP_PUSHES = (
    FingertipPush(2.1, 2.2, (0.0, 9.0, 0.0)),
    FingertipPush(4.4, 4.9, (-3.0, 0.0, 6.0)),
    FingertipPush(6.9, 6.98, (4.0, -2.0, 0.0)),
)
"""A tap, a push and a light tap, smaller than the wrench of weight and inertia."""

_DESCRIPTION_TEMPLATE = """\
# A gripper on a lab arm, {what}: made by drake-teleop sample-log.
wrench:
  file: {name}_wrench.csv  # 500 Hz
  time: {{column: time, unit: ms}}
  force:
    columns: [Fx, Fy, Fz]
    unit: lbf
  torque:
    columns: [Tx, Ty, Tz]
    unit: lbf in
  sign: -1  # the sensor reports what the load exerts on it, as most do
pose:  # of the sensor
  file: {name}_pose.csv  # 125 Hz
  time: {{column: uptime, offset: {offset}}}  # s; the arm's clock is ahead by that much
  orientation:
    columns: [rx, ry, rz]
    form: rotation_vector
    unit: deg
  position:
    columns: [x, y, z]
    unit: mm
"""


def sample_log_command(out: Path, *, seed: int = 0, quiet: bool = False) -> dict[str, Any]:
    """Write records, descriptions, truth.json and summary.json, equal for equal seeds, to `out`."""
    random = np.random.default_rng(seed)
    records = {"free": ((), "in free motion"), "touched": (FINGERTIP_PUSHES, "touched three times")}
    files = []
    with output_folder(out):
        for row, (name, (pushes, what)) in enumerate(records.items()):
            text = _DESCRIPTION_TEMPLATE.format(name=name, what=what, offset=-POSE_CLOCK_OFFSET_S)
            write_text(out / f"{name}.yaml", text)
            _write_record(out, name, row, pushes, random)
            files += [f"{name}.yaml", f"{name}_wrench.csv", f"{name}_pose.csv"]
        load = {"mass": TRUE_MASS_KG, "com": TRUE_COM_S, "inertia_com": TRUE_INERTIA_COM}
        offsets = {"offsets": TRUE_SENSOR_OFFSETS[0], "offsets_touched": TRUE_SENSOR_OFFSETS[1]}
        contacts = [_summarize_true_contact(touch) for touch in FINGERTIP_PUSHES]
        truth = {**load, "phi": TRUE_LOAD, **offsets, "delay_s": POSE_DELAY_S, "contacts": contacts}
        write_json(out / "truth.json", truth)
        duration_s = MOTION_PERIOD_S + 2 * REST_AT_ENDS_S
        summary = {"seed": seed, "files": [*files, "truth.json"], "duration_s": duration_s}
        summary |= {"wrench_hz": WRENCH_HZ, "pose_hz": POSE_HZ}
        write_json(out / "summary.json", summary)
    if not quiet:
        _print_files_and_next_commands(out)
    return summary


def _summarize_true_contact(touch: FingertipPush) -> dict[str, Any]:
    R_WS = _motion_of_record(1)(np.array([(touch.start_s + touch.stop_s) / 2]))[3][0]
    peak = np.linalg.norm(touch.push_W)
    push = R_WS.T @ touch.push_W / peak
    return {"start_s": touch.start_s, "stop_s": touch.stop_s, "peak_N": peak, "push": push}


def _print_files_and_next_commands(out: Path) -> None:
    from rich.console import Console

    load = "out/load/identification.json"
    free, touched = (shlex.quote(f"{out}/{name}.yaml") for name in ("free", "touched"))
    for line in (
        f"a gripper in free motion ({out}/free.yaml) and touched three times ({out}/touched.yaml)",
        "try:",
        f"  drake-teleop inspect {free}",
        f"  drake-teleop identify {free} --out out/load",
        f"  drake-teleop eliminate {touched} --load {load}",
        f"  drake-teleop detect {touched} --load {load} --free {free}",
        f"the true values are in {out}/truth.json",
    ):
        Console(soft_wrap=True).print(line, highlight=False, markup=False)


_Motion: TypeAlias = tuple[Array, Array, Array, Array, Array]


def _motion_of_record(number: int) -> Callable[[Array], _Motion]:
    random = np.random.default_rng([2009, number])
    return _random_motion(random, 0.5, _NUM_MOTION_HARMONICS, MOTION_PERIOD_S, REST_AT_ENDS_S)


def _random_motion(
    random: np.random.Generator, scale: float, harmonics: int, period_s: float, rest_s: float
) -> Callable[[Array], _Motion]:
    """Return the motion, as a function of times [s], of a random Fourier path between two rests."""
    sine, cosine = (
        random.normal(size=(2, 6, harmonics - 1)) * scale * _FOURIER_AMPLITUDES_RAD[:, np.newaxis]
    )
    path = FourierTrajectory.rest_to_rest(HOME_ANGLES_RAD, sine, cosine, 1 / period_s)
    return lambda t: sensor_motion(*path.evaluate(np.clip(t - rest_s, 0, period_s)))


def sensor_motion(q: Array, qd: Array, qdd: Array) -> _Motion:
    """Return specific force of So, omega and alpha of S (N, 3) in S, and R_WS and p_WS.

    S is the last link's frame; q, qd, qdd (N, 6) are angles, rates and accelerations of the joints.
    """
    R = np.broadcast_to(np.eye(3), (len(q), 3, 3))
    p, omega, alpha = np.zeros((3, len(q), 3))
    s = p + np.array([0.0, 0.0, STANDARD_GRAVITY])
    links = zip(_LINK_OFFSETS_M, _LINK_LENGTHS_M, _LINK_TWISTS_RAD, strict=True)
    for j, (d, a, twist) in enumerate(links):
        z, rate = R[:, :, 2], qd[:, j, np.newaxis]
        alpha = alpha + qdd[:, j, np.newaxis] * z + np.cross(omega, rate * z)
        omega = omega + rate * z
        turned = R @ rotation_matrices(np.outer(q[:, j], [0.0, 0.0, 1.0]), "rotation_vector")
        r = turned @ [a, 0.0, d]
        p, s = p + r, s + np.cross(alpha, r) + np.cross(omega, np.cross(omega, r))
        R = turned @ rotation_matrices(np.array([[twist, 0.0, 0.0]]), "rotation_vector")
    return *(np.einsum("nji,nj->ni", R, x) for x in (s, omega, alpha)), R, p


def _jittered_time_stamps(rate_hz: float, random: np.random.Generator) -> Array:
    t = np.arange(round((MOTION_PERIOD_S + 2 * REST_AT_ENDS_S) * rate_hz)) / rate_hz
    return t + _MAX_CLOCK_JITTER_S * random.uniform(0, 1, len(t))


def _write_record(
    out: Path, name: str, row: int, pushes: tuple[FingertipPush, ...], random: np.random.Generator
) -> None:
    from scipy.spatial.transform import Rotation

    t, motion_at = _jittered_time_stamps(WRENCH_HZ, random), _motion_of_record(row)
    s, omega, alpha, R_WS, _ = motion_at(t)
    wrench = non_contact_wrench(s, omega, alpha, TRUE_LOAD) + TRUE_SENSOR_OFFSETS[row]
    for touch in pushes:
        wrench -= touch.wrench_S(t, R_WS)  # the push reduces the wrench of the sensor on the load
    wrench += WRENCH_NOISE_STD * random.normal(size=wrench.shape)
    reading = -wrench / np.repeat([SI_VALUE_OF_UNIT["lbf"], SI_VALUE_OF_UNIT["lbf in"]], 3)
    _write_columns(out / f"{name}_wrench.csv", "time Fx Fy Fz Tx Ty Tz", [1e3 * t, reading])
    t = _jittered_time_stamps(POSE_HZ, random)
    _, _, _, R_WS, p_WS = motion_at(t - POSE_DELAY_S)
    turn = Rotation.from_matrix(R_WS).as_rotvec(degrees=True)
    columns = [t + POSE_CLOCK_OFFSET_S, 1e3 * p_WS, turn]
    _write_columns(out / f"{name}_pose.csv", "uptime x y z rx ry rz", columns)


def _write_columns(path: Path, names: str, columns: list[Array]) -> None:
    import polars as pl

    table = np.round(np.column_stack(columns), 4)
    write_table(path, pl.DataFrame(table, schema=names.split()), float_precision=4)


_POSE_NOISE_STD_M_AND_RAD = np.repeat([5e-5, 2e-4], 3)  # m, rad
_EPISODE_HARMONICS, _EPISODE_REST_S = 5, 0.2
_MIN_CONTACT_FORCE_N = 0.5


class SampleEpisode(NamedTuple):
    """Episode of N frames: times [s], poses of S in W, measured wrenches, and true contact.

    Wrenches (N, 6) are those on the load in S; `contact_wrench` is F_c of Eq. (13).
    """

    t: Array
    position: Array
    quaternion: Array
    wrench: Array
    contact_wrench: Array
    in_contact: NDArray[np.bool_]


def sample_episode(
    number: int,
    *,
    fps: float = 30.0,
    duration_s: float = 6.0,
    seed: int = 0,
    phi: Array = TRUE_LOAD,
    contacts: int = 2,
    lag_frames: float = 0.0,
) -> SampleEpisode:
    """Return an episode whose motion, contacts and noise follow from its number and the seed.

    `lag_frames` is the delay of the poses behind the wrench, in frames.
    """
    from scipy.spatial.transform import Rotation

    random = np.random.default_rng([2026, seed, number])
    t = np.arange(round(duration_s * fps)) / fps
    period = duration_s - 2 * _EPISODE_REST_S
    motion_at = _random_motion(random, 0.35, _EPISODE_HARMONICS, period, _EPISODE_REST_S)
    s, omega, alpha, R_WS, _ = motion_at(t)
    contact = np.zeros((len(t), 6))
    starts = np.sort(random.uniform(0.15, 0.75, contacts)) * duration_s
    for start in starts:
        push = random.normal(size=3)
        push *= random.uniform(5, 15) / np.linalg.norm(push)
        touch = FingertipPush(start, start + random.uniform(0.4, 0.9), tuple(push))
        contact -= touch.wrench_S(t, R_WS)
    offsets = TRUE_SENSOR_OFFSETS[0] + random.normal(size=6) * np.repeat([0.5, 0.02], 3)
    wrench = non_contact_wrench(s, omega, alpha, phi) + contact + offsets
    wrench += WRENCH_NOISE_STD * random.normal(size=wrench.shape)
    *_, R_late, p_late = motion_at(t - lag_frames / fps)
    noise = _POSE_NOISE_STD_M_AND_RAD * random.normal(size=(len(t), 6))
    turned = Rotation.from_matrix(R_late) * Rotation.from_rotvec(noise[:, 3:])
    quaternion = turned.as_quat()[:, [3, 0, 1, 2]]
    touched = np.linalg.norm(contact[:, :3], axis=1) > _MIN_CONTACT_FORCE_N
    return SampleEpisode(t, p_late + noise[:, :3], quaternion, wrench, contact, touched)
