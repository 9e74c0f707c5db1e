"""World model of an agent: peers and obstacles received over the bus, and the keep-outs and bodies that follow."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import replace

from swarmctl.agent.sensing.known_obstacles import KnownObstacles
from swarmctl.agent.sensing.peer_statuses import SILENT_US, PeerStatuses
from swarmctl.bus import topics
from swarmctl.bus.bus import Bus, agent_name
from swarmctl.bus.messages.json_messages import StatusMessage
from swarmctl.bus.messages.path_messages import stamp_us
from swarmctl.bus.orders import Orders
from swarmctl.bus.peers.clocks import PeerClocks
from swarmctl.bus.peers.paths import PeerPaths
from swarmctl.bus.peers.senders import Presence
from swarmctl.bus.refusals import LATE, Refusals
from swarmctl.control.collision.barrier import Body, body_of_obstacle, body_of_peer
from swarmctl.control.collision.keep_outs import KeepOuts
from swarmctl.control.collision.separation import (
    SeparationParams,
    aligned,
    keep_out_along,
    keep_out_of_obstacle,
    not_driving_away_m,
    without_setpoints,
)
from swarmctl.control.model import VehicleModelParams
from swarmctl.core.operator_verbs import Answer, Order
from swarmctl.core.trajectory import Trajectory
from swarmctl.core.types import Array, Phase, PredictedPath

_EXPECTED_TICKS, _EXPECTED_S = 3, 0.16  # after which a path is late, at the least; its peer may fly another one
_BUS_LOST_US = 300_000  # without a path of anybody, of several: they share one at least every 0.25 s


class WorldModel:
    """Keeps the newest paths and statuses of peers, and the obstacles published by the operator.

    Args:
        agent: index of this agent.
        peers: indices of the other agents.
        params: distances and ages.
        bus: source of messages, drained by `receive`.
        utc_us: the own clock, by which messages arrive.
        rate_hz, path_s: tick rate of every agent, and how long its paths are apart at most.
        vouchers: agents of which each sender may say that they have ended.
        quorum: see `AgentSetup`.
        model: of the own vehicle; those of peers are taken for such ones.
        loss_s: how long the own autopilot keeps the attitude without setpoints, and when it brakes if it hears nothing
            at all; None until it has told. Those of peers are taken for such ones, too.
        note: receives the events `refused` (see `Refusals`), `obstacles_changed` with the list as it was received,
            `peer_ended` with the process that has, and `unresponsive`: a peer within reach is on the bus and has
            published no accepted path for `lost_after_s`; also when that ends, with its duration.

    Attributes:
        accepted: paths and statuses of peers that were received last, for the recording.
    """

    def __init__(
        self,
        agent: int,
        peers: list[int],
        params: SeparationParams,
        bus: Bus,
        *,
        utc_us: Callable[[], int],
        rate_hz: float,
        path_s: float,
        note: Callable[..., None],
        vouchers: Mapping[str, Set[int]],
        quorum: int,
        model: VehicleModelParams,
        loss_s: Callable[[], tuple[float | None, float | None]] = lambda: (None, None),
    ) -> None:
        self._agent, self._params, self._bus, self._note = agent, params, bus, note
        self._peers, self._quorum, self._utc_us = peers, quorum, utc_us
        self._model, self._loss_s = model, loss_s
        self._budget = params.budget
        self._expected_us = round(1e6 * max(_EXPECTED_S, path_s + _EXPECTED_TICKS / rate_hz))
        self.refusals, self.presence = Refusals(note), Presence(bus)
        self.clocks = PeerClocks(peers, note, trusts_equal=params.mode == "best_effort")
        self.paths = PeerPaths(peers, rate_hz, self.refusals, self.presence, clocks=self.clocks)
        self.statuses = PeerStatuses(
            agent,
            peers,
            bus,
            rate_hz=rate_hz,
            note=note,
            refusals=self.refusals,
            presence=self.presence,
            clocks=self.clocks,
            vouchers=vouchers,
        )
        self._orders = Orders(agent, self.refusals)
        self._unresponsive_since_us: dict[int, int] = {}
        self.obstacles = KnownObstacles(note)
        self.accepted: list[PredictedPath | StatusMessage] = []

    def receive(self, utc_us: int) -> list[Order]:
        """Process everything that has arrived; returns the operator's orders to this agent."""
        self.presence.update(utc_us)
        self.accepted = []
        for sender, payload in self._received_paths():
            if path := self.paths.offer(sender, payload, utc_us):
                self.accepted.append(path)
        statuses, arrived_us = self._bus.receive(topics.STATUS), self._utc_us()  # in this order: none came later
        for sender, payload in statuses:
            if status := self.statuses.take(sender, payload, arrived_us):
                self.accepted.append(status)
        for sender, payload in self._bus.receive(topics.OBSTACLES):
            if refusal := self.obstacles.take(payload):
                self.refusals.add(sender, topics.OBSTACLES.name, refusal, utc_us)
        orders = [self._orders.take(*received, utc_us) for received in self._bus.receive(topics.COMMAND)]
        for sender, payload in self._bus.receive(topics.ENDED):
            self.statuses.take_end(sender, payload, utc_us)
        self._orders.refuse_misdated(utc_us)
        for sender, topic, reason in self._bus.refused():
            self.refusals.add(sender, topic, reason, utc_us)
            if reason == LATE and topic == topics.STATUS.name:
                self.statuses.take_late(sender, utc_us)
        self.refusals.report(utc_us)
        self._watch_unresponsive(utc_us)
        return [order for order in orders if order is not None]

    def _received_paths(self) -> list[tuple[str, bytes]]:
        """Return the paths that have come on both topics, oldest first for each sender."""
        far, near = self._bus.receive(topics.FAR_PATH), self._bus.receive(topics.PATH)
        return sorted(far + near, key=lambda item: stamp_us(item[1])) if far else near

    def answer(self, order: Order, refusal: str, comes_to: str = "") -> None:
        """Keep the agent's answer to an order: accepted, and what it comes to, or why it is refused."""
        self._orders.answer(order, refusal, comes_to)

    def due_answers(self) -> list[Answer]:
        """Return the answers to operators' orders and their repetitions that are to be sent now."""
        return self._orders.due_answers()

    def _watch_unresponsive(self, utc_us: int) -> None:
        """Report peers that are on the bus but whose paths have not been accepted for too long."""
        oldest_us = utc_us - round(self._params.lost_after_s * 1e6)
        unresponsive = {
            path.agent: path.t0_utc_us
            for path in self.paths.late(oldest_us)
            if self._is_there(path.agent) and not self.statuses.is_done(path.agent)
        }
        if not unresponsive and not self._unresponsive_since_us:
            return
        for agent in unresponsive.keys() - self._unresponsive_since_us.keys():
            self._unresponsive_since_us[agent] = unresponsive[agent]
            self._note("unresponsive", agent=agent, begins=True)
        for agent in self._unresponsive_since_us.keys() - unresponsive.keys():
            lasted_s = (utc_us - self._unresponsive_since_us.pop(agent)) * 1e-6
            self._note("unresponsive", agent=agent, begins=False, lasted_s=lasted_s)

    def _is_there(self, agent: int) -> bool:
        return self.presence.since_us(agent_name(agent)) is not None

    def keep_outs(
        self,
        pos_ned_m: Array,
        t0_utc_us: int,
        dt_us: int,
        steps: int,
        *,
        phase: Phase,
        without: Set[int] = frozenset(),
    ) -> KeepOuts:
        """Return keep-outs of peers within reach and visible obstacles, over `steps` steps of `dt_us` from `t0_utc_us`.

        Args:
            pos_ned_m: own position (3,), which decides which obstacles are visible.
            t0_utc_us: UTC of the first point.
            dt_us, steps: time grid of the plan.
            phase: own phase; in GOTO_LAND peers are kept clear of at every height.
            without: peers to leave out, because their committed trajectories are known.
        """
        params, budget, descends = self._params, self._budget, phase is Phase.GOTO_LAND
        near = (path for path in self.paths.near() if path.agent not in without)
        ways = [(path, number) for known in near for number, path in enumerate(self._ways(known, t0_utc_us))]
        paths = [path for path, _ in ways]
        places = aligned(paths, t0_utc_us, dt_us, steps, brake_m_s2=params.brake_m_s2) if paths else None
        found = [
            keep_out_along(
                path,
                points,
                t0_utc_us,
                params,
                budget,
                parked=self.statuses.is_parked(path.agent),
                landing=descends or self.statuses.is_landing(path.agent),
                here_ned_m=pos_ned_m,
                way=number,
            )
            for (path, number), points in zip(ways, () if places is None else places, strict=True)
        ]
        seen = self.obstacles.see(pos_ned_m, t0_utc_us)
        if not seen:
            return KeepOuts(found, places)
        return KeepOuts(found + [keep_out_of_obstacle(o, dt_us, steps, params, number=n) for n, o in seen.items()])

    def bodies(
        self,
        pos_ned_m: Array,
        act_utc_us: int,
        ahead_s: float,
        margin_m: float,
        *,
        committed_peers: Mapping[int, Sequence[Trajectory]],
    ) -> list[Body]:
        """Return the bodies not to touch `ahead_s` after `act_utc_us`: peers within reach, and visible obstacles.

        A peer that has committed to trajectories is placed on them, however old its message; others on their path.

        Args:
            pos_ned_m: own position (3,), which decides which obstacles are visible.
            act_utc_us: UTC at which the setpoint acts.
            ahead_s: time from then to the instant the bodies are valid for.
            margin_m: distance added to the size of every body.
            committed_peers: trajectories that peers have committed to, by agent number.
        """
        params, budget = self._params, self._budget
        fresh_us = act_utc_us - round(params.lost_after_s * 1e6)
        found, committed_apart_m = list[Body](), budget.barrier_m(margin_m)
        for agent, trajectories in committed_peers.items():
            responsibility_01 = 0.5 if self.statuses.flies_itself(agent) else 1.0
            spread_s = 1e-6 * self.clocks.spread_us(agent)
            for pos, vel in (trajectory.at(act_utc_us + ahead_s * 1e6) for trajectory in trajectories):
                apart_m = committed_apart_m + spread_s * math.hypot(*vel)
                found.append(Body(pos_ned_m=pos, vel_ned_m_s=vel, apart_m=apart_m, responsibility_01=responsibility_01))
        for path in self.paths.near():
            if path.agent in committed_peers:
                continue
            filters = self.statuses.flies_itself(path.agent) and path.t0_utc_us >= fresh_us
            age_s = max(0.0, (act_utc_us - path.t0_utc_us) * 1e-6)
            age_margin_m = budget.age_margin_m(age_s, parked=self.statuses.is_parked(path.agent))
            apart_m = budget.barrier_peer_m(margin_m, path.margin_m, age_margin_m)
            least_m = budget.barrier_peer_m(margin_m, path.margin_m, 0.0)
            for way in self._ways(path, act_utc_us):
                body = body_of_peer(
                    way, act_utc_us, ahead_s, apart_m, filters=filters and way is path, brake_m_s2=params.brake_m_s2
                )
                if age_s > params.lost_after_s:  # plans don't give way to its age either, see `keep_out_along`
                    apart_now_m = math.dist(body.pos_ned_m, pos_ned_m)
                    body = replace(body, apart_m=not_driving_away_m(apart_m, apart_now_m, least_m))
                found.append(body)
        apart_m = budget.barrier_obstacle_m(margin_m)
        seen = self.obstacles.visible(pos_ned_m, act_utc_us)
        return found + [body_of_obstacle(o, ahead_s, apart_m) for o in seen.values()]

    def ways_without_setpoints(self, agents: Set[int], t0_utc_us: int, dt_us: int, steps: int) -> dict[int, Array]:
        """Return positions (steps+1, 3) of vehicles that fly, as if their agents had sent no setpoint since their path.

        Args:
            agents: whose vehicles; of those on the ground, and of those out of reach, there are none.
            t0_utc_us, dt_us, steps: the time grid.
        """
        paths = [p for p in self.paths.near() if p.agent in agents and self.statuses.flies_itself(p.agent)]
        if not paths:
            return {}
        ways, brake_m_s2 = [self._without_setpoints(path) for path in paths], self._params.brake_m_s2
        places = aligned(ways, t0_utc_us, dt_us, steps, brake_m_s2=brake_m_s2)
        return {path.agent: points for path, points in zip(paths, places, strict=True)}

    def _ways(self, path: PredictedPath, utc_us: int) -> tuple[PredictedPath, ...]:
        """Return the paths by which a peer is predicted: its newest, the one without setpoints, or both.

        Where its process has ended, the vehicle gets no setpoint. One that is merely silent may fly on as it planned,
        or have stopped: expected in one way alone, others came to 0.17 m of it in the other. Overloaded agents are
        silent all the time, and what they have planned says more of their next setpoint than the last one: by that,
        six starts came to 0.61 m instead of 0.73 m.
        """
        agent, boot_id = path.agent, self.statuses.boot_id(path.agent)
        if boot_id is None or self.statuses.is_parked(agent):
            return (path,)
        if boot_id == path.boot_id and not self.statuses.flies_itself(agent):
            return (path,)  # as its autopilot or a pilot flies it
        if self.statuses.process_has_ended(agent, path.boot_id):  # whatever a process says that was started after it
            return (self._without_setpoints(path),)
        oldest_us = utc_us - self._expected_us
        if path.t0_utc_us >= oldest_us or all(late.agent != agent for late in self.paths.late(oldest_us)):
            return (path,)
        return path, self._without_setpoints(replace(path, setpoint_accel_ned_m_s2=None))

    def _without_setpoints(self, path: PredictedPath) -> PredictedPath:
        keeps_s, coasts_s = self._loss_s()
        lag_s, drag_1_s = self._model.lag_s, self._model.drag_1_s
        return without_setpoints(path, lag_s=lag_s, drag_1_s=drag_1_s, keeps_s=keeps_s, coasts_s=coasts_s)

    def life_sign(self, agent: int, utc_us: int) -> str:
        """Return what speaks against an operator's word that a peer has ended: it was just heard; or "".

        Of a peer out of reach only paths are heard.
        """
        heard_us = max(self.statuses.heard_us(agent), self.paths.newest_utc_us(agent))
        age_us = max(0, utc_us - heard_us)
        if self.statuses.has_ended(agent) or age_us >= SILENT_US:
            return ""
        return f"{agent_name(agent)} was heard {age_us * 1e-6:.1f} s ago, so it has not ended"

    def others_ned_m(self, utc_us: int) -> tuple[Array, ...]:
        """Return the present position (3,) of each peer by its newest path."""
        paths = self.paths.latest()
        return tuple(aligned(paths, utc_us, 1, 0, brake_m_s2=self._params.brake_m_s2)[:, 0]) if paths else ()

    def has_unresponsive_peer(self, utc_us: int) -> bool:
        """Return whether some peer within reach is silent and not known to be dead: it may fly on, or our bus is lost.

        One may be silent for a while because messages are lost; that several are at once is noticed sooner.
        A peer whose liveliness token has gone while those of a quorum, ours included, are present has died, as far as
        best effort can know; its path has become a keep-out.
        """
        oldest_us = utc_us - round(self._params.lost_after_s * 1e6)
        flying = [p.agent for p in self.paths.near(utc_us - _BUS_LOST_US) if not self.statuses.has_ended(p.agent)]
        everybody = len(flying) > 1 and utc_us - self.paths.heard_utc_us > _BUS_LOST_US
        late = [path.agent for path in self.paths.late(oldest_us) if not self.statuses.has_ended(path.agent)]
        silent = flying if everybody else late
        if not silent:
            return False
        alive = self._bus.alive()
        if agent_name(self._agent) not in alive or any(agent_name(agent) in alive for agent in silent):
            return True
        return 1 + sum(agent_name(agent) in alive for agent in self._peers) < self._quorum
