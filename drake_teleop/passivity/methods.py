"""The methods by name, their parameters, and one step of either end of the channel.

The two ports of the station's bilateral part are

- the master's: the wrench that the hand shall feel, and the motion of the slave's command before
  the channel (after kinematic scaling);
- the slave's: the contact wrench, and the actual motion of the slave.

Motion and wrenches are in world axes. Wrenches are in the *master's power units*: scaled so that
wrench times motion of the slave's command is the work at the hand. The hand puts -f . dx into the
channel, the environment f . dx; what comes out of a passive channel never exceeds what was put in.
"""

# No postponed annotations here: yaml_load_typed reads the types of the dataclass's fields.
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_teleop._compiled import njit
from drake_teleop.errors import DrakeTeleopError
from drake_teleop.passivity import (
    force_limit,
    four_channel,
    none,
    pspm,
    tdpa,
    two_layer,
    wave,
)
from drake_teleop.passivity.force_limit import ForceLimitConfig
from drake_teleop.passivity.four_channel import FourChannelConfig
from drake_teleop.passivity.memory import (
    COMMAND,
    DAMPING,
    LIMIT,
    MEMORY,
    METHOD,
    PACKET,
    PARAMETERS,
    STEPS,
    STIFFNESS,
)
from drake_teleop.passivity.packet import HEALTHY, PACKET_SIZE, POSE, SEQUENCE, finite
from drake_teleop.passivity.pspm import PspmConfig
from drake_teleop.passivity.tdpa import TdpaConfig, charged
from drake_teleop.passivity.two_layer import TwoLayerConfig
from drake_teleop.passivity.wave import WaveConfig
from drake_teleop.quantities import choice, quantity

METHODS = (
    "none",
    "wave",
    "tdpa",
    "charged_tdpa",
    "two_layer",
    "pspm",
    "four_channel",
    "force_limit",
)

NONE, WAVE, TDPA, CHARGED_TDPA, TWO_LAYER, PSPM, FOUR_CHANNEL, FORCE_LIMIT = range(len(METHODS))


@dataclass
class PassivityConfig:
    """Which method keeps the station passive, and the parameters of each.

    The servo is what the methods that act at the slave's motor port (`two_layer`, `pspm`) and
    `four_channel` believe of it: it pulls the slave with K (x_command - x) - D v.
    """

    method: str = choice("none", METHODS, "what keeps the channel passive")
    force_limit: float = quantity(37.5, "N", 0.0, 1e4, "largest force that the hand shall feel")
    torque_limit: float = quantity(0.17, "N m", 0.0, 1e3, "largest torque that the hand shall feel")
    servo_stiffness: list[float] = quantity(
        [2.1e5, 6.8e3], "N/m, N m/rad", 1.0, 1e9, "K of the slave's servo, in the slave's units (E)"
    )
    servo_damping: list[float] = quantity(
        [3.5e3, 117.0], "N s/m, N m s/rad", 0.0, 1e8, "D of the slave's servo, likewise (E)"
    )
    wave: WaveConfig = field(default_factory=WaveConfig)
    tdpa: TdpaConfig = field(default_factory=TdpaConfig)
    charged_tdpa: TdpaConfig = field(default_factory=charged)
    two_layer: TwoLayerConfig = field(default_factory=TwoLayerConfig)
    pspm: PspmConfig = field(default_factory=PspmConfig)
    four_channel: FourChannelConfig = field(default_factory=FourChannelConfig)
    local_force_limit: ForceLimitConfig = field(default_factory=ForceLimitConfig)


def parameters(
    config: PassivityConfig,
    power_scale: Sequence[float] = (1.0, 1.0),
    motion_scale: Sequence[float] = (1.0, 1.0),
) -> NDArray[np.float64]:
    """The parameters of the chosen method as one vector for the compiled steps.

    Args:
        config: the method and its parameters.
        power_scale: (2,) the master's power units over the slave's, for translation and rotation:
            force scale over kinematic scale.
        motion_scale: (2,) kinematic scale, slave over master, of translation and rotation: a wrench
            at the hand over one in the master's power units.

    Returns:
        (PARAMETERS,) packed as `drake_teleop.passivity.memory` says.
    """
    config = _in_power_units(config, motion_scale)
    p = np.zeros(PARAMETERS)
    p[LIMIT : LIMIT + 2] = config.force_limit, config.torque_limit
    p[STIFFNESS : STIFFNESS + 2] = np.multiply(config.servo_stiffness, power_scale)
    p[DAMPING : DAMPING + 2] = np.multiply(config.servo_damping, power_scale)
    own: dict[str, Any] = {
        "wave": config.wave,
        "tdpa": config.tdpa,
        "charged_tdpa": config.charged_tdpa,
        "two_layer": config.two_layer,
        "pspm": config.pspm,
        "four_channel": config.four_channel,
        "force_limit": config.local_force_limit,
    }
    if config.method in own:
        packed = own[config.method].packed()
        p[METHOD : METHOD + len(packed)] = packed
    return p


def _in_power_units(config: PassivityConfig, motion_scale: Sequence[float]) -> PassivityConfig:
    """What is said of the hand, in the master's power units."""
    translation, rotation = motion_scale

    def of_hand(tdpa: TdpaConfig) -> TdpaConfig:
        return replace(
            tdpa,
            drag=list(np.divide(tdpa.drag, motion_scale)),
            hand_stiffness=list(np.divide(tdpa.hand_stiffness, np.square(motion_scale))),
        )

    return replace(
        config,
        force_limit=config.force_limit / translation,
        torque_limit=config.torque_limit / rotation,
        tdpa=of_hand(config.tdpa),
        charged_tdpa=of_hand(config.charged_tdpa),
        local_force_limit=ForceLimitConfig(
            config.local_force_limit.force / translation,
            config.local_force_limit.torque / rotation,
        ),
    )


def initial_memory(
    method: str, parameters: NDArray[np.float64], pose: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(MEMORY,) the memory of an end before its first step.

    Args:
        method: one of `METHODS`.
        parameters: of `parameters`.
        pose: (7,) X_WS where this end starts: the slave's command until a packet arrives.

    Raises:
        DrakeTeleopError: for a method that does not exist.
    """
    if method not in METHODS:
        raise DrakeTeleopError(
            f"there is no method '{method}'",
            where="passivity.method",
            remedy=f"choose one of {', '.join(METHODS)}",
        )
    memory = np.zeros(MEMORY)
    memory[COMMAND : COMMAND + 7] = pose
    memory[PACKET + POSE : PACKET + POSE + 7] = pose
    if method == "two_layer":
        two_layer.initialize(parameters, memory)
    elif method == "pspm":
        pspm.initialize(parameters, memory)
    return memory


@njit(cache=True)
def _finish(healthy, memory, packet):
    """Numbers the packet; one of an end whose inputs are not finite repeats the last good one."""
    if healthy:
        packet[HEALTHY] = 1.0
        memory[PACKET : PACKET + PACKET_SIZE] = packet
    else:
        packet[:] = memory[PACKET : PACKET + PACKET_SIZE]
        packet[HEALTHY] = 0.0
    packet[SEQUENCE] = memory[STEPS]
    memory[STEPS] += 1.0


@njit(cache=True)
def master_step(method, received, fresh, pose, twist, dx, hand, T, p, memory, wrench, packet):
    """One step of the master's end, allocation-free: what the hand feels, and what is sent.

    Args:
        method: index in `METHODS`.
        received: (PACKET_SIZE,) the newest packet of the slave; zeros before the first.
        fresh: whether it is seen for the first time.
        pose: (7,) X_WS of the command, after kinematic scaling, before the channel.
        twist: (6,) its twist [v; omega], in W.
        dx: (6,) its increment since the last step [dp; log(R_k R_(k-1)^T)], in W.
        hand: (6,) wrench of the hand on the device, in W and master power units (0 if it is not
            measured; `four_channel` alone uses it).
        T: time between steps [s].
        p: (PARAMETERS,) of `parameters`.
        memory: (MEMORY,) of `initial_memory`, changed.
        wrench: (6,) written: what the hand shall feel until the next step. Zero if an input is
            not finite.
        packet: (PACKET_SIZE,) written: what is sent.
    """
    packet[:] = 0.0  # a method writes only what it uses
    healthy = finite(received) and finite(pose) and finite(twist) and finite(dx) and finite(hand)
    if not healthy:
        wrench[:] = 0.0
    elif method == WAVE:
        wave.master_step(received, fresh, pose, twist, dx, hand, T, p, memory, wrench, packet)
    elif method in (TDPA, CHARGED_TDPA):
        tdpa.master_step(received, fresh, pose, twist, dx, hand, T, p, memory, wrench, packet)
    elif method == TWO_LAYER:
        two_layer.master_step(received, fresh, pose, twist, dx, hand, T, p, memory, wrench, packet)
    elif method == PSPM:
        pspm.master_step(received, fresh, pose, twist, dx, hand, T, p, memory, wrench, packet)
    elif method == FOUR_CHANNEL:
        four_channel.master_step(
            received, fresh, pose, twist, dx, hand, T, p, memory, wrench, packet
        )
    elif method == FORCE_LIMIT:
        force_limit.master_step(
            received, fresh, pose, twist, dx, hand, T, p, memory, wrench, packet
        )
    else:
        none.master_step(received, fresh, pose, twist, dx, hand, T, p, memory, wrench, packet)
    _finish(healthy, memory, packet)


@njit(cache=True)
def slave_step(method, received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet):
    """One step of the slave's end, allocation-free: where the slave shall go, and what is sent.

    Args:
        method, received, fresh, T, p, memory, packet: as for `master_step`; the newest packet is
            the master's.
        pose: (7,) X_WS of the slave, actual.
        twist: (6,) its twist [v; omega], in W.
        dx: (6,) its increment since the last step, in W.
        wrench: (6,) contact wrench, scaled, in W and master power units.
        command: (13,) written: pose (7,) and twist (6,) that the slave shall follow. The last one,
            at rest, if an input is not finite.
    """
    packet[:] = 0.0  # a method writes only what it uses
    healthy = finite(received) and finite(pose) and finite(twist) and finite(dx) and finite(wrench)
    if not healthy:
        memory[COMMAND + 7 : COMMAND + 13] = 0.0
        command[:] = memory[COMMAND : COMMAND + 13]
    elif method == WAVE:
        wave.slave_step(received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet)
    elif method in (TDPA, CHARGED_TDPA):
        tdpa.slave_step(received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet)
    elif method == TWO_LAYER:
        two_layer.slave_step(
            received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet
        )
    elif method == PSPM:
        pspm.slave_step(received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet)
    elif method == FOUR_CHANNEL:
        four_channel.slave_step(
            received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet
        )
    elif method == FORCE_LIMIT:
        force_limit.slave_step(
            received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet
        )
    else:
        none.slave_step(received, fresh, pose, twist, dx, wrench, T, p, memory, command, packet)
    _finish(healthy, memory, packet)
