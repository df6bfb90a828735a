"""`drake-teleop drive`: one page on this machine, and the socket that drives.

The page, Drake's 3D viewer and the socket are served on 127.0.0.1 alone, to who knows the token in
the address; the socket, to this very page. Meshcat listens there too, and tells the scene to
whoever asks; nothing is ever taken from it.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import gc
import itertools
import json
import secrets
import threading
import time
import webbrowser
from http import HTTPStatus
from importlib import resources
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
from pydrake.common import FindResourceOrThrow
from pydrake.geometry import Meshcat, MeshcatParams
from websockets.asyncio.server import Server, ServerConnection, broadcast, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.estimation.contact_detection import ContactDetectionConfig
from drake_teleop.film import quiet_drake
from drake_teleop.identified_load import IdentifiedLoad, identified_load
from drake_teleop.live.device import DrivenBy
from drake_teleop.live.external_master import with_device
from drake_teleop.live.live import Live, Show
from drake_teleop.live.messages import LONGEST
from drake_teleop.live.pace import without_collections
from drake_teleop.live.scenes import scene
from drake_teleop.live.session import live_scenario
from drake_teleop.replay import ReplayScene
from drake_teleop.scenario import LoadScenario, Scenario, check_scenario
from drake_teleop.writing import make_folder

_HOST = "127.0.0.1"
_MOST_CLIENTS = 8
# Turns of the loop from a socket that can be read to what has been said: one wakes its reader.
_STEPS_OF_A_MESSAGE = 3
_BEHIND = 2**18  # bytes that wait for a slow page, before it misses frames


class LiveDrive:
    """A station that is being driven, in a thread of its own.

    Attributes:
        url: of the page; whoever has it may drive.
    """

    def __init__(
        self, scenario: Scenario, record: Path | None, port: int, device: str | None = None
    ) -> None:
        setup = live_scenario(scenario if device is None else with_device(scenario))
        setup.check()
        if record is not None:
            make_folder(record)  # before there is a Meshcat, which only its own thread may unmake
        load = _load_of(setup)
        self._pages: dict[ServerConnection, int] = {}
        self._own = setup
        self.url, self._port, self._token = "", port, secrets.token_urlsafe(16)
        self._device = None if device is None else DrivenBy(device)
        self._failed: Exception | None = None
        self._ready, self._over = threading.Event(), threading.Event()
        self._numbers = itertools.count(1)  # of pages
        self._thread = threading.Thread(target=self._run, args=(setup, load, record), daemon=True)
        self._thread.start()
        self._ready.wait()
        if self._failed is not None:
            raise self._failed

    def wait(self) -> None:
        """Waits until it is over: after `stop`, or Ctrl-C."""
        try:
            while not self._over.wait(0.2):
                pass
        finally:
            self.stop()
        if self._failed is not None:
            raise self._failed

    def stop(self) -> None:
        """Ends the drive; its record is then complete on the disk."""
        with contextlib.suppress(RuntimeError):  # the loop is closed already
            self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join()

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.url}" style="width:100%;height:44rem;border:0"></iframe>'

    def _run(self, scenario: Scenario, load: IdentifiedLoad | None, record: Path | None) -> None:
        """The drive's thread. Meshcat is made and unmade here: no other thread may touch it."""
        try:
            with quiet_drake():
                self._meshcat = Meshcat(MeshcatParams(host="localhost"))
            self._live = self._make(scenario, load, record)
            asyncio.run(self._serve())
        except Exception as error:
            self._failed = _without_frames(error)
        finally:
            for name in ("_live", "_meshcat"):  # none, if it could not be made
                self.__dict__.pop(name, None)
            while gc.collect():  # what Drake's objects keep alive is garbage after they are gone
                pass
            if self._device is not None:
                self._device.close()
            self._over.set()
            self._ready.set()

    def _make(self, scenario: Scenario, load: IdentifiedLoad | None, record: Path | None) -> Live:
        show = show_in(self._meshcat, scenario)
        link = None if self._device is None else self._device.link
        return Live(scenario, load, record, show, time.perf_counter(), link)

    async def _serve(self) -> None:
        self._loop, self._stop = asyncio.get_running_loop(), asyncio.Event()
        try:
            server = await serve(
                self._meet,
                _HOST,
                self._port,
                process_request=self._request,
                max_size=LONGEST,
                max_queue=8,
                compression=None,
                ping_interval=5,
                ping_timeout=5,
                close_timeout=1,
            )
        except OSError as error:
            what = f"cannot be listened to ({error.strerror})"
            remedy = "give another --port"
            raise DrakeTeleopError(what, where=f"port {self._port}", remedy=remedy) from error
        self._port = server.sockets[0].getsockname()[1]
        self.url = f"http://{_HOST}:{self._port}/?token={self._token}"
        self._ready.set()
        try:
            async with server:
                await self._drive(server)
        finally:
            self._live.close()

    async def _drive(self, server: Server) -> None:
        """The one loop: slices and frames, and messages whenever there is time between them."""
        with without_collections():
            while not self._stop.is_set():
                if self._live.asked:
                    await self._change_scene()
                frame = self._live.tick(time.perf_counter)
                if frame is not None:
                    ready = [
                        c
                        for c in server.connections
                        if c.transport.get_write_buffer_size() < _BEHIND
                    ]
                    broadcast(ready, json.dumps({"frame": frame}))
                await self._sleep()

    async def _sleep(self) -> None:
        """Until there is something to do; then messages that have come are listened to.

        As asyncio waits in whole milliseconds, the last one is slept through without it.
        """
        rest = self._live.wait(time.perf_counter()) - 1e-3
        if rest > 0:
            await asyncio.sleep(rest)
        time.sleep(self._live.wait(time.perf_counter()))
        for _ in range(_STEPS_OF_A_MESSAGE):
            await asyncio.sleep(0)

    async def _change_scene(self) -> None:
        """Identifies the load beside the loop, which may take a while; all else is Meshcat's."""
        live = self._live
        frame = json.dumps({"frame": live.frame()})
        broadcast(self._pages, frame)
        try:
            scenario = scene(live.asked, self._own)
            if self._device is not None:
                scenario = with_device(scenario)
            load = await asyncio.to_thread(_load_of, scenario)
        except DrakeTeleopError as error:
            live.refuse(str(error), time.perf_counter())
            return
        self._meshcat.Delete()
        live.change(scenario, load, show_in(self._meshcat, scenario), time.perf_counter())
        for page in tuple(self._pages):
            with contextlib.suppress(ConnectionClosed):
                await page.send(self._hello(page))

    def _hello(self, page: ServerConnection) -> str:
        more = {"you": self._pages[page], "meshcat": self._meshcat.ws_url()}
        return json.dumps({"hello": self._live.hello() | more})

    def _page(self) -> bytes:
        return resources.files("drake_teleop.live").joinpath("page.html").read_bytes()

    def _request(self, connection: ServerConnection, request: Request) -> Response | None:
        """Serves a file, or lets a socket be opened; refuses whatever is not from our own page."""
        host = f"{_HOST}:{self._port}"
        address = urlsplit(request.path)
        token = parse_qs(address.query).get("token", [""])[0]
        if request.headers.get("Host") != host or not secrets.compare_digest(
            token.encode(), self._token.encode()
        ):
            return _response(HTTPStatus.FORBIDDEN, "text/plain", b"The address needs its token.\n")
        if address.path == "/socket":
            origin = request.headers.get_all("Origin")
            if origin != [f"http://{host}"]:
                return _response(HTTPStatus.FORBIDDEN, "text/plain", b"Another page's.\n")
            return None
        if address.path == "/":
            return _response(HTTPStatus.OK, "text/html; charset=utf-8", self._page())
        if address.path == "/meshcat.js":
            script = Path(FindResourceOrThrow("drake/geometry/meshcat.js")).read_bytes()
            return _response(HTTPStatus.OK, "text/javascript; charset=utf-8", script)
        return _response(HTTPStatus.NOT_FOUND, "text/plain", b"Nothing is here.\n")

    async def _meet(self, connection: ServerConnection) -> None:
        """A page, from its first message to its last."""
        live = self._live
        if len(connection.server.connections) > _MOST_CLIENTS:
            await connection.close(1013, "too many pages")
            return
        you = self._pages[connection] = next(self._numbers)
        live.join(you, time.perf_counter())
        try:
            await connection.send(self._hello(connection))
            async for text in connection:
                live.hear(you, text, time.perf_counter())
        except ConnectionClosed:
            pass
        finally:
            del self._pages[connection]
            live.leave(you, time.perf_counter())


def _load_of(scenario: Scenario) -> IdentifiedLoad | None:
    """What the station is told of its load; with its noise, so that contact may be detected."""
    if scenario.load_estimator.enabled:
        return None
    detection = scenario.contact_detection or ContactDetectionConfig()
    return identified_load(dataclasses.replace(scenario, contact_detection=detection))


def _without_frames(error: Exception) -> Exception:
    """It and what led to it hold no frames, whose variables another thread would unmake."""
    link: BaseException | None = error
    while link is not None:
        link.__traceback__ = None
        link = link.__cause__ or link.__context__
    return error


def _response(status: HTTPStatus, kind: str, body: bytes) -> Response:
    headers = Headers(
        {
            "Content-Type": kind,
            "Content-Length": str(len(body)),
            "Cache-Control": "no-store",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "Connection": "close",
        }
    )
    return Response(status.value, status.phrase, headers, body)


def show_in(meshcat: Meshcat, scenario: Scenario, forces: bool = True) -> Show:
    """What shows the newest rows of a log in Meshcat, as a film does, with or without `forces`."""
    arrows = ("measured_wrench_S", "contact_wrench_S") if forces else ()
    scene = ReplayScene(meshcat, scenario, ("slave_state", "master_state", *arrows))

    def show(rows: dict[str, np.ndarray]) -> None:
        scene.show(float(rows["t"][-1]), rows, -1)

    return show


def drive(
    scenario: Scenario | str | Path,
    *,
    record: str | Path | None = None,
    port: int = 0,
    browser: bool = False,
    device: str | None = None,
) -> LiveDrive:
    """Drives a station in the browser: its hand by mouse, keys, gamepad or touch.

    The drive goes on in a thread of its own. In a notebook the page is shown where the value of
    this call is; elsewhere open its `url`. `wait()` returns when it is over, `stop()` ends it.

    Args:
        scenario: or the name of a shipped one, or a YAML file. Its operator gives the grip alone.
        record: a folder for the drive, which `run --inputs` repeats; None for none.
        port: of 127.0.0.1; 0 for any that is free.
        browser: whether to open the page in the user's browser.
        device: a haptic device that is the hand: udp://127.0.0.1:PORT, on which one is listened
            to, or haply://localhost:10001.

    Raises:
        DrakeTeleopError: if the scenario cannot be used, or a port is taken.
    """
    if not isinstance(scenario, Scenario):
        scenario = LoadScenario(scenario)
    check_scenario(scenario)
    live = LiveDrive(scenario, None if record is None else Path(record), port, device)
    if browser:
        webbrowser.open(live.url)
    return live


def drive_command(
    scenario: str, *, record: Path | None, port: int, browser: bool, device: str | None = None
) -> None:
    """`drake-teleop drive`: until Ctrl-C.

    Raises:
        DrakeTeleopError: as `drive`.
        KeyboardInterrupt: saying how the drive is repeated, if it is recorded.
    """
    live = drive(scenario, record=record, port=port, browser=browser, device=device)
    print(f"drive it at {live.url}\nCtrl-C ends it", flush=True)
    try:
        live.wait()
    except KeyboardInterrupt:
        if record is not None:
            print(f"\nrecorded; repeat it: drake-teleop run --inputs {record}")
