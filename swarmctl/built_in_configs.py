"""Finds the built-in configurations: beside the package in a checkout, inside it when installed."""

from __future__ import annotations

from pathlib import Path

from swarmctl.errors import ConfigError

_PLACES = (Path(__file__).parents[1] / "configs", Path(__file__).parent / "configs")


def built_in_config(name: str) -> Path:
    """Return the path of the built-in configuration `<name>.toml`.

    Raises:
        ConfigError: there is none of that name.
    """
    for place in _PLACES:
        path = place / f"{name}.toml"
        if path.is_file():
            return path
    known = sorted(path.stem for place in _PLACES for path in place.glob("*.toml"))
    raise ConfigError(name, [f"no such configuration comes with swarmctl; known are {', '.join(known)}"])
