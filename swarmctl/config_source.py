"""From a TOML file and `--set` items to a plain tree, refused in words where it could not be read, shown or nested.

What the keys mean is the business of `config`; here only the shape counts: a regular file of bounded size, tables and
lists nested as deeply as a configuration has them, and integers that TOML allows (64 bits).
"""

from __future__ import annotations

import itertools
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from swarmctl.core.text import printable
from swarmctl.errors import ConfigError
from swarmctl.files import read_file

_MAX_BYTES = 4_000_000
_MAX_DEPTH = 12  # sections and lists inside each other; ours need 5
_INT64 = range(-(2**63), 2**63)
_MAX_SHOWN = 80
_MAX_INDEX_DIGITS = 6  # digits


def read_tree(path: Path | None) -> dict[str, Any]:
    """The tree of a TOML file; empty without one.

    Raises:
        ConfigError: there is no such file, or it can't be read as TOML.
    """
    if path is None:
        return {}
    try:
        tree = tomllib.loads(read_file(path, _MAX_BYTES, follow=True).decode("utf-8"))
    except FileNotFoundError as error:
        raise ConfigError(str(path), ["no such file. Give the path of a TOML file, for example configs/"]) from error
    except OSError as error:
        raise ConfigError(str(path), [f"can't be read: {error.strerror}. Give the path of a TOML file"]) from error
    except UnicodeDecodeError as error:
        raise ConfigError(str(path), [f"can't be read: {error}"]) from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(str(path), [f"not TOML: {error}"]) from error
    except RecursionError as error:
        raise ConfigError(
            str(path), [f"nested too deeply; allowed: {_MAX_DEPTH} sections inside each other"]
        ) from error
    except ValueError as error:  # of a number: TOML's parser leaves its digits to Python
        raise ConfigError(str(path), ["holds an integer of too many digits; TOML's have 64 bits"]) from error
    problems = list(shape_problems(tree))
    if problems:
        raise ConfigError(str(path), problems)
    return tree


def override(tree: dict[str, Any], item: str) -> list[str]:
    """Set `key.sub=value` in `tree`; returns what is wrong with it."""
    key, equals, text = item.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts):
        return [f"--set {shown(item)}: write it as key.sub=value"]
    if len(parts) > _MAX_DEPTH:
        return [f"--set {printable(key, _MAX_SHOWN)}: {len(parts)} sections inside each other; allowed: {_MAX_DEPTH}"]
    try:
        value = _value(text)
    except ValueError as error:
        return [f"--set {printable(key, _MAX_SHOWN)}: {error}"]
    wrong = _place(tree, parts, value)
    if wrong:
        return [f"--set {printable(key, _MAX_SHOWN)}: {wrong}"]
    return [f"--set {problem}" for problem in shape_problems({key: value})]


def _place(tree: dict[str, Any], parts: list[str], value: Any) -> str:
    node: Any = tree
    for part, following in itertools.pairwise(parts):
        if isinstance(node, list):
            at = _index(part, len(node))
            if at is None:
                return f"{shown(part)} is not an index of a list of {len(node)}"
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
    """Place in a list of `length`, None for what is none."""
    if not part.isdecimal() or len(part) > _MAX_INDEX_DIGITS:
        return None
    return at if (at := int(part)) < length else None


def _value(text: str) -> Any:
    """A TOML value; anything that is not exactly one is the text itself.

    Raises:
        ValueError: it is one, but a number of too many digits or nested too deeply.
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
    """What is nested too deeply to be checked, and integers too large to be shown; without recursion."""
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
    """A refused value in a message, of bounded length."""
    if isinstance(value, int) and value not in _INT64:
        return f"an integer of {value.bit_length()} bits"
    return printable(repr(value), _MAX_SHOWN)
