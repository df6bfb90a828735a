"""Does the inverse kinematics reach every pose, with bounded speed at singularities?

`python benchmarks/inverse_kinematics.py [--poses 100000] [--json FILE]` tests the RX90, one with a
sliding joint, arms of five and of eight joints, and from the robot descriptions of the extra
`bench`
a Panda, an xArm 7, a UR5 and a Kinova Jaco. For each arm:

* `find_posture` for poses of random joint positions within the limits, from the middle of the
  limits: number of solutions, largest error, time; status of the others;
* `follow_pose` along a motion of all joints at 2 kHz, from its previous solution: errors, largest
  speed over its limit, time of a call. Baselines along the same motion: Drake's
  `DoDifferentialInverseKinematics`, a step as in Pinocchio's examples, and a step of damped least
  squares in numpy;
* for three arms, a tool that rotates back and forth through a wrist singularity, or near it.

For the RX90 also: the largest joint difference to the closed form, and the behaviour of the closed
form at the singularity. Times are thread times.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import Counter
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.inverse_kinematics import (
    DifferentialInverseKinematicsParameters,
    DoDifferentialInverseKinematics,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame
from scipy.spatial.transform import Rotation

from drake_teleop.station.slave.arm import (
    IS_PRISMATIC_COLUMN,
    PHI_COLUMN,
    ROTATION_COLUMN,
    TRANSLATION_COLUMN,
    ArmModel,
    forward_kinematics,
    jacobian,
)
from drake_teleop.station.slave.arm_from_plant import ArmModelFromPlant
from drake_teleop.station.slave.inverse_kinematics import (
    IkStatus,
    InverseKinematics,
    solve_pose_command,
)
from drake_teleop.station.slave.models import ParseModel
from drake_teleop.station.slave.numeric_inverse_kinematics import (
    MAX_SOLVER_STEPS_PER_COMMAND,
    MIN_SINGULAR_VALUE_M,
    find_posture,
    follow_pose,
    orientation_weight_m,
)
from drake_teleop.station.slave.plant import ParseSlave, finalize_without_limit_warnings

Array = Any
PERIOD = 5e-4
#: File and frame in the package example-robot-data.
DESCRIBED = {
    "panda": ("panda_description/urdf/panda.urdf", "panda_link8"),
    "xarm7": ("xarm_description/urdf/xarm7.urdf", "link7"),
    "ur5": ("ur_description/urdf/ur5_robot.urdf", "tool0"),
    "jaco": ("kinova_description/robots/kinova.urdf", "j2s6s200_link_6"),
}
_JOINT = """<joint name="j{k}" type="{kind}"><parent link="l{i}"/><child link="l{k}"/>
<origin xyz="{xyz}"/><axis xyz="{axis}"/><limit lower="{low}" upper="{high}" velocity="{speed}"
effort="100"/></joint><link name="l{k}"><inertial><mass value="1"/><inertia ixx="0.01" ixy="0"
ixz="0" iyy="0.01" iyz="0" izz="0.01"/></inertial></link>"""
#: Carriage on a rail of one metre, with six joints on it: kind, origin, axis, limits, speed.
_ON_A_RAIL = (
    ("prismatic", "0 0 0.3", "0 1 0", -0.5, 0.5, 0.5),
    ("revolute", "0 0 0.1", "0 0 1", -2.8, 2.8, 3.0),
    ("revolute", "0 0 0.2", "0 1 0", -1.8, 1.8, 3.0),
    ("revolute", "0 0 0.4", "0 1 0", -2.5, 2.5, 3.0),
    ("revolute", "0 0 0.2", "0 0 1", -2.8, 2.8, 5.0),
    ("revolute", "0 0 0.2", "0 1 0", -2.0, 2.0, 5.0),
    ("revolute", "0 0 0.1", "0 0 1", -3.1, 3.1, 5.0),
)
#: Five joints as in small arms, whose reachable poses leave one of six coordinates free; and eight.
_MADE = {
    "on a rail": _ON_A_RAIL,
    "five joints": (
        ("revolute", "0 0 0.1", "0 0 1", -2.0, 2.0, 3.0),
        ("revolute", "0 0 0.05", "0 1 0", -1.8, 1.8, 3.0),
        ("revolute", "0 0 0.25", "0 1 0", -2.0, 2.0, 3.0),
        ("revolute", "0 0 0.25", "0 1 0", -1.7, 1.7, 5.0),
        ("revolute", "0 0 0.1", "0 0 1", -2.8, 2.8, 5.0),
    ),
    "eight joints": (
        *_ON_A_RAIL[:4],
        ("revolute", "0 0 0.2", "0 0 1", -2.8, 2.8, 3.0),
        *_ON_A_RAIL[4:],
    ),
}


def described() -> Path | None:
    """Return the folder of the robot descriptions, if they are installed."""
    try:
        files = distribution("example-robot-data").files or []
    except PackageNotFoundError:
        return None
    found = [f for f in files if str(f).endswith(DESCRIBED["panda"][0])]
    return Path(str(found[0].locate())).parents[2] if found else None


def arms(models: Path | None) -> dict[str, tuple[ArmModel, MultibodyPlant, Frame]]:
    found = {}
    plant = MultibodyPlant(0.0)
    instance = ParseSlave(plant).instance
    finalize_without_limit_warnings(plant)
    found["rx90"] = ArmModelFromPlant(plant, instance), plant, plant.GetFrameByName("sensor")
    with tempfile.TemporaryDirectory() as folder:
        files = {}
        for name, chain in _MADE.items():
            joints = [
                _JOINT.format(
                    k=k, i=k - 1, kind=kind, xyz=xyz, axis=axis, low=low, high=high, speed=v
                )
                for k, (kind, xyz, axis, low, high, v) in enumerate(chain, start=1)
            ]
            path = Path(folder) / f"{name.replace(' ', '_')}.urdf"
            path.write_text(f'<robot name="made"><link name="l0"/>{"".join(joints)}</robot>')
            files[name] = path, f"l{len(chain)}"
        if models is not None:
            files |= {name: (models / file, frame) for name, (file, frame) in DESCRIBED.items()}
        for name, (path, frame) in files.items():
            plant = MultibodyPlant(0.0)
            model = ParseModel(plant, path, frame)
            finalize_without_limit_warnings(plant)
            arm = ArmModelFromPlant(plant, model.instance, frame)
            found[name] = arm, plant, plant.GetFrameByName(frame, model.instance)
    return found


def limits(arm: ArmModel) -> tuple[Array, Array]:
    return np.clip(arm.lower, -np.pi, None), np.clip(arm.upper, None, np.pi)


def pose_of(arm: ArmModel, q: Array) -> Array:
    R, p = np.empty((3, 3)), np.empty(3)
    forward_kinematics(arm.table, q, R, p)
    return np.append(Rotation.from_matrix(R).as_quat(scalar_first=True), p)


def errors(arm: ArmModel, pose: Array, q: Array) -> tuple[float, float]:
    """Return the errors [m], [rad]."""
    found = pose_of(arm, q)
    turn = (
        Rotation.from_quat(pose[:4], scalar_first=True)
        * Rotation.from_quat(found[:4], scalar_first=True).inv()
    )
    return float(np.linalg.norm(pose[4:] - found[4:])), float(turn.magnitude())


def random_poses(arm: ArmModel, poses: int) -> dict[str, Any]:
    lower, upper = limits(arm)
    random, middle = np.random.default_rng(0), (lower + upper) / 2
    statuses: Counter[str] = Counter()
    worst, seconds = np.zeros(2), np.empty(poses)
    for k in range(poses):
        pose = pose_of(arm, random.uniform(lower, upper))
        start = time.thread_time()
        q, status = find_posture(arm, pose, middle)
        seconds[k] = time.thread_time() - start
        statuses[status.name] += 1
        assert (arm.lower <= q).all() and (q <= arm.upper).all()
        if status == IkStatus.OK:
            worst = np.maximum(worst, errors(arm, pose, q))
    return {
        "poses": poses, "statuses": dict(statuses), "worst_m": worst[0], "worst_rad": worst[1],
        "mean_us": 1e6 * seconds.mean(), "largest_us": 1e6 * seconds.max(),
    }  # fmt: skip


#: Postures with the elbow well bent; the last joint but one causes the wrist singularity.
BENT = {
    "rx90": (0.2, -0.5, -1.6, 0.7, 0.0, 0.4),
    "on a rail": (0.1, 0.3, 0.5, 1.4, 0.7, 0.0, 0.4),
    "ur5": (0.3, -1.2, 1.5, -0.8, 0.0, 0.5),
}
ASIDE = (0.0, 1e-6, 1e-3, 0.03)


class Follower:
    """Repeated calls of `follow_pose`, as in a station."""

    def __init__(self, arm: ArmModel, q: Array) -> None:
        self.arm, self.L, self.posture, self.q = arm, orientation_weight_m(arm), q.copy(), q.copy()
        self.max_step = arm.velocity_limit * PERIOD

    def __call__(self, pose: Array) -> int:
        q = np.empty(len(self.q))
        status: int = follow_pose(
            self.arm.table, self.L, pose, self.q, self.arm.lower, self.arm.upper, self.max_step,
            self.posture, PERIOD, MIN_SINGULAR_VALUE_M, MAX_SOLVER_STEPS_PER_COMMAND, q,
        )  # fmt: skip
        self.q = q
        return status


class DrakesFollower:
    """The same with Drake's quadratic program."""

    def __init__(self, arm: ArmModel, plant: MultibodyPlant, frame: Frame, q: Array) -> None:
        self.plant, self.frame, self.q = plant, frame, q.copy()
        self.index, self.context = arm.position_index, plant.CreateDefaultContext()
        self.parameters = DifferentialInverseKinematicsParameters(
            plant.num_positions(), plant.num_velocities()
        )
        self.parameters.set_time_step(PERIOD)
        low, high = plant.GetVelocityLowerLimits(), plant.GetVelocityUpperLimits()
        low[self.index], high[self.index] = -arm.velocity_limit, arm.velocity_limit
        others = np.setdiff1d(np.arange(plant.num_velocities()), self.index)
        low[others] = high[others] = 0.0
        self.parameters.set_joint_velocity_limits((low, high))
        self.parameters.set_nominal_joint_position(self._full(q))
        self.parameters.set_end_effector_angular_speed_limit(1e3)
        self.parameters.set_end_effector_translational_velocity_limits([-1e3] * 3, [1e3] * 3)

    def _full(self, q: Array) -> Array:
        full = np.zeros(self.plant.num_positions())
        full[self.index] = q
        return full

    def __call__(self, pose: Array) -> None:
        self.plant.SetPositions(self.context, self._full(self.q))
        R = Rotation.from_quat(pose[:4], scalar_first=True).as_matrix()
        X = RigidTransform(RotationMatrix(R), pose[4:])
        result = DoDifferentialInverseKinematics(
            self.plant, self.context, X, self.frame, self.parameters
        )
        if result.joint_velocities is not None:
            self.q = self.q + PERIOD * np.array(result.joint_velocities)[self.index]


class DampedLeastSquares:
    """Simple baseline: our kinematics, numpy, one damped step for each command."""

    def __init__(self, arm: ArmModel, q: Array) -> None:
        self.arm, self.q, self.J = arm, q.copy(), np.empty((6, len(q)))

    def __call__(self, pose: Array) -> None:
        jacobian(self.arm.table, self.q, self.J)
        found = pose_of(self.arm, self.q)
        wanted, there = (Rotation.from_quat(x[:4], scalar_first=True) for x in (pose, found))
        e = np.append(pose[4:] - found[4:], (wanted * there.inv()).as_rotvec())
        self.q = self.q + self.J.T @ np.linalg.solve(self.J @ self.J.T + 1e-6 * np.eye(6), e)


class PinocchiosFollower:
    """One step of the loop in Pinocchio's examples, with its frames and its logarithm."""

    def __init__(self, arm: ArmModel, q: Array) -> None:
        import pinocchio as pin

        self.pin, self.model, self.q, last = pin, pin.Model(), q.copy(), 0
        for row in range(arm.num_joints + 1):
            R = arm.table[row, ROTATION_COLUMN:TRANSLATION_COLUMN].reshape(3, 3)
            X = pin.SE3(R, arm.table[row, TRANSLATION_COLUMN:PHI_COLUMN])
            if row < arm.num_joints:
                slides = arm.table[row, IS_PRISMATIC_COLUMN] != 0.0
                kind = pin.JointModelPZ() if slides else pin.JointModelRZ()
                last = self.model.addJoint(last, kind, X, f"j{row}")
        self.frame = self.model.addFrame(pin.Frame("S", last, 0, X, pin.FrameType.OP_FRAME))
        self.data = self.model.createData()

    def __call__(self, pose: Array) -> None:
        pin, model, data = self.pin, self.model, self.data
        wanted = pin.SE3(pin.Quaternion(pose[0], pose[1], pose[2], pose[3]), pose[4:])
        pin.framesForwardKinematics(model, data, self.q)
        off = data.oMf[self.frame].actInv(wanted)
        J = pin.computeFrameJacobian(model, data, self.q, self.frame)
        J = -pin.Jlog6(off.inverse()) @ J
        error = pin.log6(off).vector
        v = -J.T @ np.linalg.solve(J @ J.T + 1e-6 * np.eye(6), error)
        self.q = pin.integrate(model, self.q, v)


def followed(arm: ArmModel, follower: Any, motion: Array) -> dict[str, float]:
    """Follow joint positions (N, n), whose poses are the commands; return the figures."""
    poses = [pose_of(arm, q) for q in motion]
    seconds, worst, step = np.empty(len(poses)), np.zeros(2), 0.0
    for k, pose in enumerate(poses):
        before = follower.q
        start = time.thread_time()
        follower(pose)
        seconds[k] = time.thread_time() - start
        worst = np.maximum(worst, errors(arm, pose, follower.q))
        step = max(step, float((np.abs(follower.q - before) / arm.velocity_limit).max() / PERIOD))
    return {
        "median_us": 1e6 * float(np.median(seconds)), "worst_m": worst[0], "worst_rad": worst[1],
        "speed_share": step, "posture_off": float(np.abs(follower.q - motion[-1]).max()),
    }  # fmt: skip


def wavy(arm: ArmModel, samples: int) -> Array:
    """Return a motion (samples, n) of all joints about a bent posture, at a third of top speed."""
    lower, upper = limits(arm)
    t = PERIOD * np.arange(samples)[:, np.newaxis]
    n = arm.num_joints
    middle = (lower + upper) / 2 + 0.2 * (upper - lower) * np.where(np.arange(n) % 2, 1, -1)
    rate = 2.0 + 0.3 * np.arange(n)
    size = np.minimum(0.1 * (upper - lower), arm.velocity_limit / 3 / rate)
    return middle + size * np.sin(rate * t)


def through_singularity(arm: ArmModel, follower: Any, q: Array) -> dict[str, Any]:
    """Return poses that rotate back and forth about the axis of the lost rotation.

    S rotates by 0.4 rad to either side in two seconds, then rests.
    """
    J, middle = np.empty((6, len(q))), pose_of(arm, q)
    jacobian(arm.table, q, J)
    axis = np.linalg.svd(J)[0][3:, 5]
    axis /= np.linalg.norm(axis)
    wanted = Rotation.from_quat(middle[:4], scalar_first=True)
    worst, step, statuses = np.zeros(2), 0.0, Counter()
    follower.q = q.copy()
    for k in range(6000):
        angle = 0.4 * np.sin(min(k * PERIOD, 2.0) * np.pi)
        turned = Rotation.from_rotvec(angle * axis) * wanted
        pose = np.append(turned.as_quat(scalar_first=True), middle[4:])
        before = follower.q
        statuses[IkStatus(follower(pose)).name] += 1
        last = errors(arm, pose, follower.q)
        worst = np.maximum(worst, last)
        step = max(step, float((np.abs(follower.q - before) / arm.velocity_limit).max() / PERIOD))
    return {
        "speed_share": step, "worst_m": worst[0], "worst_rad": worst[1],
        "last_m": last[0], "last_rad": last[1], "statuses": dict(statuses),
    }  # fmt: skip


class ClosedForm:
    def __init__(self, arm: ArmModel, q: Array) -> None:
        self.arm, self.q = arm, q.copy()

    def __call__(self, pose: Array) -> int:
        q = np.empty(6)
        status: int = solve_pose_command(
            pose, self.q, self.arm.lower, self.arm.upper, InverseKinematics.MAX_JOINT_JUMP_RAD, q
        )
        self.q = q
        return status


def against_the_closed_form(arm: ArmModel, poses: int) -> dict[str, Any]:
    """Return figures from references up to 0.02 rad off, away from damped steps."""
    random, worst, L = np.random.default_rng(1), 0.0, orientation_weight_m(arm)
    statuses: Counter[str] = Counter()
    while statuses.total() < poses:
        q = random.uniform(arm.lower + 0.1, arm.upper - 0.1)
        reference = q + random.uniform(-0.02, 0.02, 6)
        J = np.empty((6, 6))
        jacobian(arm.table, reference, J)
        J[3:] *= L
        if np.linalg.svd(J)[1][5] < 2 * MIN_SINGULAR_VALUE_M:
            continue
        numeric, closed = Follower(arm, reference), ClosedForm(arm, reference)
        numeric.max_step = np.full(6, np.inf)
        pose = pose_of(arm, q)
        statuses[IkStatus(numeric(pose)).name] += 1
        assert closed(pose) == IkStatus.OK
        worst = max(worst, float(np.abs(numeric.q - closed.q).max()))
    return {"statuses": dict(statuses), "largest_difference_rad": worst}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--poses", type=int, default=100_000)
    parser.add_argument(
        "--models", type=Path, default=described(), help="folder example-robot-data/robots"
    )
    parser.add_argument("--arms", help="names of arms, separated by commas (default: all)")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    figures: dict[str, Any] = {}
    for name, (arm, plant, frame) in arms(options.models).items():
        if options.arms and name not in options.arms.split(","):
            continue
        motion = wavy(arm, 4000)
        start = motion[0]
        found = figures[name] = {
            "joints": arm.num_joints,
            "random": random_poses(arm, options.poses),
            "follow": followed(arm, Follower(arm, start), motion),
            "follow_drake": followed(arm, DrakesFollower(arm, plant, frame, start), motion[:1000]),
            "follow_pinocchio": followed(arm, PinocchiosFollower(arm, start), motion[:1000]),
            "follow_numpy": followed(arm, DampedLeastSquares(arm, start), motion[:1000]),
        }
        for aside in ASIDE if name in BENT else ():
            q = np.array(BENT[name])
            q[-2] = aside
            found[f"singular, {aside:g} rad"] = through_singularity(arm, Follower(arm, q), q)
            if name == "rx90":
                found[f"singular closed form, {aside:g} rad"] = through_singularity(
                    arm, ClosedForm(arm, q), q
                )
        if name == "rx90":
            found["closed_form"] = against_the_closed_form(arm, min(options.poses, 20_000))
            found["follow_closed_form"] = followed(arm, ClosedForm(arm, start), motion)
        print(name)
        for what, value in found.items():
            for row in value if isinstance(value, list) else [value]:
                print(f"  {what}: {row}")
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
