"""Flights in lockstep and measurements on their true states.

A claim about a flight must also hold for starts shifted by a millimetre, or it depends on one rounding:
`pytest tests/closed_loop --nudged SEED` flies all of them so. Claims found to be sensitive are parametrised.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sitl.lockstep import Lockstep
from sitl.studies.campaign.conditions.layouts import nudged
from swarmctl.config import Config, load
from swarmctl.core.closest_pair import closest_pair_m
from swarmctl.core.types import Mode, Phase
from swarmctl.simulator_config import SimulatorConfig
from tests.benches.early_starts import as_launched, begun_early

ROOT = Path(__file__).parents[2]
# Physics of campaigns (`sitl.studies.campaign.flight.PHYSICS_HZ`), by which the airframes of `_ALIKE` fly as they do by
# the configured ones, for five sixths of the work.
AT_100_HZ = "sitl.physics_hz=100"
_ALIKE = ("thesis", "crazyflie")
FINE = "sitl.physics_hz=250"  # as configured: for accuracy, and where a docstring gives figures of further flights
# Half the work, for claims of messages, phases, equality, and of reactions that take seconds, where the claim holds so
# from shifted starts too, and the negative control still fails. Those of test_guaranteed.py don't; accuracy, and the
# distances that shipped configurations keep, are flown at the configured rate.
COARSE = ("agent.rate_hz=25", AT_100_HZ)


@dataclass
class Flight:
    """A finished flight."""

    lockstep: Lockstep
    _ticks: dict[int, Any] = field(default_factory=dict)

    @property
    def config(self) -> Config:
        return self.lockstep.config

    @property
    def problems(self) -> list[str]:
        return self.lockstep.problems()

    @property
    def outcomes(self) -> set[str]:
        """What became of the missions; those that are under way have none, "" in the set."""
        return {agent.outcome for agent in self.lockstep.agents if agent is not None}

    @property
    def t_s(self) -> NDArray[np.float64]:
        return np.asarray(self._truth["t_us"][:, 0] * 1e-6)

    @property
    def pos_ned_m(self) -> NDArray[np.float64]:
        """True positions (T, N, 3), NED [m]."""
        return np.asarray(self._truth["pos_ned_m"])

    @cached_property
    def _truth(self) -> Any:
        return self.lockstep.truth.reshape(-1, self.config.swarm.agents)

    def ticks(self, agent: int) -> Any:
        if agent not in self._ticks:
            self._ticks[agent] = self.lockstep.logs[agent].ticks
        return self._ticks[agent]

    def tracked(self, agent: int) -> tuple[Any, NDArray[np.float64]]:
        """Return the ticks of the mission itself, and true position minus reference (K, 3) at each."""
        ticks = self.ticks(agent)
        ticks = ticks[np.isfinite(ticks["mission_t_s"])]
        true = [np.interp(ticks["t_us"] * 1e-6, self.t_s, self.pos_ned_m[:, agent, c]) for c in range(3)]
        return ticks, np.stack(true, axis=1) - ticks["ref_pos_ned_m"]

    def summed_mean_error_m(self, after_s: float = 0.0) -> float:
        """Return the sum over agents of the mean distance to the reference (index of thesis Table 19)."""
        total = 0.0
        for agent in range(self.config.swarm.agents):
            ticks, error = self.tracked(agent)
            total += float(np.linalg.norm(error[ticks["mission_t_s"] >= after_s], axis=1).mean())
        return total

    def separation_m(self, only: int | None = None) -> float:
        """Return the smallest true distance of any two vehicles at any time, on the ground and in the air."""
        pos = self.pos_ned_m
        if only is None:
            return float(closest_pair_m(pos).min())
        return float(np.linalg.norm(np.delete(pos, only, axis=1) - pos[:, [only]], axis=2).min())

    def modes(self, agent: int, phase: Phase | None = None) -> set[Mode]:
        ticks = self.ticks(agent)
        rows = ticks if phase is None else ticks[ticks["phase"] == phase]
        return {Mode(int(m)) for m in np.unique(rows["mode"])}

    def event_names(self, agent: int) -> list[str]:
        return [event["event"] for event in self.lockstep.logs[agent].events]


Fly = Callable[..., Flight]


def fly_now(
    *overrides: str,
    config: str | None = None,
    order: list[int] | None = None,
    at: dict[float, Callable[[Lockstep], None]] | None = None,
    until: Callable[[Lockstep], bool] | None = None,
    seed: int = 0,
    rehearses: bool = False,
) -> Flight:
    """Fly a configuration to its end, or until `until` returns true, by coarse physics unless `overrides` has `FINE`.

    `at` maps mission times [s] to actions, each run once; `seed` is that of `nudged`; for `rehearses` see `Lockstep`.
    """
    path = ROOT / "configs" / config if config else None
    configured = load(path, overrides)
    if configured.sitl.preset in _ALIKE:
        overrides = (AT_100_HZ, *overrides)
    starts = nudged(np.array(configured.starts_ned_m()), seed)
    overrides += (f"start.positions_ned_m={json.dumps(starts.tolist())}",) if seed else ()
    lockstep = Lockstep(load(path, overrides), order=order, rehearses=rehearses)
    due = sorted((at or {}).items())

    def on_step(running: Lockstep) -> None:
        while due and mission_t_s(running) >= due[0][0]:
            due.pop(0)[1](running)

    if until is None:
        lockstep.run(on_step)
    else:
        while not until(lockstep):
            assert not lockstep.finished, "the flight ended before what it was flown for"
            lockstep.step()
            on_step(lockstep)
    assert not due, f"the flight ended before {due[0][0]} s of mission time"
    return Flight(lockstep)


def mission_t_s(lockstep: Lockstep) -> float:
    """Return the newest mission time [s] of any agent that is tracking, else -1."""
    times = [float(log.rows[-1]["mission_t_s"][0]) for log in lockstep.logs if log.rows]
    return max((t for t in times if np.isfinite(t)), default=-1.0)


def closer_than(bound_m: float) -> Callable[[Lockstep], bool]:
    """Return what ends a negative control: whether any two vehicles are closer at this moment."""
    return lambda lockstep: bool(closest_pair_m(lockstep.world.truth_rows()["pos_ned_m"][np.newaxis])[0] < bound_m)


_as_configured = Config.simulator


@pytest.fixture(scope="module", autouse=True)
def early_starts() -> Iterator[None]:
    """Begin flights sooner, and no longer than these tests: others of the same process judge what vehicles wait for."""
    with begun_early():
        yield


@pytest.fixture(scope="module", autouse=True)
def nudged_starts(request: pytest.FixtureRequest) -> Iterator[None]:
    """Shift the vehicles of every flight by up to a millimetre, by the seed of `--nudged`."""
    seed = int(request.config.getoption("--nudged"))

    def elsewhere(config: Config, agents: Sequence[int] = ()) -> SimulatorConfig:
        simulator = _as_configured(config, agents)
        spawns_ned_m = nudged(np.array(simulator.spawn_ned_m), seed)
        return simulator.model_copy(update={"spawn_ned_m": tuple(map(tuple, spawns_ned_m.tolist()))})

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Config, "simulator", elsewhere)
        yield


@pytest.fixture
def configured_starts(nudged_starts: None, early_starts: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Start as configured all the same, and when the vehicles of a launch would.

    That is for flights compared with those of other processes, and for controls that fail from some starts only: a
    claim has to hold from all of them, its control has to fail from one.
    """
    monkeypatch.setattr(Config, "simulator", _as_configured)
    as_launched(monkeypatch)


@pytest.fixture
def fly() -> Fly:
    return fly_now


@pytest.fixture(scope="module")
def circle() -> Flight:
    """Fly the whole default mission."""
    return fly_now(FINE)
