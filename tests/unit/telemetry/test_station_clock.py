"""A station judges vehicles of several computers at the same instants, whatever their clocks say."""

from __future__ import annotations

from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from swarmctl.bus.bus import agent_name
from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.topics import OBSTACLES, STATUS, TICK
from swarmctl.core.json_safe import to_json
from swarmctl.core.recorded.records import pack_tick
from swarmctl.core.types import Phase
from swarmctl.ops.flight.station import SwarmWatch
from swarmctl.ops.flight.summary import summary_lines
from swarmctl.ops.supervision.status_table import PlainLines
from swarmctl.telemetry.evaluation.referee import Rules, RunData, evaluate
from swarmctl.telemetry.evaluation.station_clock import corrected_text
from swarmctl.telemetry.recording.run_files import load_run, write_parquet
from swarmctl.telemetry.recording.summary_file import decode_summary
from swarmctl.telemetry.report.run_charts import RunCharts
from swarmctl.telemetry.report.run_report import summary_rows
from swarmctl.wall_clock import WallClock
from tests.unit.telemetry.test_referee import UTC0_US, run, ticks

RULES = Rules(agents=2, required_separation_m=0.85)
BOOTED_US = 5_000_000_000  # time at the station since it was started, less that at the senders
SPEED_M_S = 1.8
FLOWN_S = 20.0


def crossing(least_m: float, ahead_s: float) -> list[NDArray[np.void]]:
    """Return the ticks of two agents that cross at right angles; the second one's UTC is ahead.

    Agent 1 is late at the crossing by as much as makes their least distance `least_m`.
    """
    t_s = ticks(FLOWN_S, (0.0, 0.0, 0.0))["mission_t_s"] - FLOWN_S / 2
    zero = np.zeros_like(t_s)
    north = ticks(FLOWN_S, np.column_stack([SPEED_M_S * t_s, zero, zero]))
    east = ticks(FLOWN_S, np.column_stack([zero, SPEED_M_S * t_s - np.sqrt(2.0) * least_m, zero]))
    east["t_us"] += 777_000_000  # its computer was started before
    east["utc_us"] += round(ahead_s * 1e6)
    return [north, east]


class Station:
    """A station that is told of a flight, with delays of 3 ms and more, and looks for messages every 50 ms.

    Its computer has been suspended for a while since it was started, in which one of its two monotonic clocks stood.
    """

    def __init__(self, folder: Path, flown: list[NDArray[np.void]], suspended_s: float = 0.0) -> None:
        self.now_s, self.events = BOOTED_US * 1e-6, list[dict[str, Any]]()
        names = [agent_name(agent) for agent in range(len(flown))]
        hub = LocalHub(lambda: round(1e6 * self.now_s))
        senders = [hub.connect(name) for name in names]
        bus = hub.connect("station", {STATUS: names, TICK: names, OBSTACLES: []})
        own = WallClock(lambda: round(1e9 * self.now_s), lambda: round(1e9 * self.now_s))
        awake_s = lambda: self.now_s - suspended_s  # noqa: E731
        watch = SwarmWatch(bus, len(flown), folder, PlainLines(StringIO()), self._note, awake_s, vouchers={}, clock=own)
        self._note("started", agents=[])
        rng = np.random.default_rng([1, 0, 0])
        for tick in range(len(flown[0])):
            sent_s = (BOOTED_US + int(flown[0]["t_us"][tick])) * 1e-6
            for sender, rows in zip(senders, flown, strict=True):
                self.now_s = max(self.now_s, sent_s + 0.003 + float(rng.exponential(0.003)))
                sender.publish(TICK, pack_tick(rows[tick : tick + 1], None))
            if tick % 5 == 0:
                self.now_s += float(rng.uniform(0.0, 0.005))
                watch.step()
        watch.close()
        self.run = replace(load_run(folder), events=self.events)

    def _note(self, event: str, **fields: Any) -> None:
        t_us = round(1e6 * self.now_s)
        self.events.append(
            {"event": event, "source": "launch", "t_us": t_us, "utc_us": t_us - BOOTED_US + UTC0_US, **fields}
        )


@pytest.mark.parametrize(
    ("least_m", "ahead_s", "by_stamps_m"), [(0.89, -0.5, 0.25), (0.25, 0.5, 0.89), (0.89, 0.0, 0.89)]
)
def test_distances_are_judged_by_the_stations_clock(
    tmp_path: Path, least_m: float, ahead_s: float, by_stamps_m: float
) -> None:
    station = Station(tmp_path, crossing(least_m, ahead_s))
    assert {len(rows) for rows in station.run.ticks.values()} == {round(50 * FLOWN_S) + 1}
    summary = evaluate(station.run, RULES, "completed")
    assert summary["separation"]["min_m"] == pytest.approx(least_m, abs=0.02)
    assert summary["outcome"] == ("completed" if least_m > RULES.required_separation_m else "failed")
    drawn_m = RunCharts(station.run, summary, RULES).nearest_pair()["y"]
    assert np.nanmin(drawn_m) == pytest.approx(least_m, abs=0.02)

    launched = replace(station.run, events=[{"event": "started", "agents": [0, 1]}])
    of_launch = evaluate(launched, RULES, "failed")
    assert of_launch["clocks"] is None, "one computer has one clock"
    assert of_launch["separation"]["min_m"] == pytest.approx(by_stamps_m, abs=0.02), "negative control"


def test_clocks_that_were_corrected_are_told(tmp_path: Path) -> None:
    summary = evaluate(Station(tmp_path, crossing(0.89, 0.5)).run, RULES, "completed")
    assert [clock["ahead_s"] for clock in summary["clocks"]] == pytest.approx([0.0, 0.5], abs=0.01)
    assert "; clocks corrected: agent 1 0.50 s ahead" in summary_lines(summary, tmp_path)[1]
    row = next(row for row in summary_rows(summary, RULES) if row.name.startswith("clocks"))
    assert row.value == "agent 1 0.50 s ahead"


def test_a_station_on_a_computer_that_has_been_suspended_sets_no_clock_by_that(tmp_path: Path) -> None:
    """All ticks were taken for those of an hour and a half before, and obstacles set in flight for later ones."""
    summary = evaluate(Station(tmp_path, crossing(0.89, 0.0), suspended_s=5400.0).run, RULES, "completed")
    assert [clock["ahead_s"] for clock in summary["clocks"]] == pytest.approx([0.0, 0.0], abs=0.01)


def test_what_a_station_has_not_heard_is_not_laid_to_an_agent(tmp_path: Path) -> None:
    run = Station(tmp_path, crossing(0.89, 0.0)).run
    rows = run.ticks[1]
    cut = replace(run, ticks={**run.ticks, 1: np.delete(rows, slice(100, 150))})
    silent = [text for text in evaluate(cut, RULES, "completed")["violations"] if text.startswith("agent 1")]
    assert len(silent) == 1
    assert silent[0].startswith("agent 1 was not heard by the station for 1.0 s, from ")
    rows = run.ticks[1] = rows.copy()
    rows["state_age_ms"][100:150] = 20.0 * np.arange(50)
    (stale,) = [text for text in evaluate(run, RULES, "completed")["violations"] if text.startswith("agent 1")]
    assert "did not know where its armed vehicle was" in stale


def test_events_of_an_agent_are_judged_and_drawn_by_the_stations_clock(tmp_path: Path) -> None:
    flown = crossing(2.0, 3600.0)
    station = Station(tmp_path, flown)
    first = [{"utc_us": int(rows["utc_us"][0]), "t_us": int(rows["t_us"][0])} for rows in flown]
    lost = {**first[0], "source": "agent-0", "event": "unresponsive", "agent": 1, "begins": True}
    late_us = first[1]["utc_us"] + 19_000_000
    said = {**first[1], "utc_us": late_us, "source": "agent-1", "event": "operator", "verb": "hold"}
    recorded = replace(station.run, events=[*station.run.events, lost, said])
    summary = evaluate(recorded, RULES, "completed")
    assert summary["comms"]["unresponsive"]["longest_s"] == pytest.approx(20.0, abs=1.5), "not an hour"
    charts = RunCharts(recorded, summary, RULES)
    (order,) = [event for event in charts.events if event["event"] == "operator"]
    assert charts.time_of(order) == pytest.approx(19.0, abs=0.1)
    assert said["utc_us"] == late_us, "what was recorded stays"


def test_a_station_that_began_late_says_from_when_it_has_seen_whom(tmp_path: Path) -> None:
    whole = run_of_station(ticks(20, (2.0, 0.0, 0.0)), (0, 0), (1, 0))
    for rows in whole.ticks.values():
        rows["phase"][0] = Phase.STANDBY
    summary = evaluate(whole, RULES, "completed")
    assert summary["seen_late"] == []
    assert not any("not seen from the start" in line for line in summary_lines(summary, tmp_path))
    late = replace(whole, ticks={0: whole.ticks[0], 1: whole.ticks[1][250:]})
    summary = evaluate(late, RULES, "completed")
    assert summary["outcome"] == "completed", "the station is no judge of what was before"
    assert summary["seen_late"] == [{"id": 1, "phase": "TRACK", "from_s": pytest.approx(5.0)}]
    assert decode_summary(to_json(summary).encode())["seen_late"] == summary["seen_late"]
    line = "not seen from the start, and not judged before: agent 1 from 5.0 s on, in TRACK"
    assert line in summary_lines(summary, tmp_path)
    assert evaluate(replace(late, events=[]), RULES, "completed")["seen_late"] is None


def test_differences_as_small_as_a_delay_are_not_told() -> None:
    clocks = [{"id": agent, "ahead_s": ahead_s} for agent, ahead_s in enumerate((None, 0.03, -0.03))]
    assert corrected_text(clocks) == corrected_text(None) == ""
    far = [{"id": agent, "ahead_s": -2.0} for agent in range(5)]
    assert corrected_text(far) == "agent 0 2.00 s behind, agent 1 2.00 s behind, agent 2 2.00 s behind, 2 more"


def run_of_station(rows: NDArray[np.void], *measured: tuple[int, int]) -> RunData:
    """Return a run of agent 0, whose clock is the station's, and of an agent 1 with these ticks."""
    events: list[dict[str, Any]] = [{"event": "started", "agents": [], "t_us": 0, "utc_us": UTC0_US}]
    events += [{"event": "sender_clock", "agent": agent, "behind_us": behind_us} for agent, behind_us in measured]
    return run({0: ticks(20, (0.0, 0.0, 0.0)), 1: rows}, events=events)


def test_who_has_a_clock_that_is_not_known_is_not_judged() -> None:
    near = ticks(20, (0.2, 0.0, 0.0))
    again = near.copy()
    again["t_us"][500:] -= again["t_us"][500]  # the computer was started again
    unknown = (
        run_of_station(near, (0, 0)),
        run_of_station(again, (0, 0), (1, 0)),
        run_of_station(near, (0, 0), (1, 2**62)),
    )
    for recorded in unknown:
        summary = evaluate(recorded, RULES, "completed")
        assert summary["separation"]["min_m"] is None
        assert "agent 1 can't be judged" in summary["violations"][0]
        assert summary["violations"][1].startswith("agent 1: its clock is not known")
        assert summary["clocks"] == [{"id": 0, "ahead_s": 0.0}, {"id": 1, "ahead_s": None}]
    judged = evaluate(run_of_station(near, (0, 0), (1, 9_000), (1, 0), (1, 7_000)), RULES, "completed")
    assert (judged["separation"]["min_m"], judged["clocks"][1]["ahead_s"]) == (pytest.approx(0.2), 0.0)


DAY_US = 86_400_000_000


def restarted(before_us: int, utc_before_us: int, after_us: int | None = None) -> NDArray[np.void]:
    """Return ticks of an agent whose clocks were off by so much for the first 5 s, its monotonic one after, too."""
    rows = ticks(20, (2.0, 0.0, 0.0))
    rows["t_us"][:250] += before_us
    rows["utc_us"][:250] += utc_before_us
    rows["t_us"][250:] += after_us or 0
    return rows


def with_junk() -> NDArray[np.void]:
    rows = ticks(20, (2.0, 0.0, 0.0))
    rows["t_us"][250] = 2**62
    return rows


@pytest.mark.parametrize(
    ("rows", "is_known"),
    [
        (ticks(20, (2.0, 0.0, 0.0)), True),
        (restarted(DAY_US, -60_000_000), False),
        (restarted(3 * DAY_US, -60_000_000), False),
        (restarted(0, -7 * DAY_US), True),
        (restarted(0, -7 * DAY_US, 3 * DAY_US), False),
        (with_junk(), False),
    ],
    ids=["as ever", "up for a day", "up for three days", "clock set by a week", "both", "junk"],
)
@pytest.mark.parametrize("packed", [False, True])
def test_a_computer_that_is_started_again_costs_the_verdict_on_its_agent_alone(
    tmp_path: Path, rows: NDArray[np.void], is_known: bool, packed: bool
) -> None:
    """Nothing at all was judged where one clock spanned more than 48 hours."""
    recorded = run_of_station(rows, (0, 0), (1, 0), (2, 0))
    flown = {**recorded.ticks, 2: ticks(20, (0.0, 3.0, 0.0))}
    for agent, each in flown.items():
        write_rows(tmp_path, agent, each, packed=packed)
    lines = [to_json({"source": "launch", **event}) for event in recorded.events]
    (tmp_path / "launch.events.jsonl").write_text("\n".join(lines))
    summary = evaluate(load_run(tmp_path), replace(RULES, agents=3), "completed")
    ahead_s = {clock["id"]: clock["ahead_s"] for clock in summary["clocks"]}
    assert (ahead_s[0], ahead_s[2]) == (0.0, 0.0)
    assert (ahead_s[1] is not None) is is_known
    assert summary["separation"]["min_m"] == pytest.approx(2.0 if is_known else 3.0)
    assert any("agent 1: its clock is not known" in text for text in summary["violations"]) is not is_known
    assert not any("agent 0" in text or "agent 2" in text for text in summary["violations"])


def write_rows(folder: Path, agent: int, rows: NDArray[np.void], *, packed: bool) -> None:
    if packed:
        write_parquet(folder / f"agent-{agent}.parquet", rows)
    else:
        (folder / f"agent-{agent}.ticks").write_bytes(rows.tobytes())
