"""Physics of all vehicles of a world: plant, attitude loops, air, battery and estimators.

One call does one physics step; weather and battery change every `slow_every` steps. It knows no modes and no MAVLink.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sitl.plant.airframes import Preset
from sitl.plant.attitude import AttitudeLoop
from sitl.plant.battery import Battery
from sitl.plant.estimator import Estimator
from sitl.plant.sensors import Power
from sitl.plant.vehicle import Plant
from sitl.plant.wind import Air
from swarmctl.core.types import Array
from swarmctl.simulator_config import SimulatorParams


class Physics:
    """Steps everything but the autopilots.

    Attributes:
        rotor_health_01: (4, N) share of its force that each rotor keeps; 1 without a fault.
    """

    def __init__(
        self,
        plant: Plant,
        attitude: AttitudeLoop,
        estimator: Estimator,
        params: SimulatorParams,
        *,
        seed: int,
        first_vehicle: int,
        slow_every: int,
    ) -> None:
        count = plant.state.shape[1]
        self.plant, self.attitude, self.estimator = plant, attitude, estimator
        self.air = Air(params.wind, count, slow_every * plant.dt_s, seed, first_vehicle=first_vehicle)
        self.battery = Battery(params.battery, plant.preset, count)
        self.rotor_health_01 = np.ones((4, count))
        self._slow_every = slow_every
        self._steps = 0
        self._windy = False

    def step(self, t_s: float, wrench: Array, live: Array | None) -> None:
        """Advance to `t_s` since boot under collective thrusts `wrench[0]`; the rest of it (4, N) is filled in here.

        `live` is that of `AttitudeLoop.torque`.
        """
        if self._steps % self._slow_every == 0:
            self._weather(t_s)
            self._draw_power()
        self._steps += 1
        self.attitude.torque(self.estimator.sensed, live, wrench[1:])
        self.plant.step(self.plant.mixer.allocate(wrench))
        self.estimator.advance()

    def set_rotor_health(self, vehicle: int, rotor: int, health_01: float) -> None:
        """Limit a rotor to this share of its force."""
        self.rotor_health_01[rotor, vehicle] = health_01
        self._share_force()

    def set_mass(self, vehicle: int, ratio: float) -> None:
        """Set the mass, relative to the mass at the start."""
        if self.plant.mass_ratio is None:
            self.plant.mass_ratio = np.ones(self.plant.state.shape[1])
        self.plant.mass_ratio[vehicle] = ratio

    def drain(self, vehicle: int, charge_01: float) -> None:
        """Discharge a battery to this level, as a fault."""
        self.battery.drain_to(vehicle, charge_01)
        self._share_force()
        self._tell_power()

    def _weather(self, t_s: float) -> None:
        blows = not self.air.still
        if blows:
            plant = self.plant
            plant.set_wind(self.air.velocity_ned_m_s(t_s, plant.height_m, plant.vel_ned_m_s))
        elif self._windy:
            self.plant.set_wind(None)
        self._windy = blows

    def _draw_power(self) -> None:
        if not self.battery.modelled:
            return
        self.battery.advance(self._slow_every * self.plant.dt_s, self.plant.rotor_force_n)
        self._share_force()
        self._tell_power()

    def _share_force(self) -> None:
        self.plant.rotor_share_01 = self.rotor_health_01 * self.battery.force_01

    def _tell_power(self) -> None:
        battery = self.battery
        amperes = battery.amperes if battery.modelled else np.full(len(battery.charge_01), -1.0)
        rows = zip(battery.charge_01.tolist(), battery.volts.tolist(), amperes.tolist(), strict=True)
        self.estimator.power = [Power(*row) for row in rows]


def outfitted(preset: Preset, params: SimulatorParams) -> Preset:
    """Return the airframe with the requested rotor lag and drag."""
    drag = tuple(k * params.drag_scale for k in preset.drag_n_s_m)
    tau_s = preset.motor_tau_s if params.motor_tau_s is None else params.motor_tau_s
    return replace(preset, drag_n_s_m=(drag[0], drag[1], drag[2]), motor_tau_s=tau_s)
