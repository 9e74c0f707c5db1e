"""Real autopilots to fly against: `SWARMCTL_PX4`, `SWARMCTL_ARDUCOPTER`; see docs/real_autopilots.md."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.benches.launches import Launched
from tests.real.autopilots import Fleet, Kind
from tests.real.network import Network, own_network
from tests.real.turns import locked, turn
from tests.real.witness import Truth, Witness


class Inside(Launched):
    """A launch in a network."""

    def __init__(self, network: Network, run_dir: Path, temp: Path, *arguments: str) -> None:
        self.prefix = network.prefix
        super().__init__(run_dir, temp, *arguments, "--no-view", "--set", "telemetry.enabled=false")


class Field:
    """Real vehicles with a witness; launches fly them one after the other."""

    def __init__(self, fleet: Fleet, witness: Witness, directory: Path) -> None:
        self.fleet, self.witness = fleet, witness
        self._directory = directory
        self._launches: list[Launched] = []

    def launch(self, *arguments: str) -> Launched:
        temp = Path(tempfile.mkdtemp(prefix="sw"))
        run_dir = self._directory / f"run{len(self._launches)}"
        self._launches.append(Inside(self.fleet.network, run_dir, temp, *arguments))
        return self._launches[-1]

    def close(self) -> None:
        for launched in self._launches:
            launched.clean_up()
        self.witness.close()
        self.fleet.close()


Fielder = Callable[..., Field]


@pytest.fixture
def network() -> Iterator[Network]:
    with own_network() as network:
        yield network


@pytest.fixture
def field(network: Network, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fielder]:
    """Start N vehicles of a kind, alone in the air or not (see `turn`); skip where no build of it is named."""
    fields: list[Field] = []
    turns = contextlib.ExitStack()

    def power_up(
        kind: Kind,
        count: int,
        parameters: dict[str, float] | None = None,
        on_truth: Callable[[Witness, int, Truth], None] | None = None,
        is_alone: bool = False,
    ) -> Field:
        require(kind, network, 0)  # before a wait of minutes
        turns.enter_context(turn(tmp_path_factory.getbasetemp().parent, is_alone))
        require(kind, network, count)
        fleet = Fleet(kind, count, network, tmp_path / "vehicles", parameters)
        fields.append(Field(fleet, Witness(fleet, on_truth), tmp_path))
        return fields[-1]

    yield power_up
    for each in fields:
        each.close()
    turns.close()


def require(kind: Kind, network: Network, count: int) -> None:
    """Skip without a build; fail where a named build does not exist."""
    if kind.binary is None:
        pytest.skip(f"{kind.variable} names no build")
    assert not kind.unusable, f"{kind.variable}: {', '.join(kind.unusable)} can't be run; see docs/real_autopilots.md"
    taken = network.taken(port + kind.spread * i for port in kind.ports for i in range(count))
    if taken:
        pytest.skip(f"ports {taken} are taken; run as root for a network of its own")
    running = [lock for lock in kind.locks(network, count) if held(lock)]
    if running:
        pytest.skip(f"somebody else's autopilot runs and holds {', '.join(map(str, running))}")


def held(lock: Path) -> bool:
    """Return whether a process has locked that file."""
    if not lock.exists():
        return False
    with lock.open("r+") as file:
        return not locked(file)
