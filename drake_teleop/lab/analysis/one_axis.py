"""One task direction of the station: the numbers that every linear model of it is made of.

Hand, device, slave with its servo, tool and environment along one axis:

    Z_h = m_h s + b_h + k_h / s            hand
    Z_m = m_m s + b_m                      device
    Z_s = m_s s + m_s k_v                  slave, tool included, with the damping of its servo
    C   = m_s k_v k_p / s                  the servo's spring between command and slave
    Z_e = b_e + k_e / s                    environment

The servo is that of `slave.joint_control`: computed torque for the acceleration
k_v (k_p (x_command - x) - v).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Complex = NDArray[np.complex128]


@dataclass(frozen=True, kw_only=True)
class Axis:
    """What every model of one direction has: hand, slave with its servo, tool, wall.

    The defaults are those of the paper's station, held with a medium grip.

    Args:
        hand_mass, hand_damping, hand_stiffness: [kg], [N s/m], [N/m].
        device_mass: [kg].
        slave_mass: effective mass of arm and tool where the environment pushes [kg].
        position_gain, velocity_gain: k_p, k_v of the servo [1/s].
        ideal_servo: the slave is where it is told to be.
        tool_mass: beyond the sensor [kg].
        force_scale: k_f, slave to master.
        sigma, gamma: of the elimination.
        wall_stiffness: of the environment [N/m].
    """

    hand_mass: float = 0.25
    hand_damping: float = 8.0
    hand_stiffness: float = 250.0
    device_mass: float = 0.15
    slave_mass: float = 15.13
    position_gain: float = 2 * np.pi * 12.0
    velocity_gain: float = 2 * np.pi * 70.0
    ideal_servo: bool = False
    tool_mass: float = 3.13
    force_scale: float = 1 / 17.5
    sigma: float = 0.0
    gamma: float = 1.0
    wall_stiffness: float = 5100.0

    @property
    def servo_stiffness(self) -> float:
        """m_s k_v k_p [N/m], between the command and the slave."""
        return self.slave_mass * self.velocity_gain * self.position_gain

    @property
    def servo_damping(self) -> float:
        """m_s k_v [N s/m], between the slave and the world."""
        return self.slave_mass * self.velocity_gain


@dataclass(frozen=True, kw_only=True)
class OneAxis(Axis):
    """One direction of the linear analysis.

    Args:
        device_damping: [N s/m].
        mass_error: of the estimate, estimated minus true tool mass [kg].
        position_scale: l_p, master to slave.
        delay: of the network, one way [s].
        wall_damping: of the environment [N s/m].
    """

    device_damping: float = 0.5
    mass_error: float = 0.0
    position_scale: float = 1.0
    delay: float = 0.0
    wall_damping: float = 0.0

    @property
    def felt_tool_mass(self) -> float:
        """M = sigma m_t + (sigma - gamma) dm [kg], what the elimination leaves of the tool."""
        return self.sigma * self.tool_mass + (self.sigma - self.gamma) * self.mass_error


def hand_impedance(axis: OneAxis, s: Complex) -> Complex:
    """Z_h [N s/m] at s [rad/s]."""
    return axis.hand_mass * s + axis.hand_damping + axis.hand_stiffness / s


def device_impedance(axis: OneAxis, s: Complex) -> Complex:
    """Z_m [N s/m] at s [rad/s]."""
    return axis.device_mass * s + axis.device_damping


def environment_impedance(axis: OneAxis, s: Complex) -> Complex:
    """Z_e [N s/m] at s [rad/s]."""
    return axis.wall_damping + axis.wall_stiffness / s


def servo_response(axis: OneAxis, s: Complex) -> Complex:
    """C / (Z_s + C), slave over command: k_v k_p / (s^2 + k_v s + k_v k_p); 1 if ideal."""
    if axis.ideal_servo:
        return np.ones_like(s)
    gain = axis.velocity_gain * axis.position_gain
    return gain / (s**2 + axis.velocity_gain * s + gain)


def servo_admittance(axis: OneAxis, s: Complex) -> Complex:
    """1 / (Z_s + C) [m/(N s)], by which the slave gives way; 0 if ideal."""
    if axis.ideal_servo:
        return np.zeros_like(s)
    kv, kp = axis.velocity_gain, axis.position_gain
    return s / (axis.slave_mass * (s**2 + kv * s + kv * kp))
