"""Parameters that an agent has changed for its flight: another agent that lands its vehicle sets them back."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from swarmctl.files import read_file
from swarmctl.telemetry.recording.file_names import MAX_EVENTS_BYTES, events_file

_EVENT = "parameters_changed"

_Name = Annotated[str, Meta(pattern="^[A-Za-z0-9_]{1,16}$")]
_Whole = Annotated[int, Meta(ge=-(2**31), lt=2**31)]
_Real = Annotated[float, Meta(ge=-3.4e38, le=3.4e38)]  # what MAVLink carries
Originals = dict[_Name, _Whole | _Real]  # values before the flight; integers are what the vehicle stores as integers


class _Changed(msgspec.Struct):
    event: str
    were: Originals


def decode_originals(text: str | bytes) -> Originals:
    """Return the parameters that a JSON object lists.

    Raises:
        ValueError: it is none, or lists what no vehicle has.
    """
    try:
        return msgspec.json.decode(text, type=Originals)
    except msgspec.DecodeError as error:
        raise ValueError(str(error)) from error


def read_originals(directory: Path, source: str) -> Originals:
    """Return the parameters that an agent has changed as they were, from the newest event that tells; none without one.

    Args:
        directory: the run folder of the launch.
        source: name of the agent.

    Raises:
        OSError: the events of the agent can't be read.
        ValueError: the event is damaged.
    """
    for line in reversed(read_file(directory / events_file(source), MAX_EVENTS_BYTES).splitlines()):
        if _EVENT.encode() in line:
            try:
                row = msgspec.json.decode(line, type=_Changed)
            except msgspec.DecodeError as error:
                raise ValueError(f"{events_file(source)}: {error}") from error
            if row.event == _EVENT:
                return row.were
    return {}
