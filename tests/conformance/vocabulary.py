"""Words a conformance row is written in: what is sent, what must come back, and the state it starts from.

Rows are data: nothing here does anything. `tests.conformance.dialogue` plays them against any autopilot.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from tests.conformance.fields import Between

OFFBOARD_LINK: Final = "offboard"
GCS_LINK: Final = "gcs"
TEXT_LINK: Final = "texts"  # whichever of the two hears a ground station
OWN: Final = -1  # stands for the vehicle's system id wherever a field holds it
NAN: Final = math.nan
HOVER_01: Final = 0.4905  # 1 kg, 4 x 5 N
LEVEL: Final = (1.0, 0.0, 0.0, 0.0)

ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, FAILED = range(5)
NO_ACK: Final = -1
CRITICAL, WARNING, INFO = 2, 4, 6
INT32, REAL32 = 6, 9

SET_MODE, ARM_DISARM, TAKEOFF, LAND, RTL = 176, 400, 22, 21, 20
SET_INTERVAL, REQUEST_MESSAGE, TERMINATE, MISSION_START = 511, 512, 185, 300
FORCE: Final = 21196.0


def custom_mode(main: int, sub: int = 0) -> int:
    """HEARTBEAT.custom_mode of PX4."""
    return main << 16 | sub << 24


M_MANUAL, M_ALTCTL, M_POSCTL, M_ACRO, M_OFFBOARD, M_STAB = (custom_mode(n) for n in (1, 2, 3, 5, 6, 7))
M_TERMINATION = custom_mode(10)
M_TAKEOFF, M_LOITER, M_MISSION, M_RTL, M_LAND = (custom_mode(4, n) for n in (2, 3, 4, 5, 6))


class State(enum.Enum):
    """Where a row starts."""

    BOOTING = "just started, the estimator has not settled"
    ARMABLE = "disarmed in LOITER on the ground, healthy"
    ARMED = "armed in LOITER on the ground"
    GROUND_OFFBOARD = "armed in OFFBOARD on the ground, thrust 0 at 50 Hz"
    LOITER = "flying in LOITER, nobody streams"
    OFFBOARD = "flying in OFFBOARD, level at hover thrust, 50 Hz"


# --- steps: what is sent ---


@dataclass(frozen=True, slots=True)
class Message:
    """A message by name; fields not given are 0, empty, or a level quaternion."""

    name: str
    fields: Mapping[str, Any]


def message(name: str, /, **fields: Any) -> Message:
    return Message(name, fields)


def setpoint(
    thrust_01: float = 0.0,
    q_nb: tuple[float, ...] = LEVEL,
    mask: int = 7,
    rates_rad_s: tuple[float, float, float] = (0.0, 0.0, 0.0),
    target: tuple[int, int] = (OWN, 1),
) -> Message:
    """SET_ATTITUDE_TARGET."""
    roll, pitch, yaw = rates_rad_s
    return message(
        "SET_ATTITUDE_TARGET",
        target_system=target[0],
        target_component=target[1],
        type_mask=mask,
        q=list(q_nb),
        body_roll_rate=roll,
        body_pitch_rate=pitch,
        body_yaw_rate=yaw,
        thrust=thrust_01,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Send:
    """Send a message, and look at what comes from now on."""

    what: Message
    times: int = 1
    every_s: float = 0.02
    link: str = OFFBOARD_LINK


@dataclass(frozen=True, slots=True, kw_only=True)
class Command:
    """Send a command; the answer must be this ack, from that vehicle alone, to us; or NO_ACK."""

    number: int
    params: tuple[float, ...] = ()
    ack: int = ACCEPTED
    target: tuple[int, int] = (OWN, 1)
    as_int: bool = False
    within_s: float = 0.1
    link: str = OFFBOARD_LINK


def go(main: int, sub: int = 0, ack: int = ACCEPTED, flag: int = 1) -> Command:
    """DO_SET_MODE."""
    return Command(number=SET_MODE, params=(flag, main, sub), ack=ack)


def arm(ack: int = ACCEPTED) -> Command:
    return Command(number=ARM_DISARM, params=(1.0,), ack=ack)


def disarm(ack: int = ACCEPTED, magic: float = 0.0) -> Command:
    return Command(number=ARM_DISARM, params=(0.0, magic), ack=ack)


@dataclass(frozen=True, slots=True)
class SetParam:
    """PARAM_SET, bytewise for integers; the same value must come back."""

    name: str
    value: int | float


@dataclass(frozen=True, slots=True)
class Stream:
    """Send a setpoint again and again from now on, and look at what comes from now on."""

    what: Message
    hz: float = 50.0


@dataclass(frozen=True, slots=True)
class Stop:
    """Stop streaming; times are counted from the last setpoint."""


@dataclass(frozen=True, slots=True)
class PauseHeartbeats:
    """Stop or resume our own heartbeats on a link."""

    link: str
    paused: bool = True


@dataclass(frozen=True, slots=True)
class Wait:
    """Let time pass."""

    seconds: float


@dataclass(frozen=True, slots=True)
class Mark:
    """Look only at what comes from now on."""


# --- steps: what must come back, since the last thing sent ---


@dataclass(frozen=True, slots=True, kw_only=True)
class Sees:
    """At least one message with these fields."""

    name: str | int
    fields: Mapping[str, Any]
    within_s: float = 0.5
    link: str = OFFBOARD_LINK
    not_before_s: float = 0.0
    forwarded: bool = False  # from somebody else, by way of the vehicle


def sees(name: str | int, within_s: float = 0.5, *, link: str = OFFBOARD_LINK, after_s: float = 0.0, **f: Any) -> Sees:
    return Sees(name=name, fields=f, within_s=within_s, link=link, not_before_s=after_s)


def forwarded(name: str, within_s: float, link: str, **fields: Any) -> Sees:
    return Sees(name=name, fields=fields, within_s=within_s, link=link, forwarded=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class Never:
    """No message with these fields for that long; from the last thing sent."""

    name: str | int
    fields: Mapping[str, Any]
    for_s: float = 0.3
    link: str = OFFBOARD_LINK


def never(name: str | int, for_s: float = 0.3, *, link: str = OFFBOARD_LINK, **fields: Any) -> Never:
    return Never(name=name, fields=fields, for_s=for_s, link=link)


@dataclass(frozen=True, slots=True, kw_only=True)
class Always:
    """From now on for that long every message of a kind has these fields, and there are that many."""

    name: str
    fields: Mapping[str, Any]
    for_s: float
    at_least: int = 1
    link: str = OFFBOARD_LINK


def always(name: str, for_s: float, at_least: int = 1, *, link: str = OFFBOARD_LINK, **fields: Any) -> Always:
    return Always(name=name, fields=fields, for_s=for_s, at_least=at_least, link=link)


@dataclass(frozen=True, slots=True, kw_only=True)
class Says:
    """A STATUSTEXT, verbatim, or matching a pattern. The tab of texts that are also an event is part of it."""

    text: str
    severity: int
    within_s: float = 0.5
    is_pattern: bool = False


@dataclass(frozen=True, slots=True)
class SaysNothing:
    """No STATUSTEXT for that long, but of the logger, which names its file whenever the disk has it."""

    for_s: float = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class Turns:
    """A field of a fast message takes this value, not before `low_s` and not after `high_s`."""

    value: int
    low_s: float
    high_s: float
    name: str = "CURRENT_MODE"
    field: str = "custom_mode"


@dataclass(frozen=True, slots=True)
class First:
    """The first message of a kind, counted from the vehicle's start, comes in that window; rows from a start only."""

    name: str
    low_s: float
    high_s: float


@dataclass(frozen=True, slots=True)
class At:
    """Wait until that long after the vehicle's start."""

    since_start_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Passes:
    """A field takes these values one after the other, from when it first has the first of them."""

    name: str
    field: str
    values: tuple[int, ...]
    within_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Rate:
    """A message comes that often, from now on."""

    name: str | int
    hz: Between
    for_s: float
    link: str = OFFBOARD_LINK


@dataclass(frozen=True, slots=True)
class Moves:
    """A named measurement of how the vehicle moves (`tests.conformance.motion`), within bounds."""

    measure: str
    wanted: Between
    for_s: float


Step = (
    Send
    | Command
    | SetParam
    | Stream
    | Stop
    | PauseHeartbeats
    | Wait
    | Mark
    | Sees
    | Never
    | Always
    | Says
    | SaysNothing
    | Turns
    | First
    | At
    | Passes
    | Rate
    | Moves
)
EXPECTATIONS = (
    Command,
    SetParam,
    Sees,
    Always,
    Says,
    Turns,
    First,
    Passes,
    Rate,
    Moves,
)  # can't be met by saying nothing


def heartbeat(within_s: float = 1.2, **fields: Any) -> Sees:
    """The state as HEARTBEAT shows it, up to a second late."""
    return Sees(name="HEARTBEAT", fields=fields, within_s=within_s)


def mode(value: int, intended: int | None = None, within_s: float = 0.6) -> Sees:
    """The mode as CURRENT_MODE shows it: twice a second, and at once on a change."""
    return Sees(
        name="CURRENT_MODE", fields={"custom_mode": value, "intended_custom_mode": intended or value}, within_s=within_s
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One row of the sheet.

    Attributes:
        name: unique; what is claimed.
        section: of the sheet.
        start: where the vehicle is put first.
        steps: played in order; the first that is not met ends the row.
        params: set before the start state is entered, restored afterwards.
        spoils: leaves a vehicle that only a reboot makes fit for any other row.
        untouched: needs a vehicle that has had no setpoint, and has not flown, since its start.
        needs_gcs: needs the second link.
        not_by_url: why it can't be played against a vehicle given by URL; empty when it can.
        real_px4: why a real one may answer otherwise, where that is no fault of the row; empty where it must not.
    """

    name: str
    section: str
    start: State
    steps: tuple[Step, ...]
    params: Mapping[str, int | float] = field(default_factory=dict)
    spoils: bool = False
    untouched: bool = False
    needs_gcs: bool = False
    not_by_url: str = ""
    real_px4: str = ""

    @property
    def needs_reboot(self) -> bool:
        """A vehicle given by URL must be restarted before it or after it."""
        return self.spoils or self.untouched or self.start is State.BOOTING
