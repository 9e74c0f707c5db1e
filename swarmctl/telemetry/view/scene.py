"""Converts ticks to rerun entities, for the live viewer and the offline recording alike.

Each batch of rows becomes one `send_columns` per entity. The module knows no bus, files or processes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from swarmctl import __version__
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.tick_record import CURVES
from swarmctl.core.types import Array, Mode, Phase, PlanStatus
from swarmctl.telemetry.evaluation.attitude import roll_pitch_rad
from swarmctl.telemetry.palette import LIMIT_RGB, MODE_RGB, PHASE_RGB, REFERENCE_RGB, agent_rgb
from swarmctl.telemetry.view.layout import TIMELINE, SceneBounds, layout
from swarmctl.telemetry.view.quad_mesh import quad_glb
from swarmctl.telemetry.view.separation_feed import SeparationFeed

_BOUNDS = SceneBounds()
_REPEAT_US = 2_000_000  # period of repeated states, because the server's buffer drops rare data first
_COLUMN_HALF_M = 30.0  # half of the height drawn of a column
_PROBLEMS = {
    PlanStatus.SOLVER_FAILED: "solver failed",
    PlanStatus.RESIDUAL: "residual too large",
    PlanStatus.NOT_CERTIFIED: "plan would violate true distances",
}
_WARN_MODES = (Mode.REPLAY, Mode.BRAKE, Mode.PILOT_OVERRIDE)


class _Seen(NamedTuple):
    """Newest drawn row of an agent."""

    pos_ned_m: Array  # (3,)
    phase: int
    mode: int
    plan_status: int
    state_us: int  # when the state was last sent


class Scene:
    """Draws the entities of one swarm on one recording stream.

    Args:
        rec: stream whose sinks are set.
        agents: size of the swarm.
        separation_m: separation that agents keep; the drawn spheres have half of it as radius.
        limit_m: distance below which the referee sees a violation.
        bounds: bounds of the scene for the camera.
    """

    def __init__(
        self, rec: Any, agents: int, separation_m: float, limit_m: float, *, bounds: SceneBounds = _BOUNDS
    ) -> None:
        self._rec = rec
        self._agents = agents
        self._separation_m = separation_m
        self._limit_m = limit_m
        self._bounds = bounds
        self._seen: dict[int, _Seen] = {}
        self._pending: dict[int, list[tuple[NDArray[np.int64], NDArray[np.void]]]] = {}
        self._reference_ned_m: Array | None = None
        self._separation = SeparationFeed(agents)

    def begin(self) -> None:
        """Send the blueprint and all static entities; must be the first call on a new stream."""
        self._rec.send_blueprint(layout(self._agents, self._bounds), make_active=True, make_default=True)
        self._rec.send_property("swarmctl", rr.AnyValues(version=__version__))
        self._static("world", rr.ViewCoordinates.FRD)
        self._static("world/reference", rr.Points3D.from_fields(colors=[REFERENCE_RGB], radii=[0.09]))
        self._static(
            "world/reference_trail", rr.LineStrips3D.from_fields(colors=[(*REFERENCE_RGB, 110)], radii=[0.012])
        )
        for agent in range(self._agents):
            self._begin_agent(agent)
        self._static("plot/separation/min", rr.SeriesLines(names=["nearest pair"], colors=[(45, 212, 191)], widths=[2]))
        self._static("plot/separation/limit", rr.SeriesLines(names=[f"limit {self._limit_m:g} m"], colors=[LIMIT_RGB]))

    def _begin_agent(self, agent: int) -> None:
        rgb = agent_rgb(agent)
        name = f"agent {agent}"
        self._static(f"world/agent/{agent}/body", rr.Asset3D(contents=quad_glb(rgb), media_type="model/gltf-binary"))
        sphere = rr.Ellipsoids3D(
            half_sizes=[[self._separation_m / 2] * 3],
            colors=[(*rgb, 60)],
            line_radii=[0.003],
            fill_mode="MajorWireframe",
        )
        self._static(f"world/agent/{agent}/safety", sphere)
        self._static(f"world/trail/{agent}", rr.LineStrips3D.from_fields(colors=[rgb], radii=[0.018]))
        self._static(f"world/plan/{agent}", rr.LineStrips3D.from_fields(colors=[(255, 255, 255, 190)], radii=[0.014]))
        self._static(f"plot/track_err/{agent}", rr.SeriesLines(names=[name], colors=[rgb]))
        for plot, curve in CURVES.items():
            mode = "StepAfter" if curve.is_count else "Linear"
            self._static(f"plot/{plot}/{agent}", rr.SeriesLines(names=[name], colors=[rgb], interpolation_mode=mode))
        for plot, names in (("roll", "measured"), ("pitch", "measured"), ("thrust", "hover estimate")):
            lines = rr.SeriesLines(names=["setpoint", names], colors=[(148, 163, 184), rgb])
            self._static(f"plot/att/{agent}/{plot}", lines)
        for kind, colors in (("phase", PHASE_RGB), ("mode", MODE_RGB)):
            self._static(f"state/{agent}/{kind}", _state_style(colors))

    def obstacles(self, obstacles: Sequence[Obstacle], t_us: int, elapsed_s: float) -> None:
        """Replace the drawn obstacles from `t_us` on; `elapsed_s` is the time since the obstacles were set."""
        self._rec.set_time(TIMELINE, duration=np.timedelta64(t_us, "us"))
        for path, radii_m, mode, alpha in (
            ("world/obstacles/body", [o.radius_m for o in obstacles], "solid", 255),
            ("world/obstacles/keep_out", [o.keep_out_m for o in obstacles], "MajorWireframe", 120),
        ):
            spheres = rr.Ellipsoids3D(
                centers=[o.center_after(elapsed_s) for o in obstacles],
                half_sizes=[
                    [radius_m, radius_m, _COLUMN_HALF_M if o.column else radius_m]
                    for o, radius_m in zip(obstacles, radii_m, strict=True)
                ],
                colors=[(*LIMIT_RGB, alpha)] * len(obstacles),
                line_radii=[0.004],
                fill_mode=mode,
            )
            self._rec.log(path, spheres)
        self._rec.reset_time()

    def ticks(self, agent: int, t_us: NDArray[np.int64], rows: NDArray[np.void], plan_ned_m: Array | None) -> None:
        """Draw poses, trails and changes of state of an agent; its curves are drawn by `plots`.

        Args:
            agent: index of the agent.
            t_us: time of each row on the shared timeline (T,), increasing.
            rows: `TICK_DTYPE` rows (T,).
            plan_ned_m: newest predicted path (M, 3), drawn at the last row; None to keep the old one.
        """
        if not len(rows):
            return
        self._vehicle(agent, t_us, rows)
        if plan_ned_m is not None:
            plan = [plan_ned_m] if len(plan_ned_m) > 1 else []
            self._strips(f"world/plan/{agent}", t_us[-1:], plan)
        self._pending.setdefault(agent, []).append((t_us, rows))
        self._states(agent, t_us, rows)
        self._separation.offer(agent, t_us, rows["pos_ned_m"])
        last = rows[-1]
        sent_us = self._seen[agent].state_us if agent in self._seen else 0
        state = (int(last["phase"]), int(last["mode"]), int(last["plan_status"]))
        self._seen[agent] = _Seen(np.array(last["pos_ned_m"]), *state, sent_us)

    def plots(self) -> None:
        """Draw the curves of all ticks since the last call; called less often, because each chunk costs 3 kB."""
        for agent, parts in self._pending.items():
            self._plots(agent, np.concatenate([t_us for t_us, _ in parts]), np.concatenate([rows for _, rows in parts]))
        self._pending.clear()
        self._least_distance()

    def _least_distance(self) -> None:
        """Draw the smallest separation up to the newest instant that every live agent has reported."""
        t_us, least_m = self._separation.take()
        if len(t_us):
            self._scalars("plot/separation/min", t_us, least_m)
            self._scalars("plot/separation/limit", t_us[[0, -1]], np.full(2, self._limit_m))

    def log(self, source: str, t_us: int, level: str, text: str) -> None:
        """Add one line to the event view."""
        columns = rr.TextLog.columns(text=[f"{source}: {text}"], level=[level])
        self._rec.send_columns(f"events/{source}", self._when(np.array([t_us])), columns)

    def _vehicle(self, agent: int, t_us: NDArray[np.int64], rows: NDArray[np.void]) -> None:
        pos_ned_m = rows["pos_ned_m"]
        quat_xyzw = rows["q_nb"][:, [1, 2, 3, 0]]
        when = self._when(t_us)
        pose = rr.Transform3D.columns(translation=pos_ned_m, quaternion=quat_xyzw)
        self._rec.send_columns(f"world/agent/{agent}", when, pose)
        before = self._seen.get(agent)
        trail = pos_ned_m if before is None else np.vstack([before.pos_ned_m, pos_ned_m])
        self._strips(f"world/trail/{agent}", t_us[-1:], [trail] if len(trail) > 1 else [])
        following = np.flatnonzero(rows["phase"] == Phase.TRACK)
        if agent == min({agent, *self._seen}) and len(following):
            self._reference(t_us[following], rows["ref_pos_ned_m"][following])

    def _reference(self, t_us: NDArray[np.int64], ref_ned_m: Array) -> None:
        self._rec.send_columns("world/reference", self._when(t_us[-1:]), rr.Points3D.columns(positions=ref_ned_m[-1:]))
        known = ref_ned_m if self._reference_ned_m is None else np.vstack([self._reference_ned_m, ref_ned_m])
        self._strips("world/reference_trail", t_us[-1:], [known] if len(known) > 1 else [])
        self._reference_ned_m = np.array(ref_ned_m[-1])

    def _plots(self, agent: int, t_us: NDArray[np.int64], rows: NDArray[np.void]) -> None:
        tracking = rows["phase"] == Phase.TRACK
        error_m = np.linalg.norm(rows["pos_ned_m"] - rows["ref_pos_ned_m"], axis=1)
        self._scalars(f"plot/track_err/{agent}", t_us[tracking], error_m[tracking])
        for name, curve in CURVES.items():
            shown = np.ones(len(rows), bool) if curve.where is None else curve.where(rows)
            newest = slice(-1, None) if curve.is_count else slice(None)
            self._scalars(f"plot/{name}/{agent}", t_us[shown][newest], rows[name][shown][newest])
        asked_deg, had_deg = (np.degrees(roll_pitch_rad(rows[name])) for name in ("setpoint_q_nb", "q_nb"))
        pairs = {
            "roll": np.column_stack([asked_deg[:, 0], had_deg[:, 0]]),
            "pitch": np.column_stack([asked_deg[:, 1], had_deg[:, 1]]),
            "thrust": np.column_stack([rows["setpoint_thrust_01"], rows["hover_thrust_01"]]),
        }
        for name, pair in pairs.items():
            self._scalars(f"plot/att/{agent}/{name}", t_us, pair)

    def _states(self, agent: int, t_us: NDArray[np.int64], rows: NDArray[np.void]) -> None:
        """Send state bars and log lines at each change, and bars also every `_REPEAT_US`."""
        before = self._seen.get(agent)
        repeat = before is None or t_us[-1] - before.state_us >= _REPEAT_US
        if before is not None and repeat:
            self._seen[agent] = before._replace(state_us=int(t_us[-1]))
        for kind, enum in (("phase", Phase), ("mode", Mode)):
            old = getattr(before, kind) if before else -1
            changed = np.flatnonzero(np.diff(rows[kind].astype(int), prepend=old))
            picked = sorted({*changed.tolist(), *([len(rows) - 1] if repeat else [])})
            if picked:
                names = [_name(enum, int(rows[kind][k])) for k in picked]
                self._rec.send_columns(
                    f"state/{agent}/{kind}", self._when(t_us[picked]), rr.StateChange.columns(state=names)
                )
        self._log_changes(agent, t_us, rows, before)

    def _log_changes(self, agent: int, t_us: NDArray[np.int64], rows: NDArray[np.void], before: _Seen | None) -> None:
        lines = sorted(_changes(rows, before))
        if lines:
            columns = rr.TextLog.columns(
                text=[f"agent {agent}: {text}" for _, _, text in lines], level=[level for _, level, _ in lines]
            )
            when = self._when(t_us[[k for k, _, _ in lines]])
            self._rec.send_columns(f"events/agent-{agent}", when, columns)

    def _scalars(self, path: str, t_us: NDArray[np.int64], values: NDArray[Any]) -> None:
        if len(t_us):
            self._rec.send_columns(path, self._when(t_us), rr.Scalars.columns(scalars=np.asarray(values, np.float64)))

    def _strips(self, path: str, t_us: NDArray[np.int64], strips: list[Array]) -> None:
        if strips:
            self._rec.send_columns(path, self._when(t_us), rr.LineStrips3D.columns(strips=strips))

    def _static(self, path: str, archetype: Any) -> None:
        self._rec.log(path, archetype, static=True)

    @staticmethod
    def _when(t_us: NDArray[np.int64]) -> list[Any]:
        return [rr.TimeColumn(TIMELINE, duration=np.asarray(t_us).astype("timedelta64[us]").astype("timedelta64[ns]"))]


def _changes(rows: NDArray[np.void], before: _Seen | None) -> Iterator[tuple[int, str, str]]:
    """Yield (row, log level, text) of every change of phase, mode and plan status."""
    for kind, enum in (("phase", Phase), ("mode", Mode), ("plan_status", PlanStatus)):
        old = getattr(before, kind) if before else int(rows[kind][0])
        for k in np.flatnonzero(np.diff(rows[kind].astype(int), prepend=old)).tolist():
            value = int(rows[kind][k])
            if kind == "plan_status":
                if value in _PROBLEMS:
                    yield k, "WARN", f"plan refused: {_PROBLEMS[PlanStatus(value)]}"
                continue
            level = "INFO"
            if kind == "mode":
                level = "ERROR" if value == Mode.STATE_STALE else "WARN" if value in _WARN_MODES else "INFO"
            yield k, level, f"{kind} {_name(enum, value)}"


def _name(enum: Any, value: int) -> str:
    return str(enum(value).name) if value in list(enum) else str(value)


def _state_style(colors: dict[str, tuple[int, int, int]]) -> Any:
    packed = np.array([(r << 24) | (g << 16) | (b << 8) | 0xFF for r, g, b in colors.values()], np.uint32)
    return rr.StateConfiguration(values=list(colors), labels=list(colors), colors=packed)
