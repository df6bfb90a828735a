"""Addresses of robots and sensors: kind://HOST[:PORT][?name=value&...]."""

from __future__ import annotations

import math
from urllib.parse import parse_qsl, urlsplit

from drake_teleop.common.errors import DrakeTeleopError


class Address:
    """Parsed address; `allowed` are its possible parameters, `port` and `host` the defaults."""

    def __init__(
        self, text: str, port: int | None, allowed: tuple[str, ...], *, host: str = ""
    ) -> None:
        self.text = text
        try:
            parts = urlsplit(text)
            pairs = parse_qsl(parts.query, keep_blank_values=True)
            self._parameters = dict(pairs)
            self.host = parts.hostname or host
            self.port = port if parts.port is None else parts.port
        except ValueError as error:
            raise DrakeTeleopError(str(error), where=text) from error
        if not self.host:
            raise DrakeTeleopError("has no host", where=text, remedy=f"use {parts.scheme}://HOST")
        if len(pairs) > len(self._parameters):
            what = "gives a parameter twice"
            raise DrakeTeleopError(what, where=text, remedy="give each one only once")
        self.path = parts.path.strip("/")
        if unknown := self._parameters.keys() - set(allowed):
            what = f"unknown parameter {min(unknown)!r}"
            raise DrakeTeleopError(what, where=text, remedy=f"use only {', '.join(allowed)}")

    def optional_parameter(self, name: str) -> str | None:
        return self._parameters.get(name)

    def positive_numbers(self, name: str, count: int) -> list[float] | None:
        text = self._parameters.get(name)
        if text is None:
            return None
        try:
            values = [float(part) for part in text.split(",")]
        except ValueError:
            values = []
        if len(values) != count or not all(0.0 < value < math.inf for value in values):
            what = f"{name}={text!r} is not {count} positive numbers"
            raise DrakeTeleopError(what, where=self.text, remedy="separate them by commas")
        return values

    def requested_wrench_name(self) -> str:
        """Return the name of the wrench to send: "contact" (default) or "scaled"."""
        return self._chosen_value("wrench", ("contact", "scaled"), "give contact or scaled")

    def wrench_sign(self) -> float:
        """Return the factor, -1 (default) or 1, from the reported wrench to that of Eq. (1)."""
        choices = "-1", "1", "+1", " 1"  # parse_qsl decodes + as a space
        return -1.0 if self._chosen_value("sign", choices, "give 1 or -1") == "-1" else 1.0

    def _chosen_value(self, name: str, choices: tuple[str, ...], remedy: str) -> str:
        text = self._parameters.get(name, choices[0])
        if text not in choices:
            what = f"{name}={text!r} is unknown"
            raise DrakeTeleopError(what, where=self.text, remedy=remedy)
        return text
