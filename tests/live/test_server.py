"""Access to the page and its socket."""

from __future__ import annotations

import contextlib
import itertools
import json
import socket
import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest
from sockets import THIS_MACHINE, listening, ports
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.live import server
from drake_teleop.live.live import MAX_MESSAGE_BYTES
from drake_teleop.station.scenario import Scenario, replace

LEARNING = replace(Scenario(), load_estimator__enabled=True)  # no identification before the drive


def status(url: str, **headers: str) -> int:
    try:
        with urlopen(Request(url, headers=headers)) as answer:
            return answer.status
    except HTTPError as error:
        return error.code


def open_socket(live: server.LiveDrive, origin: str | None = None):
    address = live.url.replace("http:", "ws:").replace("/?", "/socket?")
    return connect(address, origin=origin or live.url.partition("/?")[0])


def until(socket, wanted) -> dict:
    """Return the first frame that satisfies a condition."""
    end = time.monotonic() + 20.0
    while time.monotonic() < end:
        frame = json.loads(socket.recv(20.0)).get("frame")
        if frame is not None and wanted(frame):
            return frame
    raise AssertionError("there was no such frame")


def test_unwritable_record_fails_at_once(tmp_path):
    (tmp_path / "file").write_text("a file, and no folder")
    with pytest.raises(DrakeTeleopError, match="cannot be created as a folder"):
        server.drive(LEARNING, record=tmp_path / "file" / "record")


@pytest.mark.slow
def test_page_requires_the_token(live):
    base = live.url.partition("?")[0]
    assert listening() <= THIS_MACHINE
    assert status(live.url) == 200
    assert status(live.url.replace("/?", "/meshcat.js?")) == 200
    assert status(live.url.replace("/?", "/other?")) == 404
    assert status(base) == status(live.url + "x") == status(base + "meshcat.js") == 403
    assert json.loads(urlopen(live.url.replace("/?", "/scene/leaf?")).read())["commands"]
    assert status(live.url.replace("/?", "/scene/../leaf?")) == 404
    # Another host name of this address (DNS rebinding).
    assert status(live.url, Host="evil.example") == 403
    assert live.url in live._repr_html_()


@pytest.mark.slow
def test_socket_requires_the_origin_of_our_page(live):
    for origin in ("http://evil.example", "null", live.url.partition("/?")[0] + "0"):
        with pytest.raises(InvalidStatus, match="403"):
            open_socket(live, origin)
    with open_socket(live) as page:
        hello = json.loads(page.recv())["hello"]
        page.send('{"set": {"z": -300, "sigma": 50}}')
        frame = until(page, lambda frame: frame["inputs"]["sigma"] == 50)
        assert frame["driver"] == hello["you"] and frame["inputs"]["z"] == -300
        with open_socket(live) as other:
            other.send('{"drive": true}')
            assert until(page, lambda frame: frame["driver"] != hello["you"])
        page.send("x" * (MAX_MESSAGE_BYTES + 1))
        with pytest.raises(ConnectionClosed):
            until(page, lambda frame: False)


@pytest.mark.slow
def test_port_in_use_is_one_error_line(live, scenario, load, monkeypatch):
    monkeypatch.setattr(server, "identified_load", lambda *_: load)
    taken = int(live.url.partition("/?")[0].rpartition(":")[2])
    with pytest.raises(DrakeTeleopError, match=f"port {taken}: cannot be opened"):
        server.drive(scenario, port=taken)
    with pytest.raises(DrakeTeleopError, match="there is no scenario"):
        server.drive("no-such-scenario")
    assert isinstance(scenario, Scenario)


@pytest.mark.slow
def test_record_is_removed_if_the_port_is_in_use(tmp_path, monkeypatch):
    def make_no_scenes(drive, *_):
        drive._load, view = None, SimpleNamespace(scene_values=lambda rows: {})
        drive._views = dict.fromkeys(server.SCENE_NAMES, view)

    monkeypatch.setattr(server.LiveDrive, "_build_scenes_and_compile", make_no_scenes)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        for _ in range(2):
            with pytest.raises(DrakeTeleopError, match=f"port {port}: cannot be opened"):
                server.drive(LEARNING, record=tmp_path / "drive", port=port)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_one_port_listens_also_when_the_scene_changes(scenario, load, monkeypatch):
    monkeypatch.setattr(server, "identified_load", lambda *_: load)
    before = ports()
    drive = server.drive(scenario)
    with open_socket(drive) as page:
        assert len(ports() - before) == 1
        page.send('{"scene": "wall"}')
        until(page, lambda frame: frame["view"] == "wall" and frame["state"] == "running")
        assert len(ports() - before) == 1
    drive.stop()
    assert ports() == before


@pytest.mark.slow
def test_content_policy_allows_only_our_scripts(live):
    with urlopen(live.url) as answer:
        policy, page = answer.headers["Content-Security-Policy"], answer.read()
    assert "default-src 'none'" in policy and "unsafe-eval" not in policy
    (scripts,) = (part for part in policy.split("; ") if part.startswith("script-src"))
    assert "unsafe-inline" not in scripts and scripts.count("'sha256-") == page.count(b"<script>")


def hostile(host: str, token: str) -> Iterator[bytes]:
    """Send requests that a browser does not send, or that another page can cause."""
    start = f"GET /?token={token} HTTP/1.1\r\n"
    upgrade = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    key = "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
    yield f"{start}Host: {host}\r\nHost: {host}\r\n\r\n".encode()
    yield f"{start}Host: evil.example\r\nHost: {host}\r\n\r\n".encode()
    yield f"{start}\r\n".encode()
    for path in ("//[", "/socket?token=%ff", "/?" + "&" * 5000, "http://[::1", "*", "/%", "?"):
        yield f"GET {path} HTTP/1.1\r\nHost: {host}\r\n\r\n".encode()
    yield f"GET /?token=\xe9\xff HTTP/1.1\r\nHost: {host}\r\n\r\n".encode("latin-1")
    for origin in ("Origin: http://evil.example\r\n", f"Origin: http://{host}\r\n" * 2, ""):
        to = f"GET /socket?token={token} HTTP/1.1\r\nHost: {host}\r\n"
        yield f"{to}{origin}{upgrade}{key}\r\n".encode()
        yield f"{to}Origin: http://{host}\r\n{upgrade}{key}{key}\r\n".encode()
    yield b"\x16\x03\x01\x02\x00\x01\x00" + bytes(range(256))  # a browser with https
    yield b"POST / HTTP/1.1\r\nContent-Length: 5\r\n\r\nhello"
    yield b"GET / HTTP/1.1\r\n" + b"A: b\r\n" * 5000
    yield b"\r\n" * 100
    yield b""


@pytest.mark.slow
def test_hostile_clients_cannot_end_or_delay_a_drive(scenario, load, monkeypatch, capfd):
    monkeypatch.setattr(server, "identified_load", lambda *_: load)
    drive = server.drive(scenario)
    host, token = drive.url.partition("//")[2].partition("/")[0], drive.url.partition("token=")[2]
    address = host.partition(":")[0], int(host.partition(":")[2])
    for request in hostile(host, token):
        with socket.create_connection(address) as client:
            client.settimeout(5.0)
            with contextlib.suppress(OSError):  # the server closes refused connections
                client.sendall(request)
                if request.endswith(b"\r\n\r\n"):
                    assert b" 200 " not in client.recv(65536).partition(b"\r\n")[0]
    with contextlib.ExitStack() as stack:
        for text in ("[]", b"\xc1", "x" * 4096, "", b"", "x" * (MAX_MESSAGE_BYTES + 1)):
            with open_socket(drive) as page:
                page.send(text)
        silent = [socket.create_connection(address) for _ in range(5)]
        stack.callback(lambda: [each.close() for each in silent])
        deaf = stack.enter_context(open_socket(drive))
        frame = until(deaf, lambda frame: frame["state"] == "running")
        assert frame["t"] > 0.0
        start = time.monotonic()
        drive.stop()
        assert time.monotonic() - start < 5.0
    said = capfd.readouterr()
    assert said.out == "" and set(said.err.splitlines()) == {
        "Prepare the station and its 3D scenes ...",
        "simulation waits until a page is open",
    }


@pytest.mark.slow
def test_drive_ends_while_a_scene_identifies_its_load(scenario, load, monkeypatch):
    """The identification checks for the end in its progress function."""
    started, drives = threading.Event(), itertools.count()

    def identify(_, progress):
        if next(drives) == 0:
            return load
        report = progress("Identify the load")
        while True:
            started.set()
            report(0.5)
            time.sleep(0.01)

    monkeypatch.setattr(server, "identified_load", identify)
    drive = server.drive(scenario)
    with open_socket(drive) as page:
        page.send('{"scene": "slot"}')
        assert started.wait(10.0)
        start = time.monotonic()
        drive.stop()
        assert time.monotonic() - start < 5.0
