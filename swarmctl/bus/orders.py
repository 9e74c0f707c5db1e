"""An operator's order: its validity, which of several is obeyed, its answer, and which clock stamps it. Pure."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from swarmctl.bus.messages.json_messages import CommandMessage, decode_command, encode_message
from swarmctl.bus.refusals import FUTURE_ORDER, MALFORMED, REPLAYED, SEQUENCE, STALE_ORDER, SUPERSEDED_ORDER, Refusals
from swarmctl.bus.topics import COMMAND
from swarmctl.core.operator_verbs import OPERATOR_VERBS, UNNUMBERED, Answer, Order

VALID_US = 2_000_000  # from its stamp on
MAX_LEAD_US = 500_000  # a stamp further in the future comes from another clock
_SAME_CLOCK_US = 500_000
_REMEMBERED = 64  # newest numbered orders whose answers are repeated
_MISDATED = (STALE_ORDER, FUTURE_ORDER)
EVERYBODY = -1


@dataclass(slots=True)
class _Misdated:
    """Copies of one numbered order whose stamp is by a clock that is far from ours."""

    sender: str
    reason: str  # of the newest
    first_us: int
    count: int = 0


class Orders:
    """Filters the orders to one agent, so that each is obeyed once, however often it is repeated.

    An order is valid for `VALID_US`: an older one may have been meant for another flight. Of two orders the one with
    the later stamp counts, in whatever sequence they arrive, so a repeated `hold` does not undo a `resume`. Verbs that
    are never superseded (`land`, `exclude`) are obeyed whatever came before them. A numbered order is answered, and its
    number marks what repeats it under newer stamps, so a `hold` that is repeated for long does not undo a `resume`
    either.

    An operator whose clock is far from ours stamps one copy of an order by its own clock and, as soon as it knows it,
    one by ours (`order_messages`). The former copy alarms nobody if the latter comes within `VALID_US`.

    Args:
        agent: own index.
        refusals: counts orders that are not obeyed.
    """

    def __init__(self, agent: int, refusals: Refusals) -> None:
        self._agent, self._refusals = agent, refusals
        self._newest: CommandMessage | None = None  # newest one obeyed
        self._numbered: dict[int, Order] = {}  # those taken, by number
        self._answers: dict[int, Answer] = {}  # by number
        self._due: dict[int, Answer] = {}  # to be sent, by number
        self._misdated: dict[int, _Misdated] = {}  # by number

    def take(self, sender: str, payload: bytes, utc_us: int) -> Order | None:
        """Return the order if it is for this agent and to be obeyed now, otherwise None."""
        message = decode_command(payload)
        if message is not None and message.agent not in (EVERYBODY, self._agent):
            return None
        reason = MALFORMED if message is None else self._refusal(message, utc_us)
        if message is not None and message.number != UNNUMBERED and reason in _MISDATED:
            self._keep_misdated(sender, message.number, reason, utc_us)
            return None
        if reason or message is None:
            self._refusals.add(sender, COMMAND.name, reason, utc_us)
            if message is not None:
                self._answer_again(message.order, reason)
            return None
        if message.number in self._misdated:
            self._refuse_misdated(message.number, REPLAYED, utc_us)
        if self._newest is None or message.utc_us > self._newest.utc_us:
            self._newest = message
        if message.number != UNNUMBERED:
            self._numbered[message.number] = message.order
            if len(self._numbered) > _REMEMBERED:
                forgotten = next(iter(self._numbered))
                del self._numbered[forgotten]
                self._answers.pop(forgotten, None)
        return message.order

    def refuse_misdated(self, utc_us: int) -> None:
        """Refuse the orders by another clock of which no copy by ours has come in time."""
        for number, misdated in list(self._misdated.items()):
            if utc_us - misdated.first_us > VALID_US:
                self._refuse_misdated(number, misdated.reason, utc_us)

    def answer(self, order: Order, refusal: str, comes_to: str = "") -> None:
        """Keep the answer to an order that was taken: accepted, and what it comes to, or why it is refused."""
        if order.number == UNNUMBERED:
            return
        answer = Answer(order.verb, order.number, not refusal, refusal or comes_to)
        self._answers[order.number] = self._due[order.number] = answer

    def due_answers(self) -> list[Answer]:
        """Return the answers to send now, each once for as many repetitions as have arrived since the last call."""
        due, self._due = list(self._due.values()), {}
        return due

    def _keep_misdated(self, sender: str, number: int, reason: str, utc_us: int) -> None:
        """Keep a copy by another clock for a while; those that were kept longest make room."""
        if number not in self._misdated and len(self._misdated) == _REMEMBERED:
            oldest = next(iter(self._misdated))
            self._refuse_misdated(oldest, self._misdated[oldest].reason, utc_us)
        misdated = self._misdated.setdefault(number, _Misdated(sender, reason, utc_us))
        misdated.reason, misdated.count = reason, misdated.count + 1

    def _refuse_misdated(self, number: int, reason: str, utc_us: int) -> None:
        misdated = self._misdated.pop(number)
        for _ in range(misdated.count):
            self._refusals.add(misdated.sender, COMMAND.name, reason, utc_us)

    def _answer_again(self, order: Order, reason: str) -> None:
        if order.number == UNNUMBERED:
            return
        if reason == SUPERSEDED_ORDER:
            self._due[order.number] = Answer(order.verb, order.number, False, "a newer order was obeyed")
        elif reason == REPLAYED and order.number in self._answers:
            self._due[order.number] = self._answers[order.number]

    def _refusal(self, message: CommandMessage, utc_us: int) -> str:
        if message.number in self._numbered:  # whatever clock stamps it
            return REPLAYED if self._numbered[message.number] == message.order else SEQUENCE
        if utc_us - message.utc_us > VALID_US:
            return STALE_ORDER
        if message.utc_us - utc_us > MAX_LEAD_US:
            return FUTURE_ORDER
        if self._newest is None or message.utc_us > self._newest.utc_us:
            return ""
        if message == self._newest:
            return REPLAYED
        return "" if OPERATOR_VERBS[message.verb].never_superseded else SUPERSEDED_ORDER


def order_messages(order: Order, agent: int, utc_us: int, clocks_us: Iterable[int]) -> list[bytes]:
    """Return messages that give an order now: one stamped by the own clock, and one by every clock that differs.

    Agents follow a step of UTC slowly, so in flight their clock and the operator's may be far apart. One message
    always bears the own stamp, so that a forged status cannot make an order invalid.

    Args:
        order: what is asked.
        agent: number of the agent asked, or `EVERYBODY`.
        utc_us: own clock.
        clocks_us: clocks of the agents asked, by their statuses.
    """
    stamps_us = [utc_us]
    for clock_us in sorted(clocks_us):
        if all(abs(clock_us - known_us) > _SAME_CLOCK_US for known_us in stamps_us):
            stamps_us.append(clock_us)
    arguments = dict(order.arguments)
    messages = [CommandMessage(order.verb, agent, stamp_us, arguments, order.number) for stamp_us in stamps_us]
    return [encode_message(message) for message in messages]
