"""MAVLink interface: addressing, streams, requests, parameters, texts, hostile bytes, local origins, determinism."""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
import pymap3d
import pytest
from pymavlink.dialects.v20 import development as mav

from sitl.plant.sensors import local_origin
from sitl.px4.link.schedule import OFFBOARD_HZ, Schedule
from sitl.px4.parameters import int_from_wire, int_to_wire
from sitl.world import SitlWorld
from swarmctl.configuration.problems import validated
from swarmctl.core.clock import SimClock
from swarmctl.core.types import GeoOrigin
from swarmctl.errors import ConfigError
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.framing import frames
from swarmctl.mavlink.transport import pipe_pair
from swarmctl.simulator_config import SimulatorConfig

ORIGIN = GeoOrigin(47.397742, 8.545594, 489.4)
NAN = math.nan


class Client:
    """The client ends of a world's links."""

    def __init__(self, vehicles: int = 1, run_s: float = 0.2, ekf_ready_s: float = 0.1, **params: Any) -> None:
        self.clock = SimClock()
        pairs = [pipe_pair(self.clock.now_us) for _ in range(vehicles)]
        self.links = [client_end for _, client_end in pairs]
        config = SimulatorConfig(vehicles=vehicles, ekf_ready_s=ekf_ready_s, **params)
        self.world = SitlWorld(config, [vehicle_end for vehicle_end, _ in pairs])
        self.codec = Codec(1, 191)
        self.run(run_s)

    def run(self, seconds: float, vehicle: int = 0) -> list[Any]:
        """Messages of one vehicle during that time."""
        got: list[Any] = []
        for _ in range(round(seconds * 250)):
            self.clock.advance(4000)
            self.world.step(self.clock.now_us())
        for i, link in enumerate(self.links):
            for datagram in link.receive(self.clock.now_us()):
                if i == vehicle:
                    got += [self.codec.decode(f) for f in frames(datagram.data)]
        return [m for m in got if m is not None]  # what the dialect module lacks is test_sitl_wire's

    def ask(self, message: Any, vehicle: int = 0) -> list[Any]:
        self.links[vehicle].send(self.codec.encode(message))
        return self.run(0.004, vehicle)

    def command(self, number: int, *params: float, target: tuple[int, int] = (1, 1)) -> list[Any]:
        padded = [*params, *[0.0] * (7 - len(params))]
        return self.ask(mav.MAVLink_command_long_message(*target, number, 0, *padded))


def of(kind: str, messages: list[Any]) -> list[Any]:
    return [m for m in messages if m.get_type() == kind]


def result(messages: list[Any]) -> int | None:
    acks = of("COMMAND_ACK", messages)
    return acks[0].result if acks else None


# --- addressing ---


def test_heartbeats_keep_their_tick_under_any_traffic() -> None:
    client = Client()
    got = client.ask(mav.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
    assert not of("HEARTBEAT", got)
    assert len(of("HEARTBEAT", client.run(1.0))) == 1


# --- streams ---


@pytest.mark.parametrize("params", [(NAN, 10000), (331, NAN), (math.inf, 1), (331, math.inf)])
def test_impossible_intervals_fail(params: tuple[float, float]) -> None:
    assert result(Client().command(511, *params)) == 4


def test_odometry_samples_lie_on_the_agents_grid() -> None:
    client = Client()
    client.command(511, 331, 20000)
    stamps_us = [m.time_usec for m in of("ODOMETRY", client.run(1.0))]
    assert stamps_us == list(range(220_000, 1_220_000, 20_000))


def test_a_late_schedule_sends_once_and_keeps_its_grid() -> None:
    schedule = Schedule(4000)
    for message in OFFBOARD_HZ:
        schedule.set_interval(message, -1, 0)
    schedule.set_interval(331, 10000, 0)
    assert schedule.take_due(0) == [331]
    assert schedule.take_due(95000) == [331]
    assert schedule.take_due(99000) == []
    assert schedule.take_due(100000) == [331]
    schedule.set_interval(331, 1, 100000)
    assert schedule.interval_us(331) == 4000  # never faster than the physics


def test_odometry_carries_ned_velocity_and_boot_time() -> None:
    client = Client()
    client.world.plant.state[10:13, 0] = 1.0, 2.0, -3.0
    yaw = math.radians(90)
    client.world.plant.state[:4, 0] = math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)
    client.world.plant.state[7, 0] = 2.0  # forward, that is east
    m = of("ODOMETRY", client.run(0.1))[0]
    assert (m.frame_id, m.child_frame_id) == (1, 1)
    assert m.vy == pytest.approx(2.0, abs=0.02)
    assert m.vx == pytest.approx(0.0, abs=0.02)
    assert m.x == pytest.approx(1.0, abs=0.05)
    assert 0.2e6 < m.time_usec <= 0.3e6
    assert m.q == pytest.approx([math.sqrt(0.5), 0, 0, math.sqrt(0.5)], abs=1e-6)


def test_positions_wait_for_the_estimator() -> None:
    client = Client(run_s=0.004, ekf_ready_s=0.5)
    early = client.run(0.4)
    assert not of("ODOMETRY", early)
    assert not of("GPS_GLOBAL_ORIGIN", early)
    late = client.run(0.4)
    assert of("ODOMETRY", late)
    assert len(of("GPS_GLOBAL_ORIGIN", late)) == 1


def test_a_lost_position_goes_on_and_its_flags_say_so() -> None:
    client = Client(run_s=0.004)
    client.run(1.0)
    client.world.estimator.lose_gps(0)
    assert of("GPS_RAW_INT", client.run(1.1))[-1].fix_type == 0, "at once"
    early = of("ESTIMATOR_STATUS", client.run(1.1))[-1]
    assert early.flags & 0x18
    late = client.run(5.0)[-200:]
    assert of("ODOMETRY", late)
    assert not of("ESTIMATOR_STATUS", client.run(1.1))[-1].flags & 0x18


def test_health_shows_when_arming_would_be_accepted() -> None:
    client = Client(run_s=0.004, ekf_ready_s=0.5)
    (first, *_) = of("SYS_STATUS", client.run(0.4))
    assert not first.onboard_control_sensors_health & 0x10000000
    ready = of("SYS_STATUS", client.run(1.5))[-1]
    assert ready.onboard_control_sensors_health == 0x1320C83F
    assert ready.onboard_control_sensors_present == 0x0300C02F


def test_timesync_is_answered_with_the_time_of_its_arrival() -> None:
    (sync,) = of("TIMESYNC", Client().ask(mav.MAVLink_timesync_message(0, 4242)))
    assert sync.tc1 == pytest.approx(0.204e9, abs=1e7)


def test_each_setpoint_is_repeated_once_in_offboard_and_targets_all_the_time_in_other_modes() -> None:
    """As PX4 1.18 does: without new setpoints ATTITUDE_TARGET stops until the failsafe acts."""
    client = Client(run_s=1.0)
    client.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, mav.MAVLINK_MSG_ID_ATTITUDE_TARGET, 20_000.0)
    assert len(of("ATTITUDE_TARGET", client.run(1.0))) == pytest.approx(50, abs=1)
    assert result(client.command(mav.MAV_CMD_DO_SET_MODE, 1.0, 6.0)) == 0
    sent, told = [0.25, 0.5, 0.75], []
    for thrust_01 in sent:
        said = client.ask(mav.MAVLink_set_attitude_target_message(0, 1, 1, 7, [1, 0, 0, 0], 0, 0, 0, thrust_01))
        told += [message.thrust for message in of("ATTITUDE_TARGET", said + client.run(0.1))]
    assert told == sent


def test_old_texts_are_dropped() -> None:
    client = Client()
    client.command(400, 1)
    client.run(5.5)
    client.ask(mav.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    assert not of("STATUSTEXT", client.run(0.5))


# --- parameters ---


def test_integers_travel_bytewise() -> None:
    for value in (0, 1, -1, 4, 894281, -(2**31)):
        assert struct.unpack("<i", struct.pack("<f", int_to_wire(value)))[0] == value
        assert int_from_wire(int_to_wire(value)) == value


def test_an_index_beyond_the_parameters_is_refused() -> None:
    assert of("PARAM_ERROR", Client().ask(mav.MAVLink_param_request_read_message(1, 1, b"", 9999)))


# --- hostile bytes ---


def test_every_command_survives_extreme_parameters() -> None:
    client = Client()
    for command in (400, 176, 22, 21, 20, 185, 511, 512):
        for value in (NAN, math.inf, -math.inf, 3e38, -1.0):
            client.command(command, *[value] * 7)
    assert np.isfinite(client.world.plant.state).all()


# --- frames ---


@pytest.mark.parametrize(
    "spawn", [(0.0, 0.0, 0.0), (-1.0, 5.0, 2.0), (1500.0, -2500.0, -30.0), (0.003, -0.004, 0.0004)]
)
@pytest.mark.parametrize("origin", [ORIGIN, GeoOrigin(-33.9, 151.2, 20.0), GeoOrigin(64.1, -21.9, 0.0)])
def test_origin_converts_back_to_the_true_position(spawn: tuple[float, float, float], origin: GeoOrigin) -> None:
    """A client that puts the sent origin into the shared frame and adds the local position gets the truth."""
    place: dict[str, Any] = {
        "origin_lat_deg": origin.lat_deg,
        "origin_lon_deg": origin.lon_deg,
        "origin_alt_m": origin.alt_m,
    }
    client = Client(spawn_ned_m=[spawn], run_s=0.004, ekf_ready_s=0.05, **place)
    got = client.run(0.2)
    (sent,) = of("GPS_GLOBAL_ORIGIN", got)
    local = of("ODOMETRY", got)[-1]
    offset = pymap3d.geodetic2ned(
        sent.latitude / 1e7, sent.longitude / 1e7, sent.altitude / 1e3, origin.lat_deg, origin.lon_deg, origin.alt_m
    )
    truth = client.world.truth_rows()[0]["pos_ned_m"]
    assert math.dist([o + p for o, p in zip(offset, (local.x, local.y, local.z), strict=True)], truth) < 1e-6
    assert math.dist(truth, spawn) < 1e-9


def test_every_vehicle_has_its_own_origin() -> None:
    client = Client(vehicles=3)
    origins = [client.world.origins[i].lat_e7 for i in range(3)]
    assert len(set(origins)) == 3
    assert abs(local_origin(np.zeros(3), ORIGIN).lat_e7 - 473977420) <= 1


def test_global_position_agrees_with_geodesy() -> None:
    client = Client()
    client.world.plant.state[10:13, 0] = 120.0, -80.0, -15.0
    m = of("GLOBAL_POSITION_INT", client.run(0.1))[0]
    origin = client.world.origins[0]
    lat, lon, alt = pymap3d.ned2geodetic(120.0, -80.0, -15.0, origin.lat_e7 / 1e7, origin.lon_e7 / 1e7, 489.4)
    assert m.lat == pytest.approx(float(lat) * 1e7, abs=2)
    assert m.lon == pytest.approx(float(lon) * 1e7, abs=2)
    assert m.alt == pytest.approx(float(alt) * 1e3, abs=100)
    assert m.relative_alt == pytest.approx(15000, abs=100)


# --- the whole world ---


def flight(seed: int, reverse: bool = False) -> bytes:
    """Bytes of a short flight of two vehicles, and of everything they sent."""
    clock = SimClock()
    pairs = [pipe_pair(clock.now_us) for _ in range(2)]
    world = SitlWorld(SimulatorConfig(vehicles=2, seed=seed), [p[0] for p in pairs])
    codec = Codec(1, 191)
    out = b""
    for k in range(600):
        order = (1, 0) if reverse else (0, 1)
        for i in order:
            if k == 280:
                pairs[i][1].send(codec.encode(mav.MAVLink_command_long_message(i + 1, 1, 176, 0, 1, 6, 0, 0, 0, 0, 0)))
            if k == 290:
                pairs[i][1].send(codec.encode(mav.MAVLink_command_long_message(i + 1, 1, 400, 0, 1, *[0.0] * 6)))
            if k >= 270 and k % 5 == 0:
                q = [math.cos(0.02), 0.0, math.sin(0.02) * (1 - 2 * i), 0.0]
                pairs[i][1].send(codec.encode(mav.MAVLink_set_attitude_target_message(k, 0, 0, 7, q, 0, 0, 0, 0.6)))
        clock.advance(4000)
        world.step(clock.now_us())
        out += world.truth_rows().tobytes()
    assert world.truth_rows()[0]["armed"]
    assert world.truth_rows()[0]["pos_ned_m"][2] < -0.5
    return out + b"".join(d.data for p in pairs for d in p[1].receive(clock.now_us()))


def test_the_same_bytes_give_the_same_flight() -> None:
    assert flight(1) == flight(1) == flight(1, reverse=True)


def test_truth_rows_are_in_the_shared_frame() -> None:
    rows = Client(vehicles=3, spawn_ned_m=[[0, 0, 1], [5, 0, 1], [0, 7, 1]]).world.truth_rows()
    np.testing.assert_allclose(rows["pos_ned_m"], [[0, 0, 1], [5, 0, 1], [0, 7, 1]], atol=1e-9)
    assert rows["vehicle"].tolist() == [0, 1, 2]
    assert rows["t_us"].tolist() == [200_000] * 3
    assert rows["landed"].tolist() == [1, 1, 1]


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"vehicles": 0}, "vehicles"),
        ({"preset": "glider"}, "preset"),
        ({"physics_hz": 10}, "physics_hz"),
        ({"mass_scale": 3.0}, "mass_scale"),
        ({"ekf_ready_s": -1.0}, "ekf_ready_s"),
        ({"sysid_base": 255}, "sysid_base"),
        ({"spawn_ned_m": [[0, 0, 0]]}, "spawn_ned_m: 1 positions"),
        ({"spawn_ned_m": [[NAN, 0, 0], [0, 0, 0]]}, "spawn_ned_m.0.0"),
        ({"spawn_ned_m": [[1e6, 0, 0], [0, 0, 0]]}, "spawn_ned_m.0.0"),
        ({"start": "orbit"}, "start"),
        ({"faults": [{"kind": "motor", "vehicle": 2}]}, "faults.0.vehicle"),
    ],
)
def test_impossible_worlds_are_refused(change: dict[str, Any], key: str) -> None:
    with pytest.raises(ConfigError, match=f"sitl: {key}"):
        validated(SimulatorConfig, {"vehicles": 2, **change}, "sitl")
