"""Tests every file of configs/: it is flown, shortened, or only validated when it needs other vehicles."""

from __future__ import annotations

import pytest

from sitl.lockstep import Lockstep
from swarmctl.config import load
from tests.closed_loop.conftest import ROOT, Fly

FLOWN_ELSEWHERE = {  # and for longer
    "swap8": "swap",
    "thesis_6_obstacle": "obstacle",
    "improved_6_obstacle": "obstacle",
    "ardupilot_sitl": "arducopter",
    "x500_circle": "real_autopilot",
}
FILES = sorted(path.name for path in (ROOT / "configs").glob("*.toml"))


def test_the_documented_files_exist() -> None:
    expected = {"swap8", "px4_udp", "px4_serial", "ardupilot_udp", "thesis_5_circle", "thesis_6_obstacle"}
    assert expected <= {name.removesuffix(".toml") for name in FILES}
    assert {name.split("_")[1] for name in FILES if name.startswith("thesis_")} == set("123456")


@pytest.mark.parametrize("name", FILES)
def test_every_config_flies_or_is_valid(fly: Fly, name: str) -> None:
    config = load(ROOT / "configs" / name)
    assert config.name == name.removesuffix(".toml")
    if not config.sitl.enabled:
        assert len(config.vehicles) >= config.swarm.agents
        return
    if test := FLOWN_ELSEWHERE.get(config.name):
        assert name in (ROOT / "tests" / "closed_loop" / f"test_{test}.py").read_text(encoding="utf-8")
        return
    flight = fly("mission.duration_s=2", "sitl.start=air", config=name, until=Lockstep.mission_is_over)
    assert flight.outcomes == {"completed"}
    assert config.swarm.agents == 1 or flight.separation_m() >= 0.85
