"""What a haptic device and the station tell each other, as `drake_teleop_device.h` has it in C.

Little-endian, without padding, in the device's base frame B. From the device: "DTD1", flags,
number, time [s], position (3) [m], orientation (4) [w, x, y, z], behind [s]. To it: "DTF1", 0,
number and time of the packet that it answers, force and torque on the hand (6) [N, N m]. The last
letter of the four is the version.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import NamedTuple

_STATE, _FORCE = struct.Struct("<4sIQd8d"), struct.Struct("<4sIQd6d")
_FROM_DEVICE, _TO_DEVICE = b"DTD1", b"DTF1"
LONGEST = _STATE.size  #: of both kinds [bytes]
_FARTHEST, _LARGEST = 10.0, 1e3  # m; N, N m


#: From the device: its motion shall not go to the slave.
CLUTCH_OPEN = 1


class DeviceState(NamedTuple):
    """Where a device is.

    Attributes:
        number: one more in each packet.
        t: when it was there, on its own steady clock [s].
        position: p_BE [m].
        orientation: R_BE as a quaternion of unit length; the identity if it does not turn.
        flags: `CLUTCH_OPEN` or none.
        behind: how old the position is that its present force answers [s]; 0 if it has none.
    """

    number: int
    t: float
    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    flags: int = 0
    behind: float = 0.0


class Place(NamedTuple):
    """Where a device is: p_BE [m], R_BE (w, x, y, z), flags as of `DeviceState`."""

    position: Sequence[float]
    orientation: Sequence[float] = (1.0, 0.0, 0.0, 0.0)
    flags: int = 0


class ForceCommand(NamedTuple):
    """The wrench that a hand shall feel: of which state, and [f; tau] in B [N, N m]."""

    number: int
    t: float
    wrench: tuple[float, ...]


def packed_state(state: DeviceState) -> bytes:
    """Its packet."""
    numbers = (*state.position, *state.orientation, state.behind)
    return _STATE.pack(_FROM_DEVICE, state.flags, state.number, state.t, *numbers)


def unpacked_state(packet: bytes) -> DeviceState | None:
    """What is in a packet, None if it is none, or no place where a device can be. Never raises."""
    if len(packet) != _STATE.size or packet[:4] != _FROM_DEVICE:
        return None
    _, flags, number, t, *numbers = _STATE.unpack(packet)
    return believable(number, t, flags, numbers)


def believable(number: int, t: float, flags: int, numbers: Sequence[float]) -> DeviceState | None:
    """The state with position, orientation and `behind` (8), None if no device can be there."""
    x, y, z, w, i, j, k, behind = numbers
    length = math.sqrt(w * w + i * i + j * j + k * k)
    # So written that what is not a number is refused; infinite is the length of what is.
    if not (
        -_FARTHEST <= x <= _FARTHEST
        and -_FARTHEST <= y <= _FARTHEST
        and -_FARTHEST <= z <= _FARTHEST
        and 0.5 < length < 2.0
        and -1e12 <= t <= 1e12
        and math.isfinite(behind)
    ):
        return None
    orientation = (w / length, i / length, j / length, k / length)
    behind = min(max(behind, 0.0), 1.0)
    return DeviceState(number, t, (x, y, z), orientation, flags & CLUTCH_OPEN, behind)


def refusal(packet: bytes) -> str:
    """Return why a packet is no state of a device: its length, kind, version or values."""
    if len(packet) != _STATE.size:
        length = len(packet) if len(packet) < _STATE.size else f"more than {_STATE.size}"
        return f"is {length} bytes long, not {_STATE.size}"
    if packet[:3] != _FROM_DEVICE[:3]:
        return f"begins with {packet[:4]!r}, not {_FROM_DEVICE!r}"
    if packet[3:4] != _FROM_DEVICE[3:]:
        return f"has version {packet[3:4]!r}, not {_FROM_DEVICE[3:]!r}"
    return "has a position, orientation or time out of range"


def packed_force(command: ForceCommand) -> bytes:
    """Its packet."""
    return _FORCE.pack(_TO_DEVICE, 0, command.number, command.t, *command.wrench)


def unpacked_force(packet: bytes) -> ForceCommand | None:
    """What is in a packet, None if it is none, or no force that a device gives. Never raises."""
    if len(packet) != _FORCE.size or packet[:4] != _TO_DEVICE:
        return None
    _, _, number, t, *wrench = _FORCE.unpack(packet)
    if not (math.isfinite(t) and all(abs(f) < _LARGEST for f in wrench)):  # nan is not
        return None
    return ForceCommand(number, t, tuple(wrench))
