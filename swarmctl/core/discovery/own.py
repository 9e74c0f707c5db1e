"""Finds classes that somebody else has written: by name, "package.module:Class", or offered by an installed package."""

from __future__ import annotations

import difflib
import importlib
import importlib.metadata
import re
import traceback
from collections import deque
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

from pydantic import GetCoreSchemaHandler
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

_FRAMES, _TRACED = 8, 4000  # of a traceback, and its characters
_NAME = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*")


def in_words(error: BaseException) -> str:
    """Return kind and text of what somebody else's code has raised, which may raise again when it is shown."""
    try:
        return f"{type(error).__name__}: {error}"
    except (Exception, SystemExit):
        return f"{type(error).__name__}, which can't be shown"


def raised_at(error: BaseException, module: str) -> str:
    """Return "file:line" of where a module has raised, or has called what did; of another module if it is in none."""
    frames = [(frame.f_globals.get("__name__"), frame, line) for frame, line in traceback.walk_tb(error.__traceback__)]
    inside = [(frame, line) for name, frame, line in frames if name == module] or [found[1:] for found in frames]
    if not inside:
        return "no traceback"
    frame, line = inside[-1]
    return f"{PurePath(frame.f_code.co_filename).name}:{line}"


def traced(error: BaseException) -> str:
    """Return the innermost frames of what somebody else's code has raised, and what it was.

    Lines of source, which Python would show, are read from a disk, for which a tick must not wait.
    """
    frames = deque(traceback.walk_tb(error.__traceback__), maxlen=_FRAMES)
    shown = [f'File "{frame.f_code.co_filename}", line {line}, in {frame.f_code.co_name}' for frame, line in frames]
    return "\n".join([*shown, in_words(error)])[-_TRACED:]


class OwnError(Exception):
    """A class that a configuration names can't be had; the text says why.

    Args:
        text: why.
        not_found: there is no such module, rather than that something is wrong with it.
    """

    def __init__(self, text: str, *, not_found: bool = False) -> None:
        super().__init__(text)
        self.not_found = not_found


@dataclass(frozen=True, slots=True)
class BuiltInOrOwn:
    """Marks a text that is a built-in name, "package.module:Class", or an entry point of a group."""

    names: tuple[str, ...]
    group: str
    synonyms: tuple[tuple[str, str], ...] = ()  # other words for built-in names, to suggest those

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_after_validator_function(self._checked, handler(source))

    def _checked(self, name: str) -> str:
        if name in self.names or _NAME.fullmatch(name) or name in _offered(self.group):
            return name
        names = (*self.names, *_offered(self.group))
        meant = dict(self.synonyms).get(name.lower()) or next(iter(difflib.get_close_matches(name, names, 1)), "")
        hint = f"did you mean '{meant}'? " if meant else ""
        said = {"known": ", ".join(f"'{known}'" for known in names), "hint": hint}
        raise PydanticCustomError("own", "{hint}input should be {known} or 'package.module:Class'", said)


def own_class(name: str, group: str, base: type) -> Any:
    """Return the class of a name that is not built in.

    Args:
        name: "package.module:Class", or the name of an entry point.
        group: group of entry points.
        base: what the class has to be derived from.

    Raises:
        OwnError: there is none, its module can't be imported, or it is something else.
    """
    module, _, attribute = _offered(group).get(name, name).partition(":")
    try:
        found = getattr(importlib.import_module(module), attribute, None)
    except (Exception, SystemExit) as error:  # whatever the module does when it is imported
        missing = error.name if isinstance(error, ModuleNotFoundError) else None
        not_found = missing is not None and f"{module}.".startswith(f"{missing}.")
        raise OwnError(f"{module} can't be imported: {in_words(error)}", not_found=not_found) from error
    if not isinstance(found, type) or not issubclass(found, base):
        raise OwnError(f"{module} has no class {attribute} derived from {base.__module__}.{base.__name__}")
    return found


def _offered(group: str) -> dict[str, str]:
    """Return the classes that installed packages offer, by the names of their entry points."""
    return {point.name: point.value for point in importlib.metadata.entry_points(group=group)}
