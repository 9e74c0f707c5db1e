"""Interest management: an agent hears everything of peers within reach, and of all others a path now and then.

Who is within reach is chosen such that no other can matter to a plan (`Interest`). So plans and the safety filter keep
clear of those within reach alone, and only their silence counts.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from swarmctl.agent.sharing.far_paths import UNTOLD_MARGIN_M, speed_bound_m_s
from swarmctl.agent.sharing.path_sharing import PathSharingParams
from swarmctl.bus import topics
from swarmctl.bus.bus import Bus, agent_name
from swarmctl.bus.peers.paths import PeerPaths
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.core.types import PredictedPath, VehicleState

_SUBSCRIBING_S = 0.5  # until it is looked, a subscription is in force, between two computers too, and a status comes
_FARTHER_01 = 1.1  # a peer is left when it is farther away than this times the reach, lest subscriptions flutter
_LEAVING_US = 500_000  # how often it is looked whether a peer within reach may be left
_LOOKING_US = 100_000  # how often it is looked at all


class Interest:
    """Chooses the peers of which every path and status is heard.

    Before and after the mission statuses are heard of all, who wait for each other.

    A peer at the distance d, by its newest path, is within reach if

        d <= radius + margin + 0.1 m + (v + v_p) T,    T = horizon + 1 / far_hz + age of the path + time to subscribe,

    where v and v_p are speeds that the two keep to (`speed_bound_m_s`). Beyond, whatever both do until the next path of
    the peer is heard and a subscription is in force, no plan made by then meets the peer within its horizon. A peer
    that will be faster, or wants more margin, says so at once, to all. The age of its path counts, so one that falls
    silent comes within reach as what it may have flown does. A peer that has not been heard is within reach.

    Args:
        params: rate of the paths that all hear; 0 leaves all subscriptions as they are.
        separation: distances.
        bus: on which peers are heard.
        paths: newest ones of peers; they are told who is within reach.
        peers: numbers of the other agents.
        horizon_s: of plans.
    """

    def __init__(
        self,
        params: PathSharingParams,
        separation: SeparationParams,
        bus: Bus,
        paths: PeerPaths,
        peers: Iterable[int],
        *,
        horizon_s: float,
    ) -> None:
        self._params, self._separation, self._bus, self._paths = params, separation, bus, paths
        self._peers = frozenset(peers)
        self._horizon_s = horizon_s
        self._seen: dict[int, PredictedPath] = {}  # by which it was decided last
        self._due_us: dict[int, int] = {}  # when it is decided anew, though that path is the newest
        self._looked_us, self._own_m_s = -_LOOKING_US, 0.0
        self._told_by = self._peers  # of whom statuses are heard
        self.within_reach = self._peers

    def update(self, state: VehicleState | None, own_m_s: float, utc_us: int, *, waits: bool) -> None:
        """Hear those that are within reach now.

        Args:
            state: own state; None as long as there is none, when all are within reach.
            own_m_s: speed that the own vehicle keeps to.
            utc_us: now.
            waits: whether the mission is not under way, so that statuses are heard of all.
        """
        if not self._params.far_hz:
            return
        if state is None:
            self._seen.clear()
            self._attend(self._peers, utc_us)
        else:
            self._look(state, max(own_m_s, math.hypot(*state.vel_ned_m_s.tolist())), utc_us)
        told_by = self._peers if waits else self.within_reach
        if told_by != self._told_by:
            self._told_by = told_by
            self._hear(topics.STATUS, told_by)

    def _look(self, state: VehicleState, own_m_s: float, utc_us: int) -> None:
        """Decide anew on those of whom there is news, or who may have come nearer meanwhile."""
        if own_m_s > self._own_m_s:
            self._seen.clear()
        elif utc_us - self._looked_us < _LOOKING_US:
            return
        self._looked_us, self._own_m_s = utc_us, own_m_s
        pos, within_reach = state.pos_ned_m.tolist(), set(self.within_reach)
        for path in self._paths.latest():
            agent = path.agent
            is_near = agent in within_reach
            if utc_us < self._due_us.get(agent, 0) and (is_near or path is self._seen.get(agent)):
                continue
            self._seen[agent] = path
            if self._reaches(pos, path, utc_us, is_near=is_near):
                within_reach.add(agent)
            else:
                within_reach.discard(agent)
        self._attend(frozenset(within_reach), utc_us)

    def _attend(self, within_reach: frozenset[int], utc_us: int) -> None:
        if within_reach != self.within_reach:
            self.within_reach = within_reach
            self._paths.attend(within_reach, utc_us)
            self._hear(topics.PATH, within_reach)

    def _hear(self, topic: topics.Topic, peers: frozenset[int]) -> None:
        self._bus.hear(topic, [agent_name(peer) for peer in sorted(peers)])

    def _reaches(self, pos_ned_m: list[float], path: PredictedPath, utc_us: int, *, is_near: bool) -> bool:
        """Return whether a peer is within reach, and note when that is to be decided again."""
        age_s = max(0.0, (utc_us - path.t0_utc_us) * 1e-6)
        closing_m_s = self._own_m_s + speed_bound_m_s(path, self._params)
        ahead_s = self._horizon_s + 1.0 / self._params.far_hz + age_s + _SUBSCRIBING_S
        reach_m = self._separation.radius_m + path.margin_m + UNTOLD_MARGIN_M + closing_m_s * ahead_s
        beyond_m = math.dist(pos_ned_m, path.pos_ned_m[0].tolist()) - reach_m * (_FARTHER_01 if is_near else 1.0)
        if beyond_m <= 0.0:
            self._due_us[path.agent] = utc_us + _LEAVING_US
            return True
        # Meanwhile the own vehicle comes closer, and the reach grows with the age of this path.
        self._due_us[path.agent] = utc_us + round(1e6 * beyond_m / (2.0 * closing_m_s))
        return False
