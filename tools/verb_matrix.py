"""Gives every order in every phase to one agent and to all of a launch, and checks that each does what its row says.

    python tools/verb_matrix.py cells.jsonl --only hold,goto --phases TAKEOFF,TRACK

Each cell is a launch of two agents of its own. Where the order is obeyed in that phase, its effect is waited for on
every agent asked, that of a hold in TAKEOFF for one second; an agent that was not asked has to go on (the control). In
the other cells it has to be refused with a reason. A phase that was over when the order came is "missed", and tried
again twice and by the next call, which goes on where this one ended. All cells take an hour and a half.
"""

from __future__ import annotations

import argparse
import itertools
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from swarmctl.bus.bus import agent_name
from swarmctl.bus.messages.json_messages import MissionMessage, StatusMessage, decode_status, encode_message
from swarmctl.bus.topics import MISSION as MISSION_TOPIC
from swarmctl.bus.topics import STATUS
from swarmctl.core.operator_verbs import BEGIN, EXCLUDE, GOTO, MISSION, OPERATOR_VERBS, PEER, POINT, Order
from swarmctl.core.types import Phase
from swarmctl.errors import StartError
from swarmctl.ops.orders.operator import joined
from swarmctl.ops.orders.order_delivery import Reply, deliver
from swarmctl.ops.running_launches import LAUNCH_FILE, RunningLaunch, find_launch

AGENTS = 2
_MISSION = MissionMessage(mission=7, text='{"kind": "hover", "duration_s": 40.0}')
_HELD_ON_THE_WAY_UP_S = 1.0
_EFFECT_S = 6.0  # longest time until any other effect is seen: a vehicle in transit brakes from 2 m/s
_START_S, _END_S = 60.0, 120.0
_SLOW_M_S = 0.3
_TRIES = 3
# A climb ends where the mission begins: GOTO_START would be over at once, if it were not for a centimetre.
_LONG_TRANSIT = ("--set=agent.state_machine.arrive_m=0.02", "--set=agent.state_machine.arrive_m_s=0.02")

# What a status shows of an order that is obeyed.
_EFFECTS: Mapping[str, Callable[[StatusMessage], bool]] = {
    "hold": lambda s: s.held and s.ground_speed_m_s < _SLOW_M_S,
    "resume": lambda s: not s.held,
    "land": lambda s: s.phase >= Phase.GOTO_LAND,
    "rtl": lambda s: s.phase >= Phase.GOTO_LAND,
    GOTO: lambda s: s.held and s.control == "GOTO",
    MISSION: lambda s: s.phase < Phase.TRACK or s.ends_in_s > 30.0,  # the first one is shorter
    EXCLUDE: lambda s: True,  # is about a peer
}


class Launch:
    """A launch of a process of its own, and the newest status of each of its agents."""

    def __init__(self, directory: Path) -> None:
        command = [sys.executable, "-m", "swarmctl", "launch", "--agents", str(AGENTS), "--duration", "12", "--no-view"]
        command += ["--set=sitl.ground_z_m=1", *_LONG_TRANSIT, f"--run-dir={directory}"]
        self._directory = directory
        with (directory.parent / "output.txt").open("wb") as output:
            self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=output)
        self.statuses: dict[int, StatusMessage] = {}

    def found(self) -> RunningLaunch:
        """Return how it is joined, once it is there."""
        until_s = time.monotonic() + _START_S
        while time.monotonic() < until_s and self.process.poll() is None:
            if (self._directory / LAUNCH_FILE).exists():
                return find_launch(str(self._directory))
            time.sleep(0.02)
        raise StartError("the launch has not started")

    def wait(self, launch: RunningLaunch, is_so: Callable[[], bool], seconds: float) -> bool:
        """Follow statuses until something is so, at most for a time; returns whether it is."""
        until_s = time.monotonic() + seconds
        with joined(launch) as bus:
            while time.monotonic() < until_s and self.process.poll() is None:
                for sender, payload in bus.receive(STATUS):
                    status = decode_status(payload)
                    if status is not None and sender == agent_name(status.agent):
                        self.statuses[status.agent] = status
                if is_so():
                    return True
                time.sleep(0.005)
        return False

    def end(self) -> None:
        """Land what flies, and wait for the end."""
        self.process.terminate()
        try:
            self.process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


def arguments_of(verb: str) -> dict[str, float]:
    """Return arguments with which an order can be obeyed."""
    if verb == GOTO:
        return dict(zip(POINT, (2.0, 2.0, -3.0), strict=True))
    if verb == MISSION:
        return {MISSION: _MISSION.mission, BEGIN: time.time() + 1.0}
    return {PEER: 1.0} if verb == EXCLUDE else {}


def cell(phase: Phase, verb: str, to_all: bool) -> dict[str, Any]:
    """Fly one cell; returns what came of it."""
    with tempfile.TemporaryDirectory(prefix="verbs-") as folder:
        flight = Launch(Path(folder) / "run")
        try:
            launch = flight.found()
            if not flight.wait(launch, lambda: _phase(flight) is phase, _START_S + _END_S):
                return {"result": "missed"}
            return _asked(flight, launch, phase, verb, to_all)
        except StartError as error:
            return {"result": f"failed: {error}"}
        finally:
            flight.end()


def _phase(flight: Launch) -> Phase | None:
    return Phase(flight.statuses[0].phase) if 0 in flight.statuses else None


def _asked(flight: Launch, launch: RunningLaunch, phase: Phase, verb: str, to_all: bool) -> dict[str, Any]:
    asked = [] if to_all and verb != EXCLUDE else [0]
    if verb == "resume" and phase.name in OPERATOR_VERBS["hold"].phases:  # of a hold, so that there is something to do
        deliver(launch, Order("hold"), asked)
    before = ((MISSION_TOPIC, encode_message(_MISSION)),) if verb == MISSION else ()
    began_s = time.monotonic()
    replies = deliver(launch, Order(verb, arguments_of(verb)), asked, before=before)
    answered_s = time.monotonic() - began_s
    if any(reply.answer is None for reply in replies):
        return {"result": "failed: silent"}
    first = next(reply for reply in replies if reply.agent == 0)
    obeyed_there = OPERATOR_VERBS[verb].is_stop and first.answer is not None and first.answer.accepted
    if first.phase is not phase and not obeyed_there:  # a stop that is obeyed is another phase by now
        return {"result": "missed", "met": None if first.phase is None else first.phase.name}
    if phase.name not in OPERATOR_VERBS[verb].phases:
        refused = first.answer is not None and not first.answer.accepted and bool(first.answer.reason)
        return {"result": "refused" if refused else "failed: accepted", "answered_s": answered_s}
    return _effect(flight, launch, phase, verb, replies) | {"answered_s": answered_s}


def _effect(flight: Launch, launch: RunningLaunch, phase: Phase, verb: str, replies: list[Reply]) -> dict[str, Any]:
    """Return whether everybody who has accepted does it in time, and nobody else."""
    accepted = [reply.agent for reply in replies if reply.answer is not None and reply.answer.accepted]
    if 0 not in accepted:
        return {"result": f"failed: {replies[0].problem}"}
    began_s = time.monotonic()
    flight.statuses.clear()

    def is_seen() -> bool:
        return all(agent in flight.statuses and _EFFECTS[verb](flight.statuses[agent]) for agent in accepted)

    limit_s = _HELD_ON_THE_WAY_UP_S if (phase, verb) == (Phase.TAKEOFF, "hold") else _EFFECT_S
    done = flight.wait(launch, is_seen, limit_s)
    took_s = time.monotonic() - began_s
    if done and verb == "hold":
        done = _rests(flight, launch, accepted)
    others = [agent for agent, status in flight.statuses.items() if agent not in accepted and status.held]
    result = "obeyed" if done and not others else f"failed: {'held too' if others else 'no effect'}"
    return {"result": result, "seen_s": took_s}


def _rests(flight: Launch, launch: RunningLaunch, agents: list[int]) -> bool:
    """Return whether agents that hold neither climb nor sink any more: from a second after the order on."""
    flight.wait(launch, lambda: False, 0.6)
    before_m = {agent: flight.statuses[agent].altitude_m for agent in agents}
    flight.wait(launch, lambda: False, 1.0)
    return all(abs(flight.statuses[agent].altitude_m - before_m[agent]) < _SLOW_M_S for agent in agents)


def main() -> None:
    """Fly the cells that are not in the file yet, and print what all of them came to."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("--only", default=",".join(OPERATOR_VERBS), help="verbs")
    parser.add_argument("--phases", default=",".join(phase.name for phase in Phase))
    options = parser.parse_args()
    lines = options.file.read_text().splitlines() if options.file.exists() else []
    rows = [json.loads(line) for line in lines]
    settled = {(row["phase"], row["verb"], row["to"]) for row in rows if row["result"] != "missed"}
    for name, verb, to in itertools.product(options.phases.split(","), options.only.split(","), ("one", "all")):
        if (name, verb, to) in settled:
            continue
        for _ in range(_TRIES):
            row = {"phase": name, "verb": verb, "to": to, **cell(Phase[name], verb, to == "all")}
            if row["result"] != "missed":
                break
        print(json.dumps(row), flush=True)
        with options.file.open("a") as file:
            file.write(json.dumps(row) + "\n")
        rows.append(row)
    newest = {(row["phase"], row["verb"], row["to"]): row["result"] for row in rows}
    for result in sorted(set(newest.values())):
        print(f"{result}: {sum(found == result for found in newest.values())}")


if __name__ == "__main__":
    main()
