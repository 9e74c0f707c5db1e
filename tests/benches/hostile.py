"""Hostile bytes for a MAVLink receiver, seeded, so that one that does harm can be sent again.

A datagram is hostile when no autopilot may change its mode, arming or motion for it: frames that are broken, not
addressed to it, or ask for what does not exist. A command that is whole, addressed to the vehicle and exists is a
command, whoever sent it, and never generated here.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from fastcrc import crc16
from pymavlink.dialects.v20 import development as mav

NAN, INF = float("nan"), float("inf")
BAD_NUMBERS = (NAN, INF, -INF, 3e38, -3e38, 1e-42, -1.0, 2.0**31, 65536.5)
NOT_FINITE = (NAN, INF, -INF)
ARM_DISARM, SET_MODE, SET_INTERVAL, REQUEST_MESSAGE = 400, 176, 511, 512
COMMANDS_THERE_ARE = frozenset(mav.enums["MAV_CMD"])
UNKNOWN_NAMES = (b"NO_SUCH_PARAM", b"", b"\xff" * 16, b"A" * 16, b"COM_OF_LOSS_T\x01")
POISON = b"\xfd\xff"
SIGNATURE_BYTES = 13
ADDRESS_FIELDS = ("target_system", "target")


@dataclass(frozen=True, slots=True, kw_only=True)
class Shape:
    """What the wire needs to know of a message."""

    number: int
    crc_extra: int
    size: int
    target_at: int | None  # offset of the target system in the payload


def _shape(cls: Any) -> Shape:
    sizes = {"uint8_t": 1, "int8_t": 1, "char": 1, "uint16_t": 2, "int16_t": 2, "uint32_t": 4, "int32_t": 4, "float": 4}
    at, target_at = 0, None
    by_name = dict(zip(cls.fieldnames, cls.fieldtypes, strict=True))
    for name, length in zip(cls.ordered_fieldnames, cls.array_lengths, strict=True):
        if name in ADDRESS_FIELDS:
            target_at = at
        at += sizes.get(by_name[name], 8) * max(1, length)
    assert at == cls.unpacker.size, (cls.msgname, at)
    return Shape(number=cls.id, crc_extra=cls.crc_extra, size=at, target_at=target_at)


SHAPES = tuple(_shape(cls) for _, cls in sorted(mav.mavlink_map.items()))


def frame_of(number: int, crc_extra: int, payload: bytes, source: tuple[int, int], flags: int = 0) -> bytes:
    """A MAVLink 2 frame with a right checksum, payload not shortened."""
    head = struct.pack("<BBBBBB", len(payload), flags, 0, payload[0] if payload else 0, *source)
    body = head + number.to_bytes(3, "little") + payload
    return b"\xfd" + body + crc16.mcrf4xx(body + bytes((crc_extra,))).to_bytes(2, "little")


class Hostile:
    """An endless stream of hostile datagrams against vehicle `sysid`, component 1."""

    def __init__(self, seed: int, sysid: int) -> None:
        self._rng = np.random.default_rng([seed, sysid, 23])
        self._sysid = sysid
        self._packer = mav.MAVLink(None, srcSystem=250, srcComponent=190)
        self._orders = [self._pack(m) for m in self._valid_orders()]
        self._nonsense = [self._pack(m) for _ in range(20) for m in self._nonsense_orders()]
        self.kinds: tuple[Callable[[], bytes], ...] = (
            self.misaddressed,
            self.bit_flipped,
            self.truncated,
            self.nonsense,
            self.nonsense,
            self.poisoned,
            self.signed_wrongly,
            self.mavlink_1,
            self.of_another_dialect,
            self.random_bytes,
        )

    def __iter__(self) -> Iterator[bytes]:
        while True:
            yield self.kinds[int(self._rng.integers(len(self.kinds)))]()

    # --- kinds ---

    def misaddressed(self) -> bytes:
        """Return any message of the dialect with random bits, addressed to another vehicle or to none."""
        shape = SHAPES[int(self._rng.integers(len(SHAPES)))]
        payload = bytearray(self._rng.bytes(shape.size))
        if shape.target_at is not None:
            payload[shape.target_at] = self._somebody_else()
        return frame_of(shape.number, shape.crc_extra, bytes(payload), self._source())

    def bit_flipped(self) -> bytes:
        """A valid order with one bit wrong."""
        broken = bytearray(self._order())
        broken[int(self._rng.integers(len(broken)))] ^= 1 << int(self._rng.integers(8))
        return bytes(broken)

    def truncated(self) -> bytes:
        """A valid order that ends too early."""
        order = self._order()
        return order[: int(self._rng.integers(len(order)))]

    def nonsense(self) -> bytes:
        """Whole, addressed to the vehicle, and asking for what does not exist."""
        return self._nonsense[int(self._rng.integers(len(self._nonsense)))]

    def poisoned(self) -> bytes:
        """Return two bytes that announce a long frame, before and between harmless ones."""
        return POISON + self.misaddressed() + (POISON if self._rng.integers(2) else b"") + self.misaddressed()

    def signed_wrongly(self) -> bytes:
        """The signed flag without a signature on an order, or a made-up signature on what is not addressed here."""
        if self._rng.integers(2):
            order = self._order()
            payload = order[10 : 10 + order[1]]
            number = int.from_bytes(order[7:10], "little")
            return frame_of(number, mav.mavlink_map[number].crc_extra, payload, (order[5], order[6]), flags=1)
        plain = bytearray(self.misaddressed())
        plain[2] |= 1
        number = int.from_bytes(plain[7:10], "little")
        extra = bytes((mav.mavlink_map[number].crc_extra,))
        plain[-2:] = crc16.mcrf4xx(bytes(plain[1:-2]) + extra).to_bytes(2, "little")
        return bytes(plain) + self._rng.bytes(SIGNATURE_BYTES)

    def mavlink_1(self) -> bytes:
        """Return an old frame to another vehicle, whole or not."""
        payload = struct.pack("<7fHBBB", *[1.0] * 7, ARM_DISARM, self._somebody_else(), 1, 0)
        body = struct.pack("<BBBBB", len(payload), 0, *self._source(), 76) + payload
        checksum = crc16.mcrf4xx(body + bytes((mav.mavlink_map[76].crc_extra,)))
        return b"\xfe" + body + (checksum ^ int(self._rng.integers(2))).to_bytes(2, "little")

    def of_another_dialect(self) -> bytes:
        """A message id this dialect does not have."""
        number = int(self._rng.integers(1, 1 << 24))
        while number in mav.mavlink_map:
            number += 1
        payload = self._rng.bytes(int(self._rng.integers(1, 256)))
        return frame_of(number, int(self._rng.integers(256)), payload, self._source())

    def random_bytes(self) -> bytes:
        return self._rng.bytes(int(self._rng.integers(0, 300)))

    # --- what they are made of ---

    def _somebody_else(self) -> int:
        other = int(self._rng.integers(1, 256))
        return other if other != self._sysid else other % 255 + 1

    def _source(self) -> tuple[int, int]:
        return int(self._rng.integers(1, 256)), int(self._rng.integers(1, 256))

    def _pack(self, message: Any) -> bytes:
        packed: bytes = message.pack(self._packer)
        return packed

    def _order(self) -> bytes:
        return self._orders[int(self._rng.integers(len(self._orders)))]

    def _long(self, command: int, *params: float, target: tuple[int, int] | None = None) -> Any:
        padded = [*params, *[0.0] * (7 - len(params))]
        return mav.MAVLink_command_long_message(*(target or (self._sysid, 1)), command, 0, *padded)

    def _valid_orders(self) -> Iterator[Any]:
        """What would be obeyed, were it whole: used broken only."""
        yield self._long(ARM_DISARM, 1.0)
        yield self._long(ARM_DISARM, 0.0, 21196.0)
        yield self._long(SET_MODE, 1.0, 4.0, 6.0)
        yield self._long(SET_MODE, 1.0, 6.0)
        yield self._long(22, *[NAN] * 7)
        yield self._long(185, 1.0)
        yield mav.MAVLink_set_mode_message(self._sysid, 1, 0x05040000)
        yield mav.MAVLink_param_set_message(self._sysid, 1, b"COM_OF_LOSS_T", 60.0, 9)
        yield mav.MAVLink_set_attitude_target_message(7, self._sysid, 1, 7, [0.7, 0.7, 0.0, 0.0], 0.0, 0.0, 0.0, 0.9)

    def _nonsense_orders(self) -> Iterator[Any]:
        sysid, rng = self._sysid, self._rng
        bad = [float(BAD_NUMBERS[i]) for i in rng.integers(len(BAD_NUMBERS), size=7)]
        not_finite = float(NOT_FINITE[int(rng.integers(len(NOT_FINITE)))])
        number = int(rng.integers(65536))
        while number in COMMANDS_THERE_ARE:
            number = (number + 1) % 65536
        yield self._long(number, *bad)
        yield mav.MAVLink_command_int_message(sysid, 1, 0, number, 0, 0, *bad[:4], -(2**31), 2**31 - 1, bad[4])
        yield self._long(ARM_DISARM, float(rng.choice([NAN, INF, -INF, 2.0, -1.0, 5.0, 0.5, 3e38])), 21196.0)
        yield self._long(SET_MODE, 1.0, float(rng.choice([NAN, INF, -1.0, 11.0, 99.0, 300.0, 3e38])), bad[2])
        yield self._long(SET_MODE, 1.0, 4.0, float(rng.choice([77.0, -3.0, 200.0, 1e9])))
        yield self._long(SET_MODE, float(rng.choice([NAN, INF, 0.0, 128.0])), 4.0, 6.0)
        yield mav.MAVLink_set_mode_message(sysid, int(rng.choice([0, 2, 128])), 0x06040000)
        yield mav.MAVLink_set_mode_message(sysid, 1, int(rng.integers(11, 200)) << 16)
        yield self._long(SET_INTERVAL, bad[0] if bad[0] < 0 or bad[0] > 9e8 else NAN, bad[1])
        yield self._long(SET_INTERVAL, float(rng.integers(20000, 60000)), float(rng.integers(1, 10**6)))
        yield self._long(REQUEST_MESSAGE, *bad)
        yield mav.MAVLink_set_attitude_target_message(
            1, sysid, 1, 7, [not_finite, 0.0, float(rng.choice([0.0, NAN])), 0.0], 0.0, 0.0, 0.0, 0.5
        )
        yield mav.MAVLink_set_attitude_target_message(1, sysid, 1, 7, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, 0.0, not_finite)
        yield mav.MAVLink_set_attitude_target_message(1, sysid, 1, 7, [0.0] * 4, 0.0, 0.0, 0.0, 0.5)
        yield mav.MAVLink_set_attitude_target_message(
            1, sysid, 1, int(rng.choice([64, 71, 135, 192])), [0.7, 0.7, 0.0, 0.0], *[not_finite] * 3, 0.9
        )
        yield from self._nonsense_transfers(not_finite)

    def _nonsense_transfers(self, not_finite: float) -> Iterator[Any]:
        """Return reads of unknown parameters, and mission steps that no transfer expects."""
        sysid, rng = self._sysid, self._rng
        name = UNKNOWN_NAMES[int(rng.integers(len(UNKNOWN_NAMES)))]
        kind, index = int(rng.integers(256)), int(rng.choice([-32768, -2, 5000, 32767]))
        yield mav.MAVLink_param_set_message(sysid, 1, name, not_finite, kind)
        yield mav.MAVLink_param_set_message(sysid, 1, b"COM_OF_LOSS_T", 60.0, int(rng.choice([0, 6, 10, 255])))
        yield mav.MAVLink_param_set_message(sysid, 1, b"COM_OF_LOSS_T", not_finite, 9)
        yield mav.MAVLink_param_request_read_message(sysid, 1, name, index)
        place = int(rng.integers(-(2**31), 2**31)), int(rng.integers(-(2**31), 2**31)), not_finite
        sequence, of = int(rng.integers(65536)), int(rng.choice([0, 1, 2, 77]))
        yield mav.MAVLink_mission_item_int_message(
            sysid, 1, sequence, int(rng.integers(256)), int(rng.integers(65536)), 1, 1, *[not_finite] * 4, *place, of
        )
        yield mav.MAVLink_mission_count_message(sysid, 1, int(rng.choice([65535, 20000])), of)
        yield mav.MAVLink_mission_request_int_message(sysid, 1, sequence, of)
        yield mav.MAVLink_mission_ack_message(sysid, 1, int(rng.integers(256)), of)
        yield mav.MAVLink_mission_set_current_message(sysid, 1, sequence)


__all__ = ["Hostile", "frame_of"]
