"""`swarmctl keys`: new keys in private files, and what is refused before any vehicle is spoken to."""

from __future__ import annotations

import errno
import re
import stat
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from swarmctl.bus.network import identities
from swarmctl.bus.network.identities import make_identities, revoke_identity
from swarmctl.errors import ConfigError
from swarmctl.mavlink.signing.key_file import read_key
from swarmctl.ops import cli

Run = Callable[..., int]
HOSTS = '[swarm]\nagents = 1\n[[hosts]]\nname = "alpha"\naddress = "127.0.0.1:7447"\nagents = [0]\n'
VEHICLE = '[sitl]\nenabled = false\n[swarm]\nagents = 1\n[[vehicles]]\nsysid = 1\nurl = "udpin://127.0.0.1:9"\n'


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))

    def runner(*arguments: str) -> int:
        monkeypatch.setattr(sys, "argv", ["swarmctl", *arguments])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        return int(ended.value.code or 0)

    return runner


def test_new_keys_are_named_by_their_fingerprints_alone(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [tmp_path / "0.key", tmp_path / "1.key"]
    assert run("keys", "new", *map(str, files)) == 0
    keys = [read_key(path) for path in files]
    said = capsys.readouterr().out
    assert said.splitlines() == [f"{path}: key {key.fingerprint}" for path, key in zip(files, keys, strict=True)]
    assert not any(key.secret.hex() in said for key in keys)
    assert all(stat.S_IMODE(path.stat().st_mode) == 0o600 for path in files)
    assert run("keys", "new", str(files[0]), str(tmp_path / "2.key"), str(tmp_path / "no" / "folder")) == 2
    refused = capsys.readouterr().err
    assert "0.key: exists already, and a vehicle may have that key; give another name" in refused
    assert "folder: can't be written: No such file" in refused, "all at once"
    assert read_key(files[0]).secret == keys[0].secret
    assert (tmp_path / "2.key").exists()


def test_keys_whose_folder_takes_none_are_exit_code_3_and_all_are_named(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As of every file that was asked for; 2 is bad usage."""
    files = [tmp_path / "no" / "0.key", tmp_path / "1.key", tmp_path / "no" / "2.key"]
    assert run("keys", "new", *map(str, files)) == 3
    advice = "can't be written: No such file or directory. Give another name, or make its folder"
    assert capsys.readouterr().err == f"{files[0]}: {advice}\n{files[2]}: {advice}\n"
    assert files[1].exists()


@pytest.mark.parametrize("verb", ["init", "add", "revoke"])
def test_identities_that_can_not_be_written_are_exit_code_3(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, verb: str
) -> None:
    config = tmp_path / "swarm.toml"
    config.write_text(f'{HOSTS}[bus]\nidentities = "identities"\n')
    if verb != "init":
        assert run("keys", "init", str(config)) == 0
        assert verb == "revoke" or run("keys", "revoke", str(config), "alpha") == 0
    capsys.readouterr()

    def full(path: Path, content: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    for name in ("create_private", "replace_bytes"):
        monkeypatch.setattr(identities, name, full)
    assert run("keys", verb, str(config), *([] if verb == "init" else ["alpha"])) == 3
    assert re.fullmatch(
        r".*identities/\w+\.(key|pem): can't be written: No space left on device\n", capsys.readouterr().err
    )


def test_installing_without_keys_vehicles_or_a_readable_old_key_is_refused(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tmp_path / "swarm.toml"
    config.write_text(VEHICLE)
    assert run("keys", "install", str(config)) == 2
    assert "swarmctl keys new" in capsys.readouterr().err
    assert run("keys", "new", str(tmp_path / "0.key")) == 0
    config.write_text(VEHICLE + '[mavlink]\nsigning_keys = ["0.key"]\n')
    assert run("keys", "install", str(config), "--old", str(tmp_path / "lost.key")) == 2
    assert "lost.key" in capsys.readouterr().err
    config.write_text('[swarm]\nagents = 1\n[mavlink]\nsigning_keys = ["0.key"]\n')
    assert run("keys", "install", str(config)) == 2
    assert "built-in simulator" in capsys.readouterr().err
    (tmp_path / "0.key").chmod(0o644)
    config.write_text(VEHICLE + '[mavlink]\nsigning_keys = ["0.key"]\n')
    assert run("keys", "install", str(config)) == 2
    assert "has mode 0644" in capsys.readouterr().err


def test_an_identity_that_is_not_there_is_not_revoked(tmp_path: Path) -> None:
    make_identities(tmp_path / "identities", {"alpha": None, "station": None})
    with pytest.raises(ConfigError, match=r"'bravo': has no identity in .*; there are: alpha, station"):
        revoke_identity(tmp_path / "identities", "bravo")
