"""Writes the table of recorded columns into `docs/data_formats.md` from `COLUMNS` of `core.recorded.tick_record`.

`python tools/recorded_columns.py`. A test compares the page with what this writes.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from swarmctl.core.recorded.tick_record import COLUMNS, Column

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "data_formats.md"
_HEAD = "| column | type | unit | is | in the view |\n|---|---|---|---|---|\n"


def page(text: str) -> str:
    """Return the page `text` with the table of columns as declared."""
    before, _, rest = text.partition(_HEAD)
    _, _, after = rest.partition("\n\n")
    return before + _HEAD + "\n".join(map(_row, COLUMNS)) + "\n\n" + after


def _row(column: Column) -> str:
    kind = np.dtype(column.dtype).name + (f" x {column.size}" if column.size else "")
    entity = f"`{column.entity.format('<i>')}`" if column.entity else ""
    return f"| `{column.name}` | {kind} | {column.unit} | {column.text} | {entity} |".replace("  |", " |")


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    print(PAGE.relative_to(ROOT))
