"""The dialects that this program speaks: one for each autopilot that a module of this package describes.

A module is found by being there, so that a new autopilot is one new file.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator, Mapping

from swarmctl.mavlink import dialects
from swarmctl.mavlink.dialects.dialect import Dialect


def _declared() -> Iterator[Dialect]:
    """Yield every `Dialect` that a module of this package holds."""
    for found in pkgutil.iter_modules(dialects.__path__):
        if found.name != "registry":
            module = importlib.import_module(f"{dialects.__name__}.{found.name}")
            yield from (thing for thing in vars(module).values() if isinstance(thing, Dialect))


DIALECTS: Mapping[int, Dialect] = {dialect.number: dialect for dialect in _declared()}  # by HEARTBEAT.autopilot
