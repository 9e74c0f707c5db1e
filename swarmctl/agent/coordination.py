"""An agent's part in guaranteed separation: hears intents, runs `control.commit`, and says its own intent."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, replace

import numpy as np

from swarmctl.agent.world_model import WorldModel
from swarmctl.bus import topics
from swarmctl.bus.peers import Bus, agent_name
from swarmctl.bus.trajectory_messages import PeerIntents, encode_intent
from swarmctl.control.collision.separation import KeepOut, SeparationParams
from swarmctl.control.commit.protocol import CommitCounts, Commitments
from swarmctl.control.commit.trajectory_planner import CommitParams, Situation, Wish, promised_m
from swarmctl.control.mpc.swarm_mpc import MpcParams
from swarmctl.core.trajectory import Times
from swarmctl.core.trajectory_message import Intent
from swarmctl.core.types import Array, Phase, VehicleState

_DEAD_US = 100_000  # of a token's absence
_SETTLED_US = 2_000_000  # of our own presence, after which absences count


class Coordination:
    """See the module.

    Args:
        agent, boot_id: who speaks.
        peers: the others.
        params, mpc, separation, max_keep_outs, stopwatch_ns: see `Commitments`.
        world_model: who else is there.
        bus: is drained by `listen`.
        rate_hz: of every agent's ticks.
        note: is told `broken_promise` when a peer's promise contradicts ours; `off_promise` when what is flown leaves
            what is promised by more than half of what is promised beyond touching bodies, and when it is back; and
            `promises` with all counts when somebody else takes over.
    """

    def __init__(
        self,
        agent: int,
        boot_id: int,
        peers: list[int],
        params: CommitParams,
        mpc: MpcParams,
        separation: SeparationParams,
        max_keep_outs: int,
        world_model: WorldModel,
        bus: Bus,
        note: Callable[..., None],
        stopwatch_ns: Callable[[], int],
        rate_hz: float,
    ) -> None:
        self._agent, self._boot_id, self._bus, self._world_model = agent, boot_id, bus, world_model
        self._commitments = Commitments(agent, params, mpc, separation, max_keep_outs, stopwatch_ns)
        refusals, attendance = world_model.refusals, world_model.attendance
        self._intents, self._peers = PeerIntents(peers, rate_hz, refusals, attendance), frozenset(peers)
        self._note, self._seq, self._separation = note, 0, separation
        self._promised = False
        self._allowed_m = separation.tracking_m + 0.5 * (promised_m(separation) - separation.body_m)
        self._is_off, self._worst_m = False, 0.0
        self._absent_since_us: dict[int, int] = {}
        self._on_bus_since_us: int | None = None
        self._broken: set[int] = set()
        self.left_behind: list[KeepOut] = []  # where the gone have promised to end: perhaps they do

    @property
    def counts(self) -> CommitCounts:
        return self._commitments.counts

    def listen(self, utc_us: int) -> None:
        """Rule 1."""
        for sender, payload in self._bus.receive(topics.INTENT):
            self._intents.offer(sender, payload, utc_us)

    def step(self, utc_us: int, state: VehicleState, phase: Phase, wish: Wish) -> None:
        """Rules 2 to 4, while this agent flies and would like to follow a wish."""
        commitments = self._commitments
        if not self._promised:
            self._promised = True
            commitments.begin(state.pos_ned_m, state.vel_ned_m_s, utc_us)
        known, living = self._intents.newest, self._living(utc_us)
        commitments.hear(utc_us, known, living)
        broken = commitments.broken(utc_us, known)
        if broken != self._broken:
            self._broken = broken
            self._note("broken_promise", by=sorted(broken))
        astray = self._world_model.astray(known, utc_us, self._allowed_m)
        gone = self._absent_since_us.keys()  # perhaps dead: no longer trusted, still asked
        self.left_behind = [k for a in known.keys() - living if known[a].promised for k in self._ends(known[a])]
        taking_part = {a for a in living - gone - broken - astray if a in known and known[a].promised}
        self._world_model.promised = {agent: known[agent].followed for agent in taking_part}
        partners = {agent: known[agent] for agent in taking_part}
        others = self._others(utc_us, state, phase, taking_part)
        commitments.avoid(Situation(utc_us, utc_us, wish, partners, others))
        if commitments.is_due(utc_us):
            begin_us = utc_us + commitments.lead_us
            others = self._others(begin_us, state, phase, taking_part)
            commitments.propose(Situation(utc_us, begin_us, wish, known, others))
        self._watch(float(np.linalg.norm(state.pos_ned_m - self.follow(np.array([utc_us]))[0][0])))

    def idle(self, utc_us: int, state: VehicleState | None) -> None:
        """Somebody else flies, or nobody knows: nothing is promised, but peers are still acknowledged."""
        if self._promised:
            self._promised = False
            self._world_model.promised, self.left_behind = {}, []
            self._note("promises", **asdict(self.counts), worst_tracking_m=self._worst_m)
        self._commitments.end(None if state is None else state.pos_ned_m, utc_us)

    def follow(self, t_utc_us: Times) -> tuple[Array, Array]:
        """Committed positions and velocities (M, 3) at times (M,)."""
        assert self._commitments.committed is not None
        return self._commitments.committed.sample(t_utc_us)

    def say(self, utc_us: int) -> None:
        """Rule 5."""
        if self._commitments.committed is None:
            return
        self._seq += 1
        intent = Intent(
            self._agent,
            self._boot_id,
            self._seq,
            utc_us,
            self._promised,
            self._commitments.committed,
            self._commitments.proposal,
            self._intents.heard(),
        )
        self._bus.publish(topics.INTENT, encode_intent(intent))

    def _watch(self, error_m: float) -> None:
        self._worst_m = max(self._worst_m, error_m)
        if (error_m > self._allowed_m) != self._is_off:
            self._is_off = not self._is_off
            self._note("off_promise", begins=self._is_off, error_m=error_m, allowed_m=self._allowed_m)

    def _living(self, utc_us: int) -> frozenset[int]:
        """Peers that promise and whose acknowledgement counts.

        A peer is dead when it has been off the bus for some ticks while we have been on it for seconds: tokens vanish
        and come back one by one when a router is lost, and two that took each other for dead would both promise.
        """
        alive = self._bus.alive()
        promising = frozenset(agent for agent in self._peers if self._world_model.promises(agent))
        if agent_name(self._agent) not in alive:
            self._on_bus_since_us = None
            self._absent_since_us.clear()
            return promising
        if self._on_bus_since_us is None:
            self._on_bus_since_us = utc_us
        absent = {agent for agent in self._peers if agent_name(agent) not in alive}
        self._absent_since_us = {agent: self._absent_since_us.get(agent, utc_us) for agent in absent}
        if utc_us - self._on_bus_since_us < _SETTLED_US:
            return promising
        return promising - {a for a, since_us in self._absent_since_us.items() if utc_us - since_us >= _DEAD_US}

    def _ends(self, intent: Intent) -> list[KeepOut]:
        p = self._separation
        ends = [np.tile(trajectory.pos_ned_m[-1], (2, 1)) for trajectory in intent.followed]
        return [KeepOut(end, p.planned_m, promised_m(p), False, intent.agent, p.downwash) for end in ends]

    def _others(self, t0_utc_us: int, state: VehicleState, phase: Phase, taking_part: set[int]) -> list[KeepOut]:
        """Who takes no part, and obstacles, on the planner's grid from a time on.

        Nobody can tell what the silent do: they are kept clear of with all of the margin that grows with age.
        """
        steps, dt_us = self._commitments.steps, self._commitments.dt_us
        found = self._world_model.keep_outs(state.pos_ned_m, t0_utc_us, dt_us, steps, phase, taking_part)
        spent_m = self._separation.tracking_m + self._separation.certify_slack_m  # of what plans keep, until refused
        return [replace(k, certified_m=max(k.certified_m, k.radius_m - spent_m)) for k in found]
