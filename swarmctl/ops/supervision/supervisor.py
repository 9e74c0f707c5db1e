"""Supervision of one flight: reads agents' status, watches processes, orders the landing and collects the result.

The supervisor never flies: it commands agents as an operator on the bus. When a process dies, that is reported and the
others go on; only without an essential process (router, simulator) all agents land.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from functools import partial

from swarmctl.bus.bus import Bus, agent_name
from swarmctl.bus.messages.json_messages import EndedMessage
from swarmctl.bus.orders import EVERYBODY, order_messages
from swarmctl.bus.topics import COMMAND
from swarmctl.config import Config
from swarmctl.core.operator_verbs import Order
from swarmctl.core.text import counted
from swarmctl.core.types import Phase
from swarmctl.errors import EXIT_INTERRUPTED, EXIT_MISSION, EXIT_OK, EXIT_START, StartError
from swarmctl.ops.orders.operator import ends_heard, list_setters
from swarmctl.ops.orders.order_delivery import numbered
from swarmctl.ops.processes import ROUTER, SITL, VIEWER, Child, RunContext, kill_all
from swarmctl.ops.supervision.bus_report import BusReport
from swarmctl.ops.supervision.ended_processes import EndedProcesses
from swarmctl.ops.supervision.ends_elsewhere import EndsElsewhere
from swarmctl.ops.supervision.hearing import Hearing
from swarmctl.ops.supervision.landing_order import LandingOrder, is_landing
from swarmctl.ops.supervision.launch_result import LaunchResult, why_it_failed
from swarmctl.ops.supervision.obstacle_keeper import ObstacleKeeper
from swarmctl.ops.supervision.own_pause import OwnPause
from swarmctl.ops.supervision.recovery import Recovery, handed_over, is_done
from swarmctl.ops.supervision.standstill import Standstill
from swarmctl.ops.supervision.status_table import AgentView, Display, name_of, tell
from swarmctl.ops.supervision.viewer_watch import ViewerWatch
from swarmctl.telemetry.recording.event_log import EventLog
from swarmctl.telemetry.recording.obstacle_lists import recorded_list
from swarmctl.wall_clock import WallClock

ESSENTIAL_ENDED = {ROUTER: "router_ended", SITL: "sitl_ended"}  # event of the end of each essential process

_STEP_S = 0.05
_FIRST_STATUS_S = 60.0  # timeout for every agent to appear on the bus
_VEHICLE_S = 90.0  # least timeout for every agent to receive its vehicle, and set it up
_SET_UP_S = 30.0  # of it, beyond `agent.connect_timeout_s`
_BEYOND_MISSION_S = 300.0  # for take-off, waiting and landing; a longer flight is ended
_TIMED = (Phase.TRACK, Phase.GOTO_LAND)  # phases whose end is known
_SILENCE_S = 5.0
_STANDSTILL_S = 5.0  # of a silent agent, after which it is ended
_LAND_S = 60.0  # for agents to land that are told to; later they are killed
_LAND_OBEYED_S = 10.0
_ROUTER_STARTS = 3  # in one flight
_TOLD_S = 0.3  # in which the router passes on what it was told last
_ENDED_BY_SIGTERM = 128 + signal.SIGTERM  # exit code
_AFTER_DEATH_S = 3.0  # the simulator must outlive a dead agent until its vehicle has landed


class Services:
    """Services that a flight relies on; `swarmctl.ops.flight.launch` starts and stops them."""

    context: RunContext
    log: EventLog
    children: dict[str, Child]  # by name; agents have their names on the bus
    bus: Bus | None = None
    clock: WallClock  # as agents have it: it follows steps of UTC slowly

    def announce(self, view: str) -> None:
        """Publish the address of the live view to the operator's commands."""
        raise NotImplementedError

    def announce_clock(self) -> None:
        """Publish the clock to the operator's commands again, where it was corrected."""
        raise NotImplementedError

    def announce_down(self, agents: tuple[int, ...]) -> None:
        """Publish to the operator's commands which agents have ended with their vehicles down."""
        raise NotImplementedError

    def restart_router(self) -> None:
        """Start the router again; the sessions of everybody find it."""
        raise NotImplementedError

    def recover(self, agent: int) -> Child:
        """Start an agent that only lands the vehicle of an ended one."""
        raise NotImplementedError


class FlightSupervisor:
    """Watches one launch until every agent has ended or has been given up."""

    def __init__(self, config: Config, services: Services, display: Display) -> None:
        if services.bus is None:
            raise ValueError("the bus must be up before the flight is watched")
        self._config = config
        self._services = services
        self._bus: Bus = services.bus
        self._display = display
        self._announce = partial(tell, services.log, display)
        self._result = LaunchResult()
        self._viewer_watch = ViewerWatch(services.children.get(VIEWER), self._announce, services.announce)
        self._views = [AgentView(agent=agent) for agent in services.context.agents]
        self._ended = EndedProcesses(self._bus)
        self._ends_elsewhere = EndsElsewhere(ends_heard(services.context.identity))
        self._report = BusReport(self._bus, services.log.write, display)
        self._obstacles = ObstacleKeeper(
            self._bus,
            config.obstacles,
            services.clock,
            trusted=list_setters(services.context.identity),
            refuse=self._report.refuse,
        )
        self._hearing = Hearing(self._bus, self._announce)
        self._standstill = Standstill()
        self._started_s = time.monotonic()
        self._own_pause = OwnPause(self._started_s)
        self._mission_ends_s = self._started_s + config.mission.duration_s  # at the earliest
        self._vehicle_s = max(_VEHICLE_S, config.agent.connect_timeout_s + _SET_UP_S)
        self._reported: set[str] = set()
        self._router_starts = 0  # how often it was started again
        self._essential_lost = False  # an essential process, router or simulator, has ended
        self._vehicles_lost = False  # the simulator has ended, and its vehicles with it
        self._recovery = Recovery(services.recover, config.sysids())
        self._landing = LandingOrder()

    def fly(self, interrupts: Callable[[], int]) -> LaunchResult:
        """Watch the flight to its end.

        Args:
            interrupts: number of stop requests; the first lands all agents, the second kills all processes.
        """
        if configured := self._obstacles.newest.obstacles:
            text = f"{counted(len(configured), 'obstacle')}, as configured"
            self._services.log.write("obstacles", text=text, **recorded_list(self._obstacles.newest))
        while interrupts() < 2:
            self._own_pause.excuse(time.monotonic(), self._views)
            self._receive()
            self._watch_essential_processes()
            self._viewer_watch.step()
            self._watch_agents()
            self._watch_time()
            if interrupts() and not self._result.interrupted:
                self._result.interrupted = True
                self._announce("interrupted", "interrupted: landing; once more ends everything at once")
                self._land(_LAND_S)
            self._speak()
            self._display.show(self._views)
            if self._is_over():
                return self._report_left_vehicles()
            time.sleep(_STEP_S)
        self._result.interrupted = True
        self._fail("killed", "interrupted twice: every process was killed, vehicles were left to their autopilots")
        self._kill_everything()
        return self._report_left_vehicles()

    def _kill_everything(self) -> None:
        """Kill every process; agents first, so that those of other computers are told of their ends."""
        running, children = self._running(), self._services.children
        ended = {
            view.agent: (view, code)  # since the agents were watched
            for view, child in zip(self._views, self._agents(), strict=True)
            if (code := child.poll()) is not None and self._is_first(_end_of(child))
        }
        if len(self._views) < self._config.swarm.agents:
            kill_all([children[agent_name(view.agent)] for view in running])
            for view, code in (*ended.values(), *((view, 128 + signal.SIGKILL) for view in running)):
                self._vouch_for_end(view, code)
            time.sleep(_TOLD_S)
        kill_all(list(children.values()))
        if not self._config.sitl.enabled:
            left = [view for view, code in ended.values() if not self._recovery.leaves_down(view, code)]
            self._recovery.give_up([*running, *left])

    def _report_left_vehicles(self) -> LaunchResult:
        """Report every vehicle that is not known to be on the ground, and the parameters that were not set back."""
        self._result.left = () if self._vehicles_lost else tuple(self._recovery.left(self._views))
        for words in self._result.left:
            self._fail("vehicle_left", words)
        if not self._config.sitl.enabled:
            for words in self._recovery.kept_parameters(self._views, self._services.context.directory):
                self._fail("parameters_kept", words)
        return self._result

    def _receive(self) -> None:
        for status in self._report.statuses():
            view = next((view for view in self._views if view.agent == status.agent), None)
            if view is None:  # of another computer
                self._ends_elsewhere.hear(status, time.monotonic())
                continue
            if view.status is None or view.status.phase != status.phase:
                self._services.log.write("phase", agent=status.agent, phase=name_of(Phase, status.phase))
            view.status, view.received_s = status, time.monotonic()
            self._hearing.hear(view.agent)
            waits = status.held or status.phase < Phase.TRACK  # for as long as agents or operators want
            if waits or status.phase in _TIMED:  # a mission, also one that an operator has set, or a long way back
                left_s = self._config.mission.duration_s if waits else status.ends_in_s
                self._mission_ends_s = max(self._mission_ends_s, time.monotonic() + left_s)
            may_be_armed = status.phase < Phase.GOTO_LAND or status.armed  # a stop on the ground passes LAND, too
            self._result.has_armed |= Phase.ARM <= status.phase < Phase.DONE and may_be_armed
        self._ends_elsewhere.receive(self._report)
        adopted = self._obstacles.receive()
        for adoption in adopted:
            text = f"{counted(len(adoption.after.obstacles), 'obstacle')}, set by an operator"
            self._announce("obstacles", text, **recorded_list(adoption.after))
        for event, text in self._obstacles.news(adopted):
            self._announce(event, text)
        self._report.step(anybody=bool(self._flying()))

    def _watch_essential_processes(self) -> None:
        """Start a router again; land all agents when it ends again and again, or the simulator has ended."""
        router = self._services.children.get(ROUTER)
        if router is not None and router.poll() is not None and self._router_starts < _ROUTER_STARTS:
            self._router_starts += 1
            text = f"router {router.how_it_ended()}; it is started again, the flight goes on"
            self._announce(ESSENTIAL_ENDED[ROUTER], text)
            try:
                self._services.restart_router()
            except (StartError, OSError) as error:
                self._announce("router_failed", f"the router can't be started again: {error}")
        for name, land_s in ((ROUTER, _LAND_S), (SITL, _AFTER_DEATH_S)):
            child = self._services.children.get(name)
            if child is not None and child.poll() is not None and self._is_first(name):
                self._essential_lost = True
                self._vehicles_lost |= name == SITL
                self._result.could_not_start |= not any(view.status for view in self._views)
                self._fail(ESSENTIAL_ENDED[name], f"{name} {child.how_it_ended()}; landing. See {child.log}")
                self._land(land_s)

    def _watch_agents(self) -> None:
        now_s = time.monotonic()
        for view in self._views:
            child = self._services.children[agent_name(view.agent)]
            code = child.poll()
            if code is None:
                self._check_responsive(view, child, now_s)
            elif self._is_first(_end_of(child)):
                self._vouch_for_end(view, code)
                self._note_end(view, child, code)
                self._recover(view, code)

    def _vouch_for_end(self, view: AgentView, code: int) -> None:
        """Tell the others, here and elsewhere, that an agent's process has ended, before another takes its place."""
        boot_id, is_down = None if view.status is None else view.status.boot_id, self._recovery.leaves_down(view, code)
        self._ended.tell(EndedMessage(agent=view.agent, boot_id=boot_id, is_down=is_down))

    def _order(self, order: Order, views: list[AgentView], agent: int = EVERYBODY) -> None:
        """Give an order to an agent, or all, stamped by the clocks of these. A repetition is another, obeyed anew."""
        now_s = time.monotonic()
        clocks_us = [
            view.status.utc_us + round((now_s - view.received_s) * 1e6) for view in views if view.status is not None
        ]
        for message in order_messages(numbered(order), agent, self._services.clock.utc_us(), clocks_us):
            self._bus.publish(COMMAND, message)

    def _recover(self, view: AgentView, code: int) -> None:
        """Start another process that lands a vehicle which is not known to be down."""
        is_down = self._recovery.leaves_down(view, code)
        if self._recovery.is_on(view.agent) and code == EXIT_INTERRUPTED and is_down:
            self._announce("recovered", f"the vehicle of {agent_name(view.agent)} is on the ground and disarmed")
        try:
            child = None if self._vehicles_lost else self._recovery.begin(view, code)
        except (StartError, OSError) as error:
            self._fail("recovery_failed", f"the vehicle of {agent_name(view.agent)} can't be recovered: {error}")
            return
        if child is None:
            if not self._vehicles_lost and (words := handed_over(view)):
                self._announce("handed_over", words)
            return
        self._services.children[agent_name(view.agent)] = child
        view.note, view.received_s = "recovering", time.monotonic()
        self._announce(
            "recovering", f"landing the vehicle of {agent_name(view.agent)}, which may be armed or in the air"
        )

    def _check_responsive(self, view: AgentView, child: Child, now_s: float) -> None:
        waited_s, no_vehicle = now_s - self._started_s, f"{child.name} vehicle"
        if view.status is None:
            if waited_s > _FIRST_STATUS_S and self._is_first(f"{child.name} unresponsive"):
                self._refuse(f"{child.name} is not on the bus after {_FIRST_STATUS_S:.0f} s; see {child.log}")
        elif self._recovery.is_on(view.agent):
            if self._recovery.is_overdue(view.agent):
                child.kill_all()
        elif self._hearing.is_silent(view.agent, now_s - view.received_s, _SILENCE_S):
            view.note = "silent"
            if self._is_first(f"{child.name} silent"):
                self._fail(
                    "agent_unresponsive", f"{child.name} has been silent for {_SILENCE_S:.0f} s; the others fly on"
                )
            self._end_if_frozen(child, now_s)
        elif view.note:
            view.note = ""
            self._announce("agent_back", f"{child.name} responds again")
        elif view.status.phase == Phase.CONNECT and waited_s > self._vehicle_s and self._is_first(no_vehicle):
            url = self._config.vehicles[view.agent].url if self._config.vehicles else "the built-in SITL"
            self._refuse(
                f"{child.name} hears no vehicle at {url} after {self._vehicle_s:.0f} s; check that it is on and sends"
            )

    def _end_if_frozen(self, child: Child, now_s: float) -> None:
        """End a silent agent that does not run, so that its vehicle is recovered and the others are told."""
        if self._standstill.lasts_s(child, now_s) > _STANDSTILL_S and self._is_first(f"{child.name} frozen"):
            self._fail("agent_frozen", f"{child.name} has not run for {_STANDSTILL_S:.0f} s, and was ended")
            child.kill_all()

    def _watch_time(self) -> None:
        limit_s = self._mission_ends_s + _BEYOND_MISSION_S - self._started_s
        if time.monotonic() - self._started_s > limit_s and self._is_first("too long"):
            self._fail("too_long", f"the flight did not end within {limit_s:.0f} s; landing")
            self._land(_LAND_S)

    def _speak(self) -> None:
        now_s = time.monotonic()
        self._obstacles.repeat()
        self._services.announce_clock()
        self._services.announce_down(self._ends_elsewhere.down(now_s))
        self._ended.repeat()
        if self._landing.is_to_be_said(now_s):
            self._repeat_land_order(self._landing.since_s(now_s))

    def _repeat_land_order(self, since_s: float) -> None:
        """Repeat the order on the bus, newly stamped, until every agent shows that it lands; later also by signal."""
        deaf = [view for view in self._flying() if not is_landing(view)]
        if deaf and len(self._views) == self._config.swarm.agents:
            self._order(Order("land"), deaf)
        elif deaf:  # agents of other computers fly on
            for view in deaf:
                self._order(Order("land"), [view], view.agent)
        for view in deaf:
            child = self._services.children[agent_name(view.agent)]
            if since_s > _LAND_OBEYED_S and self._is_first(f"{child.name} told by signal"):
                child.signal(signal.SIGTERM)

    def _is_over(self) -> bool:
        """Return whether no agent is left to wait for. Silent agents are given up when no other one flies."""
        now_s = time.monotonic()
        running = self._running()
        if any(_end_of(child) not in self._reported for child in self._agents() if child.poll() is not None):
            return False  # it has ended since the agents were watched, and may say how the flight went
        if self._landing.is_overdue(now_s):
            self._end_late([v for v in running if not (self._is_recovered(v) or self._is_landing(v, now_s))])
            return not running
        if not running:
            deaths_s = [
                c.ended_s
                for c in self._services.children.values()
                if c.ended_s is not None and c.poll() not in (0, 130)
            ]
            return self._essential_lost or not deaths_s or now_s - max(deaths_s) > _AFTER_DEATH_S
        if not self._landing.is_given and all(view.note == "silent" for view in running):
            bus_is_suspect = len(running) == len(self._views) and len(running) > 1
            self._land(_LAND_S if bus_is_suspect else _AFTER_DEATH_S)
        return False

    def _is_recovered(self, view: AgentView) -> bool:
        """Return whether its vehicle is being landed, which has a time of its own."""
        agent = view.agent
        return self._recovery.is_on(agent) and not (self._vehicles_lost or self._recovery.is_overdue(agent))

    def _is_landing(self, view: AgentView, now_s: float) -> bool:
        return not self._vehicles_lost and self._landing.is_obeyed(view, now_s)

    def _end_late(self, running: list[AgentView]) -> None:
        """Kill who has not landed in time, and who is done and only waits for those."""
        for view in running:
            child = self._services.children[agent_name(view.agent)]
            if view.status is not None and is_done(view.status):
                self._reported.add(_end_of(child))
                kill_all([child])
                self._vouch_for_end(view, 128 + signal.SIGKILL)
                self._recover(view, 128 + signal.SIGKILL)
                continue
            if not self._recovery.is_on(view.agent):
                self._fail("not_landed", f"{child.name} did not end in time and was killed")
            kill_all([child])

    def _note_end(self, view: AgentView, child: Child, code: int) -> None:
        view.note = "done" if code == EXIT_OK else f"exit {code}"
        self._services.log.write("agent_ended", agent=view.agent, exit_code=code)
        if code == EXIT_OK or self._essential_lost or self._recovery.is_on(view.agent):
            return
        if code == EXIT_INTERRUPTED:
            self._result.landed_by_operator |= not self._landing.is_given
        elif code == EXIT_START:
            self._refuse(f"{child.name} could not start: {child.last_line()}")
        elif code == EXIT_MISSION:
            outcome = view.status.outcome if view.status else ""
            self._fail("agent_failed", f"{child.name} failed: {why_it_failed(outcome, child.last_line())}")
        elif view.status is None:
            if not self._landing.is_given or code != _ENDED_BY_SIGTERM:  # `_land` ends so who still loads its modules
                self._refuse(f"{child.name} could not start: it {child.how_it_ended()}")
        else:
            view.note = "dead"
            others = "; the others fly on" if self._flying() else ""
            self._fail("agent_died", f"{child.name} {child.how_it_ended()}{others}")

    def _land(self, timeout_s: float) -> None:
        """Order all agents to land over the bus; by signal where the bus does not reach."""
        if self._landing.give(time.monotonic(), timeout_s):
            self._services.log.write("land")
        for view in self._flying():
            if self._essential_lost or view.status is None or view.note == "silent":
                self._services.children[agent_name(view.agent)].signal(signal.SIGTERM)

    def _refuse(self, problem: str) -> None:
        self._result.could_not_start = True
        self._fail("start_failed", problem)
        self._land(_LAND_S)

    def _fail(self, event: str, problem: str) -> None:
        self._result.problems.append(problem)
        self._announce(event, problem)

    def _is_first(self, what: str) -> bool:
        if what in self._reported:
            return False
        self._reported.add(what)
        return True

    def _agents(self) -> list[Child]:
        return [self._services.children[agent_name(view.agent)] for view in self._views]

    def _running(self) -> list[AgentView]:
        return [view for view, child in zip(self._views, self._agents(), strict=True) if child.poll() is None]

    def _flying(self) -> list[AgentView]:
        """Return those whose own agents still run: what lands the vehicle of another says nothing at first."""
        return [view for view in self._running() if not self._recovery.is_on(view.agent)]


def _end_of(child: Child) -> str:
    """Return the words under which the end of this process is noted once."""
    return f"{child.name} {child.pid} ended"
