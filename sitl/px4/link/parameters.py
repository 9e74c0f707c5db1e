"""PX4's parameter protocol on one link: the list with its hash, reads by name or index, writes, PARAM_ERROR."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from pymavlink.dialects.v20 import development as mav

from sitl.net.wire import KINDS
from sitl.parameter_values import UnknownParameterError, WireValue
from sitl.px4.parameters import HASH_NAME, Parameters, WrongTypeError

UNKNOWN, WRONG_TYPE = 1, 7  # MAV_PARAM_ERROR
STALE_INDEX = 511  # PX4 leaves the index of a PARAM_ERROR by name unset; this value then appears
LIST_EVERY_US = 1000
_VALUE = KINDS[mav.MAVLINK_MSG_ID_PARAM_VALUE]
_ERROR = KINDS[mav.MAVLINK_MSG_ID_PARAM_ERROR]


class Sender(Protocol):
    """Operations that the protocol needs of its link."""

    sender: tuple[int, int]  # system and component of the message being handled

    def send(self, kind: Any, *fields: Any) -> None:
        """Send one message from its fields in wire order."""


class ParameterLink:
    """Parameters of one vehicle on one link; `on_change` tells the other links."""

    def __init__(self, table: Parameters, link: Sender, on_change: Callable[[WireValue], None]) -> None:
        self._table = table
        self._link = link
        self._on_change = on_change
        self._next: int | None = None  # index in the running list; -1: the hash
        self._due_us = 0

    def list(self, now_us: int) -> None:
        """Answer PARAM_REQUEST_LIST."""
        self._next, self._due_us = -1, now_us

    def read(self, message: Any) -> None:
        """Answer PARAM_REQUEST_READ."""
        by_name = message.param_index < 0
        if by_name and message.param_id == HASH_NAME:
            self.send(self._table.checksum())
            return
        try:
            found = self._table.by_name(message.param_id) if by_name else self._table.by_index(message.param_index)
        except UnknownParameterError:
            self._refuse(message.param_id, STALE_INDEX if by_name else message.param_index, UNKNOWN)
        else:
            self.send(found)

    def write(self, message: Any) -> None:
        """Execute PARAM_SET; of the hash it means that the client has the list already."""
        if message.param_id == HASH_NAME:
            self._next = None
            return
        try:
            stored = self._table.set_from_wire(message.param_id, message.param_value, message.param_type)
        except UnknownParameterError:
            self._refuse(message.param_id, STALE_INDEX, UNKNOWN)
        except WrongTypeError:
            self._refuse(message.param_id, STALE_INDEX, WRONG_TYPE)
        else:
            self.send(stored)
            self._on_change(stored)

    def send_due(self, now_us: int) -> None:
        """Continue the list, about a thousand a second."""
        while self._next is not None and self._due_us <= now_us:
            self._due_us += LIST_EVERY_US
            self.send(self._table.checksum() if self._next < 0 else self._table.by_index(self._next))
            self._next = self._next + 1 if self._next + 1 < len(self._table) else None

    def send(self, value: WireValue) -> None:
        """Send PARAM_VALUE."""
        self._link.send(_VALUE, value.value, len(self._table), value.index, value.name.encode(), value.kind)

    def _refuse(self, name: str, index: int, error: int) -> None:
        raw = name.encode("ascii", "replace")[:16]
        self._link.send(_ERROR, index, *self._link.sender, raw, error)
