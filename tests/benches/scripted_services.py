"""Services of scripted processes, for flights whose parts end, freeze or answer as a test wants."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec

from swarmctl.bus.bus import agent_name
from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.messages.json_messages import (
    EndedMessage,
    StatusMessage,
    decode_command,
    decode_ended,
    encode_message,
)
from swarmctl.bus.topics import COMMAND, ENDED, OBSTACLES, OPERATOR, STATUS
from swarmctl.config import load
from swarmctl.core.types import Phase
from swarmctl.ops.processes import ROUTER, Child, Command, RunContext, kill_all
from swarmctl.ops.supervision.launch_result import LaunchResult
from swarmctl.ops.supervision.status_table import AgentView
from swarmctl.ops.supervision.supervisor import FlightSupervisor, Services
from swarmctl.telemetry.recording.event_log import EventLog
from swarmctl.wall_clock import WallClock
from tests import builders

LANDS_ON_SIGTERM = """
import signal, sys, time
def land(*_):
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a second one would kill an interpreter that is on its way out
    sys.exit(130)
signal.signal(signal.SIGTERM, land)
print('up', flush=True)
"""
IGNORES_SIGTERM = """
import signal, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
print('up', flush=True)
time.sleep(60)
"""
LOADS_MODULES = "import time; print('up', flush=True); time.sleep(60)"  # SIGTERM ends it, as nothing handles it yet
FLIES_LONG = LANDS_ON_SIGTERM + "time.sleep(60)"


def ends(code: int, after_s: float = 0.3) -> str:
    return LANDS_ON_SIGTERM + f"time.sleep({after_s}); print('because'); sys.exit({code})"


def status_of(agent: int, phase: Phase, utc_us: int, held: bool = False) -> StatusMessage:
    return builders.status_message(agent=agent, phase=phase, utc_us=utc_us, held=held)


class ScriptedServices(Services):
    """Services made of scripted processes; it is also the display, which the flight calls once in every step."""

    def __init__(self, directory: Path, agents: Sequence[str], others: dict[str, str] | None = None) -> None:
        self.clock = WallClock()
        self.log = EventLog(directory / "launch.events.jsonl", "launch")
        self.context = RunContext("run", "unixsock-stream//nowhere", directory, tuple(range(len(agents))))
        scripts = {agent_name(i): script for i, script in enumerate(agents)} | (others or {ROUTER: FLIES_LONG})
        self.children = {
            name: Child(Command(name, (sys.executable, "-ESc", script)), directory) for name, script in scripts.items()
        }
        deadline_s = time.monotonic() + 30.0
        for name, child in self.children.items():  # what is sent a signal has to be there to take it
            while "'up'" in scripts[name] and not child.line_with("up") and time.monotonic() < deadline_s:
                time.sleep(0.01)
        self.hub = LocalHub(lambda: time.monotonic_ns() // 1000)
        self.bus = self.hub.connect(OPERATOR)
        self.agents = [self.hub.connect(agent_name(i)) for i in range(len(agents))]
        self.directory = directory
        self.lands = ends(130, 0.5)  # what recovers a vehicle
        self.router = FLIES_LONG  # what is started in place of a router that has ended
        self.recovered: list[int] = []
        self.said: list[str] = []
        self.interrupts = 0
        self.silent: set[int] = set()
        self.down: tuple[int, ...] = ()  # agents of other computers, as the last step has said
        self.orders: list[str] = []
        self.boot_ids = [1 for _ in agents]  # of the processes that are heard
        self.ended: list[EndedMessage] = []  # as the first agent has received them
        self.heard: list[tuple[int, bytes]] = []  # orders as the first agent has received them, and when
        self.stamped_us: list[tuple[int, int]] = []  # of each order, by how much it was stamped before we heard it
        self.behind_us = 0  # by how much the agents' clock is behind ours
        self.obeys = True
        self.phase = Phase.TRACK
        self.phases: dict[int, Phase] = {}  # of agents whose phase is another one
        self.held = False
        self.vehicle: dict[str, object] = {}  # what statuses say otherwise of vehicles
        self.ends_s: float | None = None  # monotonic time at which what all agents fly ends by itself
        self.act: Callable[[], None] = lambda: None
        self.began_s = time.monotonic()

    def announce(self, view: str) -> None:
        self.said.append(f"announced {view}")

    def announce_clock(self) -> None:
        return

    def announce_down(self, agents: tuple[int, ...]) -> None:
        self.down = agents

    def restart_router(self) -> None:
        self.children[ROUTER] = Child(Command(ROUTER, (sys.executable, "-ESc", self.router)), self.directory)

    def recover(self, agent: int) -> Child:
        self.recovered.append(agent)
        self.boot_ids[agent] += 1
        return Child(Command(agent_name(agent), (sys.executable, "-ESc", self.lands)), self.directory)

    def join_as_operator(self) -> None:
        """Receive under its own name, which operators' commands use too."""
        self.hub.detach(OPERATOR)
        senders = [agent_name(i) for i in range(len(self.agents))]
        self.bus = self.hub.connect(OPERATOR, {OBSTACLES: [OPERATOR], STATUS: senders})

    def print_line(self, text: str) -> None:
        self.said.append(text)

    def close(self) -> None:
        return

    def show(self, agents: Sequence[AgentView]) -> None:
        for i, bus in enumerate(self.agents):
            now_us = time.time_ns() // 1000
            received = [payload for _, payload in bus.receive(COMMAND)]
            self.heard += [(now_us, payload) for payload in received if i == 0]
            orders = [order for order in map(decode_command, received) if order]
            self.orders += [order.verb for order in orders]
            self.stamped_us += [(order.utc_us, now_us - order.utc_us) for order in orders]
            self.ended += [end for _, payload in bus.receive(ENDED) if i == 0 and (end := decode_ended(payload))]
            obeys = self.obeys and i not in self.silent and i not in self.recovered  # what recovers a vehicle lands it
            if any(order.verb == "land" for order in orders) and obeys:
                self.children[agent_name(i)].signal(signal.SIGTERM)
            if i not in self.silent and self.children[agent_name(i)].poll() is None:
                status = status_of(i, self.phases.get(i, self.phase), now_us - self.behind_us, self.held)
                ends_in_s = status.ends_in_s if self.ends_s is None else self.ends_s - time.monotonic()
                bus.publish(
                    STATUS,
                    encode_message(
                        msgspec.structs.replace(status, boot_id=self.boot_ids[i], ends_in_s=ends_in_s, **self.vehicle)
                    ),
                )
        if time.monotonic() - self.began_s > 0.3:
            act, self.act = self.act, lambda: None
            act()

    def fly(self, *sets: str) -> LaunchResult:
        config = load(None, [f"swarm.agents={len(self.agents)}", *sets])
        try:
            return FlightSupervisor(config, self, self).fly(lambda: self.interrupts)
        finally:
            kill_all(list(self.children.values()))

    def kill(self, name: str) -> None:
        os.kill(self.children[name].pid, signal.SIGKILL)

    def printed(self, *words: str) -> bool:
        return any(all(word in line for word in words) for line in self.said)
