"""Client of a Haply Inverse3, through the websocket of Haply's Inverse Service 3.

Tested only with a virtual service, not with the device.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Sequence
from typing import Any
from urllib.parse import urlsplit

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.live.device_guard import DeviceLimits
from drake_teleop.live.device_packets import CLUTCH_OPEN_FLAG, DeviceState, valid_state

_MAX_MESSAGE_BYTES, _RECEIVE_TIMEOUT_S = 65536, 0.5  # bytes of a message, s
_START_SERVICE_REMEDY = "start Haply's Inverse Service"
_GRIP_JSON_KEYS = ("wireless_verse_grip", "verse_grip", "wired_verse_grip", "custom_verse_grip")


def parse_device_message(text: Any) -> tuple[str, DeviceState] | None:
    """Return device name and state, in the device's base frame B; None without a valid pose."""
    if not isinstance(text, (str, bytes)) or len(text) > _MAX_MESSAGE_BYTES:
        return None
    try:
        content = json.loads(text)
        cursor = content["inverse3"][0]
        place, name = cursor["state"]["cursor_position"], cursor["device_id"]
        x, y, z = (_require_finite_float(place[axis]) for axis in "xyz")
        grip: Any = next((content[k][0]["state"] for k in _GRIP_JSON_KEYS if content.get(k)), {})
        turn = grip.get("orientation") or {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}
        w, i, j, k = (_require_finite_float(turn[axis]) for axis in "wxyz")
        pressed = (grip.get("buttons") or {}).get("a") is True
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError):
        return None
    if not isinstance(name, str):
        return None
    flags = CLUTCH_OPEN_FLAG if pressed else 0
    state = valid_state(0, 0.0, flags, (-y, x, z, w, -j, i, k, 0.0))
    return None if state is None else (name, state)


def make_force_message(device: str, wrench: Sequence[float]) -> str:
    f_x, f_y, f_z = wrench[:3]
    values = {"x": f_y, "y": -f_x, "z": f_z}
    return json.dumps(
        {"inverse3": [{"device_id": device, "commands": {"set_cursor_force": {"values": values}}}]}
    )


def _require_finite_float(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e9:
        raise ValueError(value)
    return float(value)


class HaplyDevice:
    """Haply Inverse3 at haply://HOST:PORT."""

    limits = DeviceLimits(force=8.0)  # N; the peak of the device is 10 N (data sheet)

    def __init__(self, address: str) -> None:
        from websockets.sync.client import connect

        self._open = contextlib.ExitStack()
        try:
            parts = urlsplit(address)
            url = f"ws://{parts.hostname or 'localhost'}:{parts.port or 10001}"
            limits: Any = {"max_size": _MAX_MESSAGE_BYTES, "open_timeout": 2, "close_timeout": 1}
            opened = connect(url, **limits, compression=None, proxy=None)
            self._socket = self._open.enter_context(opened)
        except (OSError, TimeoutError, ValueError) as error:
            what = f"Haply's service does not answer ({error})"
            raise DrakeTeleopError(what, where=address, remedy=_START_SERVICE_REMEDY) from error
        self._device = ""

    def read(self) -> DeviceState | None:
        from websockets.exceptions import ConnectionClosed

        try:
            message = parse_device_message(self._socket.recv(timeout=_RECEIVE_TIMEOUT_S))
        except TimeoutError:
            return None
        except ConnectionClosed as error:
            what = "Haply's service has closed the connection"
            raise DrakeTeleopError(what, where="haply", remedy=_START_SERVICE_REMEDY) from error
        if message is None:
            return None
        self._device, state = message
        return state

    def set_wrench(self, wrench: Sequence[float]) -> None:
        from websockets.exceptions import ConnectionClosed

        with contextlib.suppress(ConnectionClosed):  # `read` reports it
            self._socket.send(make_force_message(self._device, wrench) if self._device else "{}")

    def close(self) -> None:
        self.set_wrench((0.0,) * 6)
        self._open.close()
