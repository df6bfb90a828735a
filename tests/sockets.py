"""Who listens, by what Linux says of its sockets."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path


def listening() -> set[str]:
    """Where this process and those that it has started listen, in Linux' hexadecimal."""
    mine = {os.getpid()}
    for _ in range(3):  # the children of children
        for stat in Path("/proc").glob("[0-9]*/stat"):
            with suppress(OSError):
                if int(stat.read_text().rpartition(")")[2].split()[1]) in mine:
                    mine.add(int(stat.parent.name))
    inodes = set()
    for pid in mine:
        for file in Path(f"/proc/{pid}/fd").glob("*"):
            with suppress(OSError):
                inodes.add(os.readlink(file))
    addresses = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            words = line.split()
            if words[3] == "0A" and f"socket:[{words[9]}]" in inodes:
                addresses.add(words[1].rpartition(":")[0])
    return addresses


THIS_MACHINE = {"0100007F", "00000000000000000000000001000000", "0000000000000000FFFF00000100007F"}
"""127.0.0.1, ::1, and the first as IPv6 has it."""
