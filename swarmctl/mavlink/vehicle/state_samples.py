"""From the messages that carry a vehicle's state to its newest sample, and to where that is in the shared frame."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import development as mavlink

from swarmctl.core.frames import numbers_rotated_to_ned
from swarmctl.mavlink.vehicle.local_frame import LocalFrame
from swarmctl.mavlink.vehicle.plausibility import state_problem
from swarmctl.mavlink.vehicle.sample import Placed, Quaternion, Sample, Vector
from swarmctl.mavlink.vehicle.vehicle_clock import VehicleClock

_LOCAL_NED = mavlink.MAV_FRAME_LOCAL_NED
_BODY_FRD = (mavlink.MAV_FRAME_BODY_NED, mavlink.MAV_FRAME_BODY_FRD)  # frames of the velocity in ODOMETRY
_APART_US = 100_000  # by which the attitude's stamp may differ from the position's: two intervals at the lowest rate
_ODOMETRY_US = 500_000  # a vehicle that has sent ODOMETRY within this time sends its state in it


class StateSamples:
    """Keeps the newest state of one vehicle.

    Args:
        clock: the vehicle's clock.
        frame: its local frame.
        refused: counts what is not taken, by reason.
        on_reboot: called when a sample shows that the vehicle has rebooted, before it is taken.

    Attributes:
        newest: sample, None before the first.
        count: number of states received; two readings give the rate.
        is_lost: the estimator of an armed vehicle says that it knows no position: what it goes on sending, by its
            inertial sensors alone, is not taken, so that the state ages.
    """

    newest: Sample | None
    _placed: Placed | None
    _attitude: tuple[int, Quaternion, Vector] | None  # with its stamp [us] and its rates
    _reset_counter: int | None
    _was_reset: bool  # the estimator has reported a reset since the newest placed sample

    def __init__(
        self, clock: VehicleClock, frame: LocalFrame, refused: Counter[str], on_reboot: Callable[[], None]
    ) -> None:
        self._clock, self._frame, self._refused, self._on_reboot = clock, frame, refused, on_reboot
        self.count = 0
        self._boots = self._restarts = 0  # counters of the clock that have been handled
        self.forget()

    def forget(self) -> None:
        """Discard what the vehicle has reported: it has rebooted, or was never received."""
        self.newest = self._placed = self._attitude = self._reset_counter = None
        self._was_reset = self.is_lost = False
        self._odometry_us = 0

    def odometry(self, message: Any, arrived_us: int) -> None:
        """Take a whole state."""
        if message.frame_id != _LOCAL_NED or message.child_frame_id not in (_LOCAL_NED, *_BODY_FRD):
            self._refused["odometry frame"] += 1
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

    def attitude_quaternion(self, message: Any, arrived_us: int) -> None:
        """Keep an attitude for the local positions that follow."""
        q_nb = message.q1, message.q2, message.q3, message.q4
        vehicle_us = self._clock.boot_us(message.time_boot_ms, arrived_us)
        self._attitude = vehicle_us, q_nb, (message.rollspeed, message.pitchspeed, message.yawspeed)

    def local_position(self, message: Any, arrived_us: int) -> None:
        """Combine a local position with the newest attitude, for autopilots without ODOMETRY.

        A position whose attitude is of another time is refused, so that the state ages when attitudes stop.
        """
        if self._attitude is None or (arrived_us - self._odometry_us < _ODOMETRY_US and self._odometry_us):
            return
        vehicle_us = self._clock.boot_us(message.time_boot_ms, arrived_us)
        attitude_us, q_nb, rate = self._attitude
        if abs(vehicle_us - attitude_us) > _APART_US:
            self._refused["attitude of another time"] += 1
            return
        pos, vel = (message.x, message.y, message.z), (message.vx, message.vy, message.vz)
        self._take(vehicle_us, arrived_us, pos, vel, q_nb=q_nb, rate=rate)

    def placed(self, armed: bool) -> Placed | None:
        """Return the newest sample in the shared frame; None while its place can't be known."""
        sample = self.newest
        if sample is None:
            return None
        if self._placed is None or self._placed.sample is not sample:
            self._placed = self._place(sample, armed)
        return self._placed

    def _take(
        self, vehicle_us: int, arrived_us: int, pos: Vector, vel: Vector, *, q_nb: Quaternion, rate: Vector
    ) -> bool:
        """Keep a sample if it is valid and the newest; return whether it was kept."""
        w, x, y, z = q_nb
        norm = math.sqrt((w * w + y * y) + (x * x + z * z))  # in the order of a dot product, by which it rounds
        problem = "position lost by the estimator" if self.is_lost else state_problem(pos, vel, rate, norm)
        if problem:
            self._refused[problem] += 1
            return False
        t_us = self._clock.to_local(vehicle_us, arrived_us)
        if t_us is None:
            self._refused["stamp not believed"] += 1
            return False
        if self._clock.restarts != self._restarts:
            self._restarts, self.newest = self._clock.restarts, None
        if self._clock.boots != self._boots:
            self._boots = self._clock.boots
            self._on_reboot()
            self._odometry_us = arrived_us
        self.count += 1
        if self.newest is not None and vehicle_us < self.newest.vehicle_us:
            return False
        self.newest = Sample(vehicle_us, t_us, pos, vel, (w / norm, x / norm, y / norm, z / norm), rate)
        return True

    def _place(self, sample: Sample, armed: bool) -> Placed | None:
        vel, was_reset = np.array(sample.vel_ned_m_s), self._was_reset
        self._was_reset = False
        pos = self._frame.place(sample.vehicle_us, np.array(sample.pos_ned_m), vel, armed, reset=was_reset)
        if pos is None:
            return None
        return Placed(sample, pos, vel, np.array(sample.q_nb), np.array(sample.rate_frd_rad_s))
