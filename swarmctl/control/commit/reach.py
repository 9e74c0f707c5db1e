"""Whose acknowledgement a proposal can do without: that of a peer it does not meet, wherever that peer may get. Pure.

In a large swarm most peers are too far away to matter. Each message of an agent declares which peers are *far*. The
acknowledgement of all others is always required, and that of a far peer j unless

1. j has said that it has heard, within the last `FAR_LEASE_US`, a message that declared it far;
2. the proposal is *modest*: no faster than the speed v, nor longer than the stretch L, that the agent's messages state;
3. the proposal keeps the committed distance, with all its points, to the ball around the place where j was when it sent
   the newest message known, of the radius v_j min(age, FAR_LEASE_US) + L_j.

v_j and L_j are stated in that message. They bound what j has committed to or proposes in it, too, so what is clear of
the ball is clear of those.

*No two agents are ever committed to trajectories that come closer than the hard minimum distance*, as among agents that
all acknowledge (`swarmctl.control.commit.protocol`). Proof: let A be committed to a and B to b. If B has acknowledged
a, or A b, the proof is that of the protocol, which takes no more than one of the two. So let A have done without the
acknowledgement of B and B without that of A, and let A have been the later one to check condition 3, on a message m of
B. From its place in m to where it proposed b, B has come along trajectories that it was committed to or proposed in m,
or has committed to since. Of the latter, those that A has acknowledged were proposed in m at the latest, as A knows
nothing newer. For the others, and for b, B did without A, by condition 1 for `FAR_LEASE_US` after m at most. Along all
of them it was no faster than the v_B that m states, and b is no longer than its L_B. So b lies in the ball, and a
outside.

An excluded peer owes nothing as long as its newest message known does not declare the agent far: it commits to nothing
without the agent then. Otherwise proposals keep clear of its ball. From the promise to exclude it on, no message says
that later ones of it were heard. So its lease ends, for good; then that is all: it can't commit without the agent any
more, so that the agent is the later one, and needs conditions 1 and 2 no longer.

What is committed to unasked, to evade or where a pilot gives the vehicle back, leaves the ball until it is heard: the
next message of the agent, to all, states its speed and stretch. Until then a far peer may commit to what meets it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from swarmctl.core.trajectory import Trajectory
from swarmctl.core.trajectory_message import ANYWHERE, Reach, TrajectoryMessage
from swarmctl.core.types import Array

# A message to all goes out every 0.5 s at least: an answer takes two of these, and a third may be lost. Longer, and the
# balls that proposals have to keep clear of grow by a peer's speed.
FAR_LEASE_US = 1_500_000
_LOOKING_US = 100_000  # how often it is looked who is far
_COMING_M, _LEAVING_M = 1.0, 1.5  # peers this much beyond where they have to acknowledge are near already, or still
_POINT_STRIDE = 3  # of the points of trajectories that are looked at for this
_REMEMBERED = 8  # own trajectories whose extent is known
_MODEST_01 = 1.0 + 1e-6  # rounding of messages
_NOBODY: frozenset[int] = frozenset()


class _Extent(NamedTuple):
    """How fast and how long a trajectory is from its begin on."""

    fastest_m_s: float
    length_m: float


class _Place(NamedTuple):
    """Where a peer was when it sent a message."""

    message: TrajectoryMessage
    pos_ned_m: tuple[float, ...]
    sent_utc_us: int  # by the own clock


class FarPeers:
    """Chooses the peers that are far, and those whose acknowledgement a proposal can do without.

    Args:
        peers: numbers of the other agents.
        speed_m_s, stretch_m: bounds of modest proposals; a speed of 0 lets nobody be far.
        apart_m: least distance of two trajectories, whatever their direction.
        ahead_us: returns how far a peer's clock is ahead.

    Attributes:
        near: all peers that are not far.
    """

    def __init__(
        self,
        peers: Collection[int],
        *,
        speed_m_s: float,
        stretch_m: float,
        apart_m: float,
        ahead_us: Callable[[int], int],
    ) -> None:
        self._peers, self.near = frozenset(peers), frozenset(peers)
        self._speed_m_s, self._stretch_m, self._apart_m = speed_m_s, stretch_m, apart_m
        self._ahead_us = ahead_us
        self._places: dict[int, _Place] = {}
        self._extents: dict[int, tuple[Trajectory, _Extent]] = {}  # by identity of the own trajectories
        self._checked: dict[int, TrajectoryMessage] = {}  # by which peers were spared
        self._told: dict[int, int] = {}  # stamp of the first message that has declared a peer far, since it is far
        self._looked_us = 0

    @property
    def enabled(self) -> bool:
        """Whether anybody may be far."""
        return self._speed_m_s > 0.0

    def update(self, own: Sequence[Trajectory], messages: Mapping[int, TrajectoryMessage], utc_us: int) -> bool:
        """Look, if it is time, who is far now from what the agent has committed to and proposes; return whether it was.

        Where a later proposal comes closer, it takes the acknowledgement of a far peer, who is asked by the next
        message that it hears.
        """
        if not self.enabled or utc_us - self._looked_us < _LOOKING_US:
            return False
        self._looked_us = utc_us
        known = [agent for agent in self._peers if agent in messages]
        points = np.concatenate([trajectory.pos_ned_m[::_POINT_STRIDE] for trajectory in own] + [own[0].pos_ned_m[-1:]])
        room_m = [_LEAVING_M if agent in self.near else _COMING_M for agent in known]
        self.near = self._peers - self._clear(known, points, messages, utc_us, room_m)
        return True

    def spared(
        self,
        trajectory: Trajectory,
        messages: Mapping[int, TrajectoryMessage],
        confirmed_us: Mapping[int, int],
        utc_us: int,
        excluded: Collection[int] = (),
    ) -> frozenset[int]:
        """Return the peers whose acknowledgement of a trajectory is not required, by conditions 1 to 3.

        Args:
            trajectory: own, from now on.
            messages: newest ones of peers.
            confirmed_us: by peer, stamp of the newest own message that it has said to have heard.
            utc_us: now.
            excluded: peers that a majority has excluded; condition 3 alone holds for them after their lease.
        """
        if not self.enabled:
            return _NOBODY
        looked_at = {agent for agent in excluded if agent in messages and self._is_over(agent, messages[agent], utc_us)}
        if self._is_within(self._extent(trajectory)):
            looked_at.update(a for a in self._told if self._is_leased(a, confirmed_us.get(a, 0), utc_us))
        return self._checked_clear(sorted(looked_at), trajectory, messages, utc_us)

    def still_spared(
        self, spared: frozenset[int], trajectory: Trajectory, messages: Mapping[int, TrajectoryMessage], utc_us: int
    ) -> frozenset[int]:
        """Return those of the peers spared before whose messages since then have not come closer to the trajectory.

        Of the others it may not be clear: what they have committed to has to be compared.
        """
        changed = [agent for agent in spared if messages[agent] is not self._checked[agent]]
        if not changed:
            return spared
        return spared.difference(changed) | self._checked_clear(changed, trajectory, messages, utc_us)

    def _checked_clear(
        self, agents: Sequence[int], trajectory: Trajectory, messages: Mapping[int, TrajectoryMessage], utc_us: int
    ) -> frozenset[int]:
        """Return the agents whose ball the trajectory keeps clear of, and remember by which messages."""
        self._checked.update((agent, messages[agent]) for agent in agents)
        return self._clear(agents, trajectory.pos_ned_m, messages, utc_us, [0.0] * len(agents))

    def _clear(
        self,
        agents: Sequence[int],
        points: Array,
        messages: Mapping[int, TrajectoryMessage],
        utc_us: int,
        room_m: Sequence[float],
    ) -> frozenset[int]:
        """Return the agents whose ball, larger by the room for each, all points (K, 3) are outside of."""
        if not agents:
            return _NOBODY
        places = [self._place(agent, messages[agent]) for agent in agents]
        kept_m = self._apart_m + np.array([self._radius_m(place, utc_us) for place in places]) + np.array(room_m)
        ways = points[None] - np.array([place.pos_ned_m for place in places])[:, None]  # (N, K, 3)
        are_clear = np.einsum("akc,akc->ak", ways, ways).min(axis=1) > kept_m * kept_m
        return frozenset(agent for agent, is_clear in zip(agents, are_clear.tolist(), strict=True) if is_clear)

    def reach(self, own: Collection[Trajectory], *, away_m: float, speed_m_s: float, stops_m: float) -> Reach:
        """Return what a message states.

        Args:
            own: committed and proposed trajectories.
            away_m: how far the vehicle is from where it was committed to be.
            speed_m_s, stops_m: how fast it is flown by others, and the way on which it stops from there.
        """
        if not self.enabled:
            return ANYWHERE
        immodest = [extent for extent in map(self._extent, own) if not self._is_within(extent)]
        return Reach(
            far=self._peers - self.near,
            speed_m_s=max([self._speed_m_s, speed_m_s, *(extent.fastest_m_s for extent in immodest)]),
            stretch_m=away_m + max([self._stretch_m, stops_m, *(extent.length_m for extent in immodest)]),
        )

    def published(self, reach: Reach, sent_utc_us: int, *, for_all: bool) -> None:
        """Remember since when messages, which all hear or only some, declare peers far."""
        if for_all:
            self._told = {agent: self._told.get(agent, sent_utc_us) for agent in reach.far}
        elif not self._told.keys() <= reach.far:
            self._told = {agent: since_us for agent, since_us in self._told.items() if agent in reach.far}

    def _is_leased(self, agent: int, heard_us: int, utc_us: int) -> bool:
        return agent not in self.near and self._told[agent] <= heard_us <= utc_us <= heard_us + FAR_LEASE_US

    def _is_over(self, agent: int, message: TrajectoryMessage, utc_us: int) -> bool:
        """Return whether a peer can't do without this agent any more, by the lease of its newest message known."""
        place = self._place(agent, message)
        return utc_us > place.sent_utc_us + FAR_LEASE_US + message.committed.clock_error_us

    def _is_within(self, extent: _Extent) -> bool:
        fastest_m_s, length_m = extent
        return fastest_m_s <= _MODEST_01 * self._speed_m_s and length_m <= _MODEST_01 * self._stretch_m

    def _extent(self, trajectory: Trajectory) -> _Extent:
        known = self._extents.get(id(trajectory))
        if known is None:
            if len(self._extents) >= _REMEMBERED:
                self._extents.clear()
            known = self._extents[id(trajectory)] = trajectory, _extent_of(trajectory)
        return known[1]

    def _place(self, agent: int, message: TrajectoryMessage) -> _Place:
        place = self._places.get(agent)
        if place is None or place.message is not message:
            sent_utc_us = message.sent_utc_us - self._ahead_us(agent)
            place = self._places[agent] = _Place(message, message.committed.at(sent_utc_us)[0], sent_utc_us)
        return place

    def _radius_m(self, place: _Place, utc_us: int) -> float:
        """Return the radius of the ball around where a peer was, with room for the error of its clock."""
        error_us, reach = place.message.committed.clock_error_us, place.message.reach
        age_us = min(max(0, utc_us - place.sent_utc_us) + error_us, FAR_LEASE_US) + error_us
        return reach.speed_m_s * 1e-6 * age_us + reach.stretch_m + place.message.tube_m


def _extent_of(trajectory: Trajectory) -> _Extent:
    steps = trajectory.pos_ned_m[1:] - trajectory.pos_ned_m[:-1]
    legs_m, vel = np.sqrt(np.einsum("kc,kc->k", steps, steps)), trajectory.vel_ned_m_s
    fastest_m_s = max(float(legs_m.max()) / (1e-6 * trajectory.dt_us), math.sqrt(np.einsum("kc,kc->k", vel, vel).max()))
    return _Extent(fastest_m_s, float(legs_m.sum()))
