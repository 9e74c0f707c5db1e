"""Checks of vehicles that sign: scans over signed links, what is said of refused frames, and keys given to vehicles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import pytest
from pymavlink.dialects.v20 import development as mav

from sitl.world import SitlWorld
from swarmctl.check.scan.listener import Address, ReceivedDatagram
from swarmctl.check.scan.scan_facts import facts_of
from swarmctl.check.scan.scanner import SCANNER_COMPID, VehicleScan
from swarmctl.check.scan.signed_listener import SignedListener
from swarmctl.check.vehicle.findings import vehicle_findings
from swarmctl.config import load
from swarmctl.core.clock import SimClock
from swarmctl.core.types import GeoOrigin
from swarmctl.core.verdict import Verdict
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.signing.channel import CHECK_LINK, SigningChannel
from swarmctl.mavlink.signing.recognition import SignedRecognition
from swarmctl.mavlink.signing.signature import SigningKey, is_signed
from swarmctl.mavlink.transport import pipe_pair
from swarmctl.ops.vehicles.key_install import Installation
from swarmctl.simulator_config import SimulatorConfig

VEHICLE = ("10.0.0.1", 14580)
KEY, OLD_KEY = SigningKey(bytes(range(32))), SigningKey(bytes(range(1, 33)))
STEP_US = 20_000
Kind = Literal["px4", "arducopter"]


class PipeListener:
    """The ground's end of a pipe to a simulated vehicle."""

    refused = None

    def __init__(self, kind: Kind, key: SigningKey | None) -> None:
        self.dropped = 0
        self.clock = SimClock()
        self._end, far = pipe_pair(self.clock.now_us)
        config = SimulatorConfig(vehicles=1, autopilot_kind=kind, preset="x500", ekf_ready_s=0.1, physics_hz=50)
        self.world = SitlWorld(config, [far], keys=[] if key is None else [key])
        self.sent: list[bytes] = []

    def receive(self) -> list[ReceivedDatagram]:
        return [ReceivedDatagram(d.t_us, d.data, VEHICLE) for d in self._end.receive(self.clock.now_us())]

    def send(self, data: bytes, to: Address) -> None:
        assert to == VEHICLE
        self.sent.append(data)
        self._end.send(data)

    def fd(self) -> int | None:
        return None

    def close(self) -> None:
        return

    def run(self, seconds: float, act: Callable[[int], None]) -> None:
        for _ in range(round(seconds * 1e6 / STEP_US)):
            self.clock.advance(STEP_US)
            self.world.step(self.clock.now_us())
            act(self.clock.now_us())


def scanned(kind: Kind, vehicle_key: SigningKey | None, own_key: SigningKey | None) -> tuple[Any, PipeListener]:
    """Return the facts of a vehicle with one key after a scan with another, and the link."""
    link = PipeListener(kind, vehicle_key)
    listener: Any = link
    if own_key is not None:
        channel = SigningChannel(own_key, CHECK_LINK, link.clock.utc_us)
        vehicle = SignedRecognition(channel, 1, SCANNER_COMPID, link.clock.utc_us)
        listener = SignedListener(link, channel, vehicle)
    scan = VehicleScan(listener, ("", 0), 1, lambda _: ("SYSID_THISMAV", "MAV_SYS_ID"), seconds=1.0)
    link.run(4.0, scan.step)
    shared = GeoOrigin(47.397742, 8.545594, 489.4)
    return facts_of(scan, 0, "udpin://0.0.0.0:1", 1, shared=shared, now_us=link.clock.now_us()), link


@pytest.mark.parametrize("kind", ["px4", "arducopter"])
def test_a_vehicle_that_signs_is_greeted_scanned_and_answers(kind: Kind) -> None:
    facts, link = scanned(kind, KEY, KEY)
    assert not facts.unreachable
    assert any(parameter.value == 1 for parameter in facts.parameters.values()), "a parameter was asked for and told"
    assert all(map(is_signed, link.sent))
    assert not link.world.signing[0].refused
    [line] = [finding for finding in vehicle_findings(facts, load(None)) if finding.topic == "signing"]
    assert (line.verdict, line.found) == (Verdict.OK, "signed")
    disturbed = replace(facts, link=replace(facts.link, refused={"old": 9, "unsigned": 2, "wrong signature": 1}))
    [line] = [finding for finding in vehicle_findings(disturbed, load(None)) if finding.topic == "signing"]
    assert (line.verdict, line.found) == (Verdict.NOTE, "signed, 2 unsigned, 1 wrong signature refused")


@pytest.mark.parametrize(("key", "reason"), [(None, "unsigned"), (OLD_KEY, "wrong signature")])
def test_a_vehicle_without_the_key_is_not_believed_and_the_finding_says_so(key: SigningKey | None, reason: str) -> None:
    facts, link = scanned("px4", key, KEY)
    assert facts.unreachable.startswith("frames are refused: ")
    assert reason in facts.unreachable
    [line] = vehicle_findings(facts, load(None))
    assert "swarmctl keys install" in line.advice
    assert link.sent == [], "nothing is sent to who has not shown the key"


def test_negative_control_a_scan_without_the_key_believes_a_vehicle_that_does_not_answer_it() -> None:
    facts, link = scanned("px4", KEY, None)
    assert not facts.unreachable
    assert all(parameter.value is None for parameter in facts.parameters.values())
    assert link.world.signing[0].refused["unsigned"] > 0


# -- keys given to vehicles -------------------------------------------------------------------------------------------


def installed(
    kind: Kind, has: SigningKey | None, old: tuple[SigningKey, ...] = ()
) -> tuple[Installation, PipeListener]:
    link = PipeListener(kind, has)
    channel = SigningChannel(KEY, CHECK_LINK, link.clock.utc_us)
    installation = Installation(link, ("", 0), 1, channel=channel, key=KEY, old_keys=old)
    link.run(5.0, installation.step)
    return installation, link


@pytest.mark.parametrize("kind", ["px4", "arducopter"])
@pytest.mark.parametrize(
    ("has", "old"), [(None, ()), (OLD_KEY, (OLD_KEY,)), (KEY, ())], ids=["no key", "another key", "the key already"]
)
def test_a_vehicle_is_given_its_key_and_seen_to_sign(kind: Kind, has: SigningKey | None, old: Any) -> None:
    installation, link = installed(kind, has, old)
    assert installation.done
    assert (installation.problem, installation.reached) == ("", True)
    key = link.world.signing[0].key
    assert key is not None
    assert key.secret == KEY.secret
    in_clear = [frame for frame in link.sent if KEY.secret[:31] in frame]
    assert len(in_clear) <= 1, "the key is told once, and not to a vehicle that has it"


def test_a_vehicle_with_an_unknown_key_is_not_given_another() -> None:
    installation, link = installed("px4", OLD_KEY)
    assert "another key" in installation.problem
    assert not [frame for frame in link.sent if KEY.secret[:31] in frame]


def test_an_armed_vehicle_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    link = PipeListener("px4", None)
    channel = SigningChannel(KEY, CHECK_LINK, link.clock.utc_us)
    installation = Installation(link, ("", 0), 1, channel=channel, key=KEY, old_keys=())

    def beats(_: int) -> None:
        beat = mav.MAVLink_heartbeat_message(2, 12, 128, 0, 4, 3)
        received = ReceivedDatagram(0, Codec(1, 1).encode(beat), VEHICLE)
        with monkeypatch.context() as patch:
            patch.setattr(link, "receive", lambda: [received])
            installation.step(link.clock.now_us())

    link.run(3.0, beats)
    assert installation.problem == "it is armed; disarm it first"
    assert installation.reached
    assert link.sent
    assert not [frame for frame in link.sent if KEY.secret[:31] in frame]


def test_a_link_on_which_nothing_is_heard_is_not_reached() -> None:
    link = PipeListener("px4", None)
    channel = SigningChannel(KEY, CHECK_LINK, link.clock.utc_us)
    installation = Installation(link, ("", 0), 1, channel=channel, key=KEY, old_keys=())
    installation.step(0)
    assert not installation.reached
    assert "no heartbeat" in installation.problem
    assert not link.sent
