"""Files that are replaced in one step: a reader, or a crash, finds the old one or the new one."""

from __future__ import annotations

from pathlib import Path


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text through a neighbour file.

    Raises:
        OSError: the disk refuses; the old file is untouched.
    """
    part = path.with_name(path.name + ".part")
    part.write_text(text, encoding="utf-8")
    part.replace(path)
