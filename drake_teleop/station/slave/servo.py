"""Arm and joint control as one servo at the tool, for the passivity methods."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_teleop.station.slave.arm import (
    ArmModel,
    forward_dynamics,
    holding_torque,
    inverse_dynamics,
    jacobian,
)
from drake_teleop.station.slave.joint_control import JointControlConfig

Array = NDArray[np.float64]


def mass_matrix(arm: ArmModel, q: Array) -> Array:
    """Return M(q) (n, n) with rotors and tool, by inverse dynamics of unit accelerations."""
    zeros, weight = np.zeros(len(q)), holding_torque(arm, q)
    columns = np.empty((len(q), len(q)))
    for unit, column in zip(np.eye(len(q)), columns, strict=True):
        inverse_dynamics(arm.table, q, zeros, unit, column)
        column -= weight
    return columns.T


def operational_inertia(arm: ArmModel, q: Array) -> Array:
    """Return Lambda = (J M^-1 J^T)^-1 (6, 6) at So, translation first, in W; q is not singular.

    Khatib, A unified approach for motion and force control of robot manipulators (1987).
    """
    n = arm.num_joints
    still, J = np.zeros(n), np.empty((6, n))
    mobility, rates = np.empty((n, n)), np.empty(n)
    forward_dynamics(arm.table, q, still, still, np.zeros(6), rates)
    falling = rates.copy()
    for i, torque in enumerate(np.eye(n)):
        forward_dynamics(arm.table, q, still, torque, np.zeros(6), rates)
        mobility[i] = rates - falling
    jacobian(arm.table, q, J)
    return np.linalg.inv(J @ mobility @ J.T)


class ServoAtTool(NamedTuple):
    """Servo with the wrench K (x_command - x) - D v; two values each, translation and rotation.

    Attributes:
        stiffness: K [N/m, N m/rad].
        damping: D [N s/m, N m s/rad].
        mass: of arm and tool [kg, kg m^2].
    """

    stiffness: list[float]
    damping: list[float]
    mass: list[float]


def servo_at_tool(arm: ArmModel, q: Array, config: JointControlConfig) -> ServoAtTool:
    """Return stiffness, damping and mass of the slave for the passivity methods.

    Mass m and inertia J are the smallest common multiple of the largest eigenvalues of the two
    blocks of Lambda with diag(m, m, m, J, J, J) >= Lambda. They bound the kinetic energy of any
    motion. The joint loops accelerate with kv (kp (x_command - x) - v), hence K and D.

    Raises:
        DrakeTeleopError: for a servo other than computed torque.
    """
    config.check_computed_torque("the servo model of the passivity methods")
    inertia = operational_inertia(arm, q)
    blocks = [np.linalg.eigvalsh(inertia[i : i + 3, i : i + 3])[-1] for i in (0, 3)]
    unit = 1 / np.sqrt(np.repeat(blocks, 3))
    mass = np.linalg.eigvalsh(unit[:, np.newaxis] * inertia * unit)[-1] * np.array(blocks)
    kp, kv = (
        2 * np.pi * hertz for hertz in (config.position_bandwidth_hz, config.velocity_bandwidth_hz)
    )
    return ServoAtTool((kp * kv * mass).tolist(), (kv * mass).tolist(), mass.tolist())
