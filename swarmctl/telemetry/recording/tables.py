"""Arrow tables of recorded rows: one column for each component, with units, meanings and names of enumerations.

`plain_table` is what Parquet stores. `named_table` is for people: enumerations are words instead of numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from swarmctl import __version__
from swarmctl.core.recorded.stored_column import StoredColumn

if TYPE_CHECKING:
    import pyarrow as pa  # imported in functions, to keep it out of agent processes

VERSION_KEY = "swarmctl_version"  # of the metadata of Parquet


def plain_table(rows: NDArray[np.void], columns: Sequence[StoredColumn]) -> pa.Table:
    """Return rows (T,) as a table of numbers."""
    import pyarrow as pa

    return _table([(column, part, pa.array(values)) for column, part, values in _components(rows, columns)])


def named_table(rows: NDArray[np.void], columns: Sequence[StoredColumn]) -> pa.Table:
    """Return rows (T,) as a table in which enumerations are dictionary-encoded words; unknown numbers stay numerals."""
    import pyarrow as pa

    cells = []
    for column, part, values in _components(rows, columns):
        cells.append((column, part, pa.array(values) if column.names is None else _words(column.names, values)))
    return _table(cells)


def _components(
    rows: NDArray[np.void], columns: Sequence[StoredColumn]
) -> list[tuple[StoredColumn, str, NDArray[Any]]]:
    """Return each component (T,) with its column and its own name."""
    found = []
    for column in columns:
        values = rows[column.name].reshape(len(rows), len(column.parts))  # (T, components)
        found += [(column, part, np.ascontiguousarray(values[:, k])) for k, part in enumerate(column.parts)]
    return found


def _words(names: Any, values: NDArray[Any]) -> Any:
    """Return numbers (T,) as words of an enumeration."""
    import pyarrow as pa

    numbers, index = np.unique(values, return_inverse=True)
    known = {member.value: member.name for member in names}
    words = [known.get(int(number), str(number)) for number in numbers]
    return pa.DictionaryArray.from_arrays(pa.array(index.astype(np.int32)), pa.array(words, pa.string()))


def _table(cells: Sequence[tuple[StoredColumn, str, Any]]) -> pa.Table:
    import pyarrow as pa

    fields = [pa.field(part, values.type, metadata=column.metadata) for column, part, values in cells]
    schema = pa.schema(fields, metadata={VERSION_KEY: __version__})
    return pa.Table.from_arrays([values for _, _, values in cells], schema=schema)
