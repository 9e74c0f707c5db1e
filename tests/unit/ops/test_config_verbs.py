"""`swarmctl config`: every key can be found with its value and range, and begun from a commented file."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from swarmctl.config import Config, load, load_mission
from swarmctl.configuration.problems import all_keys
from swarmctl.errors import ConfigError, StartError
from swarmctl.files import write_new
from swarmctl.ops import config_help

ROOT = Path(__file__).parents[3]
BUILT_IN = sorted((ROOT / "configs").glob("*.toml"))


def leaves(tree: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in tree.items():
        if isinstance(value, dict) and value:
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def test_every_key_is_shown_with_its_value() -> None:
    keys = config_help.shown_keys(Config())
    shown = {key.key.replace(".N.", ".") for key in keys}
    missing = {key for key in all_keys(Config, "") if not any(s == key or s.startswith(f"{key}.") for s in shown)}
    assert {key for key in missing if not key.startswith("vehicles.model.")} == set()
    values = dict(leaves(Config().model_dump(exclude_none=True)))
    for key in keys:
        if key.key in values and ".N." not in key.key:
            assert key.value == key.default == values[key.key], key.key


def test_what_is_shown_is_toml_that_sets_the_same(tmp_path: Path) -> None:
    config = load(ROOT / "configs" / "x500_circle.toml")
    (tmp_path / "shown.toml").write_text("\n".join(config_help.lines_of(config_help.shown_keys(config))))
    assert load(tmp_path / "shown.toml") == config


def test_a_key_is_found_by_name_section_or_part() -> None:
    config = load(None, ["separation.radius_m=0.95"])
    (radius,) = config_help.shown_keys(config, "separation.radius_m")
    assert (radius.value, radius.default, radius.allowed, radius.type) == (0.95, 0.9, "> 0, <= 100", "number")
    assert config_help.lines_of([radius]) == [
        "separation.radius_m = 0.95",
        f"  {radius.meaning}",
        "  number; > 0, <= 100; default 0.9",
    ]
    section = config_help.shown_keys(config, "mission.circle")
    assert {key.key.rpartition(".")[0] for key in section} == {"mission.circle"}
    assert "swarm.agents" in {key.key for key in config_help.shown_keys(config, "AGENTS")}
    with pytest.raises(ConfigError, match=r"did you mean .*radius_m"):
        config_help.shown_keys(config, "separation.radios_m")
    with pytest.raises(ConfigError, match="swarmctl config show"):
        config_help.shown_keys(config, "?")


def test_the_schema_knows_every_key_of_the_built_in_files_and_no_other() -> None:
    schema = json.loads(config_help.schema())
    for path in BUILT_IN:
        assert list(unknown(tomllib.loads(path.read_text()), schema, schema)) == [], path.name
    assert list(unknown({"separation": {"radios_m": 1.0}}, schema, schema)) == ["radios_m"]
    radius = schema["$defs"]["SeparationParams"]["properties"]["radius_m"]
    assert (radius["exclusiveMinimum"], radius["maximum"], radius["default"]) == (0, 100, 0.9)
    assert radius["description"] == config_help.shown_keys(Config(), "separation.radius_m")[0].meaning


def unknown(tree: Any, node: dict[str, Any], root: dict[str, Any]) -> Iterator[str]:
    """Yield the keys of a file that a schema refuses."""
    if isinstance(tree, list):
        inner = [node for node in alternatives(node, root) if "items" in node]
        for item in tree:
            if isinstance(item, dict):
                yield from unknown(item, inner[0]["items"], root)
        return
    known = [node for node in alternatives(node, root) if "properties" in node]
    for key, value in tree.items():
        if not known:
            continue  # a table of numbers by name
        if key not in known[0]["properties"]:
            assert known[0]["additionalProperties"] is False
            yield key
        elif isinstance(value, (dict, list)):
            yield from unknown(value, known[0]["properties"][key], root)


def alternatives(node: dict[str, Any], root: dict[str, Any]) -> Iterator[dict[str, Any]]:
    if "$ref" in node:
        node = root["$defs"][node["$ref"].rpartition("/")[2]]
    yield node
    for choice in node.get("anyOf", ()):
        yield from alternatives(choice, root)


def test_the_file_of_all_keys_sets_nothing_and_states_every_default(tmp_path: Path) -> None:
    (text,) = config_help.initial_files("defaults").values()
    (tmp_path / "defaults.toml").write_text(text)
    assert load(tmp_path / "defaults.toml") == Config()
    own = [part for part in text.split("\n\n") if not part.startswith("#[[")]  # an item of a list has required keys
    uncommented = re.sub(r"^#(?! )", "", "\n\n".join(own), flags=re.MULTILINE)
    kept = [line for line in uncommented.splitlines() if " = ...  #" not in line]
    (tmp_path / "all.toml").write_text("\n".join(kept))
    assert load(tmp_path / "all.toml") == Config()
    assert "#radius_m = 0.9  # " in text


def test_a_built_in_file_is_written_with_its_comments_and_overwrites_nothing(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    write_new(config_help.initial_files("x500_circle", path))
    assert load(path) == load(ROOT / "configs" / "x500_circle.toml")
    assert "#" in path.read_text()
    with pytest.raises(ConfigError, match="exists already"):
        write_new({tmp_path / "other.toml": "", path: ""})
    assert not (tmp_path / "other.toml").exists(), "all or none"
    with pytest.raises(StartError, match=r"can't be written: No such.*\. Give another name, or make its folder"):
        write_new({tmp_path / "no" / "where.toml": ""})
    with pytest.raises(ConfigError, match=r"known are .*figure_8, .*own_pid, .*x500_circle"):
        config_help.initial_files("x501")


@pytest.mark.parametrize("name", sorted(path.stem for path in (ROOT / "configs" / "examples").glob("*.toml")))
def test_an_example_comes_with_what_it_flies_and_is_checked_where_it_was_written(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    texts = config_help.initial_files(name)
    write_new(texts)
    beside = {path.name for path in (ROOT / "configs" / "examples").glob(f"{name}.*")}
    assert {path.name for path in tmp_path.iterdir()} == beside
    assert f"configs/examples/{name}" not in "".join(texts.values()), "what it says is to be typed is about the copy"
    if name == "figure_8_mission":
        load_mission(load(None), tmp_path / f"{name}.toml")
        return
    copied, own = load(tmp_path / f"{name}.toml"), load(ROOT / "configs" / "examples" / f"{name}.toml")
    assert (copied.name, copied.mission.kind, copied.controller.kind) == (
        own.name,
        own.mission.kind,
        own.controller.kind,
    )


def test_the_files_of_an_example_go_where_the_first_goes(tmp_path: Path) -> None:
    write_new(config_help.initial_files("own_pid", tmp_path / "mine.toml"))
    assert {path.name for path in tmp_path.iterdir()} == {"mine.toml", "own_pid.py"}
    assert load(tmp_path / "mine.toml").controller.kind == "own_pid:Pid"
    assert list(config_help.initial_files("steer_swarm")) == [Path("steer_swarm.py")]


def test_the_verbs_of_the_command_line(tmp_path: Path) -> None:
    def ask(*arguments: str, **more: str) -> str:
        command = [sys.executable, "-m", "swarmctl", *arguments]
        environment = {**os.environ, **more}
        return subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=60, check=True
        ).stdout

    (shown,) = json.loads(ask("config", "show", "seed", "--set", "seed=7", "--json"))
    assert (shown["key"], shown["value"]) == ("seed", 7)
    assert ask("config", "init", "swap8").strip() == "swap8.toml"
    assert (tmp_path / "swap8.toml").exists()
    assert json.loads(ask("config", "schema"))["properties"].keys() == Config.model_fields.keys()


def test_the_shell_completes_verbs() -> None:
    words = {"_SWARMCTL_COMPLETE": "complete_bash", "COMP_WORDS": "swarmctl la", "COMP_CWORD": "1"}
    code = "import sys; sys.argv = ['swarmctl']\nfrom swarmctl.ops.cli import main\nmain()"
    command, environment = [sys.executable, "-c", code], {**os.environ, **words}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout.split() == ["launch", "land"]
