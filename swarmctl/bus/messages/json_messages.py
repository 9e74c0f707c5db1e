"""Messages of the bus that are JSON: an agent's status and end, an operator's order, its answers, the obstacles.

Decoders check bounds and return None for anything that does not fit; they never raise. Text of others is made
printable here, so that no log, table or alert holds a control character of theirs.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any, TypeVar

import msgspec

from swarmctl.core.obstacle import Obstacle
from swarmctl.core.operator_verbs import UNNUMBERED, Answer, Order, order_problem
from swarmctl.core.text import printable
from swarmctl.core.types import FlightMode, Mode, Phase

_Message = TypeVar("_Message")
_Struct = TypeVar("_Struct", bound=msgspec.Struct)

MAX_OBSTACLES = 64  # each visible one takes 20 us of a tick of 20 ms; 6000 took 130 ms
_OBSTACLE_KEYS = {"center_ned_m", "radius_m", "keep_out_m", "visibility_m"}  # no message may leave these out
# largest step of the list's version: late joiners have missed many, and forgers don't reach its end
MAX_VERSION_STEP = 2**20
MAX_ANCESTORS = 64  # lists before this one by which it is known whether its operator knew another list
MAX_REASON = 500  # longest reason of a refusal, or text about what is obeyed
Word = Annotated[str, msgspec.Meta(max_length=32)]
Count = Annotated[int, msgspec.Meta(ge=0, le=2**62)]
Number = Annotated[int, msgspec.Meta(ge=-(2**31), lt=2**31)]  # of a vehicle; longer ones can't be formatted
Agents = Annotated[tuple[Count, ...], msgspec.Meta(max_length=256)]
_Lag = Annotated[int, msgspec.Meta(ge=-(2**62), le=2**62)]
Lags = Annotated[dict[Count, _Lag], msgspec.Meta(max_length=256)]  # by agent


class StatusMessage(msgspec.Struct, frozen=True, kw_only=True):
    """Holds the status an agent publishes five times a second; peers use `phase`, `keeps_up` and `ready_utc_us`."""

    agent: Count
    boot_id: Count
    sysid: Number
    phase: Annotated[int, msgspec.Meta(ge=0, le=int(max(Phase)))]
    mode: Annotated[int, msgspec.Meta(ge=0, le=int(max(Mode)))]
    flight_mode: Annotated[int, msgspec.Meta(ge=0, le=int(max(FlightMode)))]
    armed: bool
    landed: Number
    held: bool  # an operator holds it, and `resume` lets it go on
    control: Word  # what it is doing: `control.phases.control_mode`
    altitude_m: float  # above the shared origin, where there is a state: `ground_speed_m_s` is -1 without one
    ground_speed_m_s: float
    battery_01: float  # -1, here and below: unknown
    pos_accuracy_m: float  # horizontal, 1 sigma, as its estimator reports it
    gps_fix: Number  # GPS_FIX_TYPE
    satellites: Number
    link_age_ms: float  # since the newest message of the vehicle
    keeps_up: bool = True  # with its deadlines, as it has shown in rehearsals on the ground
    ready_utc_us: Count  # time of reaching its start position, 0 before
    mission_t_s: float  # mission time, -1 outside of the mission
    ends_in_s: float  # until the mission, or what precedes or follows it, ends by itself; -1: it does not
    outcome: str  # "" while flying, "completed", or why the mission failed
    position_error_m: float
    separation_m: float  # to the nearest peer now
    tick_p99_ms: float
    ticks: Count
    deadline_misses: Count
    plan_staleness_ms: float
    solver_failed: Count
    active_alert: str  # newest one, "" for none
    alert_age_s: float  # since it began
    uses_commitments: bool  # it flies committed trajectories only, see `control.commit`
    utc_us: Count  # time of sending, by the agent's clock
    without: Agents = ()  # peers that it does not wait for: it has never heard them, and an operator has excluded them
    code: Annotated[str, msgspec.Meta(max_length=128)] = ""  # that it flies, told where agents are on several computers
    # By which the newest status of each of some peers, in turn, came later by the own clock than it was sent by theirs.
    lags_us: Lags = {}


class CommandMessage(msgspec.Struct, frozen=True):
    """Holds an operator's order to one agent or to all (`agent` -1); verbs and arguments are `core.operator_verbs`."""

    verb: Word
    agent: Number
    utc_us: Count  # time of the request, by the clock of the agents asked
    arguments: Annotated[dict[Word, float], msgspec.Meta(max_length=8)] = {}
    number: Count = UNNUMBERED  # repetitions have the same, under newer stamps

    @property
    def order(self) -> Order:
        """The order itself, without addressee and time."""
        return Order(self.verb, self.arguments, self.number)


class AnswerMessage(msgspec.Struct, frozen=True, kw_only=True):
    """Holds an agent's answer to a numbered order; it is repeated for every repetition of the order."""

    agent: Count
    boot_id: Count
    verb: Word
    number: Count
    accepted: bool
    reason: Annotated[str, msgspec.Meta(max_length=MAX_REASON)]  # why it is refused, or what it comes to
    utc_us: Count  # time of sending, by the agent's clock

    @property
    def answer(self) -> Answer:
        """The answer itself, without sender and time."""
        return Answer(self.verb, self.number, self.accepted, self.reason)


class EndedMessage(msgspec.Struct, frozen=True, kw_only=True):
    """Holds that one process of an agent has ended, as the supervisor says that has seen it end.

    It names the process, so it stays true however late it arrives, and says nothing of one that follows.
    """

    agent: Count
    boot_id: Count | None  # None: its supervisor had heard nothing of it
    is_down: bool  # its vehicle is on the ground and disarmed


class MissionMessage(msgspec.Struct, frozen=True, kw_only=True):
    """Holds a mission, which an order names by its number."""

    mission: Count
    text: str  # parameters of the mission as JSON, `control.reference.mission`


class ListedObstacle(msgspec.Struct, frozen=True, kw_only=True):
    """Holds one obstacle of the list under its number, which no other one has before or after it."""

    number: Count
    since_utc_us: Count  # when its centre was at `center_ned_m`, by the launch's clock
    obstacle: Obstacle

    @property
    def without_time(self) -> tuple[int, Obstacle]:
        """Return what an operator has set, without the time, which a keeper corrects with its clock."""
        return (self.number, self.obstacle)

    def at(self, utc_us: int) -> Obstacle:
        """Return the obstacle as it is at a time: moved on, if it moves."""
        return self.obstacle.moved((utc_us - self.since_utc_us) * 1e-6)


class ObstaclesMessage(msgspec.Struct, frozen=True, kw_only=True):
    """Holds the whole list of obstacles. All lists have one order, so that all hosts come to keep the same one.

    Operators who do not hear each other give two lists the same version. Then the draw decides, everywhere alike.
    """

    version: Count
    utc_us: Count  # time of sending, by the launch's clock
    next_number: Count  # of the next obstacle that is added
    obstacles: Annotated[tuple[ListedObstacle, ...], msgspec.Meta(max_length=MAX_OBSTACLES)]
    draw: Count = 0  # random, by who has set the list; 0: it is as configured
    made_from: Annotated[tuple[Count, ...], msgspec.Meta(max_length=MAX_ANCESTORS)] = ()  # draws of lists before it
    proposed: bool = False  # by an operator to those who keep the list; what they repeat is not

    @property
    def rank(self) -> tuple[int, int]:
        """Return the place of the list in the order of all lists."""
        return (self.version, self.draw)

    def replaces(self, known: ObstaclesMessage | None) -> bool:
        """Tell whether the list comes after the known one (None: no list), by at most `MAX_VERSION_STEP`.

        A proposal of the same version does not: its operator hears of the known one, and makes it again from there.
        """
        if known is None:
            return True
        is_later = self.version > known.version if self.proposed else self.rank > known.rank
        return is_later and not self.is_too_far_from(known)

    def is_too_far_from(self, known: ObstaclesMessage) -> bool:
        """Tell whether nobody who knows that list can have come to this one."""
        return self.version - known.version > MAX_VERSION_STEP

    def corrects(self, known: ObstaclesMessage) -> bool:
        """Tell whether it is the same list by a clock that was corrected, so that what moves is elsewhere."""
        if self.rank != known.rank or not any(item.obstacle.moves for item in self.obstacles):
            return False
        own, others = ([item.without_time for item in listed.obstacles] for listed in (self, known))
        return own == others

    def includes(self, known: ObstaclesMessage) -> bool:
        """Tell whether it is that list, or was made from it: otherwise its operator did not know that one."""
        return known.draw in (0, self.draw, *self.made_from)

    def changed(self, obstacles: tuple[ListedObstacle, ...], draw: int) -> ObstaclesMessage:
        """Return the list that an operator proposes in the place of this one."""
        return msgspec.structs.replace(
            self,
            version=self.version + 1,
            next_number=max([self.next_number, *(item.number + 1 for item in obstacles)]),
            obstacles=obstacles,
            draw=draw,
            made_from=(*self.made_from, self.draw)[-MAX_ANCESTORS:],
            proposed=True,
        )

    def shifted(self, by_us: int) -> ObstaclesMessage:
        """Return the same list by a clock that is ahead by so much."""
        moved = (
            msgspec.structs.replace(item, since_utc_us=max(0, item.since_utc_us + by_us)) for item in self.obstacles
        )
        return msgspec.structs.replace(self, obstacles=tuple(moved))


def first_list(obstacles: Iterable[Obstacle], utc_us: int, version: int = 1) -> ObstaclesMessage:
    """Return the list of obstacles that are at their centres now, numbered from 0."""
    listed = tuple(
        ListedObstacle(number=number, since_utc_us=utc_us, obstacle=obstacle)
        for number, obstacle in enumerate(obstacles)
    )
    return ObstaclesMessage(version=version, utc_us=utc_us, next_number=len(listed), obstacles=listed)


def encode_message(message: msgspec.Struct) -> bytes:
    """Encode a message as JSON."""
    return msgspec.json.encode(message, enc_hook=lambda obstacle: obstacle.model_dump())


def decode_status(payload: bytes) -> StatusMessage | None:
    """Decode a status; None if it is malformed or out of bounds."""
    return _printable(_decode(payload, _STATUS_DECODER), "control", "outcome", "active_alert", "code")


def decode_command(payload: bytes) -> CommandMessage | None:
    """Decode an operator's request; None if it is malformed, no known verb, or an argument is out of bounds."""
    message = _decode(payload, _COMMAND_DECODER)
    return None if message is None or order_problem(message.verb, message.arguments) else message


def decode_answer(payload: bytes) -> AnswerMessage | None:
    """Decode an agent's answer; None if it is malformed or out of bounds."""
    return _printable(_decode(payload, _ANSWER_DECODER), "verb", "reason")


def decode_ended(payload: bytes) -> EndedMessage | None:
    """Decode the end of an agent's process; None if it is malformed or out of bounds."""
    return _decode(payload, _ENDED_DECODER)


def decode_mission(payload: bytes) -> MissionMessage | None:
    """Decode a mission, whose text is not looked at; None if it is malformed."""
    return _decode(payload, _MISSION_DECODER)


def decode_obstacles(payload: bytes) -> ObstaclesMessage | None:
    """Decode a list of obstacles; None if it is malformed or out of bounds, or two have one number."""
    message = _decode(payload, _OBSTACLES_DECODER)
    numbers = [] if message is None else [item.number for item in message.obstacles]
    if message is None or len(set(numbers)) < len(numbers) or max(numbers, default=-1) >= message.next_number:
        return None
    return message


def _obstacle(kind: type, item: Any) -> Obstacle:
    """Return the obstacle that a message describes.

    Raises:
        ValueError: a key is missing or unknown, or a value out of bounds.
    """
    obstacle = Obstacle.model_validate(item)
    if missing := _OBSTACLE_KEYS - obstacle.model_fields_set:
        raise ValueError(f"missing: {missing}")
    return obstacle


_STATUS_DECODER = msgspec.json.Decoder(StatusMessage)
_COMMAND_DECODER = msgspec.json.Decoder(CommandMessage)
_ANSWER_DECODER = msgspec.json.Decoder(AnswerMessage)
_ENDED_DECODER = msgspec.json.Decoder(EndedMessage)
_MISSION_DECODER = msgspec.json.Decoder(MissionMessage)
_OBSTACLES_DECODER = msgspec.json.Decoder(ObstaclesMessage, dec_hook=_obstacle)


def _printable(message: _Struct | None, *texts: str) -> _Struct | None:
    """Return a message with its texts made printable."""
    said = {name: getattr(message, name) for name in texts if message is not None}
    if message is None or all(text.isprintable() for text in said.values()):
        return message
    return msgspec.structs.replace(message, **{name: printable(text) for name, text in said.items()})


def _decode(payload: bytes, decoder: msgspec.json.Decoder[_Message]) -> _Message | None:
    try:
        return decoder.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None
