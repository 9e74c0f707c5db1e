"""50,000 hostile frames never change what the bridge believes of its vehicle."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import development as mav

from sitl.world import SitlWorld
from swarmctl.core.clock import SimClock
from swarmctl.core.types import GeoOrigin
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.transport import PipeTransport, pipe_pair
from swarmctl.mavlink.vehicle.autopilot import Autopilot
from swarmctl.simulator_config import SimulatorConfig
from tests.benches.hostile import POISON, Hostile, frame_of

FRAMES = 50_000
SEEDS = (1, 2, 3, 4, 5)
SYSID = 1
PER_POLL = 100
POLL_US, STEP_US = 20_000, 4_000
FLIGHT_S = 2.0
LIES = ("HEARTBEAT", "ODOMETRY", "GPS_GLOBAL_ORIGIN", "SYS_STATUS", "EXTENDED_SYS_STATE", "CURRENT_MODE", "STATUSTEXT")


def flight() -> list[list[bytes]]:
    """What a vehicle says in each 20 ms of a take-off: the valid frames of the dialogue."""
    clock = SimClock()
    vehicle_end, ours = pipe_pair(clock.now_us)
    world = SitlWorld(SimulatorConfig(vehicles=1, preset="x500", ekf_ready_s=0.1), [vehicle_end])
    codec = Codec(1, 191)
    said: list[list[bytes]] = []
    for tick in range(round(FLIGHT_S * 1e6 / POLL_US)):
        if tick >= 10:
            ours.send(codec.encode(mav.MAVLink_set_attitude_target_message(0, 1, 1, 7, [1, 0, 0, 0], 0, 0, 0, 0.7)))
        if tick in (15, 16):
            order = (400, 1.0, 0.0) if tick == 15 else (176, 1.0, 6.0)
            ours.send(codec.encode(mav.MAVLink_command_long_message(1, 1, order[0], 0, *order[1:], *[0.0] * 5)))
        for _ in range(POLL_US // STEP_US):
            clock.advance(STEP_US)
            world.step(clock.now_us())
        said.append([d.data for d in ours.receive(clock.now_us())])
    assert world.truth_rows()["armed"][0]
    return said


class Listener:
    """The bridge's receiver on a link we write to."""

    def __init__(self) -> None:
        self.clock = SimClock()
        near_end, self.wire = pipe_pair(self.clock.now_us)
        self.recorded = 0
        origin = GeoOrigin(47.397742, 8.545594, 489.4)
        self.autopilot = Autopilot(near_end, Codec(1, 191), SYSID, origin, on_frame=self._count)
        self.transport: PipeTransport = near_end

    def _count(self, _: bytes) -> None:
        self.recorded += 1

    def hear(self, data: list[bytes]) -> str:
        """Receive these frames; return everything the bridge then believes, as text."""
        for datagram in data:
            self.wire.send(datagram)
        self.clock.advance(POLL_US)
        return f"{self.autopilot.poll(self.clock.now_us())} {beliefs(self.autopilot)}"


# connections, handlers, and the counter of what was refused
NOT_BELIEFS = frozenset(
    {"_transport", "_codec", "_on_frame", "_slow", "_handlers", "_send_frame", "_on_reboot", "_refused"}
)


def beliefs(thing: Any) -> Any:
    """Everything an object of the bridge keeps, private or not, as plain values."""
    if isinstance(thing, np.ndarray):
        return thing.tolist()
    if type(thing).__module__.startswith("swarmctl") and not isinstance(thing, int):
        names = [*getattr(thing, "__dict__", {}), *getattr(type(thing), "__slots__", ())]
        return {name: beliefs(getattr(thing, name, None)) for name in names if name not in NOT_BELIEFS}
    if isinstance(thing, list | tuple | deque):
        return [beliefs(item) for item in thing]
    if isinstance(thing, dict):
        return {key: beliefs(value) for key, value in thing.items()}
    return thing


class Impostors:
    """Yields hostile frames, and whole ones with plausible content in the name of another sender."""

    def __init__(self, seed: int) -> None:
        self._hostile = iter(Hostile(seed, SYSID))
        self._rng = np.random.default_rng([seed, 29])
        self._numbers = [n for n, cls in mav.mavlink_map.items() if cls.msgname in LIES]

    def __iter__(self) -> Iterator[bytes]:
        return self

    def __next__(self) -> bytes:
        if self._rng.integers(2):
            data = next(self._hostile)
            while len(data) > 6 and (data[5], data[6]) == (SYSID, 1):
                data = next(self._hostile)
            return data
        cls = mav.mavlink_map[self._numbers[int(self._rng.integers(len(self._numbers)))]]
        payload = self._rng.bytes(cls.unpacker.size)
        broken = bool(self._rng.integers(2))
        source = (SYSID, 1) if broken else self._other()
        frame = bytearray(frame_of(cls.id, cls.crc_extra, payload, source))
        if broken:  # in the vehicle's own name, but not whole
            frame[-1] ^= 1 + int(self._rng.integers(255))
        cut = int(self._rng.integers(len(frame))) if self._rng.integers(8) == 0 else len(frame)
        return (POISON if self._rng.integers(8) == 0 else b"") + bytes(frame[:cut])

    def _other(self) -> tuple[int, int]:
        while True:
            source = int(self._rng.integers(0, 4)), int(self._rng.integers(0, 4))
            if source != (SYSID, 1):
                return source


@pytest.fixture(scope="module")
def said() -> list[list[bytes]]:
    return flight()


@pytest.mark.parametrize("seed", SEEDS)
def test_hostile_frames_do_not_change_what_is_believed(seed: int, said: list[list[bytes]]) -> None:
    victim, twin = Listener(), Listener()
    hostile = iter(Impostors(seed))
    assert len(said) * PER_POLL * len(SEEDS) >= FRAMES
    for tick, valid in enumerate(said):
        lies = list(itertools.islice(hostile, PER_POLL))
        mixed = [*lies[: PER_POLL // 2], *valid, *lies[PER_POLL // 2 :]]
        believed, wanted = victim.hear(mixed), twin.hear(valid)
        assert believed == wanted, f"seed {seed}, tick {tick}: one of " + " ".join(data.hex() for data in lies)
    assert victim.recorded == twin.recorded > 500
    assert twin.autopilot.armed


def test_negative_control_one_whole_frame_of_the_vehicle_is_believed(said: list[list[bytes]]) -> None:
    victim, twin = Listener(), Listener()
    for valid in said[:50]:
        assert victim.hear(valid) == twin.hear(valid)
    landing = Codec(SYSID, 1).encode(mav.MAVLink_heartbeat_message(2, 12, 157, 0x06040000, 4, 3))
    assert victim.hear([*said[50], landing]) != twin.hear(said[50])


@pytest.mark.parametrize("field", ["x", "vy", "q", "rollspeed", "time_usec"])
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), 1e38], ids=str)
def test_a_state_that_is_not_finite_is_not_a_state(field: str, bad: float, said: list[list[bytes]]) -> None:
    """Even from the vehicle itself: a filter that diverges must not reach the controller."""
    listener = Listener()
    for valid in said:
        listener.hear(valid)
    codec, before = Codec(SYSID, 1), listener.autopilot.poll(listener.clock.now_us())
    assert before is not None
    values: dict[str, Any] = {"time_usec": 5_000_000, "x": 0.0, "vy": 0.0, "q": [1.0, 0.0, 0.0, 0.0], "rollspeed": 0.0}
    values[field] = [bad] * 4 if field == "q" else 2**63 if field == "time_usec" else bad
    if field == "time_usec":
        values["x"] = bad
    packed = mav.MAVLink_odometry_message(
        values["time_usec"], 1, 1, values["x"], 0.0, 0.0, values["q"], 0.0, values["vy"], 0.0, values["rollspeed"],
        0.0, 0.0, [0.0] * 21, [0.0] * 21,
    )  # fmt: skip
    listener.hear([codec.encode(packed)])
    after = listener.autopilot.poll(listener.clock.now_us())
    assert after is not None
    finite = [*after.pos_ned_m, *after.vel_ned_m_s, *after.q_nb]
    assert np.isfinite(finite).all()
