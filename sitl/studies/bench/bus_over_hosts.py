"""The bus of a swarm whose agents are on one host or on more: what it costs, and how old paths are that are heard.

All hosts are on this computer, each with its router, identity and links as in docs/hosts.md, and a process of agents.
"""

from __future__ import annotations

import contextlib
import ipaddress
import json
import os
import subprocess
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil

from sitl.studies.bench.bus_load import Measured, load_command_arguments
from sitl.studies.bench.free_ports import free_ports
from swarmctl.bus.network.hosts import HostParams, links_of, roster_of
from swarmctl.bus.network.identities import make_identities
from swarmctl.bus.network.identity_files import STATION
from swarmctl.bus.network.roster import OwnIdentity
from swarmctl.bus.zenoh.client import SCHEME
from swarmctl.errors import StartError
from swarmctl.process_lifetime import PARENT_ENV, module_command

AGENTS = 12  # of the swarm
_LOOPBACK = ipaddress.ip_address("127.0.0.1")
_SETTLES_S = 2.0  # after all have joined: routers find each other
_END_S = 20.0


@dataclass(frozen=True, slots=True, kw_only=True)
class BusCost:
    """What the bus of a swarm costs."""

    real_time_per_core: float  # seconds of agents, added up, in one second of a processor
    heard_bytes_per_agent_s: float
    path_age_p50_ms: float
    path_age_p99_ms: float


def bus_cost(hosts: int, seconds: float) -> BusCost:
    """Return what the bus of `AGENTS` agents on so many hosts costs, measured for some seconds.

    Raises:
        StartError: a router or the agents of a host don't come up.
    """
    with tempfile.TemporaryDirectory(prefix="swarm-bench-") as folder, contextlib.ExitStack() as stack:
        swarm = _hosts(hosts)
        keys = Path(folder) / "keys"
        make_identities(keys, {**{host.name: _LOOPBACK for host in swarm}, STATION: None})
        roster = roster_of(swarm, relay=False)
        routers, agents = list[subprocess.Popen[str]](), list[subprocess.Popen[str]]()
        for number, host in enumerate(swarm):
            identity = OwnIdentity(folder=str(keys), name=host.name, roster=roster)
            endpoint = f"{SCHEME}{folder}/{number}/bus.sock"
            Path(folder, f"{number}").mkdir(mode=0o700)
            links = links_of(swarm, identity).arguments()
            routers.append(_start(stack, "swarmctl.bus.network.router", endpoint, "--die-with-parent", *links))
            _line(routers[-1], f"the router of {host.name}")
            arguments = load_command_arguments(endpoint, identity, AGENTS, host.agents)
            agents.append(_start(stack, "sitl.studies.bench.bus_load", *arguments))
        for process in agents:
            _line(process, "the agents of a host")
        time.sleep(_SETTLES_S)
        return _measured(routers, agents, seconds)


def _measured(
    routers: Sequence[subprocess.Popen[str]], agents: Sequence[subprocess.Popen[str]], seconds: float
) -> BusCost:
    spent_s, began_s = -sum(processor_s(router.pid) for router in routers), time.monotonic()
    _tell(agents)
    time.sleep(seconds)
    _tell(agents)
    flown_s = AGENTS * (time.monotonic() - began_s)
    spent_s += sum(processor_s(router.pid) for router in routers)
    heard = [Measured(**json.loads(_line(process, "the agents of a host"))) for process in agents]
    ages_ms = np.concatenate([each.path_ages_ms for each in heard])
    if not len(ages_ms):
        raise StartError("bench --hosts: nobody has heard a path")
    p50_ms, p99_ms = np.percentile(ages_ms, (50, 99)).tolist()
    return BusCost(
        real_time_per_core=flown_s / (spent_s + sum(each.processor_s for each in heard)),
        heard_bytes_per_agent_s=sum(each.heard_bytes for each in heard) / flown_s,
        path_age_p50_ms=p50_ms,
        path_age_p99_ms=p99_ms,
    )


def _hosts(count: int) -> tuple[HostParams, ...]:
    shares = (tuple(range(AGENTS * k // count, AGENTS * (k + 1) // count)) for k in range(count))
    ports = free_ports(count)
    return tuple(
        HostParams(name=f"host-{k}", address=f"{_LOOPBACK}:{ports[k]}", agents=share) for k, share in enumerate(shares)
    )


def _start(stack: contextlib.ExitStack, module: str, *arguments: str) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        module_command(module, *arguments),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, PARENT_ENV: f"{os.getpid()}"},
    )
    stack.callback(_end, process)
    return process


def _end(process: subprocess.Popen[str]) -> None:
    process.terminate()
    try:
        process.communicate(timeout=_END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()


def _line(process: subprocess.Popen[str], name: str) -> str:
    assert process.stdout is not None
    line = process.stdout.readline()
    if not line:
        raise StartError(f"bench --hosts: {name} did not come up")
    return line


def _tell(processes: Sequence[subprocess.Popen[str]]) -> None:
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()


def processor_s(pid: int) -> float:
    """Return the processor time that a process has used."""
    times = psutil.Process(pid).cpu_times()
    return float(times.user + times.system)
