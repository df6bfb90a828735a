"""Text of a robot model after the repairs that let Drake read it."""

from typing import NamedTuple


class RepairedModel(NamedTuple):
    """Model text without the elements that Drake rejects or reads wrongly.

    Attributes:
        text: XML for Drake's parser, with absolute mesh paths.
        assumptions: one text per kind of repair, with the names and numbers of what changed.
        effort_limits: torque or force limits [N m, N] by joint; joints without an entry have none.
        dependent: reasons why joints or links do not move independently, by name.
        auxiliary: massless bodies between several joints of one body, which the file does not have.
    """

    text: str
    assumptions: list[str]
    effort_limits: dict[str, float]
    dependent: dict[str, str] = {}  # noqa: RUF012  (never changed)
    auxiliary: frozenset[str] = frozenset()
