"""A process of `bench --scale`: the agents of one host, who publish and receive as in flight and do nothing else.

It prints a line when all have joined the bus. A line on standard input begins what is measured, and another one ends
it; then it prints what it has measured, a `Measured` as JSON, and goes on until standard input is closed.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import struct
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field

from swarmctl.bus.bus import Bus, agent_name
from swarmctl.bus.network.joining import join_bus
from swarmctl.bus.network.roster import OwnIdentity, identity_of_json
from swarmctl.bus.network.sealed_bus import FOR_AGENTS_US
from swarmctl.bus.topics import PATH, STATUS, TICK, Topic
from swarmctl.process_lifetime import serve_parent
from swarmctl.wall_clock import WallClock

RUN = "bench"
TICK_S = 0.02
SIZES_BYTES: Mapping[Topic, int] = {PATH: 534, TICK: 573, STATUS: 753}  # of three agents that fly a circle
STATUS_TICKS = 10
_HEARD = (PATH, STATUS)
_SENT_AT_US = struct.Struct("<q")


@dataclass(slots=True)
class Measured:
    """What the agents of one host have taken from its computer, and heard."""

    processor_s: float = 0.0
    heard_bytes: int = 0
    path_ages_ms: list[float] = field(default_factory=list)


def load_command_arguments(endpoint: str, identity: OwnIdentity, agents: int, own: Sequence[int]) -> tuple[str, ...]:
    """Return the arguments of a process of this module.

    Args:
        endpoint: of the host's router.
        identity: the host's.
        agents: of the whole swarm.
        own: those of this host.
    """
    return (endpoint, identity.as_json(), f"{agents}", ",".join(map(str, own)))


def _bus(endpoint: str, identity: OwnIdentity, agents: int, own: int, clock: WallClock) -> Bus:
    peers = [agent_name(agent) for agent in range(agents) if agent != own]
    listens = dict.fromkeys(_HEARD, peers)
    me = agent_name(own)
    return join_bus(endpoint, RUN, me, listens, identity=identity, max_age_us=FOR_AGENTS_US, utc_us=clock.utc_us)


def _publish(bus: Bus, tick: int, now_us: int) -> None:
    for topic, size_bytes in SIZES_BYTES.items():
        if topic is not STATUS or tick % STATUS_TICKS == 0:
            bus.publish(topic, _SENT_AT_US.pack(now_us).ljust(size_bytes, b"\0"))


def _receive(bus: Bus, measured: Measured, clock: WallClock) -> None:
    for topic in _HEARD:
        for _, payload in bus.receive(topic):
            measured.heard_bytes += len(payload)
            if topic is PATH:
                (sent_at_us,) = _SENT_AT_US.unpack_from(payload)
                measured.path_ages_ms.append((clock.now_us() - sent_at_us) * 1e-3)


def _lines() -> Iterator[bool]:
    """Yield whether a line has come on standard input since the last time, until that is closed."""
    while True:
        is_readable, _, _ = select.select([sys.stdin], [], [], 0.0)
        read = os.read(sys.stdin.fileno(), 64) if is_readable else None
        if read == b"":
            return
        yield read is not None


def main() -> None:
    """Run the agents of one host."""
    parser = argparse.ArgumentParser(prog="python -m sitl.studies.bench.bus_load")
    for name in ("endpoint", "identity", "agents", "own"):
        parser.add_argument(name)
    options = parser.parse_args()
    serve_parent()
    clock, identity = WallClock(), identity_of_json(options.identity)
    own = [int(agent) for agent in options.own.split(",")]
    buses = [_bus(options.endpoint, identity, int(options.agents), agent, clock) for agent in own]
    print("joined", flush=True)
    measured, tick, due_s, is_measuring, began_s = Measured(), 0, time.monotonic(), False, 0.0
    for has_line in _lines():
        if has_line and is_measuring:
            measured.processor_s = time.process_time() - began_s
            print(json.dumps(asdict(measured)), flush=True)
        if has_line:
            measured, is_measuring, began_s = Measured(), not is_measuring, time.process_time()
        for bus in buses:
            _receive(bus, measured, clock)
            _publish(bus, tick, clock.now_us())
        tick, due_s = tick + 1, due_s + TICK_S
        time.sleep(max(0.0, due_s - time.monotonic()))


if __name__ == "__main__":
    main()
