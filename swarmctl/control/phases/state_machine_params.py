"""Parameters of the mission state machine."""

from __future__ import annotations

from pydantic import Field

from swarmctl.core.params import Params


class StateMachineParams(Params):
    """Speeds of the transits to the start and to the landing place, tolerances and timeouts."""

    speed_m_s: float = Field(2.0, gt=0, le=20)  # peak speed of a transit
    accel_m_s2: float = Field(1.2, gt=0, le=20)  # peak acceleration of a transit, and of stops
    state_rate_hz: float = Field(100.0, ge=20, le=250)  # rate requested for position and attitude
    arrive_m: float = Field(0.15, gt=0, le=5)  # tolerance of the start position
    arrive_m_s: float = Field(0.15, gt=0, le=5)  # largest speed of a vehicle at rest
    land_m: float = Field(0.06, gt=0, le=5)  # tolerance of the landing place; reduces the gap to neighbouring places
    land_m_s: float = Field(0.06, gt=0, le=5)  # largest speed above the landing place
    start_timeout_s: float = Field(90.0, gt=0, le=3600)  # from process start to arming, and from there to TRACK
    land_timeout_s: float = Field(20.0, gt=0, le=600)  # allowed delay at the landing place; then land where it is
    apart_m: float = Field(0.2, ge=0, le=20)  # beyond separation.radius_m, around an agent that lands in place
