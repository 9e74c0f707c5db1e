"""Measures what protections cost: seals and MAVLink signatures a tick; encryption, access control and seals the bus.

    python tools/protection_cost.py --flights 3 --seconds 10

The tick is that of `configs/three_hosts.toml` in lockstep, with and without, in turn tick by tick; the flights are the
same bit for bit. The bus is three routers on loopback, with two clients each that say and hear as much as agents do.
Times are processor times, which a busy machine changes less.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from ipaddress import ip_address
from pathlib import Path
from unittest import mock

import psutil

from sitl.lockstep import Lockstep
from sitl.studies.bench.free_ports import free_ports
from swarmctl.agent.agent import Agent
from swarmctl.bus.bus import Bus, Subscriptions, agent_name
from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.network.hosts import HostParams, links_of, roster_of
from swarmctl.bus.network.identities import make_identities
from swarmctl.bus.network.identity_files import STATION
from swarmctl.bus.network.joining import join_bus
from swarmctl.bus.network.roster import OwnIdentity, identity_of_json
from swarmctl.bus.network.sealed_bus import FOR_AGENTS_US
from swarmctl.bus.topics import PATH, STATUS, TICK, TRAJECTORY
from swarmctl.bus.zenoh.client import SCHEME
from swarmctl.config import Config, load
from swarmctl.core.recorded.tick_record import TickRecord
from swarmctl.core.types import Phase
from swarmctl.mavlink.signing.key_file import write_new_key
from swarmctl.wall_clock import WallClock
from tests.benches.sealed_hub import SealedHub

CONFIG = Path(__file__).parents[1] / "configs" / "three_hosts.toml"
LOOPBACK = ip_address("127.0.0.1")
FLIGHT_S = 15.0
SAID = {PATH: 632, TRAJECTORY: 1800, TICK: 1500, STATUS: 900}  # bytes, about as in flight
TICK_S, STATUS_TICKS = 0.02, 10
RUN_ROUTER = "from swarmctl.bus.network.router import main\nraise SystemExit(main())"
OPEN = """import swarmctl.bus.network.router_links as links
from swarmctl.bus.topics import TOPICS
rule = {
    "id": "no datagrams",
    "permission": "deny",
    "flows": ["egress"],
    "messages": ["put"],
    "key_exprs": [f"swarm/*/*/{topic.name}" for topic in TOPICS if not topic.reliable],
}
links.access_settings = lambda *_: {
    "access_control": {
        "enabled": True,
        "default_permission": "allow",
        "rules": [rule],
        "subjects": [{"id": "links", "link_protocols": ["quic", "udp"]}],
        "policies": [{"rules": ["no datagrams"], "subjects": ["links"]}],
    }
}
"""  # else what goes by datagrams goes by links as well, and round and round between them
OVER_UDP = """import json
import swarmctl.bus.network.router as router
opened = router.open_session
router.open_session = lambda settings: opened(json.loads(json.dumps(settings).replace("quic/", "udp/")))
"""
PLAIN_DATAGRAMS = """import swarmctl.bus.network.datagrams as datagrams
class Plain:
    def __init__(self, key): pass
    def encrypt(self, nonce, body, header): return body + bytes(16)
    def decrypt(self, nonce, body, header): return body[:-16]
datagrams.ChaCha20Poly1305 = Plain
"""
Connect = Callable[[LocalHub, str, Subscriptions | None], Bus]
UNPROTECTED = "neither encrypted nor checked"
LAWFUL = ("-m", "swarmctl.bus.network.router")


def ticks_ms(cases: Mapping[str, tuple[Config, Connect | None]]) -> dict[str, list[float]]:
    """Return the processor time of every tick of the mission in each case, flown in turn, tick by tick."""
    spent_ms: dict[str, list[float]] = {case: [] for case in cases}
    tick, flying = Agent.tick, ""

    def timed(agent: Agent, now_us: int, deadline_misses: int) -> TickRecord:
        began_ns = time.thread_time_ns()
        record = tick(agent, now_us, deadline_misses)
        if record.phase is Phase.TRACK:
            spent_ms[flying].append((time.thread_time_ns() - began_ns) * 1e-6)
        return record

    flights = {}
    for case, (config, connect) in cases.items():
        with mock.patch.object(LocalHub, "connect", LocalHub.connect if connect is None else connect):
            flights[case] = Lockstep(config)
    with mock.patch.object(Agent, "tick", timed):
        while any(flight.clock.now_us() < FLIGHT_S * 1e6 for flight in flights.values()):
            for flying, flight in flights.items():  # noqa: B007  (`timed` reads it)
                flight.step()
    return spent_ms


def compare_ticks(flights: int) -> None:
    """Print the median tick with and without seals and signatures."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        plain = load(CONFIG, ["sitl.start=air"])
        files = [str(folder / f"{agent}.key") for agent in range(plain.swarm.agents)]
        for file in files:
            write_new_key(Path(file))
        signed = load(CONFIG, ["sitl.start=air", f"mavlink.signing_keys={files}"])
        connect = SealedHub.of(plain.hosts, folder / "identities").connect
        cases = {"neither": (plain, None), "seals": (plain, connect), "seals, signatures": (signed, connect)}
        runs = [ticks_ms(cases) for _ in range(flights)]
    least = {case: [min(same) for same in zip(*(run[case] for run in runs), strict=True)] for case in cases}
    before_ms = statistics.median(least["neither"])
    for case, ticks in least.items():
        more_ms = statistics.median(after - before for after, before in zip(ticks, least["neither"], strict=True))
        p50_ms = statistics.median(ticks)
        print(f"tick, {case}: p50 {p50_ms:.3f} ms; each {1e3 * more_ms:+.0f} us, {100 * more_ms / before_ms:+.1f} %")


def client(endpoint: str, me: str, identity: str, seconds: float) -> None:
    """Say and hear as much as an agent for some time, then print the processor time of this process [s]."""
    own = identity_of_json(identity)
    others = [name for speaker in own.roster.speakers for name in speaker.senders[1:] if name != me]
    listen = dict.fromkeys((PATH, TRAJECTORY, STATUS), others)
    sealing = None if os.environ.get("PLAIN") else own
    clock = WallClock()
    bus = join_bus(endpoint, "run", me, listen, identity=sealing, max_age_us=FOR_AGENTS_US, utc_us=clock.utc_us)
    payloads, heard = {topic: os.urandom(size) for topic, size in SAID.items()}, 0
    time.sleep(1.5)  # until the links are up
    began_s, spent_s = time.monotonic(), time.process_time()
    for tick in range(round(seconds / TICK_S)):
        for topic in listen:
            heard += len(bus.receive(topic))
        for topic, payload in payloads.items():
            if topic is not STATUS or tick % STATUS_TICKS == 0:
                bus.publish(topic, payload)
        time.sleep(max(0.0, began_s + (tick + 1) * TICK_S - time.monotonic()))
    print(f"{time.process_time() - spent_s:.4f} {heard}", flush=True)
    bus.close()


@contextlib.contextmanager
def routers(folder: Path, hosts: Sequence[HostParams], module: Sequence[str]) -> Iterator[dict[str, psutil.Process]]:
    """Run the routers of some hosts, each with its socket in a folder of its name."""
    started = []
    for host in hosts:
        identity = OwnIdentity(folder=str(folder), name=host.name, roster=roster_of(hosts, relay=False))
        place = Path(tempfile.mkdtemp(prefix=f"sw-{host.name}"))
        command = [sys.executable, *module, f"{SCHEME}{place}/bus.sock", "--die-with-parent"]
        command += links_of(hosts, identity).arguments()
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        process.stdout.readline()
        started.append((process, place))
    try:
        yield {str(place): psutil.Process(process.pid) for process, place in started}
    finally:
        for process, _ in started:
            process.terminate()
            process.wait(10)


def bus_s(folder: Path, hosts: Sequence[HostParams], module: Sequence[str], plain: bool, seconds: float) -> float:
    """Return the processor time of routers and clients [s]."""
    with routers(folder, hosts, module) as running:
        spent = {place: sum(process.cpu_times()[:2]) for place, process in running.items()}
        clients = []
        for host, place in zip(hosts, running, strict=True):
            identity = OwnIdentity(folder=str(folder), name=host.name, roster=roster_of(hosts, relay=False))
            for agent in host.agents:
                command = [sys.executable, __file__, "--client", f"{SCHEME}{place}/bus.sock", agent_name(agent)]
                command += [identity.as_json(), "--seconds", str(seconds)]
                environment = {**os.environ, **({"PLAIN": "1"} if plain else {})}
                clients.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment))
        said = [client.communicate()[0].split() for client in clients]
        total_s = sum(float(spent_s) for spent_s, _ in said)
        return total_s + sum(sum(process.cpu_times()[:2]) - spent[place] for place, process in running.items())


def compare_bus(seconds: float, runs: int) -> None:
    """Print the processor time of the bus with and without encryption, access control and seals."""
    cases = {
        UNPROTECTED: (("-c", OPEN + OVER_UDP + PLAIN_DATAGRAMS + RUN_ROUTER), True),
        "encrypted, by TLS and datagram by datagram": (("-c", OPEN + RUN_ROUTER), True),
        "and access control": (LAWFUL, True),
        "and seals": (LAWFUL, False),
    }
    with tempfile.TemporaryDirectory() as name:
        hosts = [
            HostParams(name=f"host-{i}", address=f"127.0.0.1:{port}", agents=(2 * i, 2 * i + 1))
            for i, port in enumerate(free_ports(3))
        ]
        make_identities(Path(name), {**{host.name: LOOPBACK for host in hosts}, STATION: None})
        spent: dict[str, list[float]] = {case: [] for case in cases}
        for _ in range(runs):
            for case, (module, plain) in cases.items():
                spent[case].append(bus_s(Path(name), hosts, module, plain, seconds))
    before_s = statistics.median(spent[UNPROTECTED])
    for case, found_s in spent.items():
        median_s = statistics.median(found_s)
        change = 100 * (median_s / before_s - 1)
        print(f"bus, {case}: {100 * median_s / seconds:.1f} % of a processor, {change:+.1f} %", flush=True)


def main() -> None:
    """Measure both and print a line for each case."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--flights", type=int, default=3, help="of each case; 0: only the bus")
    parser.add_argument("--seconds", type=float, default=10.0, help="on the bus, three times each case; 0: only ticks")
    parser.add_argument("--client", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.client:
        endpoint, me, identity = options.client
        client(endpoint, me, identity, options.seconds)
        return
    if options.seconds:
        compare_bus(options.seconds, 3)
    if options.flights:
        compare_ticks(options.flights)


if __name__ == "__main__":
    main()
