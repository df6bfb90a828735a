"""Haptic device as a Drake block that advances its dynamics once per period."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from drake_teleop.common.blocks import are_finite_and_in_range
from drake_teleop.common.compiled import njit
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.common.vectors import copy_into
from drake_teleop.station.master.dynamics import HapticDevice, pose_into, step_device, twist_into
from drake_teleop.station.master.force_display import DeviceBlock, ForceDisplay
from drake_teleop.station.master.leader import LeaderArm, LeaderDevice, LeaderDisplay

_MAX_DEVICE_PERIOD_S = 1e-3  # slower than any haptic device
# A Runge-Kutta step is stable for (slope of friction / inertia) * period up to 2.8.
_MAX_STABLE_RATE_TIMES_PERIOD = 2.0


@njit(cache=True, omits_reference_counting=True)
def _advance_device(device, work, stages, state, pose, twist, display, hand_wrench, drive, period):
    copy_into(display, 6, drive, 6, drive.shape[0] - 6)
    if are_finite_and_in_range(hand_wrench) and are_finite_and_in_range(drive[:6]):
        step_device(state, hand_wrench, drive[:6], device, period, work, stages)
        pose_into(state[:6], device, pose)
        twist_into(state[:6], state[6:], device, work[0], twist)
    copy_into(display, 0, state, 0, 6)


def check_device_period(device: HapticDevice | LeaderDevice, q: Array, period: float) -> None:
    """Raise a DrakeTeleopError if one step per period [s] is unstable at the joint positions q."""
    if not 0 < period <= _MAX_DEVICE_PERIOD_S:
        raise DrakeTeleopError(
            f"gives a period of {period:g} s (a simulated haptic device needs a positive one of at"
            f" most {_MAX_DEVICE_PERIOD_S:g} s)",
            where="rates.hand_hz",
            remedy="choose 1000 Hz or more; the paper uses above 2 kHz",
        )
    device.check_limits(q)
    slope = device.damping_matrix(q, include_coulomb_slope=True)
    rate = float(np.max(np.linalg.eigvals(np.linalg.solve(device.mass_matrix(q), slope)).real))
    if rate * period > _MAX_STABLE_RATE_TIMES_PERIOD:
        raise DrakeTeleopError(
            f"the friction stops the haptic device within {1e3 / rate:.2g} ms, so that its "
            f"simulation with a period of {1e3 * period:g} ms is unstable",
            where=device.friction_setting_path,
            remedy="choose less friction, or a higher hand rate",
        )


class MasterDevice(DeviceBlock):
    """Haptic device with the hand's passive mass.

    Each period, at most 1 ms, is one classical Runge-Kutta step with held inputs.

    .. pydrake_system::

        name: MasterDevice
        input_ports:
        - hand_wrench_E: (6,) F_E_B, [f; tau] of the hand on the stylus at E, in B [N, N m]
        - drive: (27,) from the force display: motor torques (6) [N m; N], the display's memory
        output_ports:
        - state: (12,) [q; qdot] [rad, rad/s; prismatic axes m, m/s]
        - pose_master: (7,) X_BE of the stylus E in the device's base B
        - twist_master: (6,) [v; omega] of E in B [m/s, rad/s]
        - for_display: (27,) joint positions (6) [rad; m], the display's memory
    """

    __slots__ = ()

    def __init__(self, period: float, device: HapticDevice, q_initial: Array) -> None:
        check_device_period(device, q_initial, period)
        constants = device.parameters, np.zeros((2, 6, 6)), np.zeros((3, 12))
        super().__init__(period, device, q_initial, _advance_device, constants)


def AddHapticDevice(
    builder: DiagramBuilder, period: float, device: HapticDevice | LeaderDevice, q_initial: Array
) -> tuple[LeafSystem, LeafSystem]:
    check_device_period(device, q_initial, period)
    if isinstance(device, LeaderDevice):
        block: LeafSystem = LeaderArm(period, device, q_initial)
        display: LeafSystem = LeaderDisplay(period, device)
    else:
        block, display = MasterDevice(period, device, q_initial), ForceDisplay(period, device)
    builder.AddNamedSystem("master_device", block)
    builder.AddNamedSystem("force_display", display)
    builder.Connect(block.GetOutputPort("for_display"), display.GetInputPort("for_display"))
    builder.Connect(display.GetOutputPort("drive"), block.GetInputPort("drive"))
    if isinstance(device, LeaderDevice):
        builder.Connect(block.GetOutputPort("state"), display.GetInputPort("state"))
    return block, display
