"""Passivity methods by name, their parameters, and one step of each end of the channel.

Ports: at the master the wrench to render and the motion of its command (after kinematic scaling,
before the channel); at the slave the wrench of contact (with sigma > 0 also of the load) and the
actual motion, all in world axes W. Wrenches are in the *master's power units*: wrench times motion
of the slave's command is the work at the hand, docs/theory.md (T29).
"""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from numba import types
from numpy.typing import NDArray

from drake_teleop.common.compiled import address_of, call_at, njit
from drake_teleop.common.config import choice, quantity, settings
from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.vectors import put
from drake_teleop.station.passivity import none
from drake_teleop.station.passivity.force_limit import ForceLimitConfig
from drake_teleop.station.passivity.four_channel import FourChannelConfig
from drake_teleop.station.passivity.ledger import LedgerConfig
from drake_teleop.station.passivity.memory import (
    COMMAND,
    COMMAND_POSE,
    COMMAND_TWIST,
    DAMPING,
    LIMIT,
    MASS,
    MEMORY,
    MOTION_SCALE,
    PACKET,
    PARAMETERS,
    RETREAT,
    STEPS,
    STIFFNESS,
)
from drake_teleop.station.passivity.packet import HEALTHY, PACKET_SIZE, POSE, SEQUENCE, finite
from drake_teleop.station.passivity.pspm import PspmConfig
from drake_teleop.station.passivity.safe_state import retreat
from drake_teleop.station.passivity.tdpa import TdpaConfig, charged
from drake_teleop.station.passivity.two_layer import TwoLayerConfig
from drake_teleop.station.passivity.wave import WaveConfig


@settings
@dataclass
class Methods:
    """Parameters of all passivity methods; each field registers the method of its name.

    The module of the field's class implements the method: compiled `master_step` and `slave_step`,
    with the arguments of those below except `steps`; the class has `pack_into(p)`. Optional:
    `initialize(p, memory)` of an end; compiled `command_sent`; `AT_THE_MOTOR = True` for an energy
    balance at the slave's motors instead of its command.
    """

    wave: WaveConfig = field(default_factory=WaveConfig)
    tdpa: TdpaConfig = field(default_factory=TdpaConfig)
    charged_tdpa: TdpaConfig = field(default_factory=charged)
    two_layer: TwoLayerConfig = field(default_factory=TwoLayerConfig)
    pspm: PspmConfig = field(default_factory=PspmConfig)
    ledger: LedgerConfig = field(default_factory=LedgerConfig)
    four_channel: FourChannelConfig = field(default_factory=FourChannelConfig)
    local_force_limit: ForceLimitConfig = field(
        default_factory=ForceLimitConfig, metadata={"method": "force_limit"}
    )


_FIELDS = {entry.metadata.get("method", entry.name): entry for entry in fields(Methods)}
_MODULES: dict[str, Any] = {"none": none} | {
    name: import_module(entry.type.__module__) for name, entry in _FIELDS.items()
}
METHODS = tuple(_MODULES)
"""Names of all methods."""
AT_THE_MOTOR = tuple(name for name, file in _MODULES.items() if hasattr(file, "AT_THE_MOTOR"))
"""Methods with an energy balance at the port of the slave's motors."""


_SLAVE_MASS = [15.13, 0.5]  # kg, kg m^2 (E)


@dataclass
class _CommonConfig:
    method: str = choice(
        "none",
        METHODS,
        "passivity method of the channel; two_layer, pspm, four_channel and force_limit are"
        " references for comparison",
    )
    force_limit: float = quantity(37.5, "N", 0.0, 1e4, "largest rendered force at the hand")
    torque_limit: float = quantity(0.17, "N m", 0.0, 1e3, "largest rendered torque at the hand")
    retreat: list[float] = quantity(
        [0.1, 1.0],
        "m/s, rad/s",
        1e-3,
        1e3,
        "speed of the hand along the wrench where it starts to fade; zero at twice this speed",
    )
    servo_stiffness: list[float] = quantity(
        [2.1e5, 6.8e3], "N/m, N m/rad", 1.0, 1e9, "K of the slave's servo, in the slave's units (E)"
    )
    servo_damping: list[float] = quantity(
        [3.5e3, 117.0], "N s/m, N m s/rad", 0.0, 1e8, "D of the slave's servo, likewise (E)"
    )
    slave_mass: list[float] | None = quantity(
        None,
        "kg, kg m^2",
        1e-6,
        1e6,
        "mass of arm and tool at the tool, likewise; null: 15.13, 0.5 (E), with ledger"
        " mass and servo of the station's arm at the start",
    )


@settings
@dataclass
class PassivityConfig(Methods, _CommonConfig):
    """Method that keeps the station passive, and the parameters of each method.

    The servo's force on the slave is K (x_command - x) - D v. `two_layer`, `pspm`, `ledger` and
    `four_channel` use K and D. `two_layer`, `ledger` and `retreat` use the slave's mass.
    """


def parameters(
    config: PassivityConfig,
    power_scale: Sequence[float] = (1.0, 1.0),
    motion_scale: Sequence[float] = (1.0, 1.0),
) -> NDArray[np.float64]:
    """Return the parameters of the selected method as one vector for the compiled steps.

    Args:
        power_scale: (2,) factors from the slave's wrench to the master's power units, for force and
            torque: force scale over kinematic scale.
        motion_scale: (2,) kinematic scale, slave over master, of translation and rotation.

    Returns:
        (PARAMETERS,) vector in the layout of `memory`.
    """
    p = np.zeros(PARAMETERS)
    p[LIMIT] = np.divide([config.force_limit, config.torque_limit], motion_scale)
    p[STIFFNESS] = np.multiply(config.servo_stiffness, power_scale)
    p[DAMPING] = np.multiply(config.servo_damping, power_scale)
    p[MASS] = np.multiply(config.slave_mass or _SLAVE_MASS, power_scale)
    p[MOTION_SCALE] = motion_scale
    p[RETREAT] = np.multiply(config.retreat, motion_scale) if config.method != "none" else np.inf
    if config.method in _FIELDS:
        getattr(config, _FIELDS[config.method].name).pack_into(p)
    return p


def initial_memory(
    method: str, parameters: NDArray[np.float64], pose: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the memory (MEMORY,) of one end of the channel before its first step.

    Args:
        parameters: result of `parameters`.
        pose: (7,) slave's pose X_WS at the start, its command until a packet arrives.

    Raises:
        DrakeTeleopError: for an unknown method.
    """
    if method not in METHODS:
        raise DrakeTeleopError(
            f"there is no method '{method}'",
            where="passivity.method",
            remedy=f"choose one of {', '.join(METHODS)}",
        )
    memory = np.zeros(MEMORY)
    memory[COMMAND_POSE] = pose
    memory[PACKET][POSE] = pose
    if hasattr(_MODULES[method], "initialize"):
        _MODULES[method].initialize(parameters, memory)
    return memory


@njit(cache=True)
def _ignore_command(requested, command, pose, twist, p, memory):
    """Substitute for `command_sent` in methods without one."""


_ROW = types.Array(types.float64, 1, "C")
_MASTER_ARGUMENTS = (_ROW, types.boolean, *[_ROW] * 5, types.float64, *[_ROW] * 4)
_SLAVE_ARGUMENTS = (_ROW, types.boolean, *[_ROW] * 4, types.float64, *[_ROW] * 4)
_SENT_ARGUMENTS = (_ROW,) * 6
_master_step, _slave_step, _command_sent = map(
    call_at, (_MASTER_ARGUMENTS, _SLAVE_ARGUMENTS, _SENT_ARGUMENTS)
)


@cache
def steps_of(method: str) -> tuple[int, int, int]:
    """Return the addresses of a method's `master_step`, `slave_step` and `command_sent`."""
    file = _MODULES[method]
    return (
        address_of(file.master_step, _MASTER_ARGUMENTS),
        address_of(file.slave_step, _SLAVE_ARGUMENTS),
        address_of(getattr(file, "command_sent", _ignore_command), _SENT_ARGUMENTS),
    )


@njit(cache=True)
def _number_packet(healthy, memory, packet):
    """Write the packet's number; repeat the last good packet if the inputs are not finite."""
    if healthy:
        packet[HEALTHY] = 1.0
        put(memory, PACKET.start, packet, 0, PACKET_SIZE)
    else:
        put(packet, 0, memory, PACKET.start, PACKET_SIZE)
        packet[HEALTHY] = 0.0
    packet[SEQUENCE] = memory[STEPS]
    memory[STEPS] += 1.0


@njit(cache=True)
def master_step(
    steps, received, fresh, pose, twist, dx, hand, limits, T, p, memory, wrench, packet
):  # fmt: skip
    """Compute the wrench to render at the hand and the packet of one step at the master's end.

    Args:
        steps: result of `steps_of(method)`.
        received: (PACKET_SIZE,) newest packet of the slave; zeros before the first.
        fresh: True if the packet is new.
        pose: (7,) commanded pose X_WS, after kinematic scaling, before the channel.
        twist: (6,) twist of this command [v; omega], in W.
        dx: (6,) increment of this command since the last step [dp; log(R_k R_(k-1)^T)], in W.
        hand: (6,) wrench of the hand on the device, in W and master's power units; only
            `four_channel` uses it.
        limits: (2,) largest force and torque, in the master's power units [N, N m].
        T: time between steps [s].
        p: (PARAMETERS,) result of `parameters`.
        memory: (MEMORY,) memory of this end, updated.
        wrench: (6,) written: wrench to render; 0 if an input is not finite.
        packet: (PACKET_SIZE,) written: packet to send.
    """
    packet[:] = 0.0  # a method writes only the fields that it uses
    healthy = finite(received) and finite(pose) and finite(twist) and finite(dx) and finite(hand)
    if not healthy:
        wrench[:] = 0.0
    else:
        _master_step(
            steps[0], received, fresh, pose, twist, dx, hand, limits, T, p, memory, wrench, packet
        )
        retreat(twist, T, p, memory, wrench)
    _number_packet(healthy, memory, packet)


@njit(cache=True)
def slave_step(steps, received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet):
    """Compute the slave's command and the packet of one step at the slave's end.

    Args:
        steps, received, fresh, T, p, memory, packet: as for `master_step`, with the master's
            packet.
        pose: (7,) actual pose X_WS of the slave.
        twist: (6,) actual twist of the slave [v; omega], in W.
        dx: (6,) increment of this pose since the last step, in W.
        wrench: (6,) wrench on the slave from contact, with sigma > 0 also from the load, in W and
            master's power units.
        command: (13,) written: pose (7,) and twist (6,) of the slave's command. If an input is not
            finite, it is the last pose with zero twist.
    """
    packet[:] = 0.0  # a method writes only the fields that it uses
    healthy = finite(received) and finite(pose) and finite(twist) and finite(dx) and finite(wrench)
    if not healthy:
        memory[COMMAND_TWIST] = 0.0
        put(command, 0, memory, COMMAND.start, 13)
    else:
        _slave_step(
            steps[1], received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet
        )
    _number_packet(healthy, memory, packet)


@njit(cache=True)
def command_sent(steps, requested, command, pose, twist, p, memory):
    """Report to the method the command that is sent; a stop by the safe state may have changed it.

    Args:
        steps: result of `steps_of(method)`.
        requested: (7,) command X_WS of the method.
        command: (7,) command after the safe state; the method may change it.
        pose, twist: (7,) and (6,) actual pose and twist of the slave, in W.
        p, memory: as for `master_step`.
    """
    _command_sent(steps[2], requested, command, pose, twist, p, memory)
