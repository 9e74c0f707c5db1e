"""How far peers' clocks are ahead of the own one, measured on the stamps that their messages carry. Pure.

A message that a peer stamped s, and that arrived at r by the own clock, was under way for a while: the peer is ahead by
at least s - r. The peer also says when, by its clock, the newest own message arrived: it is ahead by at most that time
less the own stamp. Both bounds hold whatever the delays are (the four timestamps of RFC 5905, as an interval instead of
its midpoint); short delays make them tight. A bound is kept until a newer one is tighter, and becomes wider with time:
the clocks of agents go apart by up to 2 %, for each follows a step of its computer's UTC by 1 % of the time that passes
(`swarmctl.wall_clock`). Agents that commit say so in every trajectory message, others in their statuses.

What is applied is 0 as long as 0 is possible, and the middle of the interval when what was applied is not: equal clocks
are never corrected. Its error is at most the width of the interval, which is a round trip.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from swarmctl.bus.bus import agent_name

_DRIFT_PART = 50  # two clocks go apart by less than this part of the time that passes: 2 %
_UNKNOWN_US = 1 << 62
_UNMEASURED_US = 1 << 61  # bounds beyond are none
MOST_APART_US = 10_000_000  # clocks that are farther apart are not corrected; seals are held to it, too
_TOO_FAR = "which is too far: nothing it says is believed"
_ADVICE = "Set the clocks of the hosts (chrony, PTP)"
_REPORTED_US = 50_000  # corrections that differ by more from the last one reported are


class _PeerClock:
    """The clock of one peer.

    Attributes:
        ahead_us: how far it is taken to be ahead.
        reported_us: what was reported of that.
        low_us, high_us: least and most that it can be ahead.
        error_us: largest error that `ahead_us` may have.
    """

    __slots__ = ("_narrowed_us", "ahead_us", "error_us", "high_us", "low_us", "reported_us")

    def __init__(self) -> None:
        self._narrowed_us = 0
        self.ahead_us = self.reported_us = 0
        self.low_us, self.high_us, self.error_us = -_UNKNOWN_US, _UNKNOWN_US, _UNKNOWN_US

    def narrow(self, low_us: int, high_us: int, utc_us: int) -> None:
        """Take in new bounds, and correct what is applied if it is impossible now."""
        drift_us = max(0, -((self._narrowed_us - utc_us) // _DRIFT_PART))
        self._narrowed_us = utc_us
        low, high = max(low_us, self.low_us - drift_us), min(high_us, self.high_us + drift_us)
        if low > high:  # a clock was set
            low, high = low_us, high_us
        if not low <= self.ahead_us <= high and low > -_UNMEASURED_US and high < _UNMEASURED_US:
            self.ahead_us = (low + high) // 2
        self.low_us, self.high_us, self.error_us = low, high, max(high - self.ahead_us, self.ahead_us - low)


class PeerClocks:
    """Measures the clocks of all peers.

    Args:
        peers: their numbers.
        note: is told `clock_offset` with `agent`, `ahead_s` and the `error_s` it may have, when a correction changes,
            and `clock_gone_back` with `agent` and `by_s`.
        trusts_equal: whether clocks that may be equal are taken for equal without room for an error.

    Attributes:
        alert: what the operator has to know of the clock that is farthest off, or "".
    """

    def __init__(self, peers: Iterable[int], note: Callable[..., None], *, trusts_equal: bool = False) -> None:
        self._clocks = {agent: _PeerClock() for agent in peers}
        self._note, self._trusts_equal = note, trusts_equal
        self._refused_us: dict[int, int] = {}  # by peer: how far a refused message was ahead
        self._behind: set[int] = set()  # peers whose messages are refused as too old
        self._gone_back_us: dict[int, int] = {}  # by peer: how far its clock has gone back, as refused messages show
        self.alert = ""

    def received(self, agent: int, sent_utc_us: int, utc_us: int) -> None:
        """Take in a message that a peer stamped `sent_utc_us`, received now."""
        if self._refused_us.pop(agent, None) is not None:
            self.alert = self._farthest_off()
        self._narrow(agent, sent_utc_us - utc_us, _UNKNOWN_US, utc_us)

    def refused(self, agent: int, sent_utc_us: int, utc_us: int) -> None:
        """Take in that a message was refused now, because the stamp of the peer is too far ahead to allow for."""
        self._refused_us[agent] = sent_utc_us - utc_us
        self.alert = self._farthest_off()

    def gone_back(self, agent: int, by_us: int) -> None:
        """Take in that messages were refused as if repeated, because the clock of the peer has gone back, as it seems.

        It is told once, and is the alert until the peer is believed again.
        """
        if agent not in self._gone_back_us:
            self._gone_back_us[agent] = by_us
            self._note("clock_gone_back", agent=agent, by_s=by_us / 1e6)
            self.alert = self._farthest_off()

    def too_far_behind(self, agent: int) -> None:
        """Take in that messages are refused because the stamps of the peer are too far behind to allow for."""
        if agent not in self._behind:
            self._behind.add(agent)
            self.alert = self._farthest_off()

    def believed(self, agent: int) -> None:
        """Take in that a message of a peer was accepted."""
        if agent in self._behind or agent in self._gone_back_us:
            self._behind.discard(agent)
            self._gone_back_us.pop(agent, None)
            self.alert = self._farthest_off()

    def ended(self, agent: int) -> None:
        """Take in that a process has ended: the clock of a peer needs no setting any more, unless it is heard again."""
        self._refused_us.pop(agent, None)
        self._behind.discard(agent)
        self._gone_back_us.pop(agent, None)
        if agent in self._clocks:
            self._clocks[agent].reported_us = 0
            self.alert = self._farthest_off()

    def answered(self, agent: int, sent_utc_us: int, received_utc_us: int, utc_us: int) -> None:
        """Take in when a peer, by its clock, received the own message stamped `sent_utc_us`."""
        self._narrow(agent, -_UNKNOWN_US, received_utc_us - sent_utc_us, utc_us)

    def ahead_us(self, agent: int) -> int:
        """Return how far a peer's clock is taken to be ahead: what its stamps are reduced by."""
        clock = self._clocks.get(agent)
        return 0 if clock is None else clock.ahead_us

    def error_us(self, agent: int) -> int:
        """Return the largest error that `ahead_us` may have; very large before both bounds are known."""
        return self._clocks[agent].error_us

    def spread_us(self, agent: int) -> int:
        """Return the error to leave room for; 0 while the clock is taken for equal, as one that is not measured."""
        clock = self._clocks.get(agent)
        if clock is None or (self._trusts_equal and not clock.ahead_us):
            return 0
        if clock.low_us <= -_UNMEASURED_US or clock.high_us >= _UNMEASURED_US:
            return 0
        return clock.error_us

    def _narrow(self, agent: int, low_us: int, high_us: int, utc_us: int) -> None:
        clock = self._clocks[agent]
        clock.narrow(low_us, high_us, utc_us)
        if abs(clock.ahead_us - clock.reported_us) > _REPORTED_US:
            clock.reported_us = clock.ahead_us
            self._note("clock_offset", agent=agent, ahead_s=clock.ahead_us / 1e6, error_s=self.error_us(agent) / 1e6)
            self.alert = self._farthest_off()

    def _farthest_off(self) -> str:
        if self._behind:
            name, most_s = agent_name(min(self._behind)), MOST_APART_US // 1_000_000
            return f"clock of {name} is more than {most_s} s behind this one, {_TOO_FAR}. {_ADVICE}"
        if self._gone_back_us:
            agent, by_us = max(self._gone_back_us.items(), key=lambda item: item[1])
            name = agent_name(agent)
            return (
                f"clock of {name} may have gone back by {by_us * 1e-6:.1f} s, as it started again: what it says looks "
                f"like what was said before, and is not believed. {_ADVICE}, then start {name} again"
            )
        if self._refused_us:
            agent, ahead_us = max(self._refused_us.items(), key=lambda item: item[1])
            return f"{_apart(agent, ahead_us)}, {_TOO_FAR}. {_ADVICE}"
        agent, clock = max(self._clocks.items(), key=lambda item: abs(item[1].reported_us))
        if abs(clock.reported_us) <= _REPORTED_US:
            return ""
        return f"{_apart(agent, clock.reported_us)}, which is allowed for. {_ADVICE}"


def _apart(agent: int, ahead_us: int) -> str:
    off_s = ahead_us * 1e-6
    return f"clock of {agent_name(agent)} is {abs(off_s):.2f} s {'ahead of' if off_s > 0.0 else 'behind'} this one"
