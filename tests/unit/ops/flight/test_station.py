"""What a station records of a swarm that flies elsewhere, besides ticks, and when it ends."""

from __future__ import annotations

import time
from collections.abc import Iterator
from io import StringIO
from pathlib import Path
from typing import Any

import msgspec
import pytest

from swarmctl.bus.bus import agent_name
from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.messages.json_messages import (
    EndedMessage,
    ListedObstacle,
    decode_obstacles,
    encode_message,
    first_list,
)
from swarmctl.bus.topics import ENDED, EVENT, OBSTACLES, STATUS, TICK
from swarmctl.control.phases.obeyed_orders import OPERATOR_STOP
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Phase
from swarmctl.flown_code import code_in_words
from swarmctl.ops.flight.station import SwarmWatch
from swarmctl.ops.supervision.status_table import PlainLines
from swarmctl.telemetry.evaluation.referee import Rules, evaluate
from swarmctl.telemetry.recording.obstacle_lists import recorded_obstacles
from swarmctl.telemetry.recording.run_files import load_run, read_events
from swarmctl.wall_clock import WallClock
from tests.builders import status_message
from tests.unit.telemetry.test_referee import run, ticks

HERE = code_in_words(own_folder="")  # what this station runs
BALL = Obstacle(center_ned_m=(5.0, 0.0, -2.0), radius_m=0.5, keep_out_m=1.0)


def test_lists_of_obstacles_are_recorded_once_for_the_referee(tmp_path: Path) -> None:
    hub, noted = LocalHub(lambda: time.monotonic_ns() // 1000), list[dict[str, Any]]()
    bus = hub.connect("station", {TICK: [agent_name(0)], STATUS: [agent_name(0)], OBSTACLES: ["alpha"]})
    host, stranger = hub.connect("alpha"), hub.connect("bravo")
    with (tmp_path / "said").open("w") as said:
        watch = SwarmWatch(
            bus,
            1,
            tmp_path,
            PlainLines(said),
            lambda event, **row: noted.append({"event": event, **row}),
            vouchers={"alpha": {0}},
        )
        lists: list[tuple[int, tuple[Obstacle, ...]]] = [(1, ()), (2, (BALL,)), (2, (BALL,)), (3, ())]
        for version, obstacles in lists:
            host.publish(OBSTACLES, encode_message(first_list(obstacles, 1_000_000 * version, version)))
            stranger.publish(OBSTACLES, encode_message(first_list((BALL, BALL), 0, version + 1)))
            assert not watch.step()
            noted[-1].setdefault("utc_us", 1_000_000 * version)  # as the event log does
    assert [row["version"] for row in noted] == [1, 2, 3]
    (judged,) = recorded_obstacles((), noted)
    assert (judged.obstacle, judged.since_utc_us, judged.until_utc_us) == (BALL, 2_000_000, 3_000_000)


def test_a_station_repeats_what_operators_set_and_says_that_a_list_of_its_own_was_overruled(tmp_path: Path) -> None:
    now_us = 50_000_000
    hub, said = LocalHub(lambda: now_us), StringIO()
    bus = hub.connect("station", {STATUS: [], TICK: [], OBSTACLES: ["alpha", "station"]})
    alpha = hub.connect("alpha", {OBSTACLES: ["station"]})
    clock, noted = WallClock(lambda: 1000 * now_us, lambda: 1000 * now_us), list[str]()
    watch = SwarmWatch(
        bus,
        0,
        tmp_path,
        PlainLines(said),
        lambda event, **_: noted.append(event),
        vouchers={},
        list_setters=("alpha", "station"),
        clock=clock,
    )
    first = first_list((), now_us)
    ball = ListedObstacle(number=0, since_utc_us=now_us, obstacle=BALL)
    for sender, draw in (("station", 5), ("alpha", 9)):
        message = first.changed((ball,) if sender == "station" else (), draw)
        hub.carry(sender, OBSTACLES, encode_message(msgspec.structs.replace(message, proposed=sender == "station")))
        now_us += 1_100_000
        watch.step()
    watch.close()
    now_us += 1
    repeated = [decode_obstacles(payload) for _, payload in alpha.receive(OBSTACLES)]
    assert [(m.draw, m.proposed) for m in repeated if m][-2:] == [(5, False), (9, False)]
    assert "obstacles_overruled" in noted
    assert "version 2 of the obstacles was overruled" in said.getvalue()
    assert "obstacle 0 of it is gone" in said.getvalue()


class Watched:
    """A station that watches three agents, on a scripted clock."""

    def __init__(self, folder: Path) -> None:
        self.now_s, self.noted = 1000.0, list[tuple[str, Any]]()
        self._hub = LocalHub(lambda: round(1e6 * self.now_s))
        names = [agent_name(agent) for agent in range(3)]
        self._agents = [self._hub.connect(name) for name in names]
        self._hosts = {name: self._hub.connect(name) for name in ("alpha", "bravo")}
        hears = {STATUS: names, TICK: names, EVENT: names, OBSTACLES: [], ENDED: [*self._hosts]}
        bus = self._hub.connect("station", hears)
        vouchers = {"alpha": {0, 2}, "bravo": {1}}
        self.said = StringIO()
        self.watch = SwarmWatch(
            bus, 3, folder, PlainLines(self.said), self._note, lambda: self.now_s, vouchers=vouchers
        )

    def _note(self, event: str, **fields: Any) -> None:
        self.noted.append((event, fields.get("agents")))

    def tell(self, agent: int, payload: bytes) -> None:
        """Have an agent publish an event, or what is none."""
        self._agents[agent].publish(EVENT, payload)
        self.now_s += 0.2

    def end(self, agent: int, *, boot_id: int | None = 1, is_down: bool, host: str = "bravo") -> None:
        """Have a host say that a process has ended."""
        ended = EndedMessage(agent=agent, boot_id=boot_id, is_down=is_down)
        self._hosts[host].publish(ENDED, encode_message(ended))

    def run(
        self,
        seconds: float,
        phases: dict[int, Phase],
        armed: bool = True,
        *,
        starts: int = 1,
        outcome: str = "completed",
        without: tuple[int, ...] = (),
        code: str = HERE,
    ) -> bool:
        """Return whether the station ends while agents report these phases; the others are silent.

        Args:
            seconds: for how long.
            phases: of agents, by number.
            armed: whether those that are not done are armed.
            starts: which process of theirs it is.
            outcome: of those that are done.
            without: peers that they do not wait for.
            code: that they fly.
        """
        for _ in range(round(seconds / 0.2)):
            for agent, phase in phases.items():
                status = status_message(agent=agent, phase=phase)
                status = msgspec.structs.replace(status, boot_id=starts, without=without, code=code)
                done = msgspec.structs.replace(status, armed=False, outcome=outcome)
                status = done if phase == Phase.DONE else msgspec.structs.replace(status, armed=armed, outcome="")
                self._agents[agent].publish(STATUS, encode_message(status))
            if self.watch.step():
                return True
            self.now_s += 0.2
        return False


@pytest.fixture
def watched(tmp_path: Path) -> Iterator[Watched]:
    station = Watched(tmp_path)
    yield station
    station.watch.close()


ALL_TRACK = dict.fromkeys(range(3), Phase.TRACK)
LOST = "agent-1 was lost in TRACK: nothing was heard of it for 90 s"


def test_a_station_says_that_nothing_arrives_of_agents_that_are_there(watched: Watched) -> None:
    """As beside another station, which was told everything in its place."""
    deaf = ("station_deaf", [0, 1, 2])
    assert not watched.run(4.8, {})
    assert deaf not in watched.noted
    watched.run(4.0, {})
    assert watched.noted.count(deaf) == 1, "once"
    assert "Another station is running" in watched.said.getvalue()
    watched.run(10.0, {0: Phase.TRACK})
    watched.run(6.0, {})
    assert watched.noted.count(deaf) == 2, "again after something had arrived"


def test_a_station_ends_without_an_agent_that_was_lost_in_flight_and_says_so(watched: Watched) -> None:
    assert not watched.run(5.0, ALL_TRACK)
    assert not watched.run(80.0, {0: Phase.TRACK, 2: Phase.TRACK})
    assert not watched.run(6.0, {0: Phase.DONE, 2: Phase.DONE})
    assert not watched.run(3.8, {}), "89.8 s"
    assert watched.run(0.4, {})
    watched.watch.close()
    assert watched.watch.problems == [LOST]


def test_who_is_heard_again_is_not_lost(watched: Watched) -> None:
    assert not watched.run(5.0, ALL_TRACK)
    assert not watched.run(120.0, {0: Phase.TRACK, 2: Phase.TRACK})
    assert not watched.run(5.0, ALL_TRACK)
    assert not watched.run(2.0, dict.fromkeys(range(3), Phase.DONE))
    assert watched.run(5.0, {})
    assert watched.watch.problems == []


def test_who_was_heard_on_the_ground_alone_is_waited_for(watched: Watched) -> None:
    assert not watched.run(2.0, dict.fromkeys(range(3), Phase.STANDBY), armed=False)
    assert not watched.run(2.0, {0: Phase.DONE, 2: Phase.DONE})
    assert not watched.run(200.0, {})
    watched.watch.close()
    assert watched.watch.problems == []


def test_who_armed_without_order_is_lost_too(watched: Watched) -> None:
    assert not watched.run(2.0, dict.fromkeys(range(3), Phase.STANDBY))
    assert watched.run(95.0, {})
    assert [line.split(":")[0] for line in watched.watch.problems] == [
        f"agent-{i} was lost in STANDBY" for i in range(3)
    ]


@pytest.mark.parametrize("starts", [1, 2])
def test_who_is_taken_over_in_flight_by_another_process_is_no_operators_landing(watched: Watched, starts: int) -> None:
    assert not watched.run(5.0, ALL_TRACK)
    assert not watched.run(5.0, {1: Phase.CONNECT}, starts=starts)
    assert not watched.run(1.0, {0: Phase.DONE, 2: Phase.DONE})
    assert not watched.run(1.0, {1: Phase.DONE}, starts=starts, outcome=OPERATOR_STOP)
    assert watched.run(5.0, {})
    ended = ["agent-1 ended in TRACK, and another process took its vehicle over"]
    assert (watched.watch.problems, watched.watch.was_stopped) == (([], True) if starts == 1 else (ended, False))


def test_who_is_started_again_on_the_ground_has_not_failed(watched: Watched) -> None:
    assert not watched.run(2.0, dict.fromkeys(range(3), Phase.STANDBY), armed=False)
    assert not watched.run(5.0, ALL_TRACK, starts=2)
    assert not watched.run(2.0, dict.fromkeys(range(3), Phase.DONE), starts=2)
    assert watched.run(5.0, {})
    assert watched.watch.problems == []


def test_ctrl_c_names_who_is_silent_in_flight(watched: Watched) -> None:
    assert not watched.run(5.0, ALL_TRACK)
    assert not watched.run(12.0, {0: Phase.TRACK, 2: Phase.DONE})
    watched.watch.close()
    assert watched.watch.problems == ["agent-1 was lost in TRACK: nothing was heard of it for 12 s"]


def test_ctrl_c_names_nobody_who_is_unheard_for_a_moment(watched: Watched) -> None:
    assert not watched.run(5.0, ALL_TRACK)
    assert not watched.run(4.0, {0: Phase.TRACK})
    watched.watch.close()
    assert watched.watch.problems == []


@pytest.mark.parametrize(
    ("code", "told"),
    [
        (HERE, ""),
        (f"{HERE} with own modules 9be41f07", ""),  # a station has none
        ("swarmctl 0.1.0 (5d0c2a11)", "agent-0 flies swarmctl 0.1.0 (5d0c2a11), and "),
        ("", "agent-0 flies an older swarmctl, and "),
    ],
)
def test_a_station_says_once_that_agents_fly_another_swarmctl(watched: Watched, code: str, told: str) -> None:
    watched.run(2.0, ALL_TRACK, code=code)
    assert [event for event, _ in watched.noted if event == "other_code"] == (["other_code"] if told else [])
    assert told in watched.said.getvalue()


def test_nobody_is_lost_while_the_station_itself_stands_still(watched: Watched) -> None:
    assert not watched.run(5.0, ALL_TRACK)
    assert not watched.run(1.0, {})
    watched.now_s += 600.0
    assert not watched.run(1.0, {})
    watched.watch.close()
    assert watched.watch.problems == []


OTHERS = (0, 2)
OTHERS_TRACK, OTHERS_DONE = dict.fromkeys(OTHERS, Phase.TRACK), dict.fromkeys(OTHERS, Phase.DONE)


def test_who_was_excluded_is_not_waited_for_and_the_verdict_says_so(watched: Watched) -> None:
    assert not watched.run(2.0, OTHERS_TRACK, without=(1,))
    assert not watched.run(2.0, OTHERS_DONE, without=(1,))
    assert watched.run(5.0, {})
    assert (watched.watch.problems, watched.noted[-1]) == ([], ("flown_without", [1]))
    assert "the others went on without agent-1" in watched.said.getvalue()


@pytest.mark.parametrize("phase", [Phase.STANDBY, Phase.DONE])
def test_an_excluded_agent_that_comes_too_late_is_not_judged(watched: Watched, phase: Phase) -> None:
    assert not watched.run(2.0, OTHERS_TRACK, without=(1,))
    assert not watched.run(2.0, {1: phase}, armed=False, outcome="the mission has begun without it")
    assert not watched.run(2.0, OTHERS_DONE)
    assert watched.run(5.0, {1: phase}, armed=False, outcome="the mission has begun without it")
    assert (watched.watch.problems, watched.noted[-1]) == ([], ("flown_without", [1]))


def test_an_excluded_agent_that_flies_after_all_is_waited_for(watched: Watched) -> None:
    assert not watched.run(2.0, dict.fromkeys(OTHERS, Phase.STANDBY), armed=False, without=(1,))
    assert not watched.run(2.0, ALL_TRACK)
    assert not watched.run(2.0, OTHERS_DONE)
    assert not watched.run(60.0, {1: Phase.TRACK})
    assert not watched.run(2.0, {1: Phase.DONE}, outcome="geofence")
    assert watched.run(5.0, {})
    assert watched.watch.problems == ["agent-1 failed: geofence"]
    assert watched.noted == []


def test_nobody_goes_on_without_everybody(watched: Watched) -> None:
    assert not watched.run(2.0, dict.fromkeys(range(3), Phase.STANDBY), armed=False, without=(0, 1, 2))


@pytest.mark.parametrize("boot_id", [1, None])
def test_who_has_ended_on_the_ground_is_not_waited_for_and_is_named(watched: Watched, boot_id: int | None) -> None:
    if boot_id is not None:
        assert not watched.run(2.0, {1: Phase.STANDBY}, armed=False)
    assert not watched.run(2.0, OTHERS_TRACK)
    watched.end(1, boot_id=boot_id, is_down=True)
    assert not watched.run(2.0, OTHERS_DONE)
    assert watched.run(5.0, {})
    heard = "none" if boot_id is None else "STANDBY"
    assert watched.watch.problems == [f"agent-1 failed: it has ended, and its last phase heard is {heard}"]


def test_whose_vehicle_is_down_is_told_to_operators_until_another_process_speaks_for_it(watched: Watched) -> None:
    assert not watched.run(2.0, ALL_TRACK)
    watched.end(1, is_down=True)
    assert not watched.run(1.0, OTHERS_TRACK)
    assert list(watched.watch.down) == [], "its last statuses may be on their way"
    assert not watched.run(3.0, OTHERS_TRACK)
    assert list(watched.watch.down) == [1]
    assert not watched.run(0.4, ALL_TRACK, starts=2)
    assert list(watched.watch.down) == []
    assert not watched.run(10.0, OTHERS_TRACK)
    assert list(watched.watch.down) == [], "of this process nobody has said that it has ended"


def test_the_news_of_an_end_may_come_before_the_last_status(watched: Watched) -> None:
    assert not watched.run(2.0, ALL_TRACK)
    assert not watched.run(2.0, OTHERS_DONE)
    assert not watched.run(4.0, {1: Phase.TRACK})
    watched.end(1, is_down=True)
    assert not watched.run(0.2, {1: Phase.TRACK})
    assert not watched.run(0.2, {1: Phase.DONE})
    assert watched.run(5.0, {})
    assert watched.watch.problems == []


def test_old_news_of_an_end_does_not_end_the_next_process(watched: Watched) -> None:
    assert not watched.run(2.0, {1: Phase.STANDBY}, armed=False)
    watched.end(1, is_down=True)
    assert not watched.run(2.0, dict.fromkeys(range(3), Phase.TRACK), starts=2)
    assert not watched.run(5.0, OTHERS_DONE, starts=2)
    watched.end(1, is_down=True)
    assert not watched.run(60.0, {1: Phase.TRACK}, starts=2)
    assert not watched.run(2.0, {1: Phase.DONE}, starts=2)
    assert watched.run(5.0, {})
    assert watched.watch.problems == []


def test_who_died_is_named_also_where_its_vehicle_never_left_the_ground(watched: Watched) -> None:
    assert not watched.run(2.0, {1: Phase.STANDBY}, armed=False)
    watched.end(1, is_down=False)
    assert not watched.run(5.0, OTHERS_TRACK)
    watched.end(1, is_down=False)
    assert not watched.run(2.0, {1: Phase.DONE}, starts=2, outcome=OPERATOR_STOP)
    watched.end(1, boot_id=2, is_down=True)
    assert not watched.run(2.0, OTHERS_DONE)
    assert watched.run(5.0, {})
    died = ["agent-1 died before its vehicle was down"]
    assert (watched.watch.problems, watched.watch.was_stopped) == (died, False)


def test_who_has_completed_its_mission_and_handed_its_vehicle_over_in_the_air_has_not_died(watched: Watched) -> None:
    assert not watched.run(2.0, ALL_TRACK)
    assert not watched.run(2.0, dict.fromkeys(range(3), Phase.DONE))
    watched.end(1, is_down=False)
    assert watched.run(5.0, {})
    assert watched.watch.problems == []
    assert "vehicle 2 (agent-1) was left to its autopilot" in watched.said.getvalue()


def test_another_process_that_was_done_does_not_excuse_one_that_died(watched: Watched) -> None:
    assert not watched.run(2.0, {1: Phase.STANDBY}, armed=False)
    assert not watched.run(2.0, {1: Phase.DONE}, starts=2)
    watched.end(1, is_down=False)
    assert not watched.run(2.0, OTHERS_TRACK)
    assert not watched.run(2.0, OTHERS_DONE)
    assert watched.run(5.0, {})
    assert watched.watch.problems == ["agent-1 died before its vehicle was down"]


def test_only_who_runs_an_agent_says_that_it_has_ended(watched: Watched) -> None:
    assert not watched.run(2.0, {1: Phase.STANDBY}, armed=False)
    assert not watched.run(2.0, OTHERS_TRACK)
    watched.end(1, is_down=True, host="alpha")
    assert not watched.run(2.0, OTHERS_DONE)
    assert not watched.run(60.0, {})


@pytest.mark.parametrize("heard", [False, True])
def test_of_whom_nothing_is_known_the_station_says_so_once_all_others_have_flown(watched: Watched, heard: bool) -> None:
    if heard:
        assert not watched.run(1.0, {1: Phase.STANDBY}, armed=False)
    assert not watched.run(30.0, dict.fromkeys(OTHERS, Phase.STANDBY), armed=False)
    assert not watched.run(30.0, OTHERS_TRACK)
    assert not watched.run(20.0, OTHERS_DONE), "80 s"
    assert watched.run(15.0, {})
    known = "was last heard in STANDBY" if heard else "was never heard"
    assert watched.watch.problems == [f"agent-1 {known}: nothing was heard of it for 90 s"]


def test_ctrl_c_judges_what_is_known_and_names_who_had_not_ended(watched: Watched) -> None:
    assert not watched.run(2.0, ALL_TRACK)
    assert not watched.run(2.0, {0: Phase.DONE, 1: Phase.TRACK, 2: Phase.TRACK}, outcome="geofence")
    watched.watch.close()
    assert watched.watch.problems == ["agent-0 failed: geofence"]
    assert not watched.watch.is_over
    assert watched.noted == [("not_ended", [1, 2])]
    assert "had not ended: agent-1 (TRACK), agent-2 (TRACK)" in watched.said.getvalue()


def test_ctrl_c_of_a_flight_that_is_over_is_no_interruption(watched: Watched) -> None:
    assert not watched.run(2.0, OTHERS_TRACK, without=(1,))
    assert not watched.run(1.0, OTHERS_DONE)
    watched.watch.close()
    assert (watched.watch.is_over, watched.watch.problems) == (True, [])
    assert watched.noted == [("flown_without", [1])]


def test_the_judge_of_a_station_knows_of_missions_that_were_set_in_flight(watched: Watched, tmp_path: Path) -> None:
    """Agent 1 says so in the name of agent 2, which has flown as short as it without being asked to."""
    changed = {"utc_us": 6, "t_us": 5, "event": "mission_changed", "duration_s": 20.0}
    for agent, source in ((0, "agent-0"), (1, "agent-2")):
        watched.tell(agent, msgspec.json.encode(changed | {"source": source}))
    assert not watched.run(0.2, ALL_TRACK)
    watched.watch.close()
    places = [(0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (6.0, 0.0, 0.0)]
    flown = run({agent: ticks(20, place) for agent, place in enumerate(places)}, events=load_run(tmp_path).events)
    rules = Rules(agents=3, required_separation_m=0.5, duration_s=38.0)
    assert evaluate(flown, rules, "completed")["violations"] == ["mission time 20.0 s of agent 2 below 38 s"]


def test_events_that_arrive_as_the_station_ends_are_recorded(watched: Watched, tmp_path: Path) -> None:
    watched.tell(1, b'{"utc_us": 6, "t_us": 5, "event": "bus_summary", "sent": {}}')
    watched.watch.close()
    assert [(row["source"], row["event"]) for row in read_events(tmp_path)] == [("agent-1", "bus_summary")]


def test_what_is_no_event_is_counted_and_not_recorded(watched: Watched, tmp_path: Path) -> None:
    for payload in (b"[]", b'{"utc_us": 6, "t_us": 5, "event": "started", "agents": [0, 1, 2]}'):
        watched.tell(1, payload)
    watched.watch.step()
    watched.watch.close()
    assert [event for event, _ in watched.noted if event != "not_ended"] == ["refused", "refused"]
    refused = [f"event in the name of agent-1 refused: {why}" for why in ("malformed", "identity")]
    assert [text for text in refused if text not in watched.said.getvalue()] == []
    assert read_events(tmp_path) == []
