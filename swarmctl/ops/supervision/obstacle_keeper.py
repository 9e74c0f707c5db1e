"""The swarm's list of obstacles as a launch keeps it: repeated to all, and replaced by those of operators.

Stamps are by the clock of the launch, as its agents have it: it follows steps of UTC slowly.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass

import msgspec

from swarmctl.bus.bus import Bus
from swarmctl.bus.messages.json_messages import ObstaclesMessage, decode_obstacles, encode_message, first_list
from swarmctl.bus.refusals import MALFORMED, SEQUENCE
from swarmctl.bus.topics import OBSTACLES
from swarmctl.core.obstacle import Obstacle
from swarmctl.wall_clock import WallClock

_REPEAT_US = 1_000_000
_KNOWN_BY = 3  # messages, of which one has come without delay: the clock of their sender is known then
_KEPT = 10  # messages of each sender by which it is known, so that a step of it is noticed
_SAME_CLOCK_US = 100_000  # of a clock that is known: messages wait for a step of the launch
_UNKNOWN_CLOCK_US = 500_000  # of one that is not yet
_CORRECTED_US = 20_000  # change of the clock after which moving obstacles are stamped anew; 2 cm at 1 m/s
_TELL_AT = 3  # repetitions of another list, after which it is told: it may still come from its operator


@dataclass(frozen=True, slots=True, kw_only=True)
class Adoption:
    """Describes one list of an operator that has taken the place of another one."""

    before: ObstaclesMessage
    after: ObstaclesMessage


class ObstacleKeeper:
    """Keeps the newest list of obstacles.

    Args:
        bus: brings the lists of operators, and carries the repetitions.
        configured: obstacles from the beginning.
        clock: stamps what is repeated.
        trusted: senders whose lists are adopted; those of the others are compared only.
        refuse: is told the sender, topic and reason of what is no list.

    Attributes:
        newest: the list.
        heard: the newest that somebody repeats, adopted or not; None before the first.
    """

    def __init__(
        self,
        bus: Bus,
        configured: Sequence[Obstacle],
        clock: WallClock,
        *,
        trusted: Collection[str],
        refuse: Callable[[str, str, str], None],
    ) -> None:
        self._bus, self._clock, self._trusted, self._refuse = bus, clock, trusted, refuse
        self.newest = first_list(configured, clock.utc_us())
        self._ahead_us = clock.utc_ahead_us()  # of UTC over monotonic time, when the list was stamped
        self.heard: ObstaclesMessage | None = None
        self._said_us: int | None = None  # None: not yet
        self._received_us = clock.now_us()
        self._behind_us: dict[str, deque[int]] = {}  # by how much senders' clocks are behind at most, by each message
        self._newer_lists: dict[str, tuple[tuple[int, int], int]] = {}  # rank, and how often, of who is not believed
        self._others: list[str] = []

    def receive(self) -> list[Adoption]:
        """Adopt the lists that have arrived: each is repeated from now on; returns those that were adopted."""
        adopted = []
        waited_us, self._received_us = self._clock.now_us() - self._received_us, self._clock.now_us()
        for sender, payload in self._bus.receive(OBSTACLES):
            message = decode_obstacles(payload)
            if message is None or message.is_too_far_from(self.newest):
                self._refuse(sender, OBSTACLES.name, MALFORMED if message is None else SEQUENCE)
                continue
            behind_us = self._clock.utc_us() - message.utc_us
            self._behind_us.setdefault(sender, deque(maxlen=_KEPT)).append(behind_us)
            if not message.proposed and message.replaces(self.heard):
                self.heard = message
            if not message.replaces(self.newest):
                continue
            if sender not in self._trusted:
                self._compare(sender, message)
            else:
                adopted.append(Adoption(before=self.newest, after=self._by_own_clock(sender, message, waited_us)))
                self.newest, self._said_us = adopted[-1].after, None
                self._ahead_us = self._clock.utc_ahead_us()
                self._newer_lists.clear()
        return adopted

    def others(self) -> list[str]:
        """Return, once each, which computers repeat a newer list that no operator has told this one."""
        others, self._others = self._others, []
        return others

    def news(self, adopted: Iterable[Adoption]) -> Iterator[tuple[str, str]]:
        """Yield the events, and their texts, that tell operators of lists which were overruled, or are elsewhere."""
        for adoption in adopted:
            if overruled := adoption_text(adoption.before, adoption.after):
                yield "obstacles_overruled", overruled
        for text in self.others():
            yield "obstacles_elsewhere", text

    def repeat(self) -> None:
        """Publish the list again if it is time."""
        now_us = self._clock.now_us()
        if self._said_us is None or now_us - self._said_us >= _REPEAT_US:
            self._said_us = now_us
            self._follow_clock()
            told = msgspec.structs.replace(self.newest, utc_us=self._clock.utc_us())
            self._bus.publish(OBSTACLES, encode_message(told))

    def _follow_clock(self) -> None:
        """Stamp obstacles anew where the clock was corrected: those that move would be off by that time."""
        ahead_us = self._clock.utc_ahead_us()
        if abs(ahead_us - self._ahead_us) > _CORRECTED_US:
            self.newest = self.newest.shifted(ahead_us - self._ahead_us)
            self._ahead_us = ahead_us

    def _by_own_clock(self, sender: str, message: ObstaclesMessage, waited_us: int) -> ObstaclesMessage:
        """Return a list by the own clock, where its sender's is another one; it may have waited here for so long."""
        behind_us = self._behind_us[sender]
        if len(behind_us) < _KNOWN_BY:
            ahead_us = behind_us[-1]
            is_same = -_UNKNOWN_CLOCK_US <= ahead_us <= _UNKNOWN_CLOCK_US + waited_us
        else:
            ahead_us = min(behind_us)
            is_same = abs(ahead_us) <= _SAME_CLOCK_US
        return msgspec.structs.replace(message if is_same else message.shifted(ahead_us), proposed=False)

    def _compare(self, sender: str, message: ObstaclesMessage) -> None:
        rank, count = self._newer_lists.get(sender, (message.rank, 0))
        if count == _TELL_AT:  # told, until the next adoption
            return
        count = count + 1 if rank == message.rank else 1
        self._newer_lists[sender] = (message.rank, count)
        if count == _TELL_AT:
            self._others.append(
                f"{sender} keeps clear of other obstacles than this computer (version {message.version} of the list, "
                f"here {self.newest.version}): see swarmctl obstacle list. The next change goes on from there"
            )


def adoption_text(before: ObstaclesMessage, after: ObstaclesMessage) -> str:
    """Return in words that the list of another operator has overruled one; "" where it was made from that one."""
    if after.includes(before):
        return ""
    kept = {item.without_time for item in after.obstacles}
    lost = [str(item.number) for item in before.obstacles if item.without_time not in kept]
    gone = f"obstacle {', '.join(lost)} of it is gone or another" if lost else "none of its obstacles is gone"
    overruled = f"version {before.version} of the obstacles was overruled by an operator who did not know of it"
    return f"{overruled}: {gone}"
