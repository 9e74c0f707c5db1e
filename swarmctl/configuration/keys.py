"""Every key of the configuration with its type, default, range and meaning, read from the parameter classes.

The meaning of a key is the comment beside its field, so that it is written once: documentation, `swarmctl config` and
the schema for editors all come from here.
"""

from __future__ import annotations

import ast
import inspect
import io
import sys
import tokenize
import types
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import tomli_w
from pydantic.fields import FieldInfo

from swarmctl.config import Config
from swarmctl.core.discovery.own import BuiltInOrOwn
from swarmctl.core.params import Params, model_in

_SIGNS = (("ge", ">="), ("gt", ">"), ("le", "<="), ("lt", "<"))
_WORDS = {bool: "boolean", int: "integer", float: "number", str: "text"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Key:
    """Describes one key, in words."""

    path: str  # dotted; a list has N for the index of an item
    kind: str  # its type; choices are quoted in backquotes
    default: Any  # None: not set, or required
    is_required: bool  # whether an item of a list must have it
    allowed: str  # bounds, "" for none
    meaning: str  # "" where the name says all

    @property
    def name(self) -> str:
        """The last part of the path."""
        return self.path.rpartition(".")[2]


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """Describes a section with keys of its own."""

    path: str  # "" for the top level
    model: type[Params]
    is_listed: bool  # whether it is an item of a list
    keys: tuple[Key, ...]

    @property
    def title(self) -> str:
        """The header of the section in a file; "" for the top level."""
        return f"[[{self.path}]]" if self.is_listed else f"[{self.path}]" if self.path else ""


def sections() -> Iterator[Section]:
    """Yield every section of a configuration, each before those within it."""
    yield from _sections("", Config, Config(), is_listed=False)


def _sections(path: str, model: type[Params], given: Params | None, is_listed: bool) -> Iterator[Section]:
    """Yield a section, if it has keys of its own, and those within it.

    Args:
        path: name of the section, "" for the top level.
        model: class of the section.
        given: the section with default values; None for an item of a list, which has none before it is written.
        is_listed: whether the section is an item of a list.
    """
    inner: list[tuple[str, type[Params], Params | None, bool]] = []
    keys = []
    for name, field in model.model_fields.items():
        found = model_in(field.annotation)
        if found is None or is_optional(field.annotation):
            prefix = f"{path}.N" if is_listed else path
            keys.append(_key(f"{prefix}.{name}".lstrip("."), model, field, given))
        else:
            single = isinstance(field.annotation, type)
            inner.append((f"{path}.{name}".lstrip("."), found, getattr(given, name) if single else None, not single))
    if keys:
        yield Section(path=path, model=model, is_listed=is_listed, keys=tuple(keys))
    for section in inner:
        yield from _sections(*section)


def _key(path: str, model: type[Params], field: FieldInfo, given: Params | None) -> Key:
    name, is_required = path.rpartition(".")[2], given is None and field.is_required()
    return Key(
        path=path,
        kind=_type_text(field.annotation),
        default=None if is_required else field.default if given is None else getattr(given, name),
        is_required=is_required,
        allowed=_range_text(field),
        meaning=meanings(model).get(name, ""),
    )


def _type_text(annotation: Any) -> str:
    """Return a type in words."""
    annotation = _bare(annotation)
    if annotation is Any:
        return "any value"
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if annotation in _WORDS:
        return _WORDS[annotation]
    if found := model_in(annotation):
        return f"a table with the keys of {found.__name__}"
    if origin is Literal:
        return "one of " + ", ".join(f"`{value_text(choice)}`" for choice in arguments)
    if origin in (types.UnionType, typing.Union):
        return " or ".join(_type_text(argument) for argument in arguments if argument is not type(None))
    if origin is dict:
        return f"a table of {_type_text(arguments[1])} by name"
    if arguments[-1] is Ellipsis:
        return f"list of ({_type_text(arguments[0])})"
    return f"{len(arguments)} x {_type_text(arguments[0])}"


def _range_text(field: FieldInfo) -> str:
    """Return the bounds of a field, or those of each number in it."""
    rules = list(field.metadata)
    for argument in typing.get_args(field.annotation):
        rules += [rule for item in getattr(argument, "__metadata__", ()) for rule in getattr(item, "metadata", [item])]
    bounds = [
        f"{sign} {getattr(rule, name)}"
        for name, sign in _SIGNS
        for rule in rules
        if getattr(rule, name, None) is not None
    ]
    names = [f"`{name}`" for rule in rules if isinstance(rule, BuiltInOrOwn) for name in rule.names]
    if names:
        return f"{', '.join(names)} or `package.module:Class`"
    patterns = [f"`{rule.pattern}`" for rule in rules if getattr(rule, "pattern", None)]
    return ", ".join(dict.fromkeys(bounds + patterns))


def value_text(value: Any) -> str:
    """Return a value as TOML."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {value_text(item)}" for key, item in value.items()) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(value_text, value)) + "]"
    return tomli_w.dumps({"key": value}).strip().removeprefix("key = ")


def _bare(annotation: Any) -> Any:
    return getattr(annotation, "__origin__", annotation) if hasattr(annotation, "__metadata__") else annotation


def is_optional(annotation: Any) -> bool:
    """Return whether a field may be left unset."""
    return type(None) in typing.get_args(annotation)


@cache
def meanings(model: type[Params]) -> dict[str, str]:
    """Return the comment beside each field, inherited ones included."""
    found: dict[str, str] = {}
    for owner in reversed(model.__mro__):
        if issubclass(owner, Params) and owner is not Params:
            found |= _own_meanings(owner)
    return found


def _own_meanings(model: type[Params]) -> dict[str, str]:
    """Return the comment beside each field of a class itself.

    It is looked for in the file, as from Python 3.13 on `inspect` does not find the classes that pydantic makes.
    """
    definitions, by_line = _definitions_and_comments(inspect.getsource(sys.modules[model.__module__]))
    found = {}
    for node in next(one for one in definitions if one.name == model.__name__).body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            lines = range(node.lineno, (node.end_lineno or node.lineno) + 1)
            found[node.target.id] = " ".join(by_line[line] for line in lines if line in by_line)
    return found


@cache
def _definitions_and_comments(source: str) -> tuple[list[ast.ClassDef], dict[int, str]]:
    """Return the definitions of classes in the text of a module, and its comments by line."""
    by_line = {
        token.start[0]: token.string.lstrip("# ").strip()
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    return [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ClassDef)], by_line
