"""Packets between a haptic device and the station: little-endian, in the device's base frame B.

From the device: "DTD1", flags, number, time [s], position (3) [m], orientation (4) [w, x, y, z],
age of the position that caused the displayed force [s]. To the device: "DTF1", 0, number and time
of the answered packet, wrench (6) [N, N m].
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import NamedTuple

_STATE_FORMAT, _FORCE_FORMAT = struct.Struct("<4sIQd8d"), struct.Struct("<4sIQd6d")
_STATE_TAG, _FORCE_TAG = b"DTD1", b"DTF1"
MAX_PACKET_BYTES = _STATE_FORMAT.size  #: of both packets [bytes]
_MAX_POSITION_M, _MAX_WRENCH_VALUE = 10.0, 1e3  # m; N, N m
CLUTCH_OPEN_FLAG = 1  #: motion of the device is not transmitted to the slave


class DeviceState(NamedTuple):
    """State of a haptic device, with its packet number and time on the device's clock [s].

    Attributes:
        position: p_BE of the end effector E in the base frame B [m].
        quaternion_wxyz: (4,) unit quaternion of R_BE.
        flags: 0 or `CLUTCH_OPEN_FLAG`.
        force_age_s: age of the position that caused the displayed force [s]; 0: no force.
    """

    number: int
    t: float
    position: tuple[float, float, float]
    quaternion_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    flags: int = 0
    force_age_s: float = 0.0


class ForceCommand(NamedTuple):
    """Wrench [f; tau] in the device's base frame [N, N m]; number and time of answered state."""

    number: int
    t: float
    wrench: tuple[float, ...]


def pack_state(state: DeviceState) -> bytes:
    numbers = (*state.position, *state.quaternion_wxyz, state.force_age_s)
    return _STATE_FORMAT.pack(_STATE_TAG, state.flags, state.number, state.t, *numbers)


def unpack_state(packet: bytes) -> DeviceState | None:
    """Return the state in a packet; None for a wrong length or tag, or implausible values."""
    if len(packet) != _STATE_FORMAT.size or packet[:4] != _STATE_TAG:
        return None
    _, flags, number, t, *numbers = _STATE_FORMAT.unpack(packet)
    return valid_state(number, t, flags, numbers)


def valid_state(number: int, t: float, flags: int, numbers: Sequence[float]) -> DeviceState | None:
    """Return the state with a unit quaternion; None if position, orientation or a time is invalid.

    `numbers` (8,) are position, quaternion and `force_age_s`, which is clipped to 1 s.
    """
    x, y, z, w, i, j, k, force_age_s = numbers
    length = math.sqrt(w * w + i * i + j * j + k * k)
    # Comparisons with nan are False, so that nan is refused, too.
    if not (
        all(abs(p) <= _MAX_POSITION_M for p in (x, y, z))
        and 0.5 < length < 2.0
        and -1e12 <= t <= 1e12
        and math.isfinite(force_age_s)
    ):
        return None
    orientation = (w / length, i / length, j / length, k / length)
    force_age_s = min(max(force_age_s, 0.0), 1.0)
    return DeviceState(number, t, (x, y, z), orientation, flags & CLUTCH_OPEN_FLAG, force_age_s)


def rejection_reason(packet: bytes) -> str:
    """Return the reason for which `unpack_state` rejects a packet, as the end of a sentence."""
    if len(packet) != _STATE_FORMAT.size:
        length = len(packet) if len(packet) < MAX_PACKET_BYTES else f"more than {MAX_PACKET_BYTES}"
        return f"is {length} bytes long, not {MAX_PACKET_BYTES}"
    if packet[:3] != _STATE_TAG[:3]:
        return f"begins with {packet[:4]!r}, not {_STATE_TAG!r}"
    if packet[3:4] != _STATE_TAG[3:]:
        return f"has version {packet[3:4]!r}, not {_STATE_TAG[3:]!r}"
    return "has a position, orientation or time out of range"


def pack_force(command: ForceCommand) -> bytes:
    return _FORCE_FORMAT.pack(_FORCE_TAG, 0, command.number, command.t, *command.wrench)


def unpack_force(packet: bytes) -> ForceCommand | None:
    """Return the command in a packet; None for a wrong length or tag, or implausible values."""
    if len(packet) != _FORCE_FORMAT.size or packet[:4] != _FORCE_TAG:
        return None
    _, _, number, t, *wrench = _FORCE_FORMAT.unpack(packet)
    if not (math.isfinite(t) and all(abs(f) < _MAX_WRENCH_VALUE for f in wrench)):  # nan, too
        return None
    return ForceCommand(number, t, tuple(wrench))
