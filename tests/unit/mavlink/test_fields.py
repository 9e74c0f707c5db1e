"""Fields read from payloads against pymavlink's messages, for every message that the bridge reads so."""

from __future__ import annotations

import random
from typing import Any

import pytest
from pymavlink.dialects.v20 import development as dialect

from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.fields import BOOT_READERS, READERS, Reader, reader
from tests.unit.mavlink.test_codec import frame_with

LENGTHS = (1, 7, 40, 255)  # of payloads: cut by the zeros at their end, and longer than the message


def flat(message: Any) -> dict[str, Any]:
    """The fields of pymavlink's message; numbers of arrays one by one."""
    values: dict[str, Any] = {}
    for name in message.get_fieldnames():
        value = getattr(message, name)
        values |= {f"{name}_{i}": part for i, part in enumerate(value)} if isinstance(value, list) else {name: value}
    return values


@pytest.mark.parametrize("length", LENGTHS)
@pytest.mark.parametrize(("readers", "least"), [(READERS, 14), (BOOT_READERS, 30)], ids=["used", "boot"])
def test_fields_are_those_of_pymavlink(readers: dict[int, Reader], least: int, length: int) -> None:
    rng = random.Random(length)
    assert len(readers) >= least
    for number, read in readers.items():
        frame = frame_with(number, rng.randbytes(length))
        payload = Codec(1, 191).payload(frame)
        assert payload is not None
        found, wanted = read(payload), flat(dialect.MAVLink(None).decode(bytearray(frame)))
        names = found.get_fieldnames() if isinstance(found, dialect.MAVLink_message) else found._fields
        assert len(names) > 0
        for name in names:
            assert repr(getattr(found, name)) == repr(wanted[name]), name  # as text: NaN differs from itself


def test_every_message_with_the_time_since_boot_has_its_reader() -> None:
    assert BOOT_READERS.keys() == {n for n, kind in dialect.mavlink_map.items() if "time_boot_ms" in kind.fieldnames}


@pytest.mark.parametrize(
    ("number", "name"), [(dialect.MAVLINK_MSG_ID_ODOMETRY, "w"), (dialect.MAVLINK_MSG_ID_STATUSTEXT, "text")]
)
def test_what_is_no_number_of_a_message_can_not_be_read(number: int, name: str) -> None:
    with pytest.raises(ValueError, match=name):
        reader(number, name)
