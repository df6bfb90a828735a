"""Source for ATI Net F/T and compatible OnRobot sensors: RDT (raw data transfer) over UDP."""

from __future__ import annotations

import math
import socket
import struct
import time
from contextlib import suppress

import numpy as np

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.logs.read.description_fields import SI_VALUE_OF_UNIT
from drake_teleop.robots.address import Address
from drake_teleop.robots.streams import DAMAGED_WRENCH_READING, WRENCH, Reading, ReadingFlag, Source

DEFAULT_UDP_PORT = 49152
REQUEST_FORMAT = struct.Struct(">HHI")
RECORD_FORMAT = struct.Struct(">III6i")
"""RDT sequence, F/T sequence, status, and the wrench in counts."""
START_COMMAND, STOP_COMMAND = 2, 0
_RDT_REQUEST_HEADER = 0x1234
_SATURATED_STATUS_BIT, _ERROR_STATUS_BIT = 1 << 17, 1 << 31  # bits of the status
_STREAM_REQUEST_PERIOD_S, _MAX_UNCHANGED_WRENCH_S = 0.1, 0.05
_MAX_RECORDS_PER_CALL = 256
_SETTINGS_PAGE_TIMEOUT_S, _MAX_SETTINGS_PAGE_BYTES = 2.0, 1 << 20
_SI_VALUE_OF_SENSOR_UNIT = SI_VALUE_OF_UNIT | {"klbf": 1e3 * SI_VALUE_OF_UNIT["lbf"]}


class NetFtSource(Source):
    """Source at netft://HOST[:PORT][?counts=FORCE,TORQUE&rate=HZ&sign=-1]; counts per N and N m."""

    streams = (WRENCH,)

    def __init__(self, address: str, dt: float | None = None) -> None:
        parsed = Address(address, DEFAULT_UDP_PORT, allowed=("counts", "rate", "sign"))
        counts, rate = parsed.positive_numbers("counts", 2), parsed.positive_numbers("rate", 1)
        sign = parsed.wrench_sign()
        if rate is None and dt is not None:
            rate = [1.0 / dt]
        if counts is None or rate is None:
            page = _fetch_counts_per_unit_and_rate(parsed)
            counts, rate = counts or page[:2], rate or page[2:]
        self.dt = 1.0 / rate[0]
        self._per_count = sign / np.repeat(counts, 3)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.connect((parsed.host, parsed.port))
        except OSError as error:
            self._socket.close()
            raise DrakeTeleopError(str(error), where=address, remedy="check the host") from error
        self._pace, self._number = SampleClock(self.dt), 0
        self._last_received = self._last_request = -math.inf
        self._measured, self._measured_at = -1, -math.inf

    def read(self, timeout_s: float) -> list[Reading] | None:
        self._request_stream()
        found: list[Reading] = []
        self._socket.settimeout(timeout_s)
        try:
            while len(found) < _MAX_RECORDS_PER_CALL:
                packet = self._socket.recv(RECORD_FORMAT.size + 1)
                found.append(self.reading_of_packet(packet, time.monotonic()))
                self._socket.settimeout(0.0)
        except OSError:  # no further record, or no box
            pass
        return found

    def reading_of_packet(self, packet: bytes, now: float) -> Reading:
        """Return the wrench in a packet received at time `now` [s], flagged if it is invalid."""
        if len(packet) != RECORD_FORMAT.size:
            return DAMAGED_WRENCH_READING
        rdt_sequence, ft_sequence, status, *counts = RECORD_FORMAT.unpack(packet)
        # rdt_sequence has 32 bits and wraps around.
        self._number += (rdt_sequence - self._number + 2**31) % 2**32 - 2**31
        self._last_received = now
        flags = 0
        if status & _SATURATED_STATUS_BIT:
            flags = int(ReadingFlag.SATURATED)
        elif status & _ERROR_STATUS_BIT:
            flags = int(ReadingFlag.DAMAGED)
        if ft_sequence != self._measured:
            self._measured, self._measured_at = ft_sequence, now
        elif now - self._measured_at > _MAX_UNCHANGED_WRENCH_S:
            flags |= int(ReadingFlag.STALE)
        t = self._pace.time_of_sample(self._number, now)
        return Reading(self._number, t, np.array(counts) * self._per_count, flags, stream=WRENCH)

    def _request_stream(self) -> None:
        now = time.monotonic()
        if now - max(self._last_received, self._last_request) > _STREAM_REQUEST_PERIOD_S:
            self._last_request = now
            self._send_command(START_COMMAND)

    def _send_command(self, command: int) -> None:
        with suppress(OSError):  # no box yet
            self._socket.send(REQUEST_FORMAT.pack(_RDT_REQUEST_HEADER, command, 0))

    def close(self) -> None:
        self._send_command(STOP_COMMAND)
        self._socket.close()


def _fetch_counts_per_unit_and_rate(address: Address) -> list[float]:
    from http.client import HTTPConnection, HTTPException

    connection = HTTPConnection(address.host, timeout=_SETTINGS_PAGE_TIMEOUT_S)
    try:
        connection.request("GET", "/netftapi2.xml")
        return parse_counts_and_rate(connection.getresponse().read(_MAX_SETTINGS_PAGE_BYTES))
    except (OSError, HTTPException, SyntaxError, ValueError, KeyError) as error:
        what = f"counts per unit, units and rate cannot be read from the sensor's page ({error!r})"
        remedy = "check the host, or give netft://HOST?counts=FORCE,TORQUE&rate=HZ"
        where = f"http://{address.host}/netftapi2.xml"
        raise DrakeTeleopError(what, where=where, remedy=remedy) from error
    finally:
        connection.close()


def parse_counts_and_rate(content: bytes) -> list[float]:
    """Return counts per N and per N m, and the rate [Hz], of the page netftapi2.xml."""
    from xml.etree import ElementTree

    text = {each.tag: (each.text or "").strip() for each in ElementTree.fromstring(content).iter()}
    units = (text[f"scfg{kind}u"].replace("-", " ") for kind in "ft")
    per_unit = (float(text[f"cfgcp{kind}"]) for kind in "ft")
    counts = [x / _SI_VALUE_OF_SENSOR_UNIT[u] for x, u in zip(per_unit, units, strict=True)]
    values = [*counts, float(text["comrdtrate"])]
    if not all(0.0 < value < 1e12 for value in values):
        raise ValueError(f"counts per N, N m, and rate {values} are not between 0 and 1e12")
    return values


_MIN_PERIOD_MEASUREMENT_S, _MAX_PERIOD_MEASUREMENT_S = 1.0, 10.0  # span of our clock
_MAX_SAMPLE_GAP_S = 1.0  # a larger step of the number is a restart


class SampleClock:
    """Clock of sample numbers: period `dt` [s] for one second, then measured."""

    def __init__(self, dt: float) -> None:
        self._dt = self._period = dt
        self._number, self._t = 0, 0.0
        self._first: tuple[int, float] | None = None

    def time_of_sample(self, number: int, now: float) -> float:
        """Return the time [s] of a sample received at `now` [s] of a monotonic clock."""
        step = number - self._number
        if self._first is None or abs(step) * self._dt > _MAX_SAMPLE_GAP_S:
            self._first = number, now
        elif now - self._first[1] >= _MIN_PERIOD_MEASUREMENT_S and number > self._first[0]:
            self._period = (now - self._first[1]) / (number - self._first[0])
            if now - self._first[1] > _MAX_PERIOD_MEASUREMENT_S:
                self._first = number, now
        t = self._t + step * self._period
        if step > 0 or self._first == (number, now):
            self._number, self._t = number, t
        return t
