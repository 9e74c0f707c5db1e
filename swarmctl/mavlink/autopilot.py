"""Interface to one vehicle for the tick: decodes MAVLink into a `VehicleState`, encodes setpoints into frames.

The newest sample wins. `VehicleClock` gives its time, `LocalFrame` its position in the shared frame, and the dialect
that the HEARTBEAT names the meaning of messages. While any of these is in doubt, the flight mode included, there is no
state, and therefore no setpoint is sent.
"""

from __future__ import annotations

import math
import struct
from collections import Counter, deque
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from pymavlink.dialects.v20 import development as mavlink

from swarmctl.core.frames import numbers_rotated_to_ned
from swarmctl.core.text import printable
from swarmctl.core.types import Array, AttitudeSetpoint, FlightMode, GeoOrigin, Landed, VehicleState
from swarmctl.mavlink.codec import Codec, message_of
from swarmctl.mavlink.commands import HEARD, CommandPort
from swarmctl.mavlink.dialects.dialect import LAST_INTEGER_TYPE, Dialect
from swarmctl.mavlink.dialects.discovery import DIALECTS
from swarmctl.mavlink.fields import BOOT_READERS, READERS
from swarmctl.mavlink.framing import frames, message_id
from swarmctl.mavlink.local_frame import LocalFrame
from swarmctl.mavlink.mode_watch import ModeWatch
from swarmctl.mavlink.plausibility import state_problem
from swarmctl.mavlink.sample import Placed, Quaternion, Sample, Vector
from swarmctl.mavlink.signing.refusals import FrameRefusals
from swarmctl.mavlink.transport import Transport
from swarmctl.mavlink.vehicle_clock import VehicleClock
from swarmctl.mavlink.vehicle_health import VehicleHealth

_ATTITUDE_ONLY = 7  # type_mask that ignores body rates; with mask 0 rate and attitude setpoints would compete
_ARMED_FLAG = 128
_CRITICAL = 5
_PREARM = 1 << 28
_LOCAL_NED = mavlink.MAV_FRAME_LOCAL_NED
_BODY_FRD = (mavlink.MAV_FRAME_BODY_NED, mavlink.MAV_FRAME_BODY_FRD)  # frames of the velocity in ODOMETRY
_LOCAL_POSITION = mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED  # its time stamps are those of the state
_SETPOINT = struct.Struct("<I4f3ff3B")  # SET_ATTITUDE_TARGET, without the thrust of other axes
_SYNC_EVERY_US = 200_000
_OWN_FLIGHT_US = 1_000_000  # after this long without setpoints the autopilot flies by itself, whatever its mode
_HOVER_M_S = 0.2
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
        armed_told_us: arrival time of the HEARTBEAT that reported `armed`, host clock; -1 before the first.
        hover_thrust_01: thrust with which the autopilot hovers by itself; until observed, the value of its parameter.
        pos_accuracy_m: reported horizontal accuracy, 1 sigma; None while unreported.
        samples: number of states received; two readings give the rate.
        received_us: arrival time of the last frame, host clock.
        invalid: number of polls without a state although a sample existed, by reason.
        watch: the vehicle's flight mode and failsafe, and whether they are in doubt.
        gaps: number of setpoint gaps so long that the autopilot's failsafe may have acted unseen; `gap_s`: the newest.
        health: battery and GPS.
    """

    params: dict[str, float]
    whole_params: set[str]
    hover_thrust_01: float | None
    pos_accuracy_m: float | None
    _sample: Sample | None
    _placed: Placed | None
    _attitude: tuple[Quaternion, Vector] | None  # with its rates
    _reset_counter: int | None
    _was_reset: bool  # the estimator has reported a reset since the newest placed sample

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
        self.armed, self.armed_told_us = False, -1
        self._texts: deque[AutopilotText] = deque(maxlen=_MOST_TEXTS)
        self.refused_setpoints = self.samples = 0
        self.received_us: int | None = None
        self.invalid: Counter[str] = Counter()
        self.gaps, self.gap_s = 0, 0.0
        self._departures = 0  # count of departures from the external mode at the newest setpoint
        self._setpoint_us: int | None = None
        self._sync_us = 0
        self._syncs: deque[int] = deque(maxlen=16)  # host times of unanswered TIMESYNC requests [ns]
        self._boots = self._restarts = 0  # counters of the clock that have been handled
        self._forget()
        self._handlers: dict[int, Callable[[Any, int], None]] = {
            mavlink.MAVLINK_MSG_ID_HEARTBEAT: self._heartbeat,
            mavlink.MAVLINK_MSG_ID_CURRENT_MODE: self._current_mode,
            mavlink.MAVLINK_MSG_ID_ODOMETRY: self._odometry,
            mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: self._attitude_quaternion,
            _LOCAL_POSITION: self._local_position,
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
        for datagram in self._transport.receive(now_us):
            for frame in frames(datagram.data):
                self._frame(frame, datagram.t_us)
        self._ask_the_time(now_us)
        if self._sample is None or self.mode is FlightMode.UNKNOWN:
            return None
        if self.watch.in_doubt:
            self.invalid["mode not told since a silence"] += 1
            if self.watch.asks(now_us):
                self._ask_for(mavlink.MAVLINK_MSG_ID_HEARTBEAT)
            return None
        return self._state(self._sample, now_us)

    def send(self, setpoint: AttitudeSetpoint, now_us: int) -> str:
        """Send one setpoint and return the reason of a refusal, or "".

        No other code in the project sends setpoints.
        """
        refused = setpoint.problem(now_us)
        if refused:
            self.refused_setpoints += 1
            return refused
        stamp_ms, q_nb = now_us // 1000 & 0xFFFFFFFF, setpoint.q_nb.tolist()
        whom_and_what = self._sysid, 1, _ATTITUDE_ONLY
        payload = _SETPOINT.pack(stamp_ms, *q_nb, 0.0, 0.0, 0.0, setpoint.thrust_01, *whom_and_what)
        self._measure_gap(now_us)
        self.send_frame(self._codec.frame(mavlink.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET, payload))
        return ""

    @property
    def setpoint_loss_s(self) -> float | None:
        """Return the time without setpoints after which the autopilot takes over; None until it has told."""
        return None if self.dialect is None else self.params.get(self.dialect.loss_parameter)

    def close(self) -> None:
        self._transport.close()

    def _measure_gap(self, now_us: int) -> None:
        """Count a pause of the setpoints that was longer than the autopilot waits for them.

        PX4 returns to OFFBOARD by itself when setpoints resume, perhaps before CURRENT_MODE reports the departure.
        """
        last_us, stayed = self._setpoint_us, self._departures == self.watch.departures
        self._setpoint_us, self._departures = now_us, self.watch.departures
        loss_s = self.setpoint_loss_s
        if last_us is not None and stayed and loss_s is not None and now_us - last_us > loss_s * 1e6:
            self.gaps, self.gap_s = self.gaps + 1, (now_us - last_us) * 1e-6

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
        number = message_id(frame)
        if number in BOOT_READERS and number != _LOCAL_POSITION:
            self.clock.witness(number, BOOT_READERS[number](payload).time_boot_ms * 1000, arrived_us)
        handler = self._handlers.get(number)
        if handler is not None:
            handler(READERS[number](payload), arrived_us)
        if number in HEARD and self._slow is not None:
            self._slow.frame(message_of(number, payload))

    def _heartbeat(self, message: Any, arrived_us: int) -> None:
        dialect = DIALECTS.get(message.autopilot)
        if dialect is None:
            return
        self.dialect = dialect
        self.armed, self.armed_told_us = bool(message.base_mode & _ARMED_FLAG), arrived_us
        self.watch.alarm(message.system_status >= _CRITICAL)
        self.watch.told(dialect.mode(message.custom_mode), arrived_us)

    def _current_mode(self, message: Any, arrived_us: int) -> None:
        """Take the mode as from a HEARTBEAT; sent on change, so that a pilot's switch is seen within a tick."""
        if self.dialect is not None:
            self.watch.told(self.dialect.mode(message.custom_mode), arrived_us)

    def _ask_for(self, message_id: int) -> None:
        asked = (float(message_id), *(0.0,) * 6)
        request = mavlink.MAVLink_command_long_message(self._sysid, 1, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, *asked)
        self.send_frame(self._codec.encode(request))

    def _sys_status(self, message: Any, arrived_us: int) -> None:
        self.armable = bool(message.onboard_control_sensors_health & _PREARM)
        self.health.sys_status(message)

    def _extended(self, message: Any, arrived_us: int) -> None:
        self.landed = Landed(message.landed_state) if message.landed_state <= Landed.LANDING else Landed.UNKNOWN

    def _statustext(self, message: Any, arrived_us: int) -> None:
        text = message.text.rstrip("\t\x00") if isinstance(message.text, str) else str(message.text)
        self._texts.append(AutopilotText(int(message.severity), printable(text)))

    def next_text(self) -> AutopilotText | None:
        """Return the oldest message of the autopilot that was not returned yet; of many, the newest are kept."""
        return self._texts.popleft() if self._texts else None

    # -- state --------------------------------------------------------------------------------------------------------

    def _odometry(self, message: Any, arrived_us: int) -> None:
        if message.frame_id != _LOCAL_NED or message.child_frame_id not in (_LOCAL_NED, *_BODY_FRD):
            self._codec.refused["odometry frame"] += 1
            return
        self._odometry_us = arrived_us
        q_nb = message.q_0, message.q_1, message.q_2, message.q_3
        vel: Vector = message.vx, message.vy, message.vz
        if message.child_frame_id in _BODY_FRD:
            vel = numbers_rotated_to_ned(q_nb, vel)
        rate = message.rollspeed, message.pitchspeed, message.yawspeed
        pos = message.x, message.y, message.z
        if self._take(message.time_usec, arrived_us, pos, vel, q_nb=q_nb, rate=rate):
            self._was_reset |= self._reset_counter not in (None, message.reset_counter)
            self._reset_counter = message.reset_counter

    def _attitude_quaternion(self, message: Any, arrived_us: int) -> None:
        q_nb = message.q1, message.q2, message.q3, message.q4
        self._attitude = q_nb, (message.rollspeed, message.pitchspeed, message.yawspeed)

    def _local_position(self, message: Any, arrived_us: int) -> None:
        """Combine a local position with the newest attitude, for autopilots without ODOMETRY."""
        if self._attitude is None or (arrived_us - self._odometry_us < 500_000 and self._odometry_us):
            return
        pos, vel = (message.x, message.y, message.z), (message.vx, message.vy, message.vz)
        q_nb, rate = self._attitude
        self._take(message.time_boot_ms * 1000, arrived_us, pos, vel, q_nb=q_nb, rate=rate)

    def _take(
        self, vehicle_us: int, arrived_us: int, pos: Vector, vel: Vector, *, q_nb: Quaternion, rate: Vector
    ) -> bool:
        """Keep a sample if it is valid and the newest; return whether it was kept."""
        w, x, y, z = q_nb
        norm = math.sqrt((w * w + y * y) + (x * x + z * z))  # in the order of a dot product, by which it rounds
        if problem := state_problem(pos, vel, rate, norm):
            self._codec.refused[problem] += 1
            return False
        t_us = self.clock.to_local(vehicle_us, arrived_us)
        if t_us is None:
            self._codec.refused["stamp not believed"] += 1
            return False
        if self.clock.restarts != self._restarts:
            self._restarts, self._sample = self.clock.restarts, None
        if self.clock.boots != self._boots:
            self._boots = self.clock.boots
            self._forget()
            self._odometry_us = arrived_us
        self.samples += 1
        if self._sample is not None and vehicle_us < self._sample.vehicle_us:
            return False
        self._sample = Sample(vehicle_us, t_us, pos, vel, (w / norm, x / norm, y / norm, z / norm), rate)
        return True

    def _state(self, sample: Sample, now_us: int) -> VehicleState | None:
        if self._placed is None or self._placed.sample is not sample:
            self._placed = self._place(sample)
        if self._placed is None:
            return None
        mode, failsafe = self.watch.show(now_us)
        return VehicleState(
            t_us=sample.t_us,
            pos_ned_m=self._placed.pos_ned_m,
            vel_ned_m_s=self._placed.vel_ned_m_s,
            q_nb=self._placed.q_nb,
            rate_frd_rad_s=self._placed.rate_frd_rad_s,
            armed=self.armed,
            mode=mode,
            landed=self.landed,
            failsafe=failsafe,
        )

    def _place(self, sample: Sample) -> Placed | None:
        """Return the sample in the shared frame; None while its place can't be known."""
        vel, was_reset = np.array(sample.vel_ned_m_s), self._was_reset
        self._was_reset = False
        pos = self.frame.place(sample.vehicle_us, np.array(sample.pos_ned_m), vel, self.armed, reset=was_reset)
        if pos is None:
            return None
        return Placed(sample, pos, vel, np.array(sample.q_nb), np.array(sample.rate_frd_rad_s))

    def _forget(self) -> None:
        """Discard everything the vehicle has reported: it has rebooted, or was never received."""
        self._sample = self._placed = self._attitude = self._reset_counter = None
        self._was_reset = False
        self._odometry_us = 0
        self.landed, self.armable, self.health = Landed.UNKNOWN, False, VehicleHealth()
        self.params, self.whole_params = {}, set()
        self.hover_thrust_01 = self.pos_accuracy_m = None
        self.frame.forget()

    # -- frame, clock, accuracy, parameters ---------------------------------------------------------------------------

    def _origin(self, message: Any, arrived_us: int) -> None:
        self.frame.told(_geodetic(message.latitude, message.longitude, message.altitude))

    def _global_position(self, message: Any, arrived_us: int) -> None:
        if self._sample is not None:
            place = _geodetic(message.lat, message.lon, message.alt)
            local_us, _, pos, vel = self._sample[:4]
            self.frame.seen(place, message.time_boot_ms * 1000, local_us, np.array(pos), vel_ned_m_s=np.array(vel))

    def _ask_the_time(self, now_us: int) -> None:
        if self.dialect is not None and now_us - self._sync_us >= _SYNC_EVERY_US:
            self._sync_us = now_us
            self._syncs.append(now_us * 1000)
            self.send_frame(self._codec.encode(mavlink.MAVLink_timesync_message(0, now_us * 1000)))

    def _timesync(self, message: Any, arrived_us: int) -> None:
        if message.tc1 > 0 and message.ts1 in self._syncs:
            self._syncs.remove(message.ts1)
            self.clock.round_trip(message.ts1 // 1000, message.tc1 // 1000, arrived_us)

    def _estimator(self, message: Any, arrived_us: int) -> None:
        self._accuracy("ESTIMATOR_STATUS", message.pos_horiz_accuracy)

    def _gps(self, message: Any, arrived_us: int) -> None:
        self._accuracy("GPS_RAW_INT", message.h_acc * 1e-3)
        self.health.gps(message)

    def _accuracy(self, source: str, sigma_m: float) -> None:
        """Return an accuracy [m], or None for 0, which both messages use for unknown."""
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
        """Learn the hover thrust while the autopilot hovers by itself: in HOLD, or where take-off shares our mode."""
        if self.landed is Landed.IN_AIR and 0.05 < message.thrust < 1.0 and self._hovers_by_itself(arrived_us):
            self.hover_thrust_01 = message.thrust

    def _hovers_by_itself(self, now_us: int) -> bool:
        if self.mode is not FlightMode.EXTERNAL or self._sample is None:
            return self.mode is FlightMode.HOLD
        own = self._setpoint_us is None or now_us - self._setpoint_us > _OWN_FLIGHT_US
        return own and abs(self._sample.vel_ned_m_s[2]) < _HOVER_M_S


def _geodetic(lat_e7: int, lon_e7: int, alt_mm: int) -> GeoOrigin:
    return GeoOrigin(lat_e7 * 1e-7, lon_e7 * 1e-7, alt_mm * 1e-3)
