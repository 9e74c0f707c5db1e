"""Reads parameters by name and sets some of them; requests are repeated a few times until answered. No socket.

Every value that was set is read again, because only the stored value counts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import development as mavlink

from swarmctl.check.link_facts import Parameter
from swarmctl.core.types import Command, Verb
from swarmctl.mavlink.dialects.dialect import Dialect

_REAL32 = mavlink.MAV_PARAM_TYPE_REAL32
_ASK_US = 400_000
_BATCH_US = 50_000
_TRIES = 4
_AT_ONCE = 6  # few, for slow serial links
_DOES_NOT_EXIST = 1  # MAV_PARAM_ERROR


@dataclass(slots=True, kw_only=True)
class _Setting:
    value: float | int
    tries: int = 0
    due_us: int = 0
    reading: bool = False  # acknowledged; now read back


class ParameterReader:
    """Reads and sets the parameters of one vehicle.

    Args:
        sysid, compid: address of the autopilot.
        names: parameters to read.
        dialect: defines the encoding of integers.
    """

    def __init__(self, sysid: int, compid: int, names: Sequence[str], dialect: Dialect) -> None:
        self._target, self._dialect = (sysid, compid), dialect
        self._names = tuple(names)
        self._tries = dict.fromkeys(names, 0)
        self._requested_us: dict[str, int] = {}
        self._given_up: set[str] = set()
        self._batch_us = 0
        self._settings: dict[str, _Setting] = {}
        self.values: dict[str, Parameter] = {}
        self.interrupted = False  # the vehicle was armed while values were left to be set

    @property
    def settled(self) -> bool:
        """Whether nothing is left to read or to set."""
        return not self._settings and not self._open()

    def facts(self) -> dict[str, Parameter]:
        """Return all requested parameters; those that were never answered have no value."""
        return {name: self.values.get(name, Parameter(name=name, value=None)) for name in self._names}

    def set_all(self, values: Mapping[str, float | int]) -> None:
        """Queue values to be set, each in the type it was read with."""
        self._settings |= {name: _Setting(value=value) for name, value in values.items() if name in self.values}

    def step(self, now_us: int, may_change: bool) -> list[Any]:
        """Return the messages to send now."""
        if self._settings:
            if not may_change:
                self._settings.clear()
                self.interrupted = True
                return []
            return self._step_setting(now_us)
        if now_us < self._batch_us:
            return []
        self._batch_us = now_us + _BATCH_US
        waiting = [name for name in self._open() if now_us - self._requested_us.get(name, -_ASK_US) >= _ASK_US]
        self._given_up.update(name for name in waiting if self._tries[name] >= _TRIES)
        asked = [name for name in waiting if name not in self._given_up][:_AT_ONCE]
        for name in asked:
            self._tries[name] += 1
            self._requested_us[name] = now_us
        return [self._read(name) for name in asked]

    def hear(self, message: Any) -> None:
        """Take a PARAM_VALUE or PARAM_ERROR; ignore everything else."""
        kind = message.get_type()
        if kind == "PARAM_VALUE":
            name = _text(message.param_id)
            if name not in self._tries:
                return
            value = self._dialect.from_wire(message.param_value, message.param_type)
            if not math.isfinite(value):
                return  # not an answer to a request
            whole = message.param_type < _REAL32
            self.values[name] = Parameter(name=name, value=int(value) if whole else value, kind=message.param_type)
            self._confirm(name)
        elif kind == "PARAM_ERROR":
            name = _text(message.param_id)
            self._settings.pop(name, None)
            if message.error == _DOES_NOT_EXIST and name in self._tries:
                self.values[name] = Parameter(name=name, value=None, refused=True)

    def _confirm(self, name: str) -> None:
        setting = self._settings.get(name)
        if setting is None:
            return
        if setting.reading:
            del self._settings[name]
        else:
            setting.reading, setting.due_us = True, 0

    def _step_setting(self, now_us: int) -> list[Any]:
        name, setting = next(iter(self._settings.items()))
        if now_us < setting.due_us:
            return []
        if setting.tries >= 2 * _TRIES:
            del self._settings[name]
            return []
        setting.tries += 1
        setting.due_us = now_us + _ASK_US
        if setting.reading:
            return [self._read(name)]
        kind = self.values[name].kind
        number = round(setting.value)
        asked = (
            Command(verb=Verb.PARAM_INT, number=number)
            if kind < _REAL32
            else Command(verb=Verb.PARAM_FLOAT, value=setting.value)
        )
        wire, _ = self._dialect.to_wire(asked)
        return [mavlink.MAVLink_param_set_message(*self._target, name.encode(), wire, kind)]

    def _read(self, name: str) -> Any:
        return mavlink.MAVLink_param_request_read_message(*self._target, name.encode(), -1)

    def _open(self) -> list[str]:
        return [name for name in self._names if name not in self.values and name not in self._given_up]


def _text(raw: str | bytes) -> str:
    return raw if isinstance(raw, str) else raw.split(b"\0")[0].decode("ascii", "replace")
