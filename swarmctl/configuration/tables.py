"""Reads the CSV files that a configuration names into its tree, beside their names.

A resolved configuration therefore holds what is flown: agents, reports and replays need no file but `config.toml`.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from swarmctl.core.text import printable
from swarmctl.files import read_file

_MAX_BYTES = 1_000_000  # of one file
_MOST_FILLED_IN = 3_500_000  # characters of all, of the 4 MB that a resolved configuration may have
_MAX_SHOWN = 80
_OTHER_MARKS = {";": "semicolons", "\t": "tabs", " ": "spaces"}  # between values, of files that have no commas


def read_tables(tree: dict[str, Any], folder: Path) -> list[str]:
    """Fill in `mission.csv.tables` from `mission.csv.files`, unless it is there already; returns the problems.

    Args:
        tree: a configuration, whose form is checked later.
        folder: folder that relative names are relative to.
    """
    mission = tree.get("mission")
    section = mission.get("csv") if isinstance(mission, dict) else None
    if not isinstance(section, dict) or "tables" in section:
        return []
    files = section.get("files")
    if not isinstance(files, list) or not all(isinstance(name, str) for name in files):
        return []  # refused with the other keys
    tables, problems = [], []
    for name in files:
        table, problem = _table(folder / name)
        tables.append(table)
        problems += [f"mission.csv.files: {printable(name, _MAX_SHOWN)}: {problem}"] if problem else []
    rows = (row for table in tables for row in table.get("rows", ()))
    filled_in = sum(len(repr(number)) + 2 for row in rows for number in row)
    if filled_in > _MOST_FILLED_IN:
        has = f"hold {filled_in / 1e6:.1f} MB of numbers together; allowed: {_MOST_FILLED_IN / 1e6:g} MB"
        problems.append(f"mission.csv.files: {has}. Leave out digits, or rows: what is between them is interpolated")
    section["tables"] = tables
    return problems


def _table(path: Path) -> tuple[dict[str, Any], str]:
    """Return the table of a file, and why it is none, or ""."""
    try:
        text = read_file(path, _MAX_BYTES, follow=True).decode("utf-8-sig")
    except FileNotFoundError:
        return {}, f"no such file ({path}); names are relative to the configuration's folder"
    except OSError as error:
        return {}, f"can't be read: {error.strerror}"
    except UnicodeDecodeError:
        return {}, "can't be read: it is not UTF-8 text"
    try:
        lines = [(number, _cells(row)) for number, row in enumerate(csv.reader(text.splitlines()), 1)]
    except csv.Error as error:
        return {}, f"can't be read as CSV: {error}"
    lines = [(number, cells) for number, cells in lines if cells and not cells[0].startswith("#")]
    if not lines:
        return {}, "is empty; its first line names the columns, for example t,x,y,z"
    first = lines[0][1]
    if len(first) == 1 and (mark := next((mark for mark in _OTHER_MARKS if mark in first[0]), "")):
        return {}, f"its values are separated by {_OTHER_MARKS[mark]}; separate them by commas, with points in decimals"
    if all(_number(cell) is not None for cell in first):
        return {}, "its first line holds numbers; it has to name the columns, for example t,x,y,z"
    columns = [name.lower() for name in first]
    rows = []
    for number, cells in lines[1:]:
        numbers = [_number(cell) for cell in cells]
        if len(numbers) != len(columns):
            return {}, f"line {number}: {len(numbers)} values for {len(columns)} columns"
        for name, cell, value in zip(columns, cells, numbers, strict=True):
            if value is None:
                return {}, f"line {number}: {name} = {printable(cell, _MAX_SHOWN)!r} is not a finite number"
        rows.append(numbers)
    return {"columns": columns, "rows": rows}, ""


def _cells(row: Sequence[str]) -> list[str]:
    """Return the values of a line; an empty last one, after a comma at the end, does not count."""
    cells = [cell.strip() for cell in row]
    return cells[:-1] if cells and not cells[-1] else cells


def _number(cell: str) -> float | None:
    """Return the finite number that a text is, or None."""
    try:
        value = float(cell)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
