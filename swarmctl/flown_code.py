"""Names the code that an agent flies, so that agents of several computers notice where theirs differs."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from functools import cache
from pathlib import Path

from swarmctl import __version__
from swarmctl.own_modules import own_sources

_PACKAGE = Path(__file__).resolve().parent
_DIGEST_CHARACTERS = 8


def code_in_words(own_folder: str) -> str:
    """Return version and digest of swarmctl, with a digest of the own modules that this process has imported.

    A version alone does not tell apart two checkouts of one version.

    Args:
        own_folder: of own modules; "" for none.
    """
    own = own_sources(own_folder)
    words = f"swarmctl {__version__} ({_shipped()})"
    return f"{words} with own modules {_digest(Path(own_folder), own)}" if own else words


@cache
def _shipped() -> str:
    return _digest(_PACKAGE, sorted(_PACKAGE.rglob("*.py")))


def _digest(folder: Path, files: Iterable[Path]) -> str:
    """Return a digest of names and contents: where the folder is does not matter."""
    found = hashlib.sha256()
    for file in files:
        content = file.read_bytes()
        found.update(f"{file.relative_to(folder).as_posix()}\0{len(content)}\0".encode() + content)
    return found.hexdigest()[:_DIGEST_CHARACTERS]
