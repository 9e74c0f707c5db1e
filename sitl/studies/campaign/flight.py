"""One trial: a flight in lockstep that ends as soon as its result is known, judged on true states at every tick."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sitl.lockstep import Lockstep
from sitl.lockstep_rates import steps_per_tick
from sitl.studies.campaign.collision_monitor import STILL_M, CollisionMonitor
from sitl.studies.campaign.conditions.disturbances import NONE, disturbed
from sitl.studies.campaign.conditions.factors import NOISES, PROTECTIONS, UNCOOPERATIVE, wind_settings
from sitl.studies.campaign.conditions.layouts import least_sum_m
from sitl.studies.campaign.conditions.scenarios import AIRFRAMES, SCENARIOS, Layout, layout_of, settings_of
from sitl.studies.campaign.source import code_of
from sitl.studies.campaign.trials import Cell, Row, Trial
from swarmctl.config import Config, load
from swarmctl.control.reference.kinds.goto import GotoParams
from swarmctl.core.types import Array, Phase, PlanStatus

PHYSICS_HZ = 100  # thesis and crazyflie behave as at 250 Hz: a 3.3 m transition ends within 2 cm and 0.1 s of it
_BEGIN_WITHIN_S = 60.0  # simulated time after which the mission has failed to begin
_SETTLED_S = 1.0  # time at the goal after which a vehicle has arrived
_REST_S = 2.0  # same goal: time for which all vehicles are slow
_REST_M_S = 0.1
_AFTER_CONTACT_S = 0.5  # flown on, to measure the depth of a contact
_BAD_PLANS = (PlanStatus.SOLVER_FAILED, PlanStatus.RESIDUAL, PlanStatus.NOT_CERTIFIED)


def fly(trial: Trial, own: str = "") -> Row:
    """Fly one trial and return its row, a pure function of the trial except `cpu_s`.

    Args:
        trial: what is flown.
        own: digest of the own modules that fly it, see `sitl.studies.campaign.source`.
    """
    began_s = time.process_time()
    cell = trial.cell
    layout = drawn(cell, trial.seed)
    flight = TrialFlight(trial, layout)
    flight.run()
    alone_s = _alone_s(trial) if SCENARIOS[cell.scenario].alone else None
    return flight.row(alone_s) | {"cpu_s": time.process_time() - began_s, "code": code_of(own)}


def drawn(cell: Cell, seed: int) -> Layout:
    """Return the layout of a trial: the scenario's, with the cell's airframe and under its disturbance.

    Raises:
        ValueError: the cell can't be drawn.
    """
    layout = layout_of(cell.scenario, seed, cell.agents)
    size = AIRFRAMES[cell.airframe]
    return disturbed(layout if size is None else replace(layout, size=size), cell.disturbance, seed)


def config_of(cell: Cell, seed: int, layout: Layout, agents: int, *, extra: Sequence[str] = ()) -> Config:
    """Return the configuration of a trial.

    Raises:
        ConfigError: a setting does not exist, or values don't go together.
    """
    noise = NOISES[cell.noise]
    config = load(
        None,
        [
            "sitl.start=air",
            f"sitl.physics_hz={PHYSICS_HZ}",
            *wind_settings(cell.wind_m_s),  # first: turbulence of a disturbance is that one's
            *settings_of(layout, agents),
            f"name={cell.scenario}",
            f"seed={seed}",
            f"bus.delay_ms={cell.delay_ms}",
            f"bus.loss_01={cell.loss}",
            *noise.settings,
            *PROTECTIONS[cell.protections],
            *cell.sets.split(),
            *extra,
            "separation.allow_small_radius=true",  # until it is widened here
        ],
    )
    steps_per_tick(config)  # refused before anything flies
    needed_m = config.separation.budget.required_m(noise.accuracy_m, config.drift_m)
    radius_m = max(config.separation.radius_m, math.ceil(needed_m * 100.0) / 100.0)
    separation = config.separation.model_copy(update={"radius_m": radius_m, "allow_small_radius": False})
    return config.model_copy(update={"separation": separation})


class TrialFlight:
    """A lockstep flight with a collision monitor."""

    def __init__(self, trial: Trial, layout: Layout) -> None:
        cell, agents = trial.cell, len(layout.starts_ned_m)
        self._trial, self._layout = trial, layout
        config = config_of(cell, trial.seed, layout, agents)
        blind = {i: config_of(cell, trial.seed, layout, agents, extra=UNCOOPERATIVE) for i in layout.uncooperative}
        self.lockstep = Lockstep(config, own=blind, clocks=layout.clocks)
        self._agents = list(self.lockstep.agents)  # including those that will have died
        expected = self._expected()
        arrive_m = math.inf if layout.settles else layout.arrive_m + NOISES[cell.noise].arrive_m
        self.monitor = CollisionMonitor(config.separation.body_m, layout.goals_ned_m, arrive_m, expected)
        self._begin_s = math.nan
        self._resting_since_s = math.inf
        self._contact_s = math.inf
        self._problems: tuple[str, ...] = ()
        self._out_of_time = False

    def run(self) -> None:
        """Fly until all have arrived, two bodies have collided, an agent failed, or the time is up."""
        lockstep = self.lockstep
        offset = lockstep.world.truth_rows()["pos_ned_m"] - lockstep.world.plant.pos_ned_m.T
        while not self._over():
            lockstep.step()
            now_s = lockstep.clock.now_us() * 1e-6
            pos, vel = lockstep.world.plant.pos_ned_m.T + offset, lockstep.world.plant.vel_ned_m_s.T.copy()
            if math.isnan(self._begin_s) and self._tracking():
                self._begin_s = now_s
            t_s = now_s - self._begin_s
            if t_s >= 0.0:
                for event in self._layout.events:
                    event.step(lockstep, t_s, pos, vel)
            appeared = [o for event in self._layout.events for o in event.obstacles(t_s)]
            configured = (o.moved(now_s) for o in lockstep.config.obstacles)  # at their centres as the clock begins
            self.monitor.see(now_s, pos, vel, (*configured, *appeared))
            slow = t_s > _REST_S and np.linalg.norm(vel, axis=1).max() < _REST_M_S
            self._resting_since_s = min(self._resting_since_s, now_s) if slow else math.inf
            if self.monitor.collided:
                self._contact_s = min(self._contact_s, now_s)

    def row(self, alone_s: float | None) -> Row:
        """Return the result as a row."""
        monitor, cell, layout = self.monitor, self._trial.cell, self._layout
        collided = monitor.collided
        arrived = not collided and not self._problems and self._arrived_s() < math.inf
        stuck = self._out_of_time and self._someone_stands_short()
        stopped = not collided and not self._problems and self._out_of_time and self._all_stand_unexpected()
        outcome = "stopped" if stopped else self._outcome(collided, arrived, stuck)
        ticks = [log.ticks for log in self.lockstep.logs]
        charged = [rows[rows["phase"] == Phase.TRACK] for rows in ticks]
        separation = self.lockstep.config.separation
        goal_sum_m = None if layout.goals_ned_m is None else float(monitor.distance_m().sum())
        return {
            "scenario": cell.scenario,
            "agents": cell.agents,
            "delay_ms": cell.delay_ms,
            "loss": cell.loss,
            "seed": self._trial.seed,
            "protections": cell.protections,
            "collided": collided,
            "min_separation_m": _finite(monitor.min_separation_m),
            "arrived": None if stopped else arrived,
            "flight_time_s": self._arrived_s() - self._begin_s if arrived else None,
            "noise": cell.noise,
            "wind_m_s": cell.wind_m_s,
            "airframe": cell.airframe,
            "disturbance": cell.disturbance,
            "sets": cell.sets,
            "deadlocked": stuck and not collided,
            "outcome": outcome,
            "min_clearance_m": _finite(monitor.min_clearance_m),
            "arrived_agents": self._arrived_agents(arrived),
            "unconstrained_time_s": alone_s,
            "goal_sum_m": goal_sum_m,
            "least_sum_m": least_sum_m(cell.agents, separation.radius_m) if layout.settles else None,
            "plans_failed": sum(int(np.isin(rows["plan_status"], _BAD_PLANS).sum()) for rows in charged),
            "commits_refused": self._commits_refused(),
            "safety_filter_acted": sum(int(rows["safety_filter_acted"].sum()) for rows in charged),
            "simulated_s": self.lockstep.clock.now_us() * 1e-6,
        }

    def _over(self) -> bool:
        now_s = self.lockstep.clock.now_us() * 1e-6
        if math.isnan(self._begin_s):
            if now_s >= _BEGIN_WITHIN_S:
                self._problems = ("the mission did not begin",)
            return bool(self._problems)
        if now_s - self._contact_s >= _AFTER_CONTACT_S:
            return True
        self._problems = self._failed()
        self._out_of_time = now_s - self._begin_s >= self._layout.limit_s - 0.1
        settled_s = _REST_S if self._layout.settles else _SETTLED_S
        done = self._layout.goals_ned_m is not None and now_s - self._arrived_s() >= settled_s
        return bool(self._problems) or self._out_of_time or done

    def _arrived_s(self) -> float:
        """Return the time of the last arrival, infinite before. Without goals: the end of the mission."""
        if self._layout.goals_ned_m is None:
            return self._begin_s + self._layout.limit_s if self._out_of_time else math.inf
        return self._resting_since_s if self._layout.settles else self.monitor.arrived_s

    def _arrived_agents(self, arrived: bool) -> int | None:
        if self._layout.goals_ned_m is None or self._layout.settles:
            return self._trial.cell.agents if arrived else None
        return int(self.monitor.arrived.sum())

    def _someone_stands_short(self) -> bool:
        if self._layout.goals_ned_m is None or self._layout.settles:
            return False
        return bool((self.monitor.standing() & ~self.monitor.arrived & self._expected()).any())

    def _all_stand_unexpected(self) -> bool:
        """Return whether nobody is expected at a goal, and everybody stands, as exactly as positions are known."""
        if self._layout.goals_ned_m is None or self._layout.settles or self._expected().any():
            return False
        return bool(self.monitor.standing(STILL_M + NOISES[self._trial.cell.noise].arrive_m).all())

    def _expected(self) -> NDArray[np.bool_]:
        return np.array([i not in self._layout.lost for i in range(self._layout.agents)])

    def _outcome(self, collided: bool, arrived: bool, stuck: bool) -> str:
        if collided:
            return "collided"
        if self._problems:
            return "; ".join(self._problems)
        return "arrived" if arrived else "deadlocked" if stuck else "late"

    def _tracking(self) -> bool:
        rows = [log.rows[-1] for log in self.lockstep.logs]
        return all(int(row["phase"][0]) == Phase.TRACK for row in rows)

    def _failed(self) -> tuple[str, ...]:
        """Return the agents that have left the mission unintentionally."""
        found = []
        for i, (agent, log) in enumerate(zip(self.lockstep.agents, self.lockstep.logs, strict=True)):
            if agent is None or i in self._layout.lost or self._out_of_time:
                continue
            if int(log.rows[-1]["phase"][0]) != Phase.TRACK:
                found.append(f"agent {i}: {agent.outcome}")
        return tuple(found)

    def _commits_refused(self) -> int | None:
        """Return the number of refused commitments; None when no agent commits."""
        counts = [agent.commits_refused for agent in self._agents if agent is not None]
        committing = [count for count in counts if count is not None]
        return sum(committing) if committing else None


def _alone_s(trial: Trial) -> float | None:
    """Return the single-agent flight time of the longest path, without obstacles and without the disturbance.

    A disturbance is drawn for the whole swarm, and may be of vehicles that are not there.
    """
    calm = replace(trial.cell, disturbance=NONE)
    layout = drawn(calm, trial.seed)
    if layout.goals_ned_m is None:
        return None
    far = int(np.linalg.norm(layout.goals_ned_m - layout.starts_ned_m, axis=1).argmax())
    goal: Array = layout.goals_ned_m[far : far + 1]
    speeds = tuple(s for s in layout.settings if not s.startswith(("mission.goto=", "obstacles=")))
    mission = config_of(calm, trial.seed, layout, len(layout.starts_ned_m)).mission
    goto = mission.section(GotoParams)
    lone = replace(
        layout,
        starts_ned_m=layout.starts_ned_m[far : far + 1],
        goals_ned_m=goal,
        settings=(
            *speeds,
            f"mission.goto={{goals_ned_m={goal.tolist()},speed_m_s={goto.speed_m_s},accel_m_s2={goto.accel_m_s2}}}",
        ),
        events=(),
        uncooperative=frozenset(),
        lost=frozenset(),
    )
    flight = TrialFlight(Trial(replace(calm, agents=1, delay_ms=0.0, loss=0.0), trial.seed), lone)
    flight.run()
    found: Any = flight.row(None)["flight_time_s"]
    return None if found is None else float(found)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
