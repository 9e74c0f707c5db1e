"""Tests `[[hosts]]` and the identities of hosts."""

from __future__ import annotations

import errno
import stat
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from cryptography.x509 import load_pem_x509_crl

from swarmctl.bus.network import identities
from swarmctl.bus.network.datagram_links import bind_datagrams
from swarmctl.bus.network.hosts import HostParams, host_problems, links_of
from swarmctl.bus.network.identity_files import STATION
from swarmctl.bus.network.keyring import load_keyring
from swarmctl.config import load, own_identity
from swarmctl.errors import ConfigError, StartError
from swarmctl.files import create_private
from swarmctl.ops.cli import main
from swarmctl.ops.flight.host import (
    add_host_identity,
    load_host,
    make_host_identities,
    revoke_host_identity,
    shared_run_name,
    systemd_unit,
)

ROOT = Path(__file__).parents[3]
CONFIG = ROOT / "configs" / "three_hosts.toml"
ALPHA = "hosts.0."
NOWHERE = ("0.0.0.0", "224.0.0.1", "[::]", "[ff02::1]", "[fe80::1%eth0]")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """The shipped configuration, in a folder of its own."""
    copied = tmp_path / CONFIG.name
    copied.write_text(CONFIG.read_text())
    return copied


@pytest.mark.parametrize(
    ("item", "words"),
    [
        (ALPHA + "agents=[0]", "agents [1] run nowhere"),
        (ALPHA + "agents=[0,1,2]", "agent 2 runs at 2 hosts"),
        (ALPHA + "agents=[0,1,6]", "there are no agents [6]"),
        (ALPHA + "agents=[0,5]", "list numbers without gaps"),
        (ALPHA + "agents=[]", "hosts.0.agents"),
        (ALPHA + "address='10.20.0.2:7448'", "given 2 times"),
        (ALPHA + "address='10.20.0.1'", "write IP:PORT"),
        (ALPHA + "address='example.org:7448'", "write IP:PORT"),
        (ALPHA + "address='10.20.0.1:70000'", "write IP:PORT"),
        (ALPHA + "address='10.20.0.1:65535'", "no port from 1 to 65534"),
        (ALPHA + "address='10.20.0.2:7447'", "port 7448 of 10.20.0.2 is bravo's and that of datagrams to alpha"),
        (ALPHA + "address='[fd00::1]:7448'", "use one kind for all"),
        (ALPHA + "address='10.20.0.2:07448'", "address '10.20.0.2:7448' is given 2 times"),
        (ALPHA + "address='[10.20.0.1]:7448'", "an IPv6 address is in brackets, an IPv4 address is not"),
        (ALPHA + "address='[10.20.0.1:7448'", "write IP:PORT"),
        (ALPHA + "address='fd00::1:7448'", "an IPv6 address is in brackets, an IPv4 address is not"),
        *((ALPHA + f"address='{ip}:7448'", "not the address of one computer") for ip in NOWHERE),
        (ALPHA + "name='bravo'", "given 2 times"),
        (ALPHA + "name='station'", "reserved"),
        (ALPHA + "name='a/b'", "hosts.0.name"),
    ],
)
def test_what_is_no_list_of_hosts_is_refused(item: str, words: str) -> None:
    with pytest.raises(ConfigError) as refused:
        load(CONFIG, [item])
    assert words in str(refused.value)


def test_more_hosts_than_datagrams_can_tell_of_are_refused() -> None:
    hosts = [HostParams(name=f"h{i}", address=f"10.0.0.{i + 1}:7448", agents=(i,)) for i in range(64)]
    assert not list(host_problems(hosts[:63], 63))
    assert any("largest allowed: 63" in problem for problem in host_problems(hosts, 64))


def test_an_address_of_another_computer_is_named() -> None:
    config = load(CONFIG, [ALPHA + "address='192.0.2.1:7448'"])  # of documentation: of no computer
    with pytest.raises(StartError, match=r"192\.0\.2\.1 port 7449: .*no such address; correct that of alpha in \[\[h"):
        bind_datagrams(own_identity(config, "alpha"))


def with_devices(*devices: str) -> list[str]:
    """Return overrides by which the six vehicles of three hosts are at these devices, in turn on each host."""
    links = ",".join(f'{{sysid={i + 1},url="serial:///dev/{devices[i % 2]}:921600"}}' for i in range(6))
    return ["sitl.enabled=false", f"vehicles=[{links}]"]


def test_each_host_has_devices_of_its_own() -> None:
    assert len(load(CONFIG, with_devices("ttyACM0", "ttyACM1"), only_agents=()).vehicles) == 6
    with pytest.raises(ConfigError, match=r"vehicles\.1\.url.*same port as vehicles\.0"):
        load(CONFIG, with_devices("ttyACM0", "ttyACM0"), only_agents=())


def test_there_is_one_link_for_each_pair_of_hosts_and_the_station_has_one_to_each() -> None:
    config = load(CONFIG)
    hosts = config.hosts
    addresses = [host.address for host in hosts]
    for i, host in enumerate(hosts):
        links = links_of(hosts, own_identity(config, host.name))
        assert (links.listen, list(links.connect)) == (addresses[i], addresses[:i])
    links = links_of(hosts, own_identity(config, STATION))
    assert (links.listen, list(links.connect)) == ("", addresses)


def test_the_name_of_the_run_follows_from_what_is_flown(path: Path) -> None:
    name = shared_run_name(load(path))
    assert shared_run_name(load(CONFIG)) == name, "folders differ from computer to computer"
    assert shared_run_name(load(path, ["swarm.agents_per_process=2"])) == name, "so may how agents share processes"
    assert shared_run_name(load(path, ["separation.radius_m=1.0"])) != name
    assert shared_run_name(load(path, ["mission.swap.travel_s=9"])) != name


def test_identities_are_made_once_and_for_hosts_that_are_added(path: Path) -> None:
    folder, made = make_host_identities(path)
    assert made == ["alpha", "bravo", "charlie", "station"]
    assert {stat.S_IMODE(file.stat().st_mode) for file in folder.iterdir()} == {0o600}
    before = (folder / "alpha.pem").read_bytes()
    (folder / "charlie.pem").unlink()
    (folder / "charlie.key").unlink()
    assert make_host_identities(path)[1] == ["charlie"]
    assert (folder / "alpha.pem").read_bytes() == before
    with pytest.raises(ConfigError, match=r"alpha: another address now; swarmctl keys revoke it"):
        make_host_identities(path, [ALPHA + "address='10.20.0.9:7448'"])
    (folder / "authority.key").unlink()
    with pytest.raises(ConfigError, match=r"authority\.key is not here"):
        make_host_identities(path)


@pytest.mark.parametrize("file", ["authority.pem", "alpha.pem"])
@pytest.mark.parametrize("cut_off", [False, True])
def test_identities_are_made_after_a_disk_was_full_between_key_and_certificate(
    path: Path, monkeypatch: pytest.MonkeyPatch, file: str, cut_off: bool
) -> None:
    """What is left by a process that was killed there is a key that nobody has a certificate for."""

    def full(made: Path, content: bytes) -> None:
        if made.name == file:
            raise OSError(errno.ENOSPC, "No space left on device", str(made))
        create_private(made, content)

    with monkeypatch.context() as patch:
        patch.setattr(identities, "create_private", full)
        with pytest.raises(StartError, match="No space left"):
            make_host_identities(path)
    folder = own_identity(load(path), STATION).folder
    assert not list(Path(folder).glob("*.key")) if file == "authority.pem" else not Path(folder, "alpha.key").exists()
    if cut_off and file != "authority.pem":
        Path(folder, "alpha.key").write_bytes(b"of nobody")
    make_host_identities(path)
    load_keyring(own_identity(load(path), "alpha"))


def test_a_host_flies_only_with_an_identity(path: Path) -> None:
    with pytest.raises(ConfigError, match=r"bus.identities: .*authority.pem.*swarmctl keys init"):
        load_host(path, [2, 3])
    folder, _ = make_host_identities(path)
    config, host = load_host(path, [3, 2])
    assert (host.name, config.simulator(host.agents).vehicles) == ("bravo", 2)
    (folder / "bravo.key").chmod(0o644)
    with pytest.raises(ConfigError, match=r"bravo\.key"):
        load_host(path, [2, 3])
    with pytest.raises(ConfigError, match="the configuration lists none; a swarm on one computer flies by: swarmctl l"):
        load_host(CONFIG.with_name("px4_udp.toml"), [0])
    with pytest.raises(ConfigError, match=r"no host has just agents \[2\]; hosts of .*bravo: 2,3"):
        load_host(path, [2])
    with pytest.raises(ConfigError, match=r"bus\.identities: not set"):
        load_host(path, [2, 3], ["bus.identities=''"])


def test_an_obstacle_that_moves_has_no_common_start_on_several_hosts(path: Path) -> None:
    make_host_identities(path)
    with pytest.raises(ConfigError, match=r"obstacles: one moves"):
        load_host(path, [2, 3], ["obstacles=[{center_ned_m=[9,0,0],radius_m=0.5,vel_ned_m_s=[1,0,0]}]"])
    assert load_host(path, [2, 3], ["obstacles=[{center_ned_m=[9,0,0],radius_m=0.5}]"])[0].obstacles


def test_a_host_simulates_its_own_vehicles_by_their_numbers() -> None:
    fault = "sitl.faults=[{kind='gps_loss',vehicle=3},{kind='gps_loss',vehicle=0},{kind='mass',value=1.1}]"
    config = load(CONFIG, [fault])
    simulated = config.simulator((2, 3))
    assert (simulated.first_vehicle, simulated.sysid_base, simulated.vehicles) == (2, 3, 2)
    assert simulated.spawns_ned_m() == config.simulator().spawns_ned_m()[2:4]
    assert [fault.vehicle for fault in simulated.faults] == [3, -1]


def test_the_unit_lands_when_it_is_stopped_and_does_not_fly_at_boot(path: Path) -> None:
    make_host_identities(path)
    unit = systemd_unit(path, load_host(path, [2, 3])[1])
    assert f"host --config {path} --agents 2,3" in unit
    assert {"KillSignal=SIGINT", "Restart=no"} <= set(unit.splitlines())
    assert "\n[Install]" not in unit


def test_the_unit_sets_what_was_set(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    make_host_identities(path)
    sets = ["agent.rate_hz=25", r"""name='50%-$HOME \d "x"'"""]
    print(systemd_unit(path, load_host(path, [2, 3])[1], sets))
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("ExecStart=")]
    assert line.endswith(r"""--agents 2,3 --set=agent.rate_hz=25 "--set=name='50%%-$$HOME \\d \"x\"'" """.rstrip())
    monkeypatch.setattr(sys, "argv", ["swarmctl", "host", "--config", str(path), "--agents", "2,3", "--print-unit"])
    sys.argv += ["--set", sets[0]]
    with pytest.raises(SystemExit, match=r"^0$"):
        main()
    assert "--agents 2,3 --set=agent.rate_hz=25\n" in capsys.readouterr().out
    sys.argv += ["--run-dir", "runs/mine"]
    with pytest.raises(SystemExit, match=r"^2$"):
        main()
    assert "--run-dir: a unit is started more than once" in capsys.readouterr().err


def test_a_revoked_identity_is_refused_until_the_host_has_a_new_one(path: Path) -> None:
    folder, _ = make_host_identities(path)
    assert load_host(path, [2, 3])
    with pytest.raises(ConfigError, match=r"charlie has an identity; swarmctl keys revoke it first"):
        add_host_identity(path, "charlie")
    stolen = {name: (folder / name).read_bytes() for name in ("charlie.pem", "charlie.key")}
    assert revoke_host_identity(path, "charlie") == folder / "revoked.pem"
    for name, content in stolen.items():  # as on every other host, which has the list and still its certificate
        create_private(folder / name, content)
    with pytest.raises(ConfigError, match=r"charlie\.pem: is revoked; give charlie a new identity"):
        load_host(path, [2, 3])
    add_host_identity(path, "charlie")
    assert load_host(path, [4, 5])
    revoke_host_identity(path, "charlie")
    assert make_host_identities(path)[1] == ["charlie"]
    create_private(folder / "old.pem", stolen["charlie.pem"])
    with pytest.raises(ConfigError, match=r"old has|none of alpha"):
        add_host_identity(path, "old")
    revoked = load_pem_x509_crl((folder / "revoked.pem").read_bytes())
    assert len(list(revoked)) == 2, "what was revoked stays so"
    for name in ("authority", "../alpha"):
        with pytest.raises(ConfigError, match="name one of"):
            revoke_host_identity(path, name)


def test_the_station_may_be_revoked_and_the_swarm_flies_without_it(path: Path) -> None:
    make_host_identities(path)
    revoke_host_identity(path, STATION)
    config, host = load_host(path, [0, 1])
    keyring = load_keyring(own_identity(config, host.name))
    assert STATION not in keyring.common_names
    assert [key is None for key in keyring.keys] == [False, False, False, True]


def test_two_hosts_share_a_key_that_no_third_one_has(path: Path) -> None:
    make_host_identities(path)
    config = load(path)
    alpha, bravo, charlie = (load_keyring(own_identity(config, name)).keys for name in ("alpha", "bravo", "charlie"))
    assert alpha[1] == bravo[0]
    assert len({*alpha, *bravo, *charlie}) == 3 + 3 + 3, "three pairs, three with itself, three with the station"


@pytest.mark.parametrize(
    ("broken", "words"),
    [
        (lambda folder, other: (folder / "charlie.pem").unlink(), r"charlie\.pem: missing; copy it"),
        (lambda folder, other: replace(folder, other, "charlie.pem", "charlie.pem"), "is not by the authority"),
        (lambda folder, other: replace(folder, folder, "charlie.pem", "alpha.pem"), r"is of alpha\..*, not of charlie"),
        (lambda folder, other: replace(folder, other, "bravo.key", "bravo.key"), r"bravo\.key is not the key of bravo"),
        (lambda folder, other: replace(folder, other, "revoked.pem", "revoked.pem"), "is not by the authority"),
        (lambda folder, other: (folder / "alpha.pem").write_text("nonsense"), r"not by the authority|damaged"),
    ],
)
def test_files_that_do_not_fit_are_refused(
    path: Path, tmp_path: Path, broken: Callable[[Path, Path], None], words: str
) -> None:
    folder, _ = make_host_identities(path)
    (tmp_path / "other").mkdir()
    other_path = tmp_path / "other" / path.name
    other_path.write_text(path.read_text())
    other, _ = make_host_identities(other_path)
    revoke_host_identity(other_path, STATION)
    broken(folder, other)
    with pytest.raises(ConfigError, match=words):
        load_host(path, [2, 3])


def replace(folder: Path, other: Path, name: str, by: str) -> None:
    (folder / name).unlink(missing_ok=True)
    create_private(folder / name, (other / by).read_bytes())


@pytest.mark.parametrize("name", ["authority", "revoked", "operator", "agent-1"])
def test_names_of_others_are_no_names_of_hosts(name: str) -> None:
    with pytest.raises(ConfigError, match="reserved"):
        load(CONFIG, [f"{ALPHA}name='{name}'"])


def test_who_is_revoked_in_flight_keeps_nobody_from_starting_a_router_again(path: Path) -> None:
    make_host_identities(path)
    identity = own_identity(load(path), "alpha")
    revoke_host_identity(path, "bravo")
    keyring = load_keyring(identity)
    assert sorted(keyring.common_names) == ["alpha", "charlie", "station"]
    assert [key is None for key in keyring.keys] == [False, True, False, False]
    with pytest.raises(ConfigError, match=r"bravo\.pem: missing"):
        load_host(path, [0, 1])
