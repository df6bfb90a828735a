"""Haptic device as a Drake block that advances its dynamics once per period."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, DiagramBuilder, DiscreteValues, LeafSystem

from drake_teleop.common.blocks import NO_EXTRA_SLOTS, are_valid_port_values
from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import copy_into
from drake_teleop.station.master.dynamics import HapticDevice, pose_into, step_device, twist_into
from drake_teleop.station.master.force_display import ForceDisplay, initial_display_state
from drake_teleop.station.master.leader import LeaderDevice, step_leader

_MAX_SIMULATION_PERIOD_S = 1e-3  # slower than any haptic device
# A Runge-Kutta step is stable for (slope of friction / inertia) * period up to 2.8.
_MAX_DAMPING_RATE_TIMES_PERIOD = 2.0


@njit(cache=True, omits_reference_counting=True)
def _advance_device(
    packed_device, work, stages, state, pose, twist, display, hand_wrench, drive, period
):
    device = packed_device[0]
    copy_into(display, 6, drive, 6, drive.shape[0] - 6)
    if are_valid_port_values(hand_wrench) and are_valid_port_values(drive[:6]):
        step_device(state, hand_wrench, drive[:6], device, period, work, stages)
        pose_into(state[:6], device, pose)
        twist_into(state[:6], state[6:], device, work[0], twist)
    copy_into(display, 0, state, 0, 6)


def check_device_period(device: HapticDevice | LeaderDevice, q: Array, period: float) -> None:
    """Raise DrakeTeleopError if q is outside limits, or the step `period` [s] is too long."""
    if not 0 < period <= _MAX_SIMULATION_PERIOD_S:
        what = f"gives a period of {period:g} s (a simulated haptic device needs a positive one of"
        what = f"{what} at most {_MAX_SIMULATION_PERIOD_S:g} s)"
        remedy = "choose 1000 Hz or more; the paper uses above 2 kHz"
        raise DrakeTeleopError(what, where="rates.hand_hz", remedy=remedy)
    device.check_limits(q)
    slope = device.damping_matrix(q, include_coulomb_slope=True)
    rate = float(np.max(np.linalg.eigvals(np.linalg.solve(device.mass_matrix(q), slope)).real))
    if rate * period > _MAX_DAMPING_RATE_TIMES_PERIOD:
        what = f"the friction stops the haptic device within {1e3 / rate:.2g} ms, so that its"
        what = f"{what} simulation with a period of {1e3 * period:g} ms is unstable"
        remedy = "choose less friction, or a higher rates.hand_hz"
        raise DrakeTeleopError(what, where=device.friction_setting_name, remedy=remedy)


class MasterDevice(LeafSystem):
    """Haptic device or leader arm with n joints and the hand's passive mass, initially at rest.

    Each period, at most 1 ms, is one classical Runge-Kutta step with constant inputs.

    .. pydrake_system::

        name: MasterDevice
        input_ports:
        - hand_wrench_E: (6,) F_E_B, [f; tau] of the hand on the stylus at E, in B [N, N m]
        - drive: (27,) from the force display: motor torques (6) [N m; N] (of a leader arm: the
          wrench to display, [f; tau_z, tau_y, tau_x]), next memory of the force display (21)
        output_ports:
        - state: (2 n,) [q; qdot] [rad, rad/s; prismatic axes m, m/s]
        - pose_master: (7,) X_BE of the stylus E in the device's base B
        - twist_master: (6,) [v; omega] of E in B [m/s, rad/s]
        - for_display: (27,) joint positions (6) [rad; m] (of a leader arm: position of E (3), three
          unused zeros), memory of the force display, which this block holds
    """

    __slots__ = NO_EXTRA_SLOTS

    def __init__(
        self, period: float, device: HapticDevice | LeaderDevice, q_initial: Array
    ) -> None:
        super().__init__()
        check_device_period(device, q_initial, period)
        self._period = period
        self._advance: Callable[..., None] = _advance_device
        self._constants: tuple[Any, ...] = (
            device.packed_parameters,
            np.zeros((2, 6, 6)),
            np.zeros((3, 12)),
        )
        if isinstance(device, LeaderDevice):
            self._advance = step_leader
            self._constants = device.compiled_constants, device.hand_weight
        self._hand_wrench = self.DeclareVectorInputPort("hand_wrench_E", 6)
        # A separate port for the display's memory would cost a further call.
        coordinates = device.coordinates_for_force_display(q_initial)
        display = initial_display_state(coordinates, device.parameters)
        self._drive = self.DeclareVectorInputPort("drive", len(display))
        # Pose and twist are states because they are read more often than they change.
        for name, start in (
            ("state", np.concatenate([q_initial, np.zeros(len(q_initial))])),
            ("pose_master", device.forward_kinematics(q_initial)),
            ("twist_master", np.zeros(6)),
            ("for_display", display),
        ):
            self.DeclareStateOutputPort(name, self.DeclareDiscreteState(start))
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._advance_device_states)

    def _advance_device_states(self, context: Context, discrete_state: DiscreteValues) -> None:
        states = map(discrete_state.get_mutable_value, range(4))
        inputs = self._hand_wrench.Eval(context), self._drive.Eval(context)
        self._advance(*self._constants, *states, *inputs, self._period)


def AddDeviceAndForceDisplay(
    builder: DiagramBuilder, period: float, device: HapticDevice | LeaderDevice, q_initial: Array
) -> tuple[LeafSystem, LeafSystem]:
    block = builder.AddNamedSystem("master_device", MasterDevice(period, device, q_initial))
    display = builder.AddNamedSystem("force_display", ForceDisplay(period, device))
    builder.Connect(display.GetOutputPort("drive"), block.GetInputPort("drive"))
    for name in ("for_display", "state"):
        if display.HasInputPort(name):
            builder.Connect(block.GetOutputPort(name), display.GetInputPort(name))
    return block, display
