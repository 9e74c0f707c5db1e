"""Reads a TOML file and `--set` items into a plain tree, and refuses what can't be read, shown or checked.

`config` checks the meaning of keys. This module checks the form: a regular file of bounded size, bounded nesting, and
integers of 64 bits, as in TOML.
"""

from __future__ import annotations

import copy
import itertools
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from swarmctl.core.text import printable
from swarmctl.errors import ConfigError
from swarmctl.files import read_file

_MAX_BYTES = 4_000_000
_MAX_DEPTH = 12  # nesting of sections and lists; a configuration needs 5
_INT64 = range(-(2**63), 2**63)
_MAX_SHOWN = 80
_MAX_INDEX_DIGITS = 6  # digits
_FILLED_IN = (("csv", "files", "tables"), ("skybrush", "file", "trajectories"))  # of [mission]: names, and what is read
_NO_FILE = "no such file. Give the path of a TOML file; swarmctl config init NAME writes one to begin with"


def filled_in(tree: Mapping[str, Any]) -> dict[str, Any]:
    """Return the names of the files whose contents a resolved configuration holds, by section of the mission."""
    found = {}
    for section, names, contents in _FILLED_IN:
        keys = _keys_of(tree, section)
        if contents in keys:
            found[section] = (copy.deepcopy(keys.get(names)), keys[contents])
    return found


def forget_other_files(tree: Mapping[str, Any], before: Mapping[str, Any]) -> None:
    """Remove what was read from files of which others have been named since: these are read in their place.

    Args:
        tree: the plain tree, with what has been set in it.
        before: as `filled_in` has returned of it before that.
    """
    for section, names, contents in _FILLED_IN:
        keys = _keys_of(tree, section)
        if section in before and keys.get(names) != before[section][0] and keys.get(contents) is before[section][1]:
            del keys[contents]


def _keys_of(tree: Mapping[str, Any], section: str) -> dict[str, Any]:
    mission = tree.get("mission")
    keys = mission.get(section) if isinstance(mission, dict) else None
    return keys if isinstance(keys, dict) else {}


def read_tree(path: Path | None) -> dict[str, Any]:
    """Return the tree of a TOML file, empty for None.

    Raises:
        ConfigError: the file does not exist or is no TOML.
    """
    if path is None:
        return {}
    try:
        tree = tomllib.loads(read_file(path, _MAX_BYTES, follow=True).decode("utf-8-sig"))
    except FileNotFoundError as error:
        raise ConfigError(str(path), [_NO_FILE]) from error
    except OSError as error:
        raise ConfigError(str(path), [f"can't be read: {error.strerror}. Give the path of a TOML file"]) from error
    except UnicodeDecodeError as error:
        problem = f"can't be read: no UTF-8 text, see byte {error.start}. Give the path of a TOML file"
        raise ConfigError(str(path), [problem]) from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(str(path), [f"not TOML: {error}"]) from error
    except RecursionError as error:
        raise ConfigError(
            str(path), [f"nested too deeply; allowed: {_MAX_DEPTH} sections inside each other"]
        ) from error
    except ValueError as error:  # raised by Python's int for too many digits
        raise ConfigError(str(path), ["holds an integer of too many digits; TOML's have 64 bits"]) from error
    problems = list(shape_problems(tree))
    if problems:
        raise ConfigError(str(path), problems)
    return tree


def override(tree: dict[str, Any], item: str) -> list[str]:
    """Set `key.sub=value` in `tree`; returns the problems with it."""
    key, equals, text = item.partition("=")
    if not equals or not all(key.strip().split(".")):
        return [f"--set {shown(item)}: write it as key.sub=value"]
    try:
        value = _value(text)
    except ValueError as error:
        return [f"--set {printable(key, _MAX_SHOWN)}: {error}"]
    return [f"--set {problem}" for problem in set_value(tree, key, value)]


def set_value(tree: dict[str, Any], key: str, value: Any) -> list[str]:
    """Set the value of a dotted key in `tree`; returns the problems with it."""
    parts, name = key.strip().split("."), printable(key, _MAX_SHOWN)
    if not all(parts):
        return [f"{shown(key)}: write it as key.sub"]
    if len(parts) > _MAX_DEPTH:
        return [f"{name}: {len(parts)} sections inside each other; allowed: {_MAX_DEPTH}"]
    if problems := list(shape_problems({key: value})):
        return problems
    wrong = _place(tree, parts, value)
    return [f"{name}: {wrong}"] if wrong else []


def _place(tree: dict[str, Any], parts: list[str], value: Any) -> str:
    node: Any = tree
    for part, following in itertools.pairwise(parts):
        if isinstance(node, list):
            at = _index(part, len(node))
            if at is None:
                whole = "set the whole list, key=[...], or write it in the file"
                return f"{shown(part)} is not an index of a list of {len(node)}" + ("" if node else f"; {whole}")
            node = node[at]
        elif isinstance(node, dict):
            node = node.setdefault(part, [] if following.isdecimal() else {})
        else:
            return f"{shown(part)} is inside a value, not a section"
    last = parts[-1]
    if isinstance(node, dict):
        node[last] = value
    elif isinstance(node, list) and (at := _index(last, len(node))) is not None:
        node[at] = value
    else:
        return "no such place"
    return ""


def _index(part: str, length: int) -> int | None:
    """Return the list index that `part` names, None if it is not one of a list of `length`."""
    if not part.isdecimal() or len(part) > _MAX_INDEX_DIGITS:
        return None
    return at if (at := int(part)) < length else None


def _value(text: str) -> Any:
    """Parse a TOML value; text that is not exactly one value is returned as a string.

    Raises:
        ValueError: a number has too many digits, or the value is nested too deeply.
    """
    try:
        tree = tomllib.loads(f"v = {text}")
    except tomllib.TOMLDecodeError:
        return text
    except RecursionError as error:
        raise ValueError(f"nested too deeply; allowed: {_MAX_DEPTH}") from error
    except ValueError as error:
        raise ValueError("an integer of too many digits; TOML's have 64 bits") from error
    return tree["v"] if tree.keys() == {"v"} else text


def shape_problems(tree: dict[str, Any]) -> Iterator[str]:
    """Yield values nested too deeply and integers beyond 64 bits; works without recursion."""
    level: list[tuple[str, Any]] = list(tree.items())
    for _ in range(_MAX_DEPTH):
        for key, value in level:
            if isinstance(value, int) and value not in _INT64:
                yield f"{printable(key, _MAX_SHOWN)} = {shown(value)}: TOML's integers have 64 bits"
        level = [inner for key, value in level for inner in _inside(key, value)]
        if not level:
            return
    key = level[0][0]
    yield f"{printable(key, _MAX_SHOWN)}: nested too deeply; allowed: {_MAX_DEPTH} sections and lists inside each other"


def _inside(key: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        yield from ((f"{key}.{name}", item) for name, item in value.items())
    elif isinstance(value, list):
        yield from ((f"{key}.{number}", item) for number, item in enumerate(value))


def shown(value: Any) -> str:
    """Return a refused value as text of bounded length."""
    if isinstance(value, int) and value not in _INT64:
        return f"an integer of {value.bit_length()} bits"
    return printable(repr(value), _MAX_SHOWN)
