"""The page in a browser without a window: mouse, keys, slider, and a gamepad that is a spy."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from browser import CHROMIUM, Page, opened

SPY = """window.effects = []; window.axes = [0, 0, 0, 0];
navigator.getGamepads = () => [{connected: true, id: "spy", axes, buttons: [],
  vibrationActuator: {playEffect: (_, how) => { effects.push(how); return Promise.resolve(); }}}];
// Drawing without a graphics card takes longer than all else.
addEventListener("DOMContentLoaded", () => { MeshCat.Viewer.prototype.render = () => {}; });"""


@pytest.fixture
def page(live) -> Iterator[Page]:
    if CHROMIUM is None:
        pytest.skip("there is no Chromium here")
    with opened(live.url, SPY, Page) as shown:
        yield shown


def drag(page: Page, x: int, y: int, dx: int, dy: int) -> None:
    for kind, k in (("Pressed", 0), *(("Moved", k) for k in range(1, 6)), ("Released", 5)):
        page.mouse(kind, x + dx * k / 5, y + dy * k / 5)


@pytest.mark.slow
def test_the_page_drives(page):
    page.until("typeof frame !== 'undefined' && frame && frame.tool && target && viewer")
    # Meshcat tells where the camera is after all else; from its own place, right is another way.
    page.until("Math.hypot(...view().place.map((p, k) => p - frame.tool[k])) < 2")
    x, z = page.run("[frame.tool[0], frame.tool[2]]")
    drag(page, 300, 300, 20, -10)
    page.until(f"frame.tool[0] > {x + 0.005} && frame.tool[2] > {z + 0.002}")
    page.run("Object.assign(target, {x: 0, y: 0, z: 0})")
    for event in ("keyDown", "keyUp"):
        page.call("Input.dispatchKeyEvent", type=event, code="Space", key=" ")
        page.until(f"frame.inputs.clutch === {int(event == 'keyUp')}")
    page.call("Input.dispatchKeyEvent", type="keyDown", code="KeyE", key="e")
    page.until("frame.inputs.z > 500 && ahead[2] > 0")  # the hand hangs back behind what it is led
    page.call("Input.dispatchKeyEvent", type="keyUp", code="KeyE", key="e")
    page.until("ahead[2] === 0 && frame.inputs.z === Math.round(target.z)")
    page.run("Object.assign(target, {x: 0, y: 0, z: 0})")
    page.run("at('sigma').value = 40; at('sigma').dispatchEvent(new Event('input'))")
    page.until("frame.inputs.sigma === 40")

    # Vibration: of what is measured always, of the contact not before there is one.
    page.until("frame.f[1][1] < 0.05 && frame.inputs.z === 0")
    page.run("effects.length = 0; at('by-measured').click()")
    page.until("effects.length > 2")
    page.run("at('by-contact').click(); effects.length = 0; axes[0] = .5")
    page.until("frame.inputs.x > 500")
    assert page.run("effects.length") == 0
    drive = page.run("axes[0] = 0; at('reset').click(); frame.drive")
    page.until(f"frame.drive === {drive + 1} && target && target.x === 0")
    page.run("target.z = -4000")
    page.until("effects.length > 2 && frame.contact")
    assert 0.0 < page.run("effects[0].strongMagnitude") <= 1.0

    # Another network and an object, while it presses; then the socket is lost for a moment.
    page.run("at('network').value = 2; at('network').dispatchEvent(new Event('change'))")
    page.run("at('object').click()")
    page.until("frame.inputs.network === 2 && frame.inputs.object === 1 && frame.contact")
    you = page.run("socket.close(); hello.you")
    page.until(f"hello.you > {you} && drives && target && frame.inputs.network === 2")
    assert page.run("frame.inputs.held") == 1

    page.call(
        "Emulation.setDeviceMetricsOverride",
        width=400, height=800, deviceScaleFactor=1, mobile=True,
    )  # fmt: skip
    page.until("innerWidth === 400")
    assert page.run("document.scrollingElement.scrollWidth") <= 400
    assert page.errors == []
