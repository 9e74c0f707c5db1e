"""Parameters of realism in simulated flights: wind, battery, rotors, ground effect, faults.

The configuration of a run (`[sitl.wind]`, `[[sitl.faults]]`, ...) and the simulator share them. Everything is off by
default. The module holds data only: the physics is in `sitl`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from swarmctl.core.params import Params

EVERY_VEHICLE = -1
_Speed = Annotated[float, Field(ge=-40, le=40)]
Wind3 = Annotated[tuple[_Speed, _Speed, _Speed], Field(strict=False)]


class WindParams(Params):
    """Sets the wind: a mean, turbulence, and one gust."""

    mean_ned_m_s: Wind3 = (0.0, 0.0, 0.0)  # velocity of the air
    turbulence_m_s: float = Field(0.0, ge=0, le=30)  # wind at 6 m, sets the Dryden intensity; light is 7.7
    gust_ned_m_s: Wind3 = (0.0, 0.0, 0.0)  # peak of a 1-cosine gust
    gust_at_s: float = Field(0.0, ge=0, le=86400)  # after the simulator's start
    gust_for_s: float = Field(2.0, ge=0.1, le=600)


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
    "motor": FaultRule(0, 1, 0, "0..1 of its force that a rotor keeps"),
    "link_loss": FaultRule(0, 1, 1, "0..1 of the datagrams that are lost"),
    "link_delay": FaultRule(0, 5000, None, "ms"),
    "link_duplicate": FaultRule(0, 1, 1, "0..1 of the datagrams that arrive twice"),
    "link_reorder": FaultRule(0, 1, 1, "0..1 of the datagrams that the next one overtakes"),
    "link_corrupt": FaultRule(0, 1, 1, "0..1 of the datagrams in which a bit is turned"),
    "gust": FaultRule(-40, 40, None, "m/s, peak of a 1-cosine gust along towards_deg"),
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
    "link_duplicate",
    "link_reorder",
    "link_corrupt",
    "gust",
    "battery",
    "mass",
    "reboot",
]


class FaultParams(Params):
    """Describes one injected fault, on one vehicle or on all."""

    kind: FaultKind
    at_s: float = Field(0.0, ge=0, le=86400)  # after the simulator's start
    vehicle: int = Field(EVERY_VEHICLE, ge=EVERY_VEHICLE, le=99)  # -1: all
    value: float | None = None  # size, in the unit of the kind; see FAULTS
    for_s: float = Field(0.0, ge=0, le=86400)  # 0: to the end
    rotor: int = Field(0, ge=0, le=3)  # motor
    direction: Literal["both", "to_vehicle", "from_vehicle"] = "both"  # link_*
    towards_deg: float = Field(0.0, ge=-360, le=360)  # gust, estimator_jump: clockwise from north

    @property
    def amount(self) -> float:
        """Return the value, or the default of the kind."""
        return self.value if self.value is not None else FAULTS[self.kind].default or 0.0

    def problems(self, vehicles: int) -> Iterator[str]:
        """Yield what the kind or the number of vehicles does not allow."""
        rule = FAULTS[self.kind]
        if self.vehicle >= vehicles:
            yield f"vehicle = {self.vehicle}: allowed: 0 to {vehicles - 1}, or {EVERY_VEHICLE} for all"
        if self.value is None and rule.default is None:
            yield f"value: missing; {self.kind} takes {rule.low:g} to {rule.high:g} ({rule.meaning})"
        elif self.value is not None and not rule.low <= self.value <= rule.high:
            allowed = f"{rule.low:g} to {rule.high:g}" if rule.high > rule.low else "none"
            yield f"value = {self.value}: allowed for {self.kind}: {allowed} ({rule.meaning})"
        if self.kind in NEEDS_END and not self.for_s:
            yield f"for_s = {self.for_s}: {self.kind} has to end; give its length in seconds, > 0"
        if self.kind in ENDS_AT_ONCE and self.for_s:
            yield f"for_s = {self.for_s}: {self.kind} happens at once; leave it out"


class RealismParams(Params):
    """Collects all parameters of realism, and those of the rotors."""

    wind: WindParams = WindParams()
    battery: BatteryParams = BatteryParams()
    faults: tuple[FaultParams, ...] = Field((), strict=False)
    thrust_curve_01: float = Field(0.0, ge=0, le=1)  # k in force = (1 - k) u + k u^2 of a rotor's command u; 0 linear
    motor_tau_s: float | None = Field(None, ge=0, le=0.5)  # lag of the rotors; None: that of the airframe
    drag_scale: float = Field(1.0, ge=0, le=10)  # factor on the airframe's drag; 0: none
    ground_effect: bool = False

    def fault_problems(self, vehicles: int) -> Iterator[str]:
        """Yield problems of the faults that involve several keys."""
        for number, fault in enumerate(self.faults):
            yield from (f"faults.{number}.{problem}" for problem in fault.problems(vehicles))
