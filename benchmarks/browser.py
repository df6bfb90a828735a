"""Page in headless Chromium, controlled through the browser's debugging socket.

`live_page.py`, the film of a drive (docs/make_film.py) and the test of the page use it.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from typing import Any, TypeVar
from urllib.request import urlopen

from websockets.sync.client import ClientConnection, connect

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
"""Path of Chromium; None if it is not installed."""
_OPTIONS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--enable-unsafe-swiftshader",
)  # fmt: skip


class Page:
    """Open page; `errors` contains the exceptions of its scripts."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket, self._numbers = socket, count()
        self._answers: dict[int, dict[str, Any]] = {}
        self.errors: list[str] = []

    def send(self, method: str, **params: Any) -> int:
        """Send a command to the browser; return the number of its answer without waiting."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": params}))
        return number

    def answer(self, number: int) -> dict[str, Any]:
        """Wait for the answer with that number."""
        while number not in self._answers:
            message = json.loads(self._socket.recv(90.0))
            if "id" in message:
                self._answers[message["id"]] = message
            else:
                self.heard(message["method"], message["params"])
        found = self._answers.pop(number)
        assert "error" not in found, found
        return found["result"]

    def heard(self, event: str, params: Any) -> None:
        """Handle an event of the browser."""
        if event == "Runtime.exceptionThrown":
            self.errors.append(params["exceptionDetails"]["exception"]["description"])

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Send a command to the browser, and wait for its answer."""
        return self.answer(self.send(method, **params))

    def run(self, script: str) -> Any:
        """Return the value of a script, after the promise that it may return."""
        found = self.call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def until(self, condition: str) -> None:
        """Wait until a condition is true in the page, 60 s at most."""
        assert self.run(
            f"new Promise((done) => {{ const end = Date.now() + 60000; const look = () => {{"
            f" if ({condition}) done(true); else if (Date.now() > end) done(false);"
            " else setTimeout(look, 20); }; look(); })"
        ), f"{condition}; {self.errors}"

    def mouse(self, kind: str, x: float, y: float) -> None:
        """Send "Pressed" or "Released" of the left button, or "Moved", of the mouse [pixels]."""
        self.call(
            "Input.dispatchMouseEvent", type=f"mouse{kind}", x=x, y=y, button="left",
            buttons=int(kind != "Released"), clickCount=1,
        )  # fmt: skip


AnyPage = TypeVar("AnyPage", bound=Page)


@contextmanager
def opened(
    url: str, script: str, page: type[AnyPage], more: Sequence[str] = ()
) -> Iterator[AnyPage]:
    """Open a page in headless Chromium and simulate focus.

    Args:
        url: its address.
        script: runs before the scripts of the page.
        page: class of the result.
        more: options of the browser.

    Raises:
        FileNotFoundError: if there is no Chromium.
    """
    if CHROMIUM is None:
        raise FileNotFoundError("there is no Chromium here: install chromium or google-chrome")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        process = subprocess.Popen(
            [CHROMIUM, *_OPTIONS, *more, f"--user-data-dir={folder}"],
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            with connect(_tab(process), max_size=None, origin=None) as socket:
                shown = page(socket)
                for domain in ("Runtime", "Page"):
                    shown.call(f"{domain}.enable")
                shown.call("Emulation.setFocusEmulationEnabled", enabled=True)
                shown.call("Page.addScriptToEvaluateOnNewDocument", source=script)
                shown.call("Page.navigate", url=url)
                yield shown
        finally:
            process.kill()
            process.communicate()


def _tab(process: subprocess.Popen[str]) -> str:
    """Return the debugging socket of the browser's only page."""
    assert process.stderr is not None
    said = next((line for line in process.stderr if "DevTools listening" in line), None)
    assert said is not None, f"Chromium ended with status {process.wait()}"
    port = said.rpartition(":")[2].partition("/")[0]
    with urlopen(f"http://127.0.0.1:{port}/json") as tabs:
        return next(tab["webSocketDebuggerUrl"] for tab in json.load(tabs) if tab["type"] == "page")
