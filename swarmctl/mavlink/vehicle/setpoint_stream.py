"""The setpoints that one vehicle is sent, and the pauses between them that its failsafe may have used."""

from __future__ import annotations

import struct
from collections.abc import Callable

from pymavlink.dialects.v20 import development as mavlink

from swarmctl.core.mavlink_values import AUTOPILOT_COMPID
from swarmctl.core.types import AttitudeSetpoint
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.vehicle.heard_setpoints import HeardSetpoints

_ATTITUDE_ONLY = 7  # type_mask that ignores body rates; with mask 0 rate and attitude setpoints would compete
_SETPOINT = struct.Struct("<I4f3ff3B")  # SET_ATTITUDE_TARGET, without the thrust of other axes


class SetpointStream:
    """Packs and sends setpoints; no other code in the project does.

    Args:
        codec: packs frames under the agent's identity.
        sysid: the vehicle's system id.
        send_frame: sends a frame to the vehicle.

    Attributes:
        refused: number of setpoints that were not sent, because they were not valid.
        sent_us: time of the newest one; None before the first.
        heard: which of them the vehicle flies.
        gaps: number of pauses so long that the autopilot's failsafe may have acted unseen; `gap_s`: the newest.
    """

    def __init__(self, codec: Codec, sysid: int, send_frame: Callable[[bytes], None]) -> None:
        self._codec, self._sysid, self._send_frame = codec, sysid, send_frame
        self.refused = 0
        self.sent_us: int | None = None
        self.heard = HeardSetpoints()
        self.gaps, self.gap_s = 0, 0.0
        self._departures = 0  # count of departures from the external mode at the newest setpoint

    def send(self, setpoint: AttitudeSetpoint, now_us: int, loss_s: float | None, departures: int) -> str:
        """Send one setpoint and return the reason of a refusal, or "".

        Args:
            setpoint: attitude and thrust.
            now_us: host clock.
            loss_s: time without setpoints after which the autopilot takes over; None until it has told.
            departures: how often the vehicle has been seen to leave the external mode.
        """
        refused = setpoint.problem(now_us)
        if refused:
            self.refused += 1
            return refused
        stamp_ms, q_nb = now_us // 1000 & 0xFFFFFFFF, setpoint.q_nb.tolist()
        whom_and_what = self._sysid, AUTOPILOT_COMPID, _ATTITUDE_ONLY
        payload = _SETPOINT.pack(stamp_ms, *q_nb, 0.0, 0.0, 0.0, setpoint.thrust_01, *whom_and_what)
        self._measure_gap(now_us, loss_s, departures)
        self.heard.sent(now_us, setpoint.thrust_01)
        self._send_frame(self._codec.frame(mavlink.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET, payload))
        return ""

    def _measure_gap(self, now_us: int, loss_s: float | None, departures: int) -> None:
        """Count a pause of the setpoints that was longer than the autopilot waits for them.

        PX4 returns to OFFBOARD by itself when setpoints resume, perhaps before CURRENT_MODE reports the departure.
        """
        last_us, stayed = self.sent_us, self._departures == departures
        self.sent_us, self._departures = now_us, departures
        if last_us is not None and stayed and loss_s is not None and now_us - last_us > loss_s * 1e6:
            self.gaps, self.gap_s = self.gaps + 1, (now_us - last_us) * 1e-6
