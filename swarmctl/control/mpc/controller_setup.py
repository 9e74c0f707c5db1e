"""What a controller is told once, the same for every kind of controller."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.model import VehicleModelParams
from swarmctl.core.flight_volume import FlightVolume


@dataclass(frozen=True, slots=True, kw_only=True)
class ControllerSetup:
    """Holds what a controller is told beside its own parameters."""

    vehicle: VehicleModelParams
    separation: SeparationParams
    agent: int  # its number is its priority
    max_keep_outs: int  # at once
    stopwatch_ns: Callable[[], int]  # measures and has no influence
    volume: FlightVolume | None = None  # to stay in
