"""Recovery of a vehicle whose agent ended before the vehicle was known to be on the ground and disarmed.

A second agent is started on the same link. It only lands the vehicle and waits for the HEARTBEAT that reports it as
disarmed; the autopilot's own failsafes act meanwhile. A vehicle that can't be recovered is named, so that no launch
ends with an armed vehicle unreported. So is one that an agent which was done has left in the air, to its autopilot or
to a pilot: from those it is not taken.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

from swarmctl.bus.bus import agent_name
from swarmctl.bus.messages.json_messages import StatusMessage
from swarmctl.core.json_safe import to_json
from swarmctl.core.types import FlightMode, Landed, Phase
from swarmctl.errors import EXIT_INTERRUPTED, EXIT_OK, EXIT_START, StartError
from swarmctl.ops.processes import Child
from swarmctl.ops.supervision.status_table import AgentView, name_of
from swarmctl.telemetry.recording.changed_parameters import read_originals

RECOVERY_S = 90.0  # a failsafe that returns home first needs most of it
_SET_BACK = (
    "Set them back with a ground station before another launch, which takes what it finds for what was; no verb does: "
    "swarmctl check --apply sets what flights need"
)
_DOWN = (EXIT_OK, EXIT_INTERRUPTED)  # an agent ends with these only when it is done


class Recovery:
    """Keeps track of every vehicle of a launch that may be left armed.

    Args:
        start: starts an agent on a vehicle's link that only lands it.
        sysids: system id of each vehicle, by agent.
    """

    def __init__(self, start: Callable[[int], Child], sysids: Sequence[int]) -> None:
        self._start, self._sysids = start, sysids
        self._begun_s: dict[int, float] = {}
        self._before: dict[int, tuple[StatusMessage, float]] = {}  # what was heard last of an ended agent, and when
        self._lost: set[int] = set()  # agents whose vehicles are not known to be down, and are not watched any more
        self._killed: set[int] = set()  # agents that were killed, wherever their vehicles were

    def is_on(self, agent: int) -> bool:
        """Return whether the newest agent of this vehicle only lands it."""
        return agent in self._begun_s

    def is_overdue(self, agent: int) -> bool:
        """Return whether the recovery of a vehicle takes longer than allowed."""
        return agent in self._begun_s and time.monotonic() - self._begun_s[agent] > RECOVERY_S

    def leaves_down(self, view: AgentView, code: int) -> bool:
        """Return whether an agent that ends with this code is known to leave its vehicle on the ground and disarmed.

        One that is done may have left it in the air, so what it has told of the vehicle decides.
        """
        if view.status is not None and is_done(view.status):
            return _stands(view.status)
        return code in _DOWN or (code == EXIT_START and not self.is_on(view.agent))

    def begin(self, view: AgentView, code: int) -> Child | None:
        """Register an ended agent; return the process that recovers its vehicle, or None.

        Who is done with a vehicle in the air has left it to somebody, and may have been asked to: it is not recovered.

        Raises:
            StartError, OSError: it can't be started; the vehicle counts as lost.
        """
        if self.leaves_down(view, code) or handed_over(view):
            return None
        if self.is_on(view.agent) or view.status is None:
            self._lost |= {view.agent} if view.status is not None else set()
            return None
        self._begun_s[view.agent] = time.monotonic()
        self._before[view.agent] = view.status, view.received_s
        try:
            return self._start(view.agent)
        except (StartError, OSError):
            self._lost.add(view.agent)
            raise

    def left(self, views: Sequence[AgentView]) -> list[str]:
        """Return one line for each vehicle that may still be armed or in the air."""
        return [self._words(view) for view in views if view.agent in self._lost]

    def give_up(self, views: Sequence[AgentView]) -> None:
        """Count every vehicle whose agent is killed before it was down as lost; so who was to be landed and was not."""
        for view in views:
            self._killed.add(view.agent)
            status, _, _ = self._last_known(view)
            if status is not None and status.phase >= Phase.ARM and not (is_done(status) and _stands(status)):
                self._lost.add(view.agent)

    def kept_parameters(self, views: Sequence[AgentView], directory: Path) -> list[str]:
        """Return one line for each vehicle that is left, or whose agent was killed, with what its parameters were.

        Agents set back what they have changed once a vehicle is down.

        Args:
            views: of all agents.
            directory: the run folder, in which agents note what parameters were before they change them.
        """
        found = []
        for view in views:
            if view.agent not in self._lost | self._killed:
                continue
            keeps = (
                f"vehicle {self._sysids[view.agent]} ({agent_name(view.agent)}) may keep the parameters of this flight"
            )
            try:
                were = read_originals(directory, agent_name(view.agent))
            except (OSError, ValueError) as error:
                if view.status is not None:  # else it may have changed none
                    found.append(f"{keeps}, and what they were can't be read: {error}")
                continue
            if were:
                found.append(f"{keeps}, which were {to_json(were)}. {_SET_BACK}")
        return found

    def _last_known(self, view: AgentView) -> tuple[StatusMessage | None, float, bool]:
        """Return the newest status of who has heard the vehicle, its time, and whether it is of the ended agent."""
        status, before = view.status, self._before.get(view.agent)
        if before is None or status is None:
            return status, view.received_s, False
        has_heard_it = status.boot_id != before[0].boot_id and status.phase != Phase.CONNECT
        return (status, view.received_s, False) if has_heard_it else (*before, True)

    def _words(self, view: AgentView) -> str:
        status, received_s, is_unheard = self._last_known(view)
        assert status is not None  # of who was never heard nothing is claimed
        armed = "armed" if status.armed else "not yet told to be armed"
        since = "; what was to land it has not heard it" if is_unheard else ""
        return (
            f"vehicle {self._sysids[view.agent]} (agent-{view.agent}) may be armed or in the air: it was {armed}, in "
            f"{name_of(Phase, status.phase)}, {time.monotonic() - received_s:.0f} s ago{since}. "
            "Land and disarm it by hand"
        )


def is_done(status: StatusMessage) -> bool:
    """Return whether an agent does nothing more for its vehicle, wherever that is."""
    return status.phase == Phase.DONE


def _stands(status: StatusMessage) -> bool:
    """Return whether a vehicle has told that it is on the ground and disarmed."""
    return not status.armed and status.landed == Landed.ON_GROUND


def handed_over(view: AgentView) -> str:
    """Return in words that an ended agent was done with a vehicle that is not known to be down; else ""."""
    if view.status is None or not is_done(view.status) or _stands(view.status):
        return ""
    return hand_over_in_words(view.status)


def hand_over_in_words(status: StatusMessage) -> str:
    """Return where an agent that was done and has ended has left a vehicle that is not known to be down."""
    armed = "armed" if status.armed else "disarmed"
    place = "on the ground" if status.landed == Landed.ON_GROUND else "not known to be on the ground"
    return (
        f"vehicle {status.sysid} (agent-{status.agent}) was left to its autopilot, or to who flies it: {armed}, "
        f"{place}, in {name_of(FlightMode, status.flight_mode)}. No agent lands it"
    )
