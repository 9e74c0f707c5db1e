"""Tests that CSV files are read once, into the configuration, and refused with the line that is wrong."""

from __future__ import annotations

from pathlib import Path

import pytest

from swarmctl.config import dump, load
from swarmctl.errors import ConfigError

GOOD = "# own flight\nT, X, Y, Z,\n0, 0, 0, -1,\n\n2, 1, 0, -1\n"


def config_with(tmp_path: Path, content: bytes, name: str = "a.csv") -> Path:
    (tmp_path / name).write_bytes(content)
    path = tmp_path / "own.toml"
    path.write_text(
        '[swarm]\nagents = 1\n[mission]\nkind = "csv"\nduration_s = 1.0\n[mission.csv]\nfiles = ["a.csv"]\n'
    )
    return path


def test_a_file_is_found_beside_the_configuration_and_recorded_with_it(tmp_path: Path) -> None:
    path = config_with(tmp_path, GOOD.encode())
    config = load(path)
    resolved = tmp_path / "elsewhere" / "config.toml"
    resolved.parent.mkdir()
    resolved.write_text(dump(config))
    (tmp_path / "a.csv").unlink()
    assert load(resolved) == config, "a run folder needs no other file"
    for row in ("[0.0, 0.0, 0.0, -1.0]", "[2.0, 1.0, 0.0, -1.0]"):
        assert f"    {row},\n" in resolved.read_text(), "a row of the file is one line here too"


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "is empty"),
        (b"t,x,y,z\n0,0,0,-1\n1,0,0\n", "line 3: 3 values for 4 columns"),
        (b"t,x,y,z\n0,0,0,-1\n1,nan,0,-1\n", "line 3: x = 'nan'"),
        (b"t,x,y,z\n0,0,0,-1\n1,one,0,-1\n", "line 3: x = 'one'"),
        (b"t;x;y;z\n0,0;0;0;-1\n", "separated by semicolons; separate them by commas, with points in decimals"),
        (b"t\tx\ty\tz\n0\t0\t0\t-1\n", "separated by tabs"),
        (b"t x y z\n0 0 0 -1\n", "separated by spaces"),
        (b"0.00,0,0,-1\n1.00,0,0,-1\n", "has to name the columns, for example t,x,y,z"),
        (b"\xff\xfe", "not UTF-8"),
        (b't,x,y,z\n"' + b"1" * 140_000, "can't be read as CSV: field larger than field limit"),
        (b"t,x,y,z\n" + b"0,0,0,-1\n" * 200_000, "larger than 1 MB"),
        (b"time,x,y,z\n0,0,0,-1\n1,1,0,-1\n", "columns time,x,y,z"),
    ],
)
def test_a_file_that_is_no_table_is_refused(tmp_path: Path, content: bytes, words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load(config_with(tmp_path, content))
    assert words in str(caught.value)
    assert "a.csv" in str(caught.value)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no such file .*b\.csv"):
        load(config_with(tmp_path, GOOD.encode()), ["mission.csv.files=['b.csv']"])


def test_another_file_that_is_set_on_a_resolved_configuration_is_flown(tmp_path: Path) -> None:
    """What was read from the former one is in it, and was flown in its place without a word."""
    flown = load(config_with(tmp_path, b"t,x,y,z\n0,0,0,-1\n9,1,0,-1\n"))
    resolved, other = tmp_path / "config.toml", tmp_path / "b.csv"
    resolved.write_text(dump(flown), encoding="utf-8")
    other.write_bytes(b"t,x,y,z\n0,0,0,-2\n9,5,0,-2\n")
    assert load(resolved).mission == flown.mission
    changed = load(resolved, ["mission.csv.files=['b.csv']"])
    assert "[9.0, 5.0, 0.0, -2.0]" in dump(changed) and "[9.0, 1.0, 0.0, -1.0]" not in dump(changed)
    with pytest.raises(ConfigError, match="no such file"):
        load(resolved, ["mission.csv.files=['none.csv']"])


def test_files_that_are_more_together_than_can_be_recorded_are_refused(tmp_path: Path) -> None:
    row = b",".join([b"0.123456789012345"] * 6)
    content = b"t,x,y,z,vx,vy,vz\n" + b"".join(b"%d.0,%s\n" % (k, row) for k in range(8000))
    path = config_with(tmp_path, content)
    path.write_text(
        path.read_text().replace('["a.csv"]', '["a.csv", "a.csv", "a.csv", "a.csv", "a.csv"]'), encoding="utf-8"
    )
    with pytest.raises(ConfigError, match="MB of numbers together; allowed"):
        load(path)
