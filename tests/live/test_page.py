"""The page in a headless browser: mouse, keys, slider and a simulated gamepad."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

from browser import CHROMIUM, Page, opened

SPY = """window.effects = []; window.axes = [0, 0, 0, 0];
navigator.getGamepads = () => [{connected: true, id: "spy", axes, buttons: [],
  vibrationActuator: {playEffect: (_, how) => { effects.push(how); return Promise.resolve(); }}}];
window.path = (end) => Object.keys(frame.moves.poses).find((path) => path.endsWith(end));
window.told = (end) => frame.moves.poses[path(end)].slice(12, 15);
window.inScene = (end) => viewer.scene_tree.find(path(end).split("/").filter(Boolean))
  .object.position.toArray();
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


def speed_by_key(page: Page, slow: int, start: float) -> float:
    """Return the speed of the simulated tool while a key is held [m/s].

    It is the median over intervals of 0.1 s: the hand rests while a busy machine repeats no key.
    """
    page.run(f"say({{slow: {slow}}}); Object.assign(target, {{x: 0, y: 0, z: 0}}); 1")
    page.until(f"frame.slow === {slow} && frame.inputs.z === 0 && frame.speed > 0")
    page.until(f"Math.abs(frame.tool[2] - {start}) < 1e-3")
    page.call("Input.dispatchKeyEvent", type="keyDown", code="KeyE", key="e")
    page.until("frame.inputs.z > 2000")  # the hand has the speed
    page.run("rows.length = 0; 1")
    page.until("rows.length && frame.t > rows[0][0] + 0.8")
    t, z = np.transpose(page.run("rows"))
    page.call("Input.dispatchKeyEvent", type="keyUp", code="KeyE", key="e")
    end = np.searchsorted(t, t + 0.1)
    end = end[end < len(t)]
    return float(np.median((z[end] - z[: len(end)]) / (t[end] - t[: len(end)])))


@pytest.mark.slow
def test_keys_move_the_hand_at_the_same_simulated_speed_in_slow_motion(page):
    page.until("typeof frame !== 'undefined' && frame && frame.tool && target && viewer")
    page.run(
        "window.rows = []; show = ((before) => (said) => { before(said);"
        " rows.push([said.t, said.tool[2]]); })(show); 1"
    )
    start = page.run("frame.tool[2]")
    for slow in (1, 10, 2):
        assert speed_by_key(page, slow, start) == pytest.approx(0.12, rel=0.02)


@pytest.mark.slow
def test_a_machine_that_is_too_slow_offers_slow_motion_with_one_click(page):
    page.until("typeof frame !== 'undefined' && frame && frame.tool && target")
    page.run("say({slow: 2}); 1")
    page.until("frame.slow === 2 && at('slow').value === '2'")
    page.run("show = ((before) => (said) => before({...said, factor: 0.5}))(show); 1")
    page.until("document.querySelectorAll('#words button').length === 2")
    said = page.run("at('words').textContent")
    assert said.startswith("This machine is too slow") and said.endswith("1/5 1/10")
    page.run("[...document.querySelectorAll('#words button')][1].click()")
    page.until("frame.slow === 10 && at('slow').value === '10'")
    page.until("document.querySelectorAll('#words button').length === 0")


@pytest.mark.slow
def test_page_controls_a_drive(page):
    page.until("typeof frame !== 'undefined' && frame && frame.tool && target && viewer")
    # Meshcat sets the camera last; its default position has another direction to the right.
    page.until("Math.hypot(...view().place.map((p, k) => p - frame.tool[k])) < 2")
    x, z = page.run("[frame.tool[0], frame.tool[2]]")
    drag(page, 300, 300, 20, -10)
    page.until(f"frame.tool[0] > {x + 0.005} && frame.tool[2] > {z + 0.002}")
    page.until("loaded && inScene('_tool').every((p, k) => Math.abs(p - told('_tool')[k]) < 1e-6)")
    page.until(
        f"inScene('_tool')[0] > {x - 0.1} && inScene('measured_at_wrist/shaft').some(Boolean)"
    )
    page.run("Object.assign(target, {x: 0, y: 0, z: 0})")
    for event in ("keyDown", "keyUp"):
        page.call("Input.dispatchKeyEvent", type=event, code="Space", key=" ")
        page.until(f"frame.inputs.clutch === {int(event == 'keyUp')}")
    page.call("Input.dispatchKeyEvent", type="keyDown", code="KeyE", key="e")
    page.until("frame.inputs.z > 500")
    page.call("Input.dispatchKeyEvent", type="keyUp", code="KeyE", key="e")
    page.until(f"frame.t > {page.run('frame.t')} + 0.2")
    z = page.run("frame.inputs.z")
    page.until(f"frame.t > {page.run('frame.t')} + 0.2 && frame.inputs.z === target.z")
    assert page.run("frame.inputs.z") == z > 200
    page.run("Object.assign(target, {x: 0, y: 0, z: 0})")
    page.run("at('sigma').value = 40; at('sigma').dispatchEvent(new Event('input'))")
    page.until("frame.inputs.sigma === 40")

    # Vibration by the measured force always, by the contact force only in contact.
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
