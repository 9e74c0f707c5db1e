"""The newest path of every peer.

`PeerPaths` judges freshness by the payload, never by the bus, and identity by `swarmctl.bus.peers.senders`. It keeps
every peer's newest path whatever its age; what an old path means for separation is decided in `swarmctl.control`.
"""

from __future__ import annotations

from collections.abc import Iterable

from swarmctl.bus.bus import agent_name
from swarmctl.bus.messages.path_messages import decode_path, longest_step_m
from swarmctl.bus.peers.clocks import PeerClocks
from swarmctl.bus.peers.senders import Presence, ReceivedMessage, SenderVerifier
from swarmctl.bus.refusals import FUTURE, IDENTITY, LATE, MALFORMED, UNKNOWN_PEER, Refusals
from swarmctl.bus.topics import PATH, Topic
from swarmctl.core.types import MAX_MARGIN_M, PredictedPath

_MAX_AGE_US = 2_000_000  # a path whose first point is older when it arrives is refused
MAX_LEAD_US = 500_000  # likewise one whose first point is further in the future


def peer_verifiers(
    peers: Iterable[int], topic: Topic, rate_hz: float, refusals: Refusals, *, presence: Presence
) -> dict[int, SenderVerifier]:
    """Return a verifier of one topic for every peer; see `SenderVerifier`."""
    return {peer: SenderVerifier(agent_name(peer), topic.name, rate_hz, refusals, presence=presence) for peer in peers}


class PeerPaths:
    """Keeps the newest valid path of every peer; refused messages are counted by reason and change nothing.

    Args:
        peers: numbers of the other agents.
        rate_hz, refusals, presence: see `SenderVerifier`.
        clocks: by which paths are converted to the own clock; None takes all clocks for equal.

    Attributes:
        heard_utc_us: when a path was accepted last, of whomever.
    """

    def __init__(
        self,
        peers: Iterable[int],
        rate_hz: float,
        refusals: Refusals,
        presence: Presence,
        *,
        clocks: PeerClocks | None = None,
    ) -> None:
        peers = tuple(peers)
        self._verifiers = peer_verifiers(peers, PATH, rate_hz, refusals, presence=presence)
        self._clocks = clocks
        self._newest: dict[int, PredictedPath] = {}  # in the order of agent numbers
        self._near_since_us: dict[int, int] = dict.fromkeys(peers, 0)  # those within reach
        self._near: tuple[PredictedPath, ...] | None = None  # their paths; None: to be made anew
        self.refusals = refusals
        self.heard_utc_us = 0

    def offer(self, sender: str, payload: bytes, utc_us: int) -> PredictedPath | None:
        """Check one message of the PATH topic, and keep it if it is accepted; return the path, None if it is refused.

        Args:
            sender: name in the key it arrived on, which the bus guarantees.
            payload: bytes as received.
            utc_us: now, disciplined UTC [us].
        """
        path = self._by_own_clock(decode_path(payload), payload)
        if path is None or (reason := self._refusal(sender, path, utc_us)):
            self.refusals.add(sender, PATH.name, MALFORMED if path is None else reason, utc_us)
            return None
        message = ReceivedMessage(path.boot_id, path.seq, path.t0_utc_us, payload)
        if not self._verifiers[path.agent].accepts(message, utc_us):
            return None
        is_first = path.agent not in self._newest
        self._newest[path.agent], self.heard_utc_us, self._near = path, utc_us, None
        if is_first:
            self._newest = dict(sorted(self._newest.items()))
        return path

    def _by_own_clock(self, path: PredictedPath | None, payload: bytes) -> PredictedPath | None:
        """Return the path at times of the own clock, with room for the error that is left of the peer's."""
        if path is None or self._clocks is None:
            return path
        ahead_us, spread_us = self._clocks.ahead_us(path.agent), self._clocks.spread_us(path.agent)
        if not ahead_us and not spread_us:
            return path
        fastest_m_us = longest_step_m(payload) / path.dt_us
        return PredictedPath(
            agent=path.agent,
            boot_id=path.boot_id,
            seq=path.seq,
            t0_utc_us=path.t0_utc_us - ahead_us,
            dt_us=path.dt_us,
            margin_m=min(MAX_MARGIN_M, path.margin_m + spread_us * fastest_m_us),
            pos_ned_m=path.pos_ned_m,
            setpoint_accel_ned_m_s2=path.setpoint_accel_ned_m_s2,
        )

    def latest(self) -> tuple[PredictedPath, ...]:
        """Return the newest path of every peer, whatever its age, sorted by agent number."""
        return tuple(self._newest.values())

    def newest_utc_us(self, agent: int) -> int:
        """Return the time of the newest path of a peer, within reach or not; 0 before the first."""
        return self._newest[agent].t0_utc_us if agent in self._newest else 0

    def attend(self, within_reach: Iterable[int], utc_us: int) -> None:
        """Take these peers, and no others, for those within reach."""
        self._near_since_us = {agent: self._near_since_us.get(agent, utc_us) for agent in within_reach}
        self._near = None

    def is_near(self, agent: int) -> bool:
        """Return whether a peer is within reach, whether or not a path of it was heard."""
        return agent in self._near_since_us

    def near(self, before_utc_us: int | None = None) -> tuple[PredictedPath, ...]:
        """Return the newest paths of peers within reach, sorted by agent number; at first that is everybody.

        Args:
            before_utc_us: leave out those that came within reach after this; None: leave out none.
        """
        if self._near is None:
            since_us = self._near_since_us
            self._near = tuple([path for agent, path in self._newest.items() if agent in since_us])
        if before_utc_us is None:
            return self._near
        return tuple([path for path in self._near if self._near_since_us[path.agent] <= before_utc_us])

    def late(self, oldest_utc_us: int) -> list[PredictedPath]:
        """Return the newest paths that are older than this of peers that have been within reach since then."""
        return [path for path in self.near(oldest_utc_us) if path.t0_utc_us < oldest_utc_us]

    def _refusal(self, sender: str, path: PredictedPath, utc_us: int) -> str:
        if sender != agent_name(path.agent):
            return IDENTITY
        if path.agent not in self._verifiers:
            return UNKNOWN_PEER
        if path.t0_utc_us - utc_us > MAX_LEAD_US:
            return FUTURE
        return LATE if utc_us - path.t0_utc_us > _MAX_AGE_US else ""
