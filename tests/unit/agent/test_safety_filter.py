"""The safety filter in flight: when it may act, what it asks about bodies, and what it notes of encounters."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from swarmctl.agent.flying.safety_filter import SafetyFilter
from swarmctl.control.collision.barrier import Barrier, BarrierParams, Body
from swarmctl.control.estimation.disturbance import Estimate
from swarmctl.control.model import VehicleModelParams
from swarmctl.core.types import Array
from tests import builders

MS = 1_000
HERE = np.array([1.0, 2.0, -3.0])
TOWARDS = np.array([-0.03, 0.0, 9.81])  # leans to the north
NORTH_M_S = np.array([1.0, 0.0, 0.0])
CLOSE = Body(pos_ned_m=(1.55, 2.0, -3.0), vel_ned_m_s=(-1.0, 0.0, 0.0), apart_m=0.5, responsibility_01=1.0)
FAR = Body(pos_ned_m=(50.0, 2.0, -3.0), vel_ned_m_s=(0.0, 0.0, 0.0), apart_m=0.5, responsibility_01=1.0)
LAGGING = VehicleModelParams(attitude_rad_s=9.5)


class Bench:
    """One filter, and the bodies that its world model names; each call of `fly` is a tick 20 ms after the last."""

    def __init__(self, params: BarrierParams | None = None, vehicle: VehicleModelParams | None = None) -> None:
        self.params, self.vehicle = params or BarrierParams(), vehicle or VehicleModelParams()
        self.bodies: list[Body] = []
        self.asked: list[tuple[tuple[Any, ...], dict[str, Any]]] = []
        self.told: list[dict[str, Any]] = []
        self.now_us, self.passed_ns = 1_000_000, 0
        self.estimate = Estimate(np.zeros(3), 0.5)
        self.filter = SafetyFilter(
            self.params,
            self.vehicle,
            0.02,
            cast(Any, SimpleNamespace(bodies=self._bodies)),
            downwash=1.0,
            note=lambda name, **fields: self.told.append({"event": name, **fields}),
            stopwatch_ns=lambda: self.passed_ns,
        )

    def _bodies(self, *given: Any, **named: Any) -> list[Body]:
        self.asked.append((given, named))
        self.passed_ns += 3_000_000
        return self.bodies

    def fly(self, wanted: Array = TOWARDS, *, flies: bool = True, committed: Any = None) -> Array:
        self.now_us += 20 * MS
        return self.filter.keep_apart(
            self.now_us,
            self.now_us + 500 * MS,
            wanted,
            builders.start(pos_ned_m=HERE, vel_ned_m_s=NORTH_M_S),
            estimate=self.estimate,
            flies=flies,
            committed_peers=committed or {},
        )

    def skip(self) -> None:
        self.now_us += 20 * MS
        self.filter.skip(self.now_us)


@pytest.mark.parametrize("enabled", [True, False])
@pytest.mark.parametrize("flies", [True, False])
@pytest.mark.parametrize("bodies", [[], [FAR], [CLOSE], [FAR, CLOSE]], ids=["none", "far", "close", "both"])
def test_it_acts_where_it_is_enabled_the_agent_flies_and_a_body_is_close(
    enabled: bool, flies: bool, bodies: list[Body]
) -> None:
    bench = Bench(BarrierParams(enabled=enabled))
    bench.bodies = bodies
    flown = bench.fly(flies=flies)
    acts = enabled and flies and CLOSE in bodies
    assert bench.filter.acts is acts
    assert (flown is TOWARDS) is not acts, "what is not changed is the very command"
    assert bool(flown[0] > 0.0) is acts, "it leans back"
    assert bool(bench.asked) is (enabled and flies)


@pytest.mark.parametrize("vehicle", [VehicleModelParams(), LAGGING], ids=["at once", "with a lag"])
def test_it_asks_for_bodies_at_the_time_the_command_takes_effect_with_the_margin(vehicle: VehicleModelParams) -> None:
    bench, committed = Bench(BarrierParams(margin_m=0.125), vehicle), {1: ()}
    bench.fly(committed=committed)
    ((pos_ned_m, act_utc_us, ahead_s, margin_m), named) = bench.asked[0]
    assert list(pos_ned_m) == list(HERE)
    assert act_utc_us == bench.now_us + 500 * MS
    lag = vehicle.lag()
    assert ahead_s == (0.0 if lag is None else lag.ramp_delay_s)
    assert margin_m == 0.125
    assert named == {"committed_peers": committed}


def test_it_is_told_the_wind_and_the_thrust_that_hovers(monkeypatch: pytest.MonkeyPatch) -> None:
    given = []
    monkeypatch.setattr(Barrier, "filtered", lambda _, *arguments, **__: given.append(arguments[2:]))
    bench = Bench()
    bench.estimate = Estimate(np.array([0.5, -0.25, 0.125]), 0.625)
    bench.fly()
    ((disturbance_ned_m_s2, hover_thrust_01),) = given
    assert list(disturbance_ned_m_s2) == [0.5, -0.25, 0.125]
    assert hover_thrust_01 == 0.625


@pytest.mark.parametrize("wanted", [(np.nan, 0.0, 9.81), (0.0, 0.0, np.inf)], ids=str)
def test_a_command_that_is_no_number_is_left_to_who_refuses_it(wanted: tuple[float, ...]) -> None:
    bench = Bench()
    bench.bodies = [CLOSE]
    command = np.array(wanted)
    assert bench.fly(command) is command
    assert not bench.filter.acts


def test_an_encounter_is_noted_when_it_begins_and_when_it_is_over_with_the_ticks_it_took() -> None:
    bench = Bench()
    bench.bodies = [CLOSE]
    for _ in range(7):
        bench.fly()
    assert bench.told == [{"event": "safety_filter", "acts": True}]
    bench.bodies = []
    for _ in range(25):
        bench.fly()
    assert len(bench.told) == 1, "half a second"
    bench.fly()
    assert bench.told[1:] == [{"event": "safety_filter", "acts": False, "ticks": 7}]
    for _ in range(100):
        bench.fly()
    assert len(bench.told) == 2
    bench.bodies = [CLOSE]
    bench.fly()
    assert bench.told[2:] == [{"event": "safety_filter", "acts": True}], "the next encounter"


def test_a_pause_within_an_encounter_does_not_end_it() -> None:
    bench = Bench()
    for bodies in ([CLOSE], [], [CLOSE]):
        bench.bodies = bodies
        for _ in range(20):
            bench.fly()
    bench.bodies = []
    for _ in range(26):
        bench.fly()
    assert bench.told[1:] == [{"event": "safety_filter", "acts": False, "ticks": 40}]


def test_ticks_without_a_setpoint_end_an_encounter_too() -> None:
    bench = Bench()
    bench.bodies = [CLOSE]
    bench.fly()
    assert (bench.filter.acts, bench.filter.duration_ms) == (True, 3.0)
    bench.skip()
    assert (bench.filter.acts, bench.filter.duration_ms) == (False, 0.0)
    for _ in range(25):
        bench.skip()
    assert bench.told[1:] == [{"event": "safety_filter", "acts": False, "ticks": 1}]
    assert len(bench.asked) == 1, "nothing is asked for"
