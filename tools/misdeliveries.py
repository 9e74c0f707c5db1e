"""How messages of Zenoh come under keys of others: stops processes that listen for a moment, again and again.

    python tools/misdeliveries.py --minutes 5

Twelve processes publish and hear as much as agents do. Three listen, and are stopped for a second or so, one after the
other. With Zenoh 1.10.2 six messages at once came under the keys of others, and one in another play of four minutes,
while the machine did other work as well; in another quarter of an hour none did. In two of twelve flights of twelve
agents on a busy machine, from each of which one was killed, dozens did. The cause is not known.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence

from swarmctl.bus.bus import agent_name
from swarmctl.bus.topics import PATH, STATUS, TICK, TRAJECTORY
from swarmctl.bus.zenoh.bus import ZenohBus
from swarmctl.bus.zenoh.client import SCHEME
from tests.benches.router_process import start_router

SPEAKERS, LISTENERS = [agent_name(agent) for agent in range(12)], 3
SAID = {PATH: 632, TRAJECTORY: 900, TICK: 1500, STATUS: 2200}  # bytes, about as in flight
HEARD = (PATH, TICK, STATUS)
TICK_S, STATUS_TICKS, POLL_S, STOPPED_S = 0.025, 5, 0.02, 1.0


def speak(endpoint: str, me: str, until_s: float) -> None:
    """Publish, and hear paths of the others, as an agent does."""
    others = [name for name in SPEAKERS if name != me]
    bus, tick = ZenohBus(endpoint, "run", me, {PATH: others}), 0
    while time.monotonic() < until_s:
        for topic, size in SAID.items():
            if topic is not STATUS or tick % STATUS_TICKS == 0:
                bus.publish(topic, os.urandom(size))
        tick += 1
        bus.receive(PATH)
        time.sleep(random.expovariate(1.0 / TICK_S))
    bus.close()


def listen(endpoint: str, me: str, until_s: float) -> None:
    """Receive what all say, and print how many messages came, and how many under keys of others."""
    bus, counts = ZenohBus(endpoint, "run", me, dict.fromkeys(HEARD, SPEAKERS)), Counter[str]()
    while time.monotonic() < until_s:
        counts["heard"] += sum(len(bus.receive(topic)) for topic in HEARD)
        counts["misdelivered"] += len(bus.refused())
        time.sleep(random.expovariate(1.0 / POLL_S))
    print(f"{me}: {counts['heard']} messages, {counts['misdelivered']} under keys of others", flush=True)
    bus.close()


def stop_in_turn(processes: Sequence[subprocess.Popen[str]], until_s: float) -> None:
    """Stop one process after the other for about `STOPPED_S`."""
    while time.monotonic() < until_s:
        process = random.choice(processes)
        process.send_signal(signal.SIGSTOP)
        time.sleep(random.expovariate(1.0 / STOPPED_S))
        process.send_signal(signal.SIGCONT)
        time.sleep(random.expovariate(1.0 / STOPPED_S))


def main() -> None:
    """Run the router, everybody else, and stop listeners."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--process", nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.process:
        role, endpoint, me, until_s = options.process
        {"speak": speak, "listen": listen}[role](endpoint, me, float(until_s))
        return
    endpoint = f"{SCHEME}{tempfile.mkdtemp(prefix='swarm-')}/bus.sock"
    with start_router(endpoint) as router:
        until_s = time.monotonic() + 60.0 * options.minutes

        def start(role: str, me: str) -> subprocess.Popen[str]:
            command = [sys.executable, __file__, "--process", role, endpoint, me, str(until_s)]
            return subprocess.Popen(command, text=True)

        speakers = [start("speak", name) for name in SPEAKERS]
        listeners = [start("listen", f"listener-{number}") for number in range(LISTENERS)]
        stop_in_turn(listeners, until_s - 2.0 * STOPPED_S)
        for started in (*speakers, *listeners):
            started.wait()
        router.terminate()


if __name__ == "__main__":
    main()
