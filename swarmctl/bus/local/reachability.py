"""Who reaches whom on a bus in memory, and whose liveliness tokens each participant sees."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping


class Reachability:
    """Tells between which participants messages and tokens pass.

    Attributes:
        failed: nothing passes, not even a participant's own token.
    """

    def __init__(self) -> None:
        self.failed = False
        self._group: dict[str, int] = {}
        self._cuts: set[tuple[str, str]] = set()

    def split(self, groups: Iterable[frozenset[str]]) -> None:
        """Separate groups of names from each other, instead of the groups of before.

        Raises:
            ValueError: a name is in two groups.
        """
        group: dict[str, int] = {}
        for number, names in enumerate(groups):
            if twice := names & group.keys():
                raise ValueError(f"groups: {sorted(twice)} must be in one group only")
            group |= dict.fromkeys(names, number)
        self._group = group

    def cut(self, sender: str, receiver: str) -> None:
        """Stop messages in one direction; tokens still pass."""
        self._cuts.add((sender, receiver))

    def mend(self, sender: str, receiver: str) -> None:
        """Let messages pass in this direction again."""
        self._cuts.discard((sender, receiver))

    def passes(self, sender: str, receiver: str) -> bool:
        """Return whether messages pass."""
        if not (self._cuts or self._group):
            return not self.failed
        return (sender, receiver) not in self._cuts and self.shows(sender, receiver)

    def shows(self, name: str, observer: str) -> bool:
        """Return whether an observer is told that a participant joins, stays and leaves."""
        if self.failed:
            return False
        one, other = self._group.get(name), self._group.get(observer)
        return one is None or other is None or one == other


class TokenView:
    """The liveliness tokens as one participant sees them.

    Args:
        lease_us: time after which the token of a participant that can't be reached vanishes.
    """

    def __init__(self, lease_us: int) -> None:
        self._lease_us = lease_us
        self._seen: dict[str, object] = {}  # name -> session, as last told
        self._unreached_us: dict[str, int] = {}  # since when a seen token can't be reached
        self._arrivals: Counter[str] = Counter()
        self._alive: frozenset[str] | None = None  # names seen; None: to be made anew

    def update(self, sessions: Mapping[str, object], shows: Callable[[str], bool], now_us: int) -> None:
        """Take in a change.

        Args:
            sessions: an object for each participant attached, another one after it has rejoined.
            shows: whether this observer is told about a name from now on.
            now_us: time.
        """
        self._expire(now_us)
        self._alive = None
        for name in {**self._seen, **sessions}:
            if not shows(name):
                if name in self._seen:
                    self._unreached_us.setdefault(name, now_us)
                continue
            self._unreached_us.pop(name, None)
            session = sessions.get(name)
            if session is None:
                del self._seen[name]
            elif self._seen.get(name) is not session:
                self._seen[name] = session
                self._arrivals[name] += 1

    def alive(self, now_us: int) -> frozenset[str]:
        """Return the names whose tokens are seen."""
        self._expire(now_us)
        if self._alive is None:
            self._alive = frozenset(self._seen)
        return self._alive

    def arrivals(self) -> Mapping[str, int]:
        """Return how often the token of each name has appeared."""
        return self._arrivals

    def _expire(self, now_us: int) -> None:
        if not self._unreached_us:
            return
        vanished = [name for name, since_us in self._unreached_us.items() if now_us - since_us >= self._lease_us]
        for name in vanished:
            del self._seen[name], self._unreached_us[name]
            self._alive = None
