"""Addresses of robots: kind://HOST[:PORT][?name=value&...]."""

from __future__ import annotations

import math
from urllib.parse import parse_qsl, urlsplit

from drake_teleop.common.errors import DrakeTeleopError


class Address:
    """The parts of an address.

    Args:
        text: the address.
        port: if it says none.
        known: the names that it may have.
        host: if it says none.

    Raises:
        DrakeTeleopError: without a host, or with another name or port.
    """

    def __init__(
        self, text: str, port: int | None, known: tuple[str, ...], *, host: str = ""
    ) -> None:
        self.text = text
        try:
            parts = urlsplit(text)
            said = dict(parse_qsl(parts.query, keep_blank_values=True, strict_parsing=False))
            self.host, self.port = parts.hostname or host, parts.port or port
        except ValueError as error:
            raise DrakeTeleopError(str(error), where=text) from error
        if not self.host:
            raise DrakeTeleopError("has no host", where=text, remedy=f"{parts.scheme}://HOST")
        self.path = parts.path.strip("/")
        self._said = said
        for name in said:
            if name not in known:
                raise DrakeTeleopError(
                    f"has {name!r}, which it cannot have",
                    where=text,
                    remedy=f"it may have {', '.join(known)}",
                )

    def text_of(self, name: str) -> str | None:
        """What it says under that name."""
        return self._said.get(name)

    def numbers(self, name: str, count: int) -> list[float] | None:
        """Positive numbers with commas between them.

        Raises:
            DrakeTeleopError: if they are others.
        """
        text = self._said.get(name)
        if text is None:
            return None
        try:
            values = [float(part) for part in text.split(",")]
        except ValueError:
            values = []
        if len(values) != count or not all(0.0 < value < math.inf for value in values):
            raise DrakeTeleopError(
                f"{name}={text!r} is not {count} positive numbers", where=self.text
            )
        return values

    def choice(self, name: str, among: tuple[str, ...]) -> str:
        """One of some words, the first if it says none.

        Raises:
            DrakeTeleopError: if it is another.
        """
        text = self._said.get(name, among[0])
        if text not in among:
            raise DrakeTeleopError(
                f"{name}={text!r} is neither {' nor '.join(among)}", where=self.text
            )
        return text

    def sign(self) -> float:
        """+1 for what the sensor exerts on the load, Eq. (1); -1, the default, for the opposite.

        Raises:
            DrakeTeleopError: for anything else.
        """
        text = self._said.get("sign", "-1")
        if text not in ("-1", "1", "+1", " 1"):  # a plus in a query is a blank
            raise DrakeTeleopError(f"sign={text!r} is neither 1 nor -1", where=self.text)
        return -1.0 if text == "-1" else 1.0
