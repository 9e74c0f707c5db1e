"""One simulated ArduCopter from the configuration: autopilot, and its MAVLink interface on each of its links."""

from __future__ import annotations

from sitl.arducopter.autopilot import ArduCopter
from sitl.arducopter.endpoint import ArduCopterEndpoint
from sitl.arducopter.navigator import CopterNavigator
from sitl.arducopter.parameters import CopterParameters
from sitl.arducopter.streams import CopterReport
from sitl.net.signing import ARDUCOPTER_RULES
from sitl.vehicle_parts import Commander, MavlinkInterface, SimulatedVehicle


def arducopter(vehicle: SimulatedVehicle) -> tuple[Commander, list[MavlinkInterface]]:
    """Return the autopilot of a vehicle, and its interface on each link."""
    parameters = CopterParameters(vehicle.sysid)
    navigator = CopterNavigator(parameters, vehicle.plant.hover_thrust_01)
    pilot = ArduCopter(
        parameters, navigator, vehicle.origin, ekf_ready_us=vehicle.ekf_ready_us, airborne=vehicle.airborne
    )

    def report() -> CopterReport:
        return CopterReport(
            estimate=pilot.boot.local(vehicle.estimate()),
            pilot=pilot,
            origin=pilot.boot.origin or vehicle.origin,
            rotor_01=lambda: vehicle.plant.rotor_01(vehicle.number),
        )

    links = vehicle.sign(pilot, ARDUCOPTER_RULES)
    return pilot, [ArduCopterEndpoint(vehicle.sysid, link, pilot, report, step_us=vehicle.step_us) for link in links]
