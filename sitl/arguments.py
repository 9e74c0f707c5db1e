"""Numbers on the command lines of flights and studies."""

from __future__ import annotations

import argparse

_MOST, _MOST_SEED = 10_000, 2**31 - 1


def count(text: str) -> int:
    """Return a number of flights or processes.

    Raises:
        argparse.ArgumentTypeError: it is none.
    """
    if not text.isdecimal() or not 1 <= int(text) <= _MOST:
        raise argparse.ArgumentTypeError(f"{text!r}: allowed: 1 to {_MOST}")
    return int(text)


def seed(text: str) -> int:
    """Return a seed of random streams.

    Raises:
        argparse.ArgumentTypeError: it is none.
    """
    if not text.isdecimal() or int(text) > _MOST_SEED:
        raise argparse.ArgumentTypeError(f"{text!r}: allowed: 0 to {_MOST_SEED}")
    return int(text)
