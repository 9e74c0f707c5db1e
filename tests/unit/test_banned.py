"""Tests that calls known to be harmful are not used."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCES = [path for package in ("swarmctl", "sitl") for path in (ROOT / package).rglob("*.py")]

BANNED = {
    r"plugins\.offboard|import Offboard\b|\bOffboard\(": "MAVSDK's Offboard plugin re-sends the last setpoint for ever",
    r"\.arm_force\(": "sends a forced disarm in MAVSDK 4.1.0",
    r"\.parse_buffer\(": "loses good frames after two bytes of junk",
    r"FifoChannel|zenoh\.handlers\.Callback": "a slow reader would freeze the whole Zenoh session",
}


@pytest.mark.parametrize(("pattern", "why"), BANNED.items())
def test_not_in_the_code(pattern: str, why: str) -> None:
    found = [str(path.relative_to(ROOT)) for path in SOURCES if re.search(pattern, code_of(path))]
    assert found == [], why


def test_setpoints_are_packed_in_one_place() -> None:
    packing = r"set_attitude_target_message\(|frame\(mavlink\.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET"
    packers = [path.name for path in SOURCES if re.search(packing, code_of(path))]
    assert packers == ["setpoint_stream.py"]


def code_of(path: Path) -> str:
    """Return the source without docstrings and comments, which may name banned calls."""
    text = re.sub(r'"""(.|\n)*?"""', "", path.read_text())
    return re.sub(r"#.*", "", text)
