"""Tests of the real-time loop: missed and skipped deadlines, which are never caught up in a burst."""

from __future__ import annotations

import gc
import os
import re
import signal
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from swarmctl.agent.flight_priority import FlightPriority
from swarmctl.agent.runner import (
    NOTHING_REFUSED,
    AgentProcess,
    Pace,
    RealTimeAgent,
    StopOrder,
    _check_vehicle_silence,
    _fly,
    keep_from_collections,
    run_agent,
)
from swarmctl.bus.silence import SessionWatch
from swarmctl.config import load
from swarmctl.core.clock import SimClock
from swarmctl.core.operator_verbs import Order
from swarmctl.core.types import Mode
from swarmctl.errors import EXIT_OK, ConfigError, MissionError, StartError
from swarmctl.process_lifetime import StopRequest
from swarmctl.wall_clock import WallClock, monotonic_us

MS = 1_000


def paced(*ticks_ms: tuple[float, float]) -> Pace:
    """Run a 20 ms loop whose ticks sent and ended at the given times [ms] after the first was due."""
    pace = Pace(20 * MS, 0)
    for sent_ms, ended_ms in ticks_ms:
        pace.done(round(sent_ms * MS), round(ended_ms * MS))
    return pace


def test_ticks_in_time_keep_an_absolute_grid() -> None:
    pace = paced((3, 5), (28, 33), (59.9, 60))
    assert (pace.missed, pace.due_us) == (0, 60 * MS)


@pytest.mark.parametrize(
    ("sent_ms", "ended_ms", "late", "due_ms"),
    [
        (20, 20, 0, 20),  # sent at the very moment the next was due: not after it
        (20.001, 21, 1, 20),  # after it: late; the next starts at once, on its own grid point
        (10, 35, 0, 20),  # sent in time, recording took long: the next begins 15 ms late but nothing is lost
        (10, 40, 1, 40),  # due 20 could not begin before 40 was due: skipped
        (95, 100, 5, 100),  # itself late, and 20, 40, 60, 80 skipped
        (95, 119, 5, 100),
        (1000, 1010, 50, 1000),  # a second of standstill is 50 lost ticks
    ],
)
def test_missed_deadlines_of_late_and_skipped_ticks(sent_ms: float, ended_ms: float, late: int, due_ms: float) -> None:
    pace = paced((sent_ms, ended_ms))
    assert (pace.missed, pace.due_us) == (late, due_ms * MS)


def test_after_a_stall_one_tick_follows_and_not_a_burst() -> None:
    pace = paced((500, 505))
    assert pace.due_us == 500 * MS  # one overdue tick, begun at once
    pace.done(508 * MS, 510 * MS)
    assert pace.due_us == 520 * MS  # and the next one waits for its time
    assert pace.missed == 25


def test_a_stop_that_is_refused_is_asked_for_again_until_it_is_obeyed() -> None:
    asked_us: list[int] = []
    pilot_flies = True

    def ask(order: Order, now_us: int) -> str:
        assert order == Order("land")
        asked_us.append(now_us)
        return "a pilot has taken over" if pilot_flies else ""

    with StopRequest(signal.SIGUSR1) as stop:
        landing = StopOrder(ask)
        landing.step(stop, 0)
        assert asked_us == []
        os.kill(os.getpid(), signal.SIGUSR1)
        for tick in range(150):  # 3 s
            landing.step(stop, 20 * MS * tick)
        assert asked_us == [0, 1_000_000, 2_000_000]
        pilot_flies = False
        for tick in range(150, 400):
            landing.step(stop, 20 * MS * tick)
    assert asked_us == [0, 1_000_000, 2_000_000, 3_000_000]


def test_sleeping_until_the_past_returns_and_until_the_future_waits() -> None:
    clock = WallClock()
    began_us = clock.now_us()
    clock.sleep_until(began_us - 1_000_000)
    assert clock.now_us() - began_us < 50_000
    clock.sleep_until(began_us + 60_000)
    assert clock.now_us() >= began_us + 60_000


def test_a_vehicle_never_seen_is_a_start_error_and_a_lost_one_a_mission_error() -> None:
    config = load(None, ["agent.connect_timeout_s=5.0"])
    _check_vehicle_silence(5_000_000, False, config, "udpin://x")
    with pytest.raises(StartError, match="udpin://x"):
        _check_vehicle_silence(5_000_001, False, config, "udpin://x")
    _check_vehicle_silence(15_000_000, True, config, "udpin://x")
    with pytest.raises(MissionError, match="udpin://x"):
        _check_vehicle_silence(15_000_001, True, config, "udpin://x")
    with pytest.raises(StartError, match="frames refused: 3 unsigned;"):
        _check_vehicle_silence(5_000_001, False, config, "udpin://x", {"unsigned": 3})


@pytest.mark.parametrize("signum", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_is_one_stop_request(signum: signal.Signals) -> None:
    before = {s: signal.getsignal(s) for s in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)}
    try:
        stop = StopRequest(signum)
        assert stop.count == 0
        os.kill(os.getpid(), signum)
        assert stop.count == 1
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_each_session_that_was_replaced_is_recorded_once() -> None:
    counts = iter((0, 1, 1, 3))
    noted: list[tuple[str, int]] = []
    watch = SessionWatch(
        SimpleNamespace(reopened=lambda: next(counts)),
        lambda name, count: noted.append((name, count)),
    )
    for _ in range(4):
        watch.step()
    assert noted == [("bus_reopened", 1), ("bus_reopened", 3)]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"agent": 2}, r"--id 2: allowed: 0\.\.1"),
        ({"agent": -1}, r"--id -1: allowed: 0\.\.1"),
        *(({"bus": bus}, "use unixsock-stream//ABSOLUTE/PATH") for bus in ("tcp/127.0.0.1:1", "", "unixsock-stream/x")),
        *(({"run": run}, rf"--run '{re.escape(run)}': is no name of a run") for run in ("", "a/b", "a b", "*", "a$")),
        ({"run_dir": Path("nowhere")}, "--run-dir nowhere: no such folder; make it first"),
        ({"fd": 987}, "--fd 987: is no UDP socket that this process has inherited"),
        ({"fd": 0}, "--fd 0: is no UDP socket that this process has inherited"),
    ],
    ids=str,
)
def test_what_an_agent_is_given_is_bad_usage_where_there_is_no_such_thing_and_nothing_is_opened(
    tmp_path: Path, given: dict[str, Any], said: str
) -> None:
    path, run_dir = tmp_path / "config.toml", tmp_path / "run"
    path.write_text("[swarm]\nagents = 2\n", encoding="utf-8")
    run_dir.mkdir()
    fine: dict[str, Any] = {"agent": 0, "run": "run", "bus": "none", "run_dir": run_dir}
    with pytest.raises(ConfigError, match=said):
        run_agent(AgentProcess(config_path=path, **{**fine, **given}))
    assert not list(run_dir.iterdir()), "a recorder was opened"


@pytest.mark.parametrize("has_landed", [True, False])
def test_who_has_landed_may_be_switched_off_while_its_agent_waits_for_peers(has_landed: bool) -> None:
    clock = SimClock()
    stale = SimpleNamespace(mode=Mode.STATE_STALE, timing=SimpleNamespace(tick_ms=1.0))
    seen = SimpleNamespace(mode=Mode.TRACKING, timing=SimpleNamespace(tick_ms=1.0))

    class Landed:
        heard_us = 1_000_000
        ask, refused_frames, outcome, has_armed = None, NOTHING_REFUSED, "completed", True
        done = has_landed

        def tick(self, now_us: int, missed: int) -> Any:
            return seen if now_us < 1_000_000 else stale

        @property
        def finished(self) -> bool:
            return clock.now_us() > 40_000_000  # when the last peer is done

    if has_landed:
        assert flown(Landed(), clock) == EXIT_OK
    else:
        with pytest.raises(MissionError, match="silent for 15 s"):
            flown(Landed(), clock)


@pytest.mark.parametrize("had_position", [True, False])
def test_a_vehicle_that_is_heard_without_a_position_is_not_silent(had_position: bool) -> None:
    """A pilot may fly it by hand without GPS: whoever gave it up would leave it without the agent's heartbeat."""
    clock = SimClock()
    modes = (Mode.TRACKING if had_position else Mode.STATE_STALE, Mode.STATE_STALE)
    timing = SimpleNamespace(tick_ms=1.0)

    class Heard:
        ask, refused_frames, outcome, has_armed, done = None, NOTHING_REFUSED, "completed", True, False

        @property
        def heard_us(self) -> int:
            return clock.now_us()

        def tick(self, now_us: int, missed: int) -> Any:
            return SimpleNamespace(mode=modes[now_us >= 1_000_000], timing=timing)

        @property
        def finished(self) -> bool:
            return clock.now_us() > 90_000_000

    if had_position:
        assert flown(Heard(), clock) == EXIT_OK
    else:
        with pytest.raises(StartError, match="no heartbeat and position within"):
            flown(Heard(), clock)


def flown(agent: Any, clock: SimClock) -> int:
    """Fly a scripted agent in real time's loop, on a simulated clock; return its exit code."""

    def sleep_until(t_us: int) -> None:
        clock.advance(max(1, t_us - clock.now_us()))

    paced: Any = SimpleNamespace(now_us=clock.now_us, sleep_until=sleep_until)
    stop: Any = SimpleNamespace(count=0)
    sessions: Any = SimpleNamespace(step=lambda: None)
    flight = RealTimeAgent(agent, load(None), paced, stop, sessions, note=print, vehicle="udpin://x", only_land=False)
    return _fly(flight, paced, FlightPriority(paced, print)).exit_code


@pytest.mark.skipif(not hasattr(time, "CLOCK_BOOTTIME"), reason="Linux alone tells how long it was suspended")
def test_time_goes_on_while_the_host_is_suspended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "clock_gettime_ns", {time.CLOCK_BOOTTIME: 9_000_000_000}.__getitem__)
    assert (WallClock().now_us(), monotonic_us()) == (9_000_000, 9_000_000)


def test_a_step_of_the_hosts_utc_is_followed_slowly() -> None:
    elapsed_ns, stepped_ns = 0, 0

    def utc_ns() -> int:
        return 1_700_000_000_000_000_000 + elapsed_ns + stepped_ns

    clock = WallClock(lambda: 5_000_000_000 + elapsed_ns, utc_ns)
    began_us = before_us = clock.utc_us()
    stepped_ns = -500_000_000
    for _ in range(100):
        elapsed_ns += 20_000_000
        now_us = clock.utc_us()
        assert 19_800 <= now_us - before_us <= 20_200, "neither back nor on"
        before_us = now_us
    assert began_us + 2_000_000 - before_us == pytest.approx(20_000, abs=10), "1 % of the time that has passed"
    elapsed_ns += 100_000_000_000
    assert clock.utc_us() == utc_ns() // 1000


def test_garbage_is_collected_in_flight_though_not_while_modules_load() -> None:
    gc.disable()  # as the verb does
    try:
        keep_from_collections()
        assert gc.isenabled()
    finally:
        gc.enable()
