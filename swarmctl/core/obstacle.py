"""An obstacle, declared once: in the configuration, on the bus, and wherever one is avoided, judged or drawn."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError

from swarmctl.core.params import OTHER_KEY, Params
from swarmctl.core.types import Array

MAX_OBSTACLE_M = 10_000.0  # limit of every coordinate
_STEP_S = 0.05  # between the times at which the way of a moving one is looked at
_Coordinate = Annotated[float, Field(ge=-MAX_OBSTACLE_M, le=MAX_OBSTACLE_M)]
_Vector = Annotated[tuple[_Coordinate, _Coordinate, _Coordinate], Field(strict=False)]


class Obstacle(Params):
    """A sphere, or a vertical column of any height, visible to agents only from closer than `visibility_m`."""

    model_config = ConfigDict(validate_default=True)  # a default may not go with another key

    center_ned_m: _Vector  # when the launch starts, or when it is added
    column: bool = False  # true: of any height
    radius_m: float = Field(1.0, gt=0, le=1000)  # the obstacle itself, which the safety filter keeps clear of
    keep_out_m: float = Field(1.75, gt=0, le=1000)  # constraint radius, at least radius_m; thesis 1 + 2.5 x 0.3
    visibility_m: float = Field(3.0, gt=0, le=10000)  # agents farther from the centre do not see it; over keep_out_m
    vel_ned_m_s: _Vector = (0.0, 0.0, 0.0)  # constant

    @field_validator("keep_out_m")
    @classmethod
    def _holds_body(cls, keep_out_m: float, known: ValidationInfo) -> float:
        """Refuse a keep-out inside of the body, into which plans would lead."""
        radius_m = known.data.get("radius_m", 0.0)
        if keep_out_m < radius_m:
            raise PydanticCustomError(
                OTHER_KEY,
                "less than radius_m = {radius_m}, so that agents would fly into it; allowed: >= {radius_m}; raise it, "
                "or lower radius_m",
                {"radius_m": f"{radius_m:g}"},
            )
        return keep_out_m

    @field_validator("visibility_m")
    @classmethod
    def _is_seen_before(cls, visibility_m: float, known: ValidationInfo) -> float:
        """Refuse an obstacle that is seen only from within its keep-out."""
        key = "keep_out_m" if "keep_out_m" in known.data else "radius_m"
        kept_m = known.data.get(key, 0.0)
        if visibility_m <= kept_m:
            raise PydanticCustomError(
                OTHER_KEY,
                "agents would see it only when they are in its {key} = {kept_m}; allowed: > {kept_m}; raise it, or "
                "lower {key}",
                {"key": key, "kept_m": f"{kept_m:g}"},
            )
        return visibility_m

    @property
    def axes(self) -> int:
        """Number of leading axes along which a distance from it counts: a column has no height."""
        return 2 if self.column else 3

    @property
    def moves(self) -> bool:
        return any(self.vel_ned_m_s)

    def distance_m(self, pos_ned_m: Array | Sequence[float]) -> float:
        """Return the distance [m] of a position (3,) from the centre, or from the axis of a column."""
        return math.dist(self.center_ned_m[: self.axes], pos_ned_m[: self.axes])

    def descent_distance_m(self, pos_ned_m: Array | Sequence[float]) -> float:
        """Return the distance [m] of the vertical down from a position (3,) from the centre, or from the axis."""
        north_m, east_m, down_m = pos_ned_m
        return self.distance_m((north_m, east_m, max(down_m, self.center_ned_m[2])))

    def is_below(self, pos_ned_m: Array | Sequence[float]) -> bool:
        """Return whether the keep-out is on the vertical down from a position (3,)."""
        return self.descent_distance_m(pos_ned_m) < self.keep_out_m

    def is_above(self, pos_ned_m: Array | Sequence[float], top_z_m: float) -> bool:
        """Return whether the keep-out is on the vertical up from a position (3,) to a height, NED z; a column is."""
        north_m, east_m, down_m = pos_ned_m
        nearest = (north_m, east_m, max(self.center_ned_m[2], top_z_m))
        return (self.column or self.center_ned_m[2] < down_m) and self.distance_m(nearest) < self.keep_out_m

    def will_cross(self, place_ned_m: Array | Sequence[float], end_z_m: float, within_s: float) -> bool:
        """Return whether the keep-out will be, within a time, on the vertical from a place (3,) to a height, NED z."""
        north_m, east_m, down_m = place_ned_m
        highest_m, lowest_m = min(down_m, end_z_m), max(down_m, end_z_m)
        centers = self.center_after(np.arange(0.0, within_s + _STEP_S, _STEP_S)[:, None])  # (T, 3)
        nearest = np.array([north_m, east_m, 0.0]) + np.clip(centers[:, 2:], highest_m, lowest_m) * (0.0, 0.0, 1.0)
        apart = (centers - nearest)[:, : self.axes]
        return bool((apart * apart).sum(axis=1).min() < self.keep_out_m**2)

    def moved(self, elapsed_s: float) -> Obstacle:
        """Return the obstacle as it is after a time: at another centre if it moves."""
        if not self.moves:
            return self
        centre = tuple(self.center_after(elapsed_s).tolist())
        return self.model_copy(update={"center_ned_m": centre})

    def center_after(self, elapsed_s: float | NDArray[np.floating]) -> Array:
        """Return the centre NED [m] after a time, (3,), or (T, 3) after times (T, 1), at constant velocity."""
        return np.array(self.center_ned_m) + elapsed_s * np.array(self.vel_ned_m_s)


def taken_by(place_ned_m: Array | Sequence[float], obstacles: Mapping[int, Obstacle]) -> str:
    """Return in words which obstacle, by number, has a place (3,) in its keep-out; "" if none has."""
    for number, obstacle in obstacles.items():
        if (away_m := obstacle.distance_m(place_ned_m)) < obstacle.keep_out_m:
            away = f"{away_m:.2f} m from its {'axis' if obstacle.column else 'centre'}"
            return f"the keep-out of obstacle {number}, {away} (keep_out_m = {obstacle.keep_out_m:g})"
    return ""
