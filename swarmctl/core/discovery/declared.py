"""Finds what the modules of a package declare, so that nobody has to edit a list."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator
from types import ModuleType
from typing import TypeVar

T = TypeVar("T")


def modules_of(package: ModuleType) -> Iterator[ModuleType]:
    """Yield every module of `package`, imported, in the order of their names.

    The package's own `discovery` is left out: it is what asks.
    """
    for found in pkgutil.iter_modules(package.__path__):
        if found.name != "discovery":
            yield importlib.import_module(f"{package.__name__}.{found.name}")


def declared(package: ModuleType, kind: type[T]) -> Iterator[T]:
    """Yield every `kind` that a module of `package` holds, in the order of the modules' names."""
    for module in modules_of(package):
        yield from (thing for thing in vars(module).values() if isinstance(thing, kind))
