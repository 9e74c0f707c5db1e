"""PX4's mission protocol on one link: upload, download, clear, set current; missions, geofences, rally points."""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import development as mav

from sitl.net.wire import KINDS
from sitl.px4.link.parameters import Sender
from sitl.px4.missions import ALL, CAPACITY, MISSION, Item, MissionResult, Store, validate

RETRY_US = 250_000
TIMEOUT_US = 5_000_000
_ACK = KINDS[mav.MAVLINK_MSG_ID_MISSION_ACK]
_COUNT = KINDS[mav.MAVLINK_MSG_ID_MISSION_COUNT]
_REQUEST = KINDS[mav.MAVLINK_MSG_ID_MISSION_REQUEST_INT]
_ITEM = KINDS[mav.MAVLINK_MSG_ID_MISSION_ITEM_INT]
_FLOAT_ITEM = KINDS[mav.MAVLINK_MSG_ID_MISSION_ITEM]
_REACHED = KINDS[mav.MAVLINK_MSG_ID_MISSION_ITEM_REACHED]
_MISSION_FRAME = 2
_INT_FRAMES = {0: 5, 3: 6}  # frame of a MISSION_ITEM -> frame of MISSION_ITEM_INT


class MissionLink:
    """Uploads to one vehicle over one link; one upload at a time."""

    def __init__(self, store: Store, link: Sender) -> None:
        self._store = store
        self._link = link
        self._kind = MISSION
        self._wanted = 0  # items of the running upload; 0: none is running
        self._received: list[Item] = []
        self._partner = (0, 0)
        self._received_us = self._requested_us = 0

    # --- upload ---

    def count(self, m: Any, now_us: int) -> None:
        """Take MISSION_COUNT: a client wants to upload."""
        capacity = CAPACITY.get(m.mission_type)
        if capacity is None:
            self._acknowledge(MissionResult.UNSUPPORTED, m.mission_type)
        elif m.count > capacity:
            self._acknowledge(MissionResult.NO_SPACE, m.mission_type)
        elif self._wanted and self._partner != self._link.sender:
            self._acknowledge(MissionResult.ERROR, m.mission_type)
        elif m.count == 0:
            self._wanted = 0
            self._store.replace(m.mission_type, ())
            self._acknowledge(MissionResult.ACCEPTED, m.mission_type)
        else:
            self._kind, self._wanted, self._received = m.mission_type, m.count, []
            self._partner, self._received_us = self._link.sender, now_us
            self._request(now_us)

    def item(self, m: Any, now_us: int) -> None:
        """Take a MISSION_ITEM_INT or MISSION_ITEM of the running upload; others and repeated ones are ignored."""
        if not self._wanted or self._link.sender != self._partner or m.mission_type != self._kind:
            self._acknowledge(MissionResult.ERROR, m.mission_type)
            return
        if m.seq != len(self._received):
            return
        whole = m.get_msgId() == mav.MAVLINK_MSG_ID_MISSION_ITEM_INT
        if not whole and not (abs(m.x) < 1e4 and abs(m.y) < 1e4):  # also NaN, which no integer holds
            self._give_up(MissionResult.INVALID_PARAM5_X)
            return
        scaled = whole or m.frame == _MISSION_FRAME
        x, y = (m.x, m.y) if scaled else (m.x * 1e7, m.y * 1e7)
        item = Item(m.frame, m.command, (m.param1, m.param2, m.param3, m.param4), int(x), int(y), m.z, m.autocontinue)
        verdict = validate(self._kind, item)
        if verdict != MissionResult.ACCEPTED:
            self._give_up(verdict)
            return
        self._received_us = now_us
        self._received.append(item)
        if len(self._received) < self._wanted:
            self._request(now_us)
            return
        self._wanted = 0
        self._store.replace(self._kind, tuple(self._received))
        self._acknowledge(MissionResult.ACCEPTED, self._kind)

    def send_due(self, now_us: int) -> None:
        """Request a missing item again; give up after a silence."""
        if not self._wanted:
            return
        if now_us - self._received_us >= TIMEOUT_US:
            self._wanted = 0
        elif now_us - self._requested_us >= RETRY_US:
            self._request(now_us)

    def _give_up(self, why: MissionResult) -> None:
        self._wanted = 0
        self._acknowledge(why, self._kind)

    def _request(self, now_us: int) -> None:
        self._requested_us = now_us
        self._link.send(_REQUEST, len(self._received), *self._partner, self._kind)

    # --- download and the rest ---

    def list(self, m: Any) -> None:
        """Answer MISSION_REQUEST_LIST."""
        if m.mission_type not in CAPACITY:
            self._acknowledge(MissionResult.UNSUPPORTED, m.mission_type)
            return
        self._link.send(_COUNT, len(self._store.items[m.mission_type]), *self._link.sender, m.mission_type)

    def request(self, m: Any) -> None:
        """Answer MISSION_REQUEST_INT, or the older MISSION_REQUEST, which gets a MISSION_ITEM."""
        items = self._store.items.get(m.mission_type, ())
        if m.seq >= len(items):
            return  # PX4 answers nothing
        item = items[m.seq]
        current = int(m.mission_type == MISSION and m.seq == self._store.current)
        tail = m.seq, item.command, *self._link.sender
        rest = current, item.autocontinue, m.mission_type
        if m.get_msgId() == mav.MAVLINK_MSG_ID_MISSION_REQUEST_INT:
            frame = _INT_FRAMES.get(item.frame, item.frame)
            self._link.send(_ITEM, *item.params, item.lat_e7, item.lon_e7, item.z_m, *tail, frame, *rest)
        else:
            place = item.lat_e7 / 1e7, item.lon_e7 / 1e7
            self._link.send(_FLOAT_ITEM, *item.params, *place, item.z_m, *tail, item.frame, *rest)

    def clear(self, m: Any) -> None:
        """Execute MISSION_CLEAR_ALL."""
        if m.mission_type in CAPACITY or m.mission_type == ALL:
            self._store.replace(m.mission_type, ())
            self._acknowledge(MissionResult.ACCEPTED, m.mission_type)
        else:
            self._acknowledge(MissionResult.UNSUPPORTED, m.mission_type)

    def set_current(self, m: Any) -> None:
        """Execute MISSION_SET_CURRENT; MISSION_CURRENT shows whether there was such an item."""
        self._store.jump(m.seq)

    def reached(self, seq: int) -> None:
        """Send MISSION_ITEM_REACHED."""
        self._link.send(_REACHED, seq)

    def _acknowledge(self, result: MissionResult, kind: int) -> None:
        self._link.send(_ACK, *self._link.sender, result, kind)
