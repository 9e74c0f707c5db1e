"""Interruptions of flights with real autopilots: an agent dies, a pilot takes over, an autopilot restarts."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np
import pyarrow.parquet as pq
import pymap3d
import pytest
from pymavlink.dialects.v20 import development as mav

from swarmctl.core.types import Phase
from swarmctl.errors import EXIT_INTERRUPTED, EXIT_MISSION
from tests.benches.launches import Launched
from tests.real.autopilots import ARDUCOPTER, PX4, Kind
from tests.real.conftest import Field, Fielder
from tests.real.test_flights import (
    ARDUPILOT_CONFIG,
    BODIES_M,
    END_S,
    GROUND_S,
    LONE_PX4,
    PX4_CONFIG,
    TAKEOFF_HEIGHT,
    THREE_ARDUCOPTERS,
    booted,
)

pytestmark = [pytest.mark.process, pytest.mark.timeout(900)]

LOITER, OFFBOARD = 0x03040000, 0x00060000
PHASES = ("CONNECT", "STANDBY", "ARM", "TAKEOFF", "GOTO_START", "READY", "TRACK", "GOTO_LAND", "LAND")
CLIMBED_M, START_HEIGHT_M, HIGH_M = 0.5, 2.0, 15.0
MOVED_M_S = 2.0  # by a ground station, in hold
STRAYED_M = 20.0  # from the middle of the circle; followed for 40 s, the lost position led 180 m away
TWO_ARDUCOPTERS = (
    "--set=swarm.agents=2",
    '--set=vehicles=[{sysid=1, url="udpin://127.0.0.1:14550"}, {sysid=2, url="udpin://127.0.0.1:14560"}]',
)
LEAST_CHARGE, FULL_PERCENT = "SIM_BAT_MIN_PCT", 90.0  # to which a simulated PX4's battery is drained
DRAINED_IN, FAST_S = "SIM_BAT_DRAIN", 20.0  # time from full to empty
WORN_S, LAUNCHER_WAITS_S = 4.0, 10.0  # until worn batteries are acted on; until it lands who is silent
PASSED_M = 4.0
CHATTERING = "tests.benches.misbehaving:Chattering"
SILENT_FROM_M = 13.0  # of two at 2.3 m/s each
UPRIGHT_DEG = 25.0  # it asks for 30 to either side; without the guard the simulated vehicle turns over
STOPPED_S = 60.0  # within which nothing is armed any more, or it is named


def tracked_s(launched: Launched, agent: int) -> float:
    """Return the mission time that an agent reached."""
    table = pq.read_table(launched.run_dir / f"agent-{agent}.parquet", columns=["phase", "mission_t_s"])
    times_s = table.column("mission_t_s").to_numpy()[table.column("phase").to_numpy() == Phase.TRACK]
    return float(times_s.max(initial=0.0))


def mode_of(here: Field, index: int) -> int:
    return here.witness.vehicles[index].beats[-1][2]


def take(here: Field, index: int) -> None:
    """Set LOITER as its pilot does, and wait for it."""
    here.witness.command(index, mav.MAV_CMD_DO_SET_MODE, 1, 4, 3)
    here.witness.wait(lambda: mode_of(here, index) == LOITER, 2.5, "in LOITER")


def test_a_killed_agent_ends_with_its_vehicle_on_the_ground_and_the_others_finish(field: Fielder) -> None:
    here = field(PX4, 3)
    takeoff_m = here.witness.read_parameter(1, TAKEOFF_HEIGHT)
    launched = here.launch(PX4_CONFIG, "--duration", "30")
    launched.until_phase("TRACK", 3)
    time.sleep(5.0)
    assert here.witness.read_parameter(1, TAKEOFF_HEIGHT) != takeoff_m
    os.kill(launched.pid_of("agent", "--id", "1"), signal.SIGKILL)
    here.witness.wait(lambda: not here.witness.vehicles[1].armed, 30.0, "landed by its own failsafe and disarmed")
    assert here.witness.vehicles[1].height_m() < 0.3
    assert launched.end(END_S) == EXIT_MISSION, launched.text()
    here.witness.wait(here.witness.all_rest, GROUND_S, "all vehicles landed and disarmed")
    assert here.witness.read_parameter(1, TAKEOFF_HEIGHT) == takeoff_m, "set back by the agent that landed it"
    assert min(tracked_s(launched, 0), tracked_s(launched, 2)) == pytest.approx(30.0, abs=0.5)
    assert here.witness.min_separation_m() > BODIES_M


def closest_m(here: Field, agents: int, places: str, *options: str, crossing_s: float) -> float:
    """Return how close ArduCopters come that swap places, when the agent of one freezes so long after the begin.

    Its autopilot keeps the attitude for 1 s and flies on level, until it lands 2 s after its agent's last word.
    """
    swap = ("mission.kind=swap", "mission.swap.travel_s=6", f"start.positions_ned_m={places}")
    sets = (f"--set={each}" for each in (*swap, "separation.mode=guaranteed"))
    launched = here.launch(THREE_ARDUCOPTERS, *options, *sets, "--duration", "20")
    launched.until_phase("TRACK", agents)
    time.sleep(crossing_s)
    os.kill(launched.pid_of("agent", "--id", "1"), signal.SIGSTOP)
    assert launched.end(END_S) == EXIT_MISSION, launched.text()
    here.witness.wait(here.witness.all_rest, GROUND_S, "all vehicles landed and disarmed")
    print(f"frozen {tracked_s(launched, 1):.2f} s after the begin: {here.witness.min_separation_m():.2f} m at least")
    return here.witness.min_separation_m()


@pytest.mark.parametrize("crossing_s", [0.3, 0.6, 0.9])
def test_who_is_committed_to_cross_keeps_clear_of_an_arducopter_whose_agent_freezes(
    field: Fielder, crossing_s: float
) -> None:
    places = "[[2.5862,1.5048,-3],[-2.5752,1.4846,-3],[-0.0358,-3.002,-3]]"
    assert closest_m(booted(field, 3), 3, places, crossing_s=crossing_s) > BODIES_M


@pytest.mark.parametrize("crossing_s", [0.4, 0.8, 1.2])
def test_one_of_two_keeps_clear_of_an_arducopter_that_flies_at_it_without_its_agent(
    field: Fielder, crossing_s: float
) -> None:
    places = "[[2.99,0.1,-3],[-2.99,-0.1,-3]]"
    assert closest_m(booted(field, 2), 2, places, *TWO_ARDUCOPTERS, crossing_s=crossing_s) > BODIES_M


@pytest.mark.parametrize("kind", [PX4, ARDUCOPTER], ids=["px4", "arducopter"])
def test_two_that_hear_nobody_any_more_stop_where_they_do_not_meet(field: Fielder, kind: Kind) -> None:
    """They come at each other, and would meet if they stopped as transits do, at half of `accel_m_s2`."""
    here = field(PX4, 2) if kind is PX4 else booted(field, 2)
    swap = ("mission.kind=swap", "mission.swap.travel_s=12", "start.positions_ned_m=[[10,0,-3],[-10,0,-3]]")
    config = (PX4_CONFIG, "--agents", "2") if kind is PX4 else (THREE_ARDUCOPTERS, *TWO_ARDUCOPTERS)
    launched = here.launch(*config, *(f"--set={each}" for each in swap), "--duration", "40")
    launched.until_phase("TRACK", 2)
    router = launched.pid_of("swarmctl.bus.network.router")
    here.witness.wait(lambda: apart_m(here) < SILENT_FROM_M, 30.0, "on their way")
    os.kill(router, signal.SIGSTOP)
    time.sleep(3.5)  # a pause begins after 0.3 s
    before_m = apart_m(here)
    time.sleep(0.5)
    after_m = apart_m(here)
    os.kill(router, signal.SIGCONT)
    assert launched.end(END_S) == 0, launched.text()
    here.witness.wait(here.witness.all_rest, GROUND_S, "all vehicles landed and disarmed")
    print(f"{after_m:.1f} m from each other at rest, {here.witness.min_separation_m():.2f} m at least later")
    assert after_m > 3.0
    assert abs(after_m - before_m) < 0.2, "they rest"
    assert here.witness.min_separation_m() > BODIES_M


def test_worn_batteries_lead_nobody_home_past_who_it_does_not_hear(field: Fielder) -> None:
    """They have passed each other, and their ways home would meet."""
    here = field(PX4, 2)
    here.witness.wait(lambda: all(v.beats for v in here.witness.vehicles), 20.0, "heartbeats")
    for index in range(2):
        here.witness.set_parameter(index, LEAST_CHARGE, FULL_PERCENT)
        assert here.witness.read_parameter(index, LEAST_CHARGE) == FULL_PERCENT
    swap = ("mission.kind=swap", "mission.swap.travel_s=12", "start.positions_ned_m=[[10,0,-3],[-10,0,-3]]")
    worn = [f"agent.failsafe.{key}" for key in ("battery_warn_01=0.87", "battery_rtl_01=0.85", "window_s=1")]
    sets = (f"--set={each}" for each in (*swap, *worn))
    launched = here.launch(PX4_CONFIG, "--agents", "2", *sets, "--duration", "40")
    launched.until_phase("TRACK", 2)
    router = launched.pid_of("swarmctl.bus.network.router")
    here.witness.wait(lambda: ahead_m(here) > PASSED_M, 30.0, "past each other")
    os.kill(router, signal.SIGSTOP)
    for index in range(2):
        here.witness.set_parameter(index, DRAINED_IN, FAST_S)
        here.witness.set_parameter(index, LEAST_CHARGE, 50.0)
    time.sleep(WORN_S)
    before_m = apart_m(here)
    time.sleep(LAUNCHER_WAITS_S - WORN_S - 1.0)
    after_m, heard_us = apart_m(here), time.time_ns() // 1000
    os.kill(router, signal.SIGCONT)
    assert launched.end(END_S) == EXIT_MISSION, launched.text()
    here.witness.wait(here.witness.all_rest, GROUND_S, "all vehicles landed and disarmed")
    print(f"{after_m:.1f} m from each other at rest, {here.witness.min_separation_m():.2f} m at least")
    for agent in ("agent-0", "agent-1"):
        (turned_us,) = (row["utc_us"] for row in launched.events("escalation", agent) if row["response"] == "RTL")
        assert turned_us < heard_us - 4e6, "its battery was worn before"
        landed_us = [row["utc_us"] for row in launched.events("land") if row["utc_us"] < heard_us]
        assert not landed_us, "by the launcher, which does not hear them"
    assert abs(after_m - before_m) < 0.3, "they rest"
    assert here.witness.min_separation_m() > BODIES_M


def ahead_m(here: Field) -> float:
    """Return how far the second vehicle, which began south of the first one, is north of it now."""
    return here.witness.vehicles[1].pos_ned_m[-1][0] - here.witness.vehicles[0].pos_ned_m[-1][0]


@pytest.mark.parametrize("kind", [PX4, ARDUCOPTER], ids=["px4", "arducopter"])
def test_a_controller_that_chatters_is_not_flown_and_its_vehicle_lands(field: Fielder, kind: Kind) -> None:
    here = field(PX4, 1) if kind is PX4 else booted(field, 1)
    config = (PX4_CONFIG, *LONE_PX4) if kind is PX4 else (ARDUPILOT_CONFIG,)
    launched = here.launch(*config, f"--set=controller.kind={CHATTERING}", "--set=mission.kind=hover", "--duration=20")
    assert launched.end(END_S) == EXIT_MISSION, launched.text()
    assert f"controller {CHATTERING} tilts to and fro faster than the vehicle follows" in launched.text()
    here.witness.wait(here.witness.all_rest, GROUND_S, "landed and disarmed")
    table = pq.read_table(launched.run_dir / "agent-0.parquet", columns=["q_nb_x", "q_nb_y"])
    x, y = (table.column(name).to_numpy().astype(float) for name in table.column_names)
    tilt_deg = math.degrees(math.acos(1.0 - 2.0 * float((x * x + y * y)[np.isfinite(x)].max())))
    print(f"largest tilt {tilt_deg:.0f} deg, {tracked_s(launched, 0):.1f} s of the mission")
    assert tilt_deg < UPRIGHT_DEG


def apart_m(here: Field) -> float:
    """Return the true distance of the first two vehicles now."""
    one, other = (here.witness.vehicles[index].pos_ned_m[-1] for index in (0, 1))
    return math.dist(one, other)


def test_a_pilot_has_the_vehicle_until_resume(field: Fielder) -> None:
    here = field(PX4, 3)
    launched = here.launch(PX4_CONFIG)
    launched.until_phase("TRACK", 3)
    time.sleep(5.0)
    take(here, 1)
    until_s = time.monotonic() + 5.0
    while time.monotonic() < until_s:
        assert mode_of(here, 1) == LOITER, "the pilot has it"
        time.sleep(0.1)
    assert launched.verb("resume").returncode == 0
    here.witness.wait(lambda: mode_of(here, 1) == OFFBOARD, 15.0, "in OFFBOARD again")
    assert launched.end(END_S) == 0, launched.text()
    here.witness.wait(here.witness.all_rest, GROUND_S, "all vehicles landed and disarmed")
    assert here.witness.min_separation_m() > BODIES_M


@pytest.mark.parametrize(("kind", "land"), [(PX4, (4, 6)), (ARDUCOPTER, (9, 0))], ids=["px4", "arducopter"])
def test_what_a_pilot_lands_while_it_takes_off_stays_down(field: Fielder, kind: Kind, land: tuple[int, int]) -> None:
    here = field(PX4, 1) if kind is PX4 else booted(field, 1)
    launched = here.launch(*((PX4_CONFIG, *LONE_PX4) if kind is PX4 else (ARDUPILOT_CONFIG,)))
    launched.until_phase("TAKEOFF", 1)
    vehicle = here.witness.vehicles[0]
    here.witness.wait(lambda: vehicle.height_m() > CLIMBED_M, 30.0, "climbing")
    here.witness.command(0, mav.MAV_CMD_DO_SET_MODE, 1, *land)
    here.witness.wait(lambda: not vehicle.armed, 40.0, "landed and disarmed")
    assert here.witness.highest_m(0) < START_HEIGHT_M - 0.3, "it did not take off again"
    assert launched.end(END_S) == EXIT_MISSION, launched.text()
    assert "pilot or autopilot took over" in launched.text()
    assert not vehicle.armed


@pytest.mark.parametrize("kind", [PX4, ARDUCOPTER], ids=["px4", "arducopter"])
def test_a_climb_keeps_clear_of_an_obstacle_that_moves_into_its_way(field: Fielder, kind: Kind) -> None:
    """Its agent takes control on the way up."""
    here = field(PX4, 1) if kind is PX4 else booted(field, 1)
    high = f"start.positions_ned_m=[[0.0,0.0,{-HIGH_M}]]"
    config = (PX4_CONFIG, *LONE_PX4) if kind is PX4 else (ARDUPILOT_CONFIG,)
    launched = here.launch(*config, "--set", "mission.kind=hover", "--set", high, "--duration", "3")
    launched.until_phase("TAKEOFF", 1)
    vehicle = here.witness.vehicles[0]
    here.witness.wait(lambda: vehicle.height_m() > CLIMBED_M, 30.0, "climbing")
    moves = ("--radius", "0.5", "--keep-out", "1.0", "--visibility", "8", "--velocity=-2,0,0")
    assert launched.verb("obstacle", "add", f"--center=9,0,{-0.7 * HIGH_M}", *moves).returncode == 0
    assert launched.end(END_S) == 0, launched.text()
    table = pq.read_table(launched.run_dir / "agent-0.parquet", columns=["phase", "pos_ned_m_z"])
    taken = table.column("phase").to_numpy() == Phase.GOTO_START
    below_m = HIGH_M + float(table.column("pos_ned_m_z").to_numpy()[taken][0])
    clear = launched.summary()["obstacles"]
    print(f"control {below_m:.1f} m below its height, {clear['min_clearance_m']:.2f} m from the centre")
    assert below_m > 1.5
    assert clear["min_clearance_m"] > clear["required_m"]


def test_others_make_way_for_who_is_moved_in_hold(field: Fielder) -> None:
    here = field(PX4, 3)
    launched = here.launch(PX4_CONFIG, "--set", "mission.kind=hover", "--duration", "30")
    launched.until_phase("TRACK", 3)
    time.sleep(2.0)
    take(here, 2)
    time.sleep(2.0)
    vehicle, origin = here.witness.vehicles[2], PX4.origin
    north_m, east_m, down_m = vehicle.pos_ned_m[-1]
    beyond = pymap3d.ned2geodetic(-4.0 * north_m, east_m, down_m, origin.lat_deg, origin.lon_deg, origin.alt_m)
    params = (MOVED_M_S, 1.0, 0.0, math.nan, round(beyond[0] * 1e7), round(beyond[1] * 1e7), beyond[2])
    numbers = 3, 1, mav.MAV_FRAME_GLOBAL, mav.MAV_CMD_DO_REPOSITION, 0, 0
    here.witness.say(2, mav.MAVLink_command_int_message(*numbers, *params))
    here.witness.wait(lambda: abs(vehicle.pos_ned_m[-1][0] + 4.0 * north_m) < 2.0, 20.0, "past the others")
    assert launched.verb("land").returncode == EXIT_MISSION, "it has a pilot"
    assert launched.verb("resume").returncode == 0
    launched.end(END_S)
    here.witness.wait(here.witness.all_rest, GROUND_S, "all vehicles landed and disarmed")
    print(f"least true separation {here.witness.min_separation_m():.2f} m")
    assert here.witness.min_separation_m() > BODIES_M


@pytest.mark.parametrize("phase", ["TAKEOFF", "LAND"])
def test_what_a_pilot_holds_on_its_way_up_or_down_is_taken_back(field: Fielder, phase: str) -> None:
    here = field(PX4, 1)
    launched = here.launch(PX4_CONFIG, *LONE_PX4, "--duration", "3")
    launched.until_phase(phase, 1)
    vehicle = here.witness.vehicles[0]
    here.witness.wait(lambda: vehicle.height_m() > CLIMBED_M, 30.0, "off the ground")
    take(here, 0)
    time.sleep(5.0)
    assert mode_of(here, 0) == LOITER, "the pilot has it"
    assert launched.verb("land").returncode == EXIT_MISSION, "take it back with: resume"
    assert launched.verb("resume").returncode == 0
    assert launched.end(END_S) == 0, launched.text()
    here.witness.wait(lambda: not vehicle.armed, GROUND_S, "landed and disarmed")


def test_who_only_warns_of_its_battery_flies_on(field: Fielder) -> None:
    here = booted(field, 1)
    launched = here.launch(ARDUPILOT_CONFIG)
    launched.until_phase("TRACK", 1)
    for name, value in (("BATT_FS_LOW_ACT", 0.0), ("BATT_LOW_TIMER", 1.0), ("BATT_LOW_VOLT", 13.0)):
        here.witness.set_parameter(0, name, value)
    assert launched.end(END_S) == 0, launched.text()
    assert any("low voltage" in row["text"] for row in launched.events("autopilot_text", "agent-0")), "it has warned"
    here.witness.wait(here.witness.all_rest, GROUND_S, "landed and disarmed")


def lose_gps(here: Field, index: int) -> None:
    """Take the satellites from one simulated receiver: the first parameter is of a PX4, the second of an ArduCopter."""
    no_satellites = (b"SIM_GPS_USED", 0.0, mav.MAV_PARAM_TYPE_INT32)  # in any type zero is the same bits
    here.witness.say(index, mav.MAVLink_param_set_message(index + 1, 1, *no_satellites))
    here.witness.set_parameter(index, "SIM_GPS_DISABLE", 1.0)


@pytest.mark.parametrize(
    ("kind", "sets"),
    [(PX4, ()), (PX4, ("--set", "separation.mode=guaranteed")), (ARDUCOPTER, ())],
    ids=["px4", "px4-guaranteed", "arducopter"],
)
def test_who_loses_gps_among_others_lands_and_they_keep_away(field: Fielder, kind: Kind, sets: tuple[str, ...]) -> None:
    here = field(PX4, 3) if kind is PX4 else booted(field, 3)
    launched = here.launch(PX4_CONFIG if kind is PX4 else "tests/real/three_arducopters.toml", *sets)
    launched.until_phase("TRACK", 3)
    time.sleep(5.0)
    lose_gps(here, 1)
    assert launched.end(END_S) == EXIT_MISSION, launched.text()
    assert "no GPS for" in launched.text()
    here.witness.wait(here.witness.all_rest, GROUND_S, "landed and disarmed")
    assert here.witness.min_separation_m() > BODIES_M


def test_who_has_lost_its_position_is_landed_by_its_autopilot(field: Fielder) -> None:
    here = field(PX4, 1)
    launched = here.launch(PX4_CONFIG, *LONE_PX4)
    launched.until_phase("TRACK", 1)
    time.sleep(5.0)
    lose_gps(here, 0)
    assert launched.end(END_S) == EXIT_MISSION, launched.text()
    assert launched.events("position_lost", "agent-0"), "its estimator has said so"
    here.witness.wait(here.witness.all_rest, GROUND_S, "landed and disarmed")
    assert math.dist(here.witness.vehicles[0].pos_ned_m[-1][:2], (0.0, 0.0)) < STRAYED_M


def test_an_autopilot_that_starts_again_before_arming_is_waited_for(field: Fielder) -> None:
    here = field(PX4, 3)
    here.witness.wait(lambda: all(v.beats for v in here.witness.vehicles), 20.0, "heartbeats")
    launched = here.launch(PX4_CONFIG, "--duration", "12")
    launched.until_phase("CONNECT", 3)
    time.sleep(1.0)
    assert not any(vehicle.was_armed for vehicle in here.witness.vehicles)
    here.fleet.reboot(1)
    assert launched.end(END_S) == 0, launched.text()
    here.witness.wait(here.witness.all_rest, GROUND_S, "all vehicles landed and disarmed")
    assert all(here.witness.highest_m(i) > 1.0 for i in range(3)), "they flew"


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP], ids=lambda how: how.name)
def test_a_stopped_launch_leaves_nothing_armed(field: Fielder, how: signal.Signals, phase: str) -> None:
    here = field(PX4, 3)
    launched = here.launch(PX4_CONFIG, "--duration", "8")
    launched.until_phase(phase, 1)
    launched.process.send_signal(how)
    code = launched.end(END_S)
    if code != EXIT_MISSION:
        assert code == EXIT_INTERRUPTED, launched.text()
        here.witness.wait(here.witness.all_rest, STOPPED_S, "nothing armed any more")
        return
    time.sleep(STOPPED_S)
    armed = [i for i, vehicle in enumerate(here.witness.vehicles) if vehicle.armed]
    assert all(f"agent {i}" in launched.text() for i in armed), f"{armed} armed and not named: {launched.text()}"


@pytest.mark.parametrize("phase", PHASES)
def test_a_killed_agent_leaves_nothing_armed(field: Fielder, phase: str) -> None:
    here = field(PX4, 1)
    launched = here.launch(
        PX4_CONFIG,
        *("--set", "swarm.agents=1", "--set", 'vehicles=[{sysid=1, url="udpin://127.0.0.1:14540"}]', "--duration", "8"),
    )
    launched.until_phase(phase, 1)
    os.kill(launched.pid_of("agent", "--id", "0"), signal.SIGKILL)
    assert launched.end(END_S) == EXIT_MISSION, launched.text()
    until_s = time.monotonic() + STOPPED_S
    while time.monotonic() < until_s and here.witness.vehicles[0].armed:
        time.sleep(0.2)
    assert not here.witness.vehicles[0].armed or "armed" in launched.text(), launched.text()


LAND = 9  # of an ArduCopter
ACTS_S = 6.0  # FS_GCS_TIMEOUT, after the last heartbeat, and the witness's own heartbeat
RELAY = """
import selectors, signal, socket
port, beyond = {ports}
ears = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)  # towards the vehicle
mouth = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)  # towards the agent
ears.bind(("127.0.0.1", port))
vehicle, deaf, mute = None, [], []
signal.signal(signal.SIGUSR1, lambda *_: deaf.append(True))  # the agent hears nothing any more
signal.signal(signal.SIGUSR2, lambda *_: mute.append(True))  # nor is it heard
chosen = selectors.DefaultSelector()
for one in (ears, mouth):
    chosen.register(one, selectors.EVENT_READ)
while True:
    for key, _ in chosen.select():
        if key.fileobj is ears:
            data, vehicle = ears.recvfrom(4096)
            if not deaf:
                mouth.sendto(data, ("127.0.0.1", beyond))
        elif vehicle is not None:
            data = mouth.recv(4096)
            if not mute:
                ears.sendto(data, vehicle)
"""


@contextlib.contextmanager
def relayed(here: Field, port: int) -> Iterator[subprocess.Popen[bytes]]:
    """Relay between a vehicle that sends to a port and an agent that listens 10000 above it."""
    program = RELAY.format(ports=(port, port + 10_000))
    with subprocess.Popen([*here.fleet.network.prefix, sys.executable, "-c", program]) as relay:
        try:
            yield relay
        finally:
            relay.kill()


def lone(port: int) -> tuple[str, ...]:
    """Return the options of a launch that flies one vehicle through the relay at a port."""
    vehicle = f'vehicles=[{{sysid=1, url="udpin://127.0.0.1:{port + 10_000}"}}]'
    return "--set", "swarm.agents=1", "--set", vehicle


def test_an_arducopter_that_its_agent_does_not_hear_lands_by_its_own_failsafe(field: Fielder) -> None:
    here = booted(field, 1)
    with relayed(here, 14550) as relay:
        launched = here.launch(ARDUPILOT_CONFIG, *lone(14550))
        launched.until_phase("TRACK", 1)
        time.sleep(3.0)
        relay.send_signal(signal.SIGUSR1)
        here.witness.wait(lambda: mode_of(here, 0) == LAND, ACTS_S, "landing")
        here.witness.wait(lambda: not here.witness.vehicles[0].armed, GROUND_S, "landed and disarmed")
        assert launched.end(END_S) == EXIT_MISSION, launched.text()


@pytest.mark.parametrize(("kind", "config", "port"), [(PX4, PX4_CONFIG, 14540), (ARDUCOPTER, ARDUPILOT_CONFIG, 14550)])
def test_a_vehicle_that_misses_its_setpoints_is_known_to_before_its_failsafe_acts(
    field: Fielder, kind: Kind, config: str, port: int
) -> None:
    """By the setpoint that it repeats; in 8 s of flight before none is missed."""
    here = booted(field, 1) if kind is ARDUCOPTER else field(kind, 1)
    with relayed(here, port) as relay:
        launched = here.launch(config, *lone(port))
        launched.until_phase("TRACK", 1)
        time.sleep(8.0)
        cut_us = time.clock_gettime(time.CLOCK_BOOTTIME) * 1e6
        relay.send_signal(signal.SIGUSR2)
        here.witness.wait(lambda: not here.witness.vehicles[0].armed, GROUND_S, "landed and disarmed")
        launched.end(END_S)
        told = launched.events("setpoints_unheard", "agent-0")
        assert told[0]["unheard"], told
        assert 0.04 < (told[0]["t_us"] - cut_us) * 1e-6 < 0.3, "the failsafe of a PX4 acts after 0.5 s"
