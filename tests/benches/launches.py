"""Launches as a user starts them, what each leaves behind, and ground stations beside them."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
from pymavlink.dialects.v20 import development as mavlink

from swarmctl.core.types import Phase
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.framing import frames
from tests.process.test_readme import COARSE, ROOT, landed

READY_S = 90.0
END_S = 150.0
TWO = ("--agents", "2", "--set", "telemetry.enabled=false")
# How a launch ends does not depend on the rates of COARSE.
STAY = (*COARSE, "--set", "mission.kind=swap", "--set", "mission.swap.travel_s=600", "--set", "start.spacing_m=2")
NEAR = (*STAY, "--set", "sitl.ground_z_m=0.5")  # nothing to reach, nothing in the way, and a short landing
PATIENT = "agent.autopilot_params={COM_OBL_RC_ACT=4,COM_OF_LOSS_T=3}"  # where there is no ground no failsafe ever lands
AIR = (*STAY, "--set", "sitl.start=air", "--set", PATIENT)  # neither taken off nor landed, where that is not asked


class Launched:
    """One `swarmctl launch`; its temporary files are in a folder of their own, so that leftovers show."""

    prefix: tuple[str, ...] = ()  # of the command line
    starts = "launch"

    def __init__(self, run_dir: Path, temp: Path, *arguments: str) -> None:
        self.run_dir = run_dir
        self.temp = temp
        self.env = {**os.environ, "TMPDIR": str(temp), "XDG_RUNTIME_DIR": "", "XDG_STATE_HOME": str(temp / "state")}
        self.env.pop("DISPLAY", None)
        self.out = run_dir.with_suffix(".out")
        command = [*self.prefix, sys.executable, "-m", "swarmctl", self.starts, *arguments]
        command += ["--run-dir", str(run_dir)]
        with self.out.open("w") as out:
            self.process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, env=self.env, cwd=ROOT)

    def clean_up(self) -> None:
        """Kill what is left of it, and remove its temporary files."""
        for relative in self.relatives():
            with contextlib.suppress(psutil.Error):
                relative.kill()
        self.process.kill()
        self.process.wait(20)
        shutil.rmtree(self.temp, ignore_errors=True)

    def text(self) -> str:
        return self.out.read_text()

    def events(self, name: str, source: str = "launch") -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = []
        for file in ("launch.events.jsonl", "events.jsonl"):
            path = self.run_dir / file
            if path.exists():
                rows += [json.loads(line) for line in path.read_text().splitlines() if line.endswith("}")]
        return [row for row in rows if row["source"] == source and row["event"] == name]

    def until_phase(self, phase: str, agents: int) -> None:
        """Wait until so many agents have entered a phase, or a later one: short phases fall between two statuses."""
        deadline_s = time.monotonic() + READY_S
        least = Phase[phase]
        while len({row["agent"] for row in self.events("phase") if Phase[row["phase"]] >= least}) < agents:
            assert self.process.poll() is None, self.text()
            assert time.monotonic() < deadline_s, self.text()
            time.sleep(0.1)

    def until_event(self, name: str, text: str) -> None:
        """Wait until the launcher has recorded an event with this text."""
        deadline_s = time.monotonic() + READY_S
        while not any(row["text"] == text for row in self.events(name)):
            assert self.process.poll() is None, self.text()
            assert time.monotonic() < deadline_s, self.text()
            time.sleep(0.1)

    def end(self, timeout_s: float = END_S) -> int:
        """Exit code; afterwards nothing may be left."""
        code = self.process.wait(timeout_s)
        assert self.leftovers() == []
        return code

    def relatives(self) -> list[psutil.Process]:
        """Every process with this launch's folders on its command line, except the launcher."""
        marks = (str(self.run_dir), str(self.temp))
        found = []
        for process in psutil.process_iter(["cmdline", "status"]):
            line = " ".join(process.info["cmdline"] or ())
            if process.pid != self.process.pid and any(mark in line for mark in marks):
                found.append(process)
        return found

    def leftovers(self) -> list[str]:
        files = [str(path) for path in self.temp.rglob("*") if path.is_socket() or path.name.startswith("swarm-")]
        notes = [str(path) for path in self.temp.glob("swarmctl-*/*.json")]
        return files + notes + [" ".join(process.info["cmdline"]) for process in self.relatives()]

    def pid_of(self, *words: str) -> int:
        (pid,) = [p.pid for p in self.relatives() if all(word in p.info["cmdline"] for word in words)]
        return pid

    def verb(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """An operator's command beside the launch."""
        command = [sys.executable, "-m", "swarmctl", *arguments]
        return subprocess.run(command, env=self.env, capture_output=True, text=True, timeout=60, check=False)

    def summary(self) -> dict[str, Any]:
        summary: dict[str, Any] = json.loads((self.run_dir / "summary.json").read_text())
        return summary

    def landed(self) -> dict[int, bool]:
        """Whether each vehicle ended on the ground, in truth."""
        return landed(self.run_dir)


class GroundStation:
    """A ground station, which hears vehicles through their agents."""

    def __init__(self) -> None:
        self._codec = Codec(255, 190)
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sock.bind(("127.0.0.1", 0))
        self._sock.settimeout(READY_S)
        self.port = self._sock.getsockname()[1]

    def close(self) -> None:
        self._sock.close()

    def read_parameter(self, name: str) -> dict[int, float]:
        """Ask every vehicle for a parameter until three have answered, and return the values by system id."""
        values: dict[int, float] = {}
        deadline_s = time.monotonic() + READY_S
        while len(values) < 3 and time.monotonic() < deadline_s:
            data, agent = self._sock.recvfrom(4096)
            for message in map(self._codec.decode, frames(data)):
                if message is None or message.get_srcSystem() in values:
                    continue
                if message.get_type() == "PARAM_VALUE" and message.param_id == name:
                    values[message.get_srcSystem()] = message.param_value
                elif message.get_type() == "HEARTBEAT":
                    asked = mavlink.MAVLink_param_request_read_message(message.get_srcSystem(), 1, name.encode(), -1)
                    self._sock.sendto(self._codec.encode(asked), agent)
        return values


Start = Callable[..., Launched]
