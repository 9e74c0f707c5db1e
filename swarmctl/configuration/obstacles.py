"""Reads the file of obstacles alone that a configuration may name in the place of its own `[[obstacles]]`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from swarmctl.configuration.source import read_tree, shown
from swarmctl.errors import ConfigError

_KEY = "obstacles"


def read_obstacles(tree: dict[str, Any], folder: Path) -> list[str]:
    """Put the obstacles of a file in the place of its name; returns the problems.

    A resolved configuration therefore holds them, and needs no file but itself.

    Args:
        tree: a configuration, whose form is checked later.
        folder: folder that relative names are relative to.
    """
    name = tree.get(_KEY)
    if not isinstance(name, str):
        return []
    try:
        held = read_tree(folder / name)
    except ConfigError as error:
        return [f"{_KEY} = {shown(name)}: {error}; write [[{_KEY}]] here, or the name of a file that holds them alone"]
    if others := sorted(held.keys() - {_KEY}) or ([] if isinstance(held.get(_KEY), list | dict) else ["none"]):
        return [f"{_KEY} = {shown(name)}: holds {', '.join(others)}; a file of obstacles holds [[{_KEY}]] alone"]
    tree[_KEY] = held[_KEY]
    return []
