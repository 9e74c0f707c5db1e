"""Interface to one vehicle for the tick: decodes MAVLink into a `VehicleState`, encodes setpoints into frames.

The newest sample wins. `VehicleClock` gives its time, `LocalFrame` its position in the shared frame, and the dialect
that the HEARTBEAT names the meaning of messages. While any of these is in doubt, the flight mode included, there is no
state, and therefore no setpoint is sent.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import development as mavlink

from swarmctl.core.mavlink_values import ARMED_FLAG, AUTOPILOT_COMPID, PREARM_CHECK
from swarmctl.core.text import printable
from swarmctl.core.types import Array, AttitudeSetpoint, FlightMode, GeoOrigin, Landed, VehicleState
from swarmctl.mavlink.codec import Codec, message_of
from swarmctl.mavlink.commands import HEARD, CommandPort
from swarmctl.mavlink.dialects.dialect import LAST_INTEGER_TYPE, Dialect
from swarmctl.mavlink.dialects.discovery import DIALECTS
from swarmctl.mavlink.fields import BOOT_READERS, READERS
from swarmctl.mavlink.framing import frames, message_id
from swarmctl.mavlink.signing.refusals import FrameRefusals
from swarmctl.mavlink.transport import Transport
from swarmctl.mavlink.vehicle.local_frame import LocalFrame
from swarmctl.mavlink.vehicle.mode_watch import ModeWatch
from swarmctl.mavlink.vehicle.plausibility import kind_problem
from swarmctl.mavlink.vehicle.setpoint_stream import SetpointStream
from swarmctl.mavlink.vehicle.state_samples import StateSamples
from swarmctl.mavlink.vehicle.vehicle_clock import VehicleClock
from swarmctl.mavlink.vehicle.vehicle_health import VehicleHealth

_KNOWS_POSITION = 8 | 16  # ESTIMATOR_POS_HORIZ_REL, ESTIMATOR_POS_HORIZ_ABS
_DRIFT_M_S2 = 0.05  # 1-sigma error without GPS over time squared; measured: 0.6 m after 8 s to 2.7 m after 4 s
_LOST_REPORTS = 2  # one after the other, a second apart: flags drop out for a moment, too
_LOCAL_POSITION = mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED  # its time stamps are those of the state
_SYNC_EVERY_US = 200_000
_OWN_FLIGHT_US = 1_000_000  # after this long without setpoints the autopilot flies by itself, whatever its mode
_ATTENDED_US = 300_000  # without news of the vehicle nobody flies it
_HOVER_M_S = 0.2
_MOST_LAT_E7 = 900_000_000
_MOST_PARAMETERS = 5000  # an autopilot has some 1500
_MOST_TEXTS = 20  # that wait to be read


class AutopilotText(NamedTuple):
    """A message of the autopilot to its operator."""

    severity: int  # MAV_SEVERITY, from 0 (emergency) to 7 (debug)
    text: str


class Autopilot:
    """Connects the agent to one vehicle.

    Args:
        transport: byte link to the vehicle.
        codec: packs frames under the agent's identity.
        sysid: the vehicle's system id; everything else is ignored.
        shared: origin of the shared frame.
        on_frame: called with every frame received or sent, for recording.
        refusals: counts what a signed link has refused.

    Attributes:
        clock: the vehicle's clock; `clock.boots` counts its reboots.
        frame: the vehicle's local frame.
        params: parameters that the vehicle has reported.
        whole_params: names of the parameters that it stores as integers.
        kind_problem: why it is no vehicle to fly, by its newest HEARTBEAT, or "".
        armed_told_us: arrival time of the HEARTBEAT that reported `armed`, host clock; -1 before the first.
        hover_thrust_01: thrust with which the autopilot hovers by itself; until observed, the value of its parameter.
        pos_accuracy_m: reported horizontal accuracy, 1 sigma; None while unreported.
        states: the newest; `states.count`: how many were received; two readings give the rate.
        received_us: arrival time of the last frame, host clock.
        arrived_us: arrival time of each frame that the last poll has taken, in order, host clock.
        invalid: number of polls without a state although a sample existed, by reason.
        watch: the vehicle's flight mode and failsafe, and whether they are in doubt.
        setpoints: what it has been sent.
        health: battery and GPS.
    """

    params: dict[str, float]
    whole_params: set[str]
    hover_thrust_01: float | None
    pos_accuracy_m: float | None

    def __init__(
        self,
        transport: Transport,
        codec: Codec,
        sysid: int,
        shared: GeoOrigin,
        *,
        on_frame: Callable[[bytes], None],
        refusals: FrameRefusals | None = None,
    ) -> None:
        self._transport, self._codec, self._sysid = transport, codec, sysid
        self.refusals = refusals or FrameRefusals()
        self._on_frame = on_frame
        self.clock = VehicleClock()
        self.frame = LocalFrame(shared)
        self.watch = ModeWatch()
        self._slow: CommandPort | None = None
        self.dialect: Dialect | None = None
        self.armed, self.armed_told_us, self.kind_problem = False, -1, ""
        self._texts: deque[AutopilotText] = deque(maxlen=_MOST_TEXTS)
        self.received_us: int | None = None
        self.arrived_us: list[int] = []
        self.invalid: Counter[str] = Counter()
        self._sync_us = 0
        self._syncs: deque[int] = deque(maxlen=16)  # host times of unanswered TIMESYNC requests [ns]
        self.setpoints = SetpointStream(codec, sysid, self.send_frame)
        self.states = StateSamples(self.clock, self.frame, codec.refused, self._forget)
        self._forget()
        self._handlers: dict[int, Callable[[Any, int], None]] = {
            mavlink.MAVLINK_MSG_ID_HEARTBEAT: self._heartbeat,
            mavlink.MAVLINK_MSG_ID_CURRENT_MODE: self._current_mode,
            mavlink.MAVLINK_MSG_ID_ODOMETRY: self.states.odometry,
            mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: self.states.attitude_quaternion,
            _LOCAL_POSITION: self.states.local_position,
            mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: self._global_position,
            mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: self._origin,
            mavlink.MAVLINK_MSG_ID_SYS_STATUS: self._sys_status,
            mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: self._extended,
            mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: self._estimator,
            mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: self._gps,
            mavlink.MAVLINK_MSG_ID_ATTITUDE_TARGET: self._attitude_target,
            mavlink.MAVLINK_MSG_ID_PARAM_VALUE: self._param_value,
            mavlink.MAVLINK_MSG_ID_TIMESYNC: self._timesync,
            mavlink.MAVLINK_MSG_ID_STATUSTEXT: self._statustext,
        }

    @property
    def mode(self) -> FlightMode:
        """The newest reported flight mode."""
        return self.watch.mode

    @property
    def failsafe(self) -> bool:
        """Whether the vehicle has reported that its failsafe acts."""
        return self.watch.failsafe

    @property
    def offset_ned_m(self) -> Array | None:
        """Origin (3,) of the local frame in the shared frame."""
        return self.frame.offset_ned_m

    def connect(self, slow: CommandPort) -> None:
        """Pass to the command port `slow` what it hears."""
        self._slow = slow

    def send_frame(self, frame: bytes) -> None:
        """Send a frame of the command port over the same link."""
        self._on_frame(frame)
        self._transport.send(frame)

    def poll(self, now_us: int) -> VehicleState | None:
        """Drain the link and return the newest state; None before the first complete one and while it is in doubt."""
        self.watch.poll(now_us)
        self.arrived_us = []
        for datagram in self._transport.receive(now_us):
            for frame in frames(datagram.data):
                self._frame(frame, datagram.t_us)
        self._ask_the_time(now_us)
        if self.states.newest is None or self.mode is FlightMode.UNKNOWN:
            return None
        if self.watch.in_doubt:
            self.invalid["mode not told since a silence"] += 1
            if self.watch.asks(now_us):
                self._ask_for(mavlink.MAVLINK_MSG_ID_HEARTBEAT)
            return None
        return self._state(now_us)

    def is_attended(self, now_us: int) -> bool:
        """Return whether somebody can fly the vehicle, so that its autopilot need not act as without a link.

        The agent can't while it knows no recent state, and a pilot may, as long as another mode is told. On a link that
        has failed in one direction alone, heartbeats would keep an ArduCopter flying straight on. Before the first
        state they say where messages are to be sent.
        """
        sample, told_us = self.states.newest, self.received_us
        if sample is None or now_us - sample.t_us <= _ATTENDED_US:
            return True
        is_heard = told_us is not None and now_us - told_us <= _ATTENDED_US
        return is_heard and self.mode is not FlightMode.EXTERNAL

    def send(self, setpoint: AttitudeSetpoint, now_us: int) -> str:
        """Send one setpoint and return the reason of a refusal, or ""."""
        return self.setpoints.send(setpoint, now_us, self.setpoint_loss_s, self.watch.departures)

    @property
    def setpoint_loss_s(self) -> float | None:
        """Return the time without setpoints after which the autopilot takes over; None until it has told."""
        return None if self.dialect is None else self.params.get(self.dialect.loss_parameter)

    @property
    def landing_delay_s(self) -> float | None:
        """Return the time after which the autopilot brakes and lands when it hears nothing; None until it has told."""
        return None if self.dialect is None else self.params.get(self.dialect.landing_parameter)

    def unheard_since_us(self, now_us: int) -> int | None:
        """Return when the last setpoint was sent that the vehicle is known to fly, if it misses those after it."""
        sample = self.states.newest
        if sample is None or self.mode is not FlightMode.EXTERNAL:
            return None
        return self.setpoints.heard.unheard_since_us(now_us, sample.t_us)

    def close(self) -> None:
        self._transport.close()

    # -- frames -------------------------------------------------------------------------------------------------------

    def _frame(self, frame: bytes, arrived_us: int) -> None:
        """Take a frame: each is checked and recorded, but only what is used of it is read."""
        if frame[5] != self._sysid or frame[6] != 1:
            return
        payload = self._codec.payload(frame)
        if payload is None:
            return
        self._on_frame(frame)
        self.watch.on_frame(arrived_us)
        self.received_us = arrived_us
        self.arrived_us.append(arrived_us)
        number = message_id(frame)
        if number in BOOT_READERS and number != _LOCAL_POSITION:
            boot_us = self.clock.boot_us(BOOT_READERS[number](payload).time_boot_ms, arrived_us)
            self.clock.witness(number, boot_us, arrived_us)
        handler = self._handlers.get(number)
        if handler is not None:
            handler(READERS[number](payload), arrived_us)
        if number in HEARD and self._slow is not None:
            self._slow.frame(message_of(number, payload))

    def _heartbeat(self, message: Any, arrived_us: int) -> None:
        dialect = DIALECTS.get(message.autopilot)
        if dialect is None:
            return
        self.dialect, mode, self.kind_problem = dialect, dialect.mode(message.custom_mode), kind_problem(message.type)
        self.armed, self.armed_told_us = bool(message.base_mode & ARMED_FLAG), arrived_us
        self.watch.told(mode, arrived_us, by_heartbeat=True)
        self.watch.status(message.system_status)

    def _current_mode(self, message: Any, arrived_us: int) -> None:
        """Take the mode as from a HEARTBEAT; sent on change, so that a pilot's switch is seen within a tick."""
        if self.dialect is not None:
            self.watch.told(self.dialect.mode(message.custom_mode), arrived_us, by_heartbeat=False)

    def _ask_for(self, message_id: int) -> None:
        asked = (float(message_id), *(0.0,) * 6)
        whom_and_what = self._sysid, AUTOPILOT_COMPID, mavlink.MAV_CMD_REQUEST_MESSAGE
        request = mavlink.MAVLink_command_long_message(*whom_and_what, 0, *asked)
        self.send_frame(self._codec.encode(request))

    def _sys_status(self, message: Any, arrived_us: int) -> None:
        self.armable = bool(message.onboard_control_sensors_health & PREARM_CHECK)
        self.health.sys_status(message)

    def _extended(self, message: Any, arrived_us: int) -> None:
        self.landed = Landed(message.landed_state) if message.landed_state <= Landed.LANDING else Landed.UNKNOWN
        if self.landed is Landed.ON_GROUND:
            self._has_climbed = self._ends_climb = False

    def _statustext(self, message: Any, arrived_us: int) -> None:
        text = message.text.rstrip("\t\x00") if isinstance(message.text, str) else str(message.text)
        self._texts.append(AutopilotText(int(message.severity), printable(text)))

    def next_text(self) -> AutopilotText | None:
        """Return the oldest message of the autopilot that was not returned yet; of many, the newest are kept."""
        return self._texts.popleft() if self._texts else None

    def _state(self, now_us: int) -> VehicleState | None:
        placed = self.states.placed(self.armed)
        if placed is None:
            return None
        mode, failsafe = self.watch.show(now_us)
        return VehicleState(
            t_us=placed.sample.t_us,
            pos_ned_m=placed.pos_ned_m,
            vel_ned_m_s=placed.vel_ned_m_s,
            q_nb=placed.q_nb,
            rate_frd_rad_s=placed.rate_frd_rad_s,
            armed=self.armed,
            mode=mode,
            landed=self.landed,
            failsafe=failsafe,
        )

    def _forget(self) -> None:
        """Discard everything the vehicle has reported: it has rebooted, or was never received."""
        self.states.forget()
        self.landed, self.armable, self.health = Landed.UNKNOWN, False, VehicleHealth()
        self.params, self.whole_params = {}, set()
        self.hover_thrust_01 = self.pos_accuracy_m = None
        self._has_climbed = self._ends_climb = False  # in its present take-off
        self._gps_sigma_m = 0.0
        self._unaided = 0  # reports in a row of an estimator that knows no position
        self.frame.forget()

    @property
    def own_hover_01(self) -> float | None:
        """Return `hover_thrust_01`, None during a take-off that has not shown it yet."""
        return self.hover_thrust_01 if self.mode is not FlightMode.TAKEOFF or self._ends_climb else None

    # -- frame, clock, accuracy, parameters ---------------------------------------------------------------------------

    def _origin(self, message: Any, arrived_us: int) -> None:
        if _is_place(message.latitude, message.longitude):
            self.frame.told(_geodetic(message.latitude, message.longitude, message.altitude))

    def _global_position(self, message: Any, arrived_us: int) -> None:
        sample = self.states.newest
        if sample is not None and _is_place(message.lat, message.lon):
            place = _geodetic(message.lat, message.lon, message.alt)
            local_us, _, pos, vel = sample[:4]
            boot_us = self.clock.boot_us(message.time_boot_ms, arrived_us)
            self.frame.seen(place, boot_us, local_us, np.array(pos), vel_ned_m_s=np.array(vel))

    def _ask_the_time(self, now_us: int) -> None:
        if self.dialect is not None and now_us - self._sync_us >= _SYNC_EVERY_US:
            self._sync_us = now_us
            self._syncs.append(now_us * 1000)
            self.send_frame(self._codec.encode(mavlink.MAVLink_timesync_message(0, now_us * 1000)))

    def _timesync(self, message: Any, arrived_us: int) -> None:
        if message.tc1 > 0 and message.ts1 in self._syncs:
            self._syncs.remove(message.ts1)
            self.setpoints.heard.round_trip_us = arrived_us - message.ts1 // 1000
            self.clock.round_trip(message.ts1 // 1000, message.tc1 // 1000, arrived_us)

    def _estimator(self, message: Any, arrived_us: int) -> None:
        self._accuracy("ESTIMATOR_STATUS", message.pos_horiz_accuracy)
        self._unaided = 0 if message.flags & _KNOWS_POSITION or not self.armed else self._unaided + 1
        self.states.is_lost = self._unaided >= _LOST_REPORTS

    def _gps(self, message: Any, arrived_us: int) -> None:
        self.health.gps(message, arrived_us)
        drift_m = _DRIFT_M_S2 * self.health.fix_missing_s**2  # without a fix its own figure stays what it was
        self._gps_sigma_m = message.h_acc * 1e-3 or self._gps_sigma_m  # 0 is unknown, as without a fix
        self._accuracy("GPS_RAW_INT", self._gps_sigma_m + drift_m)

    def _accuracy(self, source: str, sigma_m: float) -> None:
        """Take an accuracy [m] from the message that the dialect names; not 0, which both messages use for unknown."""
        if self.dialect is not None and self.dialect.horizontal_accuracy == source and 0.0 < sigma_m < np.inf:
            self.pos_accuracy_m = sigma_m

    def _param_value(self, message: Any, arrived_us: int) -> None:
        if self.dialect is None:
            return
        value = self.dialect.from_wire(message.param_value, message.param_type)
        if not np.isfinite(value):
            return
        if len(self.params) >= _MOST_PARAMETERS and message.param_id not in self.params:
            self._codec.refused["too many parameters"] += 1
            return
        self.params[message.param_id] = value
        if message.param_type <= LAST_INTEGER_TYPE:
            self.whole_params.add(message.param_id)
        if message.param_id == self.dialect.hover_parameter and self.hover_thrust_01 is None and 0.05 < value < 0.95:
            self.hover_thrust_01 = value

    def _attitude_target(self, message: Any, arrived_us: int) -> None:
        """Note which setpoint is flown; learn the hover thrust where the autopilot hovers by itself."""
        self.setpoints.heard.repeated(message.thrust, arrived_us)
        if 0.05 < message.thrust < 1.0 and self._hovers_by_itself(arrived_us):
            self.hover_thrust_01 = message.thrust

    def _hovers_by_itself(self, now_us: int) -> bool:
        """Return whether it hovers, in HOLD, where take-off shares our mode, or at the end of a climb."""
        sample, setpoint_us = self.states.newest, self.setpoints.sent_us
        if self.mode is FlightMode.HOLD or sample is None:
            return self.mode is FlightMode.HOLD and self.landed is Landed.IN_AIR
        down_m_s = float(sample.vel_ned_m_s[2])
        if self.mode is FlightMode.TAKEOFF and self.landed is not Landed.ON_GROUND:
            self._has_climbed |= down_m_s < -_HOVER_M_S  # before, its rotors spin up
            self._ends_climb = self._has_climbed and abs(down_m_s) < _HOVER_M_S
            return self._ends_climb
        own = setpoint_us is None or now_us - setpoint_us > _OWN_FLIGHT_US
        in_ours = self.mode is FlightMode.EXTERNAL and self.landed is Landed.IN_AIR
        return in_ours and own and abs(down_m_s) < _HOVER_M_S


def _is_place(lat_e7: int, lon_e7: int) -> bool:
    """Return whether a place is on earth, and not the zeros that an ArduPilot sends while it knows none."""
    return (lat_e7 != 0 or lon_e7 != 0) and abs(lat_e7) <= _MOST_LAT_E7 and abs(lon_e7) <= 2 * _MOST_LAT_E7


def _geodetic(lat_e7: int, lon_e7: int, alt_mm: int) -> GeoOrigin:
    return GeoOrigin(lat_e7 * 1e-7, lon_e7 * 1e-7, alt_mm * 1e-3)
