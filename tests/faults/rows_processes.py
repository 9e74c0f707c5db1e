"""Processes killed, stopped and starved; disk, descriptors and terminal gone; a start that can't work."""

from __future__ import annotations

import os
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

from tests.faults.launched import Bounded, LaunchedRow, Start
from tests.faults.row import Off, require
from tests.process.test_check import ENV, ROOT, Pilot, Simulator
from tests.process.test_launch import (
    AIR,
    NEAR,
    TWO,
    a_closed_terminal_lands_and_keeps_the_verdict,
    a_killed_launcher_leaves_nothing,
    a_second_ctrl_c_ends_everything_at_once,
    ctrl_c_lands_and_sums_up,
    without_its_router_the_flight_goes_on_with_another,
    without_its_simulator_the_launch_ends_as_failed,
)

VIEWED = ("--agents", "2", "--no-view")
ROUTER = "swarmctl.bus.network.router"
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


# -- agents -----------------------------------------------------------------------------------------------------------


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
        launched.reacts("it rests for overload", lambda: bool(launched.said("overload")) or told_overload(launched))
    finally:
        ends.set()
        thread.join(5.0)
    launched.process.send_signal(signal.SIGINT)
    code = launched.end()
    require(code in (4, 130), f"exit code {code}")


def told_overload(launched: Bounded) -> bool:
    path = launched.run_dir / "agent-1.events.jsonl"
    return path.exists() and any('"overload"' in line and '"HOLD"' in line for line in path.read_text().splitlines())


# -- router, simulator, viewer, launcher ------------------------------------------------------------------------------


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


def launcher_stopped(start: Start) -> None:
    launched = tracking(start, *TWO, *NEAR, "--duration", "14")
    stopped(launched.process.pid, 8.0)
    code = launched.end()
    require(code == 0, f"exit code {code}: {launched.text()[-400:]}")


# -- disk, descriptors, terminal --------------------------------------------------------------------------------------


@contextmanager
def small_disk(folder: Path, megabytes: float = 6.0) -> Iterator[Path]:
    """Yield a run folder on a disk of its own, which is soon full. As root."""
    where = folder / "run"  # beside it is what the launch prints
    where.mkdir()
    size = f"size={round(megabytes * 1024)}k"
    subprocess.run(["mount", "-t", "tmpfs", "-o", size, "none", str(where)], check=True)
    try:
        yield where
    finally:
        subprocess.run(["umount", "-l", str(where)], check=True)


def fill(disk: Path) -> None:
    """Leave not a byte."""
    with (disk / "filler").open("wb", buffering=0) as file:
        for size in (65536, 4096, 512, 1):
            try:
                while True:
                    file.write(b"\0" * size)
            except OSError:
                continue


def disk_full(phase: str) -> Callable[[Start], None]:
    def script(start: Start) -> None:
        with tempfile.TemporaryDirectory(prefix="disk") as name, small_disk(Path(name)) as disk:
            launched = start(*TWO, *NEAR, "--duration", "4", run_dir=disk)
            launched.until_phase(phase, 2)
            launched.event()
            fill(disk)
            code = launched.end()
            require(code == 4, f"exit code {code}: {launched.text()[-600:]}")
            wanted = "completed" if phase in ("TRACK", "LAND") else "failed"  # what is not recorded can't be judged
            require(launched.verdict().startswith(wanted), launched.verdict())
            require("No space left" in launched.text(), "it does not say that the disk is full")

    return script


_NO_MORE = 3  # what is open stays so, and nothing else can be opened


@contextmanager
def fewest_descriptors(pid: int) -> Iterator[None]:
    """Leave a process not one more descriptor than it has."""
    process = psutil.Process(pid)
    before = process.rlimit(resource.RLIMIT_NOFILE)
    process.rlimit(resource.RLIMIT_NOFILE, (_NO_MORE, before[1]))
    try:
        yield
    finally:
        if process.is_running():
            process.rlimit(resource.RLIMIT_NOFILE, before)


def descriptors_of_an_agent(start: Start) -> None:
    launched = tracking(start, *TWO, *NEAR, *SHORT)
    with fewest_descriptors(agent_pid(launched)):
        code = launched.end()
    require(code == 0, f"exit code {code}: {launched.text()[-400:]}")


def descriptors_of_the_router(start: Start) -> None:
    launched = tracking(start, *TWO, *NEAR, *SHORT)
    with fewest_descriptors(launched.pid_of(ROUTER)):
        launched.verb("status")
        code = launched.end()
    require(code == 0, f"exit code {code}: {launched.text()[-400:]}")


def descriptors_of_the_launcher(start: Start) -> None:
    """Take them away for good: it watches the flight to its end, prints the verdict, and says what it can't write."""
    launched = tracking(start, *TWO, *NEAR, *SHORT)
    launched.keeps_note = True
    with fewest_descriptors(launched.process.pid):
        code = launched.end()
    require(code == 4, f"exit code {code}: {launched.text()[-600:]}")
    require(launched.said("Too many open files"), "why nothing is written is not said")
    launched.verdict()


def descriptors_of_the_launcher_and_an_agent_dies(start: Start) -> None:
    """It can't start what lands the vehicle: the vehicle's autopilot does, and it is named."""
    launched = tracking(start, *TWO, *NEAR, *SHORT)
    launched.keeps_note = True
    with fewest_descriptors(launched.process.pid):
        os.kill(agent_pid(launched), signal.SIGKILL)
        code = launched.end()
    require(code == 4, f"exit code {code}: {launched.text()[-600:]}")
    require(launched.said("agent-1 was killed by SIGKILL"), "the death is not said")
    require(launched.said("vehicle 2 "), "the vehicle is not named")
    launched.verdict()


class Piped(Bounded):
    """A launch whose output is read by another program, which may end."""

    prefix: tuple[str, ...] = ("sh", "-c", 'exec 3>"$0"; "$@" | { head -n 4 >&3; }; exit 0')

    def __init__(self, run_dir: Path, temp: Path, *arguments: str) -> None:
        self.prefix = (*type(self).prefix, str(run_dir.with_suffix(".head")))
        super().__init__(run_dir, temp, *arguments)


def reader_ends(start: Start) -> None:
    """Its output goes to `head`, which has ended by then: the launch flies on and finishes its folder."""
    launched = start(*TWO, *NEAR, "--duration", "4", kind=Piped)
    launched.event()
    launched.reacts("the run folder is finished", lambda: (launched.run_dir / "summary.json").exists())
    launched.process.wait(30)
    require(launched.summary()["outcome"] == "completed", f"{launched.summary()['violations']}")


# -- starts that can't work -------------------------------------------------------------------------------------------


def configuration_wrong(start: Start) -> None:
    launched = start("--set", "swarm.agnets=3", "--set", "agent.rate_hz=-1", "--set", "mission.kind=nonsense")
    launched.event()
    code = launched.end()
    require(code == 2, f"exit code {code}: {launched.text()[-300:]}")
    for word in ("agnets", "did you mean 'agents'", "agent.rate_hz", "mission.kind"):
        require(launched.said(word), f"{word} is not named: all problems at once, with key, value and fix")
    require(not launched.run_dir.exists(), "a run folder was made")


def _vehicles(*urls: str) -> tuple[str, ...]:
    listed = ",".join(f'{{sysid={i + 1},url="{url}"}}' for i, url in enumerate(urls))
    sets = ("sitl.enabled=false", "telemetry.enabled=false", f"vehicles=[{listed}]", f"swarm.agents={len(urls)}")
    return tuple(word for one in sets for word in ("--set", one))


def ports_taken(start: Start) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        launched = start(*_vehicles(f"udpin://127.0.0.1:{port}", "serial:///dev/no-such-device:57600"))
        launched.event()
        code = launched.end()
    require(code == 3, f"exit code {code}: {launched.text()[-300:]}")
    for word in ("vehicles.0.url", str(port), "vehicles.1.url", "/dev/no-such-device does not exist"):
        require(launched.said(word), f"{word} is not named")
    require(not launched.run_dir.exists(), "a run folder was made")


def vehicle_missing(start: Start) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    launched = start(*_vehicles(f"udpin://127.0.0.1:{port}"), "--set", "agent.connect_timeout_s=3")
    launched.event()
    code = launched.end()
    require(code == 3, f"exit code {code}: {launched.text()[-300:]}")
    require(launched.said(f"vehicle at udpin://127.0.0.1:{port}"), "the vehicle is not named")


SUPERVISOR = "import swarmctl.ops.supervisor as supervisor\n"
RAISES = """
import json
import swarmctl.telemetry.recording.event_log as log
def write(self, event, **fields):
    with self._path.open("a", encoding="utf-8") as file:
        file.write(json.dumps({"utc_us": 0, "t_us": 0, "source": self._source, "event": event, **fields}) + "\\n")
log.EventLog.write = write
"""
ROWS = (
    LaunchedRow(
        name="process-agent-stopped-0.3s",
        event="an agent's process is stopped for 0.3 s",
        reaction="it goes on before a failsafe acts; the mission is completed",
        within_s=60.0,
        protection="the time that the autopilot is told to wait for setpoints (COM_OF_LOSS_T)",
        script=agent_stopped_briefly,
        off=loss_after(0.1),
    ),
    LaunchedRow(
        name="process-agent-stopped-2s",
        event="an agent's process is stopped for 2 s",
        reaction="its autopilot lands the vehicle, which the agent does not take back; the launch fails, and says why",
        within_s=90.0,
        protection="offboard-loss action of the autopilot",
        script=agent_stopped_for_2_s,
        off=loss_after(60.0),
    ),
    LaunchedRow(
        name="process-agent-stopped-20s",
        event="an agent's process is stopped, and stays so",
        reaction="it is named and given up when the others have finished; its vehicle is landed",
        within_s=90.0,
        protection="agents that are silent are not waited for",
        script=agent_stopped_for_20_s,
        off=in_program("launch", SUPERVISOR + "supervisor._SILENCE_S = 1e9"),
    ),
    LaunchedRow(
        name="process-agent-killed",
        event="an agent's process is killed",
        reaction="another lands its vehicle, and says so; the launch fails",
        within_s=90.0,
        protection="recovery of vehicles whose agent has ended",
        script=agent_killed,
        off=in_program("launch", SUPERVISOR + "supervisor.FlightSupervisor._recover = lambda *_: None"),
    ),
    LaunchedRow(
        name="process-agent-starved",
        event="an agent's process runs for a tenth of the time",
        reaction="it says so, and comes to rest",
        within_s=30.0,
        protection="response to missed deadlines (agent.overload)",
        script=agent_starved,
        off=in_program(
            "agent",
            "import swarmctl.control.phases.overload as it\nit.Overload.update = lambda *_: None",
        ),
    ),
    LaunchedRow(
        name="process-router-killed",
        event="the router is killed",
        reaction="it is started again, and the mission completed",
        within_s=90.0,
        protection="a router that has ended is started again",
        script=without_its_router_the_flight_goes_on_with_another,
        off=in_program("launch", SUPERVISOR + "supervisor._ROUTER_STARTS = 0"),
    ),
    LaunchedRow(
        name="process-router-stopped",
        event="the router is stopped for 3 s",
        reaction="all come to rest, then the mission is completed",
        within_s=90.0,
        protection="agents are silent for 5 s before they are given up",
        script=router_stopped,
        off=in_program("launch", SUPERVISOR + "supervisor._SILENCE_S = 0.5"),
    ),
    LaunchedRow(
        name="process-router-killed-4-times",
        event="the router is killed again and again",
        reaction="after the third all land; the launch fails",
        within_s=90.0,
        protection="without a router agents land",
        script=router_killed_again_and_again,
        off=in_program("launch", SUPERVISOR + "supervisor._ROUTER_STARTS = 1000"),
    ),
    LaunchedRow(
        name="process-simulator-killed",
        event="the simulator of a launch is killed",
        reaction="the launch ends as failed",
        within_s=60.0,
        protection="essential processes are watched",
        script=without_its_simulator_the_launch_ends_as_failed,
        off=in_program(
            "launch", SUPERVISOR + "supervisor.FlightSupervisor._watch_essential_processes = lambda *_: None"
        ),
    ),
    LaunchedRow(
        name="process-simulator-started-again",
        event="a simulator that the launch has not started is killed, and another started on its ports",
        reaction="the new vehicle is not armed; the launch fails, and says why",
        within_s=60.0,
        protection="reboots are noticed",
        script=simulator_started_again,
        off=in_program(
            "agent",
            "import swarmctl.mavlink.vehicle_clock as it\n"
            "it.VehicleClock.boots = property(lambda self: 0, lambda self, count: None)",
        ),
    ),
    LaunchedRow(
        name="process-viewer-killed",
        event="the viewer is killed",
        reaction="the flight goes on, and this is said",
        within_s=10.0,
        protection="the viewer is not essential",
        script=viewer_killed,
        off=in_program("launch", SUPERVISOR + "supervisor.SITL = supervisor.VIEWER"),
    ),
    LaunchedRow(
        name="process-viewer-stopped",
        event="the viewer is stopped, and stays so",
        reaction="the flight goes on, and this is said",
        within_s=10.0,
        protection="the viewer is watched",
        script=viewer_stopped,
        off=in_program("launch", SUPERVISOR + "supervisor.FlightSupervisor._watch_viewer = lambda *_: None"),
    ),
    LaunchedRow(
        name="process-launcher-stopped",
        event="the launcher is stopped for 8 s",
        reaction="nobody is called silent; the mission is completed",
        within_s=90.0,
        protection="the launcher excuses its own pauses",
        script=launcher_stopped,
        off=in_program("launch", SUPERVISOR + "supervisor.FlightSupervisor._excuse_own_pause = lambda *_: None"),
    ),
    LaunchedRow(
        name="process-launcher-killed",
        event="the launcher is killed",
        reaction="every process ends, nothing is left",
        within_s=60.0,
        protection="processes end with the launcher",
        script=a_killed_launcher_leaves_nothing,
        readable=False,
        off=Off(
            preload="import swarmctl.process_lifetime as it\nit.die_with_parent = lambda *_: None",
        ),
    ),
    LaunchedRow(
        name="process-ctrl-c",
        event="Ctrl-C",
        reaction="all land, the run is summed up",
        within_s=90.0,
        protection="a stop lands first",
        script=ctrl_c_lands_and_sums_up,
        off=in_program(
            "launch",
            SUPERVISOR + "supervisor.FlightSupervisor._land = lambda *_: None",
        ),
    ),
    LaunchedRow(
        name="process-ctrl-c-twice",
        event="Ctrl-C twice",
        reaction="every process ends at once, nothing is left, the run is summed up",
        within_s=30.0,
        protection="the second stop kills",
        script=a_second_ctrl_c_ends_everything_at_once,
        off=in_program("launch", SUPERVISOR + "supervisor.kill_all = lambda *_: None"),
    ),
    LaunchedRow(
        name="process-terminal-closed",
        event="the terminal is closed, in flight and while the run is judged",
        reaction="all land, the run is summed up",
        within_s=90.0,
        protection="SIGHUP is a request to stop",
        script=a_closed_terminal_lands_and_keeps_the_verdict,
        off=in_program(
            "launch",
            "import signal\n"
            "import swarmctl.process_lifetime as it\n"
            "init = it.StopRequest.__init__\n"
            "def without(self, *signums, **more):\n"
            "    init(self, *(s for s in signums if s != signal.SIGHUP), **more)\n"
            "it.StopRequest.__init__ = without",
        ),
    ),
    LaunchedRow(
        name="process-reader-ends",
        event="the program that reads the launch's output has ended",
        reaction="the mission is completed, the run folder finished",
        within_s=90.0,
        protection="lines that can't be printed are dropped",
        script=reader_ends,
        off=in_program(
            "launch",
            "import swarmctl.ops.status_table as it\n"
            "it.PlainLines.print_line = lambda self, text: print(text, flush=True)",
        ),
    ),
    *(
        LaunchedRow(
            name=f"process-disk-full-{phase.lower()}",
            event=f"the disk is full from {phase} on",
            reaction="the mission is flown to its end, the verdict printed, what is missing named",
            within_s=90.0,
            protection="a full disk loses events, never the flight",
            script=disk_full(phase),
            readable=False,
            off=in_program("launch", RAISES),
        )
        for phase in ("STANDBY", "TRACK", "LAND")
    ),
    LaunchedRow(
        name="process-descriptors-agent",
        event="an agent has no descriptor left",
        reaction="the mission is completed",
        within_s=60.0,
        protection="an agent opens nothing in flight",
        script=descriptors_of_an_agent,
        off=in_program(
            "agent",
            "import swarmctl.agent.agent as it\n"
            "tick = it.Agent.tick\n"
            "def opening(self, *values):\n"
            "    open('/dev/null').close()\n"
            "    return tick(self, *values)\n"
            "it.Agent.tick = opening",
        ),
    ),
    LaunchedRow(
        name="process-descriptors-router",
        event="the router has no descriptor left, and an operator asks for the status",
        reaction="the mission is completed",
        within_s=60.0,
        protection="a router that has ended is started again",
        script=descriptors_of_the_router,
        off=in_program(ROUTER, "import os, threading\nthreading.Timer(12.0, lambda: os._exit(1)).start()"),
    ),
    LaunchedRow(
        name="process-descriptors-launcher",
        event="the launcher has no descriptor left",
        reaction="the flight is watched to its end, the verdict printed",
        within_s=60.0,
        protection="a full disk loses events, never the flight",
        script=descriptors_of_the_launcher,
        readable=False,
        off=in_program("launch", RAISES),
    ),
    LaunchedRow(
        name="process-descriptors-launcher-agent-killed",
        event="the launcher has no descriptor left, and an agent is killed",
        reaction="the vehicle that nobody can recover is named, the verdict printed",
        within_s=60.0,
        protection="a recovery that can't be started is no end of the flight",
        script=descriptors_of_the_launcher_and_an_agent_dies,
        readable=False,
        off=in_program("launch", RAISES),
    ),
    LaunchedRow(
        name="start-configuration-wrong",
        event="a configuration with three mistakes",
        reaction="refused with exit code 2, all mistakes at once with key, value and fix",
        within_s=20.0,
        protection="unknown keys are forbidden",
        script=configuration_wrong,
        readable=False,
        off=in_program("launch", "import swarmctl.core.params as it\nit.Params.model_config['extra'] = 'ignore'"),
    ),
    LaunchedRow(
        name="start-ports-taken",
        event="the port of one vehicle is taken, the device of another does not exist",
        reaction="refused with exit code 3, both named, before anything starts",
        within_s=20.0,
        protection="pre-flight check of the vehicles' links",
        script=ports_taken,
        readable=False,
        off=in_program("launch", "import swarmctl.ops.preflight as it\nit._vehicle_problems = lambda *_: ()"),
    ),
    LaunchedRow(
        name="start-vehicle-missing",
        event="no vehicle sends to its port",
        reaction="the launch ends with exit code 3 and names it",
        within_s=30.0,
        protection="limit on the wait for a vehicle (agent.connect_timeout_s)",
        script=vehicle_missing,
        readable=False,
        off=in_program(
            "agent", "import swarmctl.agent.runner as it\nit._check_vehicle_silence = lambda *_, **__: None"
        ),
    ),
)
