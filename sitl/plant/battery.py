"""One lithium-polymer pack per vehicle: used charge, sagging voltage, and the resulting loss of thrust.

Rotor power is momentum theory's T^1.5 / sqrt(2 rho A) over one efficiency for propeller, motor and controller. Thrust
is proportional to the square of the rotor's terminal voltage; the airframe's force limit is that of a full pack.
"""

from __future__ import annotations

import math

import numpy as np

from sitl.plant.airframes import Preset
from swarmctl.core.types import Array
from swarmctl.simulator_config import BatteryParams

_AIR_KG_M3 = 1.225
_EFFICIENCY = 0.55
_CHARGE_01 = (0.0, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0)
_CELL_V = (3.0, 3.45, 3.6, 3.7, 3.78, 3.88, 4.02, 4.2)  # at rest
_EMPTY_V = 2.5  # lower limit of a cell's voltage


class Battery:
    """Packs of all vehicles.

    Attributes:
        charge_01: (N,) remaining charge.
        volts: (N,) under load.
        amperes: (N,) current drawn.
        force_01: (N,) available rotor force over that of a full pack.
    """

    def __init__(self, params: BatteryParams, preset: Preset, vehicles: int) -> None:
        self._capacity_c = params.capacity_mah * 3.6
        self._resistance_ohm = params.resistance_ohm
        self._cells = preset.cells
        self._watts_per_n15 = 1.0 / (math.sqrt(2.0 * _AIR_KG_M3 * math.pi * preset.rotor_radius_m**2) * _EFFICIENCY)
        self.charge_01 = np.full(vehicles, params.charge_01 if self.modelled else 1.0)
        self.amperes = np.zeros(vehicles)
        self.volts = self._resting_volts()
        self.force_01 = self._force()

    @property
    def modelled(self) -> bool:
        """Whether any current is modelled."""
        return self._capacity_c > 0

    @property
    def full_volts(self) -> float:
        return self._cells * _CELL_V[-1]

    def drain_to(self, vehicle: int, charge_01: float) -> None:
        """Remove charge down to a level, as a fault; charge is never added."""
        self.charge_01[vehicle] = min(charge_01, self.charge_01[vehicle])
        self._load()

    def advance(self, dt_s: float, rotor_force_n: Array) -> None:
        """Draw for `dt_s` what rotors at `rotor_force_n` (4, N) need."""
        if not self.modelled:
            return
        watts = self._watts_per_n15 * np.sum(np.maximum(rotor_force_n, 0.0) ** 1.5, axis=0)
        self.amperes = watts / self.volts
        self.charge_01 = np.maximum(0.0, self.charge_01 - self.amperes * dt_s / self._capacity_c)
        self._load()

    def _load(self) -> None:
        self.volts = np.maximum(self._resting_volts() - self.amperes * self._resistance_ohm, self._cells * _EMPTY_V)
        self.force_01 = self._force()

    def _resting_volts(self) -> Array:
        volts: Array = self._cells * np.interp(self.charge_01, _CHARGE_01, _CELL_V)
        return volts

    def _force(self) -> Array:
        ratio = self.volts / self.full_volts
        force: Array = ratio * ratio if self.modelled else np.ones_like(ratio)
        return force
