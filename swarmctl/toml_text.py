"""Writes a plain tree as TOML; the standard library can only read it."""

from __future__ import annotations

import json
from typing import Any


def toml_text(tree: dict[str, Any]) -> str:
    """Return the whole tree as TOML text; keys must be bare, values of None are left out."""
    lines: list[str] = []
    _dump_table(tree, "", lines)
    return "\n".join(lines) + "\n"


def _dump_table(table: dict[str, Any], prefix: str, lines: list[str]) -> None:
    nested: list[tuple[str, Any]] = []
    for key, value in table.items():
        if isinstance(value, dict) or (isinstance(value, (list, tuple)) and value and isinstance(value[0], dict)):
            nested.append((key, value))
        elif value is not None:
            lines.append(f"{key} = {toml_value(value)}")
    for key, value in nested:
        name = f"{prefix}{key}"
        for item in [value] if isinstance(value, dict) else value:
            header = f"[{name}]" if isinstance(value, dict) else f"[[{name}]]"
            lines.extend(["", header])
            _dump_table(item, f"{name}.", lines)


def toml_value(value: Any) -> str:
    """Return a value as TOML on one line; None inside a table is left out."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(toml_value(v) for v in value) + "]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k} = {toml_value(v)}" for k, v in value.items() if v is not None) + "}"
    raise TypeError(f"no TOML for {type(value).__name__}")
