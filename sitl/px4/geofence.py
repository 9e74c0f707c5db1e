"""The geofence of one vehicle: a cylinder around home (GF_MAX_HOR_DIST, GF_MAX_VER_DIST) and uploaded areas."""

from __future__ import annotations

import math

from sitl.plant.sensors import LocalOrigin
from sitl.px4.missions import CIRCLE_IN, CIRCLE_OUT, FENCE, FENCE_IN, FENCE_OUT, Store
from sitl.px4.parameters import Parameters

Xy = tuple[float, float]
TEXT_DISTANCE = "Geofence: exceeding maximum distance to Home"
TEXT_HEIGHT = "Geofence: exceeding maximum altitude above Home"
TEXT_AREA = "Geofence: approaching or outside geofence"


class Geofence:
    """Tests positions against the fences; it does not act."""

    def __init__(self, parameters: Parameters, store: Store) -> None:
        self._parameters = parameters
        self._store = store
        self._areas: list[tuple[bool, list[Xy]]] = []  # polygons: keep in or out, corners
        self._circles: list[tuple[bool, Xy, float]] = []
        self._known = (-1, 0, 0)

    def breaches(
        self, pos_ned_m: tuple[float, float, float], home_ned_m: tuple[float, float, float] | None, origin: LocalOrigin
    ) -> list[str]:
        """Return PX4's text for every fence that a position violates; empty inside."""
        found: list[str] = []
        x_m, y_m, z_m = pos_ned_m
        if home_ned_m is not None:
            away_m, high_m = self._parameters.real("GF_MAX_HOR_DIST"), self._parameters.real("GF_MAX_VER_DIST")
            if away_m > 0 and math.hypot(x_m - home_ned_m[0], y_m - home_ned_m[1]) > away_m:
                found.append(TEXT_DISTANCE)
            if high_m > 0 and home_ned_m[2] - z_m > high_m:
                found.append(TEXT_HEIGHT)
        if self._store.items[FENCE]:
            self._read(origin)
            if not self._allowed((x_m, y_m)):
                found.append(TEXT_AREA)
        return found

    def _allowed(self, at_m: Xy) -> bool:
        """Return whether a position is outside every exclusion and, if there are any, inside an inclusion."""
        inclusions: list[bool] = []
        for keep_in, corners in self._areas:
            inside = _inside(at_m, corners)
            if keep_in:
                inclusions.append(inside)
            elif inside:
                return False
        for keep_in, centre, radius_m in self._circles:
            inside = math.dist(at_m, centre) <= radius_m
            if keep_in:
                inclusions.append(inside)
            elif inside:
                return False
        return any(inclusions) or not inclusions

    def _read(self, origin: LocalOrigin) -> None:
        known = self._store.changes, origin.lat_e7, origin.lon_e7
        if known == self._known:
            return
        self._known = known
        self._areas, self._circles = [], []
        items, i = self._store.items[FENCE], 0
        while i < len(items):
            item = items[i]
            if item.command in (CIRCLE_IN, CIRCLE_OUT):
                centre = origin.to_xy_m(item.lat_e7, item.lon_e7)
                self._circles.append((item.command == CIRCLE_IN, centre, item.params[0]))
                i += 1
            elif item.command in (FENCE_IN, FENCE_OUT):
                corners = items[i : i + int(item.params[0])]
                self._areas.append((item.command == FENCE_IN, [origin.to_xy_m(c.lat_e7, c.lon_e7) for c in corners]))
                i += len(corners)
            else:
                i += 1


def _inside(at_m: Xy, corners: list[Xy]) -> bool:
    """Apply the even-odd rule."""
    x_m, y_m = at_m
    inside = False
    for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True):
        if (ay > y_m) != (by > y_m) and x_m < (bx - ax) * (y_m - ay) / (by - ay) + ax:
            inside = not inside
    return inside
