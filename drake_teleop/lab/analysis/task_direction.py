"""Parameters of the one-axis model along a task direction.

One axis represents the station only if forces on the tip do not rotate the tool.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array, finite_array
from drake_teleop.lab.analysis.one_axis import OneAxis
from drake_teleop.station.channel.network import mean_delay
from drake_teleop.station.environment.point_contact import PAIR_STIFFNESS_COLUMN
from drake_teleop.station.environment.solids import Wall
from drake_teleop.station.scenario import Scenario, check_scenario
from drake_teleop.station.slave.arm import forward_kinematics, jacobian
from drake_teleop.station.slave.inverse_kinematics import IkStatus, has_closed_form, nearest_branch
from drake_teleop.station.slave.joint_control import mass_matrix
from drake_teleop.station.slave.numeric_inverse_kinematics import find_posture
from drake_teleop.station.slave.plant import AddSlavePlant, NominalSlave, SlavePlant


@dataclass(frozen=True, eq=False)
class TaskDirection:
    """Task direction at a state of rest, with one-axis parameters and directions at both ends."""

    axis: OneAxis
    hand: Array  #: (6,) direction of the hand's force and velocity at E, in B
    #: (6,) wrench about So, in W, of a unit force at the tip; tool . twist is the tip's velocity.
    tool: Array
    #: Acceleration of the tool's centre of mass over that of the tip, for a force at the tip:
    #: h12 = kf (gamma - tool_coupling M s / (Z_s + C)).
    tool_coupling: float


def OneAxisFromScenario(scenario: Scenario, direction: Sequence[float]) -> OneAxis:
    """Return the one-axis parameters of a scenario along a direction (3,) of slave motion, in W."""
    return task_direction(scenario, direction).axis


def task_direction(
    scenario: Scenario,
    direction: Sequence[float],
    *,
    load_estimate: Array | None = None,
    displacement: Sequence[float] = (0.0, 0.0, 0.0),
) -> TaskDirection:
    """Return a `TaskDirection` of a scenario for a direction (3,) of slave motion, in W.

    `displacement` of the master [m] from its start is in its base frame B. Without `load_estimate`
    (16,) the tool mass has no error.
    """
    check_scenario(scenario)
    n_W = finite_array("direction", direction, 3)
    if not np.linalg.norm(n_W) > 0.0:
        raise DrakeTeleopError("has length zero", where="direction", remedy="give another vector")
    sigma, sigma_object, gamma = scenario.force_scaling.scales()[:3]
    if sigma != sigma_object:
        what = f"sets sigma {sigma:g} for gripper, {sigma_object:g} for object (must be equal)"
        raise DrakeTeleopError(what, where="force_scaling.eta", remedy="set eta: null")
    n_W = n_W / np.linalg.norm(n_W)
    scaling, hand = scenario.kinematic_scaling, scenario.operator.hand
    R_WB = scaling.R_WB
    displacement_B = finite_array("displacement", displacement, 3)
    hand_B = np.concatenate([R_WB.T @ n_W, np.zeros(3)])
    device_mass, device_damping = _device_mass_and_damping(scenario, displacement_B, hand_B)
    slave = NominalSlave(scenario.slave)
    arm = slave.arm
    displacement_W = scaling.translation_scale * R_WB @ displacement_B
    q = _find_displaced_posture(slave, displacement_W)
    J, R_WS, p_WS = np.empty((6, arm.num_joints)), np.empty((3, 3)), np.empty(3)
    jacobian(arm.table, q, J)
    forward_kinematics(arm.table, q, R_WS, p_WS)
    tool_W = np.concatenate([n_W, np.cross(R_WS @ slave.tip, n_W)])
    # Acceleration of S for a unit force at the tip, without motor torques.
    a, alpha = np.split(J @ np.linalg.solve(mass_matrix(arm, q), J.T @ tool_W), 2)
    mass, first_moment_S = arm.phi_load[0], arm.phi_load[1:4]
    mobility = tool_W @ np.concatenate([a, alpha])
    mass_acceleration = n_W @ (a + np.cross(alpha, R_WS @ first_moment_S / mass))
    servo, sheet = scenario.joint_control, scenario.first_sheet_spring
    servo.require_computed_torque("the model of one axis")
    scenario.master.check_pose_mode("the model of one axis")
    axis = OneAxis(
        hand_mass=hand.mass,
        hand_damping=hand.damping,
        hand_stiffness=hand.stiffness,
        device_mass=device_mass,
        device_damping=device_damping,
        slave_mass=float(1 / mobility),
        position_gain=2 * np.pi * servo.position_bandwidth_hz,
        velocity_gain=2 * np.pi * servo.velocity_bandwidth_hz,
        tool_mass=float(mass),
        mass_error=0.0 if load_estimate is None else float(load_estimate[6] - mass),
        force_scale=scenario.force_scaling.force_scale,
        position_scale=scaling.translation_scale,
        sigma=sigma,
        gamma=gamma,
        delay=0.5 * sum(map(mean_delay, scenario.channel.networks_of_directions())),
        wall_stiffness=_environment_stiffness(scenario),
        wall_damping=0.0 if sheet is None else float(sheet.damping),
    )
    return TaskDirection(axis, hand_B, tool_W, float(mass_acceleration / mobility))


def check_can_press(scenario: Scenario) -> None:
    """Raise DrakeTeleopError for a translation or force scale of 0."""
    for block, name, lack in (
        ("kinematic_scaling", "translation_scale", "the slave cannot press"),
        ("force_scaling", "force_scale", "the hand receives no force"),
    ):
        if getattr(getattr(scenario, block), name) == 0.0:
            what, remedy = f"is 0, so that {lack}", "choose a scale above 0"
            raise DrakeTeleopError(what, where=f"{block}.{name}", remedy=remedy)


def _environment_stiffness(scenario: Scenario) -> float:
    if scenario.first_sheet_spring is not None:
        return float(scenario.first_sheet_spring.stiffness)
    wall = scenario.surroundings
    if not isinstance(wall, Wall):
        return 0.0
    pairs = AddSlavePlant(DiagramBuilder(), scenario.slave, wall).contact.compiled_pairs
    return float(pairs[:, PAIR_STIFFNESS_COLUMN].sum())


def _device_mass_and_damping(
    scenario: Scenario, displacement_B: Array, direction_B: Array
) -> tuple[float, float]:
    hand = scenario.operator.hand
    start = np.array([1.0, 0.0, 0.0, 0.0, *scenario.master.position])
    start[4:] += displacement_B
    device = scenario.master.device(hand.mass, hand.inertia)
    q = device.inverse_kinematics(start)
    J, M = device.jacobian(q), device.mass_matrix(q)
    rate = np.linalg.solve(M, J.T @ direction_B)  # of the joints, for a unit force
    mobility = direction_B @ J @ rate
    damping = rate @ device.damping_matrix(q) @ rate / mobility**2
    return float(1 / mobility - hand.mass), float(damping)


def _find_displaced_posture(slave: SlavePlant, displacement_W: Array) -> Array:
    arm, pose = slave.arm, slave.X_WS_start.copy()
    pose[4:] += displacement_W
    if has_closed_form(arm):
        R_WS = RotationMatrix(Quaternion(pose[:4] / np.linalg.norm(pose[:4]))).matrix()
        q, status = nearest_branch(R_WS, pose[4:], slave.start, arm.lower, arm.upper)
    else:
        q, status = find_posture(arm, pose, slave.start)
    if status != IkStatus.OK:
        reason = IkStatus(status).name
        what = f"the arm cannot reach this displacement of {displacement_W} m ({reason})"
        remedy = "choose a smaller displacement or another start posture"
        raise DrakeTeleopError(what, where="displacement", remedy=remedy)
    return q
