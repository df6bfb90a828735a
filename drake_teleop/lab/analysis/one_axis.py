"""One task direction of the station: parameters and impedances of all linear models (T50).

    Z_h = m_h s + b_h + k_h / s            hand
    Z_m = m_m s + b_m                      device
    Z_s = m_s s + m_s k_v                  slave, tool included, with the damping of its servo
    C   = m_s k_v k_p / s                  the servo's spring between command and slave
    Z_e = b_e + k_e / s                    environment

The servo (`slave.joint_control`) commands the acceleration k_v (k_p (x_command - x) - v).
Impedances are in N s/m, s in rad/s.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Complex = NDArray[np.complex128]


@dataclass(frozen=True, kw_only=True)
class AxisParameters:
    """Parameters common to all models of one direction; default: paper's station, medium grip.

    sigma and gamma are the displayed shares of the tool's inertial force and of the contact force.
    """

    hand_mass: float = 0.25  #: kg
    hand_damping: float = 8.0  #: N s/m
    hand_stiffness: float = 250.0  #: N/m
    device_mass: float = 0.15  #: kg
    slave_mass: float = 15.13  #: kg, effective at the contact point, tool included
    position_gain: float = 2 * np.pi * 12.0  #: k_p [1/s]
    velocity_gain: float = 2 * np.pi * 70.0  #: k_v [1/s]
    ideal_servo: bool = False  #: the slave follows its command exactly
    tool_mass: float = 3.13  #: kg, beyond the sensor
    force_scale: float = 1 / 17.5  #: k_f, slave to master
    sigma: float = 0.0
    gamma: float = 1.0
    wall_stiffness: float = 5100.0  #: N/m

    @property
    def servo_stiffness(self) -> float:
        return self.slave_mass * self.velocity_gain * self.position_gain

    @property
    def servo_damping(self) -> float:
        return self.slave_mass * self.velocity_gain


@dataclass(frozen=True, kw_only=True)
class OneAxis(AxisParameters):
    """One-axis parameters, also damping of device and wall, mass error, motion scale, delay.

    Fields may be arrays, which broadcast.
    """

    device_damping: float = 0.5  #: N s/m
    mass_error: float = 0.0  #: kg, estimated minus true tool mass
    position_scale: float = 1.0  #: l_p, master to slave
    delay: float = 0.0  #: s, one way
    wall_damping: float = 0.0  #: N s/m

    @property
    def displayed_tool_mass(self) -> float:
        """Tool mass [kg] in the displayed force after subtraction of the estimated mass."""
        return self.sigma * self.tool_mass + (self.sigma - self.gamma) * self.mass_error


def hand_impedance(axis: OneAxis, s: Complex) -> Complex:
    return axis.hand_mass * s + axis.hand_damping + axis.hand_stiffness / s


def device_impedance(axis: OneAxis, s: Complex) -> Complex:
    return axis.device_mass * s + axis.device_damping


def environment_impedance(axis: OneAxis, s: Complex) -> Complex:
    return axis.wall_damping + axis.wall_stiffness / s


def servo_response(axis: OneAxis, s: Complex) -> Complex:
    """Return the slave's position over its commanded position, C / (Z_s + C)."""
    if axis.ideal_servo:
        return np.ones_like(s)
    gain = axis.velocity_gain * axis.position_gain
    return gain / (s**2 + axis.velocity_gain * s + gain)


def servo_admittance(axis: OneAxis, s: Complex) -> Complex:
    """Return the slave's velocity over the contact force, 1 / (Z_s + C) [m/(N s)]."""
    if axis.ideal_servo:
        return np.zeros_like(s)
    kv, kp = axis.velocity_gain, axis.position_gain
    return s / (axis.slave_mass * (s**2 + kv * s + kv * kp))
