"""Gives every decoder of bytes from outside what a flight has sent, mutated, and reports what raises or takes too long.

    python tools/fuzz.py --executions 10000000 --state runs/fuzz.json

Every round gives each target its share of time; the state file counts executions, so that a run can be interrupted and
goes on with other mutations. A finding is written beside it, and ends with exit code 4.
"""

from __future__ import annotations

import argparse
import io
import json
import logging
import math
import random
import struct
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import development as dialect

from sitl.fault_socket import handle
from sitl.lockstep import Lockstep
from swarmctl.bus import topics
from swarmctl.bus.bus import agent_name
from swarmctl.bus.messages.commitment_messages import decode_trajectory_message
from swarmctl.bus.messages.json_messages import (
    AnswerMessage,
    EndedMessage,
    decode_answer,
    decode_command,
    decode_ended,
    decode_obstacles,
    decode_status,
    encode_message,
)
from swarmctl.bus.messages.path_messages import decode_path, encode_path
from swarmctl.bus.network.datagram_routes import DatagramRoutes
from swarmctl.bus.network.datagrams import DatagramChannel
from swarmctl.bus.network.hosts import roster_of
from swarmctl.bus.network.roster import Roster
from swarmctl.bus.network.seals import KEY_BYTES, Sealer, SealVerifier
from swarmctl.bus.relay import decode_relay, encode_relay
from swarmctl.config import load
from swarmctl.configuration.shows import read_show
from swarmctl.configuration.tables import read_tables
from swarmctl.core.recorded.records import TICK_DTYPE, unpack_tick
from swarmctl.errors import EXIT_MISSION, EXIT_OK, ConfigError
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.framing import frames
from swarmctl.mavlink.signing.channel import AGENT_LINK, SigningChannel
from swarmctl.mavlink.signing.signature import SigningKey
from swarmctl.telemetry.recording.file_names import TRUTH
from swarmctl.telemetry.recording.run_files import load_run, read_rows, write_parquet

AGENTS = 2
FLIGHT = (f"swarm.agents={AGENTS}", "separation.mode=guaranteed", "mission.duration_s=4", "sitl.start=air")
SLOW_S = 1.0  # longest time of one execution; a loaded machine may take a processor away for a while
MOST_MUTATIONS = 4
SEEDS_KEPT = 400  # of each kind
INTERESTING = (b"\x00", b"\xff", b"\x7f", b"\x80", b"nan", b"1e999", b"-1", b"null", b"[", b"{", b'"')
CONFIGS = Path(__file__).parents[1] / "configs"
MEMORY = Path("/dev/shm")
HELD_US, RESUMED_US = 8_000_000, 9_000_000
FLYING_US, RENEWED_US = 9_000_000, 300_000_000
GIVEN_A_TICK = 20
PARQUET_ROWS = 20
MOST_OF_A_FILE = 20_000  # bytes
_TLOG_STAMP_BYTES, _MOST_FRAME_BYTES, _LEAST_FRAME_BYTES = 8, 280, 12
_VERSION_2, _HEADER_BYTES, _CHECKSUM_BYTES, _MOST_PAYLOAD_BYTES = 0xFD, 10, 2, 255
RUN_FILES = ("agent-0.ticks", TRUTH, "agent-0.events.jsonl")


@dataclass(frozen=True, slots=True)
class Target:
    """One way in: what it is given to begin with, the call, and the errors by which it refuses."""

    seeds: Sequence[bytes]
    run: Callable[[bytes], object]
    refuses: tuple[type[Exception], ...] = ()
    repair: Callable[[bytes], bytes] | None = None  # makes half of the mutations pass the first check


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """What went wrong, and the bytes that did it."""

    target: str
    data: bytes
    problem: str


def flown_bytes(folder: Path) -> dict[str, list[bytes]]:
    """Return what a short flight has sent, by topic and on the links; its files are left in the folder."""
    folder.mkdir()
    flight = Lockstep(load(None, FLIGHT), folder)
    agents = [agent_name(i) for i in range(AGENTS)]
    listener = flight.hub.connect("listener", {topic: [*agents, topics.OPERATOR] for topic in topics.TOPICS})
    sent: dict[str, list[bytes]] = {topic.name: [] for topic in topics.TOPICS}

    def listen(lockstep: Lockstep) -> None:
        for topic in topics.TOPICS:
            sent[topic.name] += [payload for _, payload in listener.receive(topic)]
        if lockstep.clock.now_us() == HELD_US:
            lockstep.command("hold")
        if lockstep.clock.now_us() == RESUMED_US:
            lockstep.command("resume")

    flight.run(listen)
    for log in flight.logs:
        log.close()
    (folder / TRUTH).write_bytes(flight.truth.tobytes())
    sent["mavlink"] = [frame for i in range(AGENTS) for frame in _logged(folder / f"agent-{i}.tlog")]
    answer = AnswerMessage(agent=0, boot_id=1, verb="hold", number=1, accepted=True, reason="", utc_us=1)
    sent["answer"] = [encode_message(answer)]
    sent["ended"] = [encode_message(EndedMessage(agent=0, boot_id=1, is_down=True))]
    return {name: payloads for name, payloads in sent.items() if payloads}


def _logged(path: Path) -> Iterator[bytes]:
    """Yield the frames of a log, which are behind eight bytes of time each."""
    content, at = path.read_bytes(), _TLOG_STAMP_BYTES
    while at < len(content):
        (frame,) = frames(content[at : at + _MOST_FRAME_BYTES])[:1]
        yield frame
        at += len(frame) + _TLOG_STAMP_BYTES


class Tick:
    """A whole agent in flight: everything is given to its tick as from its vehicle, or from a peer that has died."""

    def __init__(self, names: Sequence[str]) -> None:
        self._topics = [topic for topic in topics.TOPICS if topic.name in names]
        self._given = 0
        self._begin()

    def _begin(self) -> None:
        self._flight = Lockstep(load(None, ("mission.duration_s=600", "sitl.start=air", "swarm.agents=3")))
        while self._flight.clock.now_us() < FLYING_US:
            self._flight.step()
        self._flight.kill(AGENTS)
        self._peer = self._flight.hub.connect(agent_name(AGENTS))

    def run(self, data: bytes) -> None:
        """Give it the bytes; the flight goes on after every few."""
        self._given += 1
        which = self._given % (len(self._topics) + 1)
        if which == len(self._topics):
            self._flight.links[0][1].send(data)
        else:
            self._peer.publish(self._topics[which], data)
        if self._given % GIVEN_A_TICK:
            return
        self._flight.step()
        row = self._flight.logs[0].rows[-1]
        if any(map(math.isinf, (*row["setpoint_q_nb"][0], row["setpoint_thrust_01"][0]))):
            raise AssertionError("a setpoint is infinite")
        if self._flight.finished or self._flight.clock.now_us() > RENEWED_US:
            self._begin()


class Files:
    """A way in by a file, which is written anew for each execution."""

    def __init__(self, folder: Path, name: str, read: Callable[[Path], object]) -> None:
        self._folder, self._name, self._read = folder, name, read
        folder.mkdir(parents=True)

    def run(self, data: bytes) -> object:
        """Write the file, and read it as users do."""
        (self._folder / self._name).write_bytes(data)
        return self._read(self._folder)


class Datagrams:
    """The way in by the port of datagrams: of a stranger, and of a computer of the swarm whose key seals anything."""

    def __init__(self, roster: Roster, paths: Sequence[bytes]) -> None:
        key, name = bytes(KEY_BYTES), "alpha"
        self._routes = DatagramRoutes(roster, name, [key] * len(roster.speakers), {}, session=1)
        self._peer = DatagramChannel(key, me=1, other=0, session=2)
        self.take(self._peer.seal(b""))
        self._peer.open(self._routes.take(self._peer.seal(b"hello"), ("10.0.0.2", 1), 0.0).outgoing[0][0])
        beat, message, another = (struct.pack("<BQ", kind, 3) for kind in range(3))
        named = message + bytes((16,)) + b"run/agent-2/path"
        self.sent = [self._peer.seal(beat)]
        self.bodies = [beat, *(named + path for path in paths), another + self.sent[0]]

    def take(self, data: bytes) -> object:
        """Take a datagram from anywhere."""
        return self._routes.take(data, ("10.0.0.3", 1), 0.0)

    def take_sealed(self, data: bytes) -> object:
        """Take a datagram with this body, from who may send it."""
        return self.take(self._peer.seal(data))


def targets(folder: Path) -> dict[str, Target]:
    """Return every way in, with what a flight has sent as seeds."""
    sent = flown_bytes(folder / "flight")
    rng = random.Random(1)
    seeds = {name: rng.sample(all_, min(SEEDS_KEPT, len(all_))) for name, all_ in sent.items()}
    seeds["path"] += [encode_path(path, compact=True) for path in map(decode_path, seeds["path"]) if path]
    codec, key = Codec(255, 190), SigningKey(bytes(range(32)))
    channel = SigningChannel(key, AGENT_LINK, lambda: 1_800_000_000_000_000)
    signed = [channel.sign(frame) for frame in seeds["mavlink"]]
    receiver = SigningChannel(key, AGENT_LINK, lambda: 1_800_000_000_000_000)
    roster = roster_of(load(CONFIGS / "three_hosts.toml").hosts, relay=False)
    shared: list[bytes | None] = [bytes([number]) * KEY_BYTES for number in range(len(roster.speakers))]
    sealer = Sealer(shared, "run", "agent-0", session=1)
    sealed = [sealer.seal("path", payload, 1_800_000_000_000_000) for payload in seeds["path"]]
    verifier = SealVerifier(roster, [shared[0]] * len(shared), "run", me="alpha", max_age_us={})
    flight = Lockstep(load(None, ("swarm.agents=1",)))
    datagrams = Datagrams(roster, seeds["path"][:4])
    fault = json.dumps({"fault": {"kind": "gust", "vehicle": 0, "value": 3.0, "for_s": 2.0}}).encode()
    found = {
        "path": Target(seeds["path"], decode_path),
        "trajectory": Target(seeds["trajectory"], decode_trajectory_message),
        "relay": Target([encode_relay([(0, seed)]) for seed in seeds["trajectory"][:4]], decode_relay),
        "status": Target(seeds["status"], decode_status),
        "command": Target(seeds["command"], decode_command),
        "answer": Target(seeds["answer"], decode_answer),
        "ended": Target(seeds["ended"], decode_ended),
        "obstacles": Target(seeds["obstacles"], decode_obstacles),
        "sealed": Target(sealed, lambda data: verifier.open("agent-0", "path", data, 1_800_000_000_000_000)),
        "datagram": Target(datagrams.sent, datagrams.take),
        "datagram, true sender": Target(datagrams.bodies, datagrams.take_sealed),
        "tick row": Target(seeds["tick"], unpack_tick),
        "frames": Target(seeds["mavlink"], lambda data: [codec.decode(frame) for frame in frames(data, True)]),
        "frames, checksum right": Target(
            seeds["mavlink"], lambda data: [codec.decode(frame) for frame in frames(data)], repair=with_checksum
        ),
        "signed frames": Target(signed, lambda data: [receiver.fault(frame) for frame in frames(data)]),
        "fault request": Target([fault], lambda data: handle(data, flight.world)),
        "tick": Target([payload for name in sorted(seeds) for payload in seeds[name]], Tick(list(seeds)).run),
        "configuration": Target(
            [(CONFIGS / name).read_bytes() for name in ("swap8.toml", "px4_udp.toml", "three_hosts.toml")],
            Files(folder / "configuration", "x.toml", lambda place: load(place / "x.toml")).run,
            (ConfigError,),
        ),
        "table": Target(
            [b"t,x,y,z\n0,0,0,-1\n5,1,2,-1\n", (CONFIGS / "examples" / "figure_8.csv").read_bytes()],
            Files(folder / "table", "x.csv", lambda place: read_tables(mission("csv", "files", ["x.csv"]), place)).run,
        ),
        "drone show": Target(
            [drone_show()],
            Files(folder / "show", "x.skyc", lambda place: read_show(mission("skybrush", "file", "x.skyc"), place)).run,
        ),
    }
    for name in (*RUN_FILES, "agent-0.parquet"):
        flown = folder / "flight"
        content = parquet(flown) if name.endswith("parquet") else (flown / name).read_bytes()[:MOST_OF_A_FILE]
        found[f"file {name}"] = Target([content], Files(folder / f"of {name}", name, load_run).run, (ConfigError,))
    return found


def mission(kind: str, key: str, value: object) -> dict[str, Any]:
    """Return the tree of a configuration that names files of a mission."""
    return {"mission": {kind: {key: value}}}


def parquet(folder: Path) -> bytes:
    """Return the ticks of a flight as Parquet, a few of them."""
    rows = read_rows(folder / "agent-0.ticks", TICK_DTYPE)[:PARQUET_ROWS]
    path = folder / "few.parquet"
    write_parquet(path, rows)
    return path.read_bytes()


def drone_show() -> bytes:
    """Return a drone show of one drone that climbs."""
    points = [[0.0, [0.0, 0.0, 0.0], []], [5.0, [0.0, 0.0, 2.0], []]]
    trajectory = {"version": 1, "points": points, "takeoffTime": 0}
    show = {"version": 1, "swarm": {"drones": [{"type": "generic", "settings": {"trajectory": trajectory}}]}}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("show.json", json.dumps(show))
    return buffer.getvalue()


def with_checksum(frame: bytes) -> bytes:
    """Return a frame of MAVLink 2 with the right length and checksum, if its message is known."""
    if len(frame) < _LEAST_FRAME_BYTES or frame[0] != _VERSION_2:
        return frame
    payload = frame[_HEADER_BYTES:-_CHECKSUM_BYTES][:_MOST_PAYLOAD_BYTES]
    inside = bytes([len(payload), 0]) + frame[3:_HEADER_BYTES] + payload
    known = dialect.mavlink_map.get(int.from_bytes(frame[7:10], "little"))
    extra = bytes([known.crc_extra]) if known is not None else b""
    return bytes([_VERSION_2]) + inside + mcrf4xx(inside + extra).to_bytes(_CHECKSUM_BYTES, "little")


def mutated(rng: random.Random, seeds: Sequence[bytes]) -> bytes:
    """Return one of the seeds with a few changes."""
    data = bytearray(rng.choice(seeds))
    for _ in range(rng.randint(0, MOST_MUTATIONS)):
        rng.choice(MUTATIONS)(rng, data, seeds)
    return bytes(data)


def _flip(rng: random.Random, data: bytearray, _: Sequence[bytes]) -> None:
    if data:
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _overwrite(rng: random.Random, data: bytearray, _: Sequence[bytes]) -> None:
    at = rng.randint(0, len(data))
    word = rng.choice((rng.choice(INTERESTING), rng.randbytes(rng.choice((1, 2, 4, 8)))))
    data[at : at + len(word)] = word


def _insert(rng: random.Random, data: bytearray, _: Sequence[bytes]) -> None:
    at = rng.randint(0, len(data))
    data[at:at] = rng.choice((rng.choice(INTERESTING), rng.randbytes(rng.randint(1, 16))))


def _cut(rng: random.Random, data: bytearray, _: Sequence[bytes]) -> None:
    at = rng.randint(0, len(data))
    del data[at : at + rng.choice((1, 2, 4, 8, len(data)))]


def _repeat(rng: random.Random, data: bytearray, _: Sequence[bytes]) -> None:
    at = rng.randint(0, len(data))
    data[at:at] = data[at : at + rng.randint(1, 64)] * rng.randint(1, 8)


def _splice(rng: random.Random, data: bytearray, seeds: Sequence[bytes]) -> None:
    other = rng.choice(seeds)
    at = rng.randint(0, min(len(data), len(other)))
    data[at:] = other[at:]


MUTATIONS = (_flip, _flip, _overwrite, _overwrite, _insert, _cut, _repeat, _splice)


def execute(target: Target, data: bytes) -> str:
    """Give a target its bytes; returns what went wrong, or ""."""
    began_s = time.process_time()
    try:
        target.run(data)
    except target.refuses:
        pass
    except Exception as error:
        return f"raised {type(error).__name__}: {error}"
    took_s = time.process_time() - began_s
    return f"took {took_s:.1f} s" if took_s > SLOW_S else ""


def fuzz(name: str, target: Target, done: int, end_s: float) -> tuple[int, Finding | None]:
    """Execute a target until a time; returns how often, and the first finding.

    Args:
        name: of the target, which with `done` begins the random numbers.
        target: what is executed.
        done: executions before.
        end_s: monotonic time [s].
    """
    rng, count = random.Random(f"{name} {done}"), 0
    while time.monotonic() < end_s:
        data = mutated(rng, target.seeds)
        if target.repair is not None and rng.random() < 0.5:
            data = target.repair(data)
        count += 1
        if problem := execute(target, data):
            return count, Finding(target=name, data=data, problem=problem)
    return count, None


def main() -> int:
    """Fuzz all targets in turn, and print what was done."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", maxsplit=1)[0])
    parser.add_argument("--executions", type=int, default=10_000_000, help="of all targets together, earlier ones too")
    parser.add_argument("--state", type=Path, required=True, help="file that counts executions")
    parser.add_argument("--only", help="targets, with commas between them")
    parser.add_argument("--round", type=float, default=1.0, help="seconds of one target at a time")
    options = parser.parse_args()
    counts: dict[str, int] = json.loads(options.state.read_text()) if options.state.exists() else {}
    logging.disable()
    with tempfile.TemporaryDirectory(prefix="fuzz-", dir=MEMORY if MEMORY.is_dir() else None) as folder:
        found = targets(Path(folder))
        names = options.only.split(",") if options.only else list(found)
        while sum(counts.values()) < options.executions:
            for name in names:
                end_s = time.monotonic() + options.round
                count, finding = fuzz(name, found[name], counts.get(name, 0), end_s)
                counts[name] = counts.get(name, 0) + count
                options.state.write_text(json.dumps(counts, indent=2))
                if finding is not None:
                    path = options.state.with_name(f"{options.state.stem}-{name.replace(' ', '-')}.bin")
                    path.write_bytes(finding.data)
                    print(f"{name}: {finding.problem}; {path}", flush=True)
                    return EXIT_MISSION
    print(json.dumps(counts, indent=2))
    print(f"{sum(counts.values())} executions, no finding")
    return EXIT_OK


if __name__ == "__main__":
    sys.exit(main())
