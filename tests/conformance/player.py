"""Plays whole rows: prepares the vehicle for a row, then judges its steps.

A simulated vehicle is created for every row. One given by URL is landed, disarmed and put back to LOITER with its
original parameters, or restarted where a row needs that.
"""

from __future__ import annotations

from collections.abc import Callable

from tests.conformance import vocabulary as v
from tests.conformance.dialogue import Deviation, Dialogue, integer_value
from tests.conformance.fields import Bits, near
from tests.conformance.verifier import Verifier

FAST_US = {436: 10_000, 245: 20_000, 83: 10_000, 36: 20_000}  # CURRENT_MODE, EXTENDED_SYS_STATE, ATTITUDE_TARGET, SERVO
SLOW_US = {
    31: -1,
    105: 100_000,
    33: 100_000,
}  # ATTITUDE_QUATERNION, HIGHRES_IMU, GLOBAL_POSITION_INT: time is all it saves
NOT_READ_ON_GCS = (31, 32, 33, 36, 83, 85)
FIRST_TEXT_S = 1.5  # PX4 tells a new ground station nothing before 1.4 s
NO_AUTO_DISARM = {"COM_DISARM_PRFLT": -1.0}
CLIMB_01, CLIMB_S, CALM_S = 0.7, 1.0, 0.8  # drag brings the climb to rest at about 4 m
CALM_M_S = 0.3
STREAM_GONE_S = 1.2  # COM_OF_LOSS_T, and when that is looked at
IN_AIR, LOW_M, HIGH_M = 2, 2.5, 8.0
ARMED_FLAG, PREARM_BIT = 128, 0x10000000


class Player:
    """Rows against one partner."""

    def __init__(self, dialogue: Dialogue) -> None:
        self.dialogue = dialogue
        self._verifier = Verifier(dialogue)
        self._original: dict[str, int | float] = {}  # of every parameter that a row has ever changed
        self._changed: set[str] = set()  # of these, since they were last restored
        self._spoilt = False

    def put_away(self) -> None:
        """Power the vehicle off; the next row restarts it."""
        self.dialogue.partner.stop()
        self._spoilt = True

    def play(self, row: v.Row) -> None:
        """Raises `Deviation` at the first step that is not met."""
        self.prepare(row)
        self.play_steps(row)

    def play_steps(self, row: v.Row) -> None:
        """The row itself, on a vehicle that has been prepared."""
        self._spoilt = True
        if row.start is not v.State.BOOTING:
            self.dialogue.set_mark()
        for number, step in enumerate(row.steps, 1):
            try:
                if isinstance(step, v.SetParam):
                    self._remember(step.name, step.value)
                self._verifier.verify(step)
            except Deviation as deviation:
                raise Deviation(f"step {number} of {len(row.steps)}, {step}: {deviation}") from None
        self._spoilt = row.spoils

    def prepare(self, row: v.Row) -> None:
        """Bring the vehicle to where the row starts."""
        try:
            self._afresh(row)
            if row.start is v.State.BOOTING:
                return
            on_ground = row.start in (v.State.ARMED, v.State.GROUND_OFFBOARD)
            for name, value in {**(NO_AUTO_DISARM if on_ground else {}), **row.params}.items():
                self._remember(name, value)
                self._verifier.verify(v.SetParam(name, value))
            self._reach(row.start)
            self._wait_for_texts(row)
        except Deviation as deviation:
            raise Deviation(f"before the row, towards {row.start.value!r}: {deviation}") from None

    # --- the ground ---

    def _afresh(self, row: v.Row) -> None:
        partner = self.dialogue.partner
        booting = row.start is v.State.BOOTING
        if partner.simulated or (partner.can_restart() and (row.needs_reboot or self._spoilt)):
            partner.restart(booting)
            self.dialogue.begin()
            self._changed = set(self._original)  # a real one stores a parameter seconds after it was set, or never
        self._wait(lambda: bool(self.dialogue.sysid), 10.0, "no HEARTBEAT of component 1")
        if booting:
            return
        if not partner.simulated:
            self._come_to_rest(stay_up=row.start in (v.State.LOITER, v.State.OFFBOARD))
        for number, interval_us in {**(SLOW_US if partner.simulated else {}), **FAST_US}.items():
            self._verifier.verify(v.Command(number=v.SET_INTERVAL, params=(number, interval_us), within_s=0.5))
        for number in NOT_READ_ON_GCS if partner.simulated else ():
            self._verifier.verify(v.Command(number=v.SET_INTERVAL, params=(number, -1), link=v.GCS_LINK))
        self.dialogue.set_mark()
        if not self._armed():
            self._verifier.verify(v.sees("SYS_STATUS", 60.0, onboard_control_sensors_health=Bits(PREARM_BIT)))

    def _come_to_rest(self, *, stay_up: bool) -> None:
        """By commands only: on the ground, or in LOITER where the next row flies and nothing speaks against it."""
        if self.dialogue.streaming:
            self.dialogue.stop()
            self.dialogue.run(STREAM_GONE_S)
        self.dialogue.paused.clear()
        self.dialogue.set_mark()
        self._verifier.verify(v.sees("HEARTBEAT", 2.0))
        if self._armed() and not (stay_up and not self._spoilt and self._aloft()):
            self._land_and_disarm()
        self._say(v.go(4, 3))
        for name in sorted(self._changed):
            self._verifier.verify(v.SetParam(name, self._original[name]))
        self._changed.clear()

    def _land_and_disarm(self) -> None:
        if not self._say(v.disarm()):
            self._say(v.go(4, 6))
        self._wait(lambda: not self._armed(), 120.0, "not landed and disarmed")

    def _say(self, command: v.Command) -> bool:
        """A command whose refusal is no deviation; whether it was accepted."""
        try:
            self._verifier.verify(command)
        except Deviation:
            return False
        return True

    def _armed(self) -> bool:
        beat = self.dialogue.newest("HEARTBEAT")
        return beat is not None and bool(beat.base_mode & ARMED_FLAG)

    def _aloft(self) -> bool:
        """In the air, at a height where a row can be flown."""
        at, state = self.dialogue.newest("LOCAL_POSITION_NED"), self.dialogue.newest("EXTENDED_SYS_STATE")
        return at is not None and state is not None and state.landed_state == IN_AIR and LOW_M < -at.z < HIGH_M

    def _wait_for_texts(self, row: v.Row) -> None:
        if any(isinstance(step, v.Says | v.SaysNothing) or "STATUSTEXT" in str(step) for step in row.steps):
            waited_s = self.dialogue.partner.now_s() - self.dialogue.begun_s
            self.dialogue.run(max(0.0, FIRST_TEXT_S - waited_s))

    def _remember(self, name: str, value: int | float) -> None:
        """What a parameter is before we change it; only a vehicle that outlives the row needs that."""
        if self.dialogue.partner.simulated:
            return
        self._changed.add(name)
        if name in self._original:
            return
        read = v.message("PARAM_REQUEST_READ", target_system=v.OWN, target_component=1, param_id=name, param_index=-1)
        self._verifier.verify(v.Send(what=read))
        self._verifier.verify(v.sees("PARAM_VALUE", 1.0, param_id=name))
        values = [a.message for a in self.dialogue.since_mark("PARAM_VALUE", v.OFFBOARD_LINK)]
        found = next(m.param_value for m in values if m is not None and m.param_id == name)
        self._original[name] = integer_value(found) if isinstance(value, int) else found

    # --- the air ---

    def _reach(self, start: v.State) -> None:
        if start is v.State.ARMABLE:
            return
        if start is v.State.ARMED:
            self._verifier.verify(v.arm())
            return
        climbs = start is not v.State.GROUND_OFFBOARD
        if not (climbs and self._armed()):
            self._verifier.verify(v.Stream(v.setpoint(CLIMB_01 if climbs else 0.0)))
            self._verifier.verify(v.arm())
            self._verifier.verify(v.go(6))
            if not climbs:
                return
            self.dialogue.run(CLIMB_S)
            self._verifier.verify(v.Stream(v.setpoint(v.HOVER_01)))
            self.dialogue.run(CALM_S)
            if start is v.State.OFFBOARD:
                return
            self._verifier.verify(v.go(4, 3))
            self.dialogue.stop()
        self.dialogue.set_mark()
        calm = near(0.0, CALM_M_S)
        self._verifier.verify(v.sees("LOCAL_POSITION_NED", 20.0, vx=calm, vy=calm, vz=calm))
        if start is v.State.OFFBOARD:
            self._verifier.verify(v.Stream(v.setpoint(v.HOVER_01)))
            self._verifier.verify(v.go(6))
            self.dialogue.run(CALM_S)

    def _wait(self, met: Callable[[], bool], limit_s: float, what: str) -> None:
        self.dialogue.set_mark()
        if not self.dialogue.run_until(met, limit_s):
            raise Deviation(f"{what} within {limit_s:g} s")
