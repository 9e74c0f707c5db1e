"""What a row of the fault matrix is: an event, the reaction to it, and the protection without which the row fails.

A row is played by the code of its kind: `simulated.py` (lockstep), `launched.py` (real processes), `elsewhere.py` (a
test that exists already).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch


class UnmetError(AssertionError):
    """The reaction of a row did not come, came too late, or something was violated on the way."""


def require(holds: bool, what: str) -> None:
    """Fail the row unless something holds, named so that the failure reads as what happened."""
    if not holds:
        raise UnmetError(what)


@dataclass(frozen=True, slots=True, kw_only=True)
class Off:
    """How a protection is switched off.

    Attributes:
        settings: of the configuration, over those of the row.
        patches: object, name of its attribute, and what stands in for it.
        preload: code that processes of a launch run before their own; it sees `words`, their command line.
    """

    settings: tuple[str, ...] = ()
    patches: tuple[tuple[Any, str, Any], ...] = ()
    preload: str = ""

    @contextmanager
    def applied(self) -> Iterator[None]:
        """Keep the patches of this process in place."""
        with ExitStack() as stack:
            for owner, name, value in self.patches:
                stack.enter_context(patch.object(owner, name, value, create=True))
            yield


@dataclass(frozen=True, slots=True, kw_only=True)
class Played:
    """What was measured while a row was played."""

    reacted_s: float | None = None  # after the event
    apart_m: float | None = None  # least distance of two vehicles by true states

    def __str__(self) -> str:
        """Return it in words."""
        found: Sequence[str] = [
            f"reacted after {self.reacted_s:.2f} s" if self.reacted_s is not None else "",
            f"least distance {self.apart_m:.2f} m" if self.apart_m is not None else "",
        ]
        return ", ".join(filter(None, found))


@dataclass(frozen=True, kw_only=True)
class Row(ABC):
    """A row of the matrix.

    Attributes:
        name: under which it is played alone.
        event, reaction, protection: in words, for the page.
        within_s: longest time from the event to the reaction.
    """

    name: str
    event: str
    reaction: str
    within_s: float
    protection: str

    @abstractmethod
    def play(self, folder: Path, *, protected: bool = True) -> Played:
        """Play the row in a new folder, with its protection or without.

        Raises:
            UnmetError: the row fails.
        """
