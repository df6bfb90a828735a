"""Server of `drake-teleop drive`: one page on this machine and its websocket.

It serves only clients with the token in the page's address.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import itertools
import json
import logging
import os
import secrets
import shlex
import sys
import threading
import time
import webbrowser
from collections.abc import Callable
from concurrent.futures import Future
from http import HTTPStatus
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

from pydrake.common import FindResourceOrThrow
from websockets.asyncio.server import Server, ServerConnection, broadcast, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.common.files import make_folder
from drake_teleop.common.html import content_security_policy
from drake_teleop.common.progress import StartStage, UpdateProgress, show_progress
from drake_teleop.lab.identified_load import IdentifiedLoad, identified_load
from drake_teleop.live.cockpit import PageValueCalculator
from drake_teleop.live.device_link import DeviceLink
from drake_teleop.live.live import MAX_MESSAGE_BYTES, Live, without_garbage_collection
from drake_teleop.live.page_scene import PageScene
from drake_teleop.live.scenarios import (
    SCENE_NAMES,
    live_scenario,
    scenario_of_scene,
    with_task_space_device,
)
from drake_teleop.live.session import Session
from drake_teleop.station.estimation.contact_detection import ContactDetectionConfig
from drake_teleop.station.scenario import LoadScenario, Scenario, check_scenario

_LOOPBACK_ADDRESS = "127.0.0.1"
_MAX_CONNECTED_PAGES = 8
# Iterations of asyncio's loop from a readable socket to a handled message.
_EVENT_LOOP_TURNS_TO_RECEIVE = 3
_MAX_UNSENT_BYTES_OF_PAGE = 2**18  # unsent bytes above which a slow page misses frames
# Timeouts of the clients and of the drive's thread [s].
_PAGE_CLOSE_TIMEOUT_S, _THREAD_TIMEOUT_S = 1.0, 4.0
# All other log entries of websockets are failed connections, which clients cause.
_WEBSOCKET_LOGGER = logging.getLogger("drake_teleop.live.server")
_WEBSOCKET_LOGGER.addFilter(lambda record: record.msg == "connection handler failed")


class LiveDrive:
    """Live session and its server on a thread.

    Attributes:
        url: address of the page, with its token.
        recorded: folders of completed records.
        ended: after the end, the failure that stopped the simulation, or "".
        ms: after the end, simulated time [ms].
    """

    def __init__(
        self, scenario: Scenario, record: Path | None, port: int, device: str | None = None
    ) -> None:
        setup = live_scenario(scenario if device is None else with_task_space_device(scenario))
        setup.check()
        if record is not None:
            make_folder(record)
        self.ended, self.ms = "", 0
        self._views: dict[str, PageScene] = {}
        self._build_scenes_and_compile(setup, device is not None)
        self._pages: dict[ServerConnection, int] = {}
        self.recorded: list[str] = []
        self.url, self._port, self._token = "", port, secrets.token_urlsafe(16)
        self._link = None if device is None else DeviceLink(device)
        self._start_condition = "" if device is None else " or until the device sends"
        self._failed: BaseException | None = None
        self._ready, self._over, self._stop = (threading.Event() for _ in range(3))
        self._page_numbers = itertools.count(1)  # of pages
        self._threads: list[threading.Thread] = []
        self._start_thread(self._run_session_and_server, setup, record)
        try:
            self._ready.wait()
        except KeyboardInterrupt:
            self._stop_threads_or_exit_process()
            raise
        self._raise_thread_failure()

    def _start_thread(self, work: Callable[..., None], *arguments: Any) -> None:
        self._threads.append(threading.Thread(target=work, args=arguments, daemon=True))
        self._threads[-1].start()

    def _build_scenes_and_compile(self, scenario: Scenario, device: bool) -> None:
        with show_progress(True) as stage:
            self._load = _identify_load(scenario, stage)
            progress = stage("Prepare the station and its 3D scenes")
            for name in SCENE_NAMES:
                setup = scenario_of_scene(name, scenario)
                setup = with_task_space_device(setup) if device else setup
                self._views[name] = PageScene(name, setup)
                progress(len(self._views) / (1 + len(SCENE_NAMES)))
            compile_slice_functions(scenario, self._load, device)
            progress(1.0)

    def wait(self) -> None:
        """Wait for the session's end, by `stop` or Ctrl-C; raise if the record is incomplete."""
        try:
            while not self._over.wait(0.2):
                pass
        finally:
            self._stop_threads_or_exit_process()
        self._raise_thread_failure()

    def announce_and_wait(self, title: str) -> str:
        """Print `title` and page address; wait for the end; return its cause, such as "Ctrl-C"."""
        condition = f"the simulation waits until this page is open{self._start_condition}"
        print(f"{title} at {self.url}\n{condition}; Ctrl-C ends it", flush=True)
        try:
            self.wait()
            return "stop"
        except KeyboardInterrupt as signal:
            self._raise_thread_failure()
            return str(signal) or "Ctrl-C"

    def _raise_thread_failure(self) -> None:
        if self._failed is not None:
            raise self._failed

    def stop(self) -> None:
        """End the session and complete its recording."""
        self._stop.set()
        for thread in self._threads:
            thread.join()

    def _stop_threads_or_exit_process(self) -> None:
        # Python may crash at exit while compiled code runs.
        self._stop.set()
        end = time.monotonic() + _THREAD_TIMEOUT_S
        for thread in self._threads:
            while thread.is_alive() and (rest := end - time.monotonic()) > 0.0:
                with contextlib.suppress(KeyboardInterrupt):
                    thread.join(rest)
        if any(thread.is_alive() for thread in self._threads):
            lost = "; its record may lack two seconds" if self._threads[0].is_alive() else ""
            _print_to_stderr(f"error: the session did not end within {_THREAD_TIMEOUT_S:g} s{lost}")
            sys.stdout.flush()
            os._exit(2)

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.url}" style="width:100%;height:44rem;border:0"></iframe>'

    def _run_session_and_server(self, scenario: Scenario, record: Path | None) -> None:
        try:
            self._live = self._make_live_session(scenario, record)
            asyncio.run(self._serve_pages_until_stopped())
        except (Exception, SystemExit) as error:  # SystemExit is a failed assertion of Drake
            self._failed = error
        finally:
            if self._link is not None:
                self._link.close()
            self._over.set()
            self._ready.set()

    def _make_live_session(self, scenario: Scenario, record: Path | None) -> Live:
        show = self._views[SCENE_NAMES[0]].scene_values
        live = Live(scenario, self._load, record, show, time.perf_counter(), self._link)
        self.recorded = live.recorded
        return live

    async def _serve_pages_until_stopped(self) -> None:
        try:
            server = await serve(
                self._handle_page_connection,
                _LOOPBACK_ADDRESS,
                self._port,
                process_request=self._answer_request,
                max_size=MAX_MESSAGE_BYTES,
                max_queue=8,
                compression=None,
                ping_interval=5,
                ping_timeout=5,
                close_timeout=_PAGE_CLOSE_TIMEOUT_S,
                logger=_WEBSOCKET_LOGGER,
            )
        except OSError as error:
            self._live.close()  # removes the empty record
            what, remedy = f"cannot be opened ({error.strerror})", "use another --port"
            raise DrakeTeleopError(what, where=f"port {self._port}", remedy=remedy) from error
        self._port = server.sockets[0].getsockname()[1]
        self.url = f"http://{_LOOPBACK_ADDRESS}:{self._port}/?token={self._token}"
        self._ready.set()
        try:
            await self._simulate_and_send_frames(server)
        finally:
            self.ended, self.ms = self._live.stop_reason, self._live.simulated_ms
            try:
                self._live.close()
            finally:
                server.close()
                with contextlib.suppress(asyncio.TimeoutError):
                    await asyncio.wait_for(server.wait_closed(), 2 * _PAGE_CLOSE_TIMEOUT_S)

    async def _simulate_and_send_frames(self, server: Server) -> None:
        refusal = ""
        with without_garbage_collection():
            while not self._stop.is_set():
                if self._live.requested_scene:
                    await self._identify_load_and_change_scene()
                frame = self._live.tick(time.perf_counter)
                if frame is not None:
                    pages = [(c, c.transport.get_write_buffer_size()) for c in server.connections]
                    ready = [c for c, unsent in pages if unsent < _MAX_UNSENT_BYTES_OF_PAGE]
                    broadcast(ready, json.dumps({"frame": frame}))
                if self._link is not None and self._link.refusal != refusal:
                    refusal = self._link.refusal
                    _print_to_stderr(f"a packet of the device was refused because it {refusal}")
                await self._sleep_until_next_slice_or_frame()

    async def _sleep_until_next_slice_or_frame(self) -> None:
        rest = self._live.time_to_next_tick(time.perf_counter()) - 1e-3
        if rest > 0:
            await asyncio.sleep(rest)
        time.sleep(self._live.time_to_next_tick(time.perf_counter()))
        for _ in range(_EVENT_LOOP_TURNS_TO_RECEIVE):
            await asyncio.sleep(0)

    async def _identify_load_and_change_scene(self) -> None:
        live, found = self._live, Future[IdentifiedLoad | None]()
        broadcast(self._pages, json.dumps({"frame": live.frame()}))
        view = self._views[live.requested_scene]

        def identify() -> None:
            try:
                found.set_result(_identify_load(view.scenario, self._start_interruptible_stage))
            except Exception as error:
                found.set_exception(error)

        self._start_thread(identify)
        while not found.done():
            if self._stop.is_set():
                return
            await asyncio.sleep(0.05)
        try:
            live.change_scene(view.scenario, found.result(), view.scene_values, time.perf_counter())
        except DrakeTeleopError as error:
            live.reject_scene(str(error), time.perf_counter())
            return
        for page in tuple(self._pages):
            with contextlib.suppress(ConnectionClosed):
                await page.send(self._hello_message_json(page))

    def _start_interruptible_stage(self, name: str) -> UpdateProgress:
        def progress(fraction: float, words: str = "") -> None:
            if self._stop.is_set():
                raise DrakeTeleopError("the live session was stopped")

        return progress

    def _hello_message_json(self, page: ServerConnection) -> str:
        return json.dumps({"hello": self._live.hello_message() | {"you": self._pages[page]}})

    def _page_html(self) -> str:
        return resources.files("drake_teleop.live").joinpath("page.html").read_text("utf-8")

    def _answer_request(self, connection: ServerConnection, request: Request) -> Response | None:
        host = f"{_LOOPBACK_ADDRESS}:{self._port}"
        path, _, query = request.path.partition("?")
        token = parse_qs(query).get("token", [""])[0].encode(errors="replace")
        ours = secrets.compare_digest(token, self._token.encode())
        if request.headers.get_all("Host") != [host] or not ours:
            return _http_response(HTTPStatus.FORBIDDEN, b"The address requires its token.\n")
        if path == "/socket":
            origin = request.headers.get_all("Origin")
            if origin != [f"http://{host}"]:
                refusal = b"Only this server's page may open the socket.\n"
                return _http_response(HTTPStatus.FORBIDDEN, refusal)
            return None
        if path == "/":
            page = self._page_html()
            policy = content_security_policy(page, host)
            return _http_response(HTTPStatus.OK, page.encode(), "text/html; charset=utf-8", policy)
        if path.startswith("/scene/") and (view := self._views.get(path[len("/scene/") :])):
            return _http_response(HTTPStatus.OK, view.objects, "application/json")
        if path == "/meshcat.js":
            script = Path(FindResourceOrThrow("drake/geometry/meshcat.js")).read_bytes()
            return _http_response(HTTPStatus.OK, script, "text/javascript; charset=utf-8")
        return _http_response(HTTPStatus.NOT_FOUND, b"Not found.\n")

    async def _handle_page_connection(self, connection: ServerConnection) -> None:
        live = self._live
        if len(connection.server.connections) > _MAX_CONNECTED_PAGES:
            await connection.close(1013, "too many pages")
            return
        number = self._pages[connection] = next(self._page_numbers)
        live.join(number, time.perf_counter())
        try:
            await connection.send(self._hello_message_json(connection))
            async for text in connection:
                live.handle_message(number, text, time.perf_counter())
        except ConnectionClosed:
            pass
        finally:
            del self._pages[connection]
            live.leave(number, time.perf_counter())
            if not (self._pages or self._stop.is_set()):
                _print_to_stderr(f"simulation waits until a page is open{self._start_condition}")


def _identify_load(scenario: Scenario, progress: bool | StartStage) -> IdentifiedLoad | None:
    if scenario.load_estimator.enabled:
        return None
    detection = scenario.contact_detection or ContactDetectionConfig()
    return identified_load(dataclasses.replace(scenario, contact_detection=detection), progress)


def compile_slice_functions(scenario: Scenario, load: IdentifiedLoad | None, device: bool) -> None:
    """Compile the functions of the first simulation slices, which takes a minute."""
    session, cockpit = Session(scenario, load, device=device), PageValueCalculator(scenario)
    for z in (-1, -2):  # numba compiles one and several rows separately
        cockpit.page_values(session.new_rows(), session.inputs)
        session.apply_inputs(session.inputs.with_changes({"z": z}))
        session.advance()
    session.inputs_at_stylus()


def _http_response(
    status: HTTPStatus, body: bytes, kind: str = "text/plain", policy: str = "default-src 'none'"
) -> Response:
    headers = {
        "Content-Type": kind,
        "Content-Length": str(len(body)),
        "Cache-Control": "no-store",
        "Referrer-Policy": "no-referrer",
        "X-Content-Type-Options": "nosniff",
        "Connection": "close",
        "Content-Security-Policy": policy,
    }
    return Response(status.value, status.phrase, Headers(headers), body)


def drive(
    scenario: Scenario | str | Path,
    *,
    record: str | Path | None = None,
    port: int = 0,
    browser: bool = False,
    device: str | None = None,
) -> LiveDrive:
    """Start a live session: the user moves the station's hand in the browser.

    `wait()` of the result returns at the end of the session, `stop()` ends it. A notebook displays
    the page; elsewhere open its `url`.

    Args:
        scenario: scenario, shipped name, or YAML file; of its operator only the grip is used.
        record: folder for `run --inputs`; None: no record.
        port: TCP port of the page on 127.0.0.1; 0: any free port.
        browser: whether to open the page.
        device: haptic device: udp://127.0.0.1:PORT of a client, or haply://localhost:10001.
    """
    if not isinstance(scenario, Scenario):
        scenario = LoadScenario(scenario)
    check_scenario(scenario)
    live = LiveDrive(scenario, None if record is None else Path(record), port, device)
    if browser:
        webbrowser.open(live.url)
    return live


def run_drive_command(
    scenario: str, *, record: Path | None, port: int, browser: bool, device: str | None = None
) -> None:
    live = drive(scenario, record=record, port=port, browser=browser, device=device)
    reason = live.announce_and_wait("drive it")
    print(f"\nsession ended by {reason} after {1e-3 * live.ms:.1f} s of simulated time")
    for folder in live.recorded:
        print(f"recorded; repeat it: drake-teleop run --inputs {shlex.quote(folder)}")
    if live.ended:
        raise DrakeTeleopError(f"the simulation has stopped: {live.ended}", where="drive")


def _print_to_stderr(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
