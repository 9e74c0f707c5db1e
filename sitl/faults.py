"""Faults: the effect of each kind on a world at its begin and its end.

A fault replaces an earlier one of the same kind on the same vehicle (and rotor, and direction of its links), but jumps,
gusts and winds, which add up. Where the directions of two overlap, the newer one acts, and what still runs when it ends
acts again. All times are simulated.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol

import numpy as np

from sitl.net.lossy import LinkDirection, LossyLink
from sitl.plant.estimator import Estimator
from sitl.plant.physics import Physics
from sitl.plant.wind import Gust, WindStep
from swarmctl.core.types import Array
from swarmctl.simulator_config import EVERY_VEHICLE, FaultParams

Undo = Callable[[], None]
_NEVER_US = 1 << 62


class FaultTarget(Protocol):
    """The interface of a world that faults act on."""

    @property
    def physics(self) -> Physics:
        """Plant, air and battery."""

    @property
    def estimator(self) -> Estimator:
        """Estimates of all vehicles."""

    def links_of(self, vehicle: int) -> Sequence[LossyLink]:
        """Return every link of a vehicle."""

    def reboot(self, vehicle: int, now_us: int) -> None:
        """Restart the autopilot of a vehicle."""


def _gps_loss(world: FaultTarget, vehicle: int, fault: FaultParams, now_us: int) -> Undo:
    world.estimator.lose_gps(vehicle)
    return lambda: world.estimator.find_gps(vehicle)


def _estimator_jump(world: FaultTarget, vehicle: int, fault: FaultParams, now_us: int) -> Undo:
    by_ned_m = fault.amount * _towards(fault)
    world.estimator.jump(vehicle, by_ned_m)
    return lambda: world.estimator.jump(vehicle, -by_ned_m)


def _estimator_freeze(world: FaultTarget, vehicle: int, fault: FaultParams, now_us: int) -> Undo:
    world.estimator.freeze(vehicle, now_us)
    return lambda: world.estimator.thaw(vehicle)


def _motor(world: FaultTarget, vehicle: int, fault: FaultParams, now_us: int) -> Undo:
    world.physics.set_rotor_health(vehicle, fault.rotor, fault.amount)
    return lambda: world.physics.set_rotor_health(vehicle, fault.rotor, 1.0)


def _mass(world: FaultTarget, vehicle: int, fault: FaultParams, now_us: int) -> Undo:
    world.physics.set_mass(vehicle, fault.amount)
    return lambda: world.physics.set_mass(vehicle, 1.0)


def _gust(world: FaultTarget, vehicle: int, fault: FaultParams, now_us: int) -> Undo:
    gust = Gust(peak_ned_m_s=_blown(world, vehicle, fault), from_s=now_us * 1e-6, for_s=fault.for_s)
    world.physics.air.gusts.append(gust)
    return lambda: None  # a gust ends by itself


def _wind(world: FaultTarget, vehicle: int, fault: FaultParams, now_us: int) -> Undo:
    gusts, step = world.physics.air.gusts, WindStep(_blown(world, vehicle, fault))
    gusts.append(step)
    return lambda: gusts.remove(step)


def _battery(world: FaultTarget, vehicle: int, fault: FaultParams, now_us: int) -> Undo:
    world.physics.drain(vehicle, fault.amount)
    return lambda: None


def _reboot(world: FaultTarget, vehicle: int, fault: FaultParams, now_us: int) -> Undo:
    world.reboot(vehicle, now_us)
    return lambda: None


def _link(impairment: str) -> Callable[[FaultTarget, int, FaultParams, int], Undo]:
    def begin(world: FaultTarget, vehicle: int, fault: FaultParams, now_us: int) -> Undo:
        directions = list(_directions(world.links_of(vehicle), fault.direction))

        def put(amount: float) -> None:
            for direction in directions:
                direction.set_impairment(impairment, amount)

        put(fault.amount)
        return lambda: put(0.0)

    return begin


_BEGIN: dict[str, Callable[[FaultTarget, int, FaultParams, int], Undo]] = {
    "gps_loss": _gps_loss,
    "estimator_jump": _estimator_jump,
    "estimator_freeze": _estimator_freeze,
    "motor": _motor,
    "link_loss": _link("loss_01"),
    "link_delay": _link("delay_ms"),
    "link_jitter": _link("jitter_ms"),
    "link_duplicate": _link("duplicate_01"),
    "link_reorder": _link("reorder_01"),
    "link_corrupt": _link("corrupt_01"),
    "gust": _gust,
    "wind": _wind,
    "battery": _battery,
    "mass": _mass,
    "reboot": _reboot,
}
_ADD_UP = frozenset({"estimator_jump", "gust", "wind"})
_OF_LINKS = frozenset(kind for kind in _BEGIN if kind.startswith("link_"))


class Faults:
    """Begins and ends the faults of one world, whose vehicles are numbered from `first` on in faults and events.

    Attributes:
        on_event: called at every begin and end with name, time since boot [us] and fields.
    """

    def __init__(self, world: FaultTarget, scheduled: Iterable[FaultParams], vehicles: int, first: int = 0) -> None:
        self.on_event: Callable[[str, int, dict[str, Any]], None] = lambda name, t_us, fields: None
        self._world = world
        self._vehicles, self._first = vehicles, first
        self._waiting = sorted(scheduled, key=lambda fault: fault.at_s)
        self._running: dict[tuple[Any, ...], tuple[int, FaultParams, int, Undo]] = {}
        self._numbers = itertools.count()  # of faults that add up, which replace none
        self._next_us = self._earliest_us()

    def step(self, now_us: int) -> None:
        """Begin and end the faults that are due at `now_us` since boot."""
        if now_us < self._next_us:
            return
        for key, (end_us, fault, vehicle, undo) in list(self._running.items()):
            if now_us >= end_us:
                del self._running[key]
                self._end(fault, vehicle, undo, now_us)
                self._tell("fault_ended", now_us, fault, vehicle)
        while self._waiting and self._waiting[0].at_s * 1e6 <= now_us:
            self._begin(self._waiting.pop(0), now_us)
        self._next_us = self._earliest_us()

    def begin(self, fault: FaultParams, now_us: int) -> None:
        """Begin a fault now, whatever its `at_s`."""
        self._begin(fault, now_us)
        self._next_us = self._earliest_us()

    def _begin(self, fault: FaultParams, now_us: int) -> None:
        for vehicle in range(self._vehicles) if fault.vehicle == EVERY_VEHICLE else (fault.vehicle - self._first,):
            key: tuple[Any, ...] = (fault.kind, vehicle, fault.rotor, fault.direction)
            if fault.kind in _ADD_UP:
                key = (*key, next(self._numbers))
            before = self._running.pop(key, None)
            if before is not None:
                self._end(*before[1:], now_us)
            undo = _BEGIN[fault.kind](self._world, vehicle, fault, now_us)
            if fault.for_s:
                self._running[key] = (now_us + round(fault.for_s * 1e6), fault, vehicle, undo)
            self._tell("fault_began", now_us, fault, vehicle)

    def _end(self, fault: FaultParams, vehicle: int, undo: Undo, now_us: int) -> None:
        """End a fault that no longer runs; others that act on some of the same links go on."""
        undo()
        if fault.kind in _OF_LINKS:
            for _, other, its_vehicle, _ in self._running.values():
                if (other.kind, its_vehicle) == (fault.kind, vehicle):
                    _BEGIN[other.kind](self._world, vehicle, other, now_us)

    def _earliest_us(self) -> int:
        ends = [end_us for end_us, *_ in self._running.values()]
        starts = [round(self._waiting[0].at_s * 1e6)] if self._waiting else []
        return min(ends + starts, default=_NEVER_US)

    def _tell(self, name: str, now_us: int, fault: FaultParams, vehicle: int) -> None:
        fields = {"kind": fault.kind, "vehicle": self._first + vehicle, "value": fault.amount, "for_s": fault.for_s}
        self.on_event(name, now_us, fields)


def _blown(world: FaultTarget, vehicle: int, fault: FaultParams) -> Array:
    """Return the velocity (3, N) NED [m/s] of a gust or step on one vehicle."""
    velocity = np.zeros((3, world.physics.plant.state.shape[1]))
    velocity[:, vehicle] = fault.amount * _towards(fault)
    return velocity


def _towards(fault: FaultParams) -> Array:
    azimuth_rad = math.radians(fault.towards_deg)
    return np.array([math.cos(azimuth_rad), math.sin(azimuth_rad), 0.0])


def _directions(links: Sequence[LossyLink], direction: str) -> Iterable[LinkDirection]:
    for link in links:
        if direction in ("both", "to_vehicle"):
            yield link.to_vehicle
        if direction in ("both", "from_vehicle"):
            yield link.from_vehicle
