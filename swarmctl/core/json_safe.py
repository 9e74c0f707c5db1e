"""Values as JSON has them: no NaN, no infinity, no numpy. What can't be a number becomes null. Pure."""

from __future__ import annotations

import enum
import json
import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np


def json_safe(value: Any, *, enums_by_name: bool = False) -> Any:
    """Return the same value made of dict, list, str, int, float, bool and None; non-finite floats become None.

    Args:
        value: any.
        enums_by_name: members of enums become their names, not their numbers.
    """
    if enums_by_name and isinstance(value, enum.Enum):
        return value.name
    if value is None or isinstance(value, (str, bool)):
        return value
    same = partial(json_safe, enums_by_name=enums_by_name)
    if isinstance(value, np.generic):
        return same(value.item())
    if isinstance(value, int):
        return int(value)  # also enums
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): same(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return same(value.tolist())
    if isinstance(value, (list, tuple, set, frozenset)):
        return [same(item) for item in value]
    return str(value)


def finite(value: Any) -> float | None:
    """Return a number as float; None for what is not one, not finite, or too large."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def to_json(value: Any, indent: int | None = None) -> str:
    """Return the JSON text of any value; never fails, never writes NaN."""
    return json.dumps(json_safe(value), indent=indent, allow_nan=False, ensure_ascii=False)
