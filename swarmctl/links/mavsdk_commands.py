"""The slow path on a real link: MAVSDK over `raw://`, fed by the agent's own socket.

MAVSDK keeps the heartbeat, retries and acknowledgements. Its Offboard plugin is never created: it re-sends the last
setpoint from a C++ thread for ever, which defeats the autopilot's offboard-loss failsafe. Blocking calls run in one
worker thread; the tick only exchanges queue entries with it.
"""

from __future__ import annotations

import json
import math
import queue
import threading
from collections.abc import Callable
from typing import Any

from mavsdk import Configuration, Mavsdk
from mavsdk.plugins.action import Action
from mavsdk.plugins.mavlink_direct import MavlinkDirect
from mavsdk.plugins.mavlink_direct.mavlink_direct import MavlinkMessage
from mavsdk.plugins.param import Param

from swarmctl.core.types import Command, Verb
from swarmctl.links.commands import OWN_COMPID, CommandResult, long_command


class MavsdkCommands:
    """`CommandPort` on MAVSDK.

    Args:
        send: hands a frame to the vehicle; called from MAVSDK's thread.
        target: the vehicle's system id, also ours (PX4 convention for companions).
        external, hold: see `commands.long_command`.
    """

    def __init__(
        self,
        send: Callable[[bytes], None],
        target: int,
        external: tuple[float, float],
        hold: tuple[float, float],
    ) -> None:
        self._target, self._external, self._hold = target, external, hold
        self._sdk = Mavsdk(Configuration.create_manual(target, OWN_COMPID, True))
        self._sdk.add_any_connection("raw://")
        self._raw = self._sdk.subscribe_raw_bytes_to_be_sent(send)
        self._asked: queue.SimpleQueue[Command | None] = queue.SimpleQueue()
        self._answered: queue.SimpleQueue[CommandResult] = queue.SimpleQueue()
        self._open = 0
        self._worker = threading.Thread(target=self._work, name="mavsdk-commands", daemon=True)
        self._worker.start()

    @property
    def busy(self) -> bool:
        return self._open > 0

    def request(self, command: Command) -> None:
        self._open += 1
        self._asked.put(command)

    def results(self) -> list[CommandResult]:
        done: list[CommandResult] = []
        while not self._answered.empty():
            done.append(self._answered.get_nowait())
        self._open -= len(done)
        return done

    def frame(self, frame: bytes, message: Any) -> None:
        self._sdk.pass_received_raw_bytes(frame)

    def step(self, now_us: int) -> None:
        return

    def close(self) -> None:
        self._asked.put(None)
        self._worker.join(timeout=5.0)
        if not self._worker.is_alive():  # destroying under a running call would crash the process
            self._sdk.unsubscribe_raw_bytes_to_be_sent(self._raw)
            self._sdk.destroy()

    def _work(self) -> None:
        plugins: tuple[Action, Param, MavlinkDirect] | None = None
        while True:
            command = self._asked.get()
            if command is None:
                return
            try:
                plugins = plugins or self._connect()
                if plugins is None:
                    self._answered.put(CommandResult(command, False, "MAVSDK has not discovered the vehicle"))
                    continue
                self._answered.put(CommandResult(command, True, self._execute(command, *plugins)))
            except Exception as error:  # MAVSDK's errors share no base class across plugins; all mean "refused"
                self._answered.put(CommandResult(command, False, f"{type(error).__name__}: {error}"))

    def _connect(self) -> tuple[Action, Param, MavlinkDirect] | None:
        system = self._sdk.first_autopilot(5.0)
        return None if system is None else (Action(system), Param(system), MavlinkDirect(system))

    def _execute(self, command: Command, action: Action, param: Param, direct: MavlinkDirect) -> str:
        if command.verb is Verb.ARM:
            action.arm()
        elif command.verb is Verb.DISARM:
            action.disarm()
        elif command.verb is Verb.TAKEOFF:
            action.set_takeoff_altitude(command.value)
            action.takeoff()
        elif command.verb is Verb.LAND:
            action.land()
        elif command.verb is Verb.HOLD:
            action.hold()
        elif command.verb is Verb.PARAM_INT:
            param.set_param_int(command.name, command.number)
        elif command.verb is Verb.PARAM_FLOAT:
            param.set_param_float(command.name, command.value)
        else:
            self._send_long(command, direct)
        return "accepted"

    def _send_long(self, command: Command, direct: MavlinkDirect) -> None:
        asked = long_command(command, self._external, self._hold)
        assert asked is not None
        padded = (*asked.params, *(0.0,) * (7 - len(asked.params)))
        fields: dict[str, Any] = {
            "target_system": self._target,
            "target_component": 1,
            "command": asked.command,
            "confirmation": 0,
        }
        fields.update({f"param{i + 1}": None if math.isnan(v) else v for i, v in enumerate(padded)})
        direct.send_command(
            MavlinkMessage("COMMAND_LONG", self._target, OWN_COMPID, self._target, 1, json.dumps(fields))
        )
