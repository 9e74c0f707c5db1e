"""The suite judges: an autopilot that answers wrongly fails rows, and every kind of step can fail."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from swarmctl.mavlink.codec import Codec
from tests.conformance import vocabulary as v
from tests.conformance.dialogue import Deviation, Dialogue
from tests.conformance.partners import InProcess, Tamper, TamperedLink
from tests.conformance.player import Player
from tests.conformance.rows import DEVIATIONS, ROWS
from tests.conformance.rows_streams import STREAMS
from tests.conformance.test_streams import WATCH_S, expected
from tests.conformance.verifier import command_message

BY_NAME = {row.name: row for row in ROWS}
Change = Callable[[Any], Any]


def altered(kind: str, **fields: Change) -> Tamper:
    """Frames of a kind with some fields changed, packed again with a right checksum; others as they are."""
    codec = Codec(1, 1)

    def tamper(frame: bytes) -> list[bytes]:
        message = codec.decode(frame)
        if message is None or message.get_type() != kind:
            return [frame]
        for name, change in fields.items():
            setattr(message, name, change(getattr(message, name)))
        values = [getattr(message, name) for name in message.fieldnames]
        return [codec.encode(type(message)(*[x.encode() if isinstance(x, str) else x for x in values]))]

    return tamper


def without(kind: str) -> Tamper:
    codec = Codec(1, 1)
    return lambda frame: [] if getattr(codec.decode(frame), "msgname", "") == kind else [frame]


class Lying(InProcess):
    """The simulator behind a link that modifies its frames once a row has begun."""

    def lie(self, tamper: Tamper) -> None:
        self.links = {name: TamperedLink(link, tamper) for name, link in self.links.items()}


def verdict(row: v.Row, tamper: Tamper) -> str:
    partner = Lying()
    player = Player(Dialogue(partner))
    player.prepare(row)
    partner.lie(tamper)
    try:
        player.play_steps(row)
    except Deviation as deviation:
        return str(deviation)
    return ""


LIES: tuple[tuple[str, Tamper], ...] = (
    ("an unknown command", altered("COMMAND_ACK", result=lambda r: 2)),
    ("an unknown command", altered("COMMAND_ACK", target_component=lambda c: c + 1)),
    ("an unknown command", altered("COMMAND_ACK", result_param2=lambda p: 7)),
    ("an unknown command", without("COMMAND_ACK")),
    ("ARM armed is accepted", altered("HEARTBEAT", base_mode=lambda b: b & ~128)),
    ("LOITER, armable", altered("HEARTBEAT", system_status=lambda s: 4)),
    ("LOITER, armable", altered("HEARTBEAT", custom_mode=lambda m: 0x00060000)),
    ("arming says so", altered("STATUSTEXT", text=lambda t: t.rstrip("\t"))),
    ("arming says so", altered("STATUSTEXT", severity=lambda s: 4)),
    ("arming says so", without("STATUSTEXT")),
    ("stream stops, COM_OBL_RC_ACT 5 Hold", altered("CURRENT_MODE", intended_custom_mode=lambda m: 0x03040000)),
    ("OFFBOARD comes back by itself, 1 s into RTL", altered("CURRENT_MODE", custom_mode=lambda m: 0x05040000)),
    ("COM_OF_LOSS_T 0.5", without("CURRENT_MODE")),
    ("integers travel bytewise, there and back", altered("PARAM_VALUE", param_value=lambda x: 5.0)),
    ("writing an unknown name", altered("PARAM_ERROR", error=lambda e: 2)),
    ("AUTOPILOT_VERSION on request", altered("AUTOPILOT_VERSION", capabilities=lambda c: c ^ 1)),
    ("SYS_STATUS, armable", altered("SYS_STATUS", onboard_control_sensors_health=lambda h: h ^ 32)),
    ("ODOMETRY is NED in position and velocity", altered("ODOMETRY", child_frame_id=lambda f: 12)),
    ("TIMESYNC is answered with nanoseconds since boot", altered("TIMESYNC", ts1=lambda t: t + 1)),
    ("an interval on request: ODOMETRY at 100 Hz", without("ODOMETRY")),
    ("60 degrees are followed", altered("ATTITUDE", roll=lambda r: r * 0.7)),
    ("hover thrust in LOITER", altered("ATTITUDE_TARGET", thrust=lambda t: t + 0.02)),
    ("GPS_GLOBAL_ORIGIN on request, the default place", altered("GPS_GLOBAL_ORIGIN", latitude=lambda e7: e7 + 100)),
)


@pytest.mark.parametrize(("name", "lie"), LIES, ids=[f"{i}: {name}" for i, (name, _) in enumerate(LIES)])
def test_a_wrong_answer_fails_the_row(name: str, lie: Tamper) -> None:
    assert name not in DEVIATIONS
    assert verdict(BY_NAME[name], lambda frame: [frame]) == "", "control: untouched it passes"
    assert verdict(BY_NAME[name], lie)


@pytest.mark.parametrize("row", [row for row in ROWS if row.start is v.State.ARMABLE][:40:8], ids=lambda row: row.name)
def test_a_silent_autopilot_fails_every_row(row: v.Row) -> None:
    assert verdict(row, lambda frame: [])


def expects(step: v.Step) -> bool:
    """Whether the step can't be met by saying nothing."""
    return isinstance(step, v.EXPECTATIONS) and getattr(step, "ack", 0) != v.NO_ACK


def test_no_row_is_met_by_a_dead_autopilot() -> None:
    assert not [row.name for row in ROWS if not any(expects(step) for step in row.steps)]


def test_a_wrong_default_rate_is_seen() -> None:
    """Counted as in `test_streams`, with ATTITUDE made 10 % slower."""
    partner = InProcess()
    dialogue = Dialogue(partner)
    dialogue.run_until(lambda: bool(dialogue.sysid), 2.0)
    command = v.Command(number=v.SET_INTERVAL, params=(30, 11_000))
    dialogue.send(command_message(command))
    dialogue.run(1.0)
    before = dialogue.counts()
    dialogue.run(WATCH_S)
    found = (dialogue.counts()[v.OFFBOARD_LINK] - before[v.OFFBOARD_LINK])[30]
    assert found != expected(STREAMS[0], v.OFFBOARD_LINK, 0.0)
    assert found == pytest.approx(WATCH_S * 1e6 / 11_000, abs=5)


def test_names_are_unique_and_there_are_enough() -> None:
    assert len(BY_NAME) == len(ROWS) >= 80
    assert set(DEVIATIONS) <= set(BY_NAME)
