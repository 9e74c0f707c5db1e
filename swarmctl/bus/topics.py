"""The topics of the bus: one table. A bus delivers no message that is too long for its topic.

Their messages are laid out in `bus/messages/` and `relay.py`; ticks are rows of `core.recorded.records`, events lines
of `telemetry.recording.shared_events`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

MAX_MISSION_BYTES = 65_536  # a tick reads it


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)  # the table has one object a topic: keys by identity
class Topic:
    """Describes one stream of an agent, or of the operator, on the bus."""

    name: str
    ring: int  # newest samples kept per sender; several, so that some broken ones don't displace the true one
    max_bytes: int  # longer messages are delivered as `TOO_LONG`
    reliable: bool
    repeats: str = ""  # topic whose messages it carries, too: to seals and relays the two are one

    @property
    def stream(self) -> str:
        """Return the name under which messages are sealed."""
        return self.repeats or self.name


PATH = Topic(name="path", ring=8, max_bytes=4096, reliable=False)
FAR_PATH = Topic(name="far_path", ring=8, max_bytes=4096, reliable=False)  # the paths that peers out of reach hear too
STATUS = Topic(name="status", ring=8, max_bytes=20_480, reliable=False)
TICK = Topic(name="tick", ring=256, max_bytes=4096, reliable=False)
EVENT = Topic(name="event", ring=64, max_bytes=4096, reliable=True)  # for a station, of agents on several computers
COMMAND = Topic(name="command", ring=64, max_bytes=1024, reliable=True)
ENDED = Topic(name="ended", ring=64, max_bytes=1024, reliable=True)  # of which of its agents a computer says so
ANSWER = Topic(name="answer", ring=16, max_bytes=4096, reliable=True)
OBSTACLES = Topic(name="obstacles", ring=4, max_bytes=65_536, reliable=True)
MISSION = Topic(name="mission", ring=4, max_bytes=MAX_MISSION_BYTES, reliable=True)
TRAJECTORY = Topic(name="trajectory", ring=8, max_bytes=131_072, reliable=False)  # each one replaces all earlier ones
FAR_TRAJECTORY = replace(TRAJECTORY, name="far_trajectory", repeats=TRAJECTORY.name)  # for those that are far, at times
RELAY = Topic(name="relay", ring=4, max_bytes=60_000, reliable=False)  # trajectory messages of others
_COMMITMENTS = (TRAJECTORY, FAR_TRAJECTORY, RELAY)
TOPICS = (PATH, FAR_PATH, STATUS, TICK, EVENT, COMMAND, ENDED, ANSWER, OBSTACLES, MISSION, *_COMMITMENTS)
FOR_AGENTS = (PATH, FAR_PATH, STATUS, COMMAND, ENDED, OBSTACLES, MISSION, *_COMMITMENTS)

TOO_LONG = b""  # replaces a message that is too long; every decoder refuses it

OPERATOR = "operator"  # sender name of the launcher and of verbs; with [[hosts]] those of `bus.network.roster`
