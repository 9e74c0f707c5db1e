"""All vehicles of a simulation, stepped together: one plant, and one autopilot and MAVLink endpoint per vehicle.

The world has no clock and no thread. `step(now_us)` advances it by one physics step *to* `now_us`; the same calls with
the same bytes give the same flight. Setpoints that have arrived by then act in that step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from sitl.autopilot_kinds import AUTOPILOT_KINDS
from sitl.faults import Faults
from sitl.net.lossy import LossyLink
from sitl.net.signing import SigningLink, SigningRules, VehicleSigning
from sitl.plant.airframes import PRESETS
from sitl.plant.attitude import attitude_loop
from sitl.plant.estimator import ESTIMATORS, Estimator
from sitl.plant.imu import Imu
from sitl.plant.physics import Physics, outfitted
from sitl.plant.sensors import FULL, local_origin
from sitl.plant.vehicle import Plant
from sitl.vehicle_parts import IDLE, Commander, MavlinkInterface, SimulatedVehicle
from swarmctl.core.recorded.records import TRUTH_DTYPE
from swarmctl.core.types import Array, FlightMode, GeoOrigin
from swarmctl.mavlink.signing.signature import SigningKey
from swarmctl.mavlink.transport import Transport
from swarmctl.simulator_config import SimulatorConfig

AUTOPILOT_HZ = 50
_LINK_PURPOSE, _GCS_LINK_PURPOSE = 3, 4  # purposes of random streams, beside run seed and vehicle of the swarm


@runtime_checkable
class Metered(Protocol):
    """An autopilot that reports its battery."""

    battery_01: float
    battery_v: float
    battery_a: float


class SitlWorld:
    """The simulation. `transports` are the vehicle ends of the links, in vehicle order.

    `gcs_transports` are those of a second link per vehicle, to a ground station, as in PX4. `keys` are those of
    vehicles that sign from the start; empty: none does, until it is set up. `stepped` are the vehicles whose autopilots
    are stepped here; empty: all. The others stand idle, and keep the numerics of the plant what they are with all:
    products of matrices round by the number of columns.
    """

    def __init__(
        self,
        params: SimulatorConfig,
        transports: Sequence[Transport],
        gcs_transports: Sequence[Transport] = (),
        keys: Sequence[SigningKey | None] = (),
        stepped: range = range(0),
    ) -> None:
        if len(transports) != params.vehicles or len(gcs_transports) not in (0, params.vehicles):
            raise ValueError(f"transports: {len(transports)} and {len(gcs_transports)} for {params.vehicles} vehicles")
        self.params = params
        count = params.vehicles
        shared = GeoOrigin(params.origin_lat_deg, params.origin_lon_deg, params.origin_alt_m)
        spawns_ned_m = np.array(params.spawns_ned_m())  # (N, 3)
        self.origins = [local_origin(spawn, shared) for spawn in spawns_ned_m]
        self._offset_ned_m = np.array([origin.offset_ned_m for origin in self.origins])  # (N, 3)
        self._autopilot_every = max(1, round(params.physics_hz / AUTOPILOT_HZ))
        self._make_plant(spawns_ned_m - self._offset_ned_m)  # local: the spawn is exact, its origin is rounded
        self.autopilots: list[Commander] = []
        self.endpoints: list[MavlinkInterface] = []
        self._links = self._lossy(transports, _LINK_PURPOSE)
        self.gcs_endpoints: list[MavlinkInterface] = []
        self._gcs_links = self._lossy(gcs_transports, _GCS_LINK_PURPOSE)
        self.signing: list[VehicleSigning] = []
        self._keys = keys
        self._kind = AUTOPILOT_KINDS[params.autopilot_kind]
        for i in range(count):
            pilot, interfaces = self._kind.build(self._vehicle(i))
            self.autopilots.append(pilot)
            self.endpoints.append(interfaces[0])
            self.gcs_endpoints.extend(interfaces[1:])
        self._stepped = stepped or range(count)
        self._metered = [pilot if isinstance(pilot, Metered) else None for pilot in self.autopilots]
        self._speaking = [self.endpoints[i] for i in self._stepped]
        self._wrench = np.zeros((4, count))
        self._powered = np.zeros(count, dtype=bool)
        self._kept = np.zeros(count, dtype=bool)  # on the ground or clamped
        self._clamped = set(range(count)) if params.start == "air" else set()
        self._flown = [IDLE] * count
        self._boot_us: int | None = None
        self._now_us = 0
        self._steps = 0
        self.faults = Faults(self, params.faults, count, params.first_vehicle)

    def _lossy(self, transports: Sequence[Transport], purpose: int) -> list[LossyLink]:
        seed, first = self.params.seed, self.params.first_vehicle
        return [LossyLink(link, (seed, first + i, purpose)) for i, link in enumerate(transports)]

    def _make_plant(self, spawns_local_ned_m: Array) -> None:
        """Make the vehicles at their spawns (N, 3), and what measures them and keeps their attitude."""
        params, dt_s, airborne = self.params, 1.0 / self.params.physics_hz, self.params.start == "air"
        preset = outfitted(PRESETS[params.preset], params)
        self.plant = Plant(
            preset,
            spawns_local_ned_m,
            dt_s,
            ground=not airborne,
            below_z_m=params.ground_z_m - self._offset_ned_m[:, 2],
            mass_scale=params.mass_scale,
            thrust_curve_01=params.thrust_curve_01,
            ground_effect=params.ground_effect,
        )
        self.plant.held[:] = airborne
        first = params.first_vehicle
        self.estimator = Estimator(ESTIMATORS[params.estimator], self.plant, params.seed, first_vehicle=first)
        self.attitude = attitude_loop(preset, params.vehicles, dt_s, params.attitude_gains)
        self.physics = Physics(
            self.plant,
            self.attitude,
            self.estimator,
            params,
            seed=params.seed,
            first_vehicle=first,
            slow_every=self._autopilot_every,
        )
        self.imu = Imu(self.plant, self._autopilot_every * dt_s)

    def step(self, now_us: int) -> None:
        """Do one physics step that ends at `now_us` (monotonic); then send everything due, stamped with it."""
        if self._boot_us is None:
            self._boot_us = now_us - round(1e6 / self.params.physics_hz)
        since_boot_us = now_us - self._boot_us
        self.faults.step(since_boot_us)
        self.receive(now_us)
        if self._steps % self._autopilot_every == 0:
            self.imu.sample()
            for i in self._stepped:
                pilot = self.autopilots[i]
                estimate = self.estimator.of(i, since_boot_us)
                metered = self._metered[i]
                if metered is not None and estimate.battery is not FULL:
                    metered.battery_01, metered.battery_v, metered.battery_a = estimate.battery
                pilot.tick(estimate, since_boot_us, self._autopilot_every * self.plant.dt_s)
        self._steps += 1
        self._take_outputs()
        self.physics.step(since_boot_us * 1e-6, self._wrench, self._live())
        self._now_us = now_us
        for endpoint in self._speaking:
            endpoint.send_due(since_boot_us)
        for endpoint in self.gcs_endpoints:
            endpoint.send_due(since_boot_us)

    def receive(self, now_us: int) -> None:
        """Handle everything that has arrived, without a step."""
        since_boot_us = now_us - (now_us if self._boot_us is None else self._boot_us)
        for endpoint in self._speaking:
            endpoint.receive(since_boot_us, now_us)
        for endpoint in self.gcs_endpoints:
            endpoint.receive(since_boot_us, now_us)

    def offboard_vehicles(self) -> set[int]:
        """Return the vehicles that a client flies now."""
        return {i for i, p in enumerate(self.autopilots) if p.armed and p.flight_mode() == FlightMode.EXTERNAL}

    def setpoint_counts(self) -> list[int]:
        """Return the number of SET_ATTITUDE_TARGET frames per vehicle since the first call."""
        return [sum(link.setpoints() for link in self.links_of(i)) for i in range(self.params.vehicles)]

    def scale_timeouts(self, speed: float) -> None:
        """Keep timeouts constant in wall time, as PX4 does when it starts a simulation faster than real time."""
        for pilot in self.autopilots:
            for name in self._kind.scaled_timeouts:
                pilot.parameters.assign(name, speed * pilot.parameters.real(name))

    @property
    def boot_us(self) -> int:
        """Begin of the simulation, on the clock it is stepped by; 0 before the first step."""
        return self._boot_us or 0

    @property
    def since_boot_us(self) -> int:
        """Simulated time of the newest step, the time base of faults and stamps."""
        return 0 if self._boot_us is None else self._now_us - self._boot_us

    def links_of(self, vehicle: int) -> Sequence[LossyLink]:
        """Return every link of a vehicle, for faults."""
        return self._links[vehicle : vehicle + 1] + self._gcs_links[vehicle : vehicle + 1]

    def reboot(self, vehicle: int, now_us: int) -> None:
        """Restart an autopilot; its vehicle moves on by physics."""
        self.endpoints[vehicle].reboot(now_us)

    def truth_rows(self) -> NDArray[np.void]:
        """Return true states (N,) of `TRUTH_DTYPE`, shared frame."""
        rows = np.zeros(self.params.vehicles, TRUTH_DTYPE)
        rows["t_us"] = self._now_us
        rows["vehicle"] = np.arange(self.params.vehicles) + self.params.first_vehicle
        rows["pos_ned_m"] = self.plant.pos_ned_m.T + self._offset_ned_m
        rows["vel_ned_m_s"] = self.plant.vel_ned_m_s.T
        rows["q_nb"] = self.plant.q_nb.T
        rows["armed"] = [pilot.armed for pilot in self.autopilots]
        rows["landed"] = [pilot.landed for pilot in self.autopilots]
        rows["flight_mode"] = [pilot.flight_mode() for pilot in self.autopilots]
        return rows

    def set_wind(self, wind_ned_m_s: Sequence[float]) -> None:
        """Set a steady wind (3,) NED [m/s] on every vehicle."""
        self.physics.air.mean_ned_m_s = np.array(wind_ned_m_s, dtype=np.float64).reshape(3, 1)

    def _take_outputs(self) -> None:
        """Pass changed setpoints to the attitude loops, and open clamps."""
        thrust_max_n = self.plant.preset.thrust_max_n
        for i in self._stepped:
            output = self.autopilots[i].output
            if output is not self._flown[i]:
                self._flown[i] = output
                self.attitude.set_reference(i, output.q_nb)
                self.attitude.rates.set(i, output.rate_frd_rad_s, output.feed_frd_rad_s)
                self._wrench[0, i] = 0.0 if output.stopped else output.thrust_01 * thrust_max_n
                self._powered[i] = not (output.stopped or output.loose)
        for i in [i for i in self._clamped if self.autopilots[i].released]:
            self._clamped.remove(i)
            self.plant.held[i] = False

    def _live(self) -> Array | None:
        """Return 1.0 for vehicles in free flight and 0.0 for the others (N,); None when all are in free flight."""
        np.logical_or(self.plant.contact, self.plant.held, out=self._kept)
        live = np.greater(self._powered, self._kept)
        return live.astype(np.float64) if False in live.tolist() else None

    def _vehicle(self, number: int) -> SimulatedVehicle:
        return SimulatedVehicle(
            number=number,
            params=self.params,
            origin=self.origins[number],
            plant=self.plant,
            imu=self.imu,
            since_boot_us=lambda: self.since_boot_us,
            estimate=lambda: self.estimator.of(number, self.since_boot_us),
            sign=lambda pilot, rules: self._signed(number, pilot, rules),
        )

    def _signed(self, vehicle: int, pilot: Commander, rules: SigningRules) -> list[SigningLink]:
        """Return the links of a vehicle with its signatures."""
        signing = VehicleSigning(
            rules=rules, armed=lambda: pilot.armed, boot_us=lambda: pilot.boot.at_us, tell=pilot.send_text
        )
        self.signing.append(signing)
        signing.key = self._keys[vehicle] if self._keys else None
        sysid = self.params.sysid_base + vehicle
        return [SigningLink(link, signing, number, sysid) for number, link in enumerate(self.links_of(vehicle))]
