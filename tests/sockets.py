"""Who listens, by what Linux says of its sockets."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

THIS_MACHINE = {"0100007F", "00000000000000000000000001000000", "0000000000000000FFFF00000100007F"}
"""127.0.0.1, ::1, and the first as IPv6 has it."""

on_purpose: set[int] = set()
"""Ports that a test opens to other machines."""

_of_others: set[str] = set()


def listening() -> set[str]:
    """Where this process and those that it has started listen, in Linux' hexadecimal."""
    mine = _inodes()
    return {address for address, _, inode in _listeners() if inode in mine}


def ports() -> set[int]:
    """On which ports they listen."""
    mine = _inodes()
    return {port for _, port, inode in _listeners() if inode in mine}


def open_to_others() -> set[str]:
    """As `listening`, without what this machine alone reaches; quicker, to be asked often."""
    there = [
        (address, inode)
        for address, port, inode in _listeners()
        if address not in THIS_MACHINE and port not in on_purpose and inode not in _of_others
    ]
    mine = _inodes() if there else set()
    _of_others.update(inode for _, inode in there if inode not in mine)
    return {address for address, inode in there if inode in mine}


def _listeners() -> Iterator[tuple[str, int, str]]:
    """Address, port and socket of all that listen on this machine."""
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            words = line.split()
            if words[3] == "0A":
                address, _, port = words[1].rpartition(":")
                yield address, int(port, 16), f"socket:[{words[9]}]"


def _inodes() -> set[str]:
    """What this process and those that it has started hold open."""
    mine, inodes = {os.getpid()}, set()
    for _ in range(3):  # the children of children
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
