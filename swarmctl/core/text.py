"""Text from outside as it may be shown: what a vehicle, a peer or a file says must not steer somebody's terminal."""

from __future__ import annotations

MOST_SHOWN = 500


def printable(text: str, most: int = MOST_SHOWN) -> str:
    """`text` on one line and without control characters, which are written as escapes; shortened in the middle.

    A terminal obeys ESC and the 8-bit controls, and direction marks reorder what is read: none is printable.
    """
    half = most // 2
    short = text if len(text) <= most else f"{text[:half]} ... {text[-half:]}"
    return "".join(c if c.isprintable() else _escaped(c) for c in short)


def printable_lines(text: str) -> str:
    """The same for text that may have several lines."""
    return "\n".join(printable(line, 10 * MOST_SHOWN) for line in text.split("\n"))


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")
