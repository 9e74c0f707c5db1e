"""Which rates of agents and of physics fly in lockstep, known before anything flies."""

from __future__ import annotations

from swarmctl.config import Config
from swarmctl.errors import ConfigError

_WHOLE = 1e-6  # by which a number of steps may differ from a whole one


def steps_per_tick(config: Config) -> int:
    """Return how many steps of the physics a tick of the agents has.

    Raises:
        ConfigError: it has no whole number of them.
    """
    physics_hz, rate_hz = config.sitl.physics_hz, config.agent.rate_hz
    steps = round(physics_hz / rate_hz)
    if abs(physics_hz / rate_hz - steps) > _WHOLE:
        told = f"sitl.physics_hz = {physics_hz:g}: in lockstep a multiple of agent.rate_hz"
        raise ConfigError(config.name, [f"{told} = {rate_hz:g}; set one to suit the other"])
    return steps
