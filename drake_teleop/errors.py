"""The one exception family for what a user can mend: bad scenarios, bad logs, bad numbers."""

from __future__ import annotations


class DrakeTeleopError(ValueError):
    """Input that cannot be used. Its message is one line: what is wrong, where, and the remedy.

    The command line prints it as a single ``error:`` line and exits with status 2. Programming
    mistakes (a wrong type, a broken invariant) stay ordinary exceptions.

    Args:
        what: what is wrong, in the user's words.
        where: the place, as ``file:field`` or the name of a port; empty if there is none.
        remedy: what to do about it; empty if it is obvious.
    """

    def __init__(self, what: str, *, where: str = "", remedy: str = "") -> None:
        text = f"{where}: {what}" if where else what
        if remedy:
            text = f"{text}; {remedy}"
        super().__init__(" ".join(text.split()))
