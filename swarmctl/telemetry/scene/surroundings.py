"""What stands still in the scene, or moves by itself: compass and scale, obstacles."""

from __future__ import annotations

from collections.abc import Sequence

import rerun as rr

from swarmctl.core.obstacle import Obstacle
from swarmctl.telemetry.palette import LIMIT_RGB, NUMBER_RGB
from swarmctl.telemetry.scene.stream import Stream
from swarmctl.telemetry.scene.viewed_flight import ViewedFlight


def draw_compass(stream: Stream, flight: ViewedFlight) -> None:
    """Draw an arrow to the north and one to the east, as long as the scale, in the corner nearest to the camera."""
    north_m, east_m, _ = flight.center_ned_m
    corner = [north_m - 0.3 * flight.extent_m, east_m - 0.8 * flight.extent_m, 0.0]  # lower left of the picture
    arrows = rr.Arrows3D(
        vectors=[[flight.scale_m, 0.0, 0.0], [0.0, flight.scale_m, 0.0]],
        origins=[corner, corner],
        radii=[0.006 * flight.extent_m] * 2,
        colors=[NUMBER_RGB] * 2,
        labels=["N", f"E, {flight.scale_m:g} m"],
        show_labels=True,
    )
    stream.static("world/compass", arrows)


def draw_obstacles(
    stream: Stream, obstacles: Sequence[Obstacle], t_us: int, elapsed_s: float, flight: ViewedFlight
) -> None:
    """Draw obstacles at `t_us`, `elapsed_s` after they were set; columns are drawn as high as half the scene."""
    height_m = flight.extent_m
    balls, columns = [o for o in obstacles if not o.column], [o for o in obstacles if o.column]
    axes = [(*o.center_after(elapsed_s)[:2], flight.center_ned_m[2]) for o in columns]
    for path, what, mode, alpha in (
        ("body", "radius_m", "solid", 255),
        ("keep_out", "keep_out_m", "MajorWireframe", 120),
    ):
        spheres = rr.Ellipsoids3D(
            centers=[o.center_after(elapsed_s) for o in balls],
            half_sizes=[[getattr(o, what)] * 3 for o in balls],
            colors=[(*LIMIT_RGB, alpha)] * len(balls),
            line_radii=[0.004],
            fill_mode=mode,
        )
        stream.now(f"world/obstacles/{path}", t_us, spheres)
        cylinders = rr.Cylinders3D(
            lengths=[height_m] * len(columns),
            radii=[getattr(o, what) for o in columns],
            centers=axes,
            colors=[(*LIMIT_RGB, alpha)] * len(columns),
            line_radii=[0.004],
            fill_mode=mode,
        )
        stream.now(f"world/columns/{path}", t_us, cylinders)
