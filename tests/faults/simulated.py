"""Rows flown in lockstep: protocol, control and link faults, on true states, the same bit for bit every time."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

import swarmctl
from sitl.flight_log import write_events
from sitl.lockstep import Lockstep
from swarmctl.agent.agent import Agent
from swarmctl.config import Config, dump, load
from swarmctl.core.clock import ClockError
from swarmctl.core.closest_pair import closest_pair_m
from swarmctl.core.types import FlightMode, Landed, Mode, Phase
from swarmctl.simulator_config import FaultParams
from swarmctl.telemetry.recording import run_folder
from tests.closed_loop.conftest import COARSE, ROOT, mission_t_s
from tests.faults.row import Off, Played, Row, require

AIR = "sitl.start=air"
ALONE = (*COARSE, AIR, "swarm.agents=1", "mission.duration_s=60")
SWAP = (  # they meet three seconds after the mission has begun
    *COARSE,
    AIR,
    "swarm.agents=4",
    "start.positions_ned_m=[[3,0,0],[0,3,0],[-3,0,0],[0,-3,0]]",
    "mission.kind=swap",
    "mission.swap.travel_s=6",
    "mission.duration_s=60",
)
GUARANTEED = (*SWAP, "separation.mode=guaranteed")
VICTIM = 1
_FASTEST_M_S = 8.0  # nobody flies away
_LIMIT_S = 150.0
_UNFINISHED = "did not finish"  # the scene ends before the mission


@dataclass(kw_only=True)
class Scene:
    """A flight in lockstep, and what has been seen of it since the event."""

    lockstep: Lockstep
    began_us: int | None = None  # when the event happened
    modes: dict[int, set[Mode]] = field(default_factory=dict)
    apart_m: float = np.inf
    notes: dict[Any, Any] = field(default_factory=dict)  # what an event leaves for its claims
    each_tick: list[Callable[[Scene], None]] = field(default_factory=list)  # what an event goes on to do

    @property
    def config(self) -> Config:
        return self.lockstep.config

    @property
    def since_s(self) -> float:
        """Time since the event [s], negative before."""
        return -1.0 if self.began_us is None else (self.lockstep.clock.now_us() - self.began_us) * 1e-6

    @property
    def mission_s(self) -> float:
        return mission_t_s(self.lockstep)

    @property
    def agents(self) -> list[int]:
        """Numbers of the agents whose processes run."""
        return [i for i, agent in enumerate(self.lockstep.agents) if agent is not None]

    def agent(self, i: int) -> Agent:
        agent = self.lockstep.agents[i]
        assert agent is not None
        return agent

    def tick(self, i: int) -> Any:
        """Newest recorded tick of an agent."""
        return self.lockstep.logs[i].rows[-1][0]

    def phase(self, i: int) -> Phase:
        rows = self.lockstep.logs[i].rows
        return Phase(int(rows[-1]["phase"][0])) if rows else Phase.CONNECT

    def true(self, i: int) -> Any:
        """True state of a vehicle."""
        return self.lockstep.world.truth_rows()[i]

    def stands(self, i: int) -> bool:
        """Whether a vehicle is on the ground and disarmed."""
        vehicle = self.true(i)
        return bool(vehicle["landed"] == Landed.ON_GROUND and not vehicle["armed"])

    def speed_m_s(self, i: int) -> float:
        return float(np.linalg.norm(self.true(i)["vel_ned_m_s"]))

    def flight_mode(self, i: int) -> FlightMode:
        return FlightMode(int(self.true(i)["flight_mode"]))

    def events(self, i: int, name: str) -> list[dict[str, Any]]:
        """Events of an agent since the event of the row."""
        began_us = self.began_us or 0
        return [e for e in self.lockstep.logs[i].events if e["event"] == name and e["t_us"] >= began_us]

    def alert(self, i: int) -> str:
        alert = self.agent(i)._publisher.active_alert
        return "" if alert is None else alert.text

    def fault(self, kind: str, vehicle: int = VICTIM, **fields: Any) -> None:
        """Begin a fault of the simulator, as `swarmctl fault` does."""
        fault = FaultParams.model_validate({"kind": kind, "vehicle": vehicle, **fields})
        self.lockstep.world.faults.begin(fault, self.lockstep.world.since_boot_us)

    def waits(self, i: int) -> bool:
        """Whether an agent rests because it does not hear a peer."""
        return self.agent(i)._mission.interruptions.paused

    def all_arrived(self) -> bool:
        """Whether every vehicle rests opposite of where it began."""
        pos = self.lockstep.world.truth_rows()["pos_ned_m"]
        goals = -np.array(self.config.starts_ned_m())
        return all(np.linalg.norm((pos[i] - goals[i])[:2]) < 0.4 and self.speed_m_s(i) < 0.3 for i in self.agents)


Happens = Callable[[Scene], None]
Holds = Callable[[Scene], bool]


def tracking(t_s: float) -> Holds:
    """Return whether the mission has gone on for so long."""
    return lambda scene: scene.mission_s >= t_s


def entered(phase: Phase, agent: int = VICTIM) -> Holds:
    """Return whether an agent is in a phase, or a later one."""
    return lambda scene: scene.phase(agent) >= phase


_AMID_THE_WAY = tracking(1.5)


@dataclass(frozen=True, kw_only=True)
class SimulatedRow(Row):
    """A row flown in lockstep.

    In every one, by true states: two vehicles never come closer than `apart_m`, none is faster than 8 m/s, none that
    was disarmed is armed again, and none that has left the mode that follows setpoints returns to it by itself. The run
    folder can be read, and its summary tells the violations `told`, perhaps those that `may_be_told`, and no others.

    Attributes:
        config: file of `configs/` that is flown; None: the defaults.
        scene: settings of the flight beside it; `clocks` are of agents with a clock of their own.
        due: when the event happens.
        happens: the event.
        reacts: whether the reaction is there.
        lasts_s: how long the flight is watched after the event.
        always, finally_: what else must hold, in every tick after the event and at the end, by the words of its
            failure.
        regains: setpoints are followed again after they were not.
    """

    config: str | None = None
    scene: tuple[str, ...] = SWAP
    clocks: tuple[int, ...] = ()
    due: Holds = _AMID_THE_WAY
    happens: Happens
    reacts: Holds
    lasts_s: float
    always: Mapping[str, Holds] = field(default_factory=dict)
    finally_: Mapping[str, Holds] = field(default_factory=dict)
    told: tuple[str, ...] = ()  # patterns
    may_be_told: tuple[str, ...] = ()
    apart_m: float = 0.8
    fastest_m_s: float = _FASTEST_M_S
    regains: bool = False
    off: Off

    def play(self, folder: Path, *, protected: bool = True) -> Played:
        with nullcontext() if protected else self.off.applied():
            path = None if self.config is None else ROOT / "configs" / self.config
            config = load(path, (*self.scene, *(() if protected else self.off.settings)))
            folder.mkdir(parents=True)
            clocks = {agent: ClockError() for agent in self.clocks}
            scene = Scene(lockstep=Lockstep(config, folder, clocks=clocks))
            reacted_s = self._fly(scene)
            self._judge_folder(scene, folder)
        return Played(reacted_s=reacted_s, apart_m=scene.apart_m if np.isfinite(scene.apart_m) else None)

    def _fly(self, scene: Scene) -> float:
        watch = _Watch(self)
        reacted_s: float | None = None
        while scene.since_s < self.lasts_s:
            require(scene.lockstep.clock.now_us() < _LIMIT_S * 1e6, f"{self.name}: the event was never due")
            scene.lockstep.step()
            if scene.began_us is None and self.due(scene):
                scene.began_us = scene.lockstep.clock.now_us()
                self.happens(scene)
            for act in scene.each_tick:
                act(scene)
            watch.see(scene)
            if scene.began_us is not None and reacted_s is None and self.reacts(scene):
                reacted_s = scene.since_s
            late = reacted_s is None and scene.since_s > self.within_s
            require(not late, f"not within {self.within_s:g} s: {self.reaction}")
        require(reacted_s is not None, f"not before the end: {self.reaction}")
        for what, holds in self.finally_.items():
            require(holds(scene), what)
        assert reacted_s is not None
        return reacted_s

    def _judge_folder(self, scene: Scene, folder: Path) -> None:
        """Finish the run folder as `simulate` does, and read it as a script does."""
        lockstep, config = scene.lockstep, scene.config
        (folder / "config.toml").write_text(dump(config), encoding="utf-8")
        for log in lockstep.logs:
            log.close()
        (folder / "truth.bin").write_bytes(lockstep.truth.tobytes())
        write_events(folder / "sitl.events.jsonl", lockstep.fault_events)
        problems = tuple(problem for problem in lockstep.problems() if _UNFINISHED not in problem)
        outcome = run_folder.Outcome(
            outcome="failed" if problems else "interrupted", problems=problems, speed_factor=1.0
        )
        with patch.object(run_folder, "write_report"):  # half of the time, and the matter of other tests
            rules = replace(config.rules("lockstep"), required_separation_m=self.apart_m)
            run_folder.finish_run(folder, rules, outcome, lockstep.recorded())
        run = swarmctl.load_run(folder)
        require(len(run.agents) == config.swarm.agents, f"the run folder holds the ticks of agents {run.agents}")
        violations = run.violations
        for pattern in self.told:
            require(any(re.search(pattern, line) for line in violations), f"the run does not tell: {pattern}")
        known = (*self.told, *self.may_be_told)
        unexpected = [line for line in violations if not any(re.search(pattern, line) for pattern in known)]
        require(not unexpected, f"the run tells: {unexpected}")


class _Watch:
    """What holds in every row, on true states."""

    def __init__(self, row: SimulatedRow) -> None:
        self._row = row
        self._armed: set[int] = set()  # at any time since the event
        self._disarmed: set[int] = set()  # after that
        self._left: set[int] = set()

    def see(self, scene: Scene) -> None:
        truth = scene.lockstep.world.truth_rows()
        if len(truth) > 1:
            apart_m = float(closest_pair_m(truth["pos_ned_m"][np.newaxis])[0])
            scene.apart_m = min(scene.apart_m, apart_m)
            require(apart_m >= self._row.apart_m, f"two vehicles came to {apart_m:.2f} m, {scene.since_s:.1f} s after")
        if scene.began_us is None:
            return
        for i, state in enumerate(truth):
            self._see_vehicle(i, state, scene)
        for i in scene.agents:
            scene.modes.setdefault(i, set()).add(Mode(int(scene.tick(i)["mode"])))
        for what, holds in self._row.always.items():
            require(holds(scene), f"{what}, {scene.since_s:.1f} s after")

    def _see_vehicle(self, i: int, state: Any, scene: Scene) -> None:
        speed_m_s = float(np.linalg.norm(state["vel_ned_m_s"]))
        require(speed_m_s < self._row.fastest_m_s, f"vehicle {i} flies away at {speed_m_s:.1f} m/s")
        if not state["armed"]:
            self._disarmed |= {i} & self._armed
            return
        self._armed.add(i)
        require(i not in self._disarmed or scene.phase(i) <= Phase.ARM, f"vehicle {i} was armed again")
        if state["flight_mode"] != FlightMode.EXTERNAL:
            self._left |= {i} if scene.phase(i) > Phase.GOTO_START else set()
        else:
            require(i not in self._left or self._row.regains, f"vehicle {i} follows setpoints again, which it had left")
