"""The autopilots that can be simulated: one row for each value of `autopilot_kind`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from sitl.arducopter.assembly import arducopter
from sitl.px4.assembly import px4
from sitl.vehicle_parts import Commander, MavlinkInterface, SimulatedVehicle


@dataclass(frozen=True, slots=True, kw_only=True)
class AutopilotKind:
    """What differs between the autopilots.

    Attributes:
        build: makes one, and its MAVLink interfaces, of the link to its client first.
        scaled_timeouts: parameters [s] that are constant in wall time when it is simulated faster than real time.
        has_gcs_link: its simulator has a second link, to a ground station.
    """

    build: Callable[[SimulatedVehicle], tuple[Commander, list[MavlinkInterface]]]
    scaled_timeouts: tuple[str, ...] = ()
    has_gcs_link: bool = False


AUTOPILOT_KINDS: Mapping[str, AutopilotKind] = {
    "px4": AutopilotKind(
        build=px4, scaled_timeouts=("COM_OF_LOSS_T", "COM_DL_LOSS_T", "COM_RC_LOSS_T"), has_gcs_link=True
    ),
    "arducopter": AutopilotKind(build=arducopter),
}
