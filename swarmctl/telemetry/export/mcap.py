"""Writes a finished run as MCAP, which Foxglove opens: frames, a scene, events, and every recorded value.

Frames and scene are messages of Foxglove's own schemas, so that its 3-D panel draws them; ticks and true states are
JSON, whose schema says the unit and meaning of each value. Times are UTC. The root frame `world` has z up; `ned` is the
shared frame, and `agent-<i>` that of a vehicle's body, x ahead and z down.

Needs the extra `swarmctl[mcap]`.
"""

from __future__ import annotations

import heapq
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from swarmctl import __version__
from swarmctl.core.recorded.records import TICK_DTYPE, TRUTH_COLUMNS
from swarmctl.core.recorded.stored_column import StoredColumn
from swarmctl.core.recorded.tick_record import COLUMNS
from swarmctl.core.types import Array
from swarmctl.errors import StartError
from swarmctl.files import replaced
from swarmctl.telemetry.evaluation.referee import JudgedObstacle, RunData
from swarmctl.telemetry.evaluation.station_clock import by_station_clock
from swarmctl.telemetry.evaluation.tracks import goal_ned_m, missions
from swarmctl.telemetry.palette import LIMIT_RGB, NUMBER_RGB, agent_rgb
from swarmctl.telemetry.recording.file_names import CONFIG, SUMMARY
from swarmctl.telemetry.recording.run_files import utc_us_of
from swarmctl.telemetry.recording.tables import named_table
from swarmctl.telemetry.scene.viewed_flight import ViewedFlight

if TYPE_CHECKING:
    from foxglove import Context

Messages = Iterator[tuple[int, Callable[..., None]]]  # UTC [us], and what logs the message, in order of time
_WORLD, _NED = "world", "ned"
_BODY_M, _REFERENCE_M, _GOAL_M = (0.4, 0.4, 0.08), 0.06, 0.2  # sizes drawn: a plate, radii of balls
_SCENE_TICKS = 5  # of an agent, between two of its pictures: ten a second
_PLAN_PERIOD_US, _OBSTACLE_STEP_US = 100_000, 200_000
_BLOCK = 4096  # rows turned into words at once
_NO_TICKS = np.zeros(0, TICK_DTYPE)
_JSON_TYPES = {"f": "number", "i": "integer", "u": "integer"}  # by the kind of a numpy type
_WARNINGS = ("outside_volume", "overload", "estimate_jumped", "order_refused", "refused", "unresponsive")
_ERRORS = ("controller_failed", "start_failed", "not_landed", "vehicle_left", "too_long", "killed")


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedFlight:
    """Holds what is exported of a run."""

    run: RunData
    plans: Mapping[int, NDArray[np.void]]  # predicted paths of each agent, rows of `PLAN_DTYPE`
    flight: ViewedFlight
    obstacles: Sequence[JudgedObstacle]
    config_toml: str
    summary_json: str


def write_mcap(path: Path, recorded: RecordedFlight) -> None:
    """Write a run to a file, which is replaced when all of it is written.

    Raises:
        StartError: the library is not installed.
        OSError: the file can't be written.
    """
    try:
        import foxglove
    except ImportError as error:
        raise StartError(
            "MCAP needs a library of its own. Install it, in the checkout: pip install '.[mcap]'"
        ) from error
    run = recorded.run
    clocked = by_station_clock(run.ticks, run.events, run.cut)
    recorded = replace(recorded, run=replace(run, ticks=clocked.ticks, events=clocked.events(run.events)))
    context = foxglove.Context()
    with replaced(path) as file, foxglove.open_mcap(file, context=context) as writer:
        writer.write_metadata("swarmctl", {"version": __version__})
        for name, kind, text in (
            (CONFIG, "application/toml", recorded.config_toml),
            (SUMMARY, "application/json", recorded.summary_json),
        ):
            now_ns = max(0, _begins_us(recorded.run)) * 1000
            writer.attach(log_time=now_ns, create_time=now_ns, name=name, media_type=kind, data=text.encode())
        _Export(context, recorded).write()


def _begins_us(run: RunData) -> int:
    return min((int(rows["utc_us"][0]) for rows in run.ticks.values() if len(rows)), default=0)


def _utc_us(ticks: NDArray[np.void], t_us: Any) -> Any:
    """Return the UTC of monotonic times, as ticks (T,) have it: it follows a clock that was set in flight slowly."""
    utc_us: NDArray[np.int64] = ticks["utc_us"]
    at_us: NDArray[np.int64] = ticks["t_us"]
    ahead_us = np.interp(t_us, at_us, utc_us - at_us) if len(ticks) else 0.0
    return t_us + np.rint(ahead_us).astype(np.int64)


class _Export:
    """Logs a run to the channels of a context, in order of time."""

    def __init__(self, context: Context, recorded: RecordedFlight) -> None:
        from foxglove import channels, messages

        self._context, self._recorded, self._messages = context, recorded, messages
        self._ticks = {agent: rows for agent, rows in recorded.run.ticks.items() if len(rows)}
        self._begins_us = _begins_us(recorded.run)
        self._frames = channels.FrameTransformChannel("/tf", context=context)
        self._scene = channels.SceneUpdateChannel("/scene", context=context)
        self._events = channels.LogChannel("/events", context=context)

    def write(self) -> None:
        truth = self._recorded.run.truth
        first = next(iter(self._ticks.values()), _NO_TICKS)
        streams = [self._still(), self._event_logs(), *self._obstacles()]
        for agent, rows in self._ticks.items():
            streams += [self._vehicle(agent, rows), self._plans(agent, rows), self._goals(agent, rows)]
            streams.append(self._values(f"/agent/{agent}/tick", COLUMNS, rows, rows["utc_us"]))
        for vehicle in np.unique(truth["vehicle"]):
            rows = truth[truth["vehicle"] == vehicle]
            streams.append(self._values(f"/truth/{vehicle}", TRUTH_COLUMNS, rows, _utc_us(first, rows["t_us"])))
        for utc_us, log in heapq.merge(*streams, key=lambda message: message[0]):
            log(log_time=utc_us * 1000)

    # -- scene --------------------------------------------------------------------------------------------------------

    def _still(self) -> Messages:
        """Yield what does not change: the frames' relation."""
        half = math.sqrt(0.5)  # z up: x is east, y is north
        up = self._messages.Quaternion(x=half, y=half, z=0.0, w=0.0)
        yield self._frame(self._begins_us, _WORLD, _NED, np.zeros(3), up)

    def _goals(self, agent: int, rows: NDArray[np.void]) -> Messages:
        """Yield the goal of an agent: the configured one, then that of each mission that was set in flight."""
        known = self._recorded.flight.agents
        first = known[agent].goal_ned_m if agent < len(known) else None
        goals: list[tuple[int, Sequence[float] | Array | None]] = [(self._begins_us, first)]
        goals += [(int(mission["utc_us"][0]), goal_ned_m(mission)) for mission in missions(rows)[1:]]
        for utc_us, goal in goals:
            if goal is not None:
                ball = self._ball(goal, _GOAL_M, (*agent_rgb(agent), 90))
                yield self._draw(utc_us, f"goal-{agent}", _NED, spheres=[ball])
            elif utc_us > self._begins_us:
                yield self._erase(utc_us, f"goal-{agent}")

    def _vehicle(self, agent: int, rows: NDArray[np.void]) -> Messages:
        """Yield the frame of a body in every tick; ten times a second the body and its reference."""
        seen = rows[np.isfinite(rows["pos_ned_m"]).all(axis=1) & np.isfinite(rows["q_nb"]).all(axis=1)]
        for number, row in enumerate(seen):
            utc_us, (w, x, y, z) = int(row["utc_us"]), row["q_nb"].tolist()
            rotation = self._messages.Quaternion(x=x, y=y, z=z, w=w)
            yield self._frame(utc_us, _NED, f"agent-{agent}", row["pos_ned_m"], rotation)
            if number % _SCENE_TICKS == 0:
                yield self._draw(utc_us, f"agent-{agent}", f"agent-{agent}", **self._body(agent))
                reference = row["ref_pos_ned_m"]
                if np.isfinite(reference).all():
                    ball = self._ball(reference, _REFERENCE_M, (*agent_rgb(agent), 160))
                    yield self._draw(utc_us, f"reference-{agent}", _NED, spheres=[ball])

    def _plans(self, agent: int, rows: NDArray[np.void]) -> Messages:
        """Yield the predicted paths of an agent."""
        for t_us, points_ned_m in _paths(self._recorded.plans.get(agent)):
            line = self._line(points_ned_m, (*agent_rgb(agent), 200))
            yield self._draw(int(_utc_us(rows, t_us)), f"plan-{agent}", _NED, lines=[line])

    def _obstacles(self) -> Iterator[Messages]:
        """Yield what draws each obstacle, until the next one of its number begins."""
        known = self._recorded.obstacles
        for k, judged in enumerate(known):
            yield self._obstacle(
                judged, next((later for later in known[k + 1 :] if later.number == judged.number), None)
            )

    def _obstacle(self, judged: JudgedObstacle, following: JudgedObstacle | None) -> Messages:
        """Yield an obstacle while it is there: once, or five times a second where it moves."""
        obstacle, name = judged.obstacle, f"obstacle-{judged.number}"
        since_us = self._begins_us if judged.since_utc_us is None else judged.since_utc_us
        begins_us = max(since_us, self._begins_us)
        ends_us = max((int(rows["utc_us"][-1]) for rows in self._ticks.values()), default=begins_us)
        gone_us = judged.until_utc_us if following is None else following.since_utc_us
        if gone_us is not None:
            ends_us = min(ends_us, gone_us)
        for at_us in range(begins_us, ends_us, _OBSTACLE_STEP_US) if obstacle.moves else (begins_us,):
            at_ned_m = obstacle.center_after((at_us - since_us) * 1e-6)
            if obstacle.column:
                drawn = {"cylinders": [self._column(at_ned_m, obstacle.radius_m)]}
            else:
                drawn = {"spheres": [self._ball(at_ned_m, obstacle.radius_m, (*LIMIT_RGB, 200))]}
            yield self._draw(at_us, name, _NED, **drawn)
        if gone_us is not None and following is None:
            yield self._erase(gone_us, name)

    def _draw(self, utc_us: int, name: str, frame: str, **primitives: Any) -> tuple[int, Callable[..., None]]:
        """Return the message that draws something, in the place of what was drawn under that name."""
        m = self._messages
        at = _timestamp(m, utc_us)
        entity = m.SceneEntity(timestamp=at, frame_id=frame, id=name, frame_locked=True, **primitives)
        return utc_us, partial(self._scene.log, m.SceneUpdate(entities=[entity]))

    def _erase(self, utc_us: int, name: str) -> tuple[int, Callable[..., None]]:
        """Return the message that erases what was drawn under a name."""
        m = self._messages
        deletion = m.SceneEntityDeletion(
            timestamp=_timestamp(m, utc_us), type=m.SceneEntityDeletionType.MatchingId, id=name
        )
        return utc_us, partial(self._scene.log, m.SceneUpdate(deletions=[deletion]))

    def _frame(
        self, utc_us: int, parent: str, child: str, at_m: Array, rotation: Any
    ) -> tuple[int, Callable[..., None]]:
        m = self._messages
        transform = m.FrameTransform(
            timestamp=_timestamp(m, utc_us),
            parent_frame_id=parent,
            child_frame_id=child,
            translation=self._vector(at_m),
            rotation=rotation,
        )
        return utc_us, partial(self._frames.log, transform)

    # -- parts of the scene -------------------------------------------------------------------------------------------

    def _body(self, agent: int) -> dict[str, Any]:
        """Return a vehicle and its number, in the frame of its body."""
        m, above = self._messages, self._pose((0.0, 0.0, -0.35))
        white, own = _color((*NUMBER_RGB, 255)), _color((*agent_rgb(agent), 255))
        number = m.TextPrimitive(pose=above, billboard=True, font_size=0.25, color=white, text=f"{agent}")
        plate = m.CubePrimitive(pose=self._pose((0.0, 0.0, 0.0)), size=self._vector(_BODY_M), color=own)
        return {"cubes": [plate], "texts": [number]}

    def _ball(self, at_m: Sequence[float] | Array, radius_m: float, rgba: tuple[int, int, int, int]) -> Any:
        size = self._vector((2.0 * radius_m,) * 3)
        return self._messages.SpherePrimitive(pose=self._pose(at_m), size=size, color=_color(rgba))

    def _column(self, at_ned_m: Array, radius_m: float) -> Any:
        """Return a column of any height, as high as half the scene."""
        flight = self._recorded.flight
        middle = self._pose((at_ned_m[0], at_ned_m[1], flight.center_ned_m[2]))
        size, color = self._vector((2.0 * radius_m, 2.0 * radius_m, flight.extent_m)), _color((*LIMIT_RGB, 200))
        return self._messages.CylinderPrimitive(pose=middle, size=size, bottom_scale=1.0, top_scale=1.0, color=color)

    def _line(self, points_m: Array, rgba: tuple[int, int, int, int]) -> Any:
        m = self._messages
        return m.LinePrimitive(
            type=m.LinePrimitiveLineType.LineStrip,
            pose=self._pose((0.0, 0.0, 0.0)),
            thickness=2.0,
            scale_invariant=True,  # pixels
            points=[m.Point3(x=x, y=y, z=z) for x, y, z in points_m.tolist()],
            color=_color(rgba),
        )

    def _pose(self, at_m: Sequence[float] | Array) -> Any:
        m = self._messages
        return m.Pose(position=self._vector(at_m), orientation=m.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0))

    def _vector(self, parts: Sequence[float] | Array) -> Any:
        x, y, z = (float(part) for part in parts)
        return self._messages.Vector3(x=x, y=y, z=z)

    # -- values, events -----------------------------------------------------------------------------------------------

    def _values(self, topic: str, columns: Sequence[StoredColumn], rows: NDArray[np.void], utc_us: Any) -> Messages:
        """Yield rows (T,) as JSON: vectors as objects of their components, enumerations as words."""
        from foxglove import Channel

        channel = Channel(topic, schema=json_schema(topic, columns), message_encoding="json", context=self._context)
        for first in range(0, len(rows), _BLOCK):
            messages = json_rows(rows[first : first + _BLOCK], columns)
            for message, at_us in zip(messages, utc_us[first : first + _BLOCK].tolist(), strict=True):
                yield at_us, partial(channel.log, message)

    def _event_logs(self) -> Messages:
        m = self._messages
        for event in sorted(self._recorded.run.events, key=utc_us_of):
            utc_us, name = utc_us_of(event), str(event.get("event", ""))
            level = (
                m.LogLevel.Error if name in _ERRORS else m.LogLevel.Warning if name in _WARNINGS else m.LogLevel.Info
            )
            said = {key: value for key, value in event.items() if key not in ("utc_us", "t_us", "source", "event")}
            text = f"{name} {json.dumps(said)}" if said else name
            source = str(event.get("source", ""))
            log = m.Log(timestamp=_timestamp(m, utc_us), level=level, message=text, name=source)
            yield utc_us, partial(self._events.log, log)


def json_schema(topic: str, columns: Sequence[StoredColumn]) -> dict[str, Any]:
    """Return the JSON schema of rows: types, and unit and meaning as descriptions."""
    properties: dict[str, Any] = {}
    for column in columns:
        kind = "string" if column.names is not None else _JSON_TYPES[np.dtype(column.dtype).kind]
        said = f"{column.text} [{column.unit}]" if column.unit else column.text
        scalar = {"type": kind}
        if column.size:
            components = dict.fromkeys(_axes(column), scalar)
            properties[column.name] = {"type": "object", "description": said, "properties": components}
        else:
            properties[column.name] = scalar | {"description": said}
    return {"title": f"swarmctl{topic.replace('/', '.')}", "type": "object", "properties": properties}


def json_rows(rows: NDArray[np.void], columns: Sequence[StoredColumn]) -> Iterator[dict[str, Any]]:
    """Yield rows (T,) as JSON objects; numbers that are not finite, which JSON does not know, are left out."""
    table = named_table(rows, columns).to_pydict()
    for row in range(len(rows)):
        message: dict[str, Any] = {}
        for column in columns:
            axes = _axes(column) if column.size else [column.name]
            values = zip(axes, (table[part][row] for part in column.parts), strict=True)
            known = {axis: value for axis, value in values if not isinstance(value, float) or math.isfinite(value)}
            message |= {column.name: known} if column.size else known
        yield message


def _axes(column: StoredColumn) -> list[str]:
    """Return the names of the components of a vector: x, y, z."""
    return [part.removeprefix(f"{column.name}_") for part in column.parts]


def _paths(points: NDArray[np.void] | None) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """Yield when each predicted path that is drawn was flown [us], and its points (M, 3)."""
    if points is None or not len(points):
        return
    times_us, begins = np.unique(points["t_us"], return_index=True)
    split = np.split(points["pos_ned_m"].astype(np.float64), begins[1:])
    _, drawn = np.unique(times_us // _PLAN_PERIOD_US, return_index=True)
    yield from ((int(times_us[k]), split[k]) for k in drawn)


def _timestamp(messages: Any, utc_us: int) -> Any:
    return messages.Timestamp(utc_us // 1_000_000, utc_us % 1_000_000 * 1000)


def _color(rgba: tuple[int, int, int, int]) -> Any:
    from foxglove.messages import Color

    red, green, blue, alpha = (part / 255.0 for part in rgba)
    return Color(r=red, g=green, b=blue, a=alpha)
