"""Passivity methods by name, their parameters, and one step of each end of the channel.

All poses, twists and wrenches are in world axes W. Wrenches are in the *master's power units*:
wrench times motion of the slave's command is the work at the hand, docs/theory.md (T29).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, is_dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import types

from drake_teleop.common import config
from drake_teleop.common.compiled import address_of_function, make_call_at_address, njit
from drake_teleop.common.config import choice, plain, quantity, settings
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.numeric import Array
from drake_teleop.common.registry import Registry
from drake_teleop.common.vectors import copy_into
from drake_teleop.station.passivity import (
    force_limit,
    four_channel,
    ledger,
    ledger_slave,
    none,
    pspm,
    tdpa,
    two_layer,
    wave,
)
from drake_teleop.station.passivity import memory as slots
from drake_teleop.station.passivity import packet as fields
from drake_teleop.station.passivity.force_limit import ForceLimitConfig
from drake_teleop.station.passivity.four_channel import FourChannelConfig
from drake_teleop.station.passivity.ledger import LedgerConfig
from drake_teleop.station.passivity.packet import are_vectors_finite
from drake_teleop.station.passivity.pspm import PspmConfig
from drake_teleop.station.passivity.safe_state import fade_retreat_wrench
from drake_teleop.station.passivity.tdpa import TdpaConfig, charged_tdpa_config
from drake_teleop.station.passivity.two_layer import TwoLayerConfig
from drake_teleop.station.passivity.wave import WaveConfig


@njit(cache=True)
def _keep_memory_at_command_change(requested, command, pose, twist, p, memory):
    pass


class PassivityMethod(NamedTuple):
    """Functions of a passivity method, and its requirements on the station.

    Attributes:
        master_step, slave_step, record_command: compiled functions with the arguments of those of
            this module except `steps`.
        initialize: function of `p` and `memory` of one end, called before its first step.
        config: settings dataclass of a registered method with `pack_into(p)`, or None.
        balance_at_motors: the energy balance is at the slave's motors, not at its command.
        needs_arm_mass: `slave_mass` and servo are by default those of the arm at the start.
        needs_load_apart: the ends need the load's part of the wrench as a separate input.
        speed_limit: function of config and slave mass: largest speed of the slave [m/s, rad/s].
    """

    master_step: Any
    slave_step: Any
    record_command: Any = _keep_memory_at_command_change
    initialize: Callable[[Array, Array], None] | None = None
    config: type[Any] | None = None
    balance_at_motors: bool = False
    needs_arm_mass: bool = False
    needs_load_apart: bool = False
    speed_limit: Callable[[Any, Array], Array] | None = None


def _functions_of_module(module: Any) -> tuple[Any, Any, Any, Any]:
    return module.master_step, module.slave_step, module.record_command, module.initialize


_TDPA_METHOD = PassivityMethod(tdpa.master_step, tdpa.slave_step, tdpa.record_command)
METHODS = Registry(
    "passivity method",
    {
        "none": PassivityMethod(none.master_step, none.slave_step),
        "wave": PassivityMethod(wave.master_step, wave.slave_step),
        "tdpa": _TDPA_METHOD,
        "charged_tdpa": _TDPA_METHOD,
        "two_layer": PassivityMethod(*_functions_of_module(two_layer), balance_at_motors=True),
        "pspm": PassivityMethod(*_functions_of_module(pspm), balance_at_motors=True),
        "ledger": PassivityMethod(
            ledger.master_step,
            ledger_slave.slave_step,
            ledger_slave.record_command,
            ledger.initialize,
            balance_at_motors=True,
            needs_arm_mass=True,
            needs_load_apart=True,
            speed_limit=ledger.max_slave_speed,
        ),
        "four_channel": PassivityMethod(four_channel.master_step, four_channel.slave_step),
        "force_limit": PassivityMethod(force_limit.master_step, none.slave_step),
    },
    PassivityMethod,
)
"""All methods by name."""

_DEFAULT_SLAVE_MASS_AND_INERTIA = [15.13, 0.5]  # kg, kg m^2, estimate


@settings
@dataclass
class PassivityConfig:
    """Method that keeps the station passive, and the parameters of each method.

    The servo's force on the slave is K (x_command - x) - D v. `charged_tdpa`, `two_layer`, `pspm`,
    `ledger` and `four_channel` use K, D; `two_layer`, `ledger` and limit `retreat` use the mass.
    """

    method: str = choice(
        "none", (),
        "passivity method of the channel; two_layer, pspm, four_channel and force_limit are"
        " references for comparison", METHODS,
    )  # fmt: skip
    force_limit: float = quantity(37.5, "N", 0.0, 1e4, "largest rendered force at the hand")
    torque_limit: float = quantity(0.17, "N m", 0.0, 1e3, "largest rendered torque at the hand")
    retreat: list[float] = quantity(
        [0.1, 1.0], "m/s, rad/s", 1e-3, 1e3,
        "hand speed along the wrench above which the wrench fades, to 0 at twice this speed",
    )  # fmt: skip
    servo_stiffness: list[float] = quantity(
        [2.1e5, 6.8e3], "N/m, N m/rad", 1.0, 1e9, "K of the slave's servo, in its units (estimate)"
    )
    servo_damping: list[float] = quantity(
        [3.5e3, 117.0], "N s/m, N m s/rad", 0.0, 1e8,
        "D of the slave's servo, in its units (estimate)",
    )  # fmt: skip
    slave_mass: list[float] | None = quantity(
        None, "kg, kg m^2", 1e-6, 1e6,
        "mass of arm and tool at the tool, in the slave's units; null: with ledger, mass and servo"
        " of the station's arm at the start; else 15.13, 0.5 (estimate)", length=2,
    )  # fmt: skip
    registered: dict[str, float] = plain({}, "parameters of a custom method: name and value")
    wave: WaveConfig = field(default_factory=WaveConfig)
    tdpa: TdpaConfig = field(default_factory=TdpaConfig)
    charged_tdpa: TdpaConfig = field(default_factory=charged_tdpa_config)
    two_layer: TwoLayerConfig = field(default_factory=TwoLayerConfig)
    pspm: PspmConfig = field(default_factory=PspmConfig)
    ledger: LedgerConfig = field(default_factory=LedgerConfig)
    four_channel: FourChannelConfig = field(default_factory=FourChannelConfig)
    local_force_limit: ForceLimitConfig = field(default_factory=ForceLimitConfig)

    def check(self, where: str) -> None:
        METHODS.check(self.method, f"{where}.method")
        self.method_config(where)

    def method_config(self, where: str = "passivity") -> Any:
        """Return the parameters of the selected method; None if it has none."""
        schema = METHODS[self.method].config
        if schema is None:
            if self.registered:
                what = f"built-in method '{self.method}' has no registered parameters"
                remedy = "remove this field; a built-in method has its own block of fields"
                raise DrakeTeleopError(what, where=f"{where}.registered", remedy=remedy)
            # The number `force_limit` is a limit of all methods.
            name = "local_force_limit" if self.method == "force_limit" else self.method
            own = getattr(self, name, None)
            return own if is_dataclass(own) else None
        for name in self.registered:
            config.check_field_name(schema, name, f"{where}.registered.{name}")
        with config.unchecked_assignments():
            own = schema(**self.registered)
        config.check_all_field_values(own, f"{where}.registered")
        return own


def method_parameters(
    config: PassivityConfig,
    power_scale: Sequence[float] = (1.0, 1.0),
    motion_scale: Sequence[float] = (1.0, 1.0),
) -> Array:
    """Return the parameters (NUM_PARAMETERS,) of the selected method for the compiled steps.

    Args:
        power_scale: (2,) factors from the slave's wrench to the master's power units, for force and
            torque: force scale over kinematic scale.
        motion_scale: (2,) kinematic scale, slave over master, of translation and rotation.
    """
    p = np.zeros(slots.NUM_PARAMETERS)
    p[slots.WRENCH_LIMIT] = np.divide([config.force_limit, config.torque_limit], motion_scale)
    p[slots.SERVO_K] = np.multiply(config.servo_stiffness, power_scale)
    p[slots.SERVO_D] = np.multiply(config.servo_damping, power_scale)
    p[slots.SLAVE_MASS] = np.multiply(
        config.slave_mass or _DEFAULT_SLAVE_MASS_AND_INERTIA, power_scale
    )
    p[slots.SLAVE_PER_MASTER_MOTION] = motion_scale
    fades = config.method != "none"
    p[slots.FORCE_FADE_HAND_SPEED] = np.multiply(config.retreat, motion_scale) if fades else np.inf
    own = config.method_config()
    if own is not None:
        own.pack_into(p)
    return p


def initial_method_memory(method: str, parameters: Array, pose: Array) -> Array:
    """Return the memory (MEMORY_SIZE,) of one end of the channel before its first step.

    `pose` (7,) is the slave's pose X_WS at the start, its command until a packet arrives.
    """
    own = METHODS[METHODS.check(method, "passivity.method")]
    memory = np.zeros(slots.MEMORY_SIZE)
    memory[slots.COMMAND_POSE] = pose
    memory[slots.LAST_HEALTHY_SENT_PACKET][fields.POSE] = pose
    if own.initialize is not None:
        own.initialize(parameters, memory)
    return memory


_NUMBA_VECTOR = types.Array(types.float64, 1, "C")
_NUMBA_STEP_ARGUMENT_TYPES = (
    (_NUMBA_VECTOR, types.boolean, *[_NUMBA_VECTOR] * 5, types.float64, *[_NUMBA_VECTOR] * 4),
    (_NUMBA_VECTOR, types.boolean, *[_NUMBA_VECTOR] * 4, types.float64, *[_NUMBA_VECTOR] * 4),
    (_NUMBA_VECTOR,) * 6,
)
_call_master, _call_slave, _call_record = map(make_call_at_address, _NUMBA_STEP_ARGUMENT_TYPES)


def step_addresses(method: str) -> tuple[int, ...]:
    """Return the addresses of `master_step`, `slave_step` and `record_command` of a method."""
    return _memory_addresses_of_functions(*METHODS[method][:3])


@cache
def _memory_addresses_of_functions(*steps: Any) -> tuple[int, ...]:
    return tuple(map(address_of_function, steps, _NUMBA_STEP_ARGUMENT_TYPES))


@njit(cache=True)
def _finish_packet_or_repeat_last_healthy(healthy, memory, packet):
    if healthy:
        packet[fields.SENDER_INPUTS_FINITE] = 1.0
        copy_into(memory, slots.LAST_HEALTHY_SENT_PACKET.start, packet, 0, fields.PACKET_SIZE)
    else:
        copy_into(packet, 0, memory, slots.LAST_HEALTHY_SENT_PACKET.start, fields.PACKET_SIZE)
        packet[fields.SENDER_INPUTS_FINITE] = 0.0
    packet[fields.PACKET_NUMBER] = memory[slots.STEP_COUNT]
    memory[slots.STEP_COUNT] += 1.0


@njit(cache=True)
def master_step(
    steps, received, fresh, pose, twist, dx, hand, limits, T, p, memory, wrench, packet
):  # fmt: skip
    """Compute the wrench to render at the hand and the packet of one step at the master's end.

    Args:
        steps: result of `step_addresses`.
        received: (PACKET_SIZE,) newest packet of the slave; zeros before the first.
        fresh: True if the packet is new.
        pose: (7,) commanded pose X_WS, after kinematic scaling, before the channel.
        twist: (6,) twist of this command [v; omega], in W.
        dx: (6,) increment of this command since the last step [dp; log(R_k R_(k-1)^T)], in W.
        hand: (6,) wrench of the hand on the device, in W; only `four_channel` uses it.
        limits: (2,) largest wrench to render: force, torque.
        T: time between steps [s].
        p, memory: parameters and memory of this end; memory is updated.
        wrench: (6,) written: wrench to render; 0 if an input is not finite.
        packet: (PACKET_SIZE,) written: packet to send.
    """
    packet[:] = 0.0  # a method writes only the fields that it uses
    healthy = are_vectors_finite((received, pose, twist, dx, hand))
    if not healthy:
        wrench[:] = 0.0
    else:
        _call_master(
            steps[0], received, fresh, pose, twist, dx, hand, limits, T, p, memory, wrench, packet
        )
        fade_retreat_wrench(twist, T, p, memory, wrench)
    _finish_packet_or_repeat_last_healthy(healthy, memory, packet)


@njit(cache=True)
def slave_step(steps, received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet):
    """Compute the slave's command and the packet of one step at the slave's end.

    Args:
        steps, received, fresh, T, p, memory, packet: as for `master_step`, from the master.
        pose, twist: (7,) and (6,) actual pose X_WS and twist [v; omega] of the slave, in W.
        dx: (6,) increment of this pose since the last step, in W.
        wrench: (6,) wrench on the slave from contact and the rendered part of the load, in W.
        command: (13,) written: pose (7,) and twist (6,) to command; if an input is not finite, the
            last pose and zero twist.
    """
    packet[:] = 0.0  # a method writes only the fields that it uses
    healthy = are_vectors_finite((received, pose, twist, dx, wrench))
    if not healthy:
        memory[slots.COMMAND_TWIST] = 0.0
        copy_into(command, 0, memory, slots.COMMAND.start, 13)
    else:
        _call_slave(
            steps[1], received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet
        )
    _finish_packet_or_repeat_last_healthy(healthy, memory, packet)


@njit(cache=True)
def record_command(steps, requested, command, pose, twist, p, memory):
    """Update the method's memory if the safe state changed the method's command.

    `requested` (7,) is the method's command X_WS, `command` (7,) that of the safe state; `ledger`
    may change `command`. Other arguments: see `slave_step`.
    """
    _call_record(steps[2], requested, command, pose, twist, p, memory)
