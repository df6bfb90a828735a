"""Kinematics and dynamics of the Phantom for arrays, by default without the hand."""

import numpy as np

from drake_teleop.station.master.data_sheets import Master
from drake_teleop.station.master.dynamics import gravity_compensation_torque_into

PHANTOM = Master().device(0.0, 0.0)
jacobian, forward_kinematics = PHANTOM.jacobian, PHANTOM.forward_kinematics


def mass_matrix(q, hand_mass=0.0, hand_inertia=0.0):
    return Master().device(hand_mass, hand_inertia).mass_matrix(q)


def gravity_torque(q):
    torque = np.empty(6)
    gravity_compensation_torque_into(q, PHANTOM.parameters, torque)
    return torque
