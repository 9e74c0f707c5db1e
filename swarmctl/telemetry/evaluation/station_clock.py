"""Brings the ticks that a station has recorded to one clock, its own. Pure.

Each computer stamps ticks by its own clocks. A tick of time t that arrived at time r by the station's clock was under
way for r - t, less the difference of the two clocks. The least r - t that was seen of a sender is taken for that
difference; its error is the shortest transport, a few milliseconds on a local network. Monotonic clocks are compared,
as they do not step; that they drift apart, by up to a tenth of a second in an hour, is not looked at.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from swarmctl.bus.bus import agent_name
from swarmctl.core.json_safe import finite
from swarmctl.core.types import Phase

SENDER_CLOCK = "sender_clock"  # event: the monotonic clock of `agent` is `behind_us` behind the station's, at most
_WORTH_TELLING_S = 0.05  # smaller differences are corrected without a word
_AGAIN_US = 1_000_000  # monotonic time that falls by more begins again: the computer was started again
_LARGEST_US = 1 << 61  # of a shift: its sum with a time is an int64
_SHOWN = 3  # agents whose clocks are told


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockedTicks:
    """The ticks of a run, their `utc_us` by one clock as far as that is known.

    Attributes:
        ticks: by agent, of `TICK_DTYPE`.
        ahead_s: how far the UTC of each agent was ahead of the station's, None where that is not known; None as a whole
            where one computer has recorded its own agents, whose stamps are left as they are.
    """

    ticks: dict[int, NDArray[np.void]]
    ahead_s: dict[int, float | None] | None

    def events(self, recorded: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """Return events in order of time, those of agents with `utc_us` by the station's clock where it is known."""
        ahead_us = {
            agent_name(agent): round(ahead_s * 1e6)
            for agent, ahead_s in (self.ahead_s or {}).items()
            if ahead_s is not None
        }
        if not any(ahead_us.values()):
            return [dict(event) for event in recorded]
        events = []
        for event in recorded:
            shift_us, utc_us = ahead_us.get(str(event.get("source"))), event.get("utc_us")
            if shift_us is not None and isinstance(utc_us, int):
                events.append({**event, "utc_us": utc_us - shift_us})
            else:
                events.append(dict(event))
        return sorted(events, key=lambda event: finite(event.get("utc_us")) or 0.0)

    @property
    def known(self) -> dict[int, NDArray[np.void]]:
        """Return the ticks whose times can be compared with those of other agents."""
        unknown = [agent for agent, ahead_s in (self.ahead_s or {}).items() if ahead_s is None]
        return {agent: rows for agent, rows in self.ticks.items() if agent not in unknown}

    def problems(self) -> Iterator[str]:
        """Yield a violation for each agent whose clock is not known."""
        for agent, ahead_s in (self.ahead_s or {}).items():
            if ahead_s is None:
                yield (
                    f"agent {agent}: its clock is not known, as no arrivals of its ticks were recorded or its computer "
                    "was started again: its separation can't be judged"
                )

    def summary(self) -> list[dict[str, Any]] | None:
        """Return the clocks as `summary.json` has them."""
        if self.ahead_s is None:
            return None
        return [{"id": agent, "ahead_s": ahead_s} for agent, ahead_s in sorted(self.ahead_s.items())]


def seen_late(clocked: ClockedTicks, at_s: Callable[[float], float]) -> list[dict[str, Any]] | None:
    """Return the agents whose flight a station has not seen from its beginning on; None where there is no station.

    Args:
        clocked: ticks of a run.
        at_s: returns the mission time of an instant of their UTC.
    """
    if clocked.ahead_s is None:
        return None
    firsts = [(agent, rows[0]) for agent, rows in sorted(clocked.ticks.items()) if len(rows)]
    known = clocked.known
    return [
        {
            "id": agent,
            "phase": Phase(int(first["phase"])).name,
            "from_s": at_s(float(first["utc_us"])) if agent in known else None,
        }
        for agent, first in firsts
        if Phase.STANDBY < first["phase"] < Phase.DONE
    ]


def is_of_station(events: Sequence[Mapping[str, Any]]) -> bool:
    """Return whether a station has recorded a run, by its events."""
    return started(events).get("agents") == []


def by_newest_clock(rows: NDArray[np.void], most_us: int) -> tuple[NDArray[np.void], bool]:
    """Return the ticks (T,) of an agent since its computer was started last, and whether that leaves out others.

    Args:
        rows: as a station has recorded them.
        most_us: what the clocks of a run may span. Where UTC spans more, it has been set: it is taken to have been
            before, too, what it was at the end.
    """
    if not len(rows):
        return rows, False
    t_us, is_cut = rows["t_us"].astype(np.float64), False
    if np.ptp(t_us) > most_us:
        steps_us = np.diff(t_us)
        (ends,) = np.nonzero((steps_us < -_AGAIN_US) | (steps_us > most_us))
        rows, is_cut = rows[ends[-1] + 1 :] if len(ends) else rows, len(ends) > 0
    if np.ptp(rows["utc_us"].astype(np.float64)) > most_us:
        rows = rows.copy()
        rows["utc_us"] = rows["t_us"] + (rows["utc_us"][-1:] - rows["t_us"][-1:])
    return rows, is_cut


def by_station_clock(
    ticks: Mapping[int, NDArray[np.void]], events: Sequence[Mapping[str, Any]], cut: Collection[int] = ()
) -> ClockedTicks:
    """Return the ticks of a run with UTC by the station's clock; as they are where no station has recorded them.

    Args:
        ticks: by agent.
        events: of the run.
        cut: agents whose clocks are not known, as only ticks of the newest of several are there.
    """
    if not is_of_station(events):
        return ClockedTicks(ticks=dict(ticks), ahead_s=None)
    began = started(events)
    own_utc_us, own_t_us = began.get("utc_us"), began.get("t_us")
    shifts_us = dict[int, int]()
    if isinstance(own_utc_us, int) and isinstance(own_t_us, int):
        shifts_us = {agent: behind_us + own_utc_us - own_t_us for agent, behind_us in _least_us(events).items()}
    clocked, ahead_s = dict(ticks), dict[int, float | None]()
    for agent, rows in ticks.items():
        shift_us = shifts_us.get(agent)
        if not len(rows):
            continue
        if (
            agent in cut
            or shift_us is None
            or abs(shift_us) > _LARGEST_US
            or (np.diff(rows["t_us"]) < -_AGAIN_US).any()
        ):
            ahead_s[agent] = None
            continue
        clocked[agent] = rows.copy()
        clocked[agent]["utc_us"] = rows["t_us"] + shift_us
        utc_us: NDArray[np.int64] = rows["utc_us"]
        station_utc_us: NDArray[np.int64] = clocked[agent]["utc_us"]
        ahead_s[agent] = float(np.median(utc_us - station_utc_us)) / 1e6
    return ClockedTicks(ticks=clocked, ahead_s=ahead_s)


def corrected_text(clocks: Sequence[Mapping[str, Any]] | None) -> str:
    """Return which clocks of a summary were corrected by more than is common, in words; "" if none was."""
    found = [(clock["id"], ahead_s) for clock in clocks or () if (ahead_s := finite(clock["ahead_s"])) is not None]
    far = [(agent, ahead_s) for agent, ahead_s in found if abs(ahead_s) > _WORTH_TELLING_S]
    said = [f"agent {agent} {abs(by_s):.2f} s {'ahead' if by_s > 0.0 else 'behind'}" for agent, by_s in far[:_SHOWN]]
    return ", ".join([*said, *([f"{len(far) - _SHOWN} more"] if len(far) > _SHOWN else [])])


def started(events: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    """Return the event with which a recording begins; an empty one where it is missing."""
    return next((event for event in events if event.get("event") == "started"), {})


def _least_us(events: Sequence[Mapping[str, Any]]) -> dict[int, int]:
    """Return by how much the monotonic clock of each agent is behind at most, by all arrivals."""
    least_us = dict[int, int]()
    for event in events:
        agent, behind_us = event.get("agent"), event.get("behind_us")
        if event.get("event") == SENDER_CLOCK and isinstance(agent, int) and isinstance(behind_us, int):
            least_us[agent] = min(behind_us, least_us.get(agent, behind_us))
    return least_us
