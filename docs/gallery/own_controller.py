"""
A controller of your own
========================

An impedance and an admittance controller in place of the arm's position control. The operator
presses a wall over 50 ms of delay in each direction.
"""

import matplotlib.pyplot as plt
import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RotationMatrix
from pydrake.systems.framework import LeafSystem

import drake_teleop as dt
from drake_teleop.lab.comparison.delayed_contact import energy_between
from drake_teleop.lab.identification import true_load
from drake_teleop.station.environment.solids import Wall
from drake_teleop.station.scenario import replace
from drake_teleop.station.slave.arm import holding_torque, jacobian, pose_into
from drake_teleop.station.slave.plant import NominalSlave


def rotation(pose):
    """Return R_WS of a pose [q; p]."""
    return RotationMatrix(Quaternion(pose[:4] / np.linalg.norm(pose[:4])))


class ImpedanceController(LeafSystem):
    """The tool as a spring and damper: tau = J^T (K (x_command - x) - D v) + weight."""

    def __init__(self, arm, stiffness, damping):
        super().__init__()
        self._arm, self._n = arm, arm.num_joints
        self._K, self._D = np.repeat(stiffness, 3), np.repeat(damping, 3)
        self._command = self.DeclareVectorInputPort("pose_command", 7)
        self._state = self.DeclareVectorInputPort("slave_state", 2 * self._n)
        self.DeclareVectorOutputPort("joint_torque", self._n, self._torque)

    def _torque(self, context, output):
        command, (q, v) = self._command.Eval(context), np.split(self._state.Eval(context), 2)
        J, pose, error = np.empty((6, self._n)), np.empty(7), np.empty(6)
        jacobian(self._arm.table, q, J)
        pose_into(self._arm.table, q, pose)
        turn = (rotation(command) @ rotation(pose).inverse()).ToAngleAxis()
        error[:3], error[3:] = command[4:] - pose[4:], turn.angle() * turn.axis()
        wrench = self._K * error - self._D * (J @ v)
        output.SetFromVector(J.T @ wrench + holding_torque(self._arm, q))


class AdmittanceController(LeafSystem):
    """Yields to contact: M a + D v + K d = force of the wall; d is added to the command."""

    def __init__(self, mass, damping, stiffness, period=1e-3):
        super().__init__()
        self._numbers = mass, damping, stiffness, period
        self._command = self.DeclareVectorInputPort("pose_command", 7)
        self._pose = self.DeclareVectorInputPort("pose_slave", 7)
        self._wrench = self.DeclareVectorInputPort("contact_wrench_S", 6)
        self._yielding = self.DeclareDiscreteState(6)  # d [m], its speed [m/s]
        self.DeclareVectorOutputPort("pose_command", 7, self._follow)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._yield)

    def _yield(self, context, state):
        mass, damping, stiffness, period = self._numbers
        d, v = np.split(context.get_discrete_state(self._yielding).value(), 2)
        force = -rotation(self._pose.Eval(context)).multiply(self._wrench.Eval(context)[:3])
        v = (v + period * (force - stiffness * d) / mass) / (1 + period * damping / mass)
        state.set_value(self._yielding, np.concatenate([d + period * v, v]))

    def _follow(self, context, output):
        pose = self._command.Eval(context).copy()
        pose[4:] += context.get_discrete_state(self._yielding).value()[:3]
        output.SetFromVector(pose)


x, y, z = (base := dt.LoadScenario("contact_transition")).slave.position
tip = NominalSlave(base.slave).start_tip[2]
base = replace(
    base,
    operator__intent=[dt.MinimumJerk(t_start=0.2, duration=0.5, translation=[0.0, 0.0, -0.05])],
    sheet_spring=None,
    environment=[Wall(position=[x, y, tip - 0.02], stiffness=1e4)],
    channel__delay=0.05,
    simulation__settle=0.0,
    simulation__duration=1.6,
    rates__hand_hz=1000.0,
    rates__joint_control_hz=1000.0,
    rates__sensor_hz=2000.0,
)
arm, load = NominalSlave(base.slave).arm, true_load(base)
results, figure, axes = {}, *plt.subplots(1, 2, figsize=(7.5, 3), sharex=True)
for method in ("tdpa", "ledger"):
    scenario = replace(
        base,
        passivity__method=method,
        passivity__servo_stiffness=[1500.0, 80.0],  # as seen from the channel
        passivity__servo_damping=[300.0, 16.0],
        passivity__slave_mass=[15.0, 0.5],
    )
    for name, controller in (
        ("impedance", ImpedanceController(arm, [1500.0, 80.0], [300.0, 16.0])),
        ("admittance", AdmittanceController(5.0, 600.0, 1500.0)),
    ):
        slave = dt.MakeSlaveSide(scenario, load_estimate=load, controller=controller)
        station = dt.MakeTeleopStation(scenario, slave=slave)
        result = dt.simulate(station, scenario.simulation, progress=False)
        results[name, method] = result, scenario
        axes[0].plot(result.t, result["true_contact_wrench_W"][:, 2], label=f"{name}, {method}")
        axes[1].plot(result.t, energy_between(result, scenario))
axes[0].set(xlabel="t [s]", ylabel="force of the wall [N]")
axes[1].set(xlabel="t [s]", ylabel="energy between hand and wall [J]")
axes[0].legend()
figure.tight_layout()
