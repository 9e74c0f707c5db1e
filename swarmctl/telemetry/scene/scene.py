"""Converts ticks to rerun entities, for the live viewer and the offline recording alike.

Each batch of rows becomes one `send_columns` per entity. The module knows no bus, files or processes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from swarmctl import __version__
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Array
from swarmctl.telemetry.palette import LIMIT_RGB, NUMBER_RGB, agent_rgb, lighter
from swarmctl.telemetry.scene.curves import begin_curves, send_curves
from swarmctl.telemetry.scene.layout import layout
from swarmctl.telemetry.scene.quad_mesh import quad_glb
from swarmctl.telemetry.scene.references import References
from swarmctl.telemetry.scene.separation_feed import SeparationFeed
from swarmctl.telemetry.scene.states import TABLE, States, status_table
from swarmctl.telemetry.scene.stream import Stream, Times, pieces
from swarmctl.telemetry.scene.surroundings import draw_compass, draw_obstacles
from swarmctl.telemetry.scene.viewed_flight import ViewedFlight

_PUSH_M_PER_M_S2, _LEAST_PUSH_M_S2 = 1.0, 0.1  # length of the arrow of a disturbance; smaller ones have none
_NUMBER_ABOVE = 0.09  # height of a number above its vehicle, of the scene's extent
_PLACE_TICKS = 2  # from one place of the camera that follows a vehicle to the next
_PIECE_TICKS = 5  # of the trail


class Scene:
    """Draws the entities of one swarm on one recording stream, whose sinks are set."""

    def __init__(self, rec: Any, flight: ViewedFlight) -> None:
        self._rec, self._stream, self._flight = rec, Stream(rec), flight
        self._newest: dict[int, Any] = {}  # row of TICK_DTYPE
        self._newest_us = 0
        self._pending: dict[int, list[tuple[Times, NDArray[np.void]]]] = {}
        self._states: list[States] = []
        self._references = References(self._stream, flight)
        self._separation = SeparationFeed(len(flight.agents))
        self._obstacles: tuple[Sequence[Obstacle], int] = ((), 0)  # and when they were where they say

    def begin(self) -> None:
        """Send the blueprint and all static entities; must be the first call on a new stream."""
        self._rec.send_blueprint(layout(self._flight), make_active=True, make_default=True)
        self._rec.send_property("swarmctl", rr.AnyValues(version=__version__))
        self._stream.static("world", rr.ViewCoordinates.FRD)
        draw_compass(self._stream, self._flight)
        self._references.begin()
        for agent in range(len(self._flight.agents)):
            self._begin_agent(agent)
            self._states.append(States(self._stream, agent))
        nearest = rr.SeriesLines(names=["nearest pair"], colors=[(45, 212, 191)], widths=[2])
        self._stream.static("plot/separation/min", nearest)
        limit = rr.SeriesLines(names=[f"limit {self._flight.violation_m:g} m"], colors=[LIMIT_RGB])
        self._stream.static("plot/separation/limit", limit)

    def _begin_agent(self, agent: int) -> None:
        rgb = agent_rgb(agent)
        body = rr.Asset3D(contents=quad_glb(rgb), media_type="model/gltf-binary")
        self._stream.static(f"world/agent/{agent}/body", body)
        sphere = rr.Ellipsoids3D(
            half_sizes=[[self._flight.separation_m / 2] * 3],
            colors=[(*rgb, 60)],
            line_radii=[0.003],
            fill_mode="MajorWireframe",
        )
        self._stream.static(f"world/agent/{agent}/safety", sphere)
        above = [0.0, 0.0, -_NUMBER_ABOVE * self._flight.extent_m]
        number = rr.Points3D([above], radii=[0.001], colors=[NUMBER_RGB], labels=[f"{agent}"], show_labels=True)
        self._stream.static(f"world/agent/{agent}/number", number)
        self._stream.static(f"world/trail/{agent}", rr.LineStrips3D.from_fields(colors=[rgb], radii=[0.018]))
        plan = rr.LineStrips3D.from_fields(colors=[lighter(rgb)], radii=[0.012])
        self._stream.static(f"world/plan/{agent}", plan)
        begin_curves(self._stream, agent)

    def obstacles(self, obstacles: Sequence[Obstacle], t_us: int, elapsed_s: float) -> None:
        """Replace the drawn obstacles from `t_us` on; `elapsed_s` is the time since the obstacles were set."""
        self._obstacles = (obstacles, t_us - round(elapsed_s * 1e6))
        draw_obstacles(self._stream, obstacles, t_us, elapsed_s, self._flight)

    def ticks(
        self,
        agent: int,
        t_us: Times,
        rows: NDArray[np.void],
        plan_ned_m: Array | None = None,
        *,
        ahead_us: int = 0,
        is_anew: bool = False,
    ) -> None:
        """Draw poses, trails and changes of state of an agent; its curves are drawn by `plots`.

        Args:
            agent: index of the agent.
            t_us: time of each row on the shared timeline (T,), increasing.
            rows: `TICK_DTYPE` rows (T,).
            plan_ned_m: newest predicted path (M, 3), drawn at the last row; None to keep the old one.
            ahead_us: how far these times are ahead of those of other agents, which counts for distances between them.
            is_anew: whether they do not follow those before.
        """
        if not len(rows):
            return
        self._vehicle(agent, t_us, rows)
        if plan_ned_m is not None:
            self.plans(agent, t_us[-1:], [plan_ned_m])
        self._pending.setdefault(agent, []).append((t_us, rows))
        self._states[agent].take(t_us, rows)
        self._separation.offer(agent, t_us - ahead_us, rows["pos_ned_m"], is_anew=is_anew)
        self._newest[agent] = rows[-1]
        self._newest_us = max(self._newest_us, int(t_us[-1]))

    def plans(self, agent: int, t_us: Times, plans_ned_m: Sequence[Array]) -> None:
        """Draw predicted paths, (M, 3) each, from times `t_us` (T,) on; one without points is kept out."""
        drawn = [k for k, plan in enumerate(plans_ned_m) if len(plan) > 1]
        self._stream.strips(f"world/plan/{agent}", t_us[drawn], [plans_ned_m[k] for k in drawn])

    def plots(self) -> None:
        """Draw curves and table of all ticks since the last call; called less often, because each chunk costs 3 kB."""
        for agent, parts in self._pending.items():
            t_us, rows = np.concatenate([t for t, _ in parts]), np.concatenate([rows for _, rows in parts])
            margin_m = self._obstacle_margin_m(t_us, rows["pos_ned_m"])
            send_curves(self._stream, agent, t_us, rows, self._flight, margin_m)
        for agent in self._pending:
            self._wind(agent, self._newest[agent])
        if self._pending:
            self._stream.now(TABLE, self._newest_us, status_table(self._newest))
        self._pending.clear()
        self._least_distance()

    def log(self, source: str, t_us: int, level: str, text: str) -> None:
        """Add one line to the event view."""
        self._stream.lines(source, np.array([t_us]), [(level, text)])

    def _least_distance(self) -> None:
        """Draw the smallest separation up to the newest instant that every live agent has reported."""
        t_us, least_m = self._separation.take()
        if len(t_us):
            self._stream.scalars("plot/separation/min", t_us, least_m)
            self._stream.scalars("plot/separation/limit", t_us[[0, -1]], np.full(2, self._flight.violation_m))

    def _obstacle_margin_m(self, t_us: Times, pos_ned_m: Array) -> Array:
        """Return the distance (T,) of positions (T, 3) from the nearest keep-out; inf without obstacles."""
        margin_m = np.full(len(t_us), np.inf)
        obstacles, set_us = self._obstacles
        for obstacle in obstacles:
            away_m = pos_ned_m - obstacle.center_after((t_us[:, None] - set_us) * 1e-6)
            distance_m = np.linalg.norm(away_m[:, : obstacle.axes], axis=1)
            margin_m = np.minimum(margin_m, distance_m - obstacle.keep_out_m)
        return margin_m

    def _wind(self, agent: int, row: Any) -> None:
        """Draw what pushes a vehicle by its agent's estimate, wind above all, as an arrow from its place."""
        push = row["disturbance_ned_m_s2"].astype(float)
        is_felt = bool(np.isfinite(push).all()) and float(np.linalg.norm(push)) > _LEAST_PUSH_M_S2
        arrow = rr.Arrows3D(
            vectors=[push * _PUSH_M_PER_M_S2] if is_felt else [],
            radii=[0.02] if is_felt else [],
            colors=[NUMBER_RGB] if is_felt else [],
        )
        self._stream.now(f"world/place/{agent}/wind", self._newest_us, arrow)

    def _vehicle(self, agent: int, t_us: Times, rows: NDArray[np.void]) -> None:
        pos_ned_m = rows["pos_ned_m"]
        pose = rr.Transform3D.columns(translation=pos_ned_m, quaternion=rows["q_nb"][:, [1, 2, 3, 0]])
        self._stream.columns(f"world/agent/{agent}", t_us, pose)
        place = rr.Transform3D.columns(translation=pos_ned_m[::_PLACE_TICKS])  # a camera there does not turn
        self._stream.columns(f"world/place/{agent}", t_us[::_PLACE_TICKS], place)
        before = self._newest.get(agent)
        ends, lines = pieces(pos_ned_m, None if before is None else before["pos_ned_m"], _PIECE_TICKS)
        self._stream.strips(f"world/trail/{agent}", t_us[ends], lines)
        self._references.take(agent, t_us, rows)
