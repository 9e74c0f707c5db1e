"""The operator's verbs that agents obey, in one table.

A row becomes a verb of the command line with its options (`swarmctl.ops.cli`), an order that may be on the bus with its
arguments in bounds (`swarmctl.bus.messages.json_messages`), and what `control.phases.obeyed_orders` does; but `exclude`
is obeyed by the world model, because it is about a peer.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

UNNUMBERED = 0  # number of an order that wants no answer


@dataclass(frozen=True, slots=True, kw_only=True)
class VerbArgument:
    """Describes one number that an order carries, from `least` to `most`."""

    name: str  # in messages, with the unit: height_m
    option: str  # on the command line: --height
    help: str
    least: float
    most: float
    required: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class OperatorVerb:
    """Describes one verb; outside of `phases` an agent refuses it, and may for a reason of its own within them."""

    help: str
    phases: frozenset[str]  # names of `Phase`, because the command line must not wait for numpy
    arguments: tuple[VerbArgument, ...] = ()
    is_stop: bool = False  # kept until a vehicle state is known to begin it from
    never_superseded: bool = False  # obeyed though a newer order came before it


@dataclass(frozen=True, slots=True)
class Order:
    """Holds one order: a verb of `OPERATOR_VERBS` and its arguments by name."""

    verb: str
    arguments: Mapping[str, float] = field(default_factory=dict)
    number: int = UNNUMBERED  # the same in every repetition; answers name it


@dataclass(frozen=True, slots=True)
class Answer:
    """Holds what an agent answers to a numbered order."""

    verb: str
    number: int
    accepted: bool
    reason: str = ""  # why it is refused, or what an accepted order comes to where its name does not say it


EXCLUDE, PEER = "exclude", "peer"
GOTO = "goto"
POINT = ("north_m", "east_m", "down_m")  # arguments of `goto`, shared NED
YAW, SPEED, FAR = "yaw_deg", "speed_m_s", "far"  # and its optional ones
FAR_M = 500.0  # from the vehicle; a point farther away is flown to only if that is said
MISSION, BEGIN = "mission", "begin_utc_s"  # the verb, its argument of the same name: number of the mission; its begin
CLOCK = "clock_of"  # number of the agent by whose clock the begin is; left out: by that of each agent asked
_FAR_M = 100_000.0  # from the shared origin
_AIRBORNE = frozenset({"TAKEOFF", "GOTO_START", "READY", "TRACK", "GOTO_LAND"})  # the agent decides where it flies
_NOT_LANDING = _AIRBORNE | {"CONNECT", "STANDBY", "ARM", "DONE"}

OPERATOR_VERBS = {
    "hold": OperatorVerb(
        help="Brake and hold position, also on the way up and to the landing place.", phases=_AIRBORNE
    ),
    "resume": OperatorVerb(
        help="Go on after `hold`, and take the vehicle back after a pilot or its autopilot took over.",
        phases=_AIRBORNE | {"ARM", "LAND"},  # also of a vehicle found in the air under a pilot, or taken as it landed
    ),
    "land": OperatorVerb(  # never superseded: a stamp a little in the future must not delay a landing
        help="Separate, then land.", phases=_NOT_LANDING | {"LAND"}, is_stop=True, never_superseded=True
    ),
    "rtl": OperatorVerb(
        help="Fly back to the start under the agent's own MPC, then land. The autopilot's return mode is not used.",
        phases=_NOT_LANDING,
        is_stop=True,
    ),
    GOTO: OperatorVerb(
        help="Fly to a point under the agent's own planner, and hold there until `resume`.",
        phases=frozenset({"GOTO_START", "READY", "TRACK"}),  # what is on its way to land stays so
        arguments=(
            *(
                VerbArgument(name=name, option=f"--{name[:-2]}", help="[m]", least=-_FAR_M, most=_FAR_M)
                for name in POINT
            ),
            VerbArgument(
                name=YAW,
                option="--yaw",
                help="Heading there, clockwise from north [deg]; default: that of the mission.",
                least=-360.0,
                most=360.0,
                required=False,
            ),
            VerbArgument(
                name=SPEED,
                option="--speed",
                help="Peak speed [m/s]; default: agent.state_machine.speed_m_s.",
                least=0.1,
                most=20.0,
                required=False,
            ),
            VerbArgument(
                name=FAR,
                option="--far",
                help=f"Fly there though it is more than {FAR_M:g} m away.",
                least=0.0,
                most=1.0,
                required=False,
            ),
        ),
    ),
    MISSION: OperatorVerb(
        help="Fly another mission.",
        phases=frozenset({"STANDBY", "ARM", "TAKEOFF", "GOTO_START", "READY", "TRACK"}),  # likewise
        arguments=(
            VerbArgument(name=MISSION, option="--mission", help="Number.", least=0, most=2.0**53),
            VerbArgument(name=BEGIN, option="--begin", help="Begin, UTC [s].", least=0, most=2.0**33),
            VerbArgument(
                name=CLOCK,
                option="--clock-of",
                help="Agent by whose clock that is.",
                least=0,
                most=254,
                required=False,
            ),
        ),
    ),
    EXCLUDE: OperatorVerb(
        help="Vouch that an agent has ended: the others no longer wait for its answers, and keep clear of its place.",
        phases=_NOT_LANDING | {"LAND"},
        arguments=(
            VerbArgument(name=PEER, option="--peer", help="Number of the agent that has ended.", least=0, most=254),
        ),
        never_superseded=True,
    ),
}


def order_problem(verb: str, arguments: Mapping[str, float]) -> str:
    """Return why this is no order, or ""."""
    known = OPERATOR_VERBS.get(verb)
    if known is None:
        return f"{verb!r} is no verb; known are {', '.join(OPERATOR_VERBS)}"
    required = {argument.name for argument in known.arguments if argument.required}
    if not required <= arguments.keys() <= {argument.name for argument in known.arguments}:
        return f"{verb} takes {', '.join(argument.name for argument in known.arguments) or 'no arguments'}"
    for argument in known.arguments:
        value = arguments.get(argument.name, argument.least)
        if not (math.isfinite(value) and argument.least <= value <= argument.most):
            return f"{argument.name} {value:g}: allowed: {argument.least:g} to {argument.most:g}"
    return ""
