"""How soon does the page show the driver's input, and when does a gamepad vibrate?

    python benchmarks/live_page.py [--trials 20] [--seconds 60] [--json FILE]

The page runs in headless Chromium without drawing (which takes longest without a graphics card).
Latency is the time until the tool has moved by 0.2 mm in the page's scene. It starts with the
browser's time stamp of a pointer's move by 20 pixels or of a key, or with the push of a stick. Key
and stick move the hand at 0.12 m/s. The baseline is the time that hand, device and arm take to move
the tool that far, in simulated time (`way`). Vibration: time from the slice in which the contact
force at the hand exceeds 0.5 N to `playEffect` of a simulated gamepad. Without a browser and in
virtual time: share of frames of fast free vertical motion in which a gamepad would vibrate, by the
contact force and by the measured one.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from browser import CHROMIUM, Page, opened

from drake_teleop.lab.identification import slave_arm
from drake_teleop.lab.identified_load import identified_load
from drake_teleop.live.hand import TARGET_LEAD_TIME_S
from drake_teleop.live.live import MIN_GAMEPAD_TOUCH_FORCE_N, Live
from drake_teleop.live.scenarios import live_scenario
from drake_teleop.live.server import LiveDrive, drive
from drake_teleop.live.session import Session
from drake_teleop.station.scenario import LoadScenario
from drake_teleop.station.slave.arm import forward_kinematics

SPY = """window.effects = []; window.axes = [0, 0, 0, 0];
navigator.getGamepads = () => [{connected: true, id: "spy", axes, buttons: [],
  vibrationActuator: {playEffect: () => {
    effects.push(performance.timeOrigin + performance.now()); return Promise.resolve(); }}}];
addEventListener("DOMContentLoaded", () => {
  MeshCat.Viewer.prototype.render = () => {};
  const handle = MeshCat.Viewer.prototype.handle_command;
  MeshCat.Viewer.prototype.handle_command = function (command) {
    handle.call(this, command);
    if (command.type !== "set_transform" || !/tool$/.test(command.path)) return;
    window.place = [12, 13, 14].map((k) => command.matrix[k]);
    if (window.wait && !wait.since) wait.place = [...place];
    if (window.wait && Math.hypot(...place.map((p, k) => p - wait.place[k])) > 2e-4) {
      wait.done(performance.now() - wait.since);
      window.wait = null;
    }
  };
});
for (const name of ["pointermove", "keydown"])
  addEventListener(name, (event) => {
    if (window.wait && !wait.since) wait.since = event.timeStamp; }, true);
window.moved = () => new Promise((done) => {
  window.wait = {done, place: [...place], since: 0};
  setTimeout(() => done(null), 10000); });"""


def latencies(page: Page, trials: int) -> dict[str, list[float | None]]:
    """Return the times from an input until the tool has moved [ms], by kind of input."""
    found: dict[str, list[float | None]] = {"pointer": [], "key": [], "stick": []}
    for trial in range(trials):
        for kind, times in found.items():
            page.run("Object.assign(target, {x: 0, y: 0, z: 0}); 1")
            time.sleep(1.5)
            if kind == "pointer":
                page.mouse("Pressed", 300, 300)
            page.run("window.until = moved(); 1")  # before the input, whose message has priority
            sign = 1 - 2 * (trial % 2)
            if kind == "pointer":
                page.mouse("Moved", 300 + 20 * sign, 300)
            elif kind == "key":
                code = "KeyE" if sign > 0 else "KeyQ"
                page.send("Input.dispatchKeyEvent", type="keyDown", code=code, key=code[-1])
            else:
                page.send("Runtime.evaluate", expression=STICK.replace("SIGN", str(sign)))
            times.append(page.run("until"))
            page.mouse("Released", 300, 300)
            page.send("Input.dispatchKeyEvent", type="keyUp", code="KeyE", key="E")
            page.send("Input.dispatchKeyEvent", type="keyUp", code="KeyQ", key="Q")
            page.run("axes[0] = 0; 1")
    return found


STICK = "axes[0] = SIGN; wait.since = performance.now()"


def way(speed: float = 0.12) -> float:
    """Return the time of hand, device and arm to move the tool by 0.2 mm, as by a key [ms].

    The target leads the moving hand at that speed [m/s], as in the page.
    """
    scenario = live_scenario(LoadScenario("touch"))
    session, table = Session(scenario, identified_load(scenario)), slave_arm(scenario).table
    session.advance(1000)
    session.new_rows()
    R_WS, start, place = np.empty((3, 3)), np.full(3, np.nan), np.empty(3)
    while True:
        ahead = TARGET_LEAD_TIME_S + 1e-3 * (session.ms - 1000)
        session.apply_inputs(session.inputs.with_changes({"z": 1e5 * speed * ahead}))
        session.advance(1)
        q = session.new_rows()["slave_state"][-1, : table.shape[0] - 1]
        forward_kinematics(table, q, R_WS, place)
        start = place.copy() if np.isnan(start[0]) else start
        if np.linalg.norm(place - start) > 2e-4:
            return float(session.ms - 1000)


def vibration(page: Page, driven: LiveDrive, trials: int) -> list[float | None]:
    """Return the times from the slice with a contact of 0.5 N to the gamepad's effect [ms]."""
    session = driven._live._session
    found: list[float | None] = []
    touched: list[float] = []
    advance = session.advance

    def watched(ms: int) -> None:
        start = time.time()
        advance(ms)
        if not touched and session.contact_force() > 0.5:
            touched.append(start)

    session.advance = watched  # type: ignore[method-assign]
    for _ in range(trials):
        page.run("Object.assign(target, {x: 0, y: 0, z: 0}); 1")
        time.sleep(1.5)
        touched.clear()
        page.run("effects.length = 0; target.z = -9000; 1")
        time.sleep(1.5)
        effects = page.run("effects")
        found.append(effects[0] - 1e3 * touched[0] if touched and effects else None)
    return found


def in_the_browser(trials: int) -> dict[str, float]:
    """Return the figures of a page in headless Chromium."""
    driven = drive("touch")
    try:
        with opened(driven.url, SPY, Page) as page:
            page.until("window.place && typeof target !== 'undefined' && target")
            figures = {}
            for kind, times in (
                *latencies(page, trials).items(),
                ("vibration", vibration(page, driven, trials)),
            ):
                known = [x for x in times if x is not None] or [np.nan]
                p50, p95 = np.percentile(known, [50, 95])
                figures |= {f"{kind}_p50_ms": float(p50), f"{kind}_p95_ms": float(p95)}
                figures[f"{kind}_not_in_10_s"] = trials - len(known)
            figures["real_time_factor"] = page.run("frame.factor")
    finally:
        driven.stop()
    return figures | {"way_of_key_and_stick_ms": way()}


class Clock:
    """Clock that advances only on request."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def free_motion(seconds: float) -> dict[str, float]:
    """Return the share of frames of fast free motion in which a gamepad would vibrate."""
    scenario = live_scenario(LoadScenario("touch"))
    clock, seen, fastest = Clock(), [], 0.0

    def show(rows: dict[str, np.ndarray]) -> None:
        nonlocal fastest
        size = np.linalg.norm(rows["specific_force_S"], axis=1)
        fastest = max(fastest, float(np.abs(size - 9.81).max()))

    live = Live(scenario, identified_load(scenario), None, show, clock())
    live.join(1, clock())
    while clock.now < seconds + 2.0:
        share = min(clock.now, 2.0) / 2.0
        z = share * (4000.0 + 9000.0 * np.sin(2 * np.pi * 2.63 * clock.now))
        live.handle_message(
            1, json.dumps({"set": {"z": z, "x": 600.0 * np.sin(3.0 * clock.now)}}), clock()
        )
        frame = live.tick(clock)
        if frame is not None and clock.now > 2.0:
            seen.append([frame["f"][1][1], frame["f"][0][1]])
        clock.now += max(live.time_to_next_tick(clock.now), 1e-4)
    forces = np.array(seen)
    return {
        "free_s": seconds,
        "free_peak_acceleration": fastest,
        "free_contact_force_max_N": float(forces[:, 0].max()),
        "free_vibrates_by_contact": float((forces[:, 0] >= MIN_GAMEPAD_TOUCH_FORCE_N).mean()),
        "free_vibrates_by_measured": float((forces[:, 1] >= MIN_GAMEPAD_TOUCH_FORCE_N).mean()),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args()
    figures = free_motion(options.seconds) if options.seconds else {}
    if CHROMIUM is None:
        print("there is no Chromium here")
    elif options.trials:
        figures |= in_the_browser(options.trials)
    for name, value in figures.items():
        print(f"{name:28} {value:.4g}")
    if options.json is not None:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
