"""Interest management: an agent hears every path of peers within reach, and of all others a few per second.

Paths of peers out of reach are used like all others: distances are widened with the age of a path, by what its sender
may have done since. So the subscriptions decide how closely a peer is known, never whether it is kept clear of. What is
within reach is chosen such that no path that is heard late can matter to a plan (`Interest`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from swarmctl.agent.sharing.path_sharing import PathSharingParams
from swarmctl.bus import topics
from swarmctl.bus.bus import Bus, agent_name
from swarmctl.bus.peers import PeerPaths
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.core.types import PredictedPath, VehicleState

_SUBSCRIBING_S = 0.2  # until a subscription is in force, between two computers too
_FARTHER_01 = 1.1  # a peer is left when it is farther away than this times the reach, lest subscriptions flutter


class Interest:
    """Chooses the peers whose every path is heard.

    A peer at the distance d with the speed v_p is within reach of a vehicle with the speed v if

        d <= radius + margin + (v + v_p) T + a T^2,    T = horizon + 1 / far_hz + age + time to subscribe,

    where each may accelerate by a (`separation.age_accel_m_s2`). Beyond, whatever both do until the next path of the
    peer is heard and a subscription is in force, no plan made by then meets the peer within its horizon. A peer that
    has not been heard is within reach.

    Args:
        params: rate of the paths that all hear; 0 leaves all subscriptions as they are.
        separation: distances and accelerations.
        bus: on which paths are heard.
        paths: newest ones of peers.
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
        self.within_reach = self._peers

    def update(self, state: VehicleState | None, utc_us: int) -> None:
        """Hear every path of those that are within reach now.

        Args:
            state: own state; None as long as there is none, when all are within reach.
            utc_us: now.
        """
        if not self._params.far_hz:
            return
        out_of_reach = set[int]()
        if state is not None:
            pos, speed_m_s = state.pos_ned_m.tolist(), math.hypot(*state.vel_ned_m_s.tolist())
            newest = self._paths.latest()
            out_of_reach = {path.agent for path in newest if not self._reaches(pos, speed_m_s, path, utc_us)}
        within_reach = self._peers - out_of_reach
        if within_reach != self.within_reach:
            self.within_reach = within_reach
            self._bus.hear(topics.PATH, [agent_name(peer) for peer in sorted(within_reach)])

    def _reaches(self, pos_ned_m: list[float], speed_m_s: float, path: PredictedPath, utc_us: int) -> bool:
        (first, second), age_s = path.pos_ned_m[:2].tolist(), max(0.0, (utc_us - path.t0_utc_us) * 1e-6)
        ahead_s = self._horizon_s + 1.0 / self._params.far_hz + age_s + _SUBSCRIBING_S
        closing_m_s = speed_m_s + math.dist(first, second) / (path.dt_us * 1e-6)
        reach_m = self._separation.radius_m + path.margin_m + closing_m_s * ahead_s
        reach_m += self._separation.age_accel_m_s2 * ahead_s**2
        if path.agent in self.within_reach:
            reach_m *= _FARTHER_01
        return math.dist(pos_ned_m, first) <= reach_m
