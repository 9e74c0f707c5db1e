"""`swarmctl station`: shows, records and judges a swarm that flies from several computers, and lets verbs act on it.

No agent needs it: it may start late, end early, or never be there. What it records are the ticks and events of the
agents, so it judges by estimates, as a launch over real vehicles does; it notes when ticks arrive, as clocks differ.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Collection, Mapping, Sequence, Set
from functools import partial
from pathlib import Path
from typing import Any

from swarmctl.bus.bus import Bus, agent_name
from swarmctl.bus.messages.json_messages import EndedMessage, ObstaclesMessage, StatusMessage
from swarmctl.bus.network.hosts import links_of
from swarmctl.bus.network.identity_files import STATION
from swarmctl.bus.peers.vouched_ends import VouchedEnds
from swarmctl.bus.topics import TICK
from swarmctl.config import Config, own_identity
from swarmctl.control.phases.obeyed_orders import OPERATOR_STOP
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.recorded.records import unpack_tick
from swarmctl.core.types import Phase
from swarmctl.flown_code import code_in_words
from swarmctl.ops.flight.host import refuse_no_hosts, refuse_unidentified, shared_run_name
from swarmctl.ops.flight.launch import LaunchOptions, SwarmPart, judged, started
from swarmctl.ops.orders.operator import list_setters
from swarmctl.ops.processes import ROUTER, VIEWER
from swarmctl.ops.supervision.bus_report import BusReport
from swarmctl.ops.supervision.launch_result import LaunchResult
from swarmctl.ops.supervision.obstacle_keeper import ObstacleKeeper
from swarmctl.ops.supervision.own_pause import OwnPause
from swarmctl.ops.supervision.recovery import RECOVERY_S, hand_over_in_words, is_done
from swarmctl.ops.supervision.sender_clocks import SenderClocks
from swarmctl.ops.supervision.status_table import AgentView, Display, name_of, tell
from swarmctl.ops.supervision.viewer_watch import ViewerWatch
from swarmctl.process_lifetime import StopRequest
from swarmctl.telemetry.recording.obstacle_lists import recorded_list
from swarmctl.telemetry.recording.recorder import Recorder
from swarmctl.wall_clock import WallClock

_STEP_S = 0.05
_DEAF_S = 5.0  # for which no status comes of any agent that is there; another session is opened before
_GONE_S = 3.0  # an agent that was done and is silent for so long has ended
_SILENT_S = 5.0  # an agent in flight that is silent for so long when the station is ended counts as lost; 25 statuses


def run_station(config: Config, options: LaunchOptions) -> int:
    """Watch a whole swarm until every agent has ended, or until Ctrl-C, and return the exit code of its flight.

    Raises:
        ConfigError, StartError: it was refused, or did not come up.
    """
    refuse_no_hosts(config)
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
                vouchers={host.name: frozenset(host.agents) for host in config.hosts},
            )
            told = partial(tell, services.log, services.display)
            viewer = ViewerWatch(services.children.get(VIEWER), told, services.announce)
            router = services.children[ROUTER]
            while not (stop.count or watch.step()):
                viewer.step()
                services.announce_clock()
                services.announce_down(watch.down)
                if router.poll() is not None:
                    watch.problems.append(f"router {router.how_it_ended()}; see {router.log}. The swarm flies on")
                    break
                time.sleep(_STEP_S)
            watch.close()
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # a terminal that closes now must not lose the result
    result = LaunchResult(
        problems=watch.problems,
        interrupted=bool(stop.count) and not watch.is_over,
        landed_by_operator=watch.was_stopped,
        has_armed=True,
    )
    return judged(config, services, result)


class SwarmWatch:
    """Shows and records agents that run elsewhere, and repeats the obstacles that operators set.

    Args:
        bus: receives their statuses, ticks and events.
        agents: size of the swarm.
        directory: run folder for what they report.
        display: shows them.
        note: is told of refused messages, see `Refusals`, of lists of obstacles, of senders' clocks, and of agents that
            were not waited for.
        vouchers: agents of which each sender may say that they have ended.
        configured, list_setters: see `ObstacleKeeper`.
        clock: of this computer, by which its events are stamped too.
        clock_s: time by which agents are silent [s]; it may stand still while this computer is suspended.

    Attributes:
        problems: what went wrong, in words.
        was_stopped: whether an operator has ended the mission of an agent.
        is_over: whether every agent that is waited for has ended, or is lost.
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
        vouchers: Mapping[str, Set[int]],
        configured: Sequence[Obstacle] = (),
        list_setters: Collection[str] = (),
        clock: WallClock | None = None,
    ) -> None:
        self._bus, self._display, self._clock_s = bus, display, clock_s
        self._report, self._note = BusReport(bus, note, display), note
        self._clock = clock or WallClock()
        self._obstacles = ObstacleKeeper(bus, configured, self._clock, trusted=list_setters, refuse=self._report.refuse)
        self._recorded_list: ObstaclesMessage | None = None
        self._views = [AgentView(agent=agent, received_s=clock_s()) for agent in range(agents)]
        self._numbers = {agent_name(agent): agent for agent in range(agents)}
        self._recorders = {name: Recorder(directory, agent) for name, agent in self._numbers.items()}
        self._clocks = SenderClocks(note)
        self._flying: set[int] = set()  # agents that were heard between the beginning and the end of a flight
        self._without: set[int] = set()  # agents of which another one has said that it goes on without them
        self._ends = VouchedEnds(vouchers)
        self._died: dict[int, str] = {}  # agents whose process ended before the vehicle was down, in words
        self._own_pause = OwnPause(clock_s())
        self._code, self._has_told_code = code_in_words(own_folder=""), False
        self._has_told_deaf = False
        self.problems: list[str] = []
        self.was_stopped = self.is_over = False

    def step(self) -> bool:
        """Show and record what has arrived; returns whether it is over."""
        now_s = self._clock_s()
        self._own_pause.excuse(now_s, self._views)
        self._record_ticks()
        self._record_events()
        for status in self._report.statuses():
            if 0 <= status.agent < len(self._views):
                self._take_status(self._views[status.agent], status, now_s)
        for ended in self._report.ends(self._ends):
            if not ended.is_down:
                self._take_early_end(ended)
        self._keep_obstacles()
        self._tell_deaf(now_s)
        self._report.step()
        self._display.show(self._views)
        lost = self._lost(now_s, RECOVERY_S)  # a host that lives would have landed its vehicle meanwhile
        gone = [view.agent in lost or self._has_ended(view, now_s) for view in self._waited_for()]
        self.is_over = bool(gone) and all(gone)
        if self.is_over:
            self._conclude(lost, ())
        return self.is_over

    @property
    def down(self) -> tuple[int, ...]:
        """Return the agents that have ended and left their vehicles down, and whom no other process speaks for."""
        now_s = self._clock_s()
        return tuple(view.agent for view in self._views if self._is_down(view) and now_s - view.received_s > _GONE_S)

    def close(self) -> None:
        """Write what is still to be recorded; before it is over, judge by what is known, and say who has not ended."""
        if not self.is_over:
            now_s, waited_for = self._clock_s(), self._waited_for()
            not_ended = [view for view in waited_for if not (_is_done(view) or self._has_ended(view, now_s))]
            self.is_over = bool(waited_for) and not not_ended
            self._conclude(self._lost(now_s, _SILENT_S), not_ended)
        self._record_events()
        self._clocks.close()
        for recorder in self._recorders.values():
            recorder.close()

    def _take_status(self, view: AgentView, status: StatusMessage, now_s: float) -> None:
        if view.status is not None and _flies(view.status) and status.boot_id != view.status.boot_id:
            ended = f"{agent_name(view.agent)} ended in {_last_phase(view)}, and another process took its vehicle over"
            self._died[view.agent] = ended
        view.status, view.received_s = status, now_s
        self._without.update(status.without)
        self._compare_code(status)
        if _flies(status):
            self._flying.add(status.agent)

    def _take_early_end(self, ended: EndedMessage) -> None:
        """Note that a process has ended before its vehicle was down: it died, or was done and has handed that over."""
        status = self._views[ended.agent].status
        if status is not None and status.boot_id == ended.boot_id and is_done(status):
            self._say("handed_over", hand_over_in_words(status), agent=ended.agent)
        else:
            self._died.setdefault(ended.agent, f"{agent_name(ended.agent)} died before its vehicle was down")

    def _compare_code(self, status: StatusMessage) -> None:
        """Say once that an agent flies another swarmctl than this station; agents compare theirs with one another."""
        if self._has_told_code or status.code.startswith(self._code):
            return
        self._has_told_code = True
        theirs = status.code or "an older swarmctl"
        text = f"{agent_name(status.agent)} flies {theirs}, and {self._code} judges here: verdicts may differ"
        self._say("other_code", text, agent=status.agent, theirs=status.code, own=self._code)

    def _tell_deaf(self, now_s: float) -> None:
        """Say it once when agents are there of which nothing that may be lost arrives: nothing else would tell."""
        is_deaf = now_s - max((view.received_s for view in self._views), default=now_s) >= _DEAF_S
        there = sorted(self._numbers[name] for name in self._bus.alive() & self._numbers.keys()) if is_deaf else []
        if there and not self._has_told_deaf:
            names = ", ".join(map(agent_name, there))
            text = (
                f"{names}: on the bus, and no status has come for {_DEAF_S:g} s. Another station is running, or UDP at "
                "the port after that of the hosts' addresses does not pass"
            )
            self._say("station_deaf", text, agents=there)
        self._has_told_deaf = bool(there)

    def _keep_obstacles(self) -> None:
        """Repeat the list of obstacles, record what hosts keep clear of, and say what operators have to know."""
        for event, text in self._obstacles.news(self._obstacles.receive()):
            self._say(event, text)
        heard = self._obstacles.heard
        if heard is not None and heard is not self._recorded_list:
            self._recorded_list = heard
            self._note("obstacles", **recorded_list(heard))
        self._obstacles.repeat()

    def _record_ticks(self) -> None:
        arrived = self._bus.receive(TICK)
        arrival_us = self._clock.now_us()  # not earlier than that of any of them
        for sender, payload in arrived:
            tick = unpack_tick(payload)
            if tick is not None:
                self._recorders[sender].tick(tick[0], None)
                self._clocks.received(self._numbers[sender], int(tick[0]["t_us"][0]), arrival_us)

    def _record_events(self) -> None:
        for sender, line in self._report.events():
            self._recorders[sender].put_event(line)

    def _waited_for(self) -> list[AgentView]:
        """Return all but those without whom the others go on, and who have not flown after all."""
        return [view for view in self._views if view.agent not in self._without - self._flying]

    def _has_ended(self, view: AgentView, now_s: float) -> bool:
        """Return whether an agent was done, or has left its vehicle down as who runs it says, and is gone.

        That may arrive before the last status, which has the outcome.
        """
        return (_is_done(view) or self._is_down(view)) and now_s - view.received_s > _GONE_S

    def _is_down(self, view: AgentView) -> bool:
        """Return whether the newest process of an agent has ended and left its vehicle down, as who runs it says."""
        return self._ends.is_down(view.agent, None if view.status is None else view.status.boot_id)

    def _lost(self, now_s: float, silent_s: float) -> dict[int, str]:
        """Return who is silent for longer than `silent_s` and has not ended, in words; nobody before one has flown."""
        lost = {}
        for view in self._waited_for() if self._flying else ():
            silence_s = now_s - view.received_s
            if silence_s >= silent_s and not (_is_done(view) or self._has_ended(view, now_s)):
                verb = "was lost in" if view.agent in self._flying else "was last heard in"
                known = "was never heard" if view.status is None else f"{verb} {_last_phase(view)}"
                lost[view.agent] = f"{agent_name(view.agent)} {known}: nothing was heard of it for {silence_s:.0f} s"
        return lost

    def _conclude(self, lost: Mapping[int, str], not_ended: Sequence[AgentView]) -> None:
        """Tell how all have ended; of one that died or was lost that alone: the outcome is not its own."""
        told = {**self._died, **lost}
        self.problems += told.values()
        for view in self._waited_for():
            if view.agent in told or view in not_ended:
                continue
            outcome = view.status.outcome if view.status is not None and _is_done(view) else ""
            self.was_stopped |= outcome == OPERATOR_STOP
            if outcome not in ("completed", OPERATOR_STOP):
                why = outcome or f"it has ended, and its last phase heard is {_last_phase(view)}"
                self.problems.append(f"{agent_name(view.agent)} failed: {why}")
        if without := sorted(self._without - self._flying):
            names = ", ".join(map(agent_name, without))
            self._say("flown_without", f"the others went on without {names}", agents=without)
        if not_ended:
            names = ", ".join(f"{agent_name(view.agent)} ({_last_phase(view)})" for view in not_ended)
            self._say("not_ended", f"had not ended: {names}", agents=[view.agent for view in not_ended])

    def _say(self, event: str, text: str, **fields: Any) -> None:
        self._note(event, text=text, **fields)
        self._display.print_line(text)


def _is_done(view: AgentView) -> bool:
    return view.status is not None and is_done(view.status)


def _last_phase(view: AgentView) -> str:
    return "none" if view.status is None else name_of(Phase, view.status.phase)


def _flies(status: StatusMessage) -> bool:
    """Tell whether an agent is between the beginning and the end of a flight."""
    return status.armed or Phase.STANDBY < status.phase < Phase.DONE
