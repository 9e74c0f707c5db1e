"""Sanitising of text from outside, so that no vehicle, peer or file can control a terminal."""

from __future__ import annotations

MOST_SHOWN = 500


def printable(text: str, most: int = MOST_SHOWN) -> str:
    """Return `text` on one line, shortened in the middle, with control characters written as escapes.

    Terminals act on ESC and the 8-bit controls, and direction marks reorder text: none of them is printable.
    """
    half = most // 2
    short = text if len(text) <= most else f"{text[:half]} ... {text[-half:]}"
    return "".join(c if c.isprintable() else _escaped(c) for c in short)


def printable_lines(text: str) -> str:
    """Apply `printable` to each line of `text`."""
    return "\n".join(printable(line, 10 * MOST_SHOWN) for line in text.split("\n"))


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")
