"""What a lockstep flight is told beside its configuration: clocks of the agents that are wrong, and their records."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sitl.lockstep import Lockstep, _is_due
from swarmctl.bus.peers.clocks import PeerClocks
from swarmctl.config import load
from swarmctl.core.clock import ClockError, OffsetClock, SimClock
from swarmctl.errors import ConfigError
from swarmctl.telemetry.evaluation.referee import evaluate
from swarmctl.telemetry.evaluation.tracks import mission_start_us, track_error, tracking_rows

AHEAD_US = 200_000
TWO = ("swarm.agents=2", "sitl.start=air", "mission.duration_s=3")


def flown(clocks: dict[int, ClockError] | None = None, until_s: float = 8.0) -> Lockstep:
    lockstep = Lockstep(load(None, TWO), clocks=clocks)
    lockstep.run(lambda flight: flight.clock.now_us() >= until_s * 1e6)
    return lockstep


def offsets_us(lockstep: Lockstep, agent: int) -> list[int]:
    """Return how far the agent's ticks are stamped ahead of true UTC."""
    ticks, epoch_us = lockstep.logs[agent].ticks, SimClock().utc_us()
    ahead_us: list[int] = (ticks["utc_us"] - ticks["t_us"] - epoch_us).tolist()
    return ahead_us


def test_a_wrong_clock_is_ahead_and_gains_while_its_monotonic_time_is_right() -> None:
    true = SimClock()
    clock = OffsetClock(true, ClockError(offset_us=-1000, drift_ppm=50.0))
    assert (clock.now_us(), clock.utc_us()) == (0, true.utc_us() - 1000)
    true.advance(100_000_000)
    assert (clock.now_us(), clock.utc_us()) == (100_000_000, true.utc_us() - 1000 + 5000)


@pytest.fixture(scope="module")
def skewed() -> Lockstep:
    return flown({1: ClockError(offset_us=AHEAD_US, drift_ppm=100.0)})


def test_an_agent_stamps_its_ticks_and_events_with_its_own_clock(skewed: Lockstep) -> None:
    assert set(offsets_us(skewed, 0)) == {0}
    ahead_us = offsets_us(skewed, 1)
    assert ahead_us[0] == AHEAD_US
    assert ahead_us[-1] == pytest.approx(AHEAD_US + 100.0 * skewed.logs[1].ticks["t_us"][-1] * 1e-6, abs=1)
    for agent, least_us in ((0, 0), (1, AHEAD_US)):
        event = skewed.logs[agent].events[-1]
        assert event["utc_us"] - event["t_us"] - SimClock().utc_us() == pytest.approx(least_us, abs=2000)


def test_agents_begin_the_mission_at_one_time_whatever_their_clocks_say(skewed: Lockstep) -> None:
    begin_us = [mission_start_us({i: skewed.logs[i].ticks}, "utc_us") for i in (0, 1)]
    assert begin_us[0] is not None and begin_us[1] is not None
    assert begin_us[1] - begin_us[0] == pytest.approx(AHEAD_US, abs=20_000), "each by its own clock"
    first_us = [int(tracking_rows(log.ticks)["t_us"][0]) for log in skewed.logs]
    assert first_us[0] == pytest.approx(first_us[1], abs=20_000)


def test_negative_control_by_clocks_that_nobody_measures_the_one_ahead_begins_earlier(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(PeerClocks, "ahead_us", lambda self, agent: 0)
    apart = flown({1: ClockError(offset_us=AHEAD_US)})
    first_us = [int(tracking_rows(log.ticks)["t_us"][0]) for log in apart.logs]
    assert first_us[0] - first_us[1] == pytest.approx(AHEAD_US, abs=20_000)


def test_the_evaluation_compares_records_of_wrong_clocks_at_their_monotonic_time(skewed: Lockstep) -> None:
    summary = evaluate(skewed.recorded(), skewed.config.rules("lockstep"), "interrupted")
    pos = skewed.truth["pos_ned_m"].reshape(-1, 2, 3)
    assert summary["separation"]["min_m"] == pytest.approx(float(np.linalg.norm(pos[:, 0] - pos[:, 1], axis=1).min()))
    for agent, log in enumerate(skewed.logs):
        rows = tracking_rows(log.ticks)
        error_ned_m = track_error(rows, skewed.truth, agent).error_ned_m
        assert np.linalg.norm(rows["vel_ned_m_s"], axis=1).max() > 1.0, "0.2 s would be seen"
        assert np.allclose(error_ned_m, rows["pos_ned_m"] - rows["ref_pos_ned_m"], atol=1e-4)


def test_errors_of_zero_leave_a_flight_as_it_is() -> None:
    right, unset = flown({0: ClockError(), 1: ClockError()}, until_s=3.0), flown(until_s=3.0)
    assert right.truth.tobytes() == unset.truth.tobytes()
    assert right.logs[1].events == unset.logs[1].events


def test_recorded_frames_are_stamped_with_the_own_clock(tmp_path: Path) -> None:
    lockstep = Lockstep(load(None, TWO), tmp_path, clocks={1: ClockError(offset_us=AHEAD_US)})
    for _ in range(100):
        lockstep.step()
    for log in lockstep.logs:
        log.close()
    first_us = [int.from_bytes((tmp_path / f"agent-{i}.tlog").read_bytes()[:8], "big") for i in (0, 1)]
    assert first_us[1] - first_us[0] == AHEAD_US


def test_a_tick_of_no_whole_number_of_steps_is_refused_as_a_configuration() -> None:
    with pytest.raises(ConfigError, match=r"sitl\.physics_hz = 250: in lockstep a multiple of agent\.rate_hz = 40"):
        Lockstep(load(None, ("agent.rate_hz=40",)))


@pytest.mark.parametrize(("rate_hz", "physics_hz"), [(30, 300), (60, 240), (50, 250)])
def test_a_tick_has_a_whole_number_of_steps_though_neither_is_one_of_microseconds(
    rate_hz: int, physics_hz: int
) -> None:
    lockstep = Lockstep(load(None, ("swarm.agents=1", f"agent.rate_hz={rate_hz}", f"sitl.physics_hz={physics_hz}")))
    for _ in range(rate_hz):
        lockstep.step()
    assert lockstep.clock.now_us() == pytest.approx(1e6, rel=1e-3)


@pytest.mark.parametrize(("rate_hz", "physics_hz"), [(10, 250), (25, 100), (30, 300), (50, 250), (62.5, 125)])
def test_true_states_are_recorded_as_often_whatever_the_rate_of_ticks(rate_hz: float, physics_hz: int) -> None:
    """At 10 Hz two that meet at 4 m/s were 0.4 m nearer from one recorded state to the next."""
    told = ("swarm.agents=1", f"agent.rate_hz={rate_hz}", f"sitl.physics_hz={physics_hz}")
    lockstep = Lockstep(load(None, told))
    lockstep.run(lambda flight: flight.clock.now_us() >= 1_000_000)
    since_us = np.diff(lockstep.truth["t_us"])
    assert len(since_us) >= 48 and since_us.max() <= 20_000 + 1e6 / physics_hz


@pytest.mark.parametrize("every_us", [20_000, 1_000_000])
def test_what_is_due_happens_once_in_each_of_its_periods(every_us: int) -> None:
    for step_us in (4_000, 3_333, 8_000, 20_000):
        due_us = [now_us for now_us in range(0, 3_000_000, step_us) if _is_due(now_us, step_us, every_us)]
        assert [now_us // every_us for now_us in due_us] == list(range(len(due_us)))
        assert len(due_us) == 1 + (range(0, 3_000_000, step_us)[-1] // every_us)
        assert all(now_us % every_us < step_us for now_us in due_us)


@pytest.mark.parametrize(
    ("duration_s", "least_s", "most_s"),
    [
        (9, 150.0, 200.0),  # at the time limit it is on its way
        (6, 126.0, 131.0),  # it has just landed
    ],
)
def test_a_long_way_back_is_flown_to_its_end(duration_s: int, least_s: float, most_s: float) -> None:
    """A line of 5 min led 500 m away; after 2 min on the way back the flight was over, "did not finish"."""
    line = ("mission.kind=line", "mission.line.origin_ned_m=[0, 0, -1]", "mission.line.velocity_ned_m_s=[3, 0, 0]")
    slow = ("agent.state_machine.speed_m_s=0.2", f"mission.duration_s={duration_s}", "start.center_ned_m=[0, 0, -1]")
    lockstep = Lockstep(load(None, ("swarm.agents=1", "sitl.physics_hz=50", "agent.rate_hz=10", *line, *slow)))
    lockstep.run()
    assert lockstep.problems() == []
    assert least_s < lockstep.clock.now_us() * 1e-6 < most_s


def test_a_long_way_down_is_flown_to_its_end() -> None:
    """Two minutes after the mission one that had begun 90 m up was still sinking, "did not finish"."""
    high = ("mission.kind=hover", "mission.duration_s=1", "start.center_ned_m=[0, 0, -100]")
    waits = "agent.state_machine.start_timeout_s=200"
    lockstep = Lockstep(load(None, ("swarm.agents=1", "sitl.physics_hz=50", "agent.rate_hz=10", *high, waits)))
    lockstep.run()
    assert lockstep.problems() == []
    assert lockstep.clock.now_us() > 121_000_000


def test_the_bus_in_memory_drops_who_is_not_reached_after_the_configured_lease() -> None:
    flight = Lockstep(load(None, ["swarm.agents=2", "bus.lease_ms=700"]))
    flight.hub.fail()
    flight.clock.advance(699_999)
    assert "agent-1" in flight.hub.alive("agent-0")
    flight.clock.advance(1)
    assert "agent-1" not in flight.hub.alive("agent-0")
