"""Command port on MAVSDK, over the same frames as the tick's: accepted answers, and the dialect of requests."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from sitl.world import SitlWorld
from swarmctl.core.clock import SimClock
from swarmctl.core.types import Command, FlightMode, GeoOrigin, Verb
from swarmctl.mavlink.autopilot import Autopilot
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.commands import OWN_COMPID, CommandResult
from swarmctl.mavlink.mavsdk_commands import MavsdkCommands
from swarmctl.mavlink.transport import pipe_pair
from swarmctl.simulator_config import SimulatorConfig


class Bench:
    """A simulated ArduCopter and MAVSDK beside it; simulated time runs about ten times as fast as MAVSDK's."""

    def __init__(self) -> None:
        self.clock = SimClock()
        ours, vehicles = pipe_pair(self.clock.now_us)
        params = SimulatorConfig(vehicles=1, autopilot_kind="arducopter")
        self.world = SitlWorld(params, [vehicles])
        origin = GeoOrigin(params.origin_lat_deg, params.origin_lon_deg, params.origin_alt_m)
        self.pilot = Autopilot(ours, Codec(1, OWN_COMPID), 1, origin, lambda frame: None)
        self.port = MavsdkCommands(self.pilot.send_frame, 1, lambda: self.pilot.dialect)
        self.pilot.attach(self.port)

    def ask(self, *commands: Command) -> list[CommandResult]:
        """All answers to some commands."""
        for command in commands:
            self.port.request(command)
        answers: list[CommandResult] = []
        deadline_s = time.monotonic() + 15.0
        while self.port.busy and time.monotonic() < deadline_s:
            self.tick()
            answers += self.port.results()
            time.sleep(0.002)
        return answers

    def tick(self) -> None:
        """20 ms."""
        for _ in range(5):
            self.clock.advance(4_000)
            self.world.step(self.clock.now_us())
        self.pilot.poll(self.clock.now_us())
        self.port.step(self.clock.now_us())


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    made = Bench()
    for _ in range(150):  # booting, it goes back to STABILIZE
        made.tick()
    yield made
    made.port.close()


def test_answers_are_the_autopilots_own(bench: Bench) -> None:
    mode, rate, nonsense = bench.ask(
        Command(verb=Verb.EXTERNAL),
        Command(verb=Verb.RATE, value=20.0, number=31),
        Command(verb=Verb.RATE, value=5.0, number=9999),
    )
    assert (mode.ok, rate.ok) == (True, True)
    assert nonsense == CommandResult(Command(verb=Verb.RATE, value=5.0, number=9999), False, "result 2"), (
        "any answer is MAVSDK's success"
    )
    assert bench.pilot.mode is FlightMode.EXTERNAL, "GUIDED, not PX4's OFFBOARD"


def test_parameters_are_what_the_autopilot_stores(bench: Bench) -> None:
    set_it, read = bench.ask(
        Command(verb=Verb.PARAM_INT, number=8, name="GUID_OPTIONS"), Command(verb=Verb.PARAM_GET, name="GUID_OPTIONS")
    )
    assert (set_it.ok, set_it.text, read.text) == (True, "set", "8")
    assert bench.pilot.params["GUID_OPTIONS"] == 8.0
