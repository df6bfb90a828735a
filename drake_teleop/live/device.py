"""Which haptic device drives: one that sends by itself, or one whose client is started here."""

from __future__ import annotations

import subprocess
import sys

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.live.device_link import DeviceLink
from drake_teleop.robots.udp import THIS_MACHINE

_ENDS = 2.0  # s


class DrivenBy:
    """The link to a device, and the device's client if it is ours to start.

    Attributes:
        link: to the device.

    Args:
        address: udp://127.0.0.1:PORT, on which a device's client is listened to; or
            haply://HOST:PORT, an Inverse3 at Haply's service.

    Raises:
        DrakeTeleopError: for another address, or a port that is taken.
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
        """Ends both; a client that is gone leaves its device without force."""
        self.link.close()
        if self._client is None:
            return
        self._client.terminate()
        try:
            self._client.wait(_ENDS)
        except subprocess.TimeoutExpired:
            self._client.kill()
            self._client.wait()
