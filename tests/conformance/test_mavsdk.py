"""MAVSDK, an independent client, flies the simulator as it would fly PX4: connect, healthy, arm, take off, land."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from mavsdk import Configuration, Mavsdk
from mavsdk import asyncio as mavsdk_asyncio
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.plugins.action import Action
from mavsdk.plugins.param import Param
from mavsdk.plugins.telemetry import Telemetry

pytestmark = pytest.mark.process

ROOT = Path(__file__).resolve().parents[2]
TAKEOFF_ALTITUDE_M = 1.2
OWN_SYSID = 245


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def simulator(preset: str) -> Iterator[int]:
    """`python -m sitl` with one vehicle; yields the port it sends to, and checks its clean end."""
    port = free_port()
    process = subprocess.Popen(
        [
            *(sys.executable, "-m", "sitl", "--vehicles", "1", "--preset", preset),
            *("--remote-ports", str(port), "--local-port", str(free_port())),
        ],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        yield port
        process.send_signal(signal.SIGTERM)
        output, _ = process.communicate(timeout=10)
        assert process.returncode == 0
        assert "steps" in output
    finally:
        process.kill()
        process.communicate()


def wait_for(condition: Callable[[], bool], timeout_s: float, what: str) -> None:
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline_s, f"not within {timeout_s} s: {what}"
        time.sleep(0.05)


@pytest.mark.parametrize("preset", ["thesis", "x500"])
def test_mavsdk_sync_walk(preset: str) -> None:
    with simulator(preset) as port:
        sdk = Mavsdk(Configuration.create_manual(OWN_SYSID, 190, True))
        try:
            sdk.add_any_connection(f"udpin://127.0.0.1:{port}")
            system = sdk.first_autopilot(10.0)
            assert system is not None, "MAVSDK found no autopilot"
            assert system.get_system_id() == 1
            action, telemetry, param = Action(system), Telemetry(system), Param(system)
            wait_for(telemetry.health_all_ok, 10.0, "health_all_ok")
            assert param.get_param_int("COM_OBL_RC_ACT") == 0
            param.set_param_int("COM_OBL_RC_ACT", 4)
            assert param.get_param_int("COM_OBL_RC_ACT") == 4
            assert param.get_param_float("COM_OF_LOSS_T") == pytest.approx(1.0)
            action.set_takeoff_altitude(TAKEOFF_ALTITUDE_M)
            assert action.get_takeoff_altitude() == pytest.approx(TAKEOFF_ALTITUDE_M)
            action.arm()
            wait_for(telemetry.armed, 3.0, "armed")
            action.takeoff()
            wait_for(lambda: telemetry.landed_state().name == "TAKING_OFF", 5.0, "taking off")
            wait_for(lambda: telemetry.flight_mode().name == "TAKEOFF", 3.0, "takeoff mode")
            wait_for(lambda: telemetry.flight_mode().name == "HOLD", 12.0, "hold after takeoff")
            assert telemetry.in_air()
            assert telemetry.position().relative_altitude_m == pytest.approx(TAKEOFF_ALTITUDE_M, abs=0.25)
            action.land()
            wait_for(lambda: telemetry.flight_mode().name == "LAND", 3.0, "land mode")
            wait_for(lambda: not telemetry.armed(), 15.0, "disarmed after landing")
            assert telemetry.landed_state().name == "ON_GROUND"
        finally:
            sdk.destroy()


def test_mavsdk_asyncio_walk() -> None:
    with simulator("thesis") as port:
        asyncio.run(asyncio.wait_for(fly_with_asyncio(port), 45.0))


async def fly_with_asyncio(port: int) -> None:
    async with mavsdk_asyncio.Mavsdk(Configuration.create_manual(OWN_SYSID, 190, True)) as sdk:
        await sdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        system = await sdk.first_autopilot(timeout_s=10.0)
        assert system is not None, "MAVSDK found no autopilot"
        action, telemetry = ActionAsync(system), TelemetryAsync(system)
        async for healthy in telemetry.subscribe_health_all_ok():
            if healthy:
                break
        await action.set_takeoff_altitude(TAKEOFF_ALTITUDE_M)
        await action.arm()
        await action.takeoff()
        async for position in telemetry.subscribe_position():
            if position.relative_altitude_m > TAKEOFF_ALTITUDE_M - 0.25:
                break
        assert await telemetry.in_air()
        await action.land()
        async for armed in telemetry.subscribe_armed():
            if not armed:
                break
        assert not await telemetry.in_air()
