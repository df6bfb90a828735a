"""Two arms other than the station's, and their simulated execution of a trajectory."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import PdControllerGains, SpatialInertia, WeldJoint
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import TrajectorySource
from pydrake.trajectories import PiecewisePolynomial

from drake_teleop.load.regressor import non_contact_wrench
from drake_teleop.station.slave.models import ParseModel

# Step [s]; rest before the motion without and with recording, and after it [s].
_STEP, _SETTLING, _RESTING = 2e-4, 0.5, 0.2


def write_urdf(folder: Path) -> Path:
    """Write six joints with a free base, a gripper with a finger, and existing and missing meshes.

    No joint has an acceleration limit; one is continuous, one has no speed limit.
    """
    package = folder / "somewhere" / "parts"
    package.mkdir(parents=True)
    (package / "forearm.obj").write_text(
        "".join(
            f"v {x} {y} {z}\n" for x in (-0.03, 0.03) for y in (-0.03, 0.03) for z in (0.02, 0.28)
        )
        + "f 1 2 4 3\nf 5 6 8 7\nf 1 2 6 5\nf 3 4 8 7\nf 1 3 7 5\nf 2 4 8 6\n"
    )

    triangles = np.zeros(
        4, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")]
    )
    points = np.array([[-0.03, -0.03, 0.0], [0.03, -0.03, 0.0], [0, 0.04, 0.0], [0, 0, 0.05]])
    triangles["corners"] = points[[[0, 1, 2], [0, 1, 3], [1, 2, 3], [2, 0, 3]]]
    (package / "wrist.stl").write_bytes(
        bytes(80) + len(triangles).to_bytes(4, "little") + triangles.tobytes()
    )

    def link(name: str, mass: float, shape: str, length: float) -> str:
        return (
            f'<link name="{name}"><inertial><origin xyz="0 0 {length / 2}"/><mass value="{mass}"/>'
            f'<inertia ixx="{0.02 * mass}" ixy="0" ixz="0" iyy="{0.02 * mass}" iyz="0"'
            f' izz="{0.005 * mass}"/></inertial><collision><origin xyz="0 0 {length / 2}"/>'
            f"<geometry>{shape}</geometry></collision></link>"
        )

    def joint(k: int, xyz: str, axis: str, limit: str, kind: str = "revolute") -> str:
        return (
            f'<joint name="j{k}" type="{kind}"><parent link="l{k - 1}"/><child link="l{k}"/>'
            f'<origin xyz="{xyz}"/><axis xyz="{axis}"/><limit {limit}/></joint>'
        )

    rod = '<cylinder radius="0.04" length="0.2"/>'
    links = [
        link("l0", 5, '<box size="0.2 0.2 0.1"/>', 0.1),
        link("l1", 4, rod, 0.2),
        link("l2", 4, rod, 0.35),
        link("l3", 3, '<mesh filename="package://parts/forearm.obj"/>', 0.0),
        link("l4", 1, '<mesh filename="package://absent/wrist.stl"/>', 0.05),
        link("l5", 1, '<mesh filename="package://parts/wrist.stl"/>', 0.0),
        link("l6", 0.3, '<cylinder radius="0.03" length="0.04"/>', 0.04),
        link("gripper", 0.8, '<box size="0.04 0.1 0.06"/>', 0.06),
        link("finger", 0.1, '<box size="0.01 0.01 0.05"/>', 0.05),
    ]
    wide = 'lower="-2.9" upper="2.9" velocity="3" effort="200"'
    joints = [
        joint(1, "0 0 0.15", "0 0 1", wide),
        joint(2, "0 0 0.25", "0 1 0", 'lower="-1.9" upper="1.9" velocity="2.5" effort="200"'),
        joint(3, "0 0 0.4", "0 1 0", 'lower="0.1" upper="2.6" velocity="3" effort="150"'),
        joint(4, "0 0 0.3", "0 0 1", 'velocity="5" effort="30"', "continuous"),
        joint(5, "0 0 0.1", "0 1 0", 'lower="-2" upper="2" velocity="0" effort="30"'),
        joint(6, "0 0 0.1", "0 0 1", 'lower="-3" upper="3" velocity="6" effort="15"'),
    ]
    fixed = (
        '<joint name="mount" type="fixed"><parent link="l6"/><child link="gripper"/>'
        '<origin xyz="0 0 0.04"/></joint>'
        '<joint name="slide" type="prismatic"><parent link="gripper"/><child link="finger"/>'
        '<origin xyz="0 0 0.06"/><axis xyz="0 1 0"/>'
        '<limit lower="0" upper="0.04" velocity="1" effort="20"/></joint>'
    )
    path = folder / "arm.urdf"
    path.write_text(f'<robot name="six">{"".join(links + joints)}{fixed}</robot>')
    return path


def write_sdf(folder: Path) -> Path:
    """Write seven joints with all limits; the last link has the frame `wrist`."""
    links, joints, z = [], [], 0.0
    axes = ("0 0 1", "0 1 0", "0 0 1", "0 1 0", "0 0 1", "0 1 0", "0 0 1")
    reach = (0.16, 0.2, 0.2, 0.2, 0.2, 0.2, 0.1)
    for k, length in enumerate((0.12, *reach)):
        mass = 4.0 if k < 5 else 1.0
        links.append(
            f'<link name="l{k}"><pose>0 0 {z} 0 0 0</pose><inertial><mass>{mass}</mass>'
            f"<inertia><ixx>{0.02 * mass}</ixx><iyy>{0.02 * mass}</iyy><izz>{0.01 * mass}</izz>"
            '</inertia></inertial><visual name="v"><pose>0 0 0.07 0 0 0</pose><geometry>'
            "<capsule><radius>0.05</radius><length>0.06</length></capsule></geometry></visual>"
            "</link>"
        )
        z += length
        if k == 7:
            break
        joints.append(
            f'<joint name="j{k + 1}" type="revolute"><parent>l{k}</parent><child>l{k + 1}</child>'
            f"<axis><xyz>{axes[k]}</xyz><limit><lower>-2.2</lower><upper>2.2</upper>"
            f"<velocity>{2 + k / 2}</velocity><effort>{200 - 20 * k}</effort>"
            f"<drake:acceleration>{10 + 2 * k}</drake:acceleration></limit></axis></joint>"
        )
    frame = '<frame name="wrist" attached_to="l7"><pose>0 0 0.12 0 0 0.5</pose></frame>'
    path = folder / "arm.sdf"
    path.write_text(
        '<?xml version="1.0"?><sdf version="1.9" xmlns:drake="drake.mit.edu"><model name="seven">'
        f"{''.join(links + joints)}{frame}</model></sdf>"
    )
    return path


@dataclass(frozen=True, eq=False)
class Recording:
    """Executed motion at 1 kHz.

    Attributes:
        t: (N,) [s], from 0.2 s before the trajectory to 0.2 s after it.
        q: (N, n) joint angles [rad].
        truth: (N, 15 + n) input of a sensor at S, see `sensor_chain.read_sensor_into`.
        pose: (N, 7) [quaternion wxyz, position] of S in the world.
        phi: (10,) load about the origin of S.
    """

    t: np.ndarray
    q: np.ndarray
    truth: np.ndarray
    pose: np.ndarray
    phi: np.ndarray


def execute(path: Path, frame: str, table: pl.DataFrame, load: SpatialInertia) -> Recording:
    """Simulate an exported trajectory with stiff servos and an extra body on the sensor frame."""
    builder = DiagramBuilder()
    plant = builder.AddSystem(MultibodyPlant(_STEP))
    model = ParseModel(plant, path, frame)
    frame_S = model.sensor_frame
    body = plant.AddRigidBody("load", model.instance, load)
    plant.AddJoint(WeldJoint("load", frame_S, body.body_frame(), RigidTransform.Identity()))
    joints = [plant.get_joint(k) for k in plant.GetJointIndices(model.instance)]
    moving = [joint for joint in joints if joint.num_positions() == 1]
    for joint in moving:
        if not plant.HasJointActuatorNamed(joint.name(), model.instance):
            plant.AddJointActuator(joint.name(), joint)
        actuator = plant.GetJointActuatorByName(joint.name(), model.instance)
        actuator.set_controller_gains(PdControllerGains(p=2e4, d=2e2))
    plant.Finalize()
    order = [plant.get_joint_actuator(k).joint() for k in plant.GetJointActuatorIndices()]
    commanded = np.zeros((table.height, 3, len(order)))
    for k, joint in enumerate(order):
        if f"q_{joint.name()}" in table.columns:
            for row, symbol in enumerate(("q", "qd", "qdd")):
                commanded[:, row, k] = table[f"{symbol}_{joint.name()}"]
    # Rest before and after.
    start, period = _SETTLING + _RESTING, table["t"][-1]
    times = np.concatenate([[0.0], start + table["t"].to_numpy(), [start + period + 1.0]])
    commanded = commanded[[0, *range(table.height), -1]]
    commands = builder.AddSystem(
        TrajectorySource(
            # Corners would alias into samples of the same rate.
            PiecewisePolynomial.CubicHermite(
                times,
                commanded[:, :2].reshape(len(times), -1).T,
                commanded[:, 1:].reshape(len(times), -1).T,
            )
        )
    )
    builder.Connect(commands.get_output_port(), plant.get_desired_state_input_port(model.instance))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    q = plant.GetPositions(context)
    q[[joint.position_start() for joint in order]] = commanded[0, 0]
    plant.SetPositions(context, q)
    chain = [joint for joint in order if f"q_{joint.name()}" in table.columns]
    t = np.arange(round((period + 2 * _RESTING) * 1e3) + 1) * 1e-3
    truth, pose = np.empty((len(t), 15 + len(chain))), np.empty((len(t), 7))
    for k, moment in enumerate(t):
        simulator.AdvanceTo(_SETTLING + moment)
        truth[k, 6:15] = _motion_of(plant, context, frame_S)
        truth[k, 15:] = [joint.GetOnePosition(context) for joint in chain]
        X_WS = frame_S.CalcPoseInWorld(context)
        pose[k] = [*X_WS.rotation().ToQuaternion().wxyz(), *X_WS.translation()]
    bodies = [body.index() for body in _beyond(joints, frame_S.body())]
    M_S = plant.CalcSpatialInertia(context, frame_S, bodies)
    inertia = M_S.CalcRotationalInertia().CopyToFullMatrix3()
    phi = np.array([M_S.get_mass(), *M_S.CalcComMoment(), *inertia[np.triu_indices(3)]])
    truth[:, :6] = non_contact_wrench(*np.split(truth[:, 6:15], 3, axis=1), phi)
    return Recording(t - _RESTING, truth[:, 15:], truth, pose, phi)


def _beyond(joints, body):
    found = [joint.child_body() for joint in joints if joint.parent_body() == body]
    return found + [far for near in found for far in _beyond(joints, near)]


def _motion_of(plant, context, frame_S):
    """Return (9,) specific force, angular velocity and acceleration of S, in S.

    Velocities are those in the middle of the step in which the accelerations act.
    """
    v = plant.GetVelocities(context)
    port = plant.get_generalized_acceleration_output_port(frame_S.model_instance())
    vdot = port.Eval(context)
    plant.SetVelocities(context, v + 0.5 * _STEP * vdot)
    X_WS, X_BS = frame_S.CalcPoseInWorld(context), frame_S.GetFixedPoseInBodyFrame()
    A_WB = plant.CalcSpatialAccelerationsFromVdot(context, vdot)[frame_S.body().index()]
    omega = plant.EvalBodySpatialVelocityInWorld(context, frame_S.body()).rotational()
    R_WB = plant.EvalBodyPoseInWorld(context, frame_S.body()).rotation()
    plant.SetVelocities(context, v)
    A_WS = A_WB.Shift(R_WB.multiply(X_BS.translation()), omega)
    s = A_WS.translational() - plant.gravity_field().gravity_vector()
    R_SW = X_WS.rotation().inverse()
    return np.concatenate([R_SW.multiply(x) for x in (s, omega, A_WS.rotational())])
