"""How a run ended, kept in a file whose room is taken when the run begins: a full disk has it still."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec

from swarmctl.core.json_safe import to_json
from swarmctl.files import replace_bytes
from swarmctl.telemetry.evaluation.referee import RunMode
from swarmctl.telemetry.recording.file_names import OUTCOME
from swarmctl.telemetry.recording.run_files import read_text

_OUTCOME_BYTES = 4096
_PROBLEM_CHARACTERS = 500  # of a problem that is kept in it


class KeptOutcome(msgspec.Struct):
    """How a run ended: unless it says otherwise, it was cut off."""

    outcome: Annotated[str, msgspec.Meta(pattern="^(completed|failed|interrupted)$")] = "failed"
    problems: list[str] = msgspec.field(default_factory=lambda: ["the launcher did not finish this run"])
    speed_factor: float | None = None
    mode: RunMode = "realtime"


def reserve_outcome(directory: Path, mode: RunMode) -> None:
    """Take the room, and note how the run is flown, which one that is cut off could not tell later.

    Raises:
        OSError: it can't be written.
    """
    replace_bytes(directory / OUTCOME, _padded({"mode": mode}))


def keep_outcome(directory: Path, kept: KeptOutcome) -> None:
    """Write how a run ended; of its problems, shortened, as many as there is room for."""
    problems, shown = [problem[:_PROBLEM_CHARACTERS] for problem in kept.problems], len(kept.problems)
    while True:
        told = [*problems[:shown], *([f"and {len(problems) - shown} more"] if shown < len(problems) else [])]
        content = _padded(msgspec.to_builtins(msgspec.structs.replace(kept, problems=told)))
        if len(content) <= _OUTCOME_BYTES or not shown:
            break
        shown //= 2
    _fill(directory, content)


def forget_outcome(directory: Path, mode: RunMode) -> None:
    """Leave of how a run ended what a run that was cut off has: how it was flown."""
    _fill(directory, _padded({"mode": mode}))


def kept_outcome(directory: Path) -> KeptOutcome:
    """Return how a run ended whose files the disk did not take; that it was cut off, where nothing is known of it."""
    text = read_text(directory / OUTCOME).strip()
    try:
        return msgspec.json.decode(text, type=KeptOutcome)
    except (msgspec.MsgspecError, UnicodeEncodeError):
        return KeptOutcome()


def _padded(kept: Mapping[str, Any]) -> bytes:
    return to_json(kept).encode().ljust(_OUTCOME_BYTES)


def _fill(directory: Path, content: bytes) -> None:
    """Write into the room that was kept, if it still is."""
    with contextlib.suppress(OSError):
        fd = os.open(directory / OUTCOME, os.O_WRONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
        with os.fdopen(fd, "wb") as file:
            file.write(content)
