"""One agent's part in commitments, and a peer that is only its messages, on a simulated clock."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from swarmctl.agent.planning.coordination import Coordination
from swarmctl.agent.sensing.world_model import WorldModel
from swarmctl.bus import topics
from swarmctl.bus.bus import agent_name
from swarmctl.bus.local.hub import LocalBus, LocalHub
from swarmctl.bus.messages.commitment_messages import decode_trajectory_message, encode_trajectory_message
from swarmctl.bus.messages.path_messages import encode_path
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.commit.commit_params import CommitParams
from swarmctl.control.commit.reach import FarPeers
from swarmctl.control.commit.situation import DesiredReference
from swarmctl.control.commit.trajectory_planner import TrajectoryPlanner
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.mpc.mpc_params import MpcParams
from swarmctl.core.clock import SimClock
from swarmctl.core.trajectory import resting
from swarmctl.core.trajectory_message import ANYWHERE, Exclusions, Proposal
from swarmctl.core.types import Array, Phase, VehicleState
from tests import builders

PEER = agent_name(1)
RATE_HZ = 50.0
SPEED_M_S, STRETCH_M = 2.0, 6.0
HERE = np.array([0.0, 0.0, -2.0])
PLACE = np.array([3.0, 0.0, -2.0])  # of the peer


class Bench:
    """One agent, and a peer that is only its messages; others of which nothing is heard may belong to the swarm."""

    def __init__(self, far_hz: float = 0.0, peers: Sequence[int] = (1,), rate_hz: float = RATE_HZ) -> None:
        self.tick_us = round(1e6 / rate_hz)
        self.clock, self.told = SimClock(), list[tuple[str, dict[str, Any]]]()
        self.hub = LocalHub(self.clock.now_us, 1)
        self.bus = self.hub.connect(agent_name(0))
        self.peer: LocalBus = self.hub.connect(PEER)
        self.alive = {agent_name(0), PEER}
        self.bus.alive = lambda: frozenset(self.alive)  # type: ignore[method-assign]
        separation, vehicle = SeparationParams(), VehicleModelParams()
        params = CommitParams().for_vehicle(vehicle)
        self.world_model = WorldModel(
            0,
            [*peers],
            separation,
            self.bus,
            utc_us=self.clock.utc_us,
            rate_hz=rate_hz,
            path_s=1.0 / rate_hz,
            note=lambda *_, **__: None,
            vouchers={},
            quorum=1,
            model=vehicle,
        )
        self.coordination = Coordination(
            agent=0,
            boot_id=1,
            peers=[*peers],
            params=params,
            planner=TrajectoryPlanner(
                0, params, MpcParams(), vehicle, separation, max_keep_outs=2, stopwatch_ns=lambda: 0
            ),
            separation=separation,
            world_model=self.world_model,
            bus=self.bus,
            utc_us=self.clock.utc_us,
            note=lambda name, **fields: self.told.append((name, fields)),
            rate_hz=rate_hz,
            far_peers=FarPeers(
                peers,
                speed_m_s=SPEED_M_S if far_hz else 0.0,
                stretch_m=STRETCH_M,
                apart_m=1.0,
                ahead_us=self.world_model.clocks.ahead_us,
            ),
            far_hz=far_hz,
        )
        self.seq = 0
        self.answers = True
        self.proposes, self.exclusions = False, Exclusions()  # of the peer
        self.acknowledged: Mapping[int, int] = {}  # by the agent, in the newest message that the peer has read
        self.tube_m, self.ahead_us = 0.16, 0  # of the peer: its tube, and its clock, by which it stamps what it hears
        self.heard: dict[int, tuple[int, int]] = {}  # by the peer
        self.place, self.reach = PLACE, ANYWHERE  # of the peer
        self.blown_m = np.zeros(3)  # off the place where the agent hovers

    @property
    def state(self) -> VehicleState:
        """Hovers here."""
        north = np.array([1.0, 0.0, 0.0, 0.0])
        still, now_us = np.zeros(3), self.clock.now_us()
        return builders.vehicle_state(
            t_us=now_us, pos_ned_m=HERE + self.blown_m, vel_ned_m_s=still, q_nb=north, rate_frd_rad_s=still
        )

    def fly(self, seconds: float, each: Callable[[], None] = lambda: None) -> None:
        for _ in range(round(seconds * 1e6 / self.tick_us)):
            self.clock.advance(self.tick_us)
            each()
            utc_us = self.clock.utc_us()
            self.world_model.receive(utc_us)
            self.coordination.receive(utc_us)
            self.coordination.step(
                utc_us,
                self.state,
                Phase.TRACK,
                DesiredReference(self.wanted),
                state_utc_us=utc_us,
                disturbance_ned_m_s2=np.zeros(3),
            )
            self.coordination.publish(utc_us, unsure_m=0.0, relays=True)

    def wanted(self, offsets_s: Array) -> tuple[Array, Array]:
        return np.tile(HERE, (len(offsets_s), 1)), np.zeros((len(offsets_s), 3))

    def send(self, path_at: Array | None = None, silent: bool = False) -> None:
        """The peer is committed to rest at its place, acknowledges, and is at `path_at`."""
        self.seq += 1
        utc_us = self.clock.utc_us()
        acknowledged = {}
        for _, payload in self.peer.receive(topics.TRAJECTORY):
            message = decode_trajectory_message(payload)
            assert message is not None
            self.acknowledged = message.acknowledged
            self.heard = {0: (message.sent_utc_us, utc_us + self.ahead_us)}
            if message.proposal is not None and self.answers:
                acknowledged = {0: message.proposal.number}
        path = builders.predicted_path(
            seq=self.seq,
            t0_utc_us=utc_us,
            dt_us=20_000,
            pos_ned_m=np.tile(self.place if path_at is None else path_at, (41, 1)),
        )
        self.peer.publish(topics.PATH, encode_path(path))
        if not silent:
            committed = resting(self.place, utc_us, 100_000)
            message = builders.trajectory_message(
                seq=self.seq,
                sent_utc_us=utc_us,
                is_committed=self.seq > 1,
                committed=committed,
                tube_m=self.tube_m,
                heard=self.heard,
                proposal=Proposal(number=5, made_utc_us=0, agent=1, trajectory=committed) if self.proposes else None,
                acknowledged=acknowledged,
                exclusions=self.exclusions,
            )
            payload = encode_trajectory_message(replace(message, reach=self.reach))
            self.peer.publish(topics.FAR_TRAJECTORY, payload)
            self.peer.publish(topics.TRAJECTORY, payload)

    @property
    def committed(self) -> int:
        return self.coordination.counts.committed
