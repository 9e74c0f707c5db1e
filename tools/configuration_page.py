"""Writes `docs/configuration.md` from the parameter classes: every key with its type, default, range and comment.

    python tools/configuration_page.py

A test compares the committed page with `page()`, so that the two can't differ.
"""

from __future__ import annotations

import ast
import inspect
import io
import textwrap
import tokenize
import types
import typing
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, Literal

import tomli_w
from pydantic.fields import FieldInfo

from swarmctl.config import Config
from swarmctl.core.own import BuiltInOrOwn
from swarmctl.core.params import Params
from swarmctl.simulator_config import FAULTS

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "configuration.md"
_HEAD = """\
# Configuration

`tools/configuration_page.py` writes this page from the parameter classes: to correct it, change the comment beside the
field and run it again.

A configuration is a TOML file with these sections. Every key has its unit in its name and can be set on the command
line, `--set separation.radius_m=1.5`, items of lists by index, `--set vehicles.0.url=...`. Keys that are left out have
the default given here. A configuration is refused, not repaired: all problems at once, each with the key, the value,
the allowed range and the fix. The run folder gets the resolved configuration as `config.toml`; files to begin with are
in `configs/`.
"""
_TABLE_HEAD = "| key | type | default | allowed | meaning |\n|---|---|---|---|---|\n"
_SIGNS = (("ge", ">="), ("gt", ">"), ("le", "<="), ("lt", "<"))
_WORDS = {bool: "boolean", int: "integer", float: "number", str: "text"}


def page() -> str:
    """Return the whole page as Markdown."""
    return _HEAD + "".join(_section("", Config, Config(), listed=False)) + _faults()


def _section(path: str, model: type[Params], given: Params | None, listed: bool) -> Iterator[str]:
    """Yield the text of a section and of those within it.

    Args:
        path: name of the section, "" for the top level.
        model: class of the section.
        given: the section with default values; None for an item of a list, which has none before it is written.
        listed: whether the section is an item of a list.
    """
    inner: list[tuple[str, type[Params], Params | None, bool]] = []
    rows = ""
    for name, field in model.model_fields.items():
        found = _model_in(field.annotation)
        if found is None or _is_optional(field.annotation):
            rows += _row(model, name, field, given)
        else:
            single = isinstance(field.annotation, type)
            inner.append((f"{path}.{name}".lstrip("."), found, getattr(given, name) if single else None, not single))
    if rows:
        yield f"\n## {_title(path, listed)}\n\n{inspect.getdoc(model)} (`{_source(model)}`)\n\n{_TABLE_HEAD}{rows}"
    for section in inner:
        yield from _section(*section)


def _faults() -> str:
    """Return the table of fault kinds, whose values are checked by a rule of their own."""
    rows = ""
    for kind, rule in FAULTS.items():
        allowed = f">= {rule.low}, <= {rule.high}" if rule.high > rule.low else ""
        default = "required" if rule.default is None else f"`{rule.default}`" if allowed else ""
        rows += f"| `{kind}` | {default} | {allowed} | {rule.meaning} |\n"
    head = "| `kind` | default of `value` | allowed | meaning |\n|---|---|---|---|\n"
    return f"\n## Kinds of faults\n\nFor `[[sitl.faults]]` and `swarmctl fault`.\n\n{head}{rows}"


def _title(path: str, listed: bool) -> str:
    if not path:
        return "Top level"
    return f"`[[{path}]]`, one for each" if listed else f"`[{path}]`"


def _source(model: type[Params]) -> str:
    return Path(inspect.getfile(model)).relative_to(ROOT).as_posix()


def _row(model: type[Params], name: str, field: FieldInfo, given: Params | None) -> str:
    default = getattr(given, name) if given is not None else field.default
    cells = (
        f"`{name}`",
        _type_text(field.annotation),
        "required" if given is None and field.is_required() else _value_text(default),
        _range_text(field),
        _comments(model).get(name, ""),
    )
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"


def _type_text(annotation: Any) -> str:
    """Return a type in words."""
    annotation = _bare(annotation)
    if annotation is Any:
        return "any value"
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if annotation in _WORDS:
        return _WORDS[annotation]
    if found := _model_in(annotation):
        return f"a table with the keys of {found.__name__}"
    if origin is Literal:
        return "one of " + ", ".join(f"`{_value(choice)}`" for choice in arguments)
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


def _value_text(value: Any) -> str:
    return "not set" if value is None else f"`{_value(value)}`"


def _value(value: Any) -> str:
    """Return a value as TOML."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_value(item)}" for key, item in value.items()) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_value, value)) + "]"
    return tomli_w.dumps({"key": value}).strip().removeprefix("key = ")


def _bare(annotation: Any) -> Any:
    return getattr(annotation, "__origin__", annotation) if hasattr(annotation, "__metadata__") else annotation


def _is_optional(annotation: Any) -> bool:
    return type(None) in typing.get_args(annotation)


def _model_in(annotation: Any) -> type[Params] | None:
    """Return the parameter class that an annotation is or contains."""
    if isinstance(annotation, type) and issubclass(annotation, Params):
        return annotation
    return next((found for argument in typing.get_args(annotation) if (found := _model_in(argument))), None)


@cache
def _comments(model: type[Params]) -> dict[str, str]:
    """Return the comment beside each field, inherited ones included."""
    found: dict[str, str] = {}
    for owner in reversed(model.__mro__):
        if issubclass(owner, Params) and owner is not Params:
            found |= _own_comments(textwrap.dedent(inspect.getsource(owner)))
    return found


def _own_comments(source: str) -> dict[str, str]:
    by_line = {
        token.start[0]: token.string.lstrip("# ").strip()
        for token in tokenize.generate_tokens(io.StringIO(source).readline)
        if token.type == tokenize.COMMENT
    }
    (definition,) = ast.parse(source).body
    assert isinstance(definition, ast.ClassDef)
    found = {}
    for node in definition.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            lines = range(node.lineno, (node.end_lineno or node.lineno) + 1)
            found[node.target.id] = " ".join(by_line[line] for line in lines if line in by_line)
    return found


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(PAGE.relative_to(ROOT))
