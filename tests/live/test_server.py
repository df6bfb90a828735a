"""What listens: the page and its socket, for who has the token, from our own page alone."""

from __future__ import annotations

import json
import time
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import pytest
from sockets import THIS_MACHINE, listening
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from drake_teleop.errors import DrakeTeleopError
from drake_teleop.live import server
from drake_teleop.live.messages import LONGEST
from drake_teleop.scenario import Scenario, replace

LEARNING = replace(Scenario(), load_estimator__enabled=True)  # identifies nothing beforehand


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
    """The first frame that is as wanted; frames come 60 times a second."""
    end = time.monotonic() + 20.0
    while time.monotonic() < end:
        frame = json.loads(socket.recv(20.0)).get("frame")
        if frame is not None and wanted(frame):
            return frame
    raise AssertionError("there was no such frame")


def test_a_record_that_cannot_be_written_is_said_and_nothing_waits(tmp_path):
    (tmp_path / "file").write_text("a file, and no folder")
    with pytest.raises(DrakeTeleopError, match="cannot be made a folder"):
        server.drive(LEARNING, record=tmp_path / "file" / "record")


@pytest.mark.slow
def test_only_who_has_the_token_gets_the_page(live):
    base = live.url.partition("?")[0]
    assert listening() <= THIS_MACHINE
    assert status(live.url) == 200
    assert status(live.url.replace("/?", "/meshcat.js?")) == 200
    assert status(live.url.replace("/?", "/other?")) == 404
    assert status(base) == status(live.url + "x") == status(base + "meshcat.js") == 403
    # A name that somebody else's server gave to this address.
    assert status(live.url, Host="evil.example") == 403
    assert live.url in live._repr_html_()


@pytest.mark.slow
def test_the_socket_takes_orders_from_our_own_page_alone(live):
    for origin in ("http://evil.example", "null", live.url.partition("/?")[0] + "0"):
        with pytest.raises(InvalidStatus, match="403"):
            open_socket(live, origin)
    with open_socket(live) as page:
        hello = json.loads(page.recv())["hello"]
        assert hello["meshcat"].startswith("ws://localhost:")
        page.send('{"set": {"z": -300, "sigma": 50}}')
        frame = until(page, lambda frame: frame["inputs"]["sigma"] == 50)
        assert frame["driver"] == hello["you"] and frame["inputs"]["z"] == -300
        with open_socket(live) as other:
            other.send('{"drive": true}')
            assert until(page, lambda frame: frame["driver"] != hello["you"])
        page.send("x" * (LONGEST + 1))
        with pytest.raises(ConnectionClosed):
            until(page, lambda frame: False)


@pytest.mark.slow
def test_a_port_that_is_taken_is_one_line(live, scenario, load, monkeypatch):
    monkeypatch.setattr(server, "identified_load", lambda scenario: load)
    taken = int(live.url.partition("/?")[0].rpartition(":")[2])
    with pytest.raises(DrakeTeleopError, match=f"port {taken}: cannot be listened to"):
        server.drive(scenario, port=taken)
    with pytest.raises(DrakeTeleopError, match="there is no scenario"):
        server.drive("no-such-scenario")
    assert isinstance(scenario, Scenario)
