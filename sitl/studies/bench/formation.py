"""One real agent, with its vehicle and MAVLink bytes, among neighbours that are only paths on the bus.

Neighbours keep their places in a formation that moves and turns with the shared circle, and sway a little. Each
publishes a predicted path every tick, as an agent would. The agent has the rearmost place and is drawn to the middle,
so that it is pressed against the neighbours before it. Nothing depends on wall time.
"""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sitl.world import SitlWorld
from swarmctl.agent.assembly import make_agent
from swarmctl.bus import topics
from swarmctl.bus.bus import agent_name
from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.messages.json_messages import StatusMessage, encode_message, first_list
from swarmctl.bus.messages.path_messages import encode_path
from swarmctl.bus.traffic import CountedBus
from swarmctl.config import Config, load
from swarmctl.core.clock import SimClock
from swarmctl.core.recorded.tick_record import TickRecord, TickTiming
from swarmctl.core.types import Array, Phase, Plan, PlanStatus, PredictedPath
from swarmctl.mavlink.transport import pipe_pair

SPACING_M = 1.0  # distance of places; 0.9 m is kept
RADIUS_M, OMEGA_RAD_S, HEIGHT_M = 5.0, 0.5, 1.0  # of the circle, thesis 4.3 without the climb
_PILLAR_KEEP_OUT_M = 5.2  # keep-out of an obstacle that fills the circle: always in sight, always active
_SWAY_M = 0.03
_SWAY_HZ = (0.2, 0.5)
_SWAY = 1  # purpose of the random stream
_STATUS_EVERY_US = 200_000
_OBSTACLES_EVERY_US = 1_000_000
_ENDLESS_S = 3600.0


def places_m(count: int) -> Array:
    """Return `count` places (count, 2) of a triangular lattice round its centre: outward and along the circle.

    The rearmost comes first.
    """
    reach = range(-8, 9)
    lattice = [(SPACING_M * 0.5 * math.sqrt(3.0) * i, SPACING_M * (j + 0.5 * (i % 2))) for i in reach for j in reach]
    near = np.array(sorted(lattice, key=lambda p: (round(math.hypot(*p), 6), p))[:count])
    near = near - near.mean(axis=0)
    return np.asarray(near[np.argsort(near[:, 1], kind="stable")])


def column_m(count: int) -> Array:
    """Return `count` places (count, 2) one behind the other along the rim of the pillar, the rearmost first."""
    along = SPACING_M * (np.arange(count) - 0.5 * (count - 1))
    return np.stack([np.full(count, _PILLAR_KEEP_OUT_M + 0.05 - RADIUS_M), along], axis=1)


class Neighbours:
    """Positions of the neighbours: `places` (K, 2) about the reference, turned with it, swaying."""

    def __init__(self, places: Array, seed: int) -> None:
        rng = np.random.default_rng([seed, len(places), _SWAY])
        self._places_m = places
        self._rate_rad_s = 2.0 * math.pi * rng.uniform(*_SWAY_HZ, size=(len(places), 2))
        self._phase_rad = rng.uniform(0.0, 2.0 * math.pi, size=(len(places), 2))

    def positions_ned_m(self, t_s: Array) -> Array:
        """Return (K, T, 3) at mission times `t_s` (T,); at rest and without sway before 0."""
        t_s = np.maximum(t_s, 0.0)
        sway = _SWAY_M * np.sin(self._rate_rad_s[:, None] * t_s[:, None] + self._phase_rad[:, None])
        sway -= _SWAY_M * np.sin(self._phase_rad)[:, None]
        return turned_ned_m(self._places_m[:, None] + sway, t_s)


def turned_ned_m(places: Array, t_s: Array) -> Array:
    """Return places (K, T, 2), outward and along the circle, as (K, T, 3) NED about the reference at `t_s` (T,)."""
    angle = OMEGA_RAD_S * t_s
    out, along = np.stack([np.cos(angle), np.sin(angle)], 1), np.stack([-np.sin(angle), np.cos(angle)], 1)  # (T, 2)
    flat = (RADIUS_M + places[:, :, :1]) * out + places[:, :, 1:] * along
    return np.concatenate([flat, np.full((*flat.shape[:2], 1), -HEIGHT_M)], axis=2)


def formation_config(solver: str, neighbours: int, pillar: bool) -> Config:
    """Return the thesis' circle for one agent and `neighbours` others, each of which gets rows in the problem."""
    places = column_m(neighbours + 1) if pillar else places_m(neighbours + 1)
    starts = turned_ned_m(places[:, None], np.zeros(1))[:, 0]
    overrides = [
        f"swarm.agents={neighbours + 1}",
        f"start.positions_ned_m={starts.tolist()}",
        f"mission.duration_s={_ENDLESS_S}",
        f"mission.circle={{center_ned_m=[0.0,0.0,{-HEIGHT_M}],climb_ned_m_s=0.0}}",
        f"separation.max_neighbours={max(1, neighbours)}",
        f"controller.mpc.qp.solver='{solver}'",
        "sitl.start='air'",
    ]
    if pillar:
        keep_out = f"radius_m={_PILLAR_KEEP_OUT_M - 0.5},keep_out_m={_PILLAR_KEEP_OUT_M}"
        overrides.append(f"obstacles=[{{center_ned_m=[0.0,0.0,{-HEIGHT_M}],{keep_out},visibility_m=100.0}}]")
    return load(None, overrides)


class _Nowhere:
    """A recorder that keeps nothing."""

    def tick(self, row: NDArray[np.void], flown: Plan | None) -> None:
        return

    def received(self, rows: bytes) -> None:
        return

    def event(self, name: str, t_us: int, utc_us: int, **fields: Any) -> None:
        return


class Formation:
    """Steps the agent (number 0), its vehicle and its neighbours."""

    def __init__(self, config: Config) -> None:
        self.clock = SimClock()
        self._config = config
        self._newest: TickRecord | None = None
        self._tick_us = round(1e6 / config.agent.rate_hz)
        self._physics_us = round(1e6 / config.sitl.physics_hz)
        near, far = pipe_pair(self.clock.now_us, 0)
        swarm = config.simulator()
        alone = swarm.model_copy(update={"vehicles": 1, "spawn_ned_m": swarm.spawn_ned_m[:1]})
        self._world = SitlWorld(alone, [far])
        hub = LocalHub(self.clock.now_us, config.seed)
        count = config.swarm.agents - 1
        places = column_m(count + 1) if config.obstacles else places_m(count + 1)
        self.neighbours = Neighbours(places[1:], config.seed)
        self._buses = [hub.connect(agent_name(i + 1), {}) for i in range(count)]
        self._operator = hub.connect(topics.OPERATOR, {})
        self._seq = 0
        self.agent = make_agent(
            config,
            0,
            1,
            near,
            bus=CountedBus(hub.connect(agent_name(0))),
            clock=self.clock,
            sink=_Nowhere(),
            on_frame=lambda frame: None,
            stopwatch_ns=time.perf_counter_ns,
        )

    @property
    def mission_t_s(self) -> float:
        """Mission time of the newest tick; -1 before the mission."""
        record = self._newest
        return -1.0 if record is None or not math.isfinite(record.mission_t_s) else record.mission_t_s

    @property
    def timing(self) -> TickTiming:
        """Timing of the newest tick."""
        return self.agent.timing

    @property
    def record(self) -> TickRecord:
        """Record of the newest tick."""
        assert self._newest is not None
        return self._newest

    @property
    def planned(self) -> bool:
        """Whether the newest tick had a plan that may be flown."""
        plan = self.record.plan
        return plan is not None and plan.status is PlanStatus.OK

    def step(self) -> None:
        """Publish the neighbours' messages, tick the agent, and step the physics to the next tick."""
        self._speak()
        self._newest = self.agent.tick(self.clock.now_us(), 0)
        for _ in range(self._tick_us // self._physics_us):
            self.clock.advance(self._physics_us)
            self._world.step(self.clock.now_us())

    def _speak(self) -> None:
        now_us, utc_us = self.clock.now_us(), self.clock.utc_us()
        delay_us, dt_us = round(self._config.vehicle_model.delay_s * 1e6), round(self._config.controller.mpc.dt_s * 1e6)
        steps = self._config.controller.mpc.horizon_xy
        began_s = self.mission_t_s + self._tick_us * 1e-6 if self.mission_t_s >= 0.0 else -1.0
        ahead_s = 1e-6 * np.arange(delay_us, delay_us + (steps + 1) * dt_us, dt_us, dtype=np.float64)
        paths = self.neighbours.positions_ned_m(ahead_s + began_s if began_s >= 0.0 else 0.0 * ahead_s)
        self._seq += 1
        for i, (bus, path) in enumerate(zip(self._buses, paths, strict=True)):
            message = PredictedPath(
                agent=i + 1,
                boot_id=1,
                seq=self._seq,
                t0_utc_us=utc_us + delay_us,
                dt_us=dt_us,
                margin_m=0.0,
                pos_ned_m=path,
            )
            bus.publish(topics.PATH, encode_path(message, compact=self._config.agent.path_sharing.compact))
            if now_us % _STATUS_EVERY_US == 0:
                bus.publish(topics.STATUS, encode_message(self._status(i + 1, began_s >= 0.0, utc_us)))
        if now_us % _OBSTACLES_EVERY_US == 0:
            self._operator.publish(
                topics.OBSTACLES,
                encode_message(first_list(self._config.obstacles, utc_us)),
            )

    def _status(self, agent: int, tracking: bool, utc_us: int) -> StatusMessage:
        phase = Phase.TRACK if tracking else Phase.READY
        return StatusMessage(
            agent=agent,
            boot_id=1,
            sysid=agent + 1,
            phase=int(phase),
            mode=2,
            flight_mode=7,
            armed=True,
            landed=2,
            held=False,
            control="TRACKING",
            altitude_m=5.0,
            ground_speed_m_s=1.5,
            battery_01=0.75,
            pos_accuracy_m=0.25,
            gps_fix=3,
            satellites=10,
            link_age_ms=8.5,
            ready_utc_us=1,
            mission_t_s=-1.0,
            ends_in_s=-1.0,
            outcome="",
            position_error_m=0.0,
            separation_m=0.0,
            tick_p99_ms=0.0,
            ticks=self._seq,
            deadline_misses=0,
            plan_staleness_ms=0.0,
            solver_failed=0,
            active_alert="",
            alert_age_s=2.5,
            uses_commitments=False,
            utc_us=utc_us,
        )
