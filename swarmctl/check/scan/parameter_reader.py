"""Reads parameters by name; requests are repeated a few times until answered. No socket."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Any

from pymavlink.dialects.v20 import development as mavlink

from swarmctl.check.scan.link_facts import Parameter
from swarmctl.mavlink.dialects.dialect import Dialect

_REAL32 = mavlink.MAV_PARAM_TYPE_REAL32
_ASK_US = 400_000
_BATCH_US = 50_000
_TRIES = 4
_AT_ONCE = 6  # few, for slow serial links
_DOES_NOT_EXIST = 1  # MAV_PARAM_ERROR


class ParameterReader:
    """Reads the parameters of one vehicle.

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
        self.values: dict[str, Parameter] = {}

    @property
    def settled(self) -> bool:
        """Whether nothing is left to read."""
        return not self._open()

    def facts(self) -> dict[str, Parameter]:
        """Return all requested parameters; those that were never answered have no value."""
        return {name: self.values.get(name, Parameter(name=name, value=None)) for name in self._names}

    def read_again(self, names: Collection[str]) -> None:
        """Forget these values and request them again."""
        for name in names:
            self.values.pop(name, None)
            self._requested_us.pop(name, None)
            self._given_up.discard(name)
            self._tries[name] = 0

    def step(self, now_us: int) -> list[Any]:
        """Return the messages to send now."""
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

    def receive(self, message: Any) -> None:
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
            self.values[name] = Parameter(name=name, value=int(value) if whole else value)
        elif kind == "PARAM_ERROR":
            name = _text(message.param_id)
            if message.error == _DOES_NOT_EXIST and name in self._tries:
                self.values[name] = Parameter(name=name, value=None, refused=True)

    def _read(self, name: str) -> Any:
        return mavlink.MAVLink_param_request_read_message(*self._target, name.encode(), -1)

    def _open(self) -> list[str]:
        return [name for name in self._names if name not in self.values and name not in self._given_up]


def _text(raw: str | bytes) -> str:
    return raw if isinstance(raw, str) else raw.split(b"\0")[0].decode("ascii", "replace")
