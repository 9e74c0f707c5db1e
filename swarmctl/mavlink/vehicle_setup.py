"""Setup of a vehicle's link: message rates, origin, and parameters that are set and read back.

Everything is requested again after a reboot of the autopilot, and rates also after they were lost. One command is open
at a time, and only when no other part waits: a request to land never waits for more than one answer. Parameters are set
for the flight alone and restored afterwards, because with them the vehicle relies on an agent.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping

from swarmctl.core.types import Command, Verb
from swarmctl.mavlink.commands import CommandPort, CommandResult
from swarmctl.mavlink.dialects.dialect import ATTITUDE_TARGET, GPS_GLOBAL_ORIGIN, Dialect
from swarmctl.mavlink.vehicle.autopilot import Autopilot

_ORIGIN_EVERY_US = 1_000_000
_ORIGIN_SOON_US = 200_000  # positions do not fit: there is no state until the origin is reported
_WATCH_US = 2_000_000
_WATCH_MAX_US = 30_000_000  # a link that can't carry the rate is asked ever less often
_SILENT_US = 1_200_000  # not even a heartbeat: the vehicle can't answer
_ENOUGH_01 = 0.5
_REPEATED_HZ = 50.0  # of ATTITUDE_TARGET in flight, by which setpoints are known to be heard


class VehicleSetup:
    """Sets up one autopilot and keeps it set up.

    Args:
        autopilot: provides what the vehicle reports.
        commands: executes the requests.
        setup: parameters to set, name -> value.
        sysid: system id of the agent, which its heartbeats carry.
        state_rate_hz: rate of the messages that carry the state.
        note: receives the event `parameters_changed` before any is set, the take-off height of the climb included.
        originals: values of parameters that an earlier agent has changed, integers where the vehicle stores integers.

    Attributes:
        ready: everything has been requested and answered since the last reboot.
        restored: every changed parameter has been set back, or could not be.
        restore_from_us: when the first of them is set back; None until that is asked for.
    """

    def __init__(
        self,
        autopilot: Autopilot,
        commands: CommandPort,
        setup: Mapping[str, int | float],
        sysid: int,
        *,
        state_rate_hz: float,
        note: Callable[..., None],
        originals: Mapping[str, int | float] | None = None,
    ) -> None:
        self._autopilot, self._commands = autopilot, commands
        self._given, self._setup, self._rate_hz = dict(setup), dict(setup), state_rate_hz
        self._sysid, self._note = sysid, note
        self._boots = -1
        self._dialect: Dialect | None = None
        self._todo: deque[Command] = deque()
        self._compared = False  # read values have been compared with wanted ones
        self._before = {  # parameter -> command that restores its original value
            name: _setting(name, value) for name, value in (originals or {}).items()
        }
        self.restore_from_us: int | None = None
        self._open: Command | None = None
        self._failed: dict[str, str] = {}  # parameter -> answer of the autopilot
        self._origin_us = 0
        self._watched_us = 0
        self._watch_us = _WATCH_US
        self._samples = 0
        self._repeated_hz: dict[int, float] = {}  # instead of the dialect's rate, once setpoints are sent
        self.ready = self.restored = False

    @property
    def refusal(self) -> str:
        """Reason that forbids arming, or ""; unknown before `ready`, but for what it is no vehicle to fly."""
        if self._autopilot.kind_problem or not self.ready or self._dialect is None:
            return self._autopilot.kind_problem
        heeds = self._dialect.heeds_parameter
        found = [f"{heeds} could not be set to {self._sysid}: {self._failed[heeds]}"] if heeds in self._failed else []
        told, known = self._autopilot.params, self._autopilot.params.keys()
        failed = self._setup.keys() & self._failed.keys() & known - {heeds}
        found += [f"{name} could not be set to {self._setup[name]}: {self._failed[name]}" for name in failed]
        found += [rule.problem(told.get(rule.name)) for rule in self._dialect.rules if rule.name not in self._failed]
        found += [rule.problem(None) for rule in self._dialect.rules if rule.name in self._failed.keys() - known]
        return "; ".join(sorted(problem for problem in found if problem))

    @property
    def left_changed(self) -> dict[str, int | float]:
        """Parameters that are not restored, with their original values, integers where the vehicle stores integers."""
        return {
            name: set_back.number if set_back.verb is Verb.PARAM_INT else set_back.value
            for name, set_back in self._before.items()
        }

    def restore(self, now_us: int) -> None:
        """Begin to restore every changed parameter; the vehicle has just been heard disarmed, or is handed back.

        None is set within the time in which its dialect may be saving its own: a PX4 can stop of it.
        """
        self._todo = deque(reversed(self._before.values()))
        self.restore_from_us = now_us + (round(1e6 * self._dialect.restore_after_s) if self._dialect else 0)

    def on_result(self, result: CommandResult) -> None:
        """Take a result of the command port, whichever part requested it."""
        if result.command != self._open:
            return
        self._open = None
        name = result.command.name
        if self.restore_from_us is not None:
            if result.ok and result.command == self._before.get(name):  # neither read nor set for the flight
                del self._before[name]
        elif name and not result.ok:
            self._failed[name] = result.text

    def step(self, now_us: int) -> None:
        """Request what is missing. Called last in a tick, so that all other parts request first."""
        self._notice_reboot(now_us)
        if self._dialect is None or self._commands.busy:
            return
        self._open = None
        if self.restore_from_us is not None:
            self.restored = not self._todo
            if now_us < self.restore_from_us:
                return
        elif self.ready:
            self._have_repeated()
            self._watch(now_us)
        elif not self._todo:
            self._compare()
        command = self._todo.popleft() if self._todo else self._origin(now_us)
        if command is not None:
            self._open = command
            self._commands.request(command)

    def _notice_reboot(self, now_us: int) -> None:
        autopilot = self._autopilot
        if autopilot.dialect is None or (autopilot.clock.boots == self._boots and autopilot.dialect is self._dialect):
            return
        self._boots, self._dialect, self.ready = autopilot.clock.boots, autopilot.dialect, False
        self._compared = False
        self._failed.clear()
        self._repeated_hz = {}
        self._setup = {**self._dialect.given, **self._given}
        if self._dialect.heeds_parameter:
            self._setup[self._dialect.heeds_parameter] = self._sysid
        self._watched_us, self._samples = now_us, autopilot.states.count
        if self.restore_from_us is not None:  # the flight is over: nothing else is needed any more
            self._todo = deque(reversed(self._before.values()))
            return
        origin = [Command(verb=Verb.MESSAGE, number=GPS_GLOBAL_ORIGIN)]
        reads = [Command(verb=Verb.PARAM_GET, name=n) for n in dict.fromkeys((*self._setup, *self._dialect.to_read()))]
        self._todo = deque(self._rates(self._dialect) + origin + reads)

    def _compare(self) -> None:
        """Queue a command for each value that differs from the wanted one; without any, the link is set up.

        The take-off height is kept to be restored, too, whatever it is: the climb sets it. Of a vehicle that is not to
        be flown nothing is set.
        """
        if self._compared or self._autopilot.kind_problem:
            self.ready = True
            return
        assert self._dialect is not None
        self._compared, told, kept = True, self._autopilot.params, len(self._before)
        takeoff = self._dialect.takeoff_parameter
        if takeoff in told:
            self._before.setdefault(takeoff, self._setting(takeoff, told[takeoff]))
        for name, value in self._setup.items():
            if name in told and not math.isclose(told[name], value, rel_tol=1e-6, abs_tol=1e-9):
                self._before.setdefault(name, self._setting(name, told[name]))
                self._todo.append(self._setting(name, value))
        if len(self._before) > kept:
            self._note("parameters_changed", were=self.left_changed)

    def _rates(self, dialect: Dialect) -> list[Command]:
        state = [Command(verb=Verb.RATE, value=self._rate_hz, number=number) for number in dialect.state]
        others_hz = {**dialect.rates_hz, **self._repeated_hz}
        return state + [Command(verb=Verb.RATE, value=rate_hz, number=number) for number, rate_hz in others_hz.items()]

    def _have_repeated(self) -> None:
        """Have the vehicle repeat its setpoints as fast as they come, from the first one on."""
        if self._autopilot.setpoints.sent_us is not None and not self._repeated_hz:
            self._repeated_hz = {ATTITUDE_TARGET: _REPEATED_HZ}
            self._todo.append(Command(verb=Verb.RATE, value=_REPEATED_HZ, number=ATTITUDE_TARGET))

    def _setting(self, name: str, value: float) -> Command:
        """Return the request for a value in the type in which the vehicle stores it."""
        is_whole = name in self._autopilot.whole_params and float(value).is_integer()
        return _setting(name, int(value) if is_whole else float(value))

    def _origin(self, now_us: int) -> Command | None:
        frame = self._autopilot.frame
        every_us = _ORIGIN_EVERY_US if frame.offset_ned_m is None else _ORIGIN_SOON_US
        if not frame.wants_origin or now_us - self._origin_us < every_us:
            return None
        self._origin_us = now_us
        return Command(verb=Verb.MESSAGE, number=GPS_GLOBAL_ORIGIN)

    def _watch(self, now_us: int) -> None:
        """Request the rates again when the vehicle sends, but its state comes at less than half the rate."""
        waited_us = now_us - self._watched_us
        if waited_us < self._watch_us:
            return
        samples, received_us = self._autopilot.states.count - self._samples, self._autopilot.received_us
        self._watched_us, self._samples = now_us, self._autopilot.states.count
        enough = samples >= _ENOUGH_01 * self._rate_hz * waited_us * 1e-6
        silent = received_us is None or now_us - received_us > _SILENT_US
        if enough or silent:
            self._watch_us = _WATCH_US
            return
        self._watch_us = min(_WATCH_MAX_US, 2 * self._watch_us)
        assert self._dialect is not None
        self._todo.extend(self._rates(self._dialect))


def _setting(name: str, value: int | float) -> Command:
    """Return the request that sets a parameter, as an integer or as a real number."""
    if isinstance(value, int):
        return Command(verb=Verb.PARAM_INT, number=value, name=name)
    return Command(verb=Verb.PARAM_FLOAT, value=value, name=name)
