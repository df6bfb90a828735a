"""Field types of a log description."""

from __future__ import annotations

import re
from functools import partial
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, WithJsonSchema, field_validator

from drake_teleop.common.rotations import nearest_rotation, orthogonality_error

ROTATION_TOLERANCE = 0.01  # of the entries of R^T R
_MIN_SCALE_FACTOR = 1e-12
STANDARD_GRAVITY = 9.80665
SI_VALUE_OF_UNIT = {
    "s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9,
    "N": 1.0, "mN": 1e-3, "kN": 1e3, "daN": 10.0,
    "gf": 1e-3 * STANDARD_GRAVITY, "kgf": STANDARD_GRAVITY,
    "ozf": 0.27801385095378125, "lbf": 4.4482216152605,
    "N m": 1.0, "mN m": 1e-3, "kN m": 1e3, "daN m": 10.0, "N cm": 1e-2, "N mm": 1e-3,
    "gf cm": 1e-5 * STANDARD_GRAVITY, "kgf cm": 1e-2 * STANDARD_GRAVITY, "kgf m": STANDARD_GRAVITY,
    "ozf in": 0.007061551814228644, "lbf in": 0.1129848290276167, "lbf ft": 1.3558179483314004,
    "rad": 1.0, "rad/s": 1.0, "rad/s^2": 1.0,
    "deg": np.pi / 180, "deg/s": np.pi / 180, "deg/s^2": np.pi / 180,
    "m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254, "m/s^2": 1.0, "mm/s^2": 1e-3,
    "mdeg/s": 1e-3 * np.pi / 180,
}  # fmt: skip
"""SI value of each unit, except "g", the magnitude of the described gravity, and "mg"."""
_UNIT_OF_SPELLING = {
    **{re.sub(r"[ ^]", "", unit).lower(): unit for unit in (*SI_VALUE_OF_UNIT, "g", "mg")},
    "µs": "us", "°": "deg", "dps": "deg/s", "mdps": "mdeg/s", "°/s": "deg/s", "m/s²": "m/s^2",
    "rad/s²": "rad/s^2", "sec": "s",
}  # fmt: skip


def known_unit(text: str) -> str:
    """Return the name of a unit in any spelling, such as "N m" for "[Nm]"; "" if it is unknown."""
    plain = re.sub(r"[] ^[*.·]", "", text).lower().replace("\u03bc", "µ")
    return _UNIT_OF_SPELLING.get(plain, "")


def _parse_frame(value: Any, *, keywords: tuple[str, ...] = ("sensor", "base")) -> Any:
    if value in keywords:
        return value
    try:
        matrix = np.asarray(value)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape != (3, 3) or matrix.dtype.kind not in "fi":
        words = " or ".join(keywords)
        raise ValueError(f"must be a 3x3 rotation matrix from the stream to S, or the word {words}")
    if not (np.abs(matrix) < 2.0).all() or orthogonality_error(matrix) > ROTATION_TOLERANCE:
        raise ValueError("is not a rotation: rows must be orthonormal with determinant +1")
    return tuple(map(tuple, nearest_rotation(matrix).tolist()))


def _parse_rotation(value: Any) -> Any:
    return value if value is None else _parse_frame(value, keywords=("auto",))


def _parse_position(value: Any) -> Any:
    if isinstance(value, str) and value != "auto":
        raise ValueError("a position must be three numbers [m], or the word auto")
    return value


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _parse_gravity(value: Any) -> Any:
    if isinstance(value, str) and value != "auto":
        raise ValueError("gravity must be a number, three numbers [m/s^2], or the word auto")
    if _is_number(value) and value < 0.0:
        raise ValueError(
            f"the magnitude of gravity is {value:g}: remove the sign, or give a vector"
        )
    return [0.0, 0.0, -float(value)] if _is_number(value) else value


def _parse_scale_factors(value: Any) -> Any:
    factors = value if isinstance(value, (list, tuple)) else [value]
    if any(_is_number(x) and abs(x) < _MIN_SCALE_FACTOR for x in factors):
        raise ValueError(f"a scale factor is below {_MIN_SCALE_FACTOR:g} in magnitude")
    return [float(value)] * 3 if _is_number(value) else value


def _parse_removed_weight(value: Any) -> Any:
    if value is not None and value != "removed" and not isinstance(value, (list, tuple)):
        raise ValueError("weight must be the word removed, or [m, m c_x, m c_y, m c_z] in kg, kg m")
    return value


Column = str | int
Number = Annotated[float, Field(strict=True)]  # rejects true and "1"
Vector = Annotated[tuple[Number, Number, Number], Field(strict=False)]
Rotation = tuple[Vector, Vector, Vector]
GainStd = Annotated[
    Number,
    Field(
        ge=0,
        le=0.2,
        description="standard deviation of the sensor's gains, such as 0.01 for 1 %, from its data"
        " sheet or a calibration",
    ),
]
_NUMBER_OR_VECTOR_SCHEMA: list[dict[str, Any]] = [
    {"type": "number"},
    {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3},
]
_GRAVITY_SCHEMA = {
    "anyOf": [*_NUMBER_OR_VECTOR_SCHEMA, {"type": "string", "const": "auto"}],
    "description": "magnitude, or the vector in the world, m/s^2; auto: the direction is estimated",
}
Gravity = Annotated[
    Vector | Literal["auto"], BeforeValidator(_parse_gravity), WithJsonSchema(_GRAVITY_SCHEMA)
]
_SCALE_SCHEMA = {
    "anyOf": _NUMBER_OR_VECTOR_SCHEMA,
    "description": "factor on the numbers of the file, or one for each column; -1 for another sign",
}
Scale = Annotated[Vector, BeforeValidator(_parse_scale_factors), WithJsonSchema(_SCALE_SCHEMA)]
MassAndMoment = Annotated[tuple[Number, Number, Number, Number], Field(strict=False)]
Weight = Annotated[
    MassAndMoment | Literal["removed"] | None,
    BeforeValidator(_parse_removed_weight),
    Field(
        description="weight that the robot has subtracted: removed (that of the load), or that of a"
        " payload, [m, m c_x, m c_y, m c_z] in S, kg and kg m"
    ),
]
Frame = Annotated[Literal["sensor", "base"] | Rotation, BeforeValidator(_parse_frame)]
ImuFrame = Annotated[
    Literal["sensor", "base", "auto"] | Rotation,
    BeforeValidator(partial(_parse_frame, keywords=("sensor", "base", "auto"))),
]
RotationOrAuto = Annotated[Literal["auto"] | Rotation | None, BeforeValidator(_parse_rotation)]
PositionOrAuto = Annotated[Vector | Literal["auto"], BeforeValidator(_parse_position)]


class StrictModel(BaseModel):
    """Immutable Pydantic model that rejects unknown fields and numbers beyond 1e12."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _reject_huge_numbers(cls, value: Any) -> Any:
        for number in value if isinstance(value, list) else [value]:
            if isinstance(number, (int, float)) and 1e12 < abs(number) < np.inf:
                raise ValueError(f"{number:g} is outside -1e12 to 1e12: check the number")
        return value


class _VectorColumns(StrictModel):
    columns: tuple[Column, ...]
    scale: Scale = (1.0, 1.0, 1.0)


class Force(_VectorColumns):
    """Columns of a force and their unit."""

    unit: Literal["N", "mN", "kN", "daN", "gf", "kgf", "ozf", "lbf"] = "N"


class Torque(_VectorColumns):
    """Columns of a torque and their unit."""

    unit: Literal[
        "N m", "mN m", "kN m", "daN m", "N cm", "N mm",
        "gf cm", "kgf cm", "kgf m", "ozf in", "lbf in", "lbf ft",
    ] = "N m"  # fmt: skip


class Acceleration(_VectorColumns):
    """Columns of a linear acceleration, their unit, and bias to subtract."""

    unit: Literal["m/s^2", "g", "mg", "mm/s^2"] = "m/s^2"
    bias: Vector = (0.0, 0.0, 0.0)


class AngularVelocity(_VectorColumns):
    """Columns of an angular velocity, their unit, and bias to subtract."""

    unit: Literal["rad/s", "deg/s", "mdeg/s"] = "rad/s"
    bias: Vector = (0.0, 0.0, 0.0)


class AngularAcceleration(_VectorColumns):
    """Columns of an angular acceleration, their unit, and bias to subtract."""

    unit: Literal["rad/s^2", "deg/s^2"] = "rad/s^2"
    bias: Vector = (0.0, 0.0, 0.0)


class Position(_VectorColumns):
    """Columns of a position and their unit."""

    unit: Literal["m", "cm", "mm", "in"] = "m"


FORCE_UNITS, TORQUE_UNITS, POSITION_UNITS = (
    get_args(quantity.model_fields["unit"].annotation) for quantity in (Force, Torque, Position)
)
