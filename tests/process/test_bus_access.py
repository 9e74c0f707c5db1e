"""Routers of several hosts: what the holder of one identity can bring to the others, and that access control stops it.

Charlie is the intruder: its router obeys no access control, and its clients say anything under any name.
"""

from __future__ import annotations

import socket
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path

import pytest

from sitl.studies.bench.free_ports import free_ports
from swarmctl.bus.bus import Bus
from swarmctl.bus.network.datagram_links import bind_datagrams, datagram_address
from swarmctl.bus.network.datagram_routes import DatagramRoutes
from swarmctl.bus.network.hosts import links_of
from swarmctl.bus.network.identities import add_identity, make_identities, revoke_identity
from swarmctl.bus.network.identity_files import STATION
from swarmctl.bus.network.joining import join_bus
from swarmctl.bus.network.keyring import load_keyring
from swarmctl.bus.network.router import run_router
from swarmctl.bus.network.sealed_bus import FOR_AGENTS_US
from swarmctl.bus.topics import COMMAND, ENDED, EVENT, MISSION, OBSTACLES, PATH, STATUS, Topic
from swarmctl.bus.zenoh.bus import ZenohBus
from swarmctl.bus.zenoh.client import SCHEME
from swarmctl.errors import StartError
from tests.benches.swarm_of_hosts import LOOPBACK, LOOPBACK_6, Ip, SwarmOfHosts

pytestmark = pytest.mark.process

AGENTS = ("agent-0", "agent-1", "agent-2")
SAID = (
    *((name, PATH) for name in AGENTS),
    *((name, EVENT) for name in ("agent-1", "agent-2")),
    *((name, COMMAND) for name in ("alpha", "bravo", "charlie", STATION)),
    *((name, ENDED) for name in ("bravo", "charlie")),
    *((name, topic) for name in ("alpha", "charlie") for topic in (MISSION, OBSTACLES)),
)
OPEN = "import swarmctl.bus.network.router_links as links; links.access_settings = lambda *_: {}\n"
RUN = "from swarmctl.bus.network.router import main\nraise SystemExit(main())"
ROGUE = ("-c", OPEN + RUN)
MUTE = (
    "import swarmctl.bus.network.datagram_links as carried\n"
    "carried.DatagramLinks._send = carried.DatagramLinks._publish = lambda *_: None\n"
)
HASTY = "import swarmctl.bus.network.datagram_links as links; links._MISSED_S = links._LOOKED_EVERY_S = 0.5\n"
WITHOUT_DATAGRAMS = ("-c", MUTE + RUN)
ROGUE_WITHOUT_DATAGRAMS = ("-c", OPEN + MUTE + RUN)
OF_BRAVO = {("bravo", "agent-1", "path"), ("bravo", "agent-1", "event"), ("bravo", "bravo", "ended")}
LINK_S = 1.5
WAIT_S = 20.0

Heard = set[tuple[str, str, str]]  # where it was said, as whom, topic


@pytest.fixture
def swarm(tmp_path: Path) -> SwarmOfHosts:
    return new_swarm(tmp_path)


def new_swarm(folder: Path, *, relay: bool = False, at: Ip = LOOPBACK) -> SwarmOfHosts:
    make_identities(folder, {"alpha": at, "bravo": at, "charlie": at, STATION: None})
    return SwarmOfHosts.of(folder, free_ports(3), relay=relay, at=at)


def has(ip: Ip) -> bool:
    """Return whether this computer has an address."""
    with socket.socket(socket.AF_INET6 if ip.version == 6 else socket.AF_INET, socket.SOCK_DGRAM) as sock:
        try:
            sock.bind((str(ip), 0))
        except OSError:
            return False
    return True


@contextmanager
def routers(
    swarm: SwarmOfHosts,
    *,
    lawless: tuple[str, ...] = ("charlie",),
    rogue: tuple[str, ...] = ROGUE,
    stolen: Path | None = None,
) -> Iterator[None]:
    """Run the three routers; those of `lawless` are `rogue` ones, charlie has the files of `stolen`."""
    with ExitStack() as stack:
        for host in swarm.hosts:
            options = rogue if host.name in lawless else ()
            folder = stolen if host.name == "charlie" else None
            stack.enter_context(swarm.router(host.name, *options, folder=folder))
        yield


def what_is_heard(swarm: SwarmOfHosts, by: tuple[str, ...], *, waits_for: dict[str, Heard]) -> dict[str, Heard]:
    """Return what listeners on alpha and bravo hear, of everything that clients on the hosts of `by` say.

    Links take their time on a machine under load. So all is said until what is waited for is heard, and `LINK_S` more.
    """
    listen: dict[Topic, list[str]] = {}
    for sender, topic in SAID:
        listen.setdefault(topic, []).append(sender)
    ears = {at: swarm.plain(at, "ear", listen) for at in ("alpha", "bravo")}
    mouths = {(at, sender): swarm.plain(at, sender) for at in by for sender in {sender for sender, _ in SAID}}
    heard: dict[str, Heard] = {at: set() for at in ears}
    begun_s = heard_s = time.monotonic()
    while time.monotonic() < min(heard_s + LINK_S, begun_s + WAIT_S):
        for (at, sender), mouth in mouths.items():
            for topic in (topic for name, topic in SAID if name == sender):
                mouth.publish(topic, at.encode())
        time.sleep(0.1)
        for at, ear in ears.items():
            for topic in listen:
                heard[at] |= {(said.decode(), sender, topic.name) for sender, said in ear.receive(topic)}
        if not all(expected <= heard[at] for at, expected in waits_for.items()):
            heard_s = time.monotonic()
    for bus in (*ears.values(), *mouths.values()):
        bus.close()
    return heard


@pytest.mark.parametrize(
    "at", [LOOPBACK, pytest.param(LOOPBACK_6, marks=pytest.mark.skipif(not has(LOOPBACK_6), reason="no IPv6"))], ids=str
)
def test_an_identity_brings_what_is_its_own_only(at: Ip, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    swarm = new_swarm(tmp_path, at=at)
    own = {("charlie", "agent-2", "path"), ("charlie", "agent-2", "event"), ("charlie", "charlie", "ended")}
    kept = {("charlie", "charlie", "obstacles")}  # by which alpha, an operator's, knows what charlie keeps clear of
    operators = {("alpha", "alpha", topic) for topic in ("command", "mission", "obstacles")}
    of_alpha = {("alpha", "agent-0", "path"), *operators}
    expected = {"alpha": {*own, *kept, *OF_BRAVO}, "bravo": {*own, *of_alpha}}
    with routers(swarm):
        heard = what_is_heard(swarm, ("alpha", "bravo", "charlie"), waits_for=expected)
    assert {said for said in heard["alpha"] if said[0] == "charlie"} == own | kept
    assert {said for said in heard["bravo"] if said[0] == "charlie"} == own
    assert {said for said in heard["bravo"] if said[0] == "alpha"} == of_alpha, "it has an operator's identity"
    assert {said for said in heard["alpha"] if said[0] == "alpha"} == of_alpha, "nor do clients on the host itself"
    assert {said for said in heard["alpha"] if said[0] == "bravo"} == OF_BRAVO, "it has none"
    assert "no link" not in capfd.readouterr().err


def test_a_router_says_whose_datagrams_come_without_a_link(
    swarm: SwarmOfHosts, capfd: pytest.CaptureFixture[str]
) -> None:
    """As where a firewall lets one of the two ports pass."""
    alone = "import swarmctl.bus.network.router as router; router.link_endpoint = lambda _: 'quic/127.0.0.1:0'\n"
    said, deadline_s = "", time.monotonic() + WAIT_S
    with swarm.router("alpha", "-c", alone + HASTY + RUN), swarm.router("bravo", "-c", HASTY + RUN):
        while not ("alpha: " in said and "bravo: " in said) and time.monotonic() < deadline_s:
            time.sleep(0.1)
            said += capfd.readouterr().err
    assert "alpha: its datagrams come" in said and "bravo: its datagrams come" in said
    assert "charlie" not in said, "it is off"


def test_negative_control_without_access_control_it_brings_anything(swarm: SwarmOfHosts) -> None:
    everything = {("charlie", sender, topic.name) for sender, topic in SAID}
    with routers(swarm, lawless=("alpha", "bravo", "charlie")):
        heard = what_is_heard(swarm, ("charlie",), waits_for={"alpha": everything, "bravo": everything})
    assert heard == {"alpha": everything, "bravo": everything}


def test_who_relays_passes_on_what_others_say(tmp_path: Path) -> None:
    swarm = new_swarm(tmp_path, relay=True)
    said = {("charlie", "bravo", "ended"), ("charlie", "agent-2", "path")}
    with routers(swarm):
        heard = what_is_heard(swarm, ("charlie",), waits_for={"alpha": said})
    assert said <= heard["alpha"], "seals alone tell that bravo has not said it"
    assert ("charlie", "agent-1", "path") not in heard["alpha"], "datagrams are not passed on in another's name"


def test_links_of_routers_do_not_carry_what_may_be_lost(swarm: SwarmOfHosts) -> None:
    """A link that waits for lost frames would bring paths seconds late."""
    of_bravo = {("bravo", "bravo", "ended"), ("bravo", "agent-1", "event")}
    of_alpha = {("alpha", "alpha", "command")}
    with routers(swarm, lawless=("bravo",), rogue=WITHOUT_DATAGRAMS):
        heard = what_is_heard(swarm, ("alpha", "bravo"), waits_for={"alpha": of_bravo, "bravo": of_alpha})
    assert {said for said in heard["alpha"] if said[0] == "bravo"} == of_bravo
    assert {topic for at, _, topic in heard["bravo"] if at == "alpha"} == {"command", "mission", "obstacles"}


def test_a_router_whose_port_for_datagrams_is_taken_says_which(swarm: SwarmOfHosts) -> None:
    port = int(swarm.hosts[0].address.rpartition(":")[2]) + 1
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", port))
        links = links_of(swarm.hosts, swarm.identity("alpha"))
        with pytest.raises(StartError, match=rf"127\.0\.0\.1 port {port}: .*in use.*port after that of the host"):
            run_router(f"{SCHEME}{tempfile.mkdtemp(prefix='sw')}/bus.sock", links)


def test_a_router_says_whom_it_hears_while_it_hears_much(swarm: SwarmOfHosts) -> None:
    """One that has nothing else to say, as a station's, said so every 256 datagrams: others did not relay to it."""
    identity = swarm.identity("bravo")
    addresses = {host.name: datagram_address(host.address) for host in swarm.hosts}
    bravo = DatagramRoutes(identity.roster, "bravo", load_keyring(identity).keys, addresses, session=1)
    heard_s = list[float]()
    with swarm.router("alpha"), closing(bind_datagrams(identity)) as sock:
        sock.settimeout(0.004)
        begun_s = time.monotonic()
        while (now_s := time.monotonic()) < begun_s + 3.0:
            for datagram, address in (*bravo.beat(now_s), *bravo.send("run/agent-1/path", b"path", now_s)):
                sock.sendto(datagram, address)
            with suppress(OSError):
                datagram, _ = sock.recvfrom(65_536)
                bravo.take(datagram, addresses["alpha"], time.monotonic())
                heard_s.append(time.monotonic())
    assert len([at_s for at_s in heard_s if at_s > begun_s + 1.0]) >= 10, "ten times a second, answers not counted"


def test_a_revoked_identity_has_a_link_and_no_rights(
    swarm: SwarmOfHosts, tmp_path_factory: pytest.TempPathFactory
) -> None:
    stolen = tmp_path_factory.mktemp("stolen")
    for file in swarm.folder.iterdir():
        (stolen / file.name).write_bytes(file.read_bytes())
        (stolen / file.name).chmod(0o600)
    revoke_identity(swarm.folder, "charlie")
    add_identity(swarm.folder, "charlie", LOOPBACK)
    with routers(swarm, stolen=stolen):
        heard = what_is_heard(swarm, ("bravo", "charlie"), waits_for={"alpha": OF_BRAVO})
        ear, mouth = swarm.plain("charlie", "ear", {PATH: ["agent-1"]}), swarm.plain("bravo", "agent-1")
        for _ in range(50):
            mouth.publish(PATH, b"path")
            time.sleep(0.02)
        assert ear.receive(PATH) == [], "it hears nothing either"
        assert ear.alive() - {"ear"} <= set(AGENTS[2:]), "and sees none of the others' tokens"
    assert not {said for at in heard for said in heard[at] if said[0] == "charlie"}
    assert ("bravo", "agent-1", "path") in heard["alpha"], "the others are heard: this can fail"


def sealed(swarm: SwarmOfHosts, at: str, sender: str, folder: Path | None = None) -> Bus:
    listen = {topic: [name for name in AGENTS if name != sender] for topic in (PATH, STATUS)}
    return join_bus(
        swarm.endpoint(at),
        "run",
        sender,
        listen,
        identity=swarm.identity(at, folder),
        max_age_us=FOR_AGENTS_US,
        utc_us=lambda: time.time_ns() // 1000,
    )


def test_sealed_messages_pass_between_hosts_and_plain_ones_are_counted(swarm: SwarmOfHosts) -> None:
    with routers(swarm, lawless=("alpha", "bravo", "charlie"), rogue=ROGUE_WITHOUT_DATAGRAMS):
        alpha, bravo = sealed(swarm, "alpha", "agent-0"), sealed(swarm, "bravo", "agent-1")
        forger: ZenohBus = swarm.plain("charlie", "agent-1")
        heard, refused = set[tuple[str, bytes]](), set[tuple[str, str, str]]()
        deadline_s = time.monotonic() + WAIT_S
        while not (heard and refused) and time.monotonic() < deadline_s:
            bravo.publish(PATH, b"true")
            forger.publish(PATH, b"false")
            time.sleep(0.05)
            heard |= set(alpha.receive(PATH))
            refused |= set(alpha.refused())
        assert heard == {("agent-1", b"true")}
        assert refused == {("agent-1", "path", "unsealed")}
        for bus in (alpha, bravo, forger):
            bus.close()


def test_routers_pass_no_message_on_that_came_under_the_key_of_another_one(
    swarm: SwarmOfHosts, monkeypatch: pytest.MonkeyPatch
) -> None:
    with swarm.router("alpha"), swarm.router("bravo"):
        mouth, ear = swarm.plain("alpha", "agent-0"), swarm.plain("bravo", "ear", {PATH: ["agent-0"]})
        heard: set[bytes] = set()

        def say_until_heard(message: bytes) -> None:
            deadline_s = time.monotonic() + WAIT_S
            while message not in heard and time.monotonic() < deadline_s:
                mouth.publish(PATH, message)
                time.sleep(0.05)
                heard.update(said for _, said in ear.receive(PATH))

        say_until_heard(b"first")
        with monkeypatch.context() as confused:
            confused.setattr(mouth._session._now.publishers["agent-0"][PATH], "_mark", b"of another")
            for _ in range(5):
                mouth.publish(PATH, b"confused")
        say_until_heard(b"last")
        assert heard == {b"first", b"last"}
        for bus in (mouth, ear):
            bus.close()


def test_routers_link_with_those_of_their_own_authority_only(
    swarm: SwarmOfHosts, tmp_path_factory: pytest.TempPathFactory
) -> None:
    theirs = tmp_path_factory.mktemp("theirs")
    new_swarm(theirs)
    with routers(swarm, lawless=("alpha", "bravo", "charlie"), stolen=theirs):
        heard = what_is_heard(swarm, ("bravo", "charlie"), waits_for={"alpha": OF_BRAVO})
    assert not {said for at in heard for said in heard[at] if said[0] == "charlie"}
    assert ("bravo", "agent-1", "path") in heard["alpha"]
