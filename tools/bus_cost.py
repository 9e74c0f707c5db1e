"""What the bus costs agents that share processes: with a session for each agent, and with one for each process.

    python tools/bus_cost.py --agents 20 --processes 2

Agents only publish and receive, as much as in flight without commitments, at 50 Hz; somebody else receives their ticks.
Of the router and of all agents together it prints the share of one processor, one way after the other in each repeat,
since machines are shared, and the medians of the repeats.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

from sitl.studies.bench.bus_load import SIZES_BYTES, STATUS_TICKS, TICK_S
from sitl.studies.bench.bus_over_hosts import processor_s
from swarmctl.bus.bus import agent_name
from swarmctl.bus.topics import COMMAND, OPERATOR, PATH, RELAY, STATUS, TICK, TRAJECTORY, Topic
from swarmctl.bus.zenoh.bus import ZenohBus
from swarmctl.bus.zenoh.client import SCHEME
from swarmctl.bus.zenoh.session import SharedSession, ZenohSession
from tests.benches.router_process import start_router

SESSIONS: dict[str, Callable[[], Callable[..., ZenohSession]]] = {
    "a session for each agent": lambda: ZenohSession,
    "one for each process": SharedSession,
}
HEARD = (PATH, STATUS, TRAJECTORY, RELAY)
SETTLES_S = 1.0


class Load(NamedTuple):
    """Describes shares of one processor."""

    router_01: float
    agents_01: float

    def __str__(self) -> str:
        return f"router {self.router_01:.3f}, agents {self.agents_01:.3f}"


def tick_for_ever(endpoint: str, way: str, agents: int, own: Sequence[int]) -> None:
    """Publish and receive as agents of one process do."""
    opens = SESSIONS[way]()
    buses = []
    for agent in own:
        others = [agent_name(i) for i in range(agents) if i != agent]
        listen: dict[Topic, Sequence[str]] = {**dict.fromkeys(HEARD, others), COMMAND: [OPERATOR]}
        buses.append(ZenohBus(endpoint, "run", agent_name(agent), listen, opens=opens))
    print("joined", flush=True)
    tick, due_s = 0, time.monotonic()
    while True:
        for bus in buses:
            for topic in (*HEARD, COMMAND):
                bus.receive(topic)
            bus.alive()
            for topic, size in SIZES_BYTES.items():
                if topic is not STATUS or tick % STATUS_TICKS == 0:
                    bus.publish(topic, bytes(size))
        tick, due_s = tick + 1, due_s + TICK_S
        time.sleep(max(0.0, due_s - time.monotonic()))


def measured(way: str, agents: int, processes: int, seconds: float) -> Load:
    """Run a swarm one way, and return what it takes."""
    with tempfile.TemporaryDirectory(prefix="swarm-cost-") as folder:
        return _measured(f"{SCHEME}{folder}/bus.sock", way, agents, processes, seconds)


def _measured(endpoint: str, way: str, agents: int, processes: int, seconds: float) -> Load:
    router = start_router(endpoint)
    shares = [range(agents)[i::processes] for i in range(processes)]
    started = [
        subprocess.Popen(
            [sys.executable, __file__, "--process", endpoint, way, str(agents), ",".join(map(str, share))],
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        )
        for share in shares
    ]
    try:
        for process in started:
            assert process.stdout is not None
            process.stdout.readline()
        watcher = ZenohBus(endpoint, "run", "watcher", {TICK: [agent_name(i) for i in range(agents)]})
        time.sleep(SETTLES_S)
        pids = [router.pid, *(process.pid for process in started)]
        before, began_s = [processor_s(pid) for pid in pids], time.monotonic()
        while time.monotonic() < began_s + seconds:
            watcher.receive(TICK)
            time.sleep(TICK_S)
        took_s = time.monotonic() - began_s
        of_router_s, *of_agents_s = (processor_s(pid) - spent_s for pid, spent_s in zip(pids, before, strict=True))
        watcher.close()
    finally:
        for process in (*started, router):
            process.kill()
            process.communicate()
    return Load(of_router_s / took_s, sum(of_agents_s) / took_s)


def main() -> None:
    """Measure each way in turn, and print medians."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--agents", type=int, default=20)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--process", nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.process:
        endpoint, way, agents, own = options.process
        tick_for_ever(endpoint, way, int(agents), [int(agent) for agent in own.split(",")])
        return
    found: dict[str, list[Load]] = {way: [] for way in SESSIONS}
    for _ in range(options.repeats):
        for way, loads in found.items():
            loads.append(measured(way, options.agents, options.processes, options.seconds))
            print(f"{way}: {loads[-1]}", flush=True)
    for way, loads in found.items():
        print(f"median, {way}: {Load(*(statistics.median(each) for each in zip(*loads, strict=True)))}")


if __name__ == "__main__":
    main()
