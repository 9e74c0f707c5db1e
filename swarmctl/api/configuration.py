"""Reads a configuration for scripts: the same file, checks and words of refusal as on the command line."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from swarmctl.config import NO_VALUES, Config
from swarmctl.config import load as load_config
from swarmctl.configuration.config_warnings import config_warnings
from swarmctl.errors import ConfigError

__all__ = ["Config", "load"]


def load(
    path: str | Path | None = None,
    set: Mapping[str, Any] = NO_VALUES,  # noqa: A002  (as the option is called)
) -> Config:
    """Return the checked configuration of a run, which is frozen; warns of what may not be meant.

    Args:
        path: a TOML file; None for the defaults, the circle of the thesis.
        set: values by dotted key, for example `{"swarm.agents": 5, "mission.kind": "circle"}`; items of lists by index,
            as in `"vehicles.0.url"`.

    Raises:
        ConfigError: it is invalid; lists all problems with key, value, allowed range and fix.
    """
    if not isinstance(set, Mapping):
        raise ConfigError("set", [f"{set!r}: give values by dotted key, as {{'swarm.agents': 5}}"])
    values = {key: _plain(value) for key, value in set.items()}
    config = load_config(None if path is None else Path(path), values=values)
    for text in config_warnings(config):
        warnings.warn(text, stacklevel=2)
    return config


def _plain(value: Any) -> Any:
    """Return an array or number of numpy as Python's own, which the strict checks of types expect."""
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, Mapping):
        return {name: _plain(item) for name, item in value.items()}
    return str(value) if isinstance(value, Path) else value
