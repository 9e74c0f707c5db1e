"""Finds the built-in configurations and examples: beside the package in a checkout, inside it when installed."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from swarmctl.errors import ConfigError

_PLACES = (Path(__file__).parents[1] / "configs", Path(__file__).parent / "configs")
EXAMPLES = "examples"
_KINDS = (".toml", ".py", ".csv")  # of files; the first that there is names the others


def built_in_config(name: str) -> Path:
    """Return the path of the built-in configuration `<name>.toml`.

    Raises:
        ConfigError: there is none of that name.
    """
    return built_in_files(name)[0]


def built_in_files(name: str) -> list[Path]:
    """Return a built-in configuration, or an example: its configuration, and the module or points that it flies.

    Raises:
        ConfigError: there is none of that name.
    """
    found = sorted((path for path in _files() if path.stem == name), key=lambda path: _KINDS.index(path.suffix))
    if found:
        return found
    known = ", ".join(sorted({path.stem for path in _files()}))
    raise ConfigError(name, [f"no such configuration comes with swarmctl; known are {known}"])


def _files() -> Iterator[Path]:
    """Yield the files of the first place that there is."""
    place = next((place for place in _PLACES if place.is_dir()), _PLACES[0])
    for folder in (place, place / EXAMPLES):
        yield from (path for path in folder.glob("*") if path.suffix in _KINDS)
