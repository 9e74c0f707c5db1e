"""What a sweep flies: swept keys with their values, and every combination of them with every seed."""

from __future__ import annotations

import itertools
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sitl.lockstep_rates import steps_per_tick
from swarmctl.config import Config, load
from swarmctl.errors import ConfigError

MOST_FLIGHTS = 100_000
_OPENING, _CLOSING, _QUOTES = "[{", "]}", "\"'"


@dataclass(frozen=True, slots=True)
class Axis:
    """A swept key, and its values as they are written after `--set`."""

    key: str
    values: tuple[str, ...]

    @property
    def is_number(self) -> bool:
        """Whether every value is a number."""
        return all(type(_parsed(value)) in (int, float) for value in self.values)

    def stored(self, value: str) -> float | str:
        """Return a value as it is in the table: a number, or its text."""
        return float(_parsed(value)) if self.is_number else value


@dataclass(frozen=True, slots=True)
class Flight:
    """Describes one flight of a sweep."""

    settings: tuple[tuple[str, str], ...]  # key and value of each axis
    seed: int

    def __str__(self) -> str:
        """Return it as options of the command line."""
        return " ".join([*(f"--set {key}={value}" for key, value in self.settings), f"--seed {self.seed}"])

    def config(self, base: Path | None, fixed: Sequence[str] = ()) -> Config:
        """Return its configuration.

        Args:
            base: a TOML file; None for the defaults.
            fixed: `key=value` of every flight.

        Raises:
            ConfigError: a key does not exist, or values don't go together.
        """
        config = load(base, [*fixed, *(f"{key}={value}" for key, value in self.settings), f"seed={self.seed}"])
        steps_per_tick(config)  # refused before anything flies
        return config


def parse_axes(items: Sequence[str], fixed: Sequence[str] = ()) -> list[Axis]:
    """Return the axes that `key=value,value` items describe.

    Args:
        items: what is swept.
        fixed: `key=value` of every flight, of keys that can't be swept therefore.

    Raises:
        ConfigError: an item is none; lists all.
    """
    axes = [Axis(key.strip(), _split(text)) for key, _, text in (item.partition("=") for item in items)]
    problems = [
        f"--set {item}: write it as key.sub=value,value"
        for item, axis in zip(items, axes, strict=True)
        if not axis.key or not all(axis.values)
    ]
    keys = [axis.key for axis in axes]
    twice = sorted({key for key in keys if keys.count(key) > 1})
    problems += [f"--set {key}: given twice; write all its values in one" for key in twice]
    settled = [item.partition("=")[0] for item in fixed]
    problems += [f"--set {key}: is the same in every flight by another option" for key in keys if key in settled]
    if "seed" in keys:
        problems.append("--set seed: give the number of seeds with --seeds")
    if not axes:
        problems.append("nothing is swept: give --set key.sub=value,value")
    if problems:
        raise ConfigError("sweep", problems)
    return axes


def flights_of(axes: Sequence[Axis], first_seed: int, seeds: int) -> list[Flight]:
    """Return every combination with every seed; seeds are the outer loop, so that all combinations grow together.

    Raises:
        ConfigError: there are too many.
    """
    count = seeds
    for axis in axes:
        count *= len(axis.values)
    if count > MOST_FLIGHTS:
        raise ConfigError("sweep", [f"{count} flights; allowed: {MOST_FLIGHTS}"])
    combinations = list(itertools.product(*([(axis.key, value) for value in axis.values] for axis in axes)))
    return [Flight(settings, seed) for seed in range(first_seed, first_seed + seeds) for settings in combinations]


def problems_of(flights: Sequence[Flight], base: Path | None, fixed: Sequence[str] = ()) -> Iterator[str]:
    """Yield why combinations can't be flown, each reason once, with the first combination that has it."""
    said: set[str] = set()
    for flight in flights:
        try:
            flight.config(base, fixed)
        except ConfigError as error:
            new = [problem for problem in error.problems if problem not in said]
            said.update(new)
            yield from (f"{flight}: {problem}" for problem in new)


def _split(text: str) -> tuple[str, ...]:
    """Return the parts between commas that are outside of brackets, braces and quotes."""
    parts, depth, quote = [""], 0, ""
    for character in text:
        if quote:
            quote = "" if character == quote else quote
        elif character in _QUOTES:
            quote = character
        depth += (character in _OPENING) - (character in _CLOSING) if not quote else 0
        if character == "," and not depth and not quote:
            parts.append("")
        else:
            parts[-1] += character
    return tuple(dict.fromkeys(part.strip() for part in parts))


def _parsed(text: str) -> Any:
    try:
        return tomllib.loads(f"v = {text}")["v"]
    except (tomllib.TOMLDecodeError, KeyError):
        return text
