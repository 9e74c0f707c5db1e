"""200,000 hostile frames change nothing: the vehicle stays, bit for bit, what its untouched twin is."""

from __future__ import annotations

import functools
import itertools
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import development as mav

from sitl.world import SitlWorld
from swarmctl.core.clock import SimClock
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.framing import frames
from swarmctl.mavlink.transport import pipe_pair
from swarmctl.simulator_config import SimulatorConfig
from tests.benches.hostile import Hostile

FRAMES = 200_000
SEEDS = (1, 2, 3, 4)
PLACES = ("ground", "offboard", "loiter")
PER_RUN = -(-FRAMES // (len(SEEDS) * len(PLACES)))
PER_STEP = 20  # 5000 a second, 20 times the 250 a second of a busy agent
STEP_US = 4000
DEAD_STEPS = 50  # a setpoint may take that long to show in the motion
LOITER, OFFBOARD = (4.0, 3.0), (6.0, 0.0)
QUEUE_LIMIT = 4096
HOVER_01 = 0.4905


class Vehicle:
    """One simulated vehicle and the client it obeys."""

    def __init__(self) -> None:
        self.clock = SimClock()
        vehicle_end, self.link = pipe_pair(self.clock.now_us)
        self.world = SitlWorld(SimulatorConfig(vehicles=1, preset="x500", ekf_ready_s=0.1, seed=5), [vehicle_end])
        self.codec = Codec(1, 191)
        self.stream_thrust_01: float | None = None
        self.received: list[bytes] = []

    def step(self, hostile: Sequence[bytes] = ()) -> None:
        if self.stream_thrust_01 is not None and self.clock.now_us() % 20_000 == 0:
            self.say(mav.MAVLink_set_attitude_target_message(0, 1, 1, 7, [1, 0, 0, 0], 0, 0, 0, self.stream_thrust_01))
        for data in hostile:
            self.link.send(data)
        self.clock.advance(STEP_US)
        self.world.step(self.clock.now_us())
        self.received = [d.data for d in self.link.receive(self.clock.now_us())]

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 1e6 / STEP_US)):
            self.step()

    def say(self, message: Any) -> None:
        self.link.send(self.codec.encode(message))

    def order(self, command: int, *params: float) -> int | None:
        """Give an order; its result."""
        self.say(mav.MAVLink_command_long_message(1, 1, command, 0, *params, *[0.0] * (7 - len(params))))
        answers: list[Any] = []
        for _ in range(3):
            self.step()
            answers += [self.codec.decode(f) for data in self.received for f in frames(data)]
        acks = [m.result for m in answers if m is not None and m.get_type() == "COMMAND_ACK" and m.command == command]
        return acks[0] if acks else None

    def go(self, place: str) -> Vehicle:
        self.run(0.5)
        if place != "ground":
            self.stream_thrust_01 = 0.7
            self.step()
            self.run(0.1)
            assert self.order(400, 1.0) == 0
            assert self.order(176, 1.0, *OFFBOARD) == 0
            self.run(1.0)
            self.stream_thrust_01 = HOVER_01
            self.run(0.5)
        if place == "loiter":
            assert self.order(176, 1.0, *LOITER) == 0
            self.stream_thrust_01 = None
            self.run(1.0)
        return self

    def truth(self) -> bytes:
        """Mode, arming, landed state, attitude, position and velocity."""
        rows: bytes = self.world.truth_rows().tobytes()
        return rows


@functools.cache
def untouched(place: str) -> tuple[bytes, ...]:
    """Return the truth of an equal vehicle to which nothing hostile is sent, at `place` and after each further step."""
    twin = Vehicle().go(place)
    truths = [twin.truth()]
    for _ in range(-(-PER_RUN // PER_STEP)):
        twin.step()
        truths.append(twin.truth())
    return tuple(truths)


def attack(victim: Vehicle, twin: Sequence[bytes], hostile: Iterator[bytes], count: int) -> None:
    """Send `count` hostile datagrams to one of two equal vehicles; fails at the first step that tells them apart."""
    assert victim.truth() == twin[0]
    recent: deque[bytes] = deque(maxlen=PER_STEP * DEAD_STEPS)
    for step in range(1, 1 - (-count // PER_STEP)):
        sent = list(itertools.islice(hostile, PER_STEP))
        recent.extend(sent)
        victim.step(sent)
        if victim.truth() != twin[step]:
            listed = "\n".join(data.hex() for data in recent)
            pytest.fail(f"at {victim.clock.now_us()} us {victim.world.truth_rows()} after one of\n{listed}")


def containers(thing: Any, seen: set[int], depth: int = 6) -> Iterator[tuple[str, int]]:
    """(where, length) of everything that can grow, from an object downwards."""
    if id(thing) in seen or depth < 0 or isinstance(thing, type | str | bytes | np.ndarray):
        return
    seen.add(id(thing))
    children: dict[Any, Any] = {}
    if isinstance(thing, dict):
        children = thing
    elif isinstance(thing, list | tuple | set | frozenset) or hasattr(thing, "popleft"):
        children = dict(enumerate(itertools.islice(thing, 64)))
    elif type(thing).__module__.split(".")[0] in ("sitl", "swarmctl"):
        names = [*getattr(thing, "__dict__", {}), *getattr(type(thing), "__slots__", ())]
        children = {name: getattr(thing, name, None) for name in names}
    if hasattr(thing, "__len__"):
        yield type(thing).__name__, len(thing)
    for name, child in list(children.items()):
        for where, length in containers(child, seen, depth - 1):
            yield f"{name}.{where}", length


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("place", PLACES)
def test_hostile_frames_change_nothing(place: str, seed: int) -> None:
    victim = Vehicle().go(place)
    attack(victim, untouched(place), iter(Hostile(seed, sysid=1)), PER_RUN)
    longest = max(containers(victim.world, set()), key=lambda found: found[1])
    assert longest[1] <= QUEUE_LIMIT, longest
    still_obeys(victim, place)


def still_obeys(vehicle: Vehicle, place: str) -> None:
    """A normal dialogue afterwards: parameter, ping, arming or landing."""
    vehicle.run(0.2)
    vehicle.say(mav.MAVLink_param_request_read_message(1, 1, b"COM_OF_LOSS_T", -1))
    vehicle.step()
    answers = [vehicle.codec.decode(f) for data in vehicle.received for f in frames(data)]
    assert [m.param_value for m in answers if m is not None and m.get_type() == "PARAM_VALUE"] == [1.0]
    if place == "ground":
        assert vehicle.order(400, 1.0) == 0
        assert vehicle.world.truth_rows()["armed"][0]
    else:
        assert vehicle.order(400, 0.0) == 1, "disarming in the air is refused"
        assert vehicle.order(21) == 0
        vehicle.run(0.5)
        assert vehicle.world.truth_rows()["vel_ned_m_s"][0, 2] > 0.1, "it lands"


ORDERS: dict[str, Callable[[], Any]] = {
    "ground": lambda: mav.MAVLink_command_long_message(1, 1, 400, 0, 1.0, *[0.0] * 6),
    "offboard": lambda: mav.MAVLink_set_attitude_target_message(0, 1, 1, 7, [0.9998, 0.02, 0, 0], 0, 0, 0, HOVER_01),
    "loiter": lambda: mav.MAVLink_command_long_message(1, 1, 176, 0, 1.0, 4.0, 6.0, 0, 0, 0, 0),
}


@pytest.mark.parametrize("place", PLACES)
def test_negative_control_one_valid_order_among_them_is_noticed(place: str) -> None:
    victim = Vehicle().go(place)
    order = victim.codec.encode(ORDERS[place]())
    stream = itertools.chain(itertools.islice(Hostile(9, 1), 500), [order], Hostile(10, 1))
    with pytest.raises(pytest.fail.Exception, match=order.hex()):
        attack(victim, untouched(place), stream, 2000)


def test_negative_control_a_queue_that_grows_is_found() -> None:
    vehicle = Vehicle()
    for _ in range(QUEUE_LIMIT + 1):
        vehicle.link.send(b"\xfd")
    assert max(length for _, length in containers(vehicle.world, set())) > QUEUE_LIMIT


def test_the_same_seed_gives_the_same_datagrams() -> None:
    first, second, other = (list(itertools.islice(Hostile(seed, 1), 500)) for seed in (1, 1, 2))
    assert first == second != other
