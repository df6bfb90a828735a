"""The one-axis numbers of a scenario along a direction of its task, from its models.

They are the plant's truth, for analysis; no estimator may see them.

One axis is the whole station only where a push of the environment turns nothing, as along the tool.
Sideways a push at the tip, 0.2 m away from the sensor, is a torque at the hand, whose wrist yields,
and the tool follows its turn: the tip is some hundred times as soft as the servo makes it, and with
sigma > 0 the tool's moment of inertia is felt as well. `linearization` has all six directions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RollPitchYaw, RotationMatrix
from pydrake.systems.framework import DiagramBuilder

from drake_teleop.common.arrays import checked
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.lab.analysis.one_axis import OneAxis
from drake_teleop.station.environment.point_contact import STIFFNESS
from drake_teleop.station.environment.solids import Wall
from drake_teleop.station.scenario import Scenario, check_scenario
from drake_teleop.station.slave.arm import forward_kinematics, jacobian
from drake_teleop.station.slave.inverse_kinematics import IkStatus, has_closed_form, nearest_branch
from drake_teleop.station.slave.numeric_inverse_kinematics import find_posture
from drake_teleop.station.slave.plant import AddSlavePlant, NominalSlave, SlavePlant
from drake_teleop.station.slave.servo import mass_matrix

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TaskDirection:
    """A direction of the task, at a state of rest.

    Args:
        axis: its numbers.
        hand: (6,) the direction at E, in B: force and velocity of the hand along it.
        tool: (6,) the direction at the tip as a wrench about So, in W. Likewise tool . twist of S
            is the tip's velocity.
        tool_coupling: acceleration of the tool's centre of mass over that of the tip along the
            direction, when the tip is pushed. A push turns the tool as well, so the sensor feels
            tool_coupling m_t in h12 = kf (gamma - tool_coupling M s / (Z_s + C)); h11 has m_t,
            because a command turns nothing.
    """

    axis: OneAxis
    hand: Array
    tool: Array
    tool_coupling: float


def OneAxisFromScenario(
    scenario: Scenario,
    direction: Sequence[float],
    *,
    load_estimate: Array | None = None,
    displacement: Sequence[float] = (0.0, 0.0, 0.0),
) -> OneAxis:
    """The axis of `task_direction`."""
    return task_direction(
        scenario, direction, load_estimate=load_estimate, displacement=displacement
    ).axis


def task_direction(
    scenario: Scenario,
    direction: Sequence[float],
    *,
    load_estimate: Array | None = None,
    displacement: Sequence[float] = (0.0, 0.0, 0.0),
) -> TaskDirection:
    """What a scenario is along one direction.

    Masses are those of bodies that are free in all other directions: 1 / (n' J M^-1 J' n).

    Args:
        scenario: its delay is the mean of both ways, its environment the leaf, if it has one.
        direction: (3,) of the slave's motion in W, of any length.
        load_estimate: (16,) as for `MakeTeleopStation`; None: without error.
        displacement: of the master from its start [m], in B; the slave follows.

    Raises:
        DrakeTeleopError: for a direction of length zero, a pose out of reach, or gripper and object
            that are scaled differently.
    """
    check_scenario(scenario)
    n_W = checked("direction", direction, 3)
    if not np.linalg.norm(n_W) > 0.0:
        raise DrakeTeleopError("a direction of length zero", where="direction")
    sigma, sigma_object, gamma = scenario.force_scaling.scales()
    if sigma != sigma_object:
        raise DrakeTeleopError(
            "gripper and object are scaled differently: there is no one sigma",
            where="force_scaling.eta",
            remedy="set eta: null",
        )
    n_W = n_W / np.linalg.norm(n_W)
    scaling, hand = scenario.kinematic_scaling, scenario.operator.hand
    R_WB = RollPitchYaw(scaling.alignment).ToRotationMatrix().matrix()
    moved_B = checked("displacement", displacement, 3)
    hand_B = np.concatenate([R_WB.T @ n_W, np.zeros(3)])
    device_mass, device_damping = _device(scenario, moved_B, hand_B)
    slave = NominalSlave(scenario.slave)
    arm = slave.arm
    moved_W = scaling.translation_scale * R_WB @ moved_B
    q = _slave_posture(slave, moved_W)
    J, R_WS, p_WS = np.empty((6, arm.num_joints)), np.empty((3, 3)), np.empty(3)
    jacobian(arm.table, q, J)
    forward_kinematics(arm.table, q, R_WS, p_WS)
    tool_W = np.concatenate([n_W, np.cross(R_WS @ slave.tip, n_W)])
    # Acceleration of S for a unit push at the tip, while no motor reacts.
    a, alpha = np.split(J @ np.linalg.solve(mass_matrix(arm, q), J.T @ tool_W), 2)
    mass, first_moment_S = arm.phi_load[0], arm.phi_load[1:4]
    mobility = tool_W @ np.concatenate([a, alpha])
    mass_acceleration = n_W @ (a + np.cross(alpha, R_WS @ first_moment_S / mass))
    servo, sheet = scenario.joint_control, scenario.leaf
    servo.check_is_torque("the model of one axis")
    scenario.master.check_leads_the_pose("the model of one axis")
    forward, backward = scenario.channel.lines()
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
        delay=0.5 * (forward.delay + backward.delay),
        wall_stiffness=_wall_stiffness(scenario),
        wall_damping=0.0 if sheet is None else float(sheet.damping),
    )
    return TaskDirection(axis, hand_B, tool_W, float(mass_acceleration / mobility))


def _wall_stiffness(scenario: Scenario) -> float:
    """Of the leaf, or of a wall and the tool's ball in series [N/m]; 0 for anything else."""
    if scenario.leaf is not None:
        return float(scenario.leaf.stiffness)
    wall = scenario.surroundings
    if not isinstance(wall, Wall):
        return 0.0
    pairs = AddSlavePlant(DiagramBuilder(), scenario.slave, wall).contact_pairs
    return float(pairs[:, STIFFNESS].sum())


def _device(scenario: Scenario, moved_B: Array, n: Array) -> tuple[float, float]:
    """Mass [kg] and damping [N s/m] of the device along n (6,), without the hand's mass."""
    hand = scenario.operator.hand
    start = np.array([1.0, 0.0, 0.0, 0.0, *scenario.master.position])
    start[4:] += moved_B
    device = scenario.master.device(hand.mass, hand.inertia)
    q = device.inverse_kinematics(start)
    J, M = device.jacobian(q), device.mass_matrix(q)
    rate = np.linalg.solve(M, J.T @ n)  # of the joints, for a unit push
    mobility = n @ J @ rate
    damping = rate @ device.damping_matrix(q) @ rate / mobility**2
    return float(1 / mobility - hand.mass), float(damping)


def _slave_posture(slave: SlavePlant, moved: Array) -> Array:
    arm, pose = slave.arm, slave.X_WS_start.copy()
    pose[4:] += moved
    if has_closed_form(arm):
        R_WS = RotationMatrix(Quaternion(pose[:4] / np.linalg.norm(pose[:4]))).matrix()
        q, status = nearest_branch(R_WS, pose[4:], slave.start, arm.lower, arm.upper)
    else:
        q, status = find_posture(arm, pose, slave.start)
    if status != IkStatus.OK:
        raise DrakeTeleopError(
            f"the arm cannot follow by {moved} m ({IkStatus(status).name})", where="displacement"
        )
    return q
