"""What there is to say about a value in a recording: name with unit, type, meaning, and the names of its numbers."""

from __future__ import annotations

import enum
import json
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredColumn:
    """Describes one value of the rows of a recording.

    Attributes:
        name: name of the field, and of its column or columns in Parquet.
        dtype: numpy type of a component, little-endian.
        text: meaning, for metadata and documentation.
        unit: in words of SI; "" for counts, flags and enumerations.
        size: number of components, 3 for vectors and 4 for quaternions; 0 for a scalar.
        names: what the numbers of an enumeration are called; None for other values.
        absent: number read from a recording that lacks the column. None: NaN for a floating-point column, while a
            recording that lacks an integer column is refused.
        formerly: name of the column in older recordings.
    """

    name: str
    dtype: str
    text: str
    unit: str = ""
    size: int = 0
    names: type[enum.IntEnum] | None = None
    absent: int | None = None
    formerly: str = ""

    @property
    def parts(self) -> list[str]:
        """Names of the Parquet columns, one for each component."""
        axes = {0: ("",), 3: ("_x", "_y", "_z"), 4: ("_w", "_x", "_y", "_z")}[self.size]
        return [self.name + axis for axis in axes]

    @property
    def entity(self) -> str:
        """Entity of the view that shows the value, `{}` being the agent; "" if none does."""
        return ""

    @property
    def metadata(self) -> dict[str, str]:
        """What Parquet says about the column; `names` is a JSON object from number to name."""
        said = {"unit": self.unit, "description": self.text, "entity": self.entity}
        if self.names is not None:
            said["names"] = json.dumps({str(member.value): member.name for member in self.names})
        return said


def dtype_of(columns: Sequence[StoredColumn]) -> np.dtype[np.void]:
    """Return the type of a packed row, little-endian and of fixed size, so that a file of rows is an array."""
    return np.dtype([(column.name, column.dtype, (column.size,) if column.size else ()) for column in columns])
