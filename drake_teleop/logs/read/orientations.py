"""Orientations of a stream, converted in blocks of rows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drake_teleop.common.errors import DrakeTeleopError
from drake_teleop.logs.read.description import Description, Orientation
from drake_teleop.logs.read.description_fields import ROTATION_TOLERANCE
from drake_teleop.logs.read.rotations import (
    WIDTHS,
    nearest_rotation,
    quaternions,
    rotation_error,
    rotation_matrices,
)
from drake_teleop.logs.read.tables import Table


class Orientations:
    """Orientations R_WS, or their inverses, of `rows` rows of a table."""

    def __init__(
        self,
        description: Description,
        orientation: Orientation,
        table: Table,
        rows: int,
        where: str,
    ) -> None:
        self._orientation, self._table, self._where = orientation, table, where
        width = WIDTHS[orientation.form]
        self._columns = table.numbers(orientation.columns, width, f"{where}.columns", rows)
        if orientation.form == "rotation_vector":
            self._columns *= description.scale(orientation.unit)

    def rotations(self, rows: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return (n, 3, 3) R_WS of n rows; raise an error for other matrices."""
        R = rotation_matrices(self._columns[rows], self._orientation.form)
        self._check_errors(rotation_error(R), rows)
        return nearest_rotation(np.swapaxes(R, 1, 2) if self._orientation.inverse else R)

    def quaternions(self, rows: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return (n, 4) [w, x, y, z] of `rotations`, without matrices where possible."""
        if not self._orientation.form.startswith("quaternion"):
            return quaternions(self.rotations(rows))
        q = self._columns[rows]
        if self._orientation.form == "quaternion_xyzw":
            q = np.roll(q, 1, axis=1)
        squared = np.einsum("ij,ij->i", q, q)  # the matrix of q is this, times a rotation
        self._check_errors(np.abs(squared**2 - 1.0), rows)
        q /= np.sqrt(squared)[:, None]
        if self._orientation.inverse:
            q[:, 1:] *= -1.0
        return q

    def _check_errors(self, errors: NDArray[np.float64], rows: NDArray[np.intp]) -> None:
        worst = int(np.argmax(errors))
        if errors[worst] > ROTATION_TOLERANCE:
            row = rows[worst] + self._table.first_row
            raise DrakeTeleopError(
                f"row {row} of {self._table.path.name} is not a rotation",
                where=self._where,
                remedy=f"check the columns and their order; form is {self._orientation.form}",
            )
