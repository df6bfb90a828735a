"""Shell blocks of the documentation pages, and their execution by tests.

A test runs a block of the language `sh` by `type_in` with its page and its first words.
`tests/test_shell_blocks.py` finds blocks that no test runs. A comment above such a block states
the reason, see `Block`.
"""

from __future__ import annotations

import contextlib
import re
import shlex
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from drake_teleop.cli.main import main

ROOT = Path(__file__).parents[1]
PAGES = (
    *("README.md", "CONTRIBUTING.md", "benchmarks/README.md"),
    *(str(path.relative_to(ROOT)) for path in sorted((ROOT / "docs").glob("*.md"))),
)
_BLOCK = re.compile(r"((?:^<!-- [^\n]* -->\n)*)^```sh\n(.*?)^```$", re.M | re.S)


class Block(NamedTuple):
    """Shell block of a page.

    Attributes:
        page, text: page and content of the block.
        said: the comments above it: "not run by the tests: " and the reason, or "run by the tests
            in small: " and how the tested block differs.
    """

    page: str
    text: str
    said: str

    @property
    def left_out(self) -> str:
        """Reason why no test runs the block; "" if a test does."""
        return "".join(re.findall(r"not run by the tests: (.*) -->", self.said))

    @property
    def commands(self) -> list[str]:
        """Commands, one per line, with programs of the environment by their names alone."""
        lines = self.text.replace("\\\n", " ").replace(".venv/bin/", "").splitlines()
        return [" ".join(line.split()) for line in lines]


def shell_blocks() -> list[Block]:
    """Return the shell blocks of all pages."""
    return [
        Block(page, text, said)
        for page in PAGES
        for said, text in _BLOCK.findall((ROOT / page).read_text(encoding="utf-8"))
    ]


def the_block(page: str, start: str) -> Block:
    """Return the only block of the page that begins with `start` and that a test may run."""
    (found,) = (b for b in shell_blocks() if b.page == page and b.text.startswith(start))
    assert not found.left_out
    return found


def press_ctrl_c(number: signal.Signals = signal.SIGINT) -> None:
    """Send SIGINT to the main thread of this process, as a terminal does."""
    main_thread = threading.main_thread().ident
    assert main_thread is not None
    signal.pthread_kill(main_thread, number)


@contextlib.contextmanager
def hearing_ctrl_c() -> Iterator[None]:
    """Handle Ctrl-C although workers and background processes ignore it by default."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def type_in(
    page: str, start: str, *, status: int = 0, ctrl_c: threading.Event | None = None
) -> None:
    """Run the lines of a block in this folder; check the exit status of each command.

    Programs other than `drake-teleop` run in their own processes, which get a Ctrl-C at the event.
    """
    for command in the_block(page, start).commands:
        text, _, file = command.partition(" > ")
        program, *words = shlex.split(text)
        with contextlib.ExitStack() as stack:
            stack.enter_context(hearing_ctrl_c())
            if file:
                stack.enter_context(
                    contextlib.redirect_stdout(stack.enter_context(open(file, "w")))
                )
            if program == "drake-teleop":
                with pytest.raises(SystemExit) as stop:
                    main(words)
                assert stop.value.code == status, command
            else:
                assert program == "python", command
                with subprocess.Popen([sys.executable, *words]) as process:
                    if ctrl_c is not None:
                        ctrl_c.wait(60.0)
                        process.send_signal(signal.SIGINT)
                assert process.returncode == status, command
