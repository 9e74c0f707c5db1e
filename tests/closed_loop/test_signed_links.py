"""A signed flight under attack on its MAVLink link, from both sides of it, is the same flight bit for bit.

The intruder writes into the link itself, as one who knows the ports and can forge addresses.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import development as mav

from sitl.lockstep import Lockstep
from swarmctl.core.types import FlightMode
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.signing.key_file import write_new_key
from swarmctl.mavlink.signing.signature import SigningKey, sign, stamp_at
from swarmctl.mavlink.transport import PipeTransport
from tests.closed_loop.conftest import Flight, Fly, fly_now, mission_t_s

ALONE = ("swarm.agents=1", "sitl.start=air", "mission.duration_s=30", "agent.rate_hz=25", "sitl.physics_hz=100")
ATTACKED_S = (0.5, 0.8)
END_S = 1.2
REPLAYED = 10  # frames of each side
FORCED = 21196.0
OWN_MODE, LAND = 1, (4, 6)  # flags and mode of DO_SET_MODE


def command(number: int, *params: float) -> mav.MAVLink_command_long_message:
    return mav.MAVLink_command_long_message(1, 1, number, 0, *params, *[0.0] * (7 - len(params)))


LIES_TO_THE_VEHICLE = [
    command(mav.MAV_CMD_DO_SET_MODE, OWN_MODE, *LAND),
    mav.MAVLink_set_attitude_target_message(0, 1, 1, 7, [0.9, 0.4, 0.0, 0.0], 0.0, 0.0, 0.0, 0.9),
    command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 0.0, FORCED),
]
LIES_TO_THE_AGENT = [
    mav.MAVLink_heartbeat_message(2, 12, 0, FlightMode.HOLD, 4, 3),
    mav.MAVLink_local_position_ned_message(2**31, 50.0, 50.0, -50.0, 0.0, 0.0, 0.0),
    mav.MAVLink_command_ack_message(mav.MAV_CMD_COMPONENT_ARM_DISARM, 4, 0, 0, 1, 191),
]


class Tap:
    """Records what both sides say, and writes into the link under their names."""

    def __init__(self, running: Lockstep) -> None:
        self._running = running
        self._ends = running.links[0]  # the agent's, the vehicle's
        self.heard: tuple[list[bytes], list[bytes]] = ([], [])  # from the agent, from the vehicle
        for end, said in zip(self._ends, self.heard, strict=True):
            self._listen(end, said)

    def _listen(self, end: PipeTransport, said: list[bytes]) -> None:
        send = end.send

        def tapped(data: bytes) -> None:
            said.append(data)
            send(data)

        end.send = tapped  # type: ignore[method-assign]
        self.say = {**getattr(self, "say", {}), id(end): send}

    def attack(self) -> None:
        """Send forged and recorded frames to both sides: unsigned, signed with another key, and replayed."""
        foreign, stamp = SigningKey(bytes(32)), stamp_at(self._running.clock.utc_us()) + 10_000
        names = (Codec(1, 191), Codec(1, 1))
        for end, codec, lies, heard in zip(
            self._ends, names, (LIES_TO_THE_VEHICLE, LIES_TO_THE_AGENT), self.heard, strict=True
        ):
            for lie in lies:
                plain = codec.encode(lie)
                self.say[id(end)](plain)
                self.say[id(end)](sign(plain, foreign, 1, stamp))
            for recorded in heard[-REPLAYED:]:
                self.say[id(end)](recorded)


def flown(fly: Fly, *overrides: str, attacked: bool) -> Flight:
    taps: list[Tap] = []
    act: Callable[[Lockstep], None] = (lambda running: taps[0].attack()) if attacked else lambda running: None
    at = {0.0: lambda running: taps.append(Tap(running)), **dict.fromkeys(ATTACKED_S, act)}
    return fly(*ALONE, *overrides, at=at, until=lambda running: mission_t_s(running) >= END_S)


@pytest.fixture(scope="module")
def key(tmp_path_factory: pytest.TempPathFactory) -> str:
    path: Path = tmp_path_factory.mktemp("keys") / "0.key"
    write_new_key(path)
    return f"mavlink.signing_keys=['{path}']"


def test_an_intruder_on_a_signed_link_changes_nothing_and_is_counted(fly: Fly, key: str) -> None:
    twin = flown(fly_now, key, attacked=False)
    flight = flown(fly, key, attacked=True)
    np.testing.assert_array_equal(flight.pos_ned_m, twin.pos_ned_m)
    agent, signing = flight.lockstep.agents[0], flight.lockstep.world.signing[0]
    assert agent is not None
    rounds, lies = len(ATTACKED_S), len(LIES_TO_THE_AGENT)
    forged, replayed = rounds * lies, rounds * REPLAYED
    assert agent.refused_frames == {"unsigned": forged, "wrong signature": forged, "replayed": replayed}
    assert signing.refused == {"unsigned": forged, "wrong signature": forged, "old": replayed}
    assert agent._publisher.active_alert is not None
    assert agent._publisher.active_alert.text == "frames of the vehicle refused: wrong signature"
    assert flight.event_names(0).count("frames_refused") >= 3
    calm = twin.lockstep.agents[0]
    assert calm is not None
    assert calm.refused_frames == {}
    assert calm._publisher.active_alert is None


def test_negative_control_on_a_plain_link_the_intruder_ends_the_flight(fly: Fly) -> None:
    flight = flown(fly, attacked=True)
    assert not flight.lockstep.world.autopilots[0].armed
