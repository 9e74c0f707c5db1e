"""Form of a parameter that every autopilot accepts: a MAVLink name and a 32-bit number.

The vehicle itself reports whether it stores an integer or a float, and the agent sends that type.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping

from swarmctl.core.text import printable

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,15}")  # PARAM_SET.param_id has 16 characters
_INT32 = range(-(2**31), 2**31)
_REAL32_MAX = 3.4028235e38


def parameter_problems(wanted: Mapping[str, int | float]) -> Iterator[str]:
    """Return one line for each parameter of `agent.autopilot_params` that could not be set, with the reason."""
    for name, value in wanted.items():
        key = f"agent.autopilot_params.{printable(name, 40)}"
        if not _NAME.fullmatch(name):
            yield f"{key}: no MAVLink parameter name; allowed: 1 to 16 letters, digits and _, the first a letter"
        elif isinstance(value, int) and value not in _INT32:
            yield f"{key} = {value}: an autopilot's integers have 32 bits; allowed: {_INT32[0]} to {_INT32[-1]}"
        elif abs(value) > _REAL32_MAX:
            yield f"{key} = {value}: an autopilot's floats have 32 bits; allowed: up to {_REAL32_MAX:g}"
