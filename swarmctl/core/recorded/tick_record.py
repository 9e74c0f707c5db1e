"""The record of one tick, and the one table of what is recorded of it.

A row of `COLUMNS` is everything there is to say about a recorded value: its name (with the unit), type, meaning, how it
follows from the tick, and where the view shows it. The bytes on the bus and in run files (`records`), the columns
and metadata of Parquet, the table in `docs/data_formats.md`, and the curves of view and report all derive from it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from swarmctl.core.recorded.stored_column import StoredColumn
from swarmctl.core.types import (
    Array,
    AttitudeSetpoint,
    ControlMode,
    FlightMode,
    Mode,
    Phase,
    Plan,
    PlanStatus,
    Reference,
    VehicleState,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class TickTiming:
    """Holds the durations of the parts of a tick [ms]."""

    sense_ms: float  # receiving included
    setup_ms: float  # prediction, reference, keep-outs, matrices
    commitment_ms: float  # receiving, checking and planning commitments; 0 in best effort
    spaces_ms: float  # half-spaces
    solve_ms: float  # inside the QP solver
    certify_ms: float
    barrier_ms: float  # the safety filter
    send_ms: float  # failsafe decision included

    @property
    def tick_ms(self) -> float:
        """Duration from receiving to sending the setpoint."""
        planned_ms = self.setup_ms + self.spaces_ms + self.solve_ms + self.certify_ms
        return self.sense_ms + self.commitment_ms + planned_ms + self.barrier_ms + self.send_ms


@dataclass(frozen=True, slots=True, kw_only=True)
class TickRecord:
    """Holds what one tick has seen, planned and sent; `COLUMNS` selects what is recorded of it."""

    t_us: int
    utc_us: int
    seq: int
    mission_t_s: float  # NaN outside TRACK
    phase: Phase
    mode: Mode
    control: ControlMode
    flight_mode: FlightMode
    armed: bool
    state: VehicleState | None
    reference: Reference | None  # the mission's reference now, one point
    plan: Plan | None  # the plan of this tick
    flown: Plan | None  # the plan whose input was sent, possibly an earlier one
    setpoint: AttitudeSetpoint | None  # None when none was sent
    setpoint_accel_ned_m_s2: Array | None  # (3,) that it asks for, drag aside; None when none was sent
    hover_thrust_01: float
    disturbance_ned_m_s2: Array  # (3,)
    nearest_peer_m: float  # inf without peers
    nearest_obstacle_m: float  # inf without visible obstacles
    plan_staleness_ms: float  # NaN without peers
    peers: int
    rejected: int
    deadline_misses: int
    safety_filter_acted: bool
    battery_01: float  # charge that remains; NaN while unknown
    timing: TickTiming


@dataclass(frozen=True, slots=True, kw_only=True)
class Curve:
    """Describes how a scalar is drawn over time, a line for each agent."""

    title: str  # with the unit
    page: Literal["swarm", "timing"] = "timing"  # of the view
    where: Callable[[NDArray[np.void]], NDArray[np.bool_]] | None = None  # rows (T,) to draw (T,); None: all
    is_count: bool = False  # it only grows: drawn in steps
    worst: Literal["largest", "smallest"] = "largest"  # value among agents
    is_slow: bool = False  # in the view its newest value is enough
    is_share: bool = False  # the view draws it from 0 to 1, whatever its values are

    def titled(self, since: str) -> str:
        """Return the title; that of a count says since when it is counted."""
        return f"{self.title} {since}" if self.is_count else self.title


@dataclass(frozen=True, slots=True, kw_only=True)
class Column(StoredColumn):
    """Describes one recorded value of a tick.

    Attributes:
        value: computes the value, a scalar or `size` components, from a record; None where there is none.
        none: number recorded where `value` is None.
        view: the curve of a scalar, or the entity of the view that shows it, `{}` being the agent; "" if none does.
    """

    value: Callable[[TickRecord], Any]
    none: float = math.nan
    view: Curve | str = ""

    @property
    def entity(self) -> str:
        """Entity of the view that shows the value, `{}` being the agent; "" if none does."""
        return f"plot/{self.name}/{{}}" if isinstance(self.view, Curve) else self.view

    def recorded(self, record: TickRecord) -> Any:
        """Return what is stored of a record: a scalar, or components (size,)."""
        value = self.value(record)
        if value is not None:
            return value
        return np.full(self.size, self.none) if self.size else self.none


_F4, _F8, _U1, _U2, _U4, _I8 = "<f4", "<f8", "u1", "<u2", "<u4", "<i8"
_POSE = "world/agent/{}"
_ROLL = "plot/att/{}/roll"
_THRUST = "plot/att/{}/thrust"
_SOLVE = Curve(title="Solve time [ms]", where=lambda rows: rows["iterations"] > 0)
_TICK = Curve(title="Tick time, listen to send [ms]")
_MISSES = Curve(title="Deadline misses", is_count=True, is_slow=True)
_STALENESS = Curve(title="Plan staleness, oldest of the peers' [ms]", page="swarm")
_BATTERY = Curve(title="Battery [0..1]", page="swarm", worst="smallest", is_slow=True, is_share=True)
_TYPES = "in `swarmctl/core/types.py`"
NOT_RECORDED = 255  # in place of an enumeration's number, of a recording that lacks the column

COLUMNS = (
    Column(name="t_us", dtype=_I8, unit="us", text="monotonic time of the tick", value=lambda tick: tick.t_us),
    Column(name="utc_us", dtype=_I8, unit="us", text="UTC of the tick", value=lambda tick: tick.utc_us),
    Column(name="seq", dtype=_U4, text="number of the tick", value=lambda tick: tick.seq),
    Column(
        name="mission_t_s",
        dtype=_F8,
        unit="s",
        text="mission time; NaN outside TRACK",
        value=lambda tick: tick.mission_t_s,
    ),
    Column(
        name="phase",
        dtype=_U1,
        text=f"phase of the mission, `Phase` {_TYPES}",
        names=Phase,
        value=lambda tick: tick.phase,
        view="state/{}/phase",
    ),
    Column(
        name="mode",
        dtype=_U1,
        text=f"mode of the agent, `Mode` {_TYPES}",
        names=Mode,
        value=lambda tick: tick.mode,
        view="state/{}/mode",
    ),
    Column(
        name="flight_mode",
        dtype=_U1,
        text=f"the autopilot's mode, `FlightMode` {_TYPES}",
        names=FlightMode,
        value=lambda tick: tick.flight_mode,
    ),
    Column(name="armed", dtype=_U1, text="1: armed", value=lambda tick: tick.armed),
    Column(
        name="state_age_ms",
        dtype=_F4,
        unit="ms",
        text="age of the vehicle's state",
        value=lambda tick: tick.state and (tick.t_us - tick.state.t_us) * 1e-3,
    ),
    Column(
        name="pos_ned_m",
        dtype=_F8,
        size=3,
        unit="m",
        text="reported position",
        value=lambda tick: tick.state and tick.state.pos_ned_m,
        view=_POSE,
    ),
    Column(
        name="vel_ned_m_s",
        dtype=_F8,
        size=3,
        unit="m/s",
        text="reported velocity",
        value=lambda tick: tick.state and tick.state.vel_ned_m_s,
    ),
    Column(
        name="q_nb",
        dtype=_F4,
        size=4,
        text="reported attitude",
        value=lambda tick: tick.state and tick.state.q_nb,
        view=_POSE,
    ),
    Column(
        name="ref_pos_ned_m",
        dtype=_F8,
        size=3,
        unit="m",
        text="the mission's reference now",
        value=lambda tick: tick.reference and tick.reference.pos_ned_m[0],
        view="world/reference/{}",
    ),
    Column(
        name="setpoint_q_nb",
        dtype=_F4,
        size=4,
        text="attitude sent; NaN when none was",
        value=lambda tick: tick.setpoint and tick.setpoint.q_nb,
        view=_ROLL,
    ),
    Column(
        name="setpoint_thrust_01",
        dtype=_F4,
        unit="0..1",
        text="thrust sent; NaN when none was",
        value=lambda tick: tick.setpoint and tick.setpoint.thrust_01,
        view=_THRUST,
    ),
    Column(
        name="hover_thrust_01",
        dtype=_F4,
        unit="0..1",
        text="estimated hover thrust",
        value=lambda tick: tick.hover_thrust_01,
        view=_THRUST,
    ),
    Column(
        name="disturbance_ned_m_s2",
        dtype=_F4,
        size=3,
        unit="m/s2",
        text="estimated disturbance",
        value=lambda tick: tick.disturbance_ned_m_s2,
    ),
    Column(
        name="nearest_peer_m",
        dtype=_F4,
        unit="m",
        text="distance to the newest prediction of any peer within reach; inf without",
        value=lambda tick: tick.nearest_peer_m,
    ),
    Column(
        name="nearest_obstacle_m",
        dtype=_F4,
        unit="m",
        text="distance to the centre of the nearest visible obstacle; inf without",
        value=lambda tick: tick.nearest_obstacle_m,
    ),
    Column(
        name="plan_staleness_ms",
        dtype=_F4,
        unit="ms",
        text="age of the oldest of the newest paths of peers within reach; NaN without",
        value=lambda tick: tick.plan_staleness_ms,
        formerly="path_age_ms",
        view=_STALENESS,
    ),
    Column(name="peers", dtype=_U2, text="number of paths in use", value=lambda tick: tick.peers),
    Column(name="rejected", dtype=_U4, text="number of bus messages refused so far", value=lambda tick: tick.rejected),
    Column(
        name="plan_status",
        dtype=_U1,
        text="0 ok, 1 solver failed, 2 residual too large, 3 not certified, 4 there was no plan",
        names=PlanStatus,
        value=lambda tick: tick.plan and tick.plan.status,
        none=PlanStatus.NONE,
        view="state/{}/plan",
    ),
    Column(
        name="slack_m",
        dtype=_F4,
        unit="m",
        text="largest slack of a distance that the plan has used",
        value=lambda tick: tick.plan and tick.plan.slack_m,
        none=0.0,
    ),
    Column(
        name="residual_m",
        dtype=_F4,
        unit="m",
        text="residual of the solution",
        value=lambda tick: tick.plan and tick.plan.residual_m,
        none=0.0,
    ),
    Column(
        name="iterations",
        dtype=_U4,
        text="iterations of the solver",
        value=lambda tick: tick.plan and tick.plan.iterations,
        none=0,
    ),
    Column(
        name="solve_ms",
        dtype=_F4,
        unit="ms",
        text="duration of the solver",
        value=lambda tick: tick.timing.solve_ms,
        view=_SOLVE,
    ),
    Column(
        name="tick_ms",
        dtype=_F4,
        unit="ms",
        text="duration from receiving to sending",
        value=lambda tick: tick.timing.tick_ms,
        view=_TICK,
    ),
    Column(
        name="deadline_misses",
        dtype=_U4,
        text="deadlines missed since the agent began, skipped ticks included; the verdict counts from arming on",
        value=lambda tick: tick.deadline_misses,
        formerly="late_ticks",
        view=_MISSES,
    ),
    Column(
        name="safety_filter_acted",
        dtype=_U1,
        text="1: the safety filter has changed the input",
        value=lambda tick: tick.safety_filter_acted,
        formerly="barrier_acted",
        absent=0,  # what lacks it was flown without the filter
    ),
    Column(
        name="battery_01",
        dtype=_F4,
        unit="0..1",
        text="charge of the battery that remains, as the autopilot reports it; NaN while unknown",
        value=lambda tick: tick.battery_01,
        view=_BATTERY,
    ),
    Column(
        name="control",
        dtype=_U1,
        text=f"what the vehicle is doing, in the words of `status`, `ControlMode` {_TYPES}; 255: not recorded",
        names=ControlMode,
        value=lambda tick: tick.control,
        absent=NOT_RECORDED,
    ),
    Column(
        name="setpoint_accel_ned_m_s2",
        dtype=_F4,
        size=3,
        unit="m/s2",
        text="acceleration that the setpoint sent asks for, drag aside; NaN when none was",
        value=lambda tick: tick.setpoint_accel_ned_m_s2,
    ),
)
CURVES = {column.name: column.view for column in COLUMNS if isinstance(column.view, Curve)}
