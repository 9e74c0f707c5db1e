"""What `swarmctl config` prints and writes: keys with values, a schema for editors, and commented files."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from swarmctl.built_in_configs import EXAMPLES, built_in_files
from swarmctl.config import Config
from swarmctl.configuration.keys import Key, Section, meanings, sections, value_text
from swarmctl.core.params import Params, model_in
from swarmctl.errors import ConfigError

DEFAULTS = "defaults"  # name of the file of all keys
_ITEM = ".N."
_HEAD = """\
# Every key of a configuration, with its default: remove the first # of a line, and of its section's, to set it.
# Fly with: swarmctl launch FILE
"""


class ShownKey(msgspec.Struct, frozen=True, kw_only=True):
    """A key with the value that a configuration gives it."""

    key: str
    value: Any  # None: not set
    default: Any
    type: str
    required: bool
    allowed: str
    meaning: str


def shown_keys(config: Config, wanted: str = "") -> list[ShownKey]:
    """Return the keys of a configuration: the one that is wanted, those of a section, or those with such a word.

    Items of lists have a key for each item, and one with `N` in the place of the index where the list is empty.

    Raises:
        ConfigError: there is none.
    """
    keys = [shown for section in sections() for shown in _of_section(section, config)]
    if not wanted:
        return keys
    exact = [shown for shown in keys if shown.key == wanted or shown.key.startswith(f"{wanted}.")]
    found = exact or [shown for shown in keys if wanted.lower() in shown.key.lower()]
    if found:
        return found
    names = {shown.key.rpartition(".")[2]: shown.key for shown in keys}
    close = [names[name] for name in difflib.get_close_matches(wanted.rpartition(".")[2], names, 3)]
    hint = f"did you mean {' or '.join(map(repr, close))}?" if close else "list all with: swarmctl config show"
    raise ConfigError("config show", [f"{wanted}: no key, section or part of a key; {hint}"])


def _of_section(section: Section, config: Config) -> Iterator[ShownKey]:
    if not section.is_listed:
        yield from (_shown(key, key.path, _value_at(config, key.path)) for key in section.keys)
        return
    items = _value_at(config, section.path)
    for index, item in enumerate(items):
        yield from (_shown(key, key.path.replace(_ITEM, f".{index}."), getattr(item, key.name)) for key in section.keys)
    if not items:
        yield from (_shown(key, key.path, None) for key in section.keys)


def _shown(key: Key, path: str, value: Any) -> ShownKey:
    return ShownKey(
        key=path,
        value=_plain(value),
        default=_plain(key.default),
        type=key.kind,
        required=key.is_required,
        allowed=key.allowed,
        meaning=key.meaning,
    )


def _value_at(config: Config, path: str) -> Any:
    value: Any = config
    for part in path.split("."):
        value = getattr(value, part)
    return value


def _plain(value: Any) -> Any:
    return value.model_dump(exclude_none=True) if isinstance(value, Params) else value


def lines_of(keys: list[ShownKey]) -> list[str]:
    """Return one line a key, as in a file or after `--set`; of a single key, its meaning and range below it."""
    if len(keys) != 1:
        return [f"{_assignment(shown)}  # {_about(shown)}" for shown in keys]
    (shown,) = keys
    return [_assignment(shown), *(f"  {words}" for words in (shown.meaning, _limits(shown)) if words)]


def as_json(keys: list[ShownKey]) -> str:
    """Return the keys as a JSON list of objects."""
    return json.dumps(msgspec.to_builtins(keys), indent=2)


def _assignment(shown: ShownKey) -> str:
    return f"# {shown.key}: not set" if shown.value is None else f"{shown.key} = {value_text(shown.value)}"


def _limits(shown: ShownKey) -> str:
    default = "not set" if shown.default is None else value_text(shown.default)
    words = [shown.type, shown.allowed, "required" if shown.required else f"default {default}"]
    return "; ".join(filter(None, words)).replace("`", "")


def _about(shown: ShownKey) -> str:
    return "; ".join(filter(None, (shown.meaning, _limits(shown))))


def schema() -> str:
    """Return the JSON schema of a configuration file, for editors, with the meaning of every key."""
    found = Config.model_json_schema()
    described: set[str] = set()
    _describe(Config, found, found.get("$defs", {}), described)
    listed = found["properties"]["obstacles"]
    found["properties"]["obstacles"] = {"anyOf": [listed, {"type": "string", "description": "a file of [[obstacles]]"}]}
    return json.dumps({"$schema": "https://json-schema.org/draft/2020-12/schema", **found}, indent=2)


def _describe(model: type[Params], node: dict[str, Any], definitions: dict[str, Any], described: set[str]) -> None:
    """Add meanings to the properties of a class of parameters, and of those inside it, each once."""
    for name, entry in node.get("properties", {}).items():
        if text := meanings(model).get(name):
            entry["description"] = text
        inner = model_in(model.model_fields[name].annotation)
        for reference in _references(entry):
            if inner is not None and reference not in described:
                described.add(reference)
                _describe(inner, definitions[reference], definitions, described)


def _references(node: Any) -> Iterator[str]:
    """Yield the names of definitions that a property refers to."""
    if isinstance(node, dict):
        if isinstance(reference := node.get("$ref"), str):
            yield reference.rpartition("/")[2]
        for inner in node.values():
            yield from _references(inner)
    elif isinstance(node, list):
        for inner in node:
            yield from _references(inner)


def initial_files(name: str, output: Path | None = None) -> dict[Path, str]:
    """Return commented files to begin with: a built-in configuration, an example, or every key with its default.

    Args:
        name: of the configuration, as its file without the ending.
        output: path of its first file, beside which the others belong; None: its own name, in the folder one is in.

    Raises:
        ConfigError: there is none of that name.
    """
    if name == DEFAULTS:
        return {output or Path(f"{DEFAULTS}.toml"): _HEAD + "".join(map(_commented, sections()))}
    first, *others = built_in_files(name)
    path = output or Path(first.name)
    texts = {path: first, **{path.with_name(other.name): other for other in others}}
    here = re.compile(rf"\bconfigs/(?:{EXAMPLES}/)?(?={re.escape(name)}\.)")  # commands in comments are of the copies
    return {to: here.sub("", file.read_text(encoding="utf-8")) for to, file in texts.items()}


def _commented(section: Section) -> str:
    """Return a section of a file, commented out: a section with one key may require others."""
    header = f"\n#{section.title}\n" if section.path else "\n"
    return header + "".join(map(_commented_key, section.keys))


def _commented_key(key: Key) -> str:
    value = "..." if key.default is None else value_text(key.default)
    about = "; ".join(filter(None, (key.meaning, key.kind, key.allowed, "required" if key.is_required else "")))
    return f"#{key.name} = {value}  # {about}\n".replace("`", "")
