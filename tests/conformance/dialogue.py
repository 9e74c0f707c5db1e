"""A dialogue with one vehicle: keeps our heartbeats and setpoint stream going, and logs what arrives.

The same code runs with a simulated vehicle on a simulated clock and with a real one on the wall clock. It judges
nothing; `tests.conformance.player` does.
"""

from __future__ import annotations

import struct
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from pymavlink.dialects.v20 import development as mav

from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.framing import frames, message_id
from tests.conformance import vocabulary as v
from tests.conformance.partners import Partner

IDS: dict[str, int] = {cls.msgname: number for number, cls in mav.mavlink_map.items()}
HEARTBEAT_EVERY_S = 1.0
ONBOARD_COMPONENT, GCS_COMPONENT, GCS_SYSID = 191, 190, 255
TYPE_ONBOARD, TYPE_GCS, NO_AUTOPILOT = 18, 6, 8
AUTOPILOT_COMPONENT = 1
TARGETS = frozenset({"target_system", "target"})


class Deviation(AssertionError):  # noqa: N818 - what the sheet calls it
    """The vehicle does not do what the row says."""


@dataclass(frozen=True, kw_only=True)
class Arrived:
    """A frame from the vehicle; decoded on first access."""

    t_s: float
    number: int
    order: int  # in the log
    frame: bytes
    codec: Codec

    @cached_property
    def message(self) -> Any | None:
        return self.codec.decode(self.frame)


def build(what: v.Message, sysid: int) -> Any:
    """Dialect message of a row's message, addressed to that vehicle where the row says so."""
    cls = mav.mavlink_map[IDS[what.name]]
    unknown = set(what.fields) - set(cls.fieldnames)
    if unknown:
        raise KeyError(f"{what.name} has no fields {sorted(unknown)}")
    return cls(*[_field(cls, i, name, what.fields, sysid) for i, name in enumerate(cls.fieldnames)])


def _field(cls: Any, position: int, name: str, given: Mapping[str, Any], sysid: int) -> Any:
    if name in given:
        value = given[name]
        if name in TARGETS and value == v.OWN:
            return sysid
        return value.encode() if isinstance(value, str) else value
    if cls.fieldtypes[position] == "char":
        return b""
    length = cls.array_lengths[cls.orders[position]]
    return [0] * length if length else 0


def wire_value(value: int | float) -> float:
    """PX4's PARAM_VALUE.param_value: an integer's bits."""
    wire: float = struct.unpack("<f", struct.pack("<i", value))[0] if isinstance(value, int) else value
    return wire


def integer_value(wire: float) -> int:
    """The integer in a float's bits."""
    value: int = struct.unpack("<i", struct.pack("<f", wire))[0]
    return value


def same_bits(left: float, right: float) -> bool:
    return struct.pack("<f", left) == struct.pack("<f", right)


class Dialogue:
    """One conversation with one vehicle.

    Attributes:
        sysid: of the vehicle; 0 until its first heartbeat.
        mark, mark_s: how much had come when the newest thing was sent, and when that was.
    """

    def __init__(self, partner: Partner, *, passive: bool = False) -> None:
        self.partner = partner
        self._passive = passive
        self.begin()

    def begin(self) -> None:
        """Reset for a vehicle that has just started."""
        self.sysid = 0
        self._log: dict[tuple[str, int, bool], list[Arrived]] = {}  # by link, message, and whether it is the vehicle's
        self._arrivals = 0
        self.mark, self.mark_s = 0, self.partner.now_s()
        self.paused: set[str] = set()
        self.begun_s = self.mark_s
        self._beat_due_s = self.mark_s
        self._stream: v.Stream | None = None
        self._stream_due_s = self._streamed_s = 0.0
        self._reader = Codec(GCS_SYSID, 1)
        self._codecs: dict[str, Codec] = {}

    @property
    def text_link(self) -> str:
        """Return the link that receives texts: the one with a ground station."""
        return v.GCS_LINK if v.GCS_LINK in self.partner.links else v.OFFBOARD_LINK

    @property
    def streaming(self) -> bool:
        return self._stream is not None

    def own_ids(self, link: str) -> tuple[int, int]:
        return (self.sysid or 1, ONBOARD_COMPONENT) if link == v.OFFBOARD_LINK else (GCS_SYSID, GCS_COMPONENT)

    # --- time ---

    def pump(self) -> None:
        """Let a little time pass: send what is due, take what came."""
        now_s = self.partner.now_s()
        if not self._passive and now_s >= self._beat_due_s:
            self._beat_due_s = now_s + HEARTBEAT_EVERY_S
            for link in self.partner.links:
                if link not in self.paused:
                    kind = TYPE_GCS if link == self.text_link else TYPE_ONBOARD
                    self.transmit(mav.MAVLink_heartbeat_message(kind, NO_AUTOPILOT, 0, 0, 4, 3), link)
        if self._stream is not None and now_s >= self._stream_due_s - 1e-9:
            self._send_setpoint(now_s)
        self.partner.advance()
        self._take()

    def _send_setpoint(self, now_s: float) -> None:
        assert self._stream is not None
        self._stream_due_s = max(self._stream_due_s, now_s - 0.1) + 1.0 / self._stream.hz
        self._streamed_s = now_s
        self.transmit(build(self._stream.what, self.sysid), v.OFFBOARD_LINK)

    def _take(self) -> None:
        now_us = round(self.partner.now_s() * 1e6)
        for name, link in self.partner.links.items():
            for datagram in link.receive(now_us):
                for frame in frames(datagram.data):
                    self._note(name, datagram.t_us * 1e-6, frame)

    def _note(self, link: str, t_s: float, frame: bytes) -> None:
        number = message_id(frame)
        if not self.sysid and number == mav.MAVLINK_MSG_ID_HEARTBEAT and frame[6] == AUTOPILOT_COMPONENT:
            self.sysid = frame[5]
            self._codecs.clear()
        own = frame[5] == (self.sysid or frame[5]) and frame[6] == AUTOPILOT_COMPONENT
        arrived = Arrived(t_s=t_s, number=number, order=self._arrivals, frame=frame, codec=self._reader)
        self._log.setdefault((link, number, own), []).append(arrived)
        self._arrivals += 1

    def run(self, seconds: float) -> None:
        end_s = self.partner.now_s() + seconds
        while self.partner.now_s() < end_s - 1e-9:
            self.pump()

    def run_until(self, met: Callable[[], bool], limit_s: float) -> bool:
        """Run until it is met, or that long after the mark (plus the tolerance of the partner's clock)."""
        while not met():
            if self.partner.now_s() - self.mark_s >= limit_s + self.partner.slack_s - 1e-9:
                return False
            self.pump()
        return True

    # --- sending ---

    def set_mark(self) -> None:
        self.mark, self.mark_s = self._arrivals, self.partner.now_s()

    def transmit(self, packed: Any, link: str) -> None:
        codec = self._codecs.get(link)
        if codec is None:
            codec = self._codecs[link] = Codec(*self.own_ids(link))
        self.partner.links[link].send(codec.encode(packed))

    def send(self, what: v.Message, link: str = v.OFFBOARD_LINK) -> None:
        """Send, and look at what comes from now on."""
        self.set_mark()
        self.transmit(build(what, self.sysid), link)

    def stream(self, what: v.Stream) -> None:
        """Begin a setpoint stream, or change it."""
        self.set_mark()
        self._stream, self._stream_due_s = what, self.mark_s
        self._send_setpoint(self.mark_s)

    def stop(self) -> None:
        """End the stream; the mark is its last setpoint."""
        self._stream = None
        self.mark, self.mark_s = self._arrivals, self._streamed_s

    # --- looking ---

    def all_of(self, name: str | int, link: str, *, forwarded: bool = False) -> list[Arrived]:
        """Everything of a kind: from the vehicle, or what it forwards of others."""
        number = IDS[name] if isinstance(name, str) else name
        return self._log.get((self.text_link if link == v.TEXT_LINK else link, number, not forwarded), [])

    def since_mark(self, name: str | int, link: str, *, forwarded: bool = False) -> list[Arrived]:
        """The same, since the newest thing was sent."""
        came = self.all_of(name, link, forwarded=forwarded)
        return came[bisect_left(came, self.mark, key=lambda arrived: arrived.order) :]

    def by_kind(self) -> dict[int, list[Arrived]]:
        """Everything the vehicle said, by message id."""
        kinds: dict[int, list[Arrived]] = {}
        for (_, number, own), came in self._log.items():
            if own:
                kinds.setdefault(number, []).extend(came)
        return kinds

    def counts(self) -> dict[str, Counter[int]]:
        """How many of each message id came from the vehicle, by link."""
        counts: dict[str, Counter[int]] = {link: Counter() for link in self.partner.links}
        for (link, number, own), came in self._log.items():
            if own:
                counts[link][number] += len(came)
        return counts

    def newest(self, name: str, link: str = v.OFFBOARD_LINK) -> Any | None:
        """Last message of a kind, however old."""
        came = self.all_of(name, link)
        return came[-1].message if came else None

    def texts(self) -> list[tuple[int, str]]:
        """(severity, text) since the mark, chunks put together."""
        said: list[tuple[int, str]] = []
        for arrived in self.since_mark("STATUSTEXT", self.text_link):
            m = arrived.message
            if m is None:
                continue
            if m.id and m.chunk_seq and said:
                said[-1] = (m.severity, said[-1][1] + m.text)
            else:
                said.append((m.severity, m.text))
        return said
