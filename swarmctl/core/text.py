"""Words for people: text from outside that can control no terminal, and how points and counts are written."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

MOST_SHOWN = 500


def printable(text: str, most: int = MOST_SHOWN) -> str:
    """Return `text` on one line, shortened in the middle, with control characters written as escapes.

    Terminals act on ESC and the 8-bit controls, and direction marks reorder text: none of them is printable.
    """
    half = most // 2
    short = text if len(text) <= most else f"{text[:half]} ... {text[-half:]}"
    return "".join(c if c.isprintable() else _escaped(c) for c in short)


def point_text(point: Iterable[float]) -> str:
    """Return the numbers of a point as an operator writes them: "5, -2, -3"."""
    return ", ".join(f"{part:g}" for part in point)


def counted(count: int, noun: str) -> str:
    """Return a count with its noun: "1 obstacle", "2 obstacles"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def told_apart(values: Sequence[str], most: int) -> list[str]:
    """Return values that differ, of long ones `most` characters from shortly before where they begin to."""
    texts = [value for value in values if value]
    characters = enumerate(zip(*texts, strict=False))
    differ = next((k for k, found in characters if len(set(found)) > 1), min(map(len, texts), default=0))
    begin = max(0, differ - most // 4) if len(texts) > 1 and max(map(len, texts)) > most else 0
    return [
        f"{'... ' if begin and value else ''}{value[begin : begin + most]}{' ...' if len(value) > begin + most else ''}"
        for value in values
    ]


def printable_lines(text: str) -> str:
    """Apply `printable` to each line of `text`."""
    return "\n".join(printable(line, 10 * MOST_SHOWN) for line in text.split("\n"))


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")
