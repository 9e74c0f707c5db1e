"""How committed trajectories are tracked, and what follows when a vehicle is not where it was committed to be."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from swarmctl.agent.planning import commitment_tracking
from swarmctl.agent.planning.separation_policy import Guaranteed
from swarmctl.agent.planning.state_age import StateAge
from swarmctl.config import load
from swarmctl.control.collision.barrier import Barrier, BarrierParams, Body
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.commit import commit_params
from swarmctl.control.commit.commit_params import CommitParams
from swarmctl.control.commit.protocol import Commitments
from swarmctl.control.mpc.problem import Start
from swarmctl.core.types import Array, Phase
from tests.benches.guaranteed_trials import GUARANTEED_SWAP, TUBE_M, events, flown
from tests.closed_loop.conftest import ROOT, fly_now, mission_t_s


class HeldUp:
    """One x500 on a circle at 2.5 m/s whose world stands still for a while, again and again, while time goes on.

    So it is with simulators, and with an agent, that get too little of a processor: for 1.4 s the world gets 70 % of
    the time, in pieces, and the agent executes every other tick.
    """

    BEGINS_S, LASTS_S, AFTERWARDS_S = 3.0, 1.4, 1.0

    def __init__(self) -> None:
        sets = ["swarm.agents=1", "sitl.start=air", "sitl.estimator=exact", "separation.mode=guaranteed"]
        self.flight = Lockstep(load(ROOT / "configs" / "x500_circle.toml", sets))
        self._world_step, self._lost_us, self._began_us = self.flight.world.step, 0, 0
        self.flight.world.step = self._step  # type: ignore[method-assign]

    def _since_s(self) -> float:
        return (self.flight.clock.now_us() - self._began_us) * 1e-6 - self.BEGINS_S if self._began_us else -math.inf

    def _step(self, now_us: int) -> None:
        since_s = self._since_s()
        if 0.0 < since_s < self.LASTS_S and since_s % 0.233 < 0.07:
            self._lost_us += 1_000_000 // self.flight.config.sitl.physics_hz
        else:
            self._world_step(now_us - self._lost_us)

    def fly(self) -> tuple[float, float]:
        """Return how far it was off what it had committed to [m], and how fast it was afterwards [m/s]."""
        flight, fastest_m_s = self.flight, 0.0
        while (since_s := self._since_s()) < self.LASTS_S + self.AFTERWARDS_S:
            flight.starved = {0: 2} if 0.0 < since_s < self.LASTS_S else {}
            flight.step()
            if not self._began_us and flight.logs[0].rows and flight.logs[0].rows[-1]["phase"][0] == Phase.TRACK:
                self._began_us = flight.clock.now_us()
            if since_s > self.LASTS_S:
                fastest_m_s = max(fastest_m_s, float(np.linalg.norm(flight.world.plant.vel_ned_m_s[:, 0])))
        (agent,) = flight.agents
        assert agent is not None and isinstance(agent._separation, Guaranteed)
        return agent._separation._coordination.worst_tracking_m, fastest_m_s


def test_a_vehicle_that_is_held_up_slows_and_does_not_chase_what_it_had_committed_to() -> None:
    off_m, fastest_m_s = HeldUp().fly()
    assert off_m < 0.3
    assert fastest_m_s < 1.5


def test_negative_control_commitments_that_go_on_in_time_are_chased(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Commitments, "wait_for", lambda self, *_: None)
    monkeypatch.setattr(commitment_tracking, "slowed", lambda desired, *_: desired)
    off_m, fastest_m_s = HeldUp().fly()
    assert off_m > 0.35
    assert fastest_m_s > 2.3


def off_now_m(flight: Lockstep) -> float:
    """Return how far the agents of a flight that goes on have been off what they had committed to, at most."""
    policies = [agent._separation for agent in flight.agents if agent is not None]
    return max(policy._coordination.worst_tracking_m for policy in policies if isinstance(policy, Guaranteed))


def worst_tracking_m(flight: Lockstep) -> float:
    """Return how far the agents of a flight that has ended were off what they had committed to, at most."""
    told = [event for log in flight.logs for event in log.events if event["event"] == "commitments"]
    assert len(told) == len(flight.logs)
    return max(float(event["worst_tracking_m"]) for event in told)


def off_commitments_m(shown_m: float = math.inf) -> float:
    """Return how far three x500s are off what they had committed to, from rest into a circle at 2.5 m/s and to rest.

    The flight ends there, or when one of them is farther off than `shown_m`.
    """
    sets = ["swarm.agents=3", "sitl.start=air", "sitl.estimator=exact", "separation.mode=guaranteed"]
    flight = Lockstep(load(ROOT / "configs" / "x500_circle.toml", [*sets, "mission.duration_s=8"]))

    def rest() -> bool:
        return flight.mission_is_over() and float(np.linalg.norm(flight.world.plant.vel_ned_m_s, axis=0).max()) < 0.1

    flight.run(lambda _: off_now_m(flight) > shown_m or rest())
    assert off_now_m(flight) > shown_m or rest(), "it ended before"
    return off_now_m(flight)


def test_commitments_are_left_no_sooner_than_the_vehicle_can() -> None:
    assert off_commitments_m() < 0.05


def test_negative_control_what_is_left_sooner_is_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CommitParams, "for_vehicle", lambda self, vehicle: self)
    assert off_commitments_m(0.08) > 0.08


MANY, FAR_OFF_M = 10, 1.2 * TUBE_M


def violations_by_old_states() -> tuple[int, float]:
    """Return how often three agents on circles tell of a violation, and how far off they see their vehicles at most.

    What they know of these is 80 to 100 ms old, as by a slow radio. The flight ends with the mission, or when both are
    more than `MANY` and `FAR_OFF_M`.
    """
    sets = [
        "swarm.agents=3",
        "sitl.start=air",
        "separation.mode=guaranteed",
        "mission.kind=circle",
        "mission.duration_s=9",
        "agent.state_machine.state_rate_hz=50",
        "sitl.link_latency_ms=80",
    ]
    flight = Lockstep(load(None, sets))

    def told() -> int:
        return sum(event["event"] == "tracking_violation" for log in flight.logs for event in log.events)

    flight.run(lambda _: flight.mission_is_over() or (told() > MANY and off_now_m(flight) > FAR_OFF_M))
    return told(), off_now_m(flight)


def test_a_vehicle_is_judged_by_where_it_was_to_be_when_it_was_there() -> None:
    told, off_m = violations_by_old_states()
    assert told == 0
    assert off_m < TUBE_M


def test_negative_control_what_is_not_there_yet_is_taken_for_a_violation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(StateAge, "seen_us", lambda self, state_us, now_us: now_us)
    told, off_m = violations_by_old_states()
    assert told > MANY
    assert off_m > FAR_OFF_M


@pytest.mark.parametrize(("body_m", "told"), [(0.48, False), (0.8, True)])
def test_a_tracking_violation_is_reported(body_m: float, told: bool) -> None:
    """The error may be half of the committed distance beyond touching bodies; the safety filter deflects large ones."""
    flight = flown(replace(GUARANTEED_SWAP, agents=2, sets=f"separation.body_m={body_m}"))
    assert flight.row(None)["outcome"] == "arrived"
    off = events(flight, "tracking_violation")
    assert bool(off) is told
    if told:
        assert off[0]["begins"] is True
        assert float(str(off[0]["error_m"])) > float(str(off[0]["allowed_m"])) == pytest.approx(0.04)


@pytest.mark.parametrize(("weights", "moves", "follows"), [("", 10, True), ("{q_pos=2.0,q_vel=0.05,r=1.0}", 3, False)])
def test_the_committed_trajectory_is_tracked_in_height_too(
    weights: str, moves: int, follows: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Into a climbing circle from rest; control: the thesis' soft z, which is good enough for a desired reference."""
    monkeypatch.setattr(commit_params, "_FOLLOWING_MOVES_Z", moves)
    sets = ["swarm.agents=1", "sitl.start=air", "separation.mode=guaranteed", "mission.duration_s=2.5"]
    sets += [f"agent.commit.follow_z={weights}"] * bool(weights)
    flight = Lockstep(load(None, sets))
    flight.run()
    assert (worst_tracking_m(flight) < 0.1) is follows
    assert (worst_tracking_m(flight) > TUBE_M) is not follows


def test_a_tick_with_a_stale_state_commits_nothing_and_spends_no_time_on_it() -> None:
    flight = Lockstep(load(None, ["swarm.agents=1", "sitl.start=air", "separation.mode=guaranteed"]))
    while not flight.logs[0].rows or flight.logs[0].rows[-1]["phase"][0] != Phase.TRACK:
        flight.step()
    (agent,) = flight.agents
    assert agent is not None
    assert agent.timing.commitment_ms > 0.0
    flight.links[0][1].send = lambda data: None  # type: ignore[method-assign]
    for _ in range(15):
        flight.step()
    assert agent.timing.commitment_ms == 0.0
    assert agent.timing.setup_ms >= 0.0


@pytest.mark.parametrize("mode", ["guaranteed", "best_effort"])
def test_the_safety_filter_places_peers_on_their_committed_trajectories(
    mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A commitment holds however old its message is, but for the error of the clock, which is a round trip at most.

    Control: a path's margin grows with the age the bus gives it.
    """
    flight = Lockstep(load(None, ["swarm.agents=2", "sitl.start=air", f"separation.mode={mode}", "bus.delay_ms=60"]))
    seen_m: list[float] = []
    filtered = Barrier.filtered

    round_trip_s = 0.0

    def watched(
        self: Barrier,
        virtual_control: Array,
        start: Start,
        disturbance_ned_m_s2: Array,
        hover_thrust_01: float,
        *,
        bodies: Sequence[Body],
    ) -> Array | None:
        seen_m.extend(body.apart_m - round_trip_s * math.hypot(*body.vel_ned_m_s) for body in bodies)
        return filtered(self, virtual_control, start, disturbance_ned_m_s2, hover_thrust_01, bodies=bodies)

    monkeypatch.setattr(Barrier, "filtered", watched)
    while not flight.logs[0].rows or flight.logs[0].rows[-1]["phase"][0] != Phase.TRACK:
        flight.step()
    seen_m.clear()
    if mode == "guaranteed":
        (agent, _) = flight.agents
        assert agent is not None
        round_trip_s = 1e-6 * agent._world_model.clocks.spread_us(1)
        assert 0.06 <= round_trip_s <= 0.16, "the delay there and back, and ticks"
    for _ in range(25):
        flight.step()
    least_m = SeparationParams().body_m + BarrierParams().margin_m
    assert len(seen_m) > 5
    assert (seen_m == pytest.approx([least_m] * len(seen_m))) is (mode == "guaranteed")


def test_who_is_where_it_was_committed_to_be_shares_its_path_once_in_three_ticks() -> None:
    """Peers only compare it; before it commits to anything, it shares each one."""
    sets = ("sitl.start=air", "separation.mode=guaranteed", "swarm.agents=4")
    before: dict[str, int] = {}

    def sent(lockstep: Lockstep) -> dict[str, int]:
        (agent, *_) = lockstep.agents
        assert agent is not None
        return {topic: agent.sent[topic]["messages"] for topic in ("path", "trajectory")}

    flight = fly_now(
        *sets,
        config="swap8.toml",
        at={1.0: lambda lockstep: before.update(sent(lockstep))},
        until=lambda lockstep: mission_t_s(lockstep) > 3.6,
    )
    paths, trajectories = (sent(flight.lockstep)[topic] - before[topic] for topic in ("path", "trajectory"))
    assert trajectories > 100
    assert paths == pytest.approx(trajectories / 3.0, abs=5)
