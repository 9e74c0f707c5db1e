"""Gives a running launch another mission: read from a file, checked as before a launch, sent, and ordered."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path

from swarmctl.bus.messages.json_messages import MissionMessage, StatusMessage, encode_message
from swarmctl.bus.topics import MAX_MISSION_BYTES
from swarmctl.bus.topics import MISSION as MISSION_TOPIC
from swarmctl.config import load_mission, load_recorded
from swarmctl.control.reference.mission import MissionParams
from swarmctl.core.operator_verbs import BEGIN, CLOCK, MISSION, Order
from swarmctl.errors import ConfigError
from swarmctl.ops.orders.obstacle_list import read_obstacles
from swarmctl.ops.orders.operator import read_statuses
from swarmctl.ops.orders.order_delivery import Reply, deliver
from swarmctl.ops.running_launches import RunningLaunch

_LEAD_S = 1.5  # from the order to the begin of the mission
_NUMBER_BYTES = 6  # of a digest: a number that a floating-point argument holds exactly


def set_mission(launch: RunningLaunch, file: Path, agents: Sequence[int]) -> list[Reply]:
    """Have agents of a launch, or all, fly the mission of a file; returns what each has answered.

    Raises:
        ConfigError: there is no such agent, or the mission can't be flown by this launch.
        StartError: the bus can't be joined, or the launch does not answer.
    """
    config, known = load_recorded(Path(launch.run_dir)), read_obstacles(launch).listed
    mission = load_mission(config, file, {item.number: item.at(known.utc_us) for item in known.obstacles})
    message = mission_message(mission)
    payload = encode_message(message)
    if len(payload) > MAX_MISSION_BYTES:
        takes = f"takes {len(payload)} bytes; {MAX_MISSION_BYTES} at most while a launch flies"
        raise ConfigError(str(file), [f"{takes}. Give fewer points, or start a launch with it"])
    order = mission_order(message, read_statuses(launch), launch.utc_us())
    return deliver(launch, order, agents, before=((MISSION_TOPIC, payload),))


def mission_message(mission: MissionParams) -> MissionMessage:
    """Return the message that tells agents of a mission; its number follows from what it says."""
    text = mission.model_dump_json(exclude_defaults=True)
    digest = hashlib.sha256(text.encode()).digest()[:_NUMBER_BYTES]
    return MissionMessage(mission=int.from_bytes(digest, "big"), text=text)


def mission_order(message: MissionMessage, statuses: Mapping[int, StatusMessage], utc_us: int) -> Order:
    """Return the order to fly a mission: it begins for all at one time, by the clock that is farthest ahead.

    Each agent knows how far that one is from its own. By a clock that is behind, the begin might have passed.

    Args:
        message: tells the mission.
        statuses: newest of each agent.
        utc_us: own clock, which counts where no agent is heard.
    """
    arguments: dict[str, float] = {MISSION: message.mission}
    if statuses:
        arguments[CLOCK] = max(statuses, key=lambda agent: statuses[agent].utc_us)
        utc_us = statuses[round(arguments[CLOCK])].utc_us
    return Order(MISSION, arguments | {BEGIN: utc_us * 1e-6 + _LEAD_S})
