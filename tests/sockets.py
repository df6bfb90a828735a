"""Listening sockets of processes, from /proc on Linux."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

THIS_MACHINE = {"0100007F", "00000000000000000000000001000000", "0000000000000000FFFF00000100007F"}
"""127.0.0.1, ::1, and the first in IPv6 notation."""

on_purpose: set[int] = set()
"""Ports that tests open to other machines deliberately."""

_of_others: set[str] = set()


def listening() -> set[str]:
    """Return the listening addresses of this process and its descendants, in hexadecimal."""
    mine = _inodes()
    return {address for address, _, inode in _listeners() if inode in mine}


def ports() -> set[int]:
    """Return the ports on which this process and its descendants listen."""
    mine = _inodes()
    return {port for _, port, inode in _listeners() if inode in mine}


def open_to_others() -> set[str]:
    """Return the entries of `listening` that other machines can reach; faster than `listening`."""
    there = [
        (address, inode)
        for address, port, inode in _listeners()
        if address not in THIS_MACHINE and port not in on_purpose and inode not in _of_others
    ]
    mine = _inodes() if there else set()
    _of_others.update(inode for _, inode in there if inode not in mine)
    return {address for address, inode in there if inode in mine}


def _listeners() -> Iterator[tuple[str, int, str]]:
    """Return address, port and socket number of all listening sockets of this machine."""
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            words = line.split()
            if words[3] == "0A":
                address, _, port = words[1].rpartition(":")
                yield address, int(port, 16), f"socket:[{words[9]}]"


def _inodes() -> set[str]:
    """Return the socket numbers that this process and its descendants have open."""
    mine, inodes = {os.getpid()}, set()
    for _ in range(3):  # children of children, too
        for stat in Path("/proc").glob("[0-9]*/stat"):
            with suppress(OSError):
                if int(stat.read_text().rpartition(")")[2].split()[1]) in mine:
                    mine.add(int(stat.parent.name))
    for pid in mine:
        with suppress(OSError):
            for file in Path(f"/proc/{pid}/fd").iterdir():
                with suppress(OSError):
                    inodes.add(os.readlink(file))
    return inodes
