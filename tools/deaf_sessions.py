"""How sessions of Zenoh go deaf: restarts a router under clients that limit the opening of a session, and counts them.

    python tools/deaf_sessions.py --open-timeout-ms 2 --restarts 5
    python tools/deaf_sessions.py

A client gives up the opening of a session after a time limit, also when half of it is done: then it sends and is kept
alive, but never reads (Zenoh 1.10.2). With 2 ms that happens to some of a dozen clients at each restart; with 2 s it
happened to supervisors that got no processor for so long. By default the limit is that of `swarmctl`, with which none
goes deaf. Here nothing replaces who is deaf.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence

import swarmctl.bus.zenoh.client as zenoh_client
from swarmctl.bus.topics import COMMAND, STATUS
from swarmctl.bus.zenoh.bus import ZenohBus
from swarmctl.bus.zenoh.client import SCHEME
from swarmctl.errors import StartError
from tests.benches.router_process import start_router

NEVER_S = 1e9
CONNECTED_S = 3.0  # after a restart
LISTEN_S = 1.5


def joined(endpoint: str, name: str) -> ZenohBus:
    """Join a listener, again while the limit is too short for it."""
    while True:
        try:
            return ZenohBus(endpoint, "run", name, {STATUS: ["talker"]}, connect_timeout_ms=500, deaf_s=NEVER_S)
        except StartError:
            continue


def who_hears(talker: ZenohBus, listeners: Sequence[ZenohBus]) -> tuple[list[bool], int]:
    """Return whether each listener hears the talker, and how many listeners are heard."""
    hearing, heard = [False] * len(listeners), set[str]()
    until_s = time.monotonic() + LISTEN_S
    while time.monotonic() < until_s:
        talker.publish(STATUS, b"status")
        for number, listener in enumerate(listeners):
            listener.publish(COMMAND, b"command")
            hearing[number] |= bool(listener.receive(STATUS))
        heard |= {name for name, _ in talker.receive(COMMAND)}
        time.sleep(0.02)
    return hearing, len(heard)


def main() -> None:
    """Restart the router, and print how many are deaf each time."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--open-timeout-ms", type=int, default=zenoh_client._CLIENT_OPEN_TIMEOUT_MS)
    parser.add_argument("--clients", type=int, default=12)
    parser.add_argument("--restarts", type=int, default=5)
    options = parser.parse_args()
    endpoint = f"{SCHEME}{tempfile.mkdtemp(prefix='swarm-deaf-')}/bus.sock"
    router = start_router(endpoint)
    names = [f"listener-{number}" for number in range(options.clients)]
    talker = ZenohBus(endpoint, "run", "talker", {COMMAND: names}, deaf_s=NEVER_S)
    zenoh_client._CLIENT_OPEN_TIMEOUT_MS = options.open_timeout_ms
    listeners = [joined(endpoint, name) for name in names]
    for restart in range(options.restarts):
        router.kill()
        router.wait()
        router = start_router(endpoint)
        time.sleep(CONNECTED_S)
        who_hears(talker, listeners)  # takes away what is old
        hearing, heard = who_hears(talker, listeners)
        print(f"restart {restart + 1}: {hearing.count(False)} of {len(names)} deaf, {heard} heard", flush=True)
    router.terminate()
    router.wait()


if __name__ == "__main__":
    main()
