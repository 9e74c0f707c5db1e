"""Signatures of the simulated autopilots: as PX4 sets them up, and what they take; pymavlink is the other side."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal

import pytest
from pymavlink.dialects.v20 import development as mav

from sitl.world import SitlWorld
from swarmctl.core.clock import SimClock
from swarmctl.mavlink.framing import frames
from swarmctl.mavlink.signing.signature import STAMPS_PER_S, SigningKey, is_signed, origin
from swarmctl.mavlink.transport import pipe_pair
from swarmctl.simulator_config import SimulatorConfig

SECRET, NEXT_SECRET = bytes(range(32)), bytes(range(1, 33))
START = 1_000_000 * STAMPS_PER_S
VERSION = (mav.MAV_CMD_REQUEST_MESSAGE, mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
STEP_US = 20_000


class Ground:
    """One simulated vehicle in the air, and a station that talks to it by pymavlink."""

    def __init__(self, kind: Literal["px4", "arducopter"] = "px4", secret: bytes | None = None) -> None:
        self.clock = SimClock()
        self.end, far = pipe_pair(self.clock.now_us)
        config = SimulatorConfig(vehicles=1, autopilot_kind=kind, preset="x500", ekf_ready_s=0.1, physics_hz=50)
        self.world = SitlWorld(config, [far], keys=[SigningKey(secret)] if secret else [])
        self.mav = mav.MAVLink(None, srcSystem=255, srcComponent=190)
        self.mav.signing.timestamp, self.mav.signing.link_id = START, 3
        self.told: list[str] = []

    def sign(self, secret: bytes | None) -> None:
        self.mav.signing.secret_key, self.mav.signing.sign_outgoing = secret, secret is not None

    def send(self, message: Any) -> None:
        self.end.send(bytes(message.pack(self.mav)))

    def step(self, seconds: float) -> list[bytes]:
        for _ in range(round(seconds * 1e6 / STEP_US)):
            self.clock.advance(STEP_US)
            self.world.step(self.clock.now_us())
        sent = [frame for datagram in self.end.receive(self.clock.now_us()) for frame in frames(datagram.data)]
        for frame in sent:
            if frame[7] == mav.MAVLINK_MSG_ID_STATUSTEXT:
                self.told.append(mav.MAVLink(None).decode(bytearray(frame)).text)
        return sent

    def set_up(self, secret: bytes, stamp: int = START) -> None:
        self.send(mav.MAVLink_setup_signing_message(1, 1, secret, stamp))
        self.step(0.1)

    def answers(self, command: tuple[int, int] = VERSION) -> bool:
        """Return whether the vehicle acknowledges a command; it always sends something else beside."""
        self.send(mav.MAVLink_command_long_message(1, 1, command[0], 0, command[1], *[0] * 6))
        return any(frame[7] == mav.MAVLINK_MSG_ID_COMMAND_ACK for frame in self.step(0.1))

    @property
    def refused(self) -> dict[str, int]:
        return dict(self.world.signing[0].refused)

    def texts(self) -> list[str]:
        """Return the texts since the last call; PX4 sends them to ground stations only."""
        self.send(mav.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
        self.step(0.3)
        told, self.told = self.told, []
        return told


@pytest.fixture
def ground() -> Iterator[Ground]:
    made = Ground()
    made.step(3.0)
    yield made


def test_without_a_key_everything_passes_signed_or_not(ground: Ground) -> None:
    assert ground.answers()
    ground.sign(SECRET)
    assert ground.answers()
    assert not any(map(is_signed, ground.step(0.2)))
    assert not ground.refused


def test_a_key_is_set_up_unsigned_once_and_then_by_signed_messages_only(ground: Ground) -> None:
    ground.set_up(SECRET)
    assert ground.texts()[-1:] == ["MAVLink signing key accepted"]
    assert all(map(is_signed, ground.step(0.2)))
    assert not ground.answers()
    ground.set_up(NEXT_SECRET)
    assert ground.refused == {"unsigned": 2}
    ground.sign(SECRET)
    assert ground.answers()
    ground.set_up(NEXT_SECRET, START + 50)
    assert not ground.answers()
    ground.sign(NEXT_SECRET)
    assert ground.answers()
    assert ground.refused == {"unsigned": 2, "wrong signature": 1}


def test_pymavlink_takes_every_frame_of_the_vehicle(ground: Ground) -> None:
    ground.set_up(SECRET)
    ground.sign(SECRET)
    ground.send(mav.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    ground.step(0.1)
    for frame in ground.step(0.5):
        if frame[7:10] != (411).to_bytes(3, "little"):  # not in pymavlink's dialect
            ground.mav.decode(bytearray(frame))
    assert ground.mav.signing.goodsig_count > 100
    assert ground.mav.signing.badsig_count == 0


def test_zeros_remove_the_key_only_when_they_are_signed(ground: Ground) -> None:
    ground.set_up(SECRET)
    ground.set_up(bytes(32), 0)
    assert ground.refused == {"unsigned": 1}
    assert all(map(is_signed, ground.step(0.2)))
    ground.sign(SECRET)
    ground.set_up(bytes(32), 0)
    assert not any(map(is_signed, ground.step(0.2)))


@pytest.mark.parametrize("kind", ["px4", "arducopter"])
def test_set_up_is_refused_while_armed(kind: Literal["px4", "arducopter"]) -> None:
    ground = Ground(kind)
    ground.step(3.0)
    ground.world.signing[0].armed = lambda: True
    ground.set_up(SECRET)
    assert not any(map(is_signed, ground.step(0.2)))
    assert ground.texts()[-1:] == [
        {"px4": "MAVLink signing: rejected while armed", "arducopter": "ERROR: Won't setup signing when armed"}[kind]
    ]
    ground.world.signing[0].armed = lambda: False
    ground.set_up(SECRET)
    assert all(map(is_signed, ground.step(0.2)))


def test_another_vehicles_set_up_is_ignored(ground: Ground) -> None:
    ground.send(mav.MAVLink_setup_signing_message(2, 1, SECRET, START))
    assert not any(map(is_signed, ground.step(0.2)))


def test_what_each_autopilot_takes_unsigned() -> None:
    messages = [
        mav.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3),
        mav.MAVLink_radio_status_message(*[1] * 7),
        mav.MAVLink_ping_message(1, 1, 0, 0),
    ]
    for kind, refused in (("px4", 1), ("arducopter", 2)):
        ground = Ground(kind, SECRET)  # type: ignore[arg-type]
        ground.step(3.0)
        for message in messages:
            ground.send(message)
        ground.step(0.1)
        assert ground.refused == {"unsigned": refused}, kind


def test_time_stamps_follow_the_newest_received_and_old_ones_are_refused() -> None:
    ground = Ground(secret=SECRET)
    assert [origin(frame)[1] for frame in ground.step(3.0)][-1] < STAMPS_PER_S, "it has no clock"
    ground.sign(SECRET)
    assert ground.answers()
    assert next(origin(frame)[1] for frame in ground.step(0.1)) > START
    ground.mav.signing.timestamp = START
    assert not ground.answers(), "not newer on its link"
    ground.mav.signing.timestamp, ground.mav.signing.link_id = START - 61 * STAMPS_PER_S, 4
    assert not ground.answers(), "a new link that lags by more than a minute"
    ground.mav.signing.timestamp = START - 59 * STAMPS_PER_S
    assert ground.answers()
    assert ground.refused == {"old": 2}


def test_a_rebooted_autopilot_begins_with_the_time_stamp_of_its_key(ground: Ground) -> None:
    ground.set_up(SECRET, START - 5_000)
    ground.sign(SECRET)
    assert ground.answers()
    ground.world.reboot(0, ground.clock.now_us())
    ground.end.receive(ground.clock.now_us() + STEP_US)
    frame = ground.step(2.0)[0]
    assert START - 5_000 < origin(frame)[1] < START
