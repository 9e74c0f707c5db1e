"""Default messages of a link, their rates, and the times at which they are due.

Rates are those of PX4 1.18 as measured on the ground; unlisted messages are sent only on request.
"""

from __future__ import annotations

import heapq

from pymavlink.dialects.v20 import development as mav

LINK_NODE_STATUS, ESC_INFO, ESC_STATUS = 8, 290, 291
TIME_ESTIMATE_TO_TARGET, CURRENT_EVENT_SEQUENCE, SENSOR_FUSION = 380, 411, 514

_BOTH_HZ: dict[int, tuple[float, float]] = {  # offboard link, ground station link
    mav.MAVLINK_MSG_ID_ATTITUDE: (100.0, 50.0),
    mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: (50.0, 50.0),
    mav.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: (50.0, 50.0),
    mav.MAVLINK_MSG_ID_HIGHRES_IMU: (50.0, 0.0),
    mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED: (30.0, 50.0),
    mav.MAVLINK_MSG_ID_ODOMETRY: (30.0, 0.0),
    mav.MAVLINK_MSG_ID_ATTITUDE_TARGET: (10.0, 50.0),
    mav.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: (10.0, 50.0),
    mav.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW: (10.0, 50.0),
    mav.MAVLINK_MSG_ID_TIMESYNC: (10.0, 0.0),
    mav.MAVLINK_MSG_ID_ALTITUDE: (10.0, 1.0),
    ESC_INFO: (10.0, 1.0),
    ESC_STATUS: (10.0, 1.0),
    mav.MAVLINK_MSG_ID_VFR_HUD: (10.0, 4.0),
    mav.MAVLINK_MSG_ID_DISTANCE_SENSOR: (10.0, 0.5),
    mav.MAVLINK_MSG_ID_GPS_RAW_INT: (8.0, 5.0),
    mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: (5.0, 1.0),
    mav.MAVLINK_MSG_ID_SYS_STATUS: (5.0, 1.0),
    mav.MAVLINK_MSG_ID_HEARTBEAT: (1.0, 1.0),
    LINK_NODE_STATUS: (1.0, 1.0),
    mav.MAVLINK_MSG_ID_SCALED_PRESSURE: (1.0, 1.0),
    mav.MAVLINK_MSG_ID_MISSION_CURRENT: (1.0, 1.0),
    mav.MAVLINK_MSG_ID_GNSS_INTEGRITY: (1.0, 1.0),
    mav.MAVLINK_MSG_ID_OPEN_DRONE_ID_LOCATION: (1.0, 1.0),
    mav.MAVLINK_MSG_ID_OPEN_DRONE_ID_SYSTEM: (1.0, 1.0),
    mav.MAVLINK_MSG_ID_ESTIMATOR_STATUS: (1.0, 0.5),
    SENSOR_FUSION: (1.0, 0.5),
    mav.MAVLINK_MSG_ID_SYSTEM_TIME: (1.0, 0.0),
    mav.MAVLINK_MSG_ID_PING: (1.0, 0.1),
    mav.MAVLINK_MSG_ID_BATTERY_STATUS: (0.5, 0.5),
    mav.MAVLINK_MSG_ID_HOME_POSITION: (0.5, 0.5),
    TIME_ESTIMATE_TO_TARGET: (0.5, 0.5),
    mav.MAVLINK_MSG_ID_CURRENT_MODE: (0.5, 0.5),
    mav.MAVLINK_MSG_ID_VIBRATION: (0.5, 0.1),
    CURRENT_EVENT_SEQUENCE: (1 / 3, 1 / 3),
}
OFFBOARD_HZ = {message: rates[0] for message, rates in _BOTH_HZ.items() if rates[0] > 0}
GCS_HZ = {message: rates[1] for message, rates in _BOTH_HZ.items() if rates[1] > 0}

_SHIFT_STEPS = {mav.MAVLINK_MSG_ID_ODOMETRY: 0}
_NEVER_US = 1 << 62


class Schedule:
    """Decides which messages are due. Times since boot; intervals lie on a grid from boot, so samples repeat exactly.

    All but odometry are shifted by their id, so that one step never has to send everything; the heartbeat's grid begins
    with the first message.
    """

    def __init__(self, step_us: int, default_hz: dict[int, float] | None = None, first_us: int = 0) -> None:
        self._step_us = step_us
        self._first_us = first_us  # of the heartbeat; nothing is sent before
        self._default_hz = OFFBOARD_HZ if default_hz is None else default_hz
        self._interval_us: dict[int, int] = {}
        self._next_us: dict[int, int] = {}
        self._queue: list[tuple[int, int]] = []  # (due, message); entries that `_next_us` contradicts are stale
        for message in self._default_hz:
            self.set_interval(message, 0, first_us)

    def set_interval(self, message: int, interval_us: int, now_us: int) -> None:
        """Set the interval of a message [us]: 0 its default, negative off; never below one physics step."""
        if interval_us == 0:
            rate_hz = self._default_hz.get(message, 0.0)
            interval_us = round(1e6 / rate_hz) if rate_hz > 0 else -1
        self._interval_us.pop(message, None)
        self._next_us.pop(message, None)
        if interval_us < 0:
            return
        interval_us = max(interval_us, self._step_us)
        shift_us = _SHIFT_STEPS.get(message, message) * self._step_us
        if message == mav.MAVLINK_MSG_ID_HEARTBEAT:
            shift_us = self._first_us
        self._interval_us[message] = interval_us
        self._next_us[message] = now_us + (shift_us - now_us) % interval_us
        heapq.heappush(self._queue, (self._next_us[message], message))

    def interval_us(self, message: int) -> int:
        """Return the interval of a message [us], -1 when it is off."""
        return self._interval_us.get(message, -1)

    def take_due(self, now_us: int) -> list[int]:
        """Return the ids due at `now_us`, in order of their times; a missed one is sent once."""
        due: list[int] = []
        queue, next_us = self._queue, self._next_us
        while queue and queue[0][0] <= now_us:
            at_us, message = queue[0]
            if next_us.get(message) != at_us:
                heapq.heappop(queue)
                continue
            due.append(message)
            interval_us = self._interval_us[message]
            at_us += interval_us * (1 + (now_us - at_us) // interval_us)
            next_us[message] = at_us
            heapq.heapreplace(queue, (at_us, message))
        return due
