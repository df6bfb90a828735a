"""Sinks for Foxglove, live or in an MCAP file: JSON in the topic `/wrench`."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path
from typing import Any

from drake_teleop.common.errors import DrakeTeleopError, require_library
from drake_teleop.common.files import make_folder, wrap_write_errors
from drake_teleop.logs.read.canonical import WRENCH_COLUMNS
from drake_teleop.robots.lines import flag_names
from drake_teleop.robots.streams import CompensatedWrench
from drake_teleop.robots.udp import host_and_port

DEFAULT_SERVER_PORT = 8765
WRENCH_TOPIC = "/wrench"


class _WrenchChannelSink:
    def __init__(self, where: str) -> None:
        require_library("foxglove", "foxglove-sdk", "robots", where)
        import foxglove

        schema = resources.files("drake_teleop.robots") / "foxglove_schema.json"
        self._context = foxglove.Context()
        options = {"schema": json.loads(schema.read_bytes()), "context": self._context}
        self._channel = foxglove.Channel(WRENCH_TOPIC, **options)

    def _log_wrench(self, out: CompensatedWrench, time_ns: int | None) -> None:
        data: dict[str, Any] = {"number": out.number, "t": out.t, "flags": flag_names(out.flags)}
        for name, wrench in (("contact", out.contact), ("scaled", out.scaled)):
            data[name] = dict(zip(WRENCH_COLUMNS, wrench.tolist(), strict=True))
        self._channel.log(json.dumps(data).encode(), log_time=time_ns)


class FoxgloveSink(_WrenchChannelSink):
    """Sink with a server at foxglove://[HOST][:PORT]; messages have this computer's time."""

    def __init__(self, address: str) -> None:
        host, port = host_and_port(address, DEFAULT_SERVER_PORT)
        super().__init__(address)
        import foxglove

        options: dict[str, Any] = {"name": "drake_teleop", "context": self._context}
        try:
            self._server = foxglove.start_server(host=host, port=port, **options)
        except (OSError, RuntimeError) as error:
            remedy = "give a free port, and a host of this machine"
            raise DrakeTeleopError(str(error), where=address, remedy=remedy) from error
        self.port = self._server.port

    def write(self, out: CompensatedWrench) -> None:
        self._log_wrench(out, None)

    def close(self) -> None:
        self._channel.close()
        self._server.stop()


class McapSink(_WrenchChannelSink):
    """Sink that writes an MCAP file continuously; messages have the times of the readings."""

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        import foxglove

        make_folder(path.parent)
        with wrap_write_errors(path):
            self._file = foxglove.open_mcap(path, allow_overwrite=True, context=self._context)

    def write(self, out: CompensatedWrench) -> None:
        self._log_wrench(out, round(1e9 * min(max(out.t, 0.0), 1e9 * 18)))

    def close(self) -> None:
        self._file.close()
        self._channel.close()
