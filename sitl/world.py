"""All vehicles of one simulation: one plant, one autopilot and one MAVLink endpoint each, stepped together.

The world has no clock and no thread. `step(now_us)` advances it by one physics step *to* `now_us`; the same calls with
the same bytes give the same flight. Setpoints that have arrived by then act in that very step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sitl.attitude import THESIS_GAINS, attitude_loop
from sitl.autopilot import IDLE, Autopilot
from sitl.endpoint import Endpoint
from sitl.navigator import Navigator
from sitl.parameters import Parameters
from sitl.sensors import Estimate, estimate_of, local_origin
from sitl.streams import Report
from sitl.vehicle import PRESETS, Array, Plant
from swarmctl.core.records import TRUTH_DTYPE
from swarmctl.core.types import GeoOrigin
from swarmctl.errors import ConfigError
from swarmctl.links.transport import Transport

AUTOPILOT_HZ = 50
MAX_VEHICLES = 100


@dataclass(frozen=True, slots=True)
class SitlParams:
    """What to simulate. `spawn_ned_m` (N, 3) is in the shared frame, whose origin the next three give."""

    vehicles: int
    spawn_ned_m: Array
    preset: str = "thesis"
    attitude_gains: str = "swarm"  # of sitl.attitude.THESIS_GAINS
    origin_lat_deg: float = 47.397742
    origin_lon_deg: float = 8.545594
    origin_alt_m: float = 489.4
    seed: int = 1
    physics_hz: int = 250
    mass_scale: float = 1.0
    start: Literal["ground", "air"] = "ground"
    ekf_ready_s: float = 1.0  # PX4 takes 4 s
    sysid_base: int = 1

    def __post_init__(self) -> None:
        problems = list(self._problems())
        if problems:
            raise ConfigError("sitl", problems)

    def _problems(self) -> Iterator[str]:
        ranges: tuple[tuple[str, float, float, float], ...] = (
            ("vehicles", self.vehicles, 1, MAX_VEHICLES),
            ("origin_lat_deg", self.origin_lat_deg, -89.9, 89.9),
            ("origin_lon_deg", self.origin_lon_deg, -180, 180),
            ("origin_alt_m", self.origin_alt_m, -500, 9000),
            ("seed", self.seed, 0, 2**31 - 1),
            ("physics_hz", self.physics_hz, 50, 1000),
            ("mass_scale", self.mass_scale, 0.3, 1.9),
            ("ekf_ready_s", self.ekf_ready_s, 0, 60),
            ("sysid_base", self.sysid_base, 1, 256 - self.vehicles),
        )
        for key, value, low, high in ranges:
            if not low <= value <= high:
                yield f"{key} = {value}: allowed: {low} to {high}"
        if self.preset not in PRESETS:
            yield f"preset = {self.preset!r}: allowed: {', '.join(PRESETS)}"
        if self.attitude_gains not in THESIS_GAINS:
            yield f"attitude_gains = {self.attitude_gains!r}: allowed: {', '.join(THESIS_GAINS)}"
        if self.start not in ("ground", "air"):
            yield f"start = {self.start!r}: allowed: ground, air"
        if self.spawn_ned_m.shape != (self.vehicles, 3):
            yield f"spawn = {len(self.spawn_ned_m)} positions: allowed: one x,y,z for each of {self.vehicles} vehicles"
        elif not (np.isfinite(self.spawn_ned_m).all() and np.abs(self.spawn_ned_m).max(initial=0) <= 1e5):
            yield f"spawn = {self.spawn_ned_m.tolist()}: allowed: -100000 to 100000 m"


def line_of_spawns(vehicles: int) -> Array:
    """Default spawn positions (N, 3): along x, 1 m apart, centred, on z = 0."""
    spawns = np.zeros((vehicles, 3))
    spawns[:, 0] = np.arange(vehicles) - (vehicles - 1) / 2
    return spawns


class SitlWorld:
    """The simulation; `transports` are the vehicle ends of the links, in vehicle order."""

    def __init__(self, params: SitlParams, transports: Sequence[Transport]) -> None:
        if len(transports) != params.vehicles:
            raise ValueError(f"transports: {len(transports)} for {params.vehicles} vehicles")
        self.params = params
        count, dt_s = params.vehicles, 1.0 / params.physics_hz
        preset = PRESETS[params.preset]
        shared = GeoOrigin(params.origin_lat_deg, params.origin_lon_deg, params.origin_alt_m)
        self.origins = [local_origin(spawn, shared) for spawn in params.spawn_ned_m]
        self._offset_ned_m = np.array([origin.offset_ned_m for origin in self.origins])  # (N, 3)
        airborne = params.start == "air"
        self.plant = Plant(
            preset,
            params.spawn_ned_m - self._offset_ned_m,  # local: the spawn itself is exact, its origin is rounded
            dt_s,
            ground=not airborne,
            mass_scale=params.mass_scale,
        )
        self.plant.held[:] = airborne
        self.attitude = attitude_loop(preset, count, dt_s, params.attitude_gains)
        self.autopilots: list[Autopilot] = []
        self.endpoints: list[Endpoint] = []
        for i, transport in enumerate(transports):
            table = Parameters(params.sysid_base + i)
            navigator = Navigator(table, self.plant.hover_thrust_01)
            pilot = Autopilot(table, navigator, ekf_ready_us=round(params.ekf_ready_s * 1e6), airborne=airborne)
            pilot.origin_alt_m = self.origins[i].alt_mm / 1e3
            self.autopilots.append(pilot)
            self.endpoints.append(
                Endpoint(params.sysid_base + i, transport, pilot, self._reporter(i), round(dt_s * 1e6))
            )
        self._wrench = np.zeros((4, count))
        self._live = np.zeros(count)
        self._powered = np.zeros(count, dtype=bool)
        self._flown = [IDLE] * count
        self._boot_us: int | None = None
        self._now_us = 0
        self._steps = 0
        self._autopilot_every = max(1, round(params.physics_hz / AUTOPILOT_HZ))

    def step(self, now_us: int) -> None:
        """One physics step that ends at `now_us` (monotonic); then everything due is sent, stamped with it."""
        if self._boot_us is None:
            self._boot_us = now_us - round(1e6 / self.params.physics_hz)
        since_boot_us = now_us - self._boot_us
        for endpoint in self.endpoints:
            endpoint.receive(since_boot_us, now_us)
        if self._steps % self._autopilot_every == 0:
            for i, pilot in enumerate(self.autopilots):
                pilot.tick(
                    estimate_of(self.plant, i, since_boot_us), since_boot_us, self._autopilot_every * self.plant.dt_s
                )
        self._steps += 1
        self._take_outputs()
        self.attitude.torque(self.plant, self._live, self._wrench[1:])
        self.plant.step(self.plant.mixer.allocate(self._wrench))
        self._now_us = now_us
        for endpoint in self.endpoints:
            endpoint.send_due(since_boot_us)

    def truth_rows(self) -> NDArray[np.void]:
        """True states (N,) of `TRUTH_DTYPE`, shared frame."""
        rows = np.zeros(self.params.vehicles, TRUTH_DTYPE)
        rows["t_us"] = self._now_us
        rows["vehicle"] = np.arange(self.params.vehicles)
        rows["pos_ned_m"] = self.plant.pos_ned_m.T + self._offset_ned_m
        rows["vel_ned_m_s"] = self.plant.vel_ned_m_s.T
        rows["q_nb"] = self.plant.q_nb.T
        rows["armed"] = [pilot.armed for pilot in self.autopilots]
        rows["landed"] = [pilot.landed for pilot in self.autopilots]
        rows["flight_mode"] = [pilot.flight_mode() for pilot in self.autopilots]
        return rows

    def set_wind(self, wind_ned_m_s: Sequence[float]) -> None:
        """Steady wind (3,) NED [m/s] on every vehicle."""
        wind = np.array(wind_ned_m_s, dtype=np.float64).reshape(3, 1)
        self.plant.set_wind(np.repeat(wind, self.params.vehicles, axis=1) if wind.any() else None)

    def _take_outputs(self) -> None:
        """Hand changed setpoints to the attitude loops; open clamps; note who flies."""
        thrust_max_n = self.plant.preset.thrust_max_n
        for i, pilot in enumerate(self.autopilots):
            output = pilot.output
            if output is not self._flown[i]:
                self._flown[i] = output
                self.attitude.set_reference(i, output.q_nb)
                self._wrench[0, i] = output.thrust_01 * thrust_max_n
                self._powered[i] = output is not IDLE
            if pilot.released and self.plant.held[i]:
                self.plant.held[i] = False
        np.logical_and(self._powered, ~self.plant.contact, out=self._live, casting="unsafe")
        self._live *= ~self.plant.held

    def _reporter(self, vehicle: int) -> Callable[[], Report]:
        plant, pilot, origin = self.plant, self.autopilots[vehicle], self.origins[vehicle]
        rotor_scale = 1.0 / plant.preset.rotor_force_max_n

        def report() -> Report:
            estimate: Estimate = estimate_of(plant, vehicle, self._now_us - (self._boot_us or 0))
            return Report(estimate, pilot, origin, tuple((plant.rotor_force_n[:, vehicle] * rotor_scale).tolist()))

        return report
