"""Record docs/figures/drive.webp: a drive in the page of `drake-teleop drive`, in Chromium.

Usage: `python docs/make_film.py`. A script in the page moves hand and slider by the station's time.
The drive runs in slow motion; each picture is shown at its time in the station. Printed are the
slow-down of the drive, and size and frame rate of the film.
"""

from __future__ import annotations

import io
import sys
import time
from base64 import b64decode
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from drake_teleop.live.server import drive

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))
from browser import Page, opened  # noqa: E402

FILM = ROOT / "docs" / "figures" / "drive.webp"
WIDTH, HEIGHT = 1000, 640
# Without a graphics card, Chromium draws a few pictures per second: slow motion of the page.
SLOW = 5
MOST_PER_S = 10.0
SECONDS = 12.5
# Free motion back and forth; down onto the leaf; sigma to 1 and back while pressing; up again. The
# unit is 10 um.
LEAD = """const smooth = (t, from, to) => {
  const s = Math.min(Math.max((t - from) / (to - from), 0), 1); return s * s * (3 - 2 * s); };
window.began = frame.t;
setInterval(() => {
  const t = frame.t - began, free = smooth(t, .5, 1) - smooth(t, 3.5, 4);
  if (!target) return;
  target.x = 1500 * free * Math.sin(2 * Math.PI * 1.5 * t);
  target.z = 1500 + 2500 * free * Math.sin(2 * Math.PI * 2 * t)
    - 9000 * (smooth(t, 4.5, 5.5) - smooth(t, 10, 11));
  const sigma = at("sigma"), wanted = Math.round(100 * (smooth(t, 6.5, 7.5) - smooth(t, 8.5, 9.5)));
  if (+sigma.value === wanted) return;
  sigma.value = wanted;
  sigma.dispatchEvent(new Event("input"));
}, 10); 1"""


class Filmed(Page):
    """Page that stores its pictures: (seconds, PNG)."""

    def __init__(self, socket: Any) -> None:
        super().__init__(socket)
        self.pictures: list[tuple[float, bytes]] = []

    def heard(self, event: str, params: Any) -> None:
        """Store a picture, and request the next one."""
        super().heard(event, params)
        if event == "Page.screencastFrame":
            self.pictures.append((params["metadata"]["timestamp"], b64decode(params["data"])))
            self.send("Page.screencastFrameAck", sessionId=params["sessionId"])


def filmed(url: str) -> list[tuple[float, bytes]]:
    """Return the pictures of a drive, each with the station's time [s]."""
    clocks = []  # of browser and station
    drawing = ("--use-angle=swiftshader", f"--window-size={WIDTH},{HEIGHT}")
    with opened(url, "", Filmed, drawing) as page:
        size = {"width": WIDTH, "height": HEIGHT, "deviceScaleFactor": 1, "mobile": False}
        page.call("Emulation.setDeviceMetricsOverride", **size)
        page.until("typeof target !== 'undefined' && target && frame && frame.tool")
        time.sleep(3.0)  # until the scene is complete
        page.run(f"at('slow').value = {SLOW}; at('slow').dispatchEvent(new Event('change')); 1")
        time.sleep(2.0)
        page.run(LEAD)
        page.send("Page.startScreencast", format="png")
        while page.run("frame.t - began") < SECONDS:
            clocks.append(page.run("[Date.now() / 1000, frame.t - began]"))
            time.sleep(0.1)
        page.send("Page.stopScreencast")
    browser, station = np.array(clocks).T
    print(f"{(browser[-1] - browser[0]) / (station[-1] - station[0]):.1f} s for one of the station")
    return [(float(np.interp(at, browser, station)), png) for at, png in page.pictures]


def main() -> None:
    """Record and write the film; print its figures."""
    driven = drive("contact_transition")
    try:
        pictures = filmed(driven.url)
    finally:
        driven.stop()
    kept = pictures[:1]
    for at, picture in pictures[1:]:
        if at - kept[-1][0] >= 1.0 / MOST_PER_S:
            kept.append((at, picture))
    times = [at for at, _ in kept]
    shown = [
        round(1e3 * (b - a)) for a, b in zip(times, [*times[1:], times[-1] + 1.0], strict=True)
    ]
    first, *others = (Image.open(io.BytesIO(picture)).convert("RGB") for _, picture in kept)
    first.save(
        FILM, save_all=True, append_images=others, duration=shown, loop=0, quality=60, method=2
    )
    seconds = times[-1] - times[0]
    print(
        f"{FILM}: {FILM.stat().st_size / 1e6:.2f} MB, {seconds:.1f} s, {len(kept) / seconds:.1f}"
        " pictures a second"
    )


if __name__ == "__main__":
    main()
