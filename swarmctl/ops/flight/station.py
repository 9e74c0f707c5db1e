"""`swarmctl station`: shows, records and judges a swarm that flies from several computers, and lets verbs act on it.

No agent needs it: it may start late, end early, or never be there. What it records are the reports of the agents, so
it judges by estimates, as a launch over real vehicles does; it notes when they arrive, as their clocks may differ.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path

from swarmctl.bus.bus import Bus, agent_name
from swarmctl.bus.messages.json_messages import ObstaclesMessage, StatusMessage
from swarmctl.bus.network.hosts import links_of
from swarmctl.bus.network.identity_files import STATION
from swarmctl.bus.topics import TICK
from swarmctl.config import Config, own_identity
from swarmctl.control.phases.obeyed_orders import OPERATOR_STOP
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.recorded.records import unpack_tick
from swarmctl.core.types import Phase
from swarmctl.errors import ConfigError
from swarmctl.ops.flight.host import refuse_unidentified, shared_run_name
from swarmctl.ops.flight.launch import LaunchOptions, SwarmPart, judged, started
from swarmctl.ops.orders.operator import list_setters
from swarmctl.ops.processes import ROUTER, VIEWER
from swarmctl.ops.supervision.bus_report import BusReport
from swarmctl.ops.supervision.launch_result import LaunchResult
from swarmctl.ops.supervision.obstacle_keeper import ObstacleKeeper, adoption_text
from swarmctl.ops.supervision.recovery import RECOVERY_S
from swarmctl.ops.supervision.sender_clocks import SenderClocks
from swarmctl.ops.supervision.status_table import AgentView, Display, name_of, tell
from swarmctl.ops.supervision.viewer_watch import ViewerWatch
from swarmctl.process_lifetime import StopRequest
from swarmctl.telemetry.recording.obstacle_lists import recorded_list
from swarmctl.telemetry.recording.recorder import Recorder
from swarmctl.wall_clock import WallClock

_STEP_S = 0.05
_GONE_S = 3.0  # an agent that was done and is silent for so long has ended
_SILENT_S = 5.0  # an agent in flight that is silent for so long when the station is ended counts as lost; 25 statuses
_PAUSE_S = 0.5  # of the station itself


def run_station(config: Config, options: LaunchOptions) -> int:
    """Watch a whole swarm until every agent has ended, or until Ctrl-C, and return the exit code of its flight.

    Raises:
        ConfigError, StartError: it was refused, or did not come up.
    """
    if not config.hosts:
        raise ConfigError("hosts", ["the configuration lists none; a swarm on one computer flies by: swarmctl launch"])
    refuse_unidentified(config, STATION)
    links = links_of(config.hosts, own_identity(config, STATION))
    part = SwarmPart(run=shared_run_name(config), agents=(), links=links)
    with StopRequest(signal.SIGINT, signal.SIGTERM, signal.SIGHUP) as stop:
        with started(config, options, part) as services:
            watch = SwarmWatch(
                services.joined_bus,
                config.swarm.agents,
                services.context.directory,
                services.display,
                note=services.log.write,
                configured=config.obstacles,
                list_setters=list_setters(services.context.identity),
                clock=services.clock,
            )
            told = partial(tell, services.log, services.display)
            viewer = ViewerWatch(services.children.get(VIEWER), told, services.announce)
            router = services.children[ROUTER]
            while not (stop.count or watch.step()):
                viewer.step()
                services.announce_clock()
                if router.poll() is not None:
                    watch.problems.append(f"router {router.how_it_ended()}; see {router.log}. The swarm flies on")
                    break
                time.sleep(_STEP_S)
            watch.close()
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # a terminal that closes now must not lose the result
    result = LaunchResult(
        problems=watch.problems,
        interrupted=bool(stop.count),
        landed_by_operator=watch.was_stopped,
        has_armed=True,
    )
    return judged(config, services, result)


class SwarmWatch:
    """Shows and records agents that run elsewhere, and repeats the obstacles that operators set.

    Args:
        bus: receives their statuses and ticks.
        agents: size of the swarm.
        directory: run folder for what they report.
        display: shows them.
        note: is told of refused messages, see `Refusals`, of lists of obstacles, and of senders' clocks.
        configured, list_setters, clock: see `ObstacleKeeper`.
        clock_s: monotonic time [s].

    Attributes:
        problems: what went wrong, in words.
        was_stopped: whether an operator has ended the mission of an agent.
    """

    def __init__(
        self,
        bus: Bus,
        agents: int,
        directory: Path,
        display: Display,
        note: Callable[..., None],
        clock_s: Callable[[], float] = time.monotonic,
        *,
        configured: Sequence[Obstacle] = (),
        list_setters: Collection[str] = (),
        clock: WallClock | None = None,
    ) -> None:
        self._bus, self._display, self._clock_s = bus, display, clock_s
        self._report, self._note = BusReport(bus, note, display), note
        self._obstacles = ObstacleKeeper(
            bus, configured, clock or WallClock(), trusted=list_setters, refuse=self._report.refuse
        )
        self._recorded_list: ObstaclesMessage | None = None
        self._views = [AgentView(agent=agent) for agent in range(agents)]
        self._numbers = {agent_name(agent): agent for agent in range(agents)}
        self._recorders = {name: Recorder(directory, agent) for name, agent in self._numbers.items()}
        self._clocks = SenderClocks(note)
        self._flying: set[int] = set()  # agents that were heard between the beginning and the end of a flight
        self._ended_in_flight: dict[int, str] = {}  # agents whose process has, in words
        self._stepped_s = clock_s()
        self._is_over = False
        self.problems: list[str] = []
        self.was_stopped = False

    def step(self) -> bool:
        """Show and record what has arrived; returns whether every agent was done and has ended, or is lost."""
        now_s = self._clock_s()
        self._excuse_own_pause(now_s)
        self._record_ticks()
        for status in self._report.statuses():
            if 0 <= status.agent < len(self._views):
                view = self._views[status.agent]
                if view.status is not None and _flies(view.status) and status.boot_id != view.status.boot_id:
                    in_phase = name_of(Phase, view.status.phase)
                    ended = f"{agent_name(view.agent)} ended in {in_phase}, and another process took its vehicle over"
                    self._ended_in_flight.setdefault(view.agent, ended)
                view.status, view.received_s = status, now_s
                if _flies(status):
                    self._flying.add(status.agent)
        self._keep_obstacles()
        self._report.step()
        self._display.show(self._views)
        lost = self._lost(now_s, RECOVERY_S)  # a host that lives would have landed its vehicle meanwhile
        self._is_over = all(self._has_ended(view, now_s) or view.agent in lost for view in self._views)
        if self._is_over:
            self._conclude(lost)
        return self._is_over

    def close(self) -> None:
        """Write what is still to be recorded; who is silent in flight and not waited for any longer counts as lost."""
        if not self._is_over:
            self.problems += self._lost(self._clock_s(), _SILENT_S).values()
        self._clocks.close()
        for recorder in self._recorders.values():
            recorder.close()

    def _keep_obstacles(self) -> None:
        """Repeat the list of obstacles, record what hosts keep clear of, and say what operators have to know."""
        for adoption in self._obstacles.receive():
            if overruled := adoption_text(adoption.before, adoption.after):
                self._tell("obstacles_overruled", overruled)
        for text in self._obstacles.others():
            self._tell("obstacles_elsewhere", text)
        heard = self._obstacles.heard
        if heard is not None and heard is not self._recorded_list:
            self._recorded_list = heard
            self._note("obstacles", **recorded_list(heard))
        self._obstacles.repeat()

    def _tell(self, event: str, text: str) -> None:
        self._note(event, text=text)
        self._display.print_line(text)

    def _record_ticks(self) -> None:
        arrived = self._bus.receive(TICK)
        arrival_us = round(1e6 * self._clock_s())  # not earlier than that of any of them
        for sender, payload in arrived:
            tick = unpack_tick(payload)
            if tick is not None:
                self._recorders[sender].tick(tick[0], None)
                self._clocks.received(self._numbers[sender], int(tick[0]["t_us"][0]), arrival_us)

    def _has_ended(self, view: AgentView, now_s: float) -> bool:
        done = view.status is not None and view.status.phase == Phase.DONE
        return done and now_s - view.received_s > _GONE_S

    def _lost(self, now_s: float, silent_s: float) -> dict[int, str]:
        """Return which agents were flying and are silent for longer than `silent_s`, in words."""
        return {
            view.agent: f"{agent_name(view.agent)} was lost in {name_of(Phase, view.status.phase)}: "
            f"nothing was heard of it for {now_s - view.received_s:.0f} s"
            for view in self._views
            if view.status is not None and view.agent in self._flying and view.status.phase != Phase.DONE
            if now_s - view.received_s >= silent_s
        }

    def _conclude(self, lost: Mapping[int, str]) -> None:
        """Tell the ends of all agents; of one that was taken over in flight that alone: the outcome is not its own."""
        told = {**self._ended_in_flight, **lost}
        self.problems += told.values()
        outcomes = {v.agent: v.status.outcome for v in self._views if v.status is not None and v.agent not in told}
        self.was_stopped = OPERATOR_STOP in outcomes.values()
        for agent, outcome in outcomes.items():
            if outcome not in ("completed", OPERATOR_STOP):
                self.problems.append(f"{agent_name(agent)} failed: {outcome or 'no reason given'}")

    def _excuse_own_pause(self, now_s: float) -> None:
        """Count no time in which this process itself did not run: nobody was lost in it."""
        paused_s, self._stepped_s = now_s - self._stepped_s, now_s
        if paused_s > _PAUSE_S:
            for view in self._views:
                view.received_s += paused_s if view.status is not None else 0.0


def _flies(status: StatusMessage) -> bool:
    """Tell whether an agent is between the beginning and the end of a flight."""
    return status.armed or Phase.STANDBY < status.phase < Phase.DONE
