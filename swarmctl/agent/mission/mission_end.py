"""The end of an agent's mission: the autopilot's parameters are restored before its process ends."""

from __future__ import annotations

from swarmctl.agent.ports import Ports
from swarmctl.agent.watches.alerts import Alerts
from swarmctl.control.phases.mission_state import MissionState
from swarmctl.mavlink.vehicle_setup import VehicleSetup

_RESTORE_TIMEOUT_US = 5_000_000  # longest wait for parameters to be restored, from when the first one is


class MissionEnd:
    """Begins to restore parameters when the mission has ended, and reports those that could not be.

    Args:
        ports: time; receives the event `parameters_left_changed`.
        mission: knows whether the mission has ended.
        vehicle_setup: has changed the parameters.
        alerts: are told of parameters that are left changed.
    """

    def __init__(self, ports: Ports, mission: MissionState, vehicle_setup: VehicleSetup, alerts: Alerts) -> None:
        self._ports, self._mission, self._vehicle_setup = ports, mission, vehicle_setup
        self._alerts = alerts

    @property
    def done(self) -> bool:
        """Whether the mission has ended and the autopilot's parameters are restored, or the wait for it timed out."""
        setup, from_us = self._vehicle_setup, self._vehicle_setup.restore_from_us
        if from_us is None:
            return False
        return setup.restored or self._ports.clock.now_us() - from_us > _RESTORE_TIMEOUT_US

    def step(self, now_us: int) -> None:
        """Advance by one tick."""
        if not self._mission.finished:
            return
        if self._vehicle_setup.restore_from_us is None:
            self._vehicle_setup.restore(now_us)
        left = self._vehicle_setup.left_changed
        if left and self.done and self._alerts.put("restore", f"parameters left changed, they were: {left}", now_us):
            self._ports.note("parameters_left_changed", were=left)
