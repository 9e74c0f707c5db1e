"""One simulated PX4 from the configuration: autopilot, and its MAVLink interface on each of its links."""

from __future__ import annotations

from collections.abc import Callable

from sitl.net.signing import PX4_RULES
from sitl.px4.autopilot import Autopilot
from sitl.px4.link.endpoint import Endpoint
from sitl.px4.link.schedule import GCS_HZ
from sitl.px4.link.streams import Report
from sitl.px4.navigator import Navigator
from sitl.px4.parameters import Parameters
from sitl.vehicle_parts import Commander, MavlinkInterface, SimulatedVehicle


def px4(vehicle: SimulatedVehicle) -> tuple[Commander, list[MavlinkInterface]]:
    """Return the autopilot of a vehicle, and its interface on the first link and, if there is one, on the second."""
    parameters = Parameters(vehicle.sysid)
    pilot = Autopilot(
        parameters,
        Navigator(parameters, vehicle.plant.hover_thrust_01),
        ekf_ready_us=vehicle.ekf_ready_us,
        airborne=vehicle.airborne,
        reject_bad_setpoints=vehicle.params.reject_bad_setpoints,
    )
    pilot.start_at(vehicle.origin)
    report = _reporter(vehicle, pilot)
    link, *others = vehicle.sign(pilot, PX4_RULES)
    endpoint = Endpoint(vehicle.sysid, link, pilot, report, step_us=vehicle.step_us)
    interfaces: list[MavlinkInterface] = [endpoint]
    for other in others:
        ground = Endpoint(vehicle.sysid, other, pilot, report, step_us=vehicle.step_us, default_hz=GCS_HZ)
        endpoint.join(ground)
        interfaces.append(ground)
    return pilot, interfaces


def _reporter(vehicle: SimulatedVehicle, pilot: Autopilot) -> Callable[[], Report]:
    cached: list[Report] = []  # of the newest step, for the other link

    def report() -> Report:
        now_us = vehicle.since_boot_us()
        if cached and cached[0].simulation_us == now_us:
            return cached[0]
        made = Report(
            estimate=pilot.boot.local(vehicle.estimate()),
            autopilot=pilot,
            origin=pilot.boot.origin or vehicle.origin,
            rotor_01=lambda: vehicle.plant.rotor_01(vehicle.number),
            force_frd_m_s2=lambda: vehicle.imu.of(vehicle.number),
            simulation_us=now_us,
        )
        cached[:] = [made]
        return made

    return report
