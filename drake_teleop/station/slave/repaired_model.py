"""Text of a robot model after the repairs that let Drake read it."""

from typing import NamedTuple


class RepairedModel(NamedTuple):
    """Model text without the elements that Drake rejects or reads wrongly.

    Attributes:
        text: XML for Drake's parser, with absolute mesh paths.
        assumptions: one text per kind of repair, with the names and numbers of what changed.
        effort_limits: torque or force limits [N m, N] by joint; joints without an entry have none.
    """

    text: str
    assumptions: list[str]
    effort_limits: dict[str, float]
