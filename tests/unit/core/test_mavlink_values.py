"""Tests that the values of MAVLink which stand as literals are those of its dialect."""

from __future__ import annotations

import re
from pathlib import Path

from pymavlink.dialects.v20 import development as dialect

from swarmctl.core import mavlink_values


def test_every_value_is_that_of_the_enum_that_its_comment_names() -> None:
    text = Path(mavlink_values.__file__).read_text()
    named = re.findall(r"^(\w+) = .*# (\w+)", text, re.MULTILINE)
    assert {name for name, _ in named} == {name for name in dir(mavlink_values) if name.isupper()}
    for name, of_dialect in named:
        assert getattr(mavlink_values, name) == getattr(dialect, of_dialect), name
