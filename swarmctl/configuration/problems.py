"""Turns a plain tree into parameters, or says in words what is wrong with it: key, value, allowed range and fix."""

from __future__ import annotations

import difflib
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, TypeVar

from pydantic import ValidationError

from swarmctl.configuration.source import shown
from swarmctl.core.params import OTHER_KEY, Params, model_in
from swarmctl.core.text import counted, printable
from swarmctl.errors import ConfigError

_PLACES_SHOWN = 3
_IN_OUR_WORDS = dict.fromkeys(("bool_type", "bool_parsing"), "write true or false")  # for those of pydantic
_PATTERNS = {"^[A-Za-z0-9_-]{1,40}$": "allowed are 1 to 40 of the characters A-Z, a-z, 0-9, _ and -"}
_PROBLEMS_SHOWN = 30
_COMPONENTS = {"_ned": "north, east and down", "_ne_m": "north and east"}  # of vectors, by what their names hold
_Model = TypeVar("_Model", bound=Params)


def validated(model: type[_Model], tree: Any, source: str, renamed: Mapping[str, str] | None = None) -> _Model:
    """Return the parameters that a plain tree describes.

    Args:
        model: class of the parameters.
        tree: their values, as TOML or JSON give them.
        source: where they come from, for the error.
        renamed: today's keys by former ones.

    Raises:
        ConfigError: the tree is invalid; lists all problems.
    """
    try:
        return model.model_validate(tree)
    except ValidationError as error:
        raise ConfigError(source, problems_of(error, model, renamed=renamed or {})) from error


def problems_of(
    error: ValidationError, model: type[Params], within: str = "", renamed: Mapping[str, str] = MappingProxyType({})
) -> list[str]:
    """Return what is wrong with a plain tree, a line each.

    Args:
        error: what validation has found.
        model: class of the parameters.
        within: the section they are in, "" for the whole configuration.
        renamed: today's keys by former ones.
    """
    errors = error.errors(include_url=False)[:_PROBLEMS_SHOWN]
    problems = dict.fromkeys(_explain(dict(found), model, within, renamed) for found in errors)
    hidden = error.error_count() - len(errors)
    return [*problems, *([f"and {hidden} more problems"] if hidden else [])]


def _explain(error: dict[str, Any], root: type[Params], within: str, renamed: Mapping[str, str]) -> str:
    """Return one line with key, value, allowed range and fix."""
    location = [str(part) for part in error["loc"]]
    if _is_vector(error):
        return _about_vector(error, location, within)
    key = printable(".".join([*([within] if within else []), *location]), 100)
    value = shown(error.get("input"))
    if error["type"] == "extra_forbidden":
        return f"{key} = {value}: unknown key; {_hint(location, root, renamed)}"
    if error["type"] == "missing":
        return f"{key}: missing; add it"
    if error["type"] == "finite_number":
        return f"{key} = {value}: not a finite number; give a real one{_range_of(location, root)}"
    if error["type"] == "tuple_type":
        sections = isinstance(error["input"], dict) and _keys_at(location, root)
        return f"{key} = {value}: " + (f"one of a list; write [[{key}]]" if sections else "give a list in brackets")
    if error["type"] == OTHER_KEY:
        return f"{key} = {value}: {error['msg']}"
    if error["type"] == "model_type":
        return f"{key} = {value}: is a section; set a key of it, such as {key}.{_keys_at(location, root)[0]}"
    message = _IN_OUR_WORDS.get(error["type"]) or _PATTERNS.get(error.get("ctx", {}).get("pattern")) or error["msg"]
    return f"{key} = {value}: {message[:1].lower()}{message[1:]}{_range_of(location, root)}"


def _is_vector(error: Mapping[str, Any]) -> bool:
    """Tell whether a vector has too few or too many numbers."""
    place, values = error["loc"][-1] if error["loc"] else "", error.get("input")
    short = error["type"] == "missing" and isinstance(place, int)
    return isinstance(values, list | tuple) and (short or error["type"] == "too_long")


def _about_vector(error: Mapping[str, Any], location: Sequence[str], within: str) -> str:
    parts = [*([within] if within else []), *(location[:-1] if error["type"] == "missing" else location)]
    name = next((part for part in reversed(parts) if not part.isdigit()), "")
    wanted = next((names for suffix, names in _COMPONENTS.items() if suffix in name), None)
    count = counted(len(error["input"]), "value")
    needed = "more are needed" if error["type"] == "missing" else error["msg"]
    key = printable(".".join(parts), 100)
    return f"{key} = {shown(error['input'])}: {count}; {needed if wanted is None else f'give {wanted}'}"


def _hint(location: Sequence[str], root: type[Params], renamed: Mapping[str, str]) -> str:
    """Suggest a correction for an unknown key: its new name, the one here that it lacks the unit of, a key of its name
    elsewhere, a similar one here, or a section of its name.
    """
    if now := renamed.get(".".join(location)):
        return f"did you mean {now!r}?"
    keys = list(all_keys(root, ""))
    elsewhere = [key for key in keys if key.rpartition(".")[2] == location[-1]]
    sections = [key for key in elsewhere if any(other.startswith(f"{key}.") for other in keys)]
    known = _keys_at(location[:-1], root)
    longer = [key for key in known if len(location) > 1 and key.startswith(f"{location[-1]}_")]
    close = difflib.get_close_matches(location[-1], known, 1)
    if meant := longer or [key for key in elsewhere if key not in sections] or close or sections:
        return f"did you mean {' or '.join(map(repr, meant[:_PLACES_SHOWN]))}?"
    return f"known here: {', '.join(sorted(known))}"


def all_keys(model: Any, prefix: str) -> Iterator[str]:
    """Yield the dotted keys of a class of parameters and of its sections, each after `prefix`."""
    for name, field in model.model_fields.items():
        yield f"{prefix}{name}"
        inner = model_in(field.annotation)
        if inner is not None:
            yield from all_keys(inner, f"{prefix}{name}.")


def _field_at(location: Sequence[str], root: type[Params]) -> Any:
    model: Any = root
    field: Any = None
    for part in location:
        if part.isdigit():
            continue
        field = getattr(model, "model_fields", {}).get(part)
        if field is None:
            return None
        model = model_in(field.annotation)
    return field


def _keys_at(location: Sequence[str], root: type[Params]) -> list[str]:
    model = root if not location else model_in(getattr(_field_at(location, root), "annotation", None))
    return list(getattr(model, "model_fields", {}))


def _range_of(location: Sequence[str], root: type[Params]) -> str:
    field = _field_at(location, root)
    bounds: dict[str, Any] = {}
    for rule in getattr(field, "metadata", ()):
        bounds.update({n: getattr(rule, n) for n in ("ge", "gt", "le", "lt") if getattr(rule, n, None) is not None})
    signs = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}
    text = " and ".join(f"{signs[name]} {bound}" for name, bound in bounds.items())
    return f"; allowed: {text}" if text else ""
