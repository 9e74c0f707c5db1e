"""Curves of one agent: errors, margins to its bounds, setpoints against what was measured."""

from __future__ import annotations

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from swarmctl.core.recorded.tick_record import CURVES
from swarmctl.core.types import Array, Phase
from swarmctl.telemetry.evaluation.attitude import roll_pitch_rad, tilt_rad
from swarmctl.telemetry.palette import REFERENCE_RGB, SPARE_RGB, agent_rgb
from swarmctl.telemetry.scene.stream import Stream, Times
from swarmctl.telemetry.scene.viewed_flight import AgentBounds, ViewedFlight

AXES = ("north", "east", "down")
_EVERY = 5  # ticks, of curves that say nothing about a single one


def begin_curves(stream: Stream, agent: int) -> None:
    """Send names and colours of an agent's curves."""
    rgb, name = agent_rgb(agent), f"agent {agent}"
    stream.static(f"plot/track_err/{agent}", rr.SeriesLines(names=[name], colors=[rgb]))
    for plot, curve in CURVES.items():
        mode = "StepAfter" if curve.is_count else "Linear"
        stream.static(f"plot/{plot}/{agent}", rr.SeriesLines(names=[name], colors=[rgb], interpolation_mode=mode))
    pairs = {f"att/{agent}/{angle}": ("setpoint", "measured") for angle in ("roll", "pitch")}
    pairs[f"att/{agent}/thrust"] = ("setpoint", "hover estimate")
    pairs |= {f"pos/{agent}/{axis}": ("reference", "measured") for axis in AXES}
    for plot, names in pairs.items():
        stream.static(f"plot/{plot}", rr.SeriesLines(names=names, colors=[REFERENCE_RGB, rgb]))
    distances = rr.SeriesLines(names=["peers", "obstacles"], colors=[rgb, SPARE_RGB[0]])
    stream.static(f"plot/margin/{agent}", distances)
    stream.static(f"plot/left/{agent}", rr.SeriesLines(names=["tilt", "thrust", "tick"], colors=[rgb, *SPARE_RGB]))


def send_curves(
    stream: Stream, agent: int, t_us: Times, rows: NDArray[np.void], flight: ViewedFlight, obstacle_margin_m: Array
) -> None:
    """Send the curves of some ticks.

    Args:
        stream: where to.
        agent: index of the agent.
        t_us: time of each row on the shared timeline (T,), increasing.
        rows: `TICK_DTYPE` rows (T,).
        flight: whose bounds they are drawn against.
        obstacle_margin_m: distance of each row (T,) from the nearest keep-out; inf without obstacles.
    """
    tracking = rows["phase"] == Phase.TRACK
    error_m = np.linalg.norm(rows["pos_ned_m"] - rows["ref_pos_ned_m"], axis=1)
    stream.scalars(f"plot/track_err/{agent}", t_us[tracking], error_m[tracking])
    for name, curve in CURVES.items():
        shown = np.ones(len(rows), bool) if curve.where is None else curve.where(rows)
        newest = slice(-1, None) if curve.is_slow else slice(None)
        stream.scalars(f"plot/{name}/{agent}", t_us[shown][newest], rows[name][shown][newest])
    asked_deg, had_deg = (np.degrees(roll_pitch_rad(rows[name])) for name in ("setpoint_q_nb", "q_nb"))
    for k, angle in enumerate(("roll", "pitch")):
        stream.scalars(f"plot/att/{agent}/{angle}", t_us, np.column_stack([asked_deg[:, k], had_deg[:, k]]))
    thrust_01 = np.column_stack([rows["setpoint_thrust_01"], rows["hover_thrust_01"]])
    stream.scalars(f"plot/att/{agent}/thrust", t_us, thrust_01)
    some = slice(None, None, _EVERY)
    t_us, rows, tracking, obstacle_margin_m = t_us[some], rows[some], tracking[some], obstacle_margin_m[some]
    wanted_ned_m = np.where(tracking[:, None], rows["ref_pos_ned_m"], np.nan)
    for k, axis in enumerate(AXES):
        pair = np.column_stack([wanted_ned_m[:, k], rows["pos_ned_m"][:, k]])
        stream.scalars(f"plot/pos/{agent}/{axis}", t_us, pair)
    margins_m = np.column_stack([rows["nearest_peer_m"] - flight.separation_m, obstacle_margin_m])
    stream.scalars(f"plot/margin/{agent}", t_us, margins_m)
    stream.scalars(f"plot/left/{agent}", t_us, left_percent(rows, flight.agents[agent], flight.tick_ms))


def left_percent(rows: NDArray[np.void], bounds: AgentBounds, tick_ms: float) -> Array:
    """Return what is left (T, 3) [%] of tilt, of thrust on the nearer side, and of the time of a tick.

    Tilt and thrust are those of the setpoints sent; without one they are NaN.
    """
    tilt_01 = tilt_rad(rows["setpoint_q_nb"]) / bounds.tilt_max_rad
    thrust_01 = np.asarray(rows["setpoint_thrust_01"], np.float64)
    nearer_01 = np.minimum(thrust_01 - bounds.thrust_min_01, bounds.thrust_max_01 - thrust_01)
    half_01 = 0.5 * (bounds.thrust_max_01 - bounds.thrust_min_01)
    return 100.0 * np.column_stack([1.0 - tilt_01, nearer_01 / half_01, 1.0 - rows["tick_ms"] / tick_ms])
