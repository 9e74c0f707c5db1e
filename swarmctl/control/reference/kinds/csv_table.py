"""References read from CSV files: points at times, or polynomials as crazyswarm2 writes them.

The files are read when a configuration is loaded (`swarmctl/configuration/tables.py`), which puts what they hold beside
their names; this module knows tables only.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from swarmctl.control.reference.kind import Place, SampledYaw, SharedReference, mission_kind
from swarmctl.control.reference.polynomial import PiecewisePolynomial, through
from swarmctl.core.params import Params
from swarmctl.core.types import Array, Sampled

POINT_COLUMNS = ("t", "x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az", "yaw")
POLYNOMIAL_COLUMNS = ("duration", *(f"{axis}^{k}" for axis in ("x", "y", "z", "yaw") for k in range(8)))
_POWERS = 8
Row = Annotated[tuple[float, ...], Field(strict=False)]
Frame = Literal["ned", "enu", "nwu"]
FRAMES_TO_NED = {  # north, east, down from x, y, z
    "ned": np.eye(3),
    "enu": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    "nwu": np.diag([1.0, -1.0, -1.0]),
}
# sign and offset of a yaw clockwise from north
_YAWS_TO_NED = {"ned": (1.0, 0.0), "enu": (-1.0, np.pi / 2.0), "nwu": (-1.0, 0.0)}


class Table(Params):
    """What one file holds; filled in when the file is read."""

    columns: tuple[str, ...] = Field((), strict=False)  # names in the file's first line
    rows: tuple[Row, ...] = Field((), strict=False)  # numbers of its other lines

    def column(self, *names: str) -> Array | None:
        """Return columns (R, D) of these names; None unless the table has all of them."""
        if not set(names) <= set(self.columns):
            return None
        return np.array(self.rows)[:, [self.columns.index(name) for name in names]]


@mission_kind("csv")
class CsvParams(SharedReference):
    """Describes references read from files: `t,x,y,z[,vx,vy,vz][,ax,ay,az][,yaw]`, or crazyswarm2's polynomials."""

    files: tuple[str, ...] = Field((), strict=False)  # one for each agent, or one that all share; beside this file
    frame: Frame = "ned"  # of the numbers: north east down, east north up, north west up
    from_start: bool = False  # positions count from the own start, not from the shared origin
    tables: tuple[Table, ...] = Field((), strict=False)  # content of the files, filled in where a run is recorded

    @property
    def fixed_in_time(self) -> bool:
        """Return whether agents have files of their own, or each flies the shared one from its own start."""
        return len(self.tables) > 1 or self.from_start

    def reference(self, place: Place) -> Sampled:
        flight, turn = self._flight(place), FRAMES_TO_NED[self.frame]
        origin = place.start_ned_m if self.from_start else np.zeros(3)

        def sampled(t_s: Array) -> tuple[Array, Array]:
            value, rate = flight.sample(t_s)
            return value[:, :3] @ turn.T + origin, rate[:, :3] @ turn.T

        return sampled

    def heading(self, place: Place) -> SampledYaw | None:
        flight, (sign, offset_rad) = self._flight(place), _YAWS_TO_NED[self.frame]
        if flight.coefficients.shape[2] < 4:
            return None
        return lambda t_s: sign * flight.sample(t_s)[0][:, 3] + offset_rad

    def ends_s(self, place: Place) -> float:
        return self._flight(place).end_s

    def problems(self, agents: int) -> Iterator[str]:
        if len(self.tables) not in (1, agents):
            count = f"{len(self.tables)} files for swarm.agents = {agents}"
            yield f"mission.csv.files: {count}; list one each, or one for all"
        if self.goal_assignment and self.fixed_in_time:
            yield "mission.csv.goal_assignment = true: is for files that agents share; set it to false"
        for i, table in enumerate(self.tables):
            name = self.files[i] if i < len(self.files) else f"tables.{i}"
            yield from (f"mission.csv: {name}: {problem}" for problem in _problems(table))

    def _flight(self, place: Place) -> PiecewisePolynomial:
        table = self.tables[place.agent if len(self.tables) > 1 else 0]
        return _FLIGHTS["duration" in table.columns](table)


def _of_points(table: Table) -> PiecewisePolynomial:
    """Return what meets the points; without velocities these are differences, with accelerations too it is quintic."""
    (t_s,) = _needed(table, "t").T
    values, rates = _needed(table, "x", "y", "z"), table.column("vx", "vy", "vz")
    accels = None if rates is None else table.column("ax", "ay", "az")
    flight = through(t_s, values, rates, accels)
    yaw = table.column("yaw")
    if yaw is None:
        return flight
    turning = through(t_s, np.unwrap(yaw, axis=0), None, None).coefficients
    padded = np.zeros((len(turning), flight.coefficients.shape[1], 1))
    padded[:, : turning.shape[1]] = turning
    return PiecewisePolynomial(knots_s=t_s, coefficients=np.concatenate([flight.coefficients, padded], axis=2))


def _of_polynomials(table: Table) -> PiecewisePolynomial:
    spans_s = _needed(table, "duration")[:, 0]
    axes = [_needed(table, *(f"{axis}^{k}" for k in range(_POWERS))) for axis in ("x", "y", "z", "yaw")]
    return PiecewisePolynomial(knots_s=np.concatenate([[0.0], np.cumsum(spans_s)]), coefficients=np.stack(axes, axis=2))


_FLIGHTS: dict[bool, Callable[[Table], PiecewisePolynomial]] = {False: _of_points, True: _of_polynomials}


def _needed(table: Table, *names: str) -> Array:
    found = table.column(*names)
    assert found is not None, "checked by `problems`"
    return found


def _problems(table: Table) -> Iterator[str]:
    known = POLYNOMIAL_COLUMNS if "duration" in table.columns else POINT_COLUMNS
    needed = POLYNOMIAL_COLUMNS if "duration" in table.columns else POINT_COLUMNS[:4]
    missing = [name for name in needed if name not in table.columns]
    unknown = [name for name in table.columns if name not in known]
    if missing or unknown or len(set(table.columns)) != len(table.columns):
        yield (
            f"columns {','.join(table.columns)}; allowed: t,x,y,z and any of vx,vy,vz ax,ay,az yaw, or crazyswarm2's "
            "duration,x^0..x^7,y^0..y^7,z^0..z^7,yaw^0..yaw^7"
        )
    elif len(table.rows) < (1 if known is POLYNOMIAL_COLUMNS else 2):
        yield f"{len(table.rows)} rows of numbers are no flight"
    elif any(len(row) != len(table.columns) for row in table.rows):
        yield f"every row needs {len(table.columns)} numbers"
    elif known is POLYNOMIAL_COLUMNS:
        short = np.flatnonzero(_needed(table, "duration")[:, 0] <= 0.0)
        yield from (f"row {i + 1}: a duration of {table.rows[i][0]:g} s; it must be above 0" for i in short[:1])
    else:
        t_s = _needed(table, "t")[:, 0]
        late = np.flatnonzero(np.diff(t_s) <= 0.0)
        yield from (f"row {i + 2}: t = {t_s[i + 1]:g} after {t_s[i]:g}; times must increase" for i in late[:1])
        if t_s[0] < 0.0:
            yield f"row 1: t = {t_s[0]:g}; the mission begins at 0"
