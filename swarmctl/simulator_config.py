"""The configuration of the simulator, declared once: `[sitl]` of a run's configuration, and what its process is told.

It is declared in the bridge and not in `sitl`, because a launch validates it and hands it over, and the bridge never
imports the simulator. `SimulatorParams` holds the keys; `SimulatorConfig` adds what the rest of a run decides. A launch
gives the latter to `python -m sitl` as JSON, lockstep gives it to the simulated world as it is, and the options of
`python -m sitl` are made from its fields. So a new key is one line here, and its effect where `sitl` computes it: every
part of the simulator can read `SitlWorld.params`.

The module holds data only. What goes wrong outside (wind, battery, faults, ...) is off by default.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal, NamedTuple

from pydantic import Field, model_validator

from swarmctl.core.params import Params, Vec3
from swarmctl.errors import ConfigError

MAX_VEHICLES = 100

EVERY_VEHICLE = -1
_Speed = Annotated[float, Field(ge=-40, le=40)]
Wind3 = Annotated[tuple[_Speed, _Speed, _Speed], Field(strict=False)]


class WindParams(Params):
    """Sets the wind: a mean, turbulence, and one gust."""

    mean_ned_m_s: Wind3 = (0.0, 0.0, 0.0)  # velocity of the air
    turbulence_m_s: float = Field(0.0, ge=0, le=30)  # wind at 6 m, sets the Dryden intensity; light is 7.7
    gust_ned_m_s: Wind3 = (0.0, 0.0, 0.0)  # peak of a 1-cosine gust
    gust_at_s: float = Field(0.0, ge=0, le=86400)  # after the simulator's start
    gust_for_s: float = Field(2.0, ge=0.1, le=600)  # duration of the gust


class BatteryParams(Params):
    """Sets a pack of lithium-polymer cells, whose sagging voltage reduces thrust."""

    capacity_mah: float = Field(0.0, ge=0, le=100000)  # 0: no discharge and no sag
    resistance_ohm: float = Field(0.02, ge=0, le=2)  # of the whole pack; x500's 4 cells 0.02, crazyflie's one cell 0.2
    charge_01: float = Field(1.0, gt=0, le=1)  # at the start


class FaultRule(NamedTuple):
    """Describes the value that a kind of fault takes."""

    low: float
    high: float
    default: float | None  # None: the value is required
    meaning: str


FAULTS: dict[str, FaultRule] = {
    "gps_loss": FaultRule(0, 0, 0, "no value: position drifts and its accuracy fades"),
    "estimator_jump": FaultRule(-50, 50, None, "m, of the reported position, along towards_deg"),
    "estimator_freeze": FaultRule(0, 0, 0, "no value: the estimate stays as it is"),
    "motor": FaultRule(
        0, 1, 0, "0..1 of its force that a rotor keeps; at 0.8 an x500 holds its place, at 0.95 thesis does not"
    ),
    "link_loss": FaultRule(0, 1, 1, "0..1 of the datagrams that are lost"),
    "link_delay": FaultRule(0, 5000, None, "ms"),
    "link_jitter": FaultRule(0, 5000, None, "ms, the most by which each datagram is late by chance"),
    "link_duplicate": FaultRule(0, 1, 1, "0..1 of the datagrams that arrive twice"),
    "link_reorder": FaultRule(0, 1, 1, "0..1 of the datagrams that the next one overtakes"),
    "link_corrupt": FaultRule(0, 1, 1, "0..1 of the datagrams in which a bit is turned"),
    "gust": FaultRule(-40, 40, None, "m/s, peak of a 1-cosine gust along towards_deg"),
    "wind": FaultRule(-40, 40, None, "m/s, along towards_deg, from one instant to the next"),
    "battery": FaultRule(0, 1, None, "0..1 of the charge that is left"),
    "mass": FaultRule(0.3, 3, None, "mass over the mass at the start"),
    "reboot": FaultRule(0, 0, 0, "no value: the autopilot starts again"),
}
NEEDS_END = ("gust",)  # its shape is made from its length
ENDS_AT_ONCE = ("battery", "reboot")
FaultKind = Literal[
    "gps_loss",
    "estimator_jump",
    "estimator_freeze",
    "motor",
    "link_loss",
    "link_delay",
    "link_jitter",
    "link_duplicate",
    "link_reorder",
    "link_corrupt",
    "gust",
    "wind",
    "battery",
    "mass",
    "reboot",
]


class FaultParams(Params):
    """Describes one injected fault, on one vehicle or on all."""

    kind: FaultKind  # what fails, see Kinds of faults
    at_s: float = Field(0.0, ge=0, le=86400)  # after the simulator's start
    vehicle: int = Field(EVERY_VEHICLE, ge=EVERY_VEHICLE, le=99)  # -1: all
    value: float | None = None  # size, in the unit of the kind, see Kinds of faults
    for_s: float = Field(0.0, ge=0, le=86400)  # duration; 0: to the end
    rotor: int = Field(0, ge=0, le=3)  # the one that a fault of kind motor is of
    direction: Literal["both", "to_vehicle", "from_vehicle"] = "both"  # of links, for the kinds link_*
    towards_deg: float = Field(0.0, ge=-360, le=360)  # of gust, wind and estimator_jump, clockwise from north

    @property
    def amount(self) -> float:
        """Return the value, or the default of the kind."""
        return self.value if self.value is not None else FAULTS[self.kind].default or 0.0

    def problems(self, vehicles: int, first: int = 0) -> Iterator[str]:
        """Yield what the kind or the numbers of the vehicles, which begin at `first`, do not allow."""
        rule = FAULTS[self.kind]
        if self.vehicle != EVERY_VEHICLE and not first <= self.vehicle < first + vehicles:
            last = first + vehicles - 1
            yield f"vehicle = {self.vehicle}: allowed: {first} to {last}, or {EVERY_VEHICLE} for all"
        if self.value is None and rule.default is None:
            yield f"value: missing; {self.kind} takes {rule.low:g} to {rule.high:g} ({rule.meaning})"
        elif self.value is not None and not rule.low <= self.value <= rule.high:
            allowed = f"{rule.low:g} to {rule.high:g}" if rule.high > rule.low else "none"
            yield f"value = {self.value}: allowed for {self.kind}: {allowed} ({rule.meaning})"
        if self.kind in NEEDS_END and not self.for_s:
            yield f"for_s = {self.for_s}: {self.kind} has to end; give its length in seconds, > 0"
        if self.kind in ENDS_AT_ONCE and self.for_s:
            yield f"for_s = {self.for_s}: {self.kind} happens at once; leave it out"


class SimulatorParams(Params):
    """Collects the keys that reach the simulated vehicles, whoever starts the simulator."""

    wind: WindParams = WindParams()
    battery: BatteryParams = BatteryParams()
    faults: tuple[FaultParams, ...] = Field((), strict=False)
    thrust_curve_01: float = Field(0.0, ge=0, le=1)  # k in force = (1 - k) u + k u^2 of a rotor's command u; 0 linear
    motor_tau_s: float | None = Field(None, ge=0, le=0.5)  # lag of the rotors; left out: that of the airframe
    drag_scale: float = Field(1.0, ge=0, le=10)  # factor on the airframe's drag; 0: none
    ground_effect: bool = False  # more thrust close to the ground
    preset: Literal["thesis", "x500", "crazyflie", "arducopter"] = "thesis"  # airframe
    attitude_gains: Literal["swarm", "single", "pid_step", "pid_trajectory"] = "swarm"  # for the thesis airframe only
    start: Literal["ground", "air"] = "ground"  # air: vehicles begin at their start positions, without ground (thesis)
    ground_z_m: float = Field(2.0, ge=-1000, le=1000)  # height of the ground below the shared origin, NED z
    ekf_ready_s: float = Field(1.0, ge=0, le=60)  # from power-up until arming is possible; 4 in PX4
    mass_scale: float = Field(1.0, ge=0.3, le=1.9)  # true mass over the preset's, unknown to the bridge
    estimator: Literal["exact", "gps", "external", "px4_gps", "px4_external"] = "exact"  # errors of their estimates
    autopilot_kind: Literal["px4", "arducopter"] = "px4"  # autopilot whose MAVLink interface is simulated
    physics_hz: int = Field(250, ge=50, le=1000)  # integration steps per second
    gcs_port: int = Field(0, ge=0, le=65535)  # ground station, with a second link to every vehicle; 0: none
    reject_bad_setpoints: bool = True  # false: NaN and zero quaternions have the effects they have on PX4 1.18
    speed: float = Field(1.0, gt=0, le=100)  # simulated over wall time; agents require 1


class OriginParams(Params):
    """Describes the origin of the shared NED frame."""

    origin_lat_deg: float = Field(47.397742, ge=-89.9, le=89.9)  # shared origin of all positions in the configuration
    origin_lon_deg: float = Field(8.545594, ge=-180, le=180)  # longitude of the same point
    origin_alt_m: float = Field(489.4, ge=-500, le=9000)  # above mean sea level


_Coordinate = Annotated[float, Field(ge=-1e5, le=1e5)]
_Spawn = Annotated[tuple[_Coordinate, _Coordinate, _Coordinate], Field(strict=False)]


class SimulatorConfig(SimulatorParams, OriginParams):
    """Describes a whole simulation. An impossible one is refused with a `ConfigError` that lists the problems."""

    vehicles: int = Field(3, ge=1, le=MAX_VEHICLES)
    spawn_ned_m: tuple[_Spawn, ...] = Field((), strict=False)  # shared frame, one each; empty: along x, 1 m apart
    seed: int = Field(1, ge=0, le=2**31 - 1)
    sysid_base: int = Field(1, ge=1, le=255)  # MAVLink system id of the first vehicle
    first_vehicle: int = Field(0, ge=0, lt=MAX_VEHICLES)  # number of the first vehicle in true states and faults
    signing_keys: tuple[str, ...] = Field((), strict=False)  # key files, one each; none: vehicles sign once set up

    @model_validator(mode="after")
    def _is_possible(self) -> SimulatorConfig:
        if problems := list(self._problems()):
            raise ConfigError("sitl", problems)
        return self

    def _problems(self) -> Iterator[str]:
        """Yield what the keys do not allow together."""
        if self.sysid_base + self.vehicles > 256:
            yield f"sysid_base = {self.sysid_base}: allowed: 1 to {256 - self.vehicles} for {self.vehicles} vehicles"
        if len(self.spawn_ned_m) not in (0, self.vehicles):
            yield f"spawn_ned_m: {len(self.spawn_ned_m)} positions; allowed: one for each of {self.vehicles} vehicles"
        if len(self.signing_keys) not in (0, self.vehicles):
            yield f"signing_keys: {len(self.signing_keys)} files; allowed: one for each of {self.vehicles} vehicles"
        for number, fault in enumerate(self.faults):
            yield from (f"faults.{number}.{problem}" for problem in fault.problems(self.vehicles, self.first_vehicle))

    def spawns_ned_m(self) -> tuple[Vec3, ...]:
        """Return the position at which each vehicle begins, shared NED [m]."""
        middle = (self.vehicles - 1) / 2
        return self.spawn_ned_m or tuple((i - middle, 0.0, 0.0) for i in range(self.vehicles))
