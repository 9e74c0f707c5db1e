"""Stops a launch in every phase, in every way, and checks that every vehicle left armed is named.

Where one agent is killed that is asked of its vehicle only: the others fly on, and hold for as long as they are told.

    python tools/stop_matrix.py --cells sigint:ARM,kill-agent:TAKEOFF
    python tools/stop_matrix.py --config configs/px4_udp.toml --witness-port 14550

Without `--config` each cell flies vehicles of a separate simulator (`python -m sitl`), which outlives the launch. With
it the vehicles are those of the configuration, real ones too, that run already. A second link to every vehicle (PX4's
ground-station link) shows by the vehicle's own HEARTBEAT whether it is armed.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import psutil

from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.framing import frames
from swarmctl.ops.preflight import claim_ports

PHASES = ("CONNECT", "STANDBY", "ARM", "TAKEOFF", "GOTO_START", "READY", "TRACK", "HOLD", "GOTO_LAND", "LAND")
STOPS = ("sigint", "sigterm", "sighup", "land", "kill-agent", "kill-router", "kill-launcher")
SIGNALS = {"sigint": signal.SIGINT, "sigterm": signal.SIGTERM, "sighup": signal.SIGHUP, "kill-launcher": signal.SIGKILL}
SAFE_S = 60.0  # after the stop every vehicle is disarmed, or named
START_S = 120.0
AGENTS = 2
KILLED_AGENT = 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """One stop in one phase, `after_s` into it."""

    stop: str
    phase: str
    after_s: float = 0.0

    def concerns(self, sysid: int) -> bool:
        """Return whether that vehicle must be disarmed in the end."""
        return self.stop != "kill-agent" or sysid == KILLED_AGENT + 1

    def __str__(self) -> str:
        return f"{self.stop}:{self.phase}" + (f"+{self.after_s:.2f}" if self.after_s else "")


class Witness:
    """Receives from every vehicle on a second link and never sends."""

    def __init__(self, port: int) -> None:
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sock.bind(("127.0.0.1", port))
        self._sock.setblocking(False)
        self._codec = Codec(255, 190)
        self.armed: dict[int, bool] = {}
        self.received_s: dict[int, float] = {}
        self.ever: set[int] = set()

    def receive(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                for frame in frames(self._sock.recv(4096)):
                    message = self._codec.decode(frame) if frame[7:10] == b"\0\0\0" and frame[6] == 1 else None
                    if message is not None:
                        self.armed[frame[5]] = bool(message.base_mode & 128)
                        self.received_s[frame[5]] = time.monotonic()
                        self.ever |= {frame[5]} if message.base_mode & 128 else set()

    def close(self) -> None:
        self._sock.close()


def free_ports(count: int) -> list[int]:
    """Return UDP ports of loopback that are free now."""
    sockets = claim_ports(count)
    ports = [int(sock.getsockname()[1]) for sock in sockets]
    for sock in sockets:
        sock.close()
    return ports


@contextmanager
def vehicles(config: Path | None, folder: Path, witness_port: int) -> Iterator[Path]:
    """Yield the configuration of vehicles that run inside the context."""
    if config is not None:
        yield config
        return
    ports = free_ports(AGENTS)
    lines = ['name = "stops"', "[swarm]", f"agents = {AGENTS}", "[mission]", "duration_s = 6.0"]
    lines += ["[start]", "center_ned_m = [2.0, 0.0, 0.0]"]  # far enough for GOTO_START to be seen
    lines += ["[sitl]", "enabled = false", "[telemetry]", "enabled = false"]
    for i, port in enumerate(ports):
        lines += ["[[vehicles]]", f"sysid = {i + 1}", f'url = "udpin://127.0.0.1:{port}"']
    path = folder / "stops.toml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    argv = [sys.executable, "-m", "sitl", "--vehicles", f"{AGENTS}", "--gcs-port", f"{witness_port}"]
    argv += ["--remote-ports", ",".join(map(str, ports)), "--local-port", f"{free_ports(1)[0]}", "--die-with-parent"]
    simulator = subprocess.Popen(argv, stdout=subprocess.DEVNULL, stderr=subprocess.STDOUT)
    try:
        yield path
    finally:
        simulator.terminate()
        simulator.wait(10)


def phases(run_dir: Path) -> set[str]:
    """Return the names of the phases that any agent has reported so far; HOLD is a TRACK."""
    found = set()
    with contextlib.suppress(OSError):
        for line in (run_dir / "launch.events.jsonl").read_text(encoding="utf-8").splitlines():
            with contextlib.suppress(json.JSONDecodeError):
                found.add(str(json.loads(line).get("phase")))
    return found


def child_of(launcher: psutil.Process, words: str) -> psutil.Process:
    """Return the launch's process whose command line has these words."""
    return next(c for c in launcher.children(recursive=True) if words in " ".join(c.cmdline()))


def verb(run_dir: Path, *words: str) -> None:
    argv = [sys.executable, "-m", "swarmctl", *words, "--run-dir", str(run_dir)]
    subprocess.run(argv, stdout=subprocess.DEVNULL, stderr=subprocess.STDOUT, timeout=30, check=False)


def stop(cell: Cell, launch: subprocess.Popen[bytes], run_dir: Path) -> None:
    """Execute the stop of a cell."""
    if cell.stop in SIGNALS:
        launch.send_signal(SIGNALS[cell.stop])
    elif cell.stop == "land":
        verb(run_dir, "land")
    else:
        words = f"--id {KILLED_AGENT} " if cell.stop == "kill-agent" else "--router"
        child_of(psutil.Process(launch.pid), words).kill()


def fly(cell: Cell, config: Path | None, witness_port: int) -> tuple[bool, str]:
    """Fly a cell; return whether it holds, and what happened."""
    with tempfile.TemporaryDirectory(prefix="stops") as name:
        folder, port = Path(name), witness_port or free_ports(1)[0]
        witness = Witness(port)
        try:
            with vehicles(config, folder, port) as path:
                return _fly(cell, path, folder, witness)
        finally:
            witness.close()


def _fly(cell: Cell, path: Path, folder: Path, witness: Witness) -> tuple[bool, str]:
    run_dir, log = folder / "run", folder / "launch.log"
    with log.open("wb") as out:
        argv = [sys.executable, "-m", "swarmctl", "launch", str(path), "--no-view", "--run-dir", str(run_dir)]
        launch = subprocess.Popen(argv, stdout=out, stderr=subprocess.STDOUT, start_new_session=True)
    try:
        if not _reach(cell, run_dir, launch, witness):
            return False, f"{cell.phase} was not reached: {log.read_text()[-300:]}"
        stop(cell, launch, run_dir)
        stopped_s = time.monotonic()
        while time.monotonic() - stopped_s < SAFE_S:
            witness.receive()
            fresh = all(s > stopped_s + 2.0 for s in witness.received_s.values()) and len(witness.received_s) > 0
            if launch.poll() is not None and fresh and not any(witness.armed.values()) and _alone(folder):
                break
            time.sleep(0.05)
        witness.receive()
        took_s = time.monotonic() - stopped_s
        left = sorted(i for i, armed in witness.armed.items() if armed and cell.concerns(i))
        said = log.read_text(errors="replace")
        named = launch.poll() == 4 and all(f"vehicle {i} " in said for i in left)
        heeded = launch.poll() != 0 or cell.phase in ("GOTO_LAND", "LAND")  # it did not fly on to the end
        flown = f"armed before: {sorted(witness.ever)}"
        return heeded and (not left or named), f"exit {launch.poll()}, {took_s:.1f} s, left armed: {left}, {flown}"
    finally:
        if launch.poll() is None:
            os.killpg(launch.pid, signal.SIGKILL)
        launch.wait()


def _alone(folder: Path) -> bool:
    """Return whether no process of the launch is left, also after the launcher was killed."""
    return not any(
        str(folder) in " ".join(p.info["cmdline"] or ()) and p.pid != os.getpid()
        for p in psutil.process_iter(["cmdline"])
    )


def _reach(cell: Cell, run_dir: Path, launch: subprocess.Popen[bytes], witness: Witness) -> bool:
    deadline_s = time.monotonic() + START_S
    while (cell.phase if cell.phase != "HOLD" else "TRACK") not in phases(run_dir):
        witness.receive()
        if launch.poll() is not None or time.monotonic() > deadline_s:
            return False
        time.sleep(0.01)
    if cell.phase == "HOLD":
        verb(run_dir, "hold")
    time.sleep(cell.after_s)
    return True


def cells_of(text: str) -> list[Cell]:
    """Return cells such as `sigint:ARM+0.05,land:TRACK`, or all of them."""
    if text == "all":
        once = [Cell(stop=s, phase=p) for p in PHASES for s in STOPS]
        return once + [Cell(stop=s, phase="ARM", after_s=0.05 * k) for s in STOPS for k in range(1, 21)]
    found = []
    for item in text.split(","):
        kind, _, place = item.partition(":")
        phase, _, after = place.partition("+")
        found.append(Cell(stop=kind, phase=phase, after_s=float(after or 0.0)))
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cells", type=cells_of, default="all", metavar="STOP:PHASE[+SECONDS],...")
    parser.add_argument("--config", type=Path, metavar="FILE", help="vehicles that run already")
    parser.add_argument("--witness-port", type=int, default=0, help="their second link's port here")
    options = parser.parse_args()
    for signum in (signal.SIGINT, signal.SIGHUP):
        signal.signal(signum, signal.SIG_DFL)  # in the background a shell ignores them, and a launch inherits that
    failed = 0
    for cell in options.cells:
        holds, what = fly(cell, options.config, options.witness_port)
        failed += not holds
        print(f"{'ok  ' if holds else 'FAIL'} {cell!s:28} {what}", flush=True)
    print(f"{len(options.cells) - failed} of {len(options.cells)} cells hold")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
