"""The page in a browser without a window: mouse, keys, slider, and a gamepad that is a spy."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Iterator
from itertools import count
from typing import Any
from urllib.request import urlopen

import pytest
from websockets.sync.client import ClientConnection, connect

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
SPY = """window.effects = []; window.axes = [0, 0, 0, 0];
navigator.getGamepads = () => [{connected: true, id: "spy", axes, buttons: [],
  vibrationActuator: {playEffect: (_, how) => { effects.push(how); return Promise.resolve(); }}}];
// Drawing without a graphics card takes longer than all else.
addEventListener("DOMContentLoaded", () => { MeshCat.Viewer.prototype.render = () => {}; });"""


class Browser:
    """A page, through the browser's own debugging socket."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket, self._numbers = socket, count()
        self.errors: list[str] = []
        for domain in ("Runtime", "Page"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            message = json.loads(self._socket.recv(90.0))
            if message.get("method") == "Runtime.exceptionThrown":
                self.errors.append(
                    message["params"]["exceptionDetails"]["exception"]["description"]
                )
            if message.get("id") == number:
                return message["result"]

    def run(self, script: str) -> Any:
        """The value of a script; of what it waits for, if it waits."""
        found = self.call(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def until(self, condition: str) -> None:
        """Waits for what becomes true in the page, 60 s at most."""
        assert self.run(
            f"new Promise((done) => {{ const end = Date.now() + 60000; const look = () => {{"
            f" if ({condition}) done(true); else if (Date.now() > end) done(false);"
            " else setTimeout(look, 20); }; look(); })"
        ), f"{condition}; {self.errors}"


@pytest.fixture
def browser(live, tmp_path) -> Iterator[Browser]:
    if CHROMIUM is None:
        pytest.skip("there is no Chromium here")
    options = ("--headless", "--no-sandbox", "--remote-debugging-port=0", "--disable-gpu")
    process = subprocess.Popen(
        [CHROMIUM, *options, "--enable-unsafe-swiftshader", f"--user-data-dir={tmp_path}"],
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stderr is not None
        said = next(line for line in process.stderr if "DevTools listening" in line)
        port = said.rpartition(":")[2].partition("/")[0]
        tabs = json.load(urlopen(f"http://127.0.0.1:{port}/json"))
        address = next(tab["webSocketDebuggerUrl"] for tab in tabs if tab["type"] == "page")
        with connect(address, max_size=None, origin=None) as socket:
            page = Browser(socket)
            page.call("Page.addScriptToEvaluateOnNewDocument", source=SPY)
            page.call("Page.navigate", url=live.url)
            yield page
    finally:
        process.kill()
        process.communicate()


def drag(browser: Browser, x: int, y: int, dx: int, dy: int) -> None:
    for kind, k in (("Pressed", 0), *(("Moved", k) for k in range(1, 6)), ("Released", 5)):
        browser.call(
            "Input.dispatchMouseEvent", type=f"mouse{kind}", x=x + dx * k / 5, y=y + dy * k / 5,
            button="left", buttons=int(kind != "Released"), clickCount=1,
        )  # fmt: skip


@pytest.mark.slow
def test_the_page_drives(browser):
    browser.until("typeof frame !== 'undefined' && frame && frame.tool && target && viewer")
    # Meshcat tells where the camera is after all else; from its own place, right is another way.
    browser.until("Math.hypot(...view().place.map((p, k) => p - frame.tool[k])) < 2")
    x, z = browser.run("[frame.tool[0], frame.tool[2]]")
    drag(browser, 300, 300, 20, -10)
    browser.until(f"frame.tool[0] > {x + 0.005} && frame.tool[2] > {z + 0.002}")
    browser.run("Object.assign(target, {x: 0, y: 0, z: 0})")
    for event in ("keyDown", "keyUp"):
        browser.call("Input.dispatchKeyEvent", type=event, code="Space", key=" ")
        browser.until(f"frame.inputs.clutch === {int(event == 'keyUp')}")
    browser.run("at('sigma').value = 40; at('sigma').dispatchEvent(new Event('input'))")
    browser.until("frame.inputs.sigma === 40")

    # Vibration: of what is measured always, of the contact not before there is one.
    browser.until("frame.f[1][1] < 0.05 && frame.inputs.z === 0")
    browser.run("effects.length = 0; at('by-measured').click()")
    browser.until("effects.length > 2")
    browser.run("at('by-contact').click(); effects.length = 0; axes[0] = .5")
    browser.until("frame.inputs.x > 500")
    assert browser.run("effects.length") == 0
    drive = browser.run("axes[0] = 0; at('reset').click(); frame.drive")
    browser.until(f"frame.drive === {drive + 1} && target && target.x === 0")
    browser.run("target.z = -4000")
    browser.until("effects.length > 2 && frame.contact")
    assert 0.0 < browser.run("effects[0].strongMagnitude") <= 1.0

    # Another network and an object, while it presses; then the socket is lost for a moment.
    browser.run("at('network').value = 2; at('network').dispatchEvent(new Event('change'))")
    browser.run("at('object').click()")
    browser.until("frame.inputs.network === 2 && frame.inputs.object === 1 && frame.contact")
    you = browser.run("socket.close(); hello.you")
    browser.until(f"hello.you > {you} && drives && target && frame.inputs.network === 2")
    assert browser.run("frame.inputs.held") == 1

    browser.call(
        "Emulation.setDeviceMetricsOverride",
        width=400, height=800, deviceScaleFactor=1, mobile=True,
    )  # fmt: skip
    browser.until("innerWidth === 400")
    assert browser.run("document.scrollingElement.scrollWidth") <= 400
    assert browser.errors == []
