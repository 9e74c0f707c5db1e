"""Tests `[[hosts]]` and the identities of hosts."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from swarmctl.bus.network.hosts import links_of
from swarmctl.bus.network.identity_files import STATION
from swarmctl.config import load, own_identity
from swarmctl.errors import ConfigError
from swarmctl.ops.host import load_host, make_host_identities, shared_run_name, systemd_unit

ROOT = Path(__file__).parents[3]
CONFIG = ROOT / "configs" / "three_hosts.toml"
ALPHA = "hosts.0."


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
        (ALPHA + "name='bravo'", "given 2 times"),
        (ALPHA + "name='station'", "reserved"),
        (ALPHA + "name='a/b'", "hosts.0.name"),
    ],
)
def test_what_is_no_list_of_hosts_is_refused(item: str, words: str) -> None:
    with pytest.raises(ConfigError) as refused:
        load(CONFIG, [item])
    assert words in str(refused.value)


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


def test_a_host_flies_only_with_an_identity(path: Path) -> None:
    with pytest.raises(ConfigError, match=r"bus.identities: .*authority.pem.*swarmctl keys init"):
        load_host(path, [2, 3])
    folder, _ = make_host_identities(path)
    config, host = load_host(path, [3, 2])
    assert (host.name, config.simulator(host.agents).vehicles) == ("bravo", 2)
    (folder / "bravo.key").chmod(0o644)
    with pytest.raises(ConfigError, match=r"bravo\.key"):
        load_host(path, [2, 3])
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
