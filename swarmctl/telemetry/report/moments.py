"""What operators had a swarm do, and when: numbered moments on the time axis of a run."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from swarmctl.bus.bus import agent_name
from swarmctl.core.json_safe import finite
from swarmctl.core.operator_verbs import EXCLUDE, GOTO, MISSION, POINT
from swarmctl.core.text import point_text
from swarmctl.core.types import Array
from swarmctl.telemetry.evaluation.tracks import missions

_TOGETHER_S = 1.0  # what several agents do within this time is one moment
_ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth")


class Moment(NamedTuple):
    """An order that agents have accepted, or the beginning of another mission."""

    at_s: float
    words: str
    agents: tuple[int, ...]


def moments(
    events: Iterable[Mapping[str, Any]],
    ticks: Mapping[int, NDArray[np.void]],
    time_of: Callable[[Mapping[str, Any]], float | None],
    seconds: Callable[[NDArray[np.void]], Array],
) -> list[Moment]:
    """Return the moments of a run in order of time; of orders those that agents have accepted.

    Args:
        events: of the run.
        ticks: of each agent.
        time_of: returns the mission time [s] of an event; None: it does not say.
        seconds: returns the mission times (T,) [s] of ticks.
    """
    sources = {agent_name(agent): agent for agent in ticks}
    found: list[tuple[float, str, int]] = []
    for event in events:
        agent, at_s = sources.get(str(event.get("source"))), time_of(event)
        if event.get("event") == "operator" and agent is not None and at_s is not None:
            found += [(at_s, words, agent) for words in [_words(event)] if words]
    for agent, rows in ticks.items():
        for number, mission in enumerate(missions(rows)[1:], 2):
            begin_s = float(seconds(mission[:1])[0]) - float(mission["mission_t_s"][0])  # its clock runs before
            found.append((begin_s, f"{ordinal(number)} mission begins", agent))
    return _together(sorted(found))


def ordinal(number: int) -> str:
    """Return "second" for 2."""
    return _ORDINALS[number - 1] if 0 < number <= len(_ORDINALS) else f"{number}th"


def who(agents: Sequence[int], everybody: int) -> str:
    """Return " (agents 0, 2)", or "" if it is everybody."""
    return "" if len(agents) == everybody else f" (agent{'s'[: len(agents) - 1]} {', '.join(map(str, agents))})"


def _words(event: Mapping[str, Any]) -> str:
    """Return an order in words; "" for what changes no flight."""
    verb = str(event.get("verb"))
    if verb == GOTO:
        at_m = [finite(event.get(axis)) for axis in POINT]
        return f"goto {point_text(math.nan if place_m is None else place_m for place_m in at_m)}"
    return {EXCLUDE: "", MISSION: "mission set"}.get(verb, verb)


def _together(found: Iterable[tuple[float, str, int]]) -> list[Moment]:
    """Return one moment of those in which several agents did the same, at the time of the first."""
    result: list[Moment] = []
    for at_s, words, agent in found:
        same = (k for k, other in enumerate(result) if other.words == words and at_s - other.at_s < _TOGETHER_S)
        known = next(same, None)
        if known is None:
            result.append(Moment(at_s, words, (agent,)))
        else:
            agents = tuple(sorted({*result[known].agents, agent}))
            result[known] = result[known]._replace(agents=agents)
    return result
