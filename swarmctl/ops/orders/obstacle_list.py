"""The obstacles of a running launch: read, changed, and kept in files. Positions are those of now.

Operators stamp what they add with the launch's clock, which repeats the list: their own may be another.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import tomli_w
from pydantic import Field, ValidationError

from swarmctl.bus.bus import Bus
from swarmctl.bus.messages.json_messages import (
    MAX_OBSTACLES,
    ListedObstacle,
    ObstaclesMessage,
    decode_obstacles,
    encode_message,
)
from swarmctl.bus.topics import OBSTACLES
from swarmctl.configuration.problems import validated
from swarmctl.configuration.source import read_tree
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.params import Params
from swarmctl.errors import ConfigError, StartError
from swarmctl.files import write_new
from swarmctl.ops.orders.operator import ANSWER_S, REPEAT_S, joined, vector
from swarmctl.ops.orders.order_delivery import no_operator
from swarmctl.ops.running_launches import RunningLaunch

_OPTIONS = {  # of the command line, by key
    "center_ned_m": "--center",
    "radius_m": "--radius",
    "keep_out_m": "--keep-out",
    "visibility_m": "--visibility",
    "vel_ned_m_s": "--velocity",
}
_TRIES = 5  # of a change, while other operators are quicker
_SOURCE = "obstacle"  # of problems


class ObstacleFile(Params):
    """Holds what a file of obstacles alone holds: the same tables as a configuration."""

    obstacles: tuple[Obstacle, ...] = Field((), strict=False)


def read_obstacles(launch: RunningLaunch) -> ObstaclesMessage:
    """Return the obstacle list that the launch repeats.

    Raises:
        StartError: the launch does not answer in time.
    """
    with joined(launch) as bus:
        return _received(bus, 0)


def change_obstacles(
    launch: RunningLaunch, change: Callable[[ObstaclesMessage], Sequence[ListedObstacle]]
) -> ObstaclesMessage:
    """Replace the obstacle list by what `change` makes of it, and wait until the launch repeats the new one.

    Raises:
        ConfigError: `change` refuses, there would be too many, or this computer may not change them.
        StartError: the launch does not answer, or others change the list all the time.
    """
    if launch.identity is not None and not launch.identity.speaker.operator:
        raise ConfigError(_SOURCE, [no_operator(launch)])
    with joined(launch) as bus:
        old = _received(bus, 0)
        for _ in range(_TRIES):
            listed = tuple(change(old))
            if len(listed) > MAX_OBSTACLES:
                would = f"there would be {len(listed)}, now there are {len(old.obstacles)}"
                raise ConfigError(_SOURCE, [f"{would}; agents keep {MAX_OBSTACLES} at most"])
            following = max([old.next_number, *(item.number + 1 for item in listed)])
            new = msgspec.structs.replace(old, version=old.version + 1, next_number=following, obstacles=listed)
            old = _received(bus, new.version, encode_message(new))
            if old.obstacles == new.obstacles:
                return old
    raise StartError("obstacle: others change the list at the same time; nothing of this was changed")


def added(known: ObstaclesMessage, obstacles: Sequence[Obstacle]) -> list[ListedObstacle]:
    """Return the list with obstacles that are at their centres now, under numbers that none has had."""
    new = [
        ListedObstacle(number=known.next_number + i, since_utc_us=known.utc_us, obstacle=obstacle)
        for i, obstacle in enumerate(obstacles)
    ]
    return [*known.obstacles, *new]


def removed(known: ObstaclesMessage, numbers: Sequence[int]) -> list[ListedObstacle]:
    """Return the list without the obstacles of these numbers.

    Raises:
        ConfigError: names every number that there is none of.
    """
    if problems := _unknown(known, numbers):
        raise ConfigError(_SOURCE, problems)
    return [item for item in known.obstacles if item.number not in numbers]


def moved(known: ObstaclesMessage, number: int, center: str | None, velocity: str | None) -> list[ListedObstacle]:
    """Return the list with one obstacle at another place, or of another velocity, from now on.

    Args:
        known: the list.
        number: of the obstacle.
        center, velocity: `north,east,down`, shared frame; None: where it is, as it moves.

    Raises:
        ConfigError: there is no such obstacle, or a number is missing, not finite or out of range.
    """
    problems = _unknown(known, [number])
    asked = {"center_ned_m": center, "vel_ned_m_s": velocity}
    if center is None and velocity is None:
        problems.append("give --center, --velocity or both")
    values = {key: vector(_OPTIONS[key], text, problems) for key, text in asked.items() if text is not None}
    there = {item.number: item for item in known.obstacles}
    before = there[number].at(known.utc_us).model_dump() if number in there else {"center_ned_m": (0.0, 0.0, 0.0)}
    after = _validated(before | values, problems)
    return [
        ListedObstacle(number=number, since_utc_us=known.utc_us, obstacle=after) if item.number == number else item
        for item in known.obstacles
    ]


def obstacle(
    center: str, radius_m: float, keep_out_m: float, visibility_m: float, *, velocity: str, column: bool = False
) -> Obstacle:
    """Return the obstacle that a command line describes; vectors are `north,east,down`, shared frame.

    Raises:
        ConfigError: a number is missing, not finite or out of range.
    """
    problems: list[str] = []
    asked = {"center_ned_m": center, "vel_ned_m_s": velocity}
    vectors = {key: vector(_OPTIONS[key], text, problems) for key, text in asked.items()}
    values = {"radius_m": radius_m, "keep_out_m": keep_out_m, "visibility_m": visibility_m, "column": column}
    return _validated(values | vectors, problems)


def read_file(path: Path) -> tuple[Obstacle, ...]:
    """Return the obstacles of a file.

    Raises:
        ConfigError: with every problem: the file is not readable, a key is unknown, a value is out of range.
    """
    return validated(ObstacleFile, read_tree(path), str(path)).obstacles


def write_file(path: Path, known: ObstaclesMessage) -> None:
    """Write the obstacles as they are now to a new file, which `read_file` and configurations take.

    Raises:
        ConfigError: the file exists already, or can't be written.
    """
    listed = [_shown(item, known.utc_us) for item in known.obstacles]
    tables = [{key: value for key, value in item.items() if key != "number"} for item in listed]
    write_new({path: tomli_w.dumps({"obstacles": tables})})


def as_json(known: ObstaclesMessage) -> str:
    """Return the obstacles as they are now as a JSON list."""
    return json.dumps([_shown(item, known.utc_us) for item in known.obstacles], indent=2)


def lines_of(known: ObstaclesMessage) -> list[str]:
    """Return a headline and one line for each obstacle as it is now."""
    lines = [f"{len(known.obstacles)} obstacles, where they are now, shared NED [m]"]
    for item in known.obstacles:
        there = item.at(known.utc_us)
        shape, speed = "column" if there.column else "sphere", f"velocity {_words(there.vel_ned_m_s)} m/s"
        lines.append(
            f"{item.number}: {shape} at {_words(there.center_ned_m)}  radius {there.radius_m:g}  "
            f"keep-out {there.keep_out_m:g}  seen from {there.visibility_m:g}  {speed if there.moves else 'at rest'}"
        )
    return lines


def _shown(item: ListedObstacle, utc_us: int) -> dict[str, Any]:
    values = item.at(utc_us).model_dump()
    return {"number": item.number} | {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}


def _words(vector_ned: Sequence[float]) -> str:
    return ", ".join(f"{part:.2f}" for part in vector_ned)


def _unknown(known: ObstaclesMessage, numbers: Sequence[int]) -> list[str]:
    there = [item.number for item in known.obstacles]
    are = f"those there are: {', '.join(map(str, there))}" if there else "there are none"
    return [f"there is no obstacle {number}; {are}" for number in dict.fromkeys(numbers) if number not in there]


def _validated(values: dict[str, Any], problems: list[str]) -> Obstacle:
    """Return the obstacle of these values.

    Raises:
        ConfigError: with `problems` and all of the values.
    """
    try:
        described = Obstacle.model_validate(values)
    except ValidationError as error:
        found = [f"{_OPTIONS[str(e['loc'][0])]} {e['input']}: {e['msg'].lower()}" for e in error.errors()]
        raise ConfigError(_SOURCE, [*problems, *found]) from error
    if problems:
        raise ConfigError(_SOURCE, problems)
    return described


def _received(bus: Bus, least_version: int, say: bytes | None = None) -> ObstaclesMessage:
    deadline_s = time.monotonic() + ANSWER_S
    while time.monotonic() < deadline_s:
        if say is not None:
            bus.publish(OBSTACLES, say)
        time.sleep(REPEAT_S)
        for _, payload in bus.receive(OBSTACLES):
            message = decode_obstacles(payload)
            if message is not None and message.version >= least_version:
                return message
    raise StartError(f"obstacle: the launch did not answer within {ANSWER_S:.0f} s; see: swarmctl status")
