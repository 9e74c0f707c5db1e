"""Values as JSON has them: no NaN, no infinity, no numpy. What can't be a number becomes null."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np


def json_safe(value: Any) -> Any:
    """The same value made of dict, list, str, int, float, bool and None; non-finite floats become None."""
    if value is None or isinstance(value, (str, bool)):
        return value
    if isinstance(value, np.generic):
        return json_safe(value.item())
    if isinstance(value, int):
        return int(value)  # also enums
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): json_safe(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return json_safe(value.tolist())
    if isinstance(value, (list, tuple, set, frozenset)):
        return [json_safe(item) for item in value]
    return str(value)


def finite(value: Any) -> float | None:
    """A number as float; None for what is not one, not finite, or too large."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def to_json(value: Any, indent: int | None = None) -> str:
    """JSON text of any value; never fails, never writes NaN."""
    return json.dumps(json_safe(value), indent=indent, allow_nan=False, ensure_ascii=False)
