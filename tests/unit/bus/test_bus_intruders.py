"""What an intruder on the bus of several hosts can send, row by row: nothing of it is believed, all of it is counted.

Agent 0 of host alpha hears agent 1 of bravo and agent 2 of charlie. The intruder has the wire: it hears everything and
may put any bytes under any name, as a router could that obeys no access control. In some rows it has the files of a
legal host, charlie, or those that bravo had before they were revoked, or those of another swarm. Each row says why it
is refused, and whether it would be believed with the protection of this row off.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import msgspec
import numpy as np
import pytest

from swarmctl.agent.sensing.world_model import WorldModel
from swarmctl.bus.bus import agent_name
from swarmctl.bus.local.hub import LocalHub
from swarmctl.bus.messages.commitment_messages import encode_trajectory_message
from swarmctl.bus.messages.json_messages import CommandMessage, EndedMessage, encode_message, first_list
from swarmctl.bus.messages.path_messages import encode_path
from swarmctl.bus.network.identities import add_identity, make_identities, revoke_identity
from swarmctl.bus.network.identity_files import STATION
from swarmctl.bus.network.keyring import load_keyring
from swarmctl.bus.network.sealed_bus import FOR_AGENTS_US, SealedBus
from swarmctl.bus.network.seals import TAG_BYTES, PairKeys, Sealer, SealVerifier, overhead_bytes
from swarmctl.bus.peers.trajectories import PeerTrajectories
from swarmctl.bus.refusals import MISDELIVERED, RefusedMessage
from swarmctl.bus.relay import RelayingBus, encode_relay
from swarmctl.bus.topics import COMMAND, ENDED, OBSTACLES, PATH, RELAY, STATUS, TRAJECTORY, Topic
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.model import VehicleModelParams
from swarmctl.core.clock import SimClock
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.trajectory import resting
from swarmctl.core.types import Phase
from tests import builders
from tests.benches.swarm_of_hosts import LOOPBACK, SwarmOfHosts

RUN, TICK_US, RATE_HZ = "run", 20_000, 50.0
ME, VICTIM, OTHER = agent_name(0), agent_name(1), agent_name(2)
BOOT, STRANGER = 7, 99
MINUTE_US = 60_000_000
POINTS = np.tile([4.0, 0.0, -2.0], (5, 1))
HEADER = struct.Struct("<2sBBQQq")


@cache
def keyring(folder: Path, name: str) -> PairKeys:
    return load_keyring(SwarmOfHosts.of(folder).identity(name)).keys


@dataclass(frozen=True, kw_only=True)
class Folders:
    """Of the swarm as it is now; of bravo before it was revoked; of another swarm."""

    ours: Path
    revoked: Path
    theirs: Path


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Folders:
    made = Folders(**{name: tmp_path_factory.mktemp(name) for name in ("ours", "revoked", "theirs")})
    names = {"alpha": LOOPBACK, "bravo": LOOPBACK, "charlie": LOOPBACK, STATION: None}
    for folder in (made.ours, made.theirs):
        make_identities(folder, names)
    for file in made.ours.iterdir():
        (made.revoked / file.name).write_bytes(file.read_bytes())
        (made.revoked / file.name).chmod(0o600)
    revoke_identity(made.ours, "bravo")
    add_identity(made.ours, "bravo", LOOPBACK)
    return made


@dataclass
class Scene:
    """Agent 0 among two peers, and the intruder."""

    folders: Folders
    seals: bool = True
    clock: SimClock = field(default_factory=SimClock)
    heard: list[tuple[str, Topic, bytes]] = field(default_factory=list)  # by the intruder

    def __post_init__(self) -> None:
        swarm = SwarmOfHosts.of(self.folders.ours)
        self.roster = swarm.identity("alpha").roster
        self.hub = LocalHub(self.clock.now_us)
        keys = keyring(self.folders.ours, "alpha")
        listen = {
            **{topic: [VICTIM, OTHER] for topic in (PATH, STATUS, TRAJECTORY, RELAY)},
            COMMAND: [*self.roster.commanders("alpha")],
            ENDED: [*self.roster.hosts],
            OBSTACLES: ["alpha"],
        }
        bus = self.hub.connect(ME, listen)
        verifier = SealVerifier(self.roster, keys, RUN, me="alpha", max_age_us=FOR_AGENTS_US)
        if not self.seals:
            verifier.open = self.believe  # type: ignore[method-assign]
        self.bus = SealedBus(RelayingBus(bus, [1, 2]), Sealer(keys, RUN, ME, session=1), verifier, self.clock.utc_us)
        vouchers = {host: frozenset((number,)) for number, host in enumerate(self.roster.hosts)}
        self.world = WorldModel(
            0,
            [1, 2],
            SeparationParams(),
            self.bus,
            utc_us=lambda: self.now_us,
            rate_hz=RATE_HZ,
            path_s=0.02,
            note=lambda *_, **__: None,
            vouchers=vouchers,
            quorum=1,
            model=VehicleModelParams(),
        )
        refusals, presence = self.world.refusals, self.world.presence
        self.trajectories = PeerTrajectories([1, 2], RATE_HZ, refusals, presence, agent=0, clocks=self.world.clocks)
        self.victim = self.sealer("bravo", VICTIM, session=BOOT)
        self.numbers = {VICTIM: 0, OTHER: 0}
        self.believed: list[str] = []
        for _ in range(5):
            self.live()

    def believe(self, sender: str, topic: str, sealed: bytes, utc_us: int) -> tuple[bytes, str]:
        """Open a message without looking at its seal."""
        return sealed[overhead_bytes(self.roster) :], ""

    def sealer(self, identity: str, sender: str, folder: Path | None = None, session: int = 5) -> Sealer:
        return Sealer(keyring(folder or self.folders.ours, identity), RUN, sender, session=session)

    def live(self) -> None:
        """Let the victim speak, and agent 0 listen."""
        self.clock.advance(TICK_US)
        for topic, payload in ((PATH, self.path()), (STATUS, self.status()), (TRAJECTORY, self.trajectory())):
            self.carry(VICTIM, topic, self.victim.seal(topic.name, payload, self.now_us))
        self.listen()

    def carry(self, sender: str, topic: Topic, message: bytes) -> None:
        self.heard.append((sender, topic, message))
        self.hub.carry(sender, topic, message)

    def listen(self) -> None:
        self.clock.advance(TICK_US)
        orders = self.world.receive(self.now_us)
        self.believed = [order.verb for order in orders]
        for sender, payload in self.bus.receive(TRAJECTORY):
            self.trajectories.offer(sender, payload, self.now_us)
        self.world.receive(self.now_us)  # counts what was refused of these

    @property
    def now_us(self) -> int:
        return self.clock.utc_us()

    def number(self, agent: int) -> int:
        self.numbers[agent_name(agent)] += 1
        return self.numbers[agent_name(agent)]

    def path(self, agent: int = 1, boot_id: int = BOOT, **fields: int) -> bytes:
        of = {"agent": agent, "boot_id": boot_id, "seq": self.number(agent), "t0_utc_us": self.now_us, **fields}
        return encode_path(builders.predicted_path(pos_ned_m=POINTS, **of))

    def status(self, phase: Phase = Phase.TRACK, boot_id: int = BOOT) -> bytes:
        of = {"boot_id": boot_id, "ticks": self.number(1), "utc_us": self.now_us}
        return encode_message(msgspec.structs.replace(builders.status_message(agent=1, phase=phase), **of))

    def trajectory(self) -> bytes:
        standing, number = resting(POINTS[0], self.now_us, 100_000), self.number(1)
        return encode_trajectory_message(
            builders.trajectory_message(committed=standing, boot_id=BOOT, seq=number, sent_utc_us=self.now_us)
        )

    def order(self, verb: str, **arguments: float) -> bytes:
        return encode_message(CommandMessage(verb, -1, self.now_us, arguments))

    def knows(self) -> tuple[object, ...]:
        """Return everything that agent 0 believes of others."""
        obstacles = len(self.world.obstacles.listed)
        ended = tuple(self.world.statuses.has_ended(agent) for agent in (1, 2))
        newest = tuple((m.boot_id, m.seq) for m in self.trajectories.newest.values())
        paths = tuple((path.agent, path.boot_id, path.seq) for path in self.world.paths.latest())
        statuses = tuple((s.boot_id, s.ticks, s.phase) for s in self.world.statuses._newest.values())
        return (*self.believed, obstacles, ended, newest, paths, statuses)


Attack = Callable[[Scene], None]


def sealed_by(identity: str, sender: str, topic: Topic, payload: Callable[[Scene], bytes], of: str = "ours") -> Attack:
    """Say something under a name with the files of an identity."""

    def attack(scene: Scene) -> None:
        sealer = scene.sealer(identity, sender, getattr(scene.folders, of))
        scene.carry(sender, topic, sealer.seal(topic.name, payload(scene), scene.now_us))

    return attack


def plain(sender: str, topic: Topic, payload: Callable[[Scene], bytes]) -> Attack:
    """Say something without a seal, padded so that it would be understood by who does not look at seals."""
    return lambda scene: scene.carry(sender, topic, bytes(overhead_bytes(scene.roster)) + payload(scene))


def changed(change: Callable[[bytearray, Scene], None], topic: Topic = PATH, sender: str = VICTIM) -> Attack:
    """Hold back the victim's next message, and deliver it changed."""

    def attack(scene: Scene) -> None:
        payload = scene.path() if topic is PATH else scene.status()
        message = bytearray(scene.victim.seal(topic.name, payload, scene.now_us))
        change(message, scene)
        scene.carry(sender, topic, bytes(message))

    return attack


def _flip_payload(message: bytearray, scene: Scene) -> None:
    message[-1] ^= 0x01  # a coordinate, which stays finite


def _flip_number(message: bytearray, scene: Scene) -> None:
    message[12] ^= 0x01


def _flip_time(message: bytearray, scene: Scene) -> None:
    message[20] ^= 0x01


def _flip_session(message: bytearray, scene: Scene) -> None:
    message[4] ^= 0x01


def _swap_tags(message: bytearray, scene: Scene) -> None:
    message[HEADER.size : HEADER.size + TAG_BYTES] = message[HEADER.size + 2 * TAG_BYTES : HEADER.size + 3 * TAG_BYTES]


def _no_tags(message: bytearray, scene: Scene) -> None:
    message[HEADER.size : overhead_bytes(scene.roster)] = bytes(TAG_BYTES * len(scene.roster.speakers))


def _other_version(message: bytearray, scene: Scene) -> None:
    message[2] += 1


def _fewer_tags(message: bytearray, scene: Scene) -> None:
    message[3] -= 1


def _nothing(message: bytearray, scene: Scene) -> None:
    return


def _replayed(scene: Scene) -> None:
    for sender, topic, message in scene.heard[-3:]:
        scene.hub.carry(sender, topic, message)


def _reordered(scene: Scene) -> None:
    late = [scene.victim.seal(PATH.name, scene.path(), scene.now_us) for _ in range(3)]
    for message in (late[2], late[0], late[1]):
        scene.hub.carry(VICTIM, PATH, message)


def _recorded_before(scene: Scene) -> None:
    """The victim landed a minute ago, in an earlier process of which agent 0 has heard nothing."""
    sealer, then_us = scene.sealer("bravo", VICTIM, session=3), scene.now_us - MINUTE_US
    status = msgspec.json.decode(scene.status(Phase.DONE, boot_id=STRANGER))
    message = sealer.seal(STATUS.name, encode_status_at(status, then_us), then_us)
    for _ in range(2):
        scene.hub.carry(VICTIM, STATUS, message)


def encode_status_at(status: dict[str, object], utc_us: int) -> bytes:
    return msgspec.json.encode(status | {"utc_us": utc_us})


def _from_the_future(scene: Scene) -> None:
    sealer, then_us = scene.sealer("bravo", VICTIM, session=3), scene.now_us + MINUTE_US
    scene.hub.carry(VICTIM, PATH, sealer.seal(PATH.name, scene.path(boot_id=STRANGER), then_us))


def _flood(scene: Scene) -> None:
    """A second of 10,000 messages a second."""
    for _ in range(50):
        sealer, path = scene.sealer("charlie", VICTIM), scene.path()
        for _ in range(200):
            scene.hub.carry(VICTIM, PATH, sealer.seal(PATH.name, path, scene.now_us))
        scene.listen()


def _other_run(scene: Scene) -> None:
    sealer = Sealer(keyring(scene.folders.ours, "bravo"), "another run", VICTIM, session=5)
    scene.hub.carry(VICTIM, PATH, sealer.seal(PATH.name, scene.path(), scene.now_us))


def _many_obstacles(scene: Scene) -> bytes:
    ball = Obstacle(center_ned_m=(5.0, 0.0, -2.0), radius_m=0.5, keep_out_m=1.0, visibility_m=100.0)
    return encode_message(first_list([ball] * 6000, scene.now_us))


def _ball(scene: Scene) -> bytes:
    ball = Obstacle(center_ned_m=(5.0, 0.0, -2.0), radius_m=0.5, keep_out_m=1.0, visibility_m=100.0)
    return encode_message(first_list([ball], scene.now_us))


def path_of(agent: int, **of: int) -> Callable[[Scene], bytes]:
    return lambda scene: scene.path(agent, **of)


def says(verb: str, **arguments: float) -> Callable[[Scene], bytes]:
    return lambda scene: scene.order(verb, **arguments)


def done(scene: Scene) -> bytes:
    return scene.status(Phase.DONE)


def ended(agent: int) -> Callable[[Scene], bytes]:
    return lambda scene: encode_message(EndedMessage(agent=agent, boot_id=BOOT, is_down=False))


def trajectory(scene: Scene) -> bytes:
    return scene.trajectory()


def megabytes(scene: Scene) -> bytes:
    return bytes(3_000_000)


@dataclass(frozen=True, kw_only=True)
class Row:
    attack: Attack
    reasons: set[str]
    by_seal: bool = True  # would be believed without seals


ROWS = {
    "path without a seal": Row(attack=plain(VICTIM, PATH, path_of(1)), reasons={"unsealed"}),
    "status without a seal": Row(attack=plain(VICTIM, STATUS, done), reasons={"unsealed"}),
    "land without a seal": Row(attack=plain(STATION, COMMAND, says("land")), reasons={"unsealed"}),
    "obstacles without a seal": Row(attack=plain("alpha", OBSTACLES, _ball), reasons={"unsealed"}),
    "cut off within the seal": Row(
        attack=lambda scene: scene.hub.carry(VICTIM, PATH, scene.heard[-1][2][:40]), reasons={"unsealed"}, by_seal=False
    ),
    "seal of another version": Row(attack=changed(_other_version), reasons={"unsealed"}),
    "seal for another roster": Row(attack=changed(_fewer_tags), reasons={"unsealed"}),
    "a legal host as another's agent": Row(attack=sealed_by("charlie", VICTIM, PATH, path_of(1)), reasons={"forged"}),
    "its status": Row(attack=sealed_by("charlie", VICTIM, STATUS, done), reasons={"forged"}),
    "its trajectory": Row(attack=sealed_by("charlie", VICTIM, TRAJECTORY, trajectory), reasons={"forged"}),
    "a boot of a peer, new": Row(
        attack=sealed_by("charlie", VICTIM, PATH, path_of(1, boot_id=STRANGER)), reasons={"forged"}, by_seal=False
    ),
    "land by a host of agents": Row(attack=sealed_by("charlie", STATION, COMMAND, says("land")), reasons={"forged"}),
    "hold as this host": Row(attack=sealed_by("charlie", "alpha", COMMAND, says("hold")), reasons={"forged"}),
    "obstacles as this host": Row(attack=sealed_by("charlie", "alpha", OBSTACLES, _ball), reasons={"forged"}),
    "end of an agent, as its host": Row(attack=sealed_by("charlie", "bravo", ENDED, ended(1)), reasons={"forged"}),
    "end of another's agent": Row(
        attack=sealed_by("bravo", "bravo", ENDED, ended(2)), reasons={"identity"}, by_seal=False
    ),
    "land among ends of agents": Row(
        attack=sealed_by("bravo", "bravo", ENDED, says("land")), reasons={"malformed"}, by_seal=False
    ),
    "a revoked identity": Row(attack=sealed_by("bravo", VICTIM, PATH, path_of(1), "revoked"), reasons={"forged"}),
    "a revoked operator": Row(attack=sealed_by("bravo", STATION, COMMAND, says("land"), "revoked"), reasons={"forged"}),
    "another authority": Row(attack=sealed_by("bravo", VICTIM, PATH, path_of(1), "theirs"), reasons={"forged"}),
    "another authority's station": Row(
        attack=sealed_by(STATION, STATION, COMMAND, says("land"), "theirs"), reasons={"forged"}
    ),
    "a changed position": Row(attack=changed(_flip_payload), reasons={"forged"}),
    "a changed number": Row(attack=changed(_flip_number), reasons={"forged"}),
    "a changed time": Row(attack=changed(_flip_time), reasons={"forged"}),
    "a changed session": Row(attack=changed(_flip_session), reasons={"forged"}),
    "the tag for another host": Row(attack=changed(_swap_tags), reasons={"forged"}),
    "no tags": Row(attack=changed(_no_tags), reasons={"forged"}),
    "moved to another agent": Row(attack=changed(_nothing, sender=OTHER), reasons={"forged"}, by_seal=False),
    "moved to another topic": Row(
        attack=lambda scene: scene.hub.carry(VICTIM, PATH, scene.victim.seal(STATUS.name, scene.path(), scene.now_us)),
        reasons={"forged"},
    ),
    "moved from another run": Row(attack=_other_run, reasons={"forged"}),
    "repeated": Row(attack=_replayed, reasons={"replayed"}, by_seal=False),
    "reordered": Row(attack=_reordered, reasons={"replayed"}, by_seal=False),
    "recorded before": Row(attack=_recorded_before, reasons={"late", "replayed"}, by_seal=False),
    "from the future": Row(attack=_from_the_future, reasons={"future"}, by_seal=False),
    "about another agent, in the own name": Row(
        attack=sealed_by("charlie", OTHER, PATH, path_of(1)), reasons={"identity"}, by_seal=False
    ),
    "a path of a million points a second": Row(
        attack=lambda scene: scene.carry(VICTIM, PATH, scene.victim.seal(PATH.name, scene.path(dt_us=1), scene.now_us)),
        reasons={"malformed"},
        by_seal=False,
    ),
    "3 MB": Row(attack=sealed_by("charlie", OTHER, PATH, megabytes), reasons={"malformed"}, by_seal=False),
    "6000 obstacles": Row(
        attack=sealed_by("alpha", "alpha", OBSTACLES, _many_obstacles), reasons={"malformed"}, by_seal=False
    ),
    "10,000 messages a second": Row(attack=_flood, reasons={"forged"}),
}


@pytest.mark.parametrize("name", ROWS)
def test_an_intruder_is_not_believed_but_counted_and_locks_nobody_out(name: str, folders: Folders) -> None:
    row, scene = ROWS[name], Scene(folders)
    if name == "reordered":
        row.attack(scene)
        scene.listen()
        assert scene.world.paths.latest()[0].seq == scene.numbers[VICTIM], "the newest of them"
    else:
        before = scene.knows()
        row.attack(scene)
        scene.listen()
        assert scene.knows() == before
    assert {reason for reason, count in scene.world.refusals.by_reason.items() if count} <= row.reasons
    assert scene.world.refusals.total > 0
    before = scene.knows()
    scene.live()
    assert scene.knows() != before, "the true sender is heard on"
    (path,) = scene.world.paths.latest()
    assert path.boot_id == BOOT


@pytest.mark.parametrize("name", [name for name, row in ROWS.items() if row.by_seal])
def test_negative_control_without_seals_the_intruder_is_believed(name: str, folders: Folders) -> None:
    scene = Scene(folders, seals=False)
    before = scene.knows()
    ROWS[name].attack(scene)
    scene.listen()
    assert scene.knows() != before


@pytest.mark.parametrize(
    ("identity", "believed"), [("bravo", True), ("charlie", False)], ids=["its own seal", "control: the relay's"]
)
def test_what_is_relayed_is_opened_by_the_seal_of_who_has_said_it(
    folders: Folders, identity: str, believed: bool
) -> None:
    scene = Scene(folders)
    before = scene.trajectories.newest[1].seq
    carried = scene.sealer(identity, VICTIM).seal(TRAJECTORY.name, scene.trajectory(), scene.now_us)
    scene.carry(OTHER, RELAY, encode_relay([(1, carried)]))
    scene.listen()
    assert (scene.trajectories.newest[1].seq > before) is believed
    assert bool(scene.world.refusals.by_reason) is not believed


def test_what_a_slower_relay_delivers_is_no_replay(folders: Folders) -> None:
    scene = Scene(folders)
    late = scene.victim.seal(TRAJECTORY.name, scene.trajectory(), scene.now_us)
    scene.live()
    scene.carry(OTHER, RELAY, encode_relay([(1, late)]))
    scene.listen()
    assert not scene.world.refusals.by_reason


def test_what_the_carrier_of_sealed_messages_has_refused_is_counted(
    folders: Folders, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = Scene(folders)
    carrier = type(scene.hub.connect("agent-9", {}))
    monkeypatch.setattr(carrier, "refused", lambda _: [RefusedMessage(VICTIM, PATH.name, MISDELIVERED)])
    assert scene.bus.refused() == [RefusedMessage(VICTIM, PATH.name, MISDELIVERED)]
    scene.listen()
    assert set(scene.world.refusals.by_reason) == {MISDELIVERED}
