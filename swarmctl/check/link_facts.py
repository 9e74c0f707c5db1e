"""What a check has found out about one vehicle and its link, as plain values. No judgement, no I/O.

`None` means that the vehicle never told.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from swarmctl.core.types import FlightMode, Landed

Ned = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter as the autopilot holds it; `value` None when it has none of that name, or never answered."""

    name: str
    value: float | int | None
    kind: int = 0  # MAV_PARAM_TYPE
    refused: bool = False  # the autopilot itself said that there is none of that name


@dataclass(frozen=True, slots=True)
class RoundTrip:
    """Of requests that were answered."""

    p50_ms: float
    p99_ms: float
    answers: int
    by: str  # TIMESYNC or PING


@dataclass(frozen=True, slots=True)
class VehicleTime:
    """The vehicle's clock against the monotonic one of this host."""

    offset_s: float  # vehicle minus host
    drift_ppm: float  # vehicle seconds gained per million host seconds
    sigma_ppm: float  # standard error of the drift


@dataclass(frozen=True, slots=True)
class LinkFacts:
    """One link, for as long as it was listened to."""

    listened_s: float
    rates_hz: Mapping[str, float]  # message name -> rate of arrival
    frames_s: float
    bytes_s: float
    lost_01: float  # share of frames missing by their sequence numbers
    mavlink1: int  # frames
    mavlink2: int
    autopilots: tuple[int, ...]  # system ids
    senders: int  # addresses that frames came from
    round_trip: RoundTrip | None
    time: VehicleTime | None


@dataclass(frozen=True, slots=True)
class Version:
    """AUTOPILOT_VERSION."""

    firmware: tuple[int, int, int]
    stage: str  # dev, alpha, beta, rc, release
    git: str
    board: int
    uid: str  # uid2, hexadecimal; of PX4's simulator the number of its instance, so it tells nothing of what it is
    bytewise: bool | None  # which parameter encoding it announces
    vendor: int = 0  # of its USB port; 0 where there is none: simulators, and boards that run Linux

    @property
    def has_usb(self) -> bool:
        """Whether this is a board of its own, for sure; False says nothing."""
        return self.vendor != 0


@dataclass(frozen=True, slots=True)
class Estimator:
    """ESTIMATOR_STATUS."""

    flags: int
    pos_horiz_m: float | None  # 1 sigma
    pos_vert_m: float | None


@dataclass(frozen=True, slots=True)
class Gps:
    """GPS_RAW_INT."""

    fix_type: int  # 3: three-dimensional
    satellites: int | None
    pos_horiz_m: float | None  # its own accuracy


@dataclass(frozen=True, slots=True)
class Sensors:
    """SYS_STATUS: bits of MAV_SYS_STATUS_SENSOR, and the battery."""

    present: int
    enabled: int
    healthy: int
    battery_v: float | None
    battery_01: float | None


@dataclass(frozen=True, slots=True)
class VehicleFacts:
    """One vehicle of the configuration."""

    agent: int
    url: str
    wanted_sysid: int
    unreachable: str  # why, or "" when its heartbeat was heard
    link: LinkFacts
    sysid: int = 0
    autopilot: str = ""  # name of the dialect, "" for one we don't speak
    autopilot_number: int = 0  # MAV_AUTOPILOT
    version: Version | None = None
    mode: FlightMode = FlightMode.UNKNOWN
    custom_mode: int = 0
    armed: bool = False
    landed: Landed = Landed.UNKNOWN
    system_status: int = 0  # MAV_STATE
    sensors: Sensors | None = None
    estimator: Estimator | None = None
    gps: Gps | None = None
    pos_ned_m: Ned | None = None  # shared frame
    origin_ned_m: Ned | None = None  # of its local frame, in the shared one
    origin_told: bool = False  # by GPS_GLOBAL_ORIGIN; else worked out from its global position
    parameters: Mapping[str, Parameter] | None = None

    @property
    def pos_accuracy_m(self) -> float | None:
        """Horizontal accuracy, 1 sigma: the estimator's, else the receiver's."""
        if self.estimator is not None and self.estimator.pos_horiz_m is not None:
            return self.estimator.pos_horiz_m
        return None if self.gps is None else self.gps.pos_horiz_m

    @property
    def reached(self) -> bool:
        """Whether there is anything to judge beyond the link."""
        return not self.unreachable

    def number(self, name: str) -> float | None:
        """Value of a parameter, None when it is not known."""
        parameter = (self.parameters or {}).get(name)
        return None if parameter is None or parameter.value is None else float(parameter.value)
