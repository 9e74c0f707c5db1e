"""What the peers of an agent have said of themselves, and what others vouch for: who flies, lands, stands or has ended.

Each of these asks for evidence. That a liveliness token is missing is none: the peer may be cut off.
"""

from __future__ import annotations

import bisect
from collections.abc import Callable, Mapping, Sequence, Set

from swarmctl.bus import topics
from swarmctl.bus.bus import Bus, agent_name
from swarmctl.bus.messages.json_messages import StatusMessage, decode_status
from swarmctl.bus.peers.clocks import MOST_APART_US, PeerClocks
from swarmctl.bus.peers.paths import MAX_LEAD_US, peer_verifiers
from swarmctl.bus.peers.senders import Presence, ReceivedMessage
from swarmctl.bus.peers.vouched_ends import VouchedEnds
from swarmctl.bus.refusals import FUTURE, IDENTITY, MALFORMED, UNKNOWN_PEER, Refusals
from swarmctl.control.estimation.flown_by_others import CREEP_M_S
from swarmctl.control.phases.inputs import PeerInputs
from swarmctl.core.types import FLOWN_BY_AGENT, FlightMode, Landed, Phase

_COMPANY_US = 10_000_000  # a peer whose last status is older has left
SILENT_US = 2_000_000  # ten statuses; who is heard within it has not ended, and its clock is measured
_LAGS_TOLD = 8  # in one status, so that its size does not grow with the swarm: 50 peers are told in 1.4 s
_READY_LEAD_US = 1_000_000  # largest lead of a peer's ready time over its status
_DESCENDS = frozenset((FlightMode.LAND, FlightMode.RTL))  # modes in which an autopilot does, or is about to
_HOLDS = frozenset((FlightMode.HOLD,))
_MOVES = frozenset(FlightMode) - _HOLDS


class PeerStatuses:
    """Keeps the newest status of each peer, the ends that were vouched for, and whom an operator has excluded.

    Args:
        agent: index of this agent.
        peers: indices of the other agents.
        bus: tells who is alive.
        rate_hz: tick rate of every agent.
        note: receives the event `peer_ended` with the process that has.
        refusals: receives what is not believed.
        presence: when each sender came.
        clocks: of the peers; is told what statuses say of them.
        vouchers: agents of which each sender may say that they have ended.

    Attributes:
        uncommitted: peers whose status says that they do not fly by commitments.
    """

    def __init__(
        self,
        agent: int,
        peers: Sequence[int],
        bus: Bus,
        *,
        rate_hz: float,
        note: Callable[..., None],
        refusals: Refusals,
        presence: Presence,
        clocks: PeerClocks,
        vouchers: Mapping[str, Set[int]],
    ) -> None:
        self._agent, self._bus, self._note, self._refusals, self._clocks = agent, bus, note, refusals, clocks
        self._verifiers = peer_verifiers(peers, topics.STATUS, rate_hz, refusals, presence=presence)
        self._numbers = {agent_name(agent): agent for agent in peers}
        self._ends = VouchedEnds(vouchers)
        self._excluded: set[int] = set()  # peers of which an operator has said that they have ended
        self._newest: dict[int, StatusMessage] = {}
        self._heard_us: dict[int, int] = {}  # UTC of the newest one's arrival
        self._late_since_us: dict[int, int] = {}  # peers of which only statuses have come that are too old
        self._ended: frozenset[int] | None = frozenset()  # peers that have; None: to be found out anew
        self._lag_told = -1  # peer whose lag was told last
        self.uncommitted: frozenset[int] = frozenset()

    def take(self, sender: str, payload: bytes, utc_us: int) -> StatusMessage | None:
        """Keep a status that has arrived, and return it; None if it is refused."""
        status = decode_status(payload)
        reason = ""
        if status is None:
            reason = MALFORMED
        elif sender != agent_name(status.agent):
            reason = IDENTITY
        elif status.agent not in self._verifiers:
            reason = UNKNOWN_PEER
        elif status.ready_utc_us > status.utc_us + _READY_LEAD_US:
            reason = FUTURE
        elif self._is_far_ahead(status, utc_us):
            reason = FUTURE
            self._clocks.refused(status.agent, status.utc_us, utc_us)
        if reason or status is None:
            self._refusals.add(sender, topics.STATUS.name, reason, utc_us)
            return None
        stamp_us = min(status.utc_us, utc_us + MAX_LEAD_US)  # a clock that is ahead is measured, and not refused
        message = ReceivedMessage(status.boot_id, status.ticks, stamp_us, payload)
        verifier = self._verifiers[status.agent]
        if not verifier.accepts(message, utc_us):
            if back_us := verifier.gone_back_us(utc_us):
                self._clocks.gone_back(status.agent, back_us)
            return None
        self._clocks.believed(status.agent)
        self._late_since_us.pop(status.agent, None)
        self._newest[status.agent], self._heard_us[status.agent], self._ended = status, utc_us, None
        if not status.uses_commitments:  # trajectory messages say more of the clocks of those that commit
            self._measure_clock(status, utc_us)
        if status.uses_commitments is (status.agent in self.uncommitted):
            self.uncommitted ^= {status.agent}
        return status

    def take_late(self, sender: str, utc_us: int) -> None:
        """Take in that the seal of a status is too old, as all are by a clock that is too far behind.

        After it was cut off, messages of a peer that have waited come at once, before new ones: those tell nothing.
        """
        agent = self._numbers.get(sender)
        if agent is not None and utc_us - self._late_since_us.setdefault(agent, utc_us) >= SILENT_US:
            self._clocks.too_far_behind(agent)

    def _is_far_ahead(self, status: StatusMessage, utc_us: int) -> bool:
        return status.utc_us - self._clocks.ahead_us(status.agent) > utc_us + MOST_APART_US

    def _measure_clock(self, status: StatusMessage, utc_us: int) -> None:
        self._clocks.received(status.agent, status.utc_us, utc_us)
        if (lag_us := status.lags_us.get(self._agent)) is not None:
            self._clocks.answered(status.agent, 0, lag_us, utc_us)

    def next_lags_us(self, utc_us: int) -> dict[int, int]:
        """Return by how much the newest status of each of some peers came later than it was sent, by its stamp.

        Those that are heard have their turn, one after another.
        """
        heard = sorted(agent for agent, at_us in self._heard_us.items() if utc_us - at_us < SILENT_US)
        first = bisect.bisect_right(heard, self._lag_told)
        told = (heard[first:] + heard[:first])[:_LAGS_TOLD]
        self._lag_told = told[-1] if told else -1
        return {agent: self._heard_us[agent] - self._newest[agent].utc_us for agent in told}

    def take_end(self, sender: str, payload: bytes, utc_us: int) -> None:
        """Believe who runs a peer's process, and has seen it end, however recently the peer was heard."""
        ended, refusal = self._ends.take(sender, payload)
        if refusal:
            self._refusals.add(sender, topics.ENDED.name, refusal, utc_us)
        if ended is not None:
            self._ended = None
            self._clocks.ended(ended.agent)
            self._note("peer_ended", agent=ended.agent, boot_id=ended.boot_id, is_down=ended.is_down)

    def exclude(self, agent: int) -> None:
        """Believe that the process of a peer has ended; another process under its number takes part again."""
        self._ends.vouch(agent, self.boot_id(agent))
        self._excluded.add(agent)
        self._ended = None
        self._clocks.ended(agent)

    def heard_us(self, agent: int) -> int:
        """Return the UTC at which the newest status of a peer has arrived; 0 without one."""
        return self._heard_us.get(agent, 0)

    def boot_id(self, agent: int) -> int | None:
        """Return the boot id of a peer's process; None of one that has not been heard."""
        status = self._newest.get(agent)
        return None if status is None else status.boot_id

    def process_has_ended(self, agent: int, boot_id: int | None) -> bool:
        """Return whether somebody vouches for the end of this process: its vehicle gets no more setpoints from it."""
        return self._ends.has_ended(agent, boot_id)

    def has_ended(self, agent: int) -> bool:
        """Return whether there is evidence that a peer commits to nothing more.

        Somebody vouches for the end of its process, or it was heard done, and sends nothing to its vehicle any more.
        """
        return self.process_has_ended(agent, self.boot_id(agent)) or self.is_done(agent)

    @property
    def ended(self) -> frozenset[int]:
        """Return the peers that have, see `has_ended`."""
        if self._ended is None:
            self._ended = frozenset(agent for agent in self._verifiers if self.has_ended(agent))
        return self._ended

    @property
    def excused(self) -> frozenset[int]:
        """Return the peers that nobody waits for: they have never been heard, and an operator has excluded them.

        That a process has ended, as who runs it says, lets nobody take off without it: an operator decides that.
        """
        return frozenset(self._excluded - self._newest.keys())

    def is_done(self, agent: int) -> bool:
        """Return whether a peer has said that its mission has ended."""
        return self._is_in(agent, Phase.DONE)

    def codes(self) -> dict[int, str]:
        """Return the code that each peer flies, as its status says; "" where it does not."""
        return {agent: status.code for agent, status in self._newest.items()}

    def inputs(self) -> dict[int, PeerInputs]:
        """Return phase, ready time by the own clock, and liveliness of every peer that has published a status."""
        alive = self._bus.alive()
        return {
            agent: PeerInputs(
                Phase(status.phase), self._ready_utc_us(status), agent_name(agent) in alive, status.keeps_up
            )
            for agent, status in self._newest.items()
        }

    def _ready_utc_us(self, status: StatusMessage) -> int:
        """Return when a peer reached its start, by the own clock; 0 before."""
        return status.ready_utc_us - self._clocks.ahead_us(status.agent) if status.ready_utc_us else 0

    def has_company(self, utc_us: int) -> bool:
        """Return whether some peer is on the bus and not done.

        A liveliness token alone is no proof: one of a computer that was lost may stay for good on a router of another
        one. So a peer that is silent for long is no company.
        """
        since_us = utc_us - _COMPANY_US
        alive = self._bus.alive()
        return any(
            status.phase != Phase.DONE and agent_name(agent) in alive and self._heard_us[agent] >= since_us
            for agent, status in self._newest.items()
        )

    def standing_m(self) -> dict[int, float]:
        """Return the heights [m] above the shared origin at which peers' vehicles stand, as their agents have said."""
        return {
            agent: status.altitude_m
            for agent, status in self._newest.items()
            if status.landed == Landed.ON_GROUND and not status.armed and status.ground_speed_m_s >= 0.0
        }

    def flies_itself(self, agent: int) -> bool:
        """Return whether a peer's agent controls its vehicle, and so runs the same safety filter as ours."""
        status = self._newest.get(agent)
        return status is not None and status.mode in FLOWN_BY_AGENT

    def is_parked(self, agent: int) -> bool:
        """Return whether a peer's mission has ended and its vehicle stays where it is: on the ground, or in a hold.

        An agent that was restarted in flight is done at once, while the autopilot still lands its vehicle. One that
        was handed back in a hold may be moved in it.
        """
        status = self._newest.get(agent)
        if status is None or status.phase != Phase.DONE or self._flies_in(agent, _MOVES):
            return False
        return status.ground_speed_m_s < CREEP_M_S or not self._flies_in(agent, _HOLDS)

    def is_landing(self, agent: int) -> bool:
        """Return whether a peer's vehicle descends, by its agent's order, a pilot's, or by itself."""
        return self._is_in(agent, Phase.LAND) or self._flies_in(agent, _DESCENDS)

    def _is_in(self, agent: int, phase: Phase) -> bool:
        status = self._newest.get(agent)
        return status is not None and status.phase == phase

    def _flies_in(self, agent: int, modes: Set[FlightMode]) -> bool:
        """Return whether a peer's vehicle flies in one of these modes, as far as its agent has heard."""
        status = self._newest.get(agent)
        if status is None or not status.armed or status.landed == Landed.ON_GROUND:
            return False
        return status.flight_mode in modes
