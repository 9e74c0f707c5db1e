"""What one agent has received in a recorded run, given to an agent again, tick by tick.

Frames of its vehicle are those of the `.tlog`, paths of peers those of their `.plans`; statuses of peers follow from
their ticks, orders and lists of obstacles from the events. What the agent sends goes nowhere.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from swarmctl.agent.assembly import shared_code
from swarmctl.bus import topics
from swarmctl.bus.bus import Bus, agent_name
from swarmctl.bus.messages.json_messages import (
    CommandMessage,
    MissionMessage,
    StatusMessage,
    encode_message,
    first_list,
)
from swarmctl.bus.messages.path_messages import encode_path
from swarmctl.bus.topics import OPERATOR, Topic
from swarmctl.config import Config
from swarmctl.control.estimation.flown_by_others import StopJudge, predict_flown_by_others
from swarmctl.control.model import Predictor
from swarmctl.control.phases.steps.tracking import BEGIN_DELAY_US
from swarmctl.core.operator_verbs import MISSION, OPERATOR_VERBS
from swarmctl.core.recorded.received import ReceivedKind
from swarmctl.core.types import FlightMode, Landed, Phase, PredictedPath, VehicleState
from swarmctl.mavlink.commands import OWN_COMPID
from swarmctl.mavlink.transport import Datagram
from swarmctl.telemetry.recording.run_files import utc_us_of

Heard = tuple[int, Topic, str, bytes]  # UTC [us] of a message, its topic, sender and payload
_STAMP = struct.Struct(">Q")  # UTC [us] before each frame of a .tlog
_V1, _V2 = 0xFE, 0xFD  # first byte of a frame
_BOOT = 1  # of every peer
_STATUS_EVERY = 10  # ticks
_SECOND_TICKS = 50
_COAST_S, _COAST_POINTS = 0.1, 21  # times of the path of a peer that has flown no plan at all


class RecordedTime:
    """The clock of a recorded tick."""

    def __init__(self) -> None:
        self.t_us = self.utc = 0

    def now_us(self) -> int:
        return self.t_us

    def utc_us(self) -> int:
        return self.utc

    def utc_of_us(self, t_us: int) -> int:
        return self.utc + t_us - self.t_us


class RecordedLink:
    """A link whose vehicle says what it has said."""

    def __init__(self) -> None:
        self._arrived: list[Datagram] = []

    def offer(self, datagrams: Iterable[Datagram]) -> None:
        """Have frames arrive, each at its time."""
        self._arrived += datagrams

    def send(self, data: bytes) -> None:
        """Send to nobody."""

    def receive(self, now_us: int) -> list[Datagram]:
        arrived, self._arrived = self._arrived, []
        return arrived

    def close(self) -> None:
        """Nothing is open."""


class RecordedBus(Bus):
    """A bus on which peers and operator say what they have said."""

    def __init__(self, senders: frozenset[str]) -> None:
        self._senders = senders
        self._waiting: dict[Topic, list[tuple[str, bytes]]] = {}

    def offer(self, topic: Topic, sender: str, payload: bytes) -> None:
        """Have a message arrive."""
        self._waiting.setdefault(topic, []).append((sender, payload))

    def publish(self, topic: Topic, payload: bytes) -> None:
        """Publish to nobody."""

    def receive(self, topic: Topic) -> list[tuple[str, bytes]]:
        return self._waiting.pop(topic, [])

    def hear(self, topic: Topic, senders: Collection[str]) -> None:
        """Hear what was heard."""

    def alive(self) -> frozenset[str]:
        return self._senders

    def arrivals(self) -> Mapping[str, int]:
        return dict.fromkeys(self._senders, 1)

    def close(self) -> None:
        """Nothing is open."""


def frames_of(recorded: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the frames of a `.tlog` that the vehicle has sent, each with its UTC [us], to where the file is cut off."""
    at = 0
    while at + _STAMP.size + 8 <= len(recorded):
        (utc_us,) = _STAMP.unpack_from(recorded, at)
        at += _STAMP.size
        magic, payload = recorded[at], recorded[at + 1]
        if magic == _V2:
            size, component = 12 + payload + (13 if recorded[at + 2] & 1 else 0), recorded[at + 6]
        elif magic == _V1:
            size, component = 8 + payload, recorded[at + 4]
        else:
            return
        if component != OWN_COMPID:
            yield utc_us, recorded[at : at + size]
        at += size


def begins_utc_us(rows: NDArray[np.void]) -> NDArray[np.int64]:
    """Return the UTC (T,) [us] at which ticks have begun: rows of older recordings hold that of their end, and both
    monotonic and UTC time go on alike over a second.
    """
    utc_us: NDArray[np.int64] = rows["utc_us"]
    t_us: NDArray[np.int64] = rows["t_us"]
    late_us = np.pad(utc_us - t_us, _SECOND_TICKS // 2, mode="edge")
    least_us = np.lib.stride_tricks.sliding_window_view(late_us, _SECOND_TICKS + 1).min(axis=1)
    return np.asarray(t_us + least_us)


def peer_messages(
    config: Config, agent: int, ticks: Mapping[int, NDArray[np.void]], plans: Mapping[int, NDArray[np.void]]
) -> list[Heard]:
    """Return what peers have said to an agent."""
    heard: list[Heard] = []
    for peer, rows in ticks.items():
        if peer != agent:
            stamps_us = rows["utc_us"].tolist()
            paths = zip(stamps_us, _paths(config, peer, rows, plans[peer]), strict=True)
            heard += [_path_message(config, utc_us, path) for utc_us, path in paths if path is not None]
            said = np.diff(rows["phase"].astype(int), prepend=-1) != 0
            heard += map(_status_message, _statuses(config, peer, rows, said | (rows["seq"] % _STATUS_EVERY == 0)))
    return sorted(heard, key=lambda message: message[0])


def received_messages(
    config: Config,
    ticks: Mapping[int, NDArray[np.void]],
    plans: Mapping[int, NDArray[np.void]],
    received: NDArray[np.void],
) -> dict[int, list[Heard]]:
    """Return what peers have said to an agent, by the monotonic time of the tick that received it.

    Args:
        config, ticks, plans: of the run; what peers say follows from theirs.
        received: what the agent has received, rows (K,) of `RECEIVED_DTYPE`.
    """
    paths: dict[int, dict[int, PredictedPath | None]] = {}
    statuses: dict[int, dict[int, StatusMessage]] = {}
    for peer, rows in ticks.items():
        earlier = (rows["seq"].astype(np.int64) - 1).tolist()  # a path is numbered before its tick is counted
        paths[peer] = dict(zip(earlier, _paths(config, peer, rows, plans[peer]), strict=True))
        theirs = received[(received["kind"] == ReceivedKind.STATUS) & (received["sender"] == peer)]
        statuses[peer] = {
            said.ticks: said for said in _statuses(config, peer, rows, np.isin(rows["seq"], theirs["seq"]))
        }
    heard: dict[int, list[Heard]] = {}
    for t_us, kind, sender, seq, stamp_us, margin_m, keeps_up in received.tolist():
        now = heard.setdefault(t_us, [])
        if kind == ReceivedKind.PATH and (path := paths.get(sender, {}).get(seq)):
            now.append(_path_message(config, stamp_us, replace(path, t0_utc_us=stamp_us, margin_m=margin_m)))
        elif kind == ReceivedKind.STATUS and (status := statuses.get(sender, {}).get(seq)):
            now.append(_status_message(msgspec.structs.replace(status, keeps_up=bool(keeps_up))))
    return heard


def operator_messages(
    config: Config, agent: int, ticks: Mapping[int, NDArray[np.void]], events: Sequence[Mapping[str, Any]]
) -> list[Heard]:
    """Return what the operator has said to an agent: obstacles, and the orders that it has obeyed.

    A run that was recorded before lists of obstacles were has the configured ones.
    """
    own = [event for event in events if event.get("source") == agent_name(agent)]
    heard = [*_orders(agent, own), *_obstacles(own)]
    if not any(topic is topics.OBSTACLES for _, topic, _, _ in heard):
        begins_us = min(int(rows["utc_us"][0]) for rows in ticks.values())
        heard.append((begins_us, topics.OBSTACLES, OPERATOR, encode_message(first_list(config.obstacles, begins_us))))
    return sorted(heard, key=lambda message: message[0])


def _obstacles(own: Sequence[Mapping[str, Any]]) -> Iterator[Heard]:
    """Yield the lists of obstacles that an agent has taken over, from its events."""
    for event in own:
        if event.get("event") == "obstacles_changed" and isinstance(event.get("listed"), str):
            yield utc_us_of(event), topics.OBSTACLES, OPERATOR, event["listed"].encode(errors="replace")


def _status_message(status: StatusMessage) -> Heard:
    return status.utc_us, topics.STATUS, agent_name(status.agent), encode_message(status)


def _path_message(config: Config, utc_us: int, path: PredictedPath) -> Heard:
    encoded = encode_path(path, compact=config.agent.path_sharing.compact)
    return utc_us, topics.PATH, agent_name(path.agent), encoded


def _paths(
    config: Config, peer: int, rows: NDArray[np.void], points: NDArray[np.void]
) -> Iterator[PredictedPath | None]:
    """Yield the path of a peer at each tick: its plan, or where it has flown none, straight on or to rest."""
    times_us, begins = np.unique(points["t_us"], return_index=True)
    planned = dict(zip(times_us.tolist(), np.split(points, begins[1:]), strict=True)) if len(points) else {}
    like = planned[int(times_us[0])]["at_us"] if planned else np.arange(_COAST_POINTS) * round(_COAST_S * 1e6)
    model = config.model_of(peer)
    delay_us, stop_judge, brake_m_s2 = Predictor(model).delay_us, StopJudge(), config.separation.brake_m_s2
    for row, begin_us in zip(rows, begins_utc_us(rows).tolist(), strict=True):
        t_us, accel = int(row["t_us"]), row["setpoint_accel_ned_m_s2"]
        if t_us in planned:
            stop_judge.forget()
            at_us, pos = planned[t_us]["at_us"], planned[t_us]["pos_ned_m"].astype(np.float64)
        elif np.isfinite(row["pos_ned_m"]).all() and np.isfinite(row["vel_ned_m_s"]).all():
            at_us = t_us + delay_us + like - like[0]
            state = _state(row)
            ahead_s = (at_us - state.t_us).astype(np.float64) * 1e-6
            stops = stop_judge.update(state)
            pos = predict_flown_by_others(state, ahead_s, brake_m_s2, stops=stops, drag_1_s=model.drag_1_s)
        else:
            yield None
            continue
        yield PredictedPath(
            agent=peer,
            boot_id=_BOOT,
            seq=int(row["seq"]),
            t0_utc_us=int(at_us[0]) + begin_us - t_us,
            dt_us=int(at_us[1] - at_us[0]),
            margin_m=0.0,
            pos_ned_m=pos,
            setpoint_accel_ned_m_s2=accel if t_us in planned and np.isfinite(accel).all() else None,
        )


def _state(row: NDArray[np.void]) -> VehicleState:
    """Return the state of a vehicle that its agent does not fly, as far as its path follows from it."""
    age_us = float(row["state_age_ms"]) * 1e3
    return VehicleState(
        t_us=int(row["t_us"]) - round(age_us),
        pos_ned_m=row["pos_ned_m"],
        vel_ned_m_s=row["vel_ned_m_s"],
        q_nb=row["q_nb"],
        rate_frd_rad_s=np.zeros(3),
        armed=bool(row["armed"]),
        mode=FlightMode(int(row["flight_mode"])),
        landed=Landed.UNKNOWN,
        failsafe=False,
    )


def _statuses(config: Config, peer: int, rows: NDArray[np.void], said: NDArray[np.bool_]) -> Iterator[StatusMessage]:
    """Yield what a peer has said of itself in the ticks in which it has, as far as others use it."""
    ready_us, code = _ready_utc_us(rows), shared_code(config)
    for row in rows[said]:
        utc_us = int(row["utc_us"])
        yield StatusMessage(
            agent=peer,
            boot_id=_BOOT,
            sysid=peer + 1,
            phase=int(row["phase"]),
            mode=int(row["mode"]),
            flight_mode=int(row["flight_mode"]),
            armed=bool(row["armed"]),
            landed=0,
            held=False,
            control="",
            altitude_m=0.0,
            ground_speed_m_s=-1.0,
            battery_01=-1.0,
            pos_accuracy_m=-1.0,
            gps_fix=-1,
            satellites=-1,
            link_age_ms=0.0,
            ready_utc_us=ready_us if utc_us >= ready_us else 0,
            mission_t_s=-1.0,
            ends_in_s=-1.0,
            outcome="",
            position_error_m=0.0,
            separation_m=-1.0,
            tick_p99_ms=0.0,
            ticks=int(row["seq"]),
            deadline_misses=int(row["deadline_misses"]),
            plan_staleness_ms=-1.0,
            solver_failed=0,
            active_alert="",
            alert_age_s=0.0,
            uses_commitments=False,
            utc_us=utc_us,
            code=code,
        )


def _ready_utc_us(rows: NDArray[np.void]) -> int:
    """Return when a peer was ready: a second before the mission's begin, which its mission time tells exactly."""
    tracked = rows[np.isfinite(rows["mission_t_s"])][:_SECOND_TICKS]
    if len(tracked):
        return round(float(np.median(tracked["utc_us"] - tracked["mission_t_s"] * 1e6))) - BEGIN_DELAY_US
    ready = begins_utc_us(rows)[rows["phase"] == Phase.READY]
    return int(ready[0]) if len(ready) else 0


def _orders(agent: int, own: Sequence[Mapping[str, Any]]) -> Iterator[Heard]:
    """Yield the orders that an agent has obeyed, and the missions that it was told of, from its events."""
    missions = [event for event in own if event.get("event") == "mission_changed"]
    for event in own:
        verb = event.get("verb")
        if event.get("event") != "operator" or verb not in OPERATOR_VERBS:
            continue
        names = {argument.name for argument in OPERATOR_VERBS[verb].arguments}
        arguments = {name: value for name, value in event.items() if name in names}
        if verb == MISSION and missions:
            told = MissionMessage(mission=int(arguments[MISSION]), text=str(missions.pop(0)["mission"]))
            yield event["utc_us"], topics.MISSION, OPERATOR, encode_message(told)
        order = CommandMessage(verb, agent, event["utc_us"], arguments)
        yield event["utc_us"], topics.COMMAND, OPERATOR, msgspec.json.encode(order)
