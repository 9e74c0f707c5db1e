"""Command port on a real link: MAVSDK over `raw://`, fed from the agent's own socket.

MAVSDK does retries and acknowledgements; the dialect defines the content of a command. Heartbeats are sent by the tick:
a separate thread would hide a hanging tick from the autopilot. Parameters use our own codec, because MAVSDK reports
only that a value was not refused, not what is stored.

Its Offboard plugin is never created: it repeats the last setpoint from a C++ thread without end, which defeats the
autopilot's offboard-loss failsafe. Blocking calls run in one worker thread; the tick only exchanges queue entries.
"""

from __future__ import annotations

import json
import math
import queue
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

from mavsdk import Configuration, Mavsdk
from mavsdk.plugins.mavlink_direct import MavlinkDirect
from mavsdk.plugins.mavlink_direct.mavlink_direct import MavlinkMessage

from swarmctl.core.types import Command, Verb
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.commands import OWN_COMPID, CodecCommands, CommandResult
from swarmctl.mavlink.dialects.dialect import Dialect, LongCommand

_PARAMETERS = (Verb.PARAM_INT, Verb.PARAM_FLOAT, Verb.PARAM_GET)
_DISCOVERY_S = 5.0
_JOIN_S = 5.0


class MavsdkCommands:
    """Implements `CommandPort` on MAVSDK.

    Args:
        send: sends a frame to the vehicle; called from MAVSDK's thread.
        target: system id of the vehicle, also ours (PX4 convention for companions).
        dialect: returns the autopilot's dialect, or None while unknown; commands wait for it.
    """

    def __init__(self, send: Callable[[bytes], None], target: int, dialect: Callable[[], Dialect | None]) -> None:
        self._target, self._dialect = target, dialect
        self._sdk = Mavsdk(Configuration.create_manual(target, OWN_COMPID, False))
        self._sdk.add_any_connection("raw://")
        self._raw = self._sdk.subscribe_raw_bytes_to_be_sent(send)
        self._parameters = CodecCommands(send, Codec(target, OWN_COMPID), target, dialect)
        self._wanted: deque[Command] = deque()
        self._steps: deque[Command] = deque()  # steps of the command that is being executed
        self._open = False  # the first step has been handed to MAVSDK or the codec
        self._results: list[CommandResult] = []
        self._asked: queue.SimpleQueue[tuple[Command, LongCommand] | None] = queue.SimpleQueue()
        self._answered: queue.SimpleQueue[CommandResult] = queue.SimpleQueue()
        self._worker = threading.Thread(target=self._work, name="mavsdk-commands", daemon=True)
        self._worker.start()

    @property
    def busy(self) -> bool:
        return bool(self._steps or self._wanted)

    def request(self, command: Command) -> None:
        self._wanted.append(command)

    def results(self) -> list[CommandResult]:
        done, self._results = self._results, []
        return done

    def frame(self, frame: bytes, message: Any) -> None:
        self._sdk.pass_received_raw_bytes(frame)
        self._parameters.frame(frame, message)

    def step(self, now_us: int) -> None:
        self._parameters.step(now_us)
        for result in self._parameters.results():
            self._finish(result)
        while not self._answered.empty():
            self._finish(self._answered.get_nowait())
        dialect = self._dialect()
        if dialect is None or self._open:
            return
        if not self._steps and self._wanted:
            self._steps.extend(dialect.steps(self._wanted.popleft()))
        if self._steps:
            self._begin(self._steps[0], dialect)

    def close(self) -> None:
        self._asked.put(None)
        self._worker.join(timeout=_JOIN_S)
        if not self._worker.is_alive():  # destroying under a running call would crash the process
            self._sdk.unsubscribe_raw_bytes_to_be_sent(self._raw)
            self._sdk.destroy()

    def _begin(self, command: Command, dialect: Dialect) -> None:
        self._open = True
        if command.verb in _PARAMETERS:
            self._parameters.request(command)
            return
        asked = dialect.long_command(command)
        assert asked is not None
        self._asked.put((command, asked))

    def _finish(self, result: CommandResult) -> None:
        self._open = False
        self._steps.popleft()
        self._results.append(result)
        if not result.ok:
            self._results.extend(CommandResult(step, False, result.text) for step in self._steps)
            self._steps.clear()

    def _work(self) -> None:
        direct: MavlinkDirect | None = None
        while True:
            asked = self._asked.get()
            if asked is None:
                return
            command, long = asked
            try:
                direct = direct or self._connect()
                if direct is None:
                    self._answered.put(CommandResult(command, False, "MAVSDK has not discovered the vehicle"))
                    continue
                answer = json.loads(direct.send_command(self._message(long)).fields_json)
                result = answer.get("result")  # MAVSDK counts any answer as success
                self._answered.put(CommandResult(command, result == 0, f"result {result}"))
            except Exception as error:  # MAVSDK's errors share no base class across plugins; all mean "refused"
                self._answered.put(CommandResult(command, False, f"{type(error).__name__}: {error}"))

    def _connect(self) -> MavlinkDirect | None:
        system = self._sdk.first_autopilot(_DISCOVERY_S)
        return None if system is None else MavlinkDirect(system)

    def _message(self, asked: LongCommand) -> MavlinkMessage:
        padded = (*asked.params, *(0.0,) * (7 - len(asked.params)))
        fields: dict[str, Any] = {
            "target_system": self._target,
            "target_component": 1,
            "command": asked.command,
            "confirmation": 0,
        }
        fields.update({f"param{i + 1}": None if math.isnan(v) else v for i, v in enumerate(padded)})
        return MavlinkMessage("COMMAND_LONG", self._target, OWN_COMPID, self._target, 1, json.dumps(fields))
