"""The volume that a swarm flies in, declared once: in the configuration, in plans, and wherever a flight is judged."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from pydantic import Field

from swarmctl.core.params import Params, Vec2, Vec3
from swarmctl.core.types import Array

_FEWEST, _MOST = 3, 12  # corners; each side is rows in every problem
_TINY_M2 = 1e-6  # of a turn: less is straight on
_TURNS = 2.0 * np.pi
_ROUNDS = 50  # of bringing a point inside; a box needs three


class VolumeParams(Params):
    """The volume to fly in, a convex polygon with floor and ceiling, in the shared frame; no corners: no volume."""

    corners_ne_m: tuple[Vec2, ...] = Field((), strict=False, max_length=_MOST)  # in order, either way round
    floor_z_m: float | None = Field(None, ge=-10_000, le=10_000)  # NED z: -1 is 1 m above the origin
    ceiling_z_m: float | None = Field(None, ge=-10_000, le=10_000)  # NED z, less than that of the floor
    margin_m: float = Field(0.3, ge=0, le=100)  # plans keep this much inside, for tracking errors and wind
    certify_slack_m: float = Field(0.1, ge=0, le=100)  # a plan that uses up more of the margin is never flown
    brake_m_s2: float = Field(1.5, gt=0, le=20)  # braking before a side that plans leave room for
    brake_z_m_s2: float = Field(3.0, gt=0, le=20)  # likewise before floor and ceiling

    def problems(self, starts_ned_m: Sequence[Vec3] = (), needed_m: float = 0.0) -> Iterator[str]:
        """Yield what is wrong with the volume: its form, or what does not go with it.

        Args:
            starts_ned_m: where agents wait for the mission to begin.
            needed_m: least margin, by tracking and gusts.
        """
        if problems := list(self._problems()):
            yield from problems
            return
        volume = self.flight_volume()
        if volume is None:
            return
        for agent, start in enumerate(starts_ned_m):
            if refusal := volume.refusal(start):
                yield f"start: agent {agent} would wait outside: {refusal}. Move it, or the volume"
        if self.margin_m < needed_m:
            yield (
                f"volume.margin_m = {self.margin_m:g}: separation.tracking_m and gusts of separation.gust_m_s need "
                f"{needed_m:.2f} m. Raise it"
            )

    def _problems(self) -> Iterator[str]:
        corners, floor_z_m, ceiling_z_m = self.corners_ne_m, self.floor_z_m, self.ceiling_z_m
        if not corners:
            if floor_z_m is not None or ceiling_z_m is not None:
                yield "volume.corners_ne_m: none, but a floor or a ceiling; list the corners, or leave these out"
            return
        if len(corners) < _FEWEST:
            yield f"volume.corners_ne_m: {len(corners)} corners are no polygon; list {_FEWEST} or more"
        elif (dent := _dent(np.array(corners))) is not None:
            yield (
                f"volume.corners_ne_m.{dent} = {list(corners[dent])}: here the polygon is dented, crosses itself, or"
                " goes straight on; a volume is convex: leave such corners out"
            )
        if floor_z_m is None or ceiling_z_m is None:
            missing = "floor_z_m" if floor_z_m is None else "ceiling_z_m"
            yield f"volume.{missing}: missing; give floor and ceiling with the corners"
        elif ceiling_z_m >= floor_z_m:
            yield (
                f"volume.ceiling_z_m = {ceiling_z_m:g}: not above volume.floor_z_m = {floor_z_m:g} (NED, up is "
                "negative); lower the floor or raise the ceiling"
            )
        if self.certify_slack_m > self.margin_m:
            yield (
                f"volume.certify_slack_m = {self.certify_slack_m:g}: more than volume.margin_m = {self.margin_m:g}; "
                "plans that leave the volume would be flown. Lower it"
            )

    def flight_volume(self) -> FlightVolume | None:
        """Return the volume of parameters without problems; None if there is none."""
        return FlightVolume(self) if self.corners_ne_m else None


class FlightVolume:
    """Holds the faces of a volume as half-spaces `normal . position >= offset`, sides first, then floor and ceiling.

    Args:
        params: without problems.

    Attributes:
        params: as given.
        normals_ned: (F, 3) of unit length, pointing inside.
        offsets_m: (F,) of the faces themselves.
        brakes_m_s2: (F,) braking that plans leave room for.
        sides: number of the faces that stand upright, one for each corner.
    """

    def __init__(self, params: VolumeParams) -> None:
        assert params.floor_z_m is not None and params.ceiling_z_m is not None
        corners = np.array(params.corners_ne_m)
        along = np.roll(corners, -1, axis=0) - corners
        inward = np.column_stack([-along[:, 1], along[:, 0]]) * (1.0 if _twice_area_m2(corners) > 0.0 else -1.0)
        inward /= np.linalg.norm(inward, axis=1)[:, None]
        self.params, self.sides = params, len(corners)
        self.normals_ned = np.zeros((self.sides + 2, 3))
        self.normals_ned[:-2, :2] = inward
        self.normals_ned[-2:, 2] = -1.0, 1.0
        self.offsets_m = np.append((inward * corners).sum(axis=1), [-params.floor_z_m, params.ceiling_z_m])
        self.brakes_m_s2 = np.append(np.full(self.sides, params.brake_m_s2), np.full(2, params.brake_z_m_s2))

    @property
    def planned_m(self) -> Array:
        """Return the offsets (F,) that plans keep."""
        return self.offsets_m + self.params.margin_m

    @property
    def certified_m(self) -> Array:
        """Return the offsets (F,) beyond which a plan is not flown."""
        return self.planned_m - self.params.certify_slack_m

    @property
    def planned_sides(self) -> tuple[Array, Array]:
        """Return normals (S, 2) and offsets (S,) of the sides, as plans keep them."""
        return self.normals_ned[: self.sides, :2], self.planned_m[: self.sides]

    def beyond_m(self, pos_ned_m: Array, kept_m: float = 0.0) -> Array:
        """Return how far (...,) positions (..., 3) are outside of the volume less `kept_m`; negative is inside."""
        outside: Array = (self.offsets_m + kept_m - pos_ned_m @ self.normals_ned.T).max(axis=-1)
        return outside

    def beyond_plans_m(self, pos_ned_m: Array) -> Array:
        """Return how far (...,) positions (..., 3) are outside of what plans keep to; negative is inside."""
        return self.beyond_m(pos_ned_m, self.params.margin_m)

    def braking_m_s2(self, pos_ned_m: Array, vel_ned_m_s: Array) -> float:
        """Return the deceleration by which braking straight ahead from a state, (3,) each, ends where plans keep to.

        At speed v it ends after v^2 / 2a. Faces that the position is outside of already don't count: no deceleration
        ends inside of them.
        """
        room_m = self.normals_ned @ pos_ned_m - self.planned_m
        towards_m_s = -(self.normals_ned @ vel_ned_m_s)
        ahead = (towards_m_s > 0.0) & (room_m > 0.0)
        if not ahead.any():
            return 0.0
        speed_m_s = float(np.linalg.norm(vel_ned_m_s))
        return float((0.5 * speed_m_s * towards_m_s[ahead] / room_m[ahead]).max())

    def face(self, pos_ned_m: Array) -> str:
        """Return the name of the face that a position (3,) is farthest outside of, or nearest to."""
        worst = int((self.offsets_m - self.normals_ned @ pos_ned_m).argmax())
        return f"side {worst}" if worst < self.sides else ("floor", "ceiling")[worst - self.sides]

    def brought_inside(self, pos_ned_m: Array) -> Array:
        """Return a position (3,) that plans keep to near another one; the same if that is one."""
        for _ in range(_ROUNDS):
            short_m = self.planned_m - self.normals_ned @ pos_ned_m
            worst = int(short_m.argmax())
            if short_m[worst] <= 0.0:
                break
            pos_ned_m = pos_ned_m + short_m[worst] * self.normals_ned[worst]
        return pos_ned_m

    def refusal(self, pos_ned_m: Sequence[float] | Array) -> str:
        """Say why plans do not lead to a position (3,), or ""."""
        where = np.asarray(pos_ned_m, dtype=np.float64)
        beyond_m = float(self.beyond_plans_m(where))
        if beyond_m <= 0.0:
            return ""
        place = ", ".join(f"{c:.2f}" for c in where)
        kept = f"volume.margin_m = {self.params.margin_m:g}"
        return f"{place} is {beyond_m:.2f} m outside of the flight volume less {kept} ({self.face(where)})"


def _twice_area_m2(corners: Array) -> float:
    """Return twice the area of a polygon with corners (K, 2), positive from north to east."""
    north, east = corners.T
    return float((north * np.roll(east, -1) - np.roll(north, -1) * east).sum())


def _dent(corners: Array) -> int | None:
    """Return the first corner (K, 2) at which the polygon does not turn as it does on the whole; None if convex."""
    leaving = np.roll(corners, -1, axis=0) - corners
    arriving = np.roll(leaving, 1, axis=0)
    turned = arriving[:, 0] * leaving[:, 1] - arriving[:, 1] * leaving[:, 0]
    straight = (arriving * leaving).sum(axis=1)
    side = 1.0 if turned.sum() > 0.0 else -1.0
    wrong = np.flatnonzero(side * turned <= _TINY_M2)
    if len(wrong):
        return int(wrong[0])
    angles = side * np.arctan2(turned, straight)
    around = angles.sum() > 1.5 * _TURNS  # a star turns one way, but twice around
    return len(corners) - 1 if around else None
