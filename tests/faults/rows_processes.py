"""Processes killed, stopped and starved; disk, descriptors and terminal gone; a start that can't work."""

from __future__ import annotations

from tests.faults.launched import LaunchedRow
from tests.faults.process_events import (
    ROUTER,
    agent_frozen_where_four_meet,
    agent_killed,
    agent_starved,
    agent_stopped_briefly,
    agent_stopped_for_2_s,
    agent_stopped_for_20_s,
    in_program,
    loss_after,
    router_killed_again_and_again,
    router_stopped,
    simulator_killed,
    simulator_started_again,
    viewer_killed,
    viewer_stopped,
)
from tests.faults.process_limits import (
    configuration_wrong,
    descriptors_of_an_agent,
    descriptors_of_the_launcher,
    descriptors_of_the_launcher_and_an_agent_dies,
    descriptors_of_the_router,
    disk_full,
    ports_taken,
    reader_ends,
    run_folder_renamed_and_an_agent_dies,
    vehicle_missing,
)
from tests.faults.row import Off
from tests.process.test_launch import (
    a_closed_terminal_lands_and_keeps_the_verdict,
    a_killed_launcher_leaves_nothing,
    a_second_ctrl_c_ends_everything_at_once,
    ctrl_c_lands_and_sums_up,
    without_its_router_the_flight_goes_on_with_another,
)

SUPERVISOR = "import swarmctl.ops.supervision.supervisor as supervisor\n"
HEARING = "import swarmctl.ops.supervision.hearing as hearing\n"
RAISES = """
import json
import swarmctl.telemetry.recording.event_log as log
def write(self, event, **fields):
    with self._path.open("a", encoding="utf-8") as file:
        file.write(json.dumps({"utc_us": 0, "t_us": 0, "source": self._source, "event": event, **fields}) + "\\n")
log.EventLog.write = write
"""
TRUTH_RAISES = """
import sitl.realtime as it
record = it.TruthFile.record
def raising(self, world, now_us):
    record(self, world, now_us)
    if self.lost:
        raise OSError(28, "No space left on device")
it.TruthFile.record = raising
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
        reaction="it is named and not waited for; its vehicle is landed",
        within_s=90.0,
        protection="agents that are silent are not waited for",
        script=agent_stopped_for_20_s,
        off=in_program("launch", SUPERVISOR + "supervisor._SILENCE_S = 1e9"),
    ),
    LaunchedRow(
        name="process-agent-frozen",
        event="an agent's process is stopped for good where four meet, with guaranteed separation",
        reaction="it is ended, and another process lands its vehicle; the others, who have waited, arrive",
        within_s=15.0,
        protection="who is silent and does not run is ended",
        script=agent_frozen_where_four_meet,
        off=in_program("launch", SUPERVISOR + "supervisor._STANDSTILL_S = 1e9"),
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
            "import swarmctl.control.failsafe.overload as it\nit.Overload.update = lambda *_, **__: None",
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
        protection="agents are silent for 5 s, also on another session if one can be opened, before they are given up",
        script=router_stopped,
        off=in_program("launch", SUPERVISOR + "supervisor._SILENCE_S = 0.5\n" + HEARING + "hearing._OPENING_S = 0.0"),
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
        script=simulator_killed,
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
            "import swarmctl.mavlink.vehicle.vehicle_clock as it\n"
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
        off=in_program("launch", "import swarmctl.ops.processes as it\nit.Child.is_stopped = lambda self: False"),
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
        protection="the second stop does not wait for landings",
        script=a_second_ctrl_c_ends_everything_at_once,
        off=in_program(
            "launch",
            SUPERVISOR + "fly = supervisor.FlightSupervisor.fly\n"
            "supervisor.FlightSupervisor.fly = lambda self, interrupts: fly(self, lambda: min(1, interrupts()))",
        ),
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
            "import swarmctl.ops.supervision.status_table as it\n"
            "it.PlainLines.print_line = lambda self, text: print(text, flush=True)",
        ),
    ),
    *(
        LaunchedRow(
            name=f"process-disk-full-{phase.lower()}",
            event=f"the disk is full from {phase} on",
            reaction="the mission is flown to its end, the verdict printed, what is missing named",
            within_s=90.0,
            protection="a full disk loses records, never the flight",
            script=disk_full(phase),
            readable=False,
            off=in_program("sitl", TRUTH_RAISES),
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
        off=Off(
            preload=in_program(
                ROUTER, "import os, threading\nthreading.Timer(12.0, lambda: os._exit(1)).start()"
            ).preload
            + "\n"
            + in_program("launch", SUPERVISOR + "supervisor._ROUTER_STARTS = 0").preload
        ),
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
        name="process-run-folder-renamed-agent-killed",
        event="the run folder is renamed in flight, and an agent is killed",
        reaction="another process lands its vehicle, the verdict is printed",
        within_s=90.0,
        protection="what lands a vehicle needs no run folder",
        script=run_folder_renamed_and_an_agent_dies,
        readable=False,
        off=in_program(
            "launch",
            "import swarmctl.ops.flight.launch as it\n"
            "it.Launcher._recovery_folder = lambda self: self.context.directory / 'recovery'",
        ),
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
