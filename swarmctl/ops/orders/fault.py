"""`swarmctl fault`: injects a fault into a running simulator and prints its answer.

Only the simulator that a launch started takes faults: a run with real vehicles has no control socket and is refused.
"""

from __future__ import annotations

import json
import os
import socket
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from swarmctl.config import load_recorded
from swarmctl.configuration.problems import validated
from swarmctl.errors import ConfigError, StartError
from swarmctl.ops.processes import control_socket
from swarmctl.ops.running_launches import RunningLaunch
from swarmctl.simulator_config import FAULTS, FaultParams

_ANSWER_S = 3.0
_LARGEST = 8192
_OPTIONS = {"for_s": "--for", "towards_deg": "--towards", "kind": "KIND"}


def parse_fault(wanted: Mapping[str, Any], vehicles: int) -> FaultParams:
    """Return the fault that a command line describes; values of None were not given.

    Raises:
        ConfigError: with every problem: kind, vehicle, value, times.
    """
    given = {key: value for key, value in wanted.items() if value is not None}
    try:
        fault = validated(FaultParams, given, "fault")
    except ConfigError as error:
        problems = [_as_option(problem) for problem in error.problems]
        raise ConfigError("fault", [*problems, *_missed(given, vehicles, problems)]) from error
    problems = [_as_option(problem) for problem in fault.problems(vehicles)]
    if problems:
        raise ConfigError("fault", problems)
    return fault


def inject(launch: RunningLaunch, fault: FaultParams) -> float:
    """Send a fault to the simulator of a launch; returns when it began, since the simulator's start [s].

    Raises:
        ConfigError: the launch does not simulate its vehicles, or the simulator refuses the fault.
        StartError: the simulator does not answer, or has ended with the flight.
    """
    path = control_socket(launch.bus)
    if not path.exists():
        if load_recorded(Path(launch.run_dir)).sitl.enabled:
            raise StartError(f"fault: the simulator of {launch.run} is not up yet, or has ended; see: swarmctl status")
        why = "this launch started no simulator; faults are for simulated vehicles, never for real ones"
        raise ConfigError("fault", [f"{launch.run}: {why}"])
    answer = _ask(path, {"fault": fault.model_dump()})
    if not answer.get("ok"):
        raise ConfigError("fault", [str(problem) for problem in answer.get("problems", ["refused"])])
    return float(answer["since_boot_s"])


def line_of(fault: FaultParams, since_boot_s: float) -> str:
    """Return what was injected, and when, in words."""
    who = "every vehicle" if fault.vehicle < 0 else f"vehicle {fault.vehicle}"
    length = f" for {fault.for_s:g} s" if fault.for_s else ""
    return f"{fault.kind} on {who}{length}, {since_boot_s:.1f} s after the simulator's start"


def as_json(run: str, fault: FaultParams, since_boot_s: float) -> str:
    """Return the same for programs."""
    return json.dumps({"run": run, **fault.model_dump(), "since_boot_s": since_boot_s}, indent=2)


def _ask(path: Path, request: dict[str, Any]) -> dict[str, Any]:
    """Send one request and return its answer, over a socket in a private folder."""
    try:
        with (
            tempfile.TemporaryDirectory(prefix="swarm-") as folder,
            socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock,
        ):
            sock.bind(f"{folder}/{os.getpid()}.sock")
            sock.settimeout(_ANSWER_S)
            sock.sendto(json.dumps(request).encode(), str(path))
            answer = json.loads(sock.recv(_LARGEST))
    except (OSError, ValueError) as error:
        raise StartError(f"fault: the simulator does not answer ({error}); see: swarmctl status") from error
    return answer if isinstance(answer, dict) else {}


def _missed(given: dict[str, Any], vehicles: int, found: list[str]) -> Iterator[str]:
    """Yield problems that the validation did not reach: the vehicle of an unknown kind, the value of a known one."""
    vehicle = given.get("vehicle", -1)
    if not any("--vehicle" in problem for problem in found) and vehicle >= vehicles:
        yield f"--vehicle = {vehicle}: allowed: 0 to {vehicles - 1}, or -1 for all"
    rule = FAULTS.get(str(given.get("kind")))
    value = given.get("value")
    if rule and value is not None and not rule.low <= value <= rule.high:
        yield f"--value = {value}: allowed for {given['kind']}: {rule.low:g} to {rule.high:g} ({rule.meaning})"


def _as_option(problem: str) -> str:
    """Return a problem with the key replaced by the command-line option."""
    key = problem.split(" ", 1)[0].split(":", 1)[0]
    return problem.replace(key, _OPTIONS.get(key, f"--{key}"), 1)
