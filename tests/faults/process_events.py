"""What is done to the processes of a launch: they are stopped, killed and starved."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time

from swarmctl.telemetry.recording.file_names import SUMMARY
from tests.benches.launches import AIR, NEAR, TWO
from tests.faults.launched import Bounded, Start
from tests.faults.row import Off, require
from tests.process.test_check import ENV, ROOT, Pilot, Simulator
from tests.process.test_launch import killed_part

VIEWED = ("--agents", "2", "--no-view")

ROUTER = "swarmctl.bus.network.router"
MEETING = (  # of four in one point, with guaranteed separation; time for those who wait
    *("configs/swap8.toml", "--agents", "4", "--duration", "25", "--no-view", "--set", "separation.mode=guaranteed"),
    *("--set", "start.positions_ned_m=[[4,0,0],[0,4,0],[-4,0,0],[0,-4,0]]"),
)
SHORT, LONG = ("--duration", "8"), ("--duration", "120")


def in_program(word: str, code: str) -> Off:
    """Run code first in the processes whose command line has a word."""
    indented = "\n".join(f"    {line}" for line in code.strip().splitlines())
    return Off(preload=f"if {word!r} in words:\n{indented}")


def loss_after(seconds: float) -> Off:
    """Have autopilots act on a loss of setpoints after so long."""
    return Off(settings=(f"agent.autopilot_params={{COM_OBL_RC_ACT=4,COM_OF_LOSS_T={seconds}}}",))


def tracking(start: Start, *arguments: str) -> Bounded:
    """Start a launch of two agents, and wait until they fly their mission."""
    launched = start(*arguments)
    launched.until_phase("TRACK", 2)
    launched.event()
    return launched


def agent_pid(launched: Bounded, agent: int = 1) -> int:
    return launched.pid_of("agent", "--id", str(agent))


def stopped(pid: int, seconds: float) -> None:
    os.kill(pid, signal.SIGSTOP)
    time.sleep(seconds)
    os.kill(pid, signal.SIGCONT)


def agent_stopped_briefly(start: Start) -> None:
    launched = tracking(start, *TWO, *NEAR, *SHORT)
    stopped(agent_pid(launched), 0.3)
    code = launched.end()
    require(code == 0, f"exit code {code}: {launched.text()[-400:]}")


def agent_stopped_for_2_s(start: Start) -> None:
    launched = tracking(start, *TWO, *NEAR, *SHORT)
    stopped(agent_pid(launched), 2.0)
    code = launched.end()
    require(code == 4, f"exit code {code}")
    require("setpoints stopped" in launched.text(), "why is not said")
    require(launched.landed() == {0: True, 1: True}, "a vehicle has not landed")


def agent_stopped_for_20_s(start: Start) -> None:
    launched = tracking(start, *TWO, *NEAR, *SHORT)
    os.kill(agent_pid(launched), signal.SIGSTOP)
    code = launched.end()
    require(code == 4, f"exit code {code}")
    require(launched.said("agent-1 has been silent"), "its silence is not said")
    require(launched.landed() == {0: True, 1: True}, "a vehicle has not landed")


def agent_frozen_where_four_meet(start: Start) -> None:
    """The others can't pass where it may be until somebody knows."""
    launched = start(*MEETING)
    launched.until_phase("TRACK", 4)
    time.sleep(2.0)
    launched.event()
    os.kill(agent_pid(launched), signal.SIGSTOP)
    launched.reacts("it is ended", lambda: launched.said("agent-1 has not run for"))
    code = launched.end()
    require(code == 4, f"exit code {code}")
    require(launched.said("the vehicle of agent-1 is on the ground and disarmed"), "nobody recovered its vehicle")
    goals = json.loads((launched.run_dir / SUMMARY).read_text())["goals"]["agents"]
    arrived = [goal["id"] for goal in goals if goal["reached_at_s"] is not None]
    require(arrived == [0, 2, 3], f"only these have arrived: {arrived}")


def agent_killed(start: Start) -> None:
    launched = tracking(start, *TWO, *NEAR, *SHORT)
    os.kill(agent_pid(launched), signal.SIGKILL)
    code = launched.end()
    require(code == 4, f"exit code {code}")
    require(launched.said("the vehicle of agent-1 is on the ground and disarmed"), "nobody recovered its vehicle")


def agent_starved(start: Start) -> None:
    """Let it run for a tenth of the time."""
    launched = tracking(start, *TWO, *NEAR, *LONG)
    pid, ends = agent_pid(launched), threading.Event()

    def starve() -> None:
        while not ends.wait(0.03) and launched.process.poll() is None:
            try:
                stopped(pid, 0.25)
            except ProcessLookupError:
                return

    thread = threading.Thread(target=starve)
    thread.start()
    try:
        launched.reacts("it rests for overload", lambda: told_overload(launched))
    finally:
        ends.set()
        thread.join(5.0)
    launched.process.send_signal(signal.SIGINT)
    code = launched.end()
    require(code in (4, 130), f"exit code {code}")


def told_overload(launched: Bounded) -> bool:
    path = launched.run_dir / "agent-1.events.jsonl"
    return path.exists() and any('"overload"' in line and '"HOLD"' in line for line in path.read_text().splitlines())


def simulator_killed(start: Start) -> None:
    launched = killed_part(start, "sitl", *AIR)
    require("sitl was killed by SIGKILL; landing" in launched.text(), "its end is not said")


def router_stopped(start: Start) -> None:
    launched = tracking(start, *TWO, *NEAR, *SHORT)
    stopped(launched.pid_of(ROUTER), 3.0)
    code = launched.end()
    require(code == 0, f"exit code {code}: {launched.text()[-400:]}")


def router_killed_again_and_again(start: Start) -> None:
    launched = tracking(start, *TWO, *NEAR, *LONG)
    for number in range(4):
        os.kill(launched.pid_of(ROUTER), signal.SIGKILL)
        wanted = number + 1
        if wanted <= 3:
            launched.reacts("it is started again", lambda wanted=wanted: _routers(launched) >= wanted)  # type: ignore[misc]
            time.sleep(0.5)
    launched.reacted_s, before = None, launched.within_s
    launched.event()
    code = launched.end(before)
    require(code == 4, f"exit code {code}")
    require(launched.landed() == {0: True, 1: True}, "a vehicle has not landed")


def _routers(launched: Bounded) -> int:
    ended = len(launched.events("router_ended"))
    return ended if any(ROUTER in p.info["cmdline"] for p in launched.relatives()) else 0


def simulator_started_again(start: Start) -> None:
    """Kill the simulator of a launch that has not started it, and start another on the same ports."""
    first = Simulator(1)
    first.wait_until_up()
    (port,) = first.ports
    others: list[subprocess.Popen[str]] = []
    try:
        launched = start(*_of_another_simulator(port))
        launched.until_phase("TRACK", 1)
        launched.event()
        first.process.kill()
        first.process.wait(10)
        time.sleep(1.0)
        others.append(_simulator_on(port))
        code = launched.end()
        require(code == 4, f"exit code {code}: {launched.text()[-400:]}")
        require(launched.said("rebooted"), f"why is not said: {launched.text()[-400:]}")
        with Pilot(port) as pilot:
            require(not pilot.armed(), "the new vehicle was armed")
    finally:
        first.stop()
        for other in others:
            other.kill()
            other.communicate(timeout=10)


def _of_another_simulator(port: int) -> tuple[str, ...]:
    vehicle = f'vehicles=[{{sysid=1,url="udpin://127.0.0.1:{port}"}}]'
    sets = ("sitl.enabled=false", "telemetry.enabled=false", vehicle, "start.center_ned_m=[0.0,0.0,-1.0]")
    return ("--agents", "1", *(word for one in sets for word in ("--set", one)), "--duration", "60")


def _simulator_on(port: int) -> subprocess.Popen[str]:
    line = [sys.executable, "-m", "sitl", "--vehicles", "1", "--remote-ports", str(port), "--ekf-ready-s", "0.2"]
    return subprocess.Popen([*line, "--die-with-parent"], cwd=ROOT, env=ENV, stdout=subprocess.PIPE, text=True)


def viewer_killed(start: Start) -> None:
    viewer_hit(start, signal.SIGKILL, "the flight goes on")


def viewer_stopped(start: Start) -> None:
    viewer_hit(start, signal.SIGSTOP, "viewer is frozen; the flight goes on")


def viewer_hit(start: Start, signum: signal.Signals, words: str) -> None:
    launched = tracking(start, *VIEWED, *AIR, "--duration", "4")
    os.kill(launched.pid_of("swarmctl.telemetry.view.viewer"), signum)
    launched.reacts(words, lambda: launched.said(words))
    code = launched.end()
    require(code == 0, f"exit code {code}: {launched.text()[-400:]}")
