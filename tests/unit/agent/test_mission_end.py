"""The end of a mission: how long a process waits until its vehicle's parameters are restored."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from swarmctl.agent.mission.mission_end import MissionEnd
from swarmctl.agent.watches.alerts import Alerts
from tests.unit.mavlink.test_vehicle_setup import ARDUCOPTER, PX4, Vehicle

CHANGED: dict[int, tuple[dict[str, float], dict[str, float]]] = {  # each is asked for 3 s before it is given up
    PX4: ({"NAV_DLL_ACT": 0, "COM_DL_LOSS_T": 10, "COM_OBL_RC_ACT": 0}, {"COM_OBL_RC_ACT": 4}),
    ARDUCOPTER: ({"FS_GCS_ENABLE": 0, "FS_GCS_TIMEOUT": 9.0}, {"FS_GCS_ENABLE": 5, "FS_GCS_TIMEOUT": 2.0}),
}


@pytest.mark.parametrize(("autopilot", "waits_s"), [(PX4, 6.0), (ARDUCOPTER, 5.0)], ids=["PX4", "ArduCopter"])
def test_a_vehicle_that_is_gone_is_waited_for_five_seconds_from_when_it_is_asked(
    autopilot: int, waits_s: float
) -> None:
    came_with, wanted = CHANGED[autopilot]
    vehicle = Vehicle(autopilot, **came_with).set_up(**wanted).run(30.0)
    vehicle.talks = False
    noted: dict[str, Any] = {}
    ports = SimpleNamespace(clock=vehicle.clock, note=lambda name, **fields: noted.update({name: fields}))
    mission = SimpleNamespace(finished=False)
    end = MissionEnd(cast(Any, ports), cast(Any, mission), vehicle.vehicle_setup, Alerts())
    end.step(vehicle.clock.now_us())
    assert not end.done
    mission.finished = True
    began_us = vehicle.clock.now_us()
    while not end.done:
        end.step(vehicle.clock.now_us())
        vehicle.run(0.02)
    assert (vehicle.clock.now_us() - began_us) * 1e-6 == pytest.approx(waits_s, abs=0.1)
    end.step(vehicle.clock.now_us())
    assert noted["parameters_left_changed"]["were"]
