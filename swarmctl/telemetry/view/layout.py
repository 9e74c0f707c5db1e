"""The rerun blueprint: views and plots for a number of agents. Entity paths are those of `scene`."""

from __future__ import annotations

from typing import Any, NamedTuple

import rerun as rr
import rerun.blueprint as rrb

from swarmctl.core.tick_record import CURVES

TIMELINE = "flight_time"
_PLOT_S = 20.0  # sliding window of the plots
_TRAIL_S = 12.0  # length of the trails behind vehicles
_TABS = 10  # largest number of agents that get a tab


class SceneBounds(NamedTuple):
    """Bounds of the flight; the camera is placed to the south-west and above."""

    center_ned_m: tuple[float, float, float] = (0.0, 0.0, -2.0)
    extent_m: float = 6.0  # from the centre to the edge


def layout(agents: int, bounds: SceneBounds) -> Any:
    """Return the blueprint: scene, mode bars and log on the left, plots of the swarm and of each agent on the right."""
    names = [f"Agent {i}" for i in range(min(agents, _TABS))]
    tabs = [_swarm_plots(), *(_agent_plots(i, name) for i, name in enumerate(names))]
    below = rrb.Horizontal(
        rrb.StateTimelineView(origin="/state", name="Phase and mode"), _log(), column_shares=[3, 2], name="State"
    )
    left = rrb.Vertical(_scene(agents, bounds), below, row_shares=[5, 2])
    return rrb.Blueprint(
        rrb.Horizontal(left, rrb.Tabs(*tabs, active_tab=0), column_shares=[8, 5]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        auto_layout=False,
        auto_views=False,
    )


def _scene(agents: int, bounds: SceneBounds) -> Any:
    north_m, east_m, down_m = bounds.center_ned_m
    away_m = max(bounds.extent_m, 2.0)
    eye = (north_m - 1.2 * away_m, east_m - 1.05 * away_m, down_m - 1.2 * away_m)
    window = rr.VisibleTimeRange(TIMELINE, start=_cursor(-_TRAIL_S), end=_cursor())
    trails = [f"/world/trail/{i}" for i in range(agents)] + ["/world/reference_trail"]
    return rrb.Spatial3DView(
        origin="/world",
        name="Swarm, NED",
        background=[17, 21, 29],
        overrides={path: rrb.VisibleTimeRanges([window]) for path in trails},
        eye_controls=rrb.EyeControls3D(position=eye, look_target=bounds.center_ned_m, eye_up=(0, 0, -1)),
        line_grid=rrb.LineGrid3D(spacing=1.0, plane=rr.components.Plane3D.XY, color=[120, 130, 150, 60]),
    )


def _swarm_plots() -> Any:
    return rrb.Vertical(
        _plot("/plot/track_err", "Distance to the reference [m]"),
        _plot("/plot/separation", "Smallest separation and its limit [m]"),
        *(_plot(f"/plot/{name}", curve.title) for name, curve in CURVES.items()),
        name="Swarm",
    )


def _agent_plots(agent: int, name: str) -> Any:
    return rrb.Vertical(
        _plot(f"/plot/att/{agent}/roll", "Roll [deg]"),
        _plot(f"/plot/att/{agent}/pitch", "Pitch [deg]"),
        _plot(f"/plot/att/{agent}/thrust", "Thrust [0..1]"),
        name=name,
    )


def _plot(origin: str, name: str) -> Any:
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        plot_legend=rrb.PlotLegend(corner="LeftTop"),
        axis_x=rrb.TimeAxis(view_range=rr.TimeRange(start=_cursor(-_PLOT_S), end=_cursor())),
    )


def _log() -> Any:
    columns = rrb.TextLogColumns(timeline_columns=[TIMELINE], text_log_columns=["loglevel", "body"])
    return rrb.TextLogView(origin="/events", name="Events", columns=columns)


def _cursor(seconds: float = 0.0) -> Any:
    return rr.TimeRangeBoundary.cursor_relative(seconds=seconds)
