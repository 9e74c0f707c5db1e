"""Serial devices of this computer: which there are, and why one that a URL names can't be used."""

from __future__ import annotations

import os
from pathlib import Path

_FOLDER = Path("/dev")
_NAMES = ("ttyUSB*", "ttyACM*", "ttyAMA*", "ttyTHS*", "serial[0-9]*")  # adapters, USB, UARTs of companions


def serial_problem(device: str) -> str:
    """Return why a serial device can't be used, and what to do about it; "" where opening it will tell."""
    if not Path(device).exists():
        here = ", ".join(_known()) or "none that is known by its name"
        return f"{device} does not exist; serial ports here: {here}. Plug it in, or name another"
    if not os.access(device, os.R_OK | os.W_OK):
        return f"no permission to read and write; join the group that owns {device}"
    return ""


def _known() -> list[str]:
    return sorted({str(path) for pattern in _NAMES for path in _FOLDER.glob(pattern)})
