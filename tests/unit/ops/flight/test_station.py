"""What a station records of a swarm that flies elsewhere, besides ticks."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from swarmctl.bus.bus import agent_name
from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.messages.json_messages import encode_message, first_list
from swarmctl.bus.topics import OBSTACLES, STATUS, TICK
from swarmctl.core.obstacle import Obstacle
from swarmctl.ops.flight.station import SwarmWatch
from swarmctl.ops.supervision.status_table import PlainLines
from swarmctl.telemetry.recording.obstacle_lists import recorded_obstacles

BALL = Obstacle(center_ned_m=(5.0, 0.0, -2.0), radius_m=0.5, keep_out_m=1.0)


def test_lists_of_obstacles_are_recorded_once_for_the_referee(tmp_path: Path) -> None:
    hub, noted = LocalHub(lambda: time.monotonic_ns() // 1000), list[dict[str, Any]]()
    bus = hub.connect("station", {TICK: [agent_name(0)], STATUS: [agent_name(0)], OBSTACLES: ["alpha"]})
    host, stranger = hub.connect("alpha"), hub.connect("bravo")
    with (tmp_path / "said").open("w") as said:
        watch = SwarmWatch(
            bus, 1, tmp_path, PlainLines(said), lambda event, **row: noted.append({"event": event, **row})
        )
        lists: list[tuple[int, tuple[Obstacle, ...]]] = [(1, ()), (2, (BALL,)), (2, (BALL,)), (3, ())]
        for version, obstacles in lists:
            host.publish(OBSTACLES, encode_message(first_list(obstacles, 1_000_000 * version, version)))
            stranger.publish(OBSTACLES, encode_message(first_list((BALL, BALL), 0, version + 1)))
            assert not watch.step()
            noted[-1].setdefault("utc_us", 1_000_000 * version)  # as the event log does
        watch.close()
    assert [row["version"] for row in noted] == [1, 2, 3]
    (judged,) = recorded_obstacles((), noted)
    assert (judged.obstacle, judged.since_utc_us, judged.until_utc_us) == (BALL, 2_000_000, 3_000_000)
