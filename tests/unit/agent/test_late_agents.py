"""An agent that comes after its swarm has begun without it, and that has no vehicle, holds up nobody."""

from __future__ import annotations

import msgspec

from swarmctl.bus import topics
from swarmctl.bus.bus import agent_name
from swarmctl.bus.messages.json_messages import encode_message
from swarmctl.core.types import Phase
from tests import builders
from tests.benches.agent_and_peer import Bench

LATE = 2


def committed_beside_one_that_only_says_that_it_is_there(*, is_excused: bool) -> int:
    """Return how often the agent commits anew within 10 s, from two seconds after its begin on."""
    bench = Bench(peers=(1, LATE))
    if is_excused:
        bench.world_model.statuses.exclude(LATE)
    bench.fly(2.0, each=bench.send)
    before, bus, count = bench.committed, bench.hub.connect(agent_name(LATE)), 0
    bench.alive.add(agent_name(LATE))

    def each() -> None:
        nonlocal count
        bench.send()
        count += 1
        if count % 10 == 1:
            status = builders.status_message(agent=LATE, utc_us=bench.clock.utc_us(), phase=Phase.CONNECT)
            bus.publish(
                topics.STATUS,
                encode_message(msgspec.structs.replace(status, uses_commitments=True, boot_id=77, ticks=count)),
            )

    bench.fly(10.0, each=each)
    return bench.committed - before


def test_who_was_flown_without_and_has_come_without_a_vehicle_is_waited_for_by_nobody() -> None:
    assert committed_beside_one_that_only_says_that_it_is_there(is_excused=True) >= 90


def test_control_who_belongs_to_the_swarm_from_the_beginning_is_waited_for() -> None:
    assert committed_beside_one_that_only_says_that_it_is_there(is_excused=False) == 0
