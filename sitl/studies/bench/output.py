"""What `bench` leaves in the folder of its `--out`."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from swarmctl.errors import StartError
from swarmctl.files import replace_text


def json_rows(rows: Sequence[Any]) -> str:
    """Return rows, each a dataclass, as a JSON list."""
    return json.dumps([asdict(row) for row in rows], indent=1) + "\n"


def make_folder(directory: Path) -> None:
    """Make the folder if necessary, and check that it takes a file, before minutes of measuring for it.

    Raises:
        StartError: it can't be made or written to.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=directory):
            pass
    except OSError as error:
        raise _unwritable(directory, error) from error


def write_texts(texts: Mapping[str, str], directory: Path) -> list[Path]:
    """Write files by name to `directory`, which is made if necessary, and return their paths.

    Raises:
        StartError: one can't be written.
    """
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            replace_text(directory / name, text)
    except OSError as error:
        raise _unwritable(directory, error) from error
    return [directory / name for name in texts]


def _unwritable(directory: Path, error: OSError) -> StartError:
    return StartError(f"{directory}: can't be written: {error.strerror}. Choose another with --out")
