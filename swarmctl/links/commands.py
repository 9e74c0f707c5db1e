"""The slow path: arming, modes, parameters and rates, as commands that are requested and answered later.

One table of MAVLink commands serves both executors: `CodecCommands` here (lockstep; also plain links without MAVSDK)
and `MavsdkCommands`, which runs MAVSDK over the same socket. The tick never waits for either.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from pymavlink.dialects.v20 import development as dialect

from swarmctl.core.types import Command, Verb
from swarmctl.links.mavlink import Codec

OWN_COMPID = 191  # MAV_COMP_ID_ONBOARD_COMPUTER, beside the vehicle's own system id
_RETRY_US = 500_000
_TRIES = 4
_IN_PROGRESS = 5  # MAV_RESULT
_HEARTBEAT_US = 1_000_000


@dataclass(frozen=True, slots=True)
class CommandResult:
    """One answer; `text` says what the autopilot said."""

    command: Command
    ok: bool
    text: str


class CommandPort(Protocol):
    """Executes commands one after the other, in the background of the tick."""

    @property
    def busy(self) -> bool:
        """Whether something is asked and not answered yet."""

    def request(self, command: Command) -> None:
        """Queue a command."""

    def results(self) -> list[CommandResult]:
        """Answers since the last call."""

    def frame(self, frame: bytes, message: Any) -> None:
        """Everything the vehicle says, except the fast state messages."""

    def step(self, now_us: int) -> None:
        """Called once a tick."""

    def close(self) -> None:
        """Release everything."""


@dataclass(frozen=True, slots=True)
class LongCommand:
    """A COMMAND_LONG: id and its seven parameters."""

    command: int
    params: tuple[float, ...]


def long_command(command: Command, external: tuple[float, float], hold: tuple[float, float]) -> LongCommand | None:
    """COMMAND_LONG of a command, or None when it is a parameter.

    Args:
        command: what is asked.
        external: (main, sub) custom mode that follows external setpoints in this dialect.
        hold: (main, sub) custom mode that holds position.
    """
    nan = math.nan
    table: dict[Verb, LongCommand] = {
        Verb.ARM: LongCommand(400, (1.0,)),
        Verb.DISARM: LongCommand(400, (0.0,)),
        Verb.TAKEOFF: LongCommand(22, (nan, nan, nan, nan, nan, nan, nan)),
        Verb.EXTERNAL: LongCommand(176, (1.0, *external)),
        Verb.HOLD: LongCommand(176, (1.0, *hold)),
        Verb.LAND: LongCommand(21, (nan, nan, nan, nan, nan, nan, nan)),
        Verb.RATE: LongCommand(511, (float(command.number), 1e6 / command.value if command.value > 0 else -1.0)),
        Verb.MESSAGE: LongCommand(512, (float(command.number),)),
    }
    return table.get(command.verb)


class CodecCommands:
    """Commands through the codec, re-sent until acknowledged; also sends the companion's heartbeat.

    Args:
        send: hands a frame to the vehicle.
        codec: own identity.
        target: the vehicle's system id.
        external, hold: see `long_command`.
    """

    def __init__(
        self,
        send: Callable[[bytes], None],
        codec: Codec,
        target: int,
        external: tuple[float, float],
        hold: tuple[float, float],
    ) -> None:
        self._send, self._codec, self._target = send, codec, target
        self._external, self._hold = external, hold
        self._queue: deque[Command] = deque()
        self._current: Command | None = None
        self._tries = 0
        self._next_us = 0
        self._heartbeat_us = 0
        self._results: list[CommandResult] = []

    @property
    def busy(self) -> bool:
        return self._current is not None or bool(self._queue)

    def request(self, command: Command) -> None:
        if command.verb is Verb.TAKEOFF:
            self._queue.append(Command(Verb.PARAM_FLOAT, value=command.value, name="MIS_TAKEOFF_ALT"))
        self._queue.append(command)

    def results(self) -> list[CommandResult]:
        done, self._results = self._results, []
        return done

    def frame(self, frame: bytes, message: Any) -> None:
        current = self._current
        if current is None:
            return
        kind = message.get_type()
        if kind == "COMMAND_ACK":
            asked = long_command(current, self._external, self._hold)
            if asked is None or asked.command != message.command:
                return
            if message.result == _IN_PROGRESS:
                self._tries = 0
            else:
                self._finish(message.result == 0, f"result {message.result}")
        elif kind == "PARAM_VALUE" and current.name and message.param_id == current.name:
            told, wanted = (struct.pack("<f", v) for v in (message.param_value, self._wire_value(current)))
            self._finish(told == wanted, "set" if told == wanted else f"stays at {message.param_value}")
        elif kind == "PARAM_ERROR" and current.name and message.param_id == current.name:
            self._finish(False, f"parameter error {message.error}")

    def step(self, now_us: int) -> None:
        if now_us >= self._heartbeat_us:
            self._heartbeat_us = now_us + _HEARTBEAT_US
            beat = dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)  # onboard controller, active
            self._send(self._codec.encode(beat))
        if self._current is None:
            if not self._queue:
                return
            self._current, self._tries, self._next_us = self._queue.popleft(), 0, now_us
        if now_us >= self._next_us:
            if self._tries == _TRIES:
                self._finish(False, "no answer")
                return
            self._next_us = now_us + _RETRY_US
            self._tries += 1
            self._send(self._codec.encode(self._message(self._current)))

    def close(self) -> None:
        self._queue.clear()

    def _finish(self, ok: bool, text: str) -> None:
        assert self._current is not None
        self._results.append(CommandResult(self._current, ok, text))
        self._current = None

    def _message(self, command: Command) -> Any:
        asked = long_command(command, self._external, self._hold)
        if asked is None:
            kind = 6 if command.verb is Verb.PARAM_INT else 9
            name = command.name.encode()
            return dialect.MAVLink_param_set_message(self._target, 1, name, self._wire_value(command), kind)
        padded = (*asked.params, *(0.0,) * (7 - len(asked.params)))
        return dialect.MAVLink_command_long_message(self._target, 1, asked.command, self._tries - 1, *padded)

    @staticmethod
    def _wire_value(command: Command) -> float:
        """PX4 carries integers bytewise in the float."""
        if command.verb is Verb.PARAM_INT:
            return float(struct.unpack("<f", struct.pack("<i", command.number))[0])
        return float(struct.unpack("<f", struct.pack("<f", command.value))[0])
