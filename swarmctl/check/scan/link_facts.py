"""Facts that a check has gathered about one vehicle and its link, as plain values without judgement.

`None` means that the vehicle has not reported the value.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from swarmctl.core.types import FlightMode, Landed

Ned = tuple[float, float, float]
LatLon = tuple[float, float]  # latitude, longitude [deg]


@dataclass(frozen=True, slots=True, kw_only=True)
class Parameter:
    """One parameter as the autopilot stores it; `value` is None when it does not exist or was not answered."""

    name: str
    value: float | int | None
    refused: bool = False  # the autopilot has reported that it does not exist


@dataclass(frozen=True, slots=True, kw_only=True)
class RoundTrip:
    """Round-trip times of the answered requests."""

    p50_ms: float
    p99_ms: float
    answers: int
    by: str  # message used: TIMESYNC or PING


@dataclass(frozen=True, slots=True)
class VehicleTime:
    """The vehicle's clock against the monotonic clock of this host."""

    offset_s: float  # vehicle minus host
    drift_ppm: float  # vehicle seconds gained per million host seconds
    sigma_ppm: float  # standard error of the drift


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkFacts:
    """Statistics of one link over the time it was listened to."""

    listened_s: float
    rates_hz: Mapping[str, float]  # message name -> rate of arrival
    frames_s: float
    bytes_s: float
    lost_01: float  # share of frames lost on the way: missing by sequence number, and not dropped by this computer
    dropped: int = 0  # datagrams that this computer was too busy to take
    refused: Mapping[str, int] | None = None  # frames not taken, by reason; None: the link is not signed
    mavlink1: int  # frames
    mavlink2: int
    autopilots: tuple[int, ...]  # system ids
    senders: int  # number of addresses that frames came from
    round_trip: RoundTrip | None
    time: VehicleTime | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Version:
    """Firmware and board from AUTOPILOT_VERSION."""

    firmware: tuple[int, int, int]
    stage: str  # dev, alpha, beta, rc, release
    git: str
    board: int
    uid: str  # uid2, hexadecimal; PX4's simulator reports its instance number, so it does not identify a board
    bytewise: bool | None  # announced encoding of integer parameters
    vendor: int = 0  # USB vendor id; 0 for simulators and for boards that run Linux

    @property
    def has_usb(self) -> bool:
        """Whether this is certainly a board; False leaves it open."""
        return self.vendor != 0


@dataclass(frozen=True, slots=True)
class Estimator:
    """Flags and accuracies from ESTIMATOR_STATUS."""

    flags: int
    pos_horiz_m: float | None  # 1 sigma


@dataclass(frozen=True, slots=True)
class Gps:
    """Fix and accuracy from GPS_RAW_INT."""

    fix_type: int  # 3: three-dimensional
    satellites: int | None
    pos_horiz_m: float | None  # reported by the receiver


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensors:
    """Sensor bits (MAV_SYS_STATUS_SENSOR) and battery from SYS_STATUS."""

    present: int
    enabled: int
    healthy: int
    battery_v: float | None
    battery_01: float | None


@dataclass(frozen=True, slots=True)
class ArmingProblem:
    """One line of the autopilot's own arming checks in its current mode."""

    text: str
    blocks: bool  # arming is refused because of it


@dataclass(frozen=True, slots=True, kw_only=True)
class FenceFacts:
    """The geofence that a vehicle stores."""

    corners_deg: tuple[LatLon, ...] = ()  # of its first polygon to stay in; empty: none
    others: int = 0  # number of further areas
    problem: str = ""  # why it is not known, or could not be uploaded


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleLog:
    """One log that a vehicle stores."""

    number: int
    date: str  # as the vehicle tells it, UTC
    size_bytes: int


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleFacts:
    """Everything known about one vehicle of the configuration."""

    agent: int
    url: str
    wanted_sysid: int
    unreachable: str  # why, or "" once its heartbeat was received
    link: LinkFacts
    opened: bool = True  # the link could be, on this computer
    sysid: int = 0
    autopilot: str = ""  # name of the dialect; "" for an unsupported one
    autopilot_number: int = 0  # MAV_AUTOPILOT
    kind_problem: str = ""  # why it is no vehicle to fly, by its MAV_TYPE
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
    origin_ned_m: Ned | None = None  # origin of the local frame, in the shared frame
    origin_told: bool = False  # reported by GPS_GLOBAL_ORIGIN; else computed from the global position
    parameters: Mapping[str, Parameter] | None = None
    has_metadata: bool = False  # it serves component information, which the texts of its arming checks are in
    arming_problems: tuple[ArmingProblem, ...] | None = None
    fence: FenceFacts | None = None  # None: not asked for, because no fence is configured

    @property
    def pos_accuracy_m(self) -> float | None:
        """Horizontal accuracy [m], 1 sigma: the estimator's, else the receiver's."""
        if self.estimator is not None and self.estimator.pos_horiz_m is not None:
            return self.estimator.pos_horiz_m
        return None if self.gps is None else self.gps.pos_horiz_m

    @property
    def reached(self) -> bool:
        """Whether the vehicle was reached, so that more than the link can be judged."""
        return not self.unreachable

    def number(self, name: str) -> float | None:
        """Return the value of a parameter, or None while it is unknown."""
        parameter = (self.parameters or {}).get(name)
        return None if parameter is None or parameter.value is None else float(parameter.value)
