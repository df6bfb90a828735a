"""Haptic device of a drive."""

from __future__ import annotations

import subprocess
import sys

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.live.device_link import DeviceLink
from drake_teleop.robots.udp import THIS_MACHINE

_ENDS = 2.0  # s


class DrivenBy:
    """Link to a haptic device, and the client process if this program starts it.

    Args:
        address: udp://127.0.0.1:PORT of a device client, or haply://HOST:PORT of an Inverse3.

    Raises:
        DrakeTeleopError: for another address, or if the port is in use.
    """

    def __init__(self, address: str) -> None:
        kind = address.partition("://")[0]
        if kind not in ("udp", "haply"):
            raise DrakeTeleopError(
                "is no haptic device",
                where=address,
                remedy="give udp://127.0.0.1:PORT or haply://localhost:10001",
            )
        self.link = DeviceLink(address if kind == "udp" else f"udp://{THIS_MACHINE}:0")
        self._client: subprocess.Popen[bytes] | None = None
        if kind == "haply":
            station = f"udp://{THIS_MACHINE}:{self.link.port}"
            client = [sys.executable, "-m", "drake_teleop.live.device_client", address, station]
            self._client = subprocess.Popen(client, stdout=subprocess.DEVNULL)

    def close(self) -> None:
        """Close the link and end the client, which releases the device."""
        self.link.close()
        if self._client is None:
            return
        self._client.terminate()
        try:
            self._client.wait(_ENDS)
        except subprocess.TimeoutExpired:
            self._client.kill()
            self._client.wait()
