"""Command port: arming, modes, parameters and message rates, requested now and answered later.

It is the same in real flight and in lockstep, and runs within the tick: it sends nothing while the tick hangs, and the
tick never waits for an answer.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable, Set
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import development as mavlink

from swarmctl.core.mavlink_values import ACTIVE, AUTOPILOT_COMPID, GROUND_STATION, NO_AUTOPILOT
from swarmctl.core.types import Command, Verb
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.dialects.dialect import Dialect

OWN_COMPID = 191  # MAV_COMP_ID_ONBOARD_COMPUTER, beside the vehicle's own system id
_RETRY_US = 500_000
_TRIES = 4
_SURPLUS_US = 1_000_000  # after an answer, within which those to its repetitions arrive
_IN_PROGRESS = 5  # MAV_RESULT
_HEARTBEAT_US = 200_000  # autopilots that count from the newest one fly on for a time that is known so well
HEARD = frozenset(  # ids of the messages that answer a command
    (mavlink.MAVLINK_MSG_ID_COMMAND_ACK, mavlink.MAVLINK_MSG_ID_PARAM_VALUE, mavlink.MAVLINK_MSG_ID_PARAM_ERROR)
)


@dataclass(frozen=True, slots=True)
class CommandResult:
    """The outcome of one command; `text` is the autopilot's answer in words."""

    command: Command
    ok: bool
    text: str

    @property
    def asked(self) -> str:
        """Return what was requested, with the parameter or message that it was about."""
        command = self.command
        kind = mavlink.mavlink_map.get(command.number) if command.verb in (Verb.RATE, Verb.MESSAGE) else None
        return f"{command.verb.value} {command.name if kind is None else kind.msgname}".rstrip()


class CommandPort:
    """Executes commands one after the other, repeats each until acknowledged, and sends the agent's heartbeat.

    The heartbeat is that of a ground station. PX4 counts only those for its data-link failsafe, which lands a vehicle
    whose agent dies before OFFBOARD, and sends its texts only to them. ArduCopter has no other failsafe of its link.

    Args:
        send: sends a frame to the vehicle.
        codec: packs frames under the agent's identity.
        target: system id of the vehicle.
        dialect: returns the autopilot's dialect, or None while unknown; commands wait for it.
    """

    def __init__(
        self,
        send: Callable[[bytes], None],
        codec: Codec,
        target: int,
        dialect: Callable[[], Dialect | None],
    ) -> None:
        self._send, self._codec, self._target = send, codec, target
        self._dialect = dialect
        self._asked: deque[Command] = deque()
        self._steps: deque[Command] = deque()  # steps of the command that is being executed
        self._verb: Verb | None = None  # of that command
        self._is_withdrawn = False  # that command is not repeated
        self._differs = ""  # what the autopilot has told of a parameter that is being set
        self._surplus: dict[int, int] = {}  # by MAV_CMD: answers to repetitions of a step that is finished
        self._passed_over = 0  # answers taken for such while the current step is open
        self._surplus_until_us = 0
        self._now_us = 0
        self._spoken: Dialect | None = None  # dialect of the command that is being executed
        self._tries = 0
        self._next_us = 0
        self._heartbeat_us = 0
        self._results: list[CommandResult] = []

    @property
    def busy(self) -> bool:
        """Whether a command is still unanswered."""
        return bool(self._steps or self._asked)

    def request(self, command: Command) -> None:
        """Queue a command."""
        self._asked.append(command)

    def withdraw(self, verbs: Set[Verb]) -> None:
        """Ask no more for these: nothing of them is sent from now on, though it may be that what was sent is obeyed.

        The answer to that is awaited for as long as a repetition would have been, and the port is busy until then.
        """
        if not verbs or not self.busy:
            return
        self._asked = deque(command for command in self._asked if command.verb not in verbs)
        if self._verb not in verbs or not self._steps:
            return
        if self._is_sent:
            self._steps, self._is_withdrawn = deque((self._steps[0],)), True
        else:
            self._steps.clear()

    def results(self) -> list[CommandResult]:
        """Return the results since the last call."""
        done, self._results = self._results, []
        return done

    def frame(self, message: Any) -> None:
        """Take a message of the vehicle that is one of `HEARD`."""
        if not self._steps or self._spoken is None or not self._is_sent:
            return
        current = self._steps[0]
        kind = message.get_type()
        if kind == "COMMAND_ACK":
            asked = self._spoken.long_command(current)
            if asked is None or asked.command != message.command or not self._is_ours(message):
                return
            if self._is_surplus(message.command):
                return
            if message.result == _IN_PROGRESS:
                self._tries = 0
            else:
                self._note_surplus(message.command)
                self._finish(message.result == 0, _in_words(message.result))
        elif kind == "PARAM_VALUE" and current.name and message.param_id == current.name:
            self._compare(current, self._spoken, message)
        elif kind == "PARAM_ERROR" and current.name and message.param_id == current.name:
            self._finish(False, f"parameter error {message.error}")

    def step(self, now_us: int, *, heartbeat: bool = True) -> None:
        """Send what is due: a heartbeat, and the open command if it was not answered; called once per tick.

        Args:
            now_us: monotonic time.
            heartbeat: whether the vehicle may be told that somebody flies it (`Autopilot.is_attended`).
        """
        if heartbeat and now_us >= self._heartbeat_us:
            self._heartbeat_us = now_us + _HEARTBEAT_US
            beat = mavlink.MAVLink_heartbeat_message(GROUND_STATION, NO_AUTOPILOT, 0, 0, ACTIVE, 3)
            self._send(self._codec.encode(beat))
        self._now_us = now_us
        if not self._steps:
            self._spoken = self._dialect()
            if not self._asked or self._spoken is None:
                return
            command = self._asked.popleft()
            self._verb, self._is_withdrawn = command.verb, False
            self._steps.extend(self._spoken.steps(command))
        if now_us >= self._next_us:
            if self._tries == _TRIES or self._is_withdrawn:
                self._finish(False, self._differs or "no answer")
                return
            self._next_us = now_us + _RETRY_US
            self._tries += 1
            assert self._spoken is not None
            self._send(self._codec.encode(self._message(self._steps[0], self._spoken)))

    @property
    def _is_sent(self) -> bool:
        """Whether the current step has been sent, so that there may be an answer to it."""
        return self._next_us > 0

    def _is_ours(self, message: Any) -> bool:
        """Whether an acknowledgement answers this component, or, as from older autopilots, names nobody."""
        return message.target_system in (0, self._codec.sysid) and message.target_component in (0, self._codec.compid)

    def _compare(self, current: Command, dialect: Dialect, message: Any) -> None:
        told = dialect.from_wire(message.param_value, message.param_type)
        if current.verb is Verb.PARAM_GET:
            self._finish(True, f"{told:g}")
            return
        bits, wanted = (struct.pack("<f", v) for v in (message.param_value, dialect.to_wire(current)[0]))
        if bits == wanted:
            self._finish(True, "set")
        else:  # it may be an answer to somebody else, from before it was set: repetitions tell
            self._differs = f"stays at {told:g}"

    def _note_surplus(self, number: int) -> None:
        """Note that a step was asked for more often than it is now answered: those answers mean no later step."""
        if (left := self._tries - 1 - self._passed_over) > 0:
            self._surplus = {number: left}
            self._surplus_until_us = self._now_us + _SURPLUS_US

    def _is_surplus(self, number: int) -> bool:
        """Return whether an answer is one to a repetition of a step that is finished, and count it."""
        left = self._surplus.get(number, 0) if self._now_us < self._surplus_until_us else 0
        if left:
            self._surplus[number] = left - 1
            self._passed_over += 1
        return left > 0

    def _finish(self, ok: bool, text: str) -> None:
        """Finish the current step; the next one follows at once, unless this one failed."""
        current = self._steps.popleft()
        self._results.append(CommandResult(current, ok, text))
        self._tries, self._next_us, self._passed_over, self._differs = 0, 0, 0, ""
        if not ok:
            why = f"{current.name or current.verb.value}: {text}"
            self._results.extend(CommandResult(step, False, why) for step in self._steps)
            self._steps.clear()

    def _message(self, command: Command, dialect: Dialect) -> Any:
        whom, name = (self._target, AUTOPILOT_COMPID), command.name.encode()
        if command.verb is Verb.PARAM_GET:
            return mavlink.MAVLink_param_request_read_message(*whom, name, -1)
        asked = dialect.long_command(command)
        if asked is None:
            return mavlink.MAVLink_param_set_message(*whom, name, *dialect.to_wire(command))
        padded = (*asked.params, *(0.0,) * (7 - len(asked.params)))
        return mavlink.MAVLink_command_long_message(*whom, asked.command, self._tries - 1, *padded)


def _in_words(result: int) -> str:
    """Return a MAV_RESULT in words; an unknown one as a number."""
    known = mavlink.enums["MAV_RESULT"].get(result)
    return f"result {result}" if known is None else known.name.removeprefix("MAV_RESULT_").lower().replace("_", " ")
