"""Each vehicle draws its errors, its turbulence and its losses by its number in the swarm, on whatever host it is."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

from sitl.world import SitlWorld
from swarmctl.config import load
from swarmctl.core.clock import SimClock
from swarmctl.core.types import Array
from swarmctl.mavlink.transport import pipe_pair
from tests.benches.flown_world import FlownWorld

DRAWN = (
    "swarm.agents=4",
    "seed=7",
    "sitl.start=air",
    "sitl.estimator=px4_gps",
    "sitl.wind.turbulence_m_s=8.0",
    "sitl.faults=[{kind='link_loss',value=0.5},{kind='gps_loss',at_s=0.1}]",
)


def simulated(agents: Sequence[int] = ()) -> SitlWorld:
    """Return the world of these agents' vehicles after half a second."""
    params, clock = load(None, DRAWN).simulator(agents), SimClock()
    world = SitlWorld(params, [pipe_pair(clock.now_us, 0)[1] for _ in range(params.vehicles)])
    for _ in range(params.physics_hz // 2):
        clock.advance(round(1e6 / params.physics_hz))
        world.step(clock.now_us())
    return world


def errors_ned_m(world: SitlWorld, vehicle: int) -> Array:
    """Return by how much a vehicle's estimate is off."""
    estimate = world.estimator.of(vehicle, world.since_boot_us)
    return np.array(estimate.pos_ned_m) - world.plant.pos_ned_m[:, vehicle]


def wind_ned_m_s(world: SitlWorld, vehicle: int) -> Array:
    """Return the wind at a vehicle, one draw later."""
    plant = world.plant
    return world.physics.air.velocity_ned_m_s(0.5, plant.height_m, plant.vel_ned_m_s)[:, vehicle]


@pytest.mark.parametrize("drawn", [errors_ned_m, wind_ned_m_s])
def test_a_vehicle_draws_the_same_on_its_own_host_as_on_one_for_all(drawn: Callable[[SitlWorld, int], Array]) -> None:
    alone, first, second = (simulated(agents) for agents in ((), (0, 1), (2, 3)))
    third = drawn(second, 0)
    assert third == pytest.approx(drawn(alone, 2), abs=1e-12)
    assert np.abs(third - drawn(first, 0)).max() > 0.01


def test_links_of_several_hosts_lose_different_messages() -> None:
    def arrived(first_vehicle: int) -> list[int]:
        faults = [{"kind": "link_loss", "value": 0.5}]
        flown = FlownWorld(1, first_vehicle=first_vehicle, faults=faults)
        flown.step(1.0)
        return [datagram.t_us for datagram in flown.clients[0].receive(flown.clock.now_us())]

    assert arrived(2) == arrived(2)
    assert arrived(2) != arrived(0)
