"""Tests that what is written as JSON is JSON, whatever it was made of."""

from __future__ import annotations

import json
import math
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest

from swarmctl.core.json_safe import finite, json_safe, to_json
from swarmctl.core.types import Phase


@pytest.mark.parametrize(
    ("value", "safe"),
    [
        (math.inf, None),
        (np.float64("nan"), None),
        (np.int32(3), 3),
        (np.array([1.0, math.nan]), [1.0, None]),
        (MappingProxyType({2: {"a": (True, None)}}), {"2": {"a": [True, None]}}),
        (Phase.TRACK, int(Phase.TRACK)),
    ],
)
def test_values_become_those_of_json(value: Any, safe: Any) -> None:
    assert json_safe(value) == json.loads(to_json(value)) == safe


def test_members_of_enums_can_have_their_names() -> None:
    assert json_safe({"phases": [Phase.TRACK, 1]}, enums_by_name=True) == {"phases": ["TRACK", 1]}


@pytest.mark.parametrize("value", [True, "1", None, math.nan, 10**400])
def test_what_is_no_finite_number_is_none(value: Any) -> None:
    assert finite(value) is None
    assert finite(2) == 2.0
