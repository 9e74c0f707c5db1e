"""The rerun blueprint: views and plots for a number of agents. Entity paths are those of `scene`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from swarmctl.core.recorded.tick_record import CURVES, Curve
from swarmctl.telemetry.scene.viewed_flight import ViewedFlight

TIMELINE = "flight_time"
_PLOT_S = 20.0  # sliding window of the plots
_TRAIL_S = 12.0  # length of the trails behind vehicles
_SHARE = (0.0, 1.05)  # axis of a share, with room above
_TABS = 20  # largest number of agents that get a tab
_LEGENDS = 5  # agents that a legend in a small plot has room for
_ROWS = 8  # agents that a low table has room for
_FOLLOWING_M = (-3.0, -2.5, -2.0)  # camera that follows a vehicle, relative to it


def layout(flight: ViewedFlight) -> Any:
    """Return the blueprint: scene, states and log on the left, pages of plots on the right."""
    agents = len(flight.agents)
    tabs = [_plots("Swarm", "swarm", agents), _plots("Timing", "timing", agents)]
    tabs += [_agent_page(agent, flight) for agent in range(min(agents, _TABS))]
    below = rrb.Horizontal(_states(agents), _log(), column_shares=[3, 2], name="State")
    left = rrb.Vertical(_scene(flight), below, row_shares=[5, 2 if agents <= _ROWS else 3])
    return rrb.Blueprint(
        rrb.Horizontal(left, rrb.Tabs(*tabs, active_tab=0), column_shares=[8, 5]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        auto_layout=False,
        auto_views=False,
    )


def _scene(flight: ViewedFlight) -> Any:
    north_m, east_m, down_m = flight.center_ned_m
    away_m = max(flight.extent_m, 2.0)
    eye = (north_m - 1.1 * away_m, east_m - 1.0 * away_m, down_m - 1.1 * away_m)
    camera = rrb.EyeControls3D(position=eye, look_target=flight.center_ned_m, eye_up=(0, 0, -1))
    return _space("Swarm, NED", flight, camera)


def _space(name: str, flight: ViewedFlight, camera: Any, origin: str = "/world") -> Any:
    """Return a view of the whole scene, seen from a camera whose place is relative to `origin`."""
    window = rr.VisibleTimeRange(TIMELINE, start=_cursor(-_TRAIL_S), end=_cursor())
    agents = range(len(flight.agents))
    trails = [f"/world/{trail}/{i}" for trail in ("trail", "reference_trail") for i in agents]
    return rrb.Spatial3DView(
        origin=origin,
        contents="+ /world/**",
        name=name,
        background=[17, 21, 29],
        overrides={path: rrb.VisibleTimeRanges([window]) for path in trails},
        eye_controls=camera,
        line_grid=rrb.LineGrid3D(spacing=flight.scale_m, plane=rr.components.Plane3D.XY, color=[120, 130, 150, 60]),
    )


def _plots(name: str, page: str, agents: int) -> Any:
    """Return a page with a curve for each agent in every plot; of many agents the first, larger one has the legend."""
    error = [("track_err", Curve(title="Distance to the reference [m]"))] if page == "swarm" else []
    plots = error + [(key, curve) for key, curve in CURVES.items() if curve.page == page]
    crowded = agents > _LEGENDS
    views = [
        _plot(f"/plot/{key}", curve.titled("since the start"), legend=not crowded or k == 0, is_share=curve.is_share)
        for k, (key, curve) in enumerate(plots)
    ]
    shares = [3.0 if crowded and k == 0 else 1.0 for k in range(len(views))]
    if page == "swarm":
        views.insert(1, _plot("/plot/separation", "Smallest separation and its limit [m]"))
        shares.insert(1, 1.0)
    return rrb.Vertical(*views, row_shares=shares, name=name)


def _agent_page(agent: int, flight: ViewedFlight) -> Any:
    """Return the page of one agent: a camera that follows it, its states, its margins, asked against measured."""
    follow = rrb.EyeControls3D(position=_FOLLOWING_M, look_target=(0, 0, 0), eye_up=(0, 0, -1))
    top = rrb.Horizontal(
        _space(f"Following agent {agent}", flight, follow, origin=f"/world/place/{agent}"),
        _bars("Phase, mode, plan", [f"/state/{agent}/{kind}" for kind in ("phase", "mode", "plan")]),
        column_shares=[3, 2],
    )
    margins = rrb.Horizontal(
        _plot(f"/plot/margin/{agent}", "Margin to keep-outs [m]"),
        _plot(f"/plot/left/{agent}", "Left of its bounds [%]"),
    )
    positions = [_plot(f"/plot/pos/{agent}/{axis}", f"{axis.title()} [m]") for axis in ("north", "east", "down")]
    attitudes = [
        _plot(f"/plot/att/{agent}/{part}", f"{part.title()} [{unit}]")
        for part, unit in (("roll", "deg"), ("pitch", "deg"), ("thrust", "0..1"))
    ]
    pairs = [rrb.Horizontal(*pair) for pair in zip(positions, attitudes, strict=True)]
    return rrb.Vertical(top, margins, *pairs, row_shares=[3, 2, 2, 2, 2], name=f"{agent}")


def _plot(origin: str, name: str, *, legend: bool = True, is_share: bool = False) -> Any:
    return rrb.TimeSeriesView(
        origin=origin,
        name=name,
        plot_legend=rrb.PlotLegend(corner="LeftTop", visible=legend),
        axis_y=rrb.ScalarAxis(range=_SHARE) if is_share else None,
        axis_x=rrb.TimeAxis(view_range=rr.TimeRange(start=_cursor(-_PLOT_S), end=_cursor())),
    )


def _states(agents: int) -> Any:
    table = rrb.TextDocumentView(origin="/status", name="Agents")
    kinds = (("phase", "Phases"), ("mode", "Modes"), ("plan", "Plans"))
    bars = [_bars(name, [f"/state/{i}/{kind}" for i in range(agents)]) for kind, name in kinds]
    return rrb.Tabs(table, *bars, active_tab=0)


def _bars(name: str, paths: Sequence[str]) -> Any:
    return rrb.StateTimelineView(origin="/state", contents=[f"+ {path}" for path in paths], name=name)


def _log() -> Any:
    columns = rrb.TextLogColumns(timeline_columns=[TIMELINE], text_log_columns=["loglevel", "body"])
    return rrb.TextLogView(origin="/events", name="Events", columns=columns)


def _cursor(seconds: float = 0.0) -> Any:
    return rr.TimeRangeBoundary.cursor_relative(seconds=seconds)
