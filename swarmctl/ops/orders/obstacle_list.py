"""The obstacles of a running launch: read, changed, and kept in files. Positions are those of now.

Operators stamp what they add with the clock of who repeats the list: their own may be another.
"""

from __future__ import annotations

import json
import secrets
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
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
from swarmctl.bus.network.identity_files import STATION
from swarmctl.bus.network.roster import OwnIdentity
from swarmctl.bus.topics import OBSTACLES, OPERATOR
from swarmctl.configuration.problems import validated
from swarmctl.configuration.source import read_tree
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.params import Params
from swarmctl.core.text import counted
from swarmctl.errors import ConfigError, StartError
from swarmctl.files import write_new
from swarmctl.ops.orders.operator import ANSWER_S, REPEAT_S, joined, list_keepers, list_setters, vector
from swarmctl.ops.orders.order_delivery import no_operator
from swarmctl.ops.running_launches import RunningLaunch

_OPTIONS = {  # of the command line, by key
    "center_ned_m": "--center",
    "radius_m": "--radius",
    "keep_out_m": "--keep-out",
    "visibility_m": "--visibility",
    "vel_ned_m_s": "--velocity",
}
_DRAW_BITS = 53
_TRIES = 5  # of a change, while other operators are quicker
_LISTEN_S = 2.5  # for who repeats the list: that is done once a second
_CONVERGE_S = 1.5  # in which lists of one version become one, where those who keep them hear each other
_SOURCE = "obstacle"  # of problems


class ObstacleFile(Params):
    """Holds what a file of obstacles alone holds: the same tables as a configuration."""

    obstacles: tuple[Obstacle, ...] = Field((), strict=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class KeptList:
    """Describes a list of obstacles, and who is known to keep it.

    Attributes:
        listed: the list, as of now.
        others: those who are heard and keep another one.
        unheard: those who are not heard, so that nothing is known of them.
    """

    listed: ObstaclesMessage
    others: tuple[str, ...]
    unheard: tuple[str, ...]


def read_obstacles(launch: RunningLaunch) -> KeptList:
    """Return the newest obstacle list that is repeated here.

    Raises:
        StartError: the launch does not answer in time.
    """
    with joined(launch) as bus:
        keepers = _Keepers(bus, launch.identity)
        keepers.listen()
        return keepers.kept(keepers.newest())


def change_obstacles(launch: RunningLaunch, change: Callable[[ObstaclesMessage], Sequence[ListedObstacle]]) -> KeptList:
    """Replace the obstacle list by what `change` makes of it, and wait until all who are heard repeat the new one.

    Raises:
        ConfigError: `change` refuses, there would be too many, or this computer may not change them.
        StartError: the launch does not answer, or others change the list all the time.
    """
    if launch.identity is not None and not launch.identity.speaker.operator:
        raise ConfigError(_SOURCE, [no_operator(launch)])
    with joined(launch) as bus:
        keepers = _Keepers(bus, launch.identity)
        keepers.listen()
        for _ in range(_TRIES):
            old = keepers.newest()
            listed = tuple(change(old))
            if len(listed) > MAX_OBSTACLES:
                would = f"there would be {len(listed)}, now there are {len(old.obstacles)}"
                raise ConfigError(_SOURCE, [f"{would}; agents keep {MAX_OBSTACLES} at most"])
            new = old.changed(listed, secrets.randbits(_DRAW_BITS) | 1)
            if keepers.propose(new):
                return keepers.kept(new)
    raise StartError("obstacle: others change the list at the same time; nothing of this was changed")


class _Keepers:
    """Hears which lists are repeated by whom, and proposes another one.

    Args:
        bus: of the launch.
        identity: the own one; None: a launch on one computer.
    """

    def __init__(self, bus: Bus, identity: OwnIdentity | None) -> None:
        self._bus = bus
        self._own = OPERATOR if identity is None else identity.name
        self._setters = list_setters(identity)
        may_end = () if identity is None else (STATION,)
        self._expected = [name for name in list_keepers(identity) if name == self._own or name not in may_end]
        self._heard: dict[str, tuple[ObstaclesMessage, float]] = {}  # newest list of each, and when

    def listen(self) -> None:
        """Listen until all who may keep a list have repeated theirs, or time is up.

        Raises:
            StartError: the own launch does not answer.
        """
        began_s = time.monotonic()
        while not self._heard.keys() >= set(self._expected):
            waited_s = time.monotonic() - began_s
            if waited_s >= (_LISTEN_S if self._own in self._heard else ANSWER_S):
                break
            self._receive()
        if self._own not in self._heard:
            raise StartError(f"obstacle: the launch did not answer within {ANSWER_S:.0f} s; see: swarmctl status")

    def newest(self) -> ObstaclesMessage:
        """Return the newest list that the own launch can go on from, as of now by the clock of who repeats it."""
        own, _ = self._heard[self._own]
        lists = [heard for heard in self._heard.values() if not heard[0].is_too_far_from(own)]
        message, at_s = max(lists, key=lambda heard: heard[0].rank)
        return _as_of_now(message, at_s)

    def propose(self, new: ObstaclesMessage) -> bool:
        """Propose a list until all who are heard keep it, or time is up; returns false if an operator was quicker.

        Raises:
            StartError: the own launch does not take it.
        """
        began_s = time.monotonic()
        while (waited_s := time.monotonic() - began_s) < ANSWER_S:
            self._bus.publish(OBSTACLES, encode_message(_as_of_now(new, began_s)))
            self._receive()
            others = {name: message for name, (message, _) in self._heard.items() if not message.includes(new)}
            if not others:
                return True
            rivals = [name for name in others if name in self._setters and others[name].version >= new.version]
            if rivals and (waited_s > _CONVERGE_S or not self.newest().includes(new)):
                return False
        if not self._heard[self._own][0].includes(new):
            raise StartError(
                f"obstacle: the launch did not take the list within {ANSWER_S:.0f} s; see: swarmctl status"
            )
        return True

    def kept(self, listed: ObstaclesMessage) -> KeptList:
        """Return who is known to keep a list, or one that was made from it."""
        others = [name for name, (message, _) in self._heard.items() if not message.includes(listed)]
        unheard = [name for name in self._expected if name not in self._heard]
        return KeptList(listed=self.newest(), others=tuple(sorted(others)), unheard=tuple(unheard))

    def _receive(self) -> None:
        time.sleep(REPEAT_S)
        for sender, payload in self._bus.receive(OBSTACLES):
            message = decode_obstacles(payload)
            if message is not None and not message.proposed:
                self._heard[sender] = (message, time.monotonic())


def _as_of_now(message: ObstaclesMessage, at_s: float) -> ObstaclesMessage:
    """Return a list as it was stamped at a monotonic time, stamped now."""
    return msgspec.structs.replace(message, utc_us=message.utc_us + round((time.monotonic() - at_s) * 1e6))


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
        ConfigError: the file exists already.
        StartError: it can't be written.
    """
    listed = [_shown(item, known.utc_us) for item in known.obstacles]
    tables = [{key: value for key, value in item.items() if key != "number"} for item in listed]
    write_new({path: tomli_w.dumps({"obstacles": tables})})


def as_json(known: ObstaclesMessage) -> str:
    """Return the obstacles as they are now as a JSON list."""
    return json.dumps([_shown(item, known.utc_us) for item in known.obstacles], indent=2)


def lines_of(known: ObstaclesMessage) -> list[str]:
    """Return a headline and one line for each obstacle as it is now."""
    lines = [f"{counted(len(known.obstacles), 'obstacle')}, where they are now, shared NED [m]"]
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
