"""Partners of a dialogue: a simulated vehicle in this process, or any autopilot by URL.

Both provide transports and the passing of time; they do not differ otherwise.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from typing import Protocol

from sitl.world import SitlWorld
from swarmctl.core.clock import SimClock
from swarmctl.mavlink.framing import frames, message_id
from swarmctl.mavlink.transport import Datagram, Transport, open_transport, pipe_pair
from swarmctl.simulator_config import SimulatorConfig
from tests.conformance.vocabulary import GCS_LINK, OFFBOARD_LINK

EKF_READY_S = 4.0  # as measured on PX4
ATTITUDE = 30  # begins with the milliseconds since the vehicle's start
STEP_US = 4000
Tamper = Callable[[bytes], list[bytes]]


class Partner(Protocol):
    """One vehicle and the links to it."""

    links: dict[str, Transport]
    slack_s: float  # added to every limit: what the wall clock and a loaded machine may cost
    simulated: bool

    def now_s(self) -> float:
        """Time the vehicle's promises are measured in."""

    def advance(self) -> None:
        """Let a few milliseconds pass."""

    def restart(self, booting: bool) -> None:
        """A vehicle that has just started; `booting`: with the time its estimator really takes."""

    def can_restart(self) -> bool: ...

    def stop(self) -> None:
        """Power it off until it is restarted; one that can't be restarted stays on."""

    def close(self) -> None: ...


class TamperedLink:
    """A link whose incoming frames are modified by a function."""

    def __init__(self, inner: Transport, tamper: Tamper) -> None:
        self._inner = inner
        self._tamper = tamper

    def send(self, data: bytes) -> None:
        self._inner.send(data)

    def receive(self, now_us: int) -> list[Datagram]:
        return [Datagram(d.t_us, frame) for d in self._inner.receive(now_us) for frame in self._tamper(d.data)]

    def close(self) -> None:
        self._inner.close()


class InProcess:
    """`SitlWorld` with one vehicle like the sheet's, on a simulated clock and in-memory links."""

    slack_s = 0.0
    simulated = True

    def __init__(self) -> None:
        self.restart(booting=True)

    def restart(self, booting: bool) -> None:
        self._clock = SimClock()
        pairs = {name: pipe_pair(self._clock.now_us) for name in (OFFBOARD_LINK, GCS_LINK)}
        self.links: dict[str, Transport] = {name: ours for name, (_, ours) in pairs.items()}
        ready_s = EKF_READY_S if booting else 0.1
        params = SimulatorConfig(
            vehicles=1, preset="x500", ekf_ready_s=ready_s, reject_bad_setpoints=False
        )  # the sheet's PX4 validates nothing
        self.world = SitlWorld(params, [pairs[OFFBOARD_LINK][0]], [pairs[GCS_LINK][0]])

    def can_restart(self) -> bool:
        return True

    def stop(self) -> None:
        return  # without `advance` no time passes for it

    def now_s(self) -> float:
        return self._clock.now_us() * 1e-6

    def advance(self) -> None:
        self._clock.advance(STEP_US)
        self.world.step(self._clock.now_us())

    def close(self) -> None:
        for link in self.links.values():
            link.close()


class VehicleClock:
    """The vehicle's own time, in which it keeps its promises: a loaded machine makes a simulated one slow.

    Between two of its messages time passes as on the wall, but not on and on: a simulation that stands still for up to
    `STALL_S` has not used any time. Time never runs backwards.
    """

    STALL_S = 1.0
    LATE = 2.0  # times as long as between the two messages before

    def __init__(self, wall_s: Callable[[], float] = time.monotonic) -> None:
        self._wall_s = wall_s
        self._newest_s = self._heard_s = self._heard_wall_s = wall_s()
        self._start_s: float | None = None  # of the vehicle, once it has been heard
        self._every_s = 0.0

    def now_s(self) -> float:
        age_s = self._wall_s() - self._heard_wall_s
        stalled_s = 0.0 if self._start_s is None else min(max(age_s - self.LATE * self._every_s, 0.0), self.STALL_S)
        self._newest_s = max(self._newest_s, self._heard_s + age_s - stalled_s)
        return self._newest_s

    def started(self) -> None:
        """Expect its messages to begin at zero again."""
        self._heard_s, self._heard_wall_s, self._start_s = self.now_s(), self._wall_s(), None

    def heard(self, since_start_s: float, age_s: float) -> None:
        """Take over the time of a message that arrived so long ago."""
        wall_s = self._wall_s() - age_s
        if self._start_s is None:
            self._start_s = self._heard_s + wall_s - self._heard_wall_s - since_start_s
        self._every_s = self._start_s + since_start_s - self._heard_s
        self._heard_s, self._heard_wall_s = self._start_s + since_start_s, wall_s


class ClockLink:
    """A link to a vehicle that sets its clock."""

    def __init__(self, inner: Transport, clock: VehicleClock) -> None:
        self._inner = inner
        self._clock = clock

    def send(self, data: bytes) -> None:
        self._inner.send(data)

    def receive(self, now_us: int) -> list[Datagram]:
        came = self._inner.receive(now_us)
        for datagram in came:
            for frame in frames(datagram.data):
                if message_id(frame) == ATTITUDE:
                    self._clock.heard(int.from_bytes(frame[10:14], "little") * 1e-3, (now_us - datagram.t_us) * 1e-6)
        return came

    def close(self) -> None:
        self._inner.close()


class ByUrl:
    """Any autopilot on the URLs of its links; `restart_command` is a shell line that starts it afresh."""

    slack_s = 0.15
    simulated = False
    PAUSE_S = 0.002

    def __init__(self, url: str, gcs_url: str = "", restart_command: str = "") -> None:
        urls = {OFFBOARD_LINK: url} | ({GCS_LINK: gcs_url} if gcs_url else {})
        self.links: dict[str, Transport] = {name: open_transport(u) for name, u in urls.items()}
        self._clock = VehicleClock()
        self.links[OFFBOARD_LINK] = ClockLink(self.links[OFFBOARD_LINK], self._clock)
        self._restart_command = restart_command
        self._process: subprocess.Popen[bytes] | None = None
        if restart_command:
            self.restart(booting=True)

    def can_restart(self) -> bool:
        return bool(self._restart_command)

    def restart(self, booting: bool) -> None:
        self.stop()
        for link in self.links.values():
            link.receive(0)  # what the last one still said
        self._clock.started()
        self._process = subprocess.Popen(["sh", "-c", f"exec {self._restart_command}"], stdout=subprocess.DEVNULL)

    def now_s(self) -> float:
        return self._clock.now_s()

    def advance(self) -> None:
        time.sleep(self.PAUSE_S)

    def stop(self) -> None:
        """Power it off until it is restarted; one that somebody else has started stays on."""
        if self._process is not None:
            self._process.terminate()
            self._process.wait(timeout=10.0)
            self._process = None

    def close(self) -> None:
        self.stop()
        for link in self.links.values():
            link.close()
