"""Error for the scalar conversion of a block that runs compiled code with state."""

from __future__ import annotations

from typing import Any, NoReturn

from drake_teleop.common.errors import DrakeTeleopError

_NO_SLOTS: tuple[str, ...] = ()


class DoubleOnly:
    """Base class of blocks for double only; a conversion raises one clear error."""

    __slots__ = _NO_SLOTS  # a second dictionary would keep the block alive

    def _refuse(self, *_: Any) -> NoReturn:
        raise DrakeTeleopError(
            "computes with compiled code for double only",
            where=type(self).__name__,
            remedy="use NonContactWrench or WrenchScaling, or linearize numerically",
        )

    ToAutoDiffXd = ToSymbolic = _refuse
