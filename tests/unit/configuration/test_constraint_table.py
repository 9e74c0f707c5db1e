"""Tests that constraints between sections are checked as far as the sections that they read are right."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from swarmctl.config import Config, load
from swarmctl.configuration.constraint_table import CONSTRAINTS, sections_of
from swarmctl.errors import ConfigError

CONFIGS = sorted((Path(__file__).parents[3] / "configs").glob("*.toml"))


def problems(*overrides: str) -> tuple[str, ...]:
    with pytest.raises(ConfigError) as caught:
        load(None, overrides)
    return caught.value.problems


def test_what_is_wrong_between_sections_is_said_beside_what_is_wrong_in_others() -> None:
    found = problems("telemetry.port=0", "sitl.speed=2", "limits.min_separation_m=2", "start.spacing_m=0.8")
    assert [problem.split(" = ")[0].split(":")[0] for problem in found] == [
        *("telemetry.port", "start", "start", "sitl.speed", "limits.min_separation_m"),
    ]


def test_an_item_that_is_none_hides_nothing_that_is_wrong_with_keys() -> None:
    assert [problem.split(" = ")[0] for problem in problems("swarm.agents", "agent.rate_hz=-1")] == [
        *("--set 'swarm.agents': write it as key.sub=value", "agent.rate_hz"),
    ]


def test_a_file_that_is_missing_hides_nothing_that_is_wrong_elsewhere() -> None:
    missing, speed = problems("obstacles=none.toml", "sitl.speed=2")
    assert missing.startswith("obstacles = 'none.toml'") and speed.startswith("sitl.speed = 2.0")


@pytest.mark.parametrize("wrong", ["separation.radius_m=nan", "separation.radius=3", "--set", "sepration.radius_m=3"])
def test_nothing_is_said_that_only_follows_from_what_is_wrong(wrong: str) -> None:
    """By the default radius of 0.9 m both would be wrong: agents too near, and judged by more than they keep."""
    (found,) = problems(wrong, "limits.min_separation_m=2", "start.spacing_m=0.8")
    assert wrong.partition(".")[0] in found


def test_negative_control_of_the_radius_both_are_said() -> None:
    assert {"limits", "start"} <= sections_of(problems("limits.min_separation_m=2", "start.spacing_m=0.8"))


@pytest.mark.parametrize("wrong", ["vehicle_model.delay_s=-1", "mission.duration_s=-1"])
def test_own_code_that_was_not_tried_is_not_asked_for_its_problems(wrong: str) -> None:
    (found,) = problems("mission.kind=nowhere:Kind", wrong)
    assert found.startswith(wrong.partition("=")[0])


@pytest.mark.parametrize("file", CONFIGS, ids=lambda file: file.stem)
@pytest.mark.parametrize("overrides", [(), ("mission.duration_s=5000", "start.spacing_m=0.01")], ids=["", "wrong"])
def test_constraints_read_the_sections_that_they_declare(
    file: Path, overrides: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    read: set[str] = set()
    get = Config.__getattribute__

    def noted(config: Config, name: str) -> Any:
        if name in Config.model_fields:
            read.add(name)
        return get(config, name)

    config = load(file)
    for key, value in (item.split("=") for item in overrides):
        section, name = key.split(".")
        changed = getattr(config, section).model_copy(update={name: float(value)})
        config = config.model_copy(update={section: changed})
    monkeypatch.setattr(Config, "__getattribute__", noted)
    for constraint in CONSTRAINTS:
        read.clear()
        list(constraint.problems(config))
        assert read <= constraint.reads, f"{constraint} reads {sorted(read - constraint.reads)} too"
