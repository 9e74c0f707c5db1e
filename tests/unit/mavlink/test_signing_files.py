"""Files of signed links: keys that only their owner may read, and time stamps that outlive a program."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from swarmctl import files
from swarmctl.errors import ConfigError, StartError
from swarmctl.mavlink.signing import stamp_file
from swarmctl.mavlink.signing.channel import AGENT_LINK, CHECK_LINK, SigningChannel, Stamps
from swarmctl.mavlink.signing.key_file import read_key, write_new_key
from swarmctl.mavlink.signing.signature import SigningKey, Stream, stamp_at
from swarmctl.mavlink.signing.stamp_file import StampFile, kept_channel, state_folder
from swarmctl.signing_keys import key_problems, read_keys, read_own_key

SECRET = bytes(range(32))
KEY = SigningKey(SECRET)
UTC_US = 1_790_000_000_000_000
VEHICLE = Stream(0, 3, 1)


@pytest.fixture
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return state_folder()


def key_at(path: Path, text: bytes = SECRET.hex().encode() + b"\n", mode: int = 0o600) -> Path:
    path.write_bytes(text)
    path.chmod(mode)
    return path


# -- keys -------------------------------------------------------------------------------------------------------------


def test_a_new_key_is_random_private_and_never_replaces_a_file(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        keys = [write_new_key(tmp_path / name) for name in ("a.key", "b.key")]
    finally:
        os.umask(before)
    assert keys[0].secret != keys[1].secret
    assert stat.S_IMODE((tmp_path / "a.key").stat().st_mode) == 0o600
    assert read_key(tmp_path / "a.key").secret == keys[0].secret
    with pytest.raises(FileExistsError):
        write_new_key(tmp_path / "a.key")
    assert read_key(tmp_path / "a.key").secret == keys[0].secret
    (tmp_path / "link.key").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match="exists"):
        write_new_key(tmp_path / "link.key")
    assert not (tmp_path / "elsewhere").exists()


def linked(path: Path) -> Path:
    path.symlink_to(key_at(path.with_name("target")))
    return path


def piped(path: Path) -> Path:
    os.mkfifo(path, 0o600)
    return path


def folder(path: Path) -> Path:
    path.mkdir(mode=0o700)
    return path


REFUSED: dict[str, tuple[Callable[[Path], Path], str]] = {
    "readable by the group": (lambda path: key_at(path, mode=0o640), "has mode 0640"),
    "readable by all": (lambda path: key_at(path, mode=0o604), "has mode 0604"),
    "writable by others": (lambda path: key_at(path, mode=0o622), "has mode 0622"),
    "symbolic link": (linked, "is a symbolic link"),
    "pipe": (piped, "is not a regular file"),
    "folder": (folder, "is not a regular file"),
    "missing": (lambda path: path, "No such file"),
    "too short": (lambda path: key_at(path, b"00" * 31), "holds no key"),
    "too long": (lambda path: key_at(path, b"00" * 33), "holds no key"),
    "no key": (lambda path: key_at(path, b"correct horse battery staple"), "holds no key"),
    "large": (lambda path: key_at(path, b"0" * 10_000), "is larger than"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_key_file_that_is_not_private_or_not_a_key_is_refused(tmp_path: Path, name: str) -> None:
    make, said = REFUSED[name]
    with pytest.raises(OSError, match=said):
        read_key(make(tmp_path / "a.key"))


@pytest.mark.parametrize("name", ["readable by the group", "readable by all", "writable by others"])
def test_negative_control_without_the_check_of_its_mode_the_file_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setattr(files, "_why_not_private", lambda status: "")
    assert read_key(REFUSED[name][0](tmp_path / "a.key")).secret == SECRET


def test_a_key_file_of_another_user_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = key_at(tmp_path / "a.key")
    monkeypatch.setattr(os, "geteuid", lambda: path.stat().st_uid + 1)
    with pytest.raises(OSError, match="belongs to another user"):
        read_key(path)


def test_all_problems_with_keys_at_once_and_none_shows_a_key(tmp_path: Path) -> None:
    names = [str(make(tmp_path / f"{i}.key")) for i, (make, _) in enumerate(REFUSED.values()) if make is not linked]
    names += [str(key_at(tmp_path / name)) for name in ("twin-a", "twin-b")]
    problems = list(key_problems(names, len(names) + 1))
    assert problems[0].startswith(f"mavlink.signing_keys: {len(names)} files for swarm.agents = {len(names) + 1}")
    assert len(problems) == len(names), "each file but the first twin, and their number"
    assert problems[-1] == (
        f"mavlink.signing_keys.{len(names) - 1}: holds the same key as mavlink.signing_keys.{len(names) - 2}; "
        "give every vehicle its own"
    )
    assert not any(SECRET.hex()[:8] in problem for problem in problems)
    with pytest.raises(ConfigError):
        read_keys(names, 2)


def test_an_agent_needs_the_key_of_its_own_vehicle_alone(tmp_path: Path) -> None:
    names = [str(tmp_path / "elsewhere.key"), str(key_at(tmp_path / "own.key"))]
    own = read_own_key(names, 1)
    assert own is not None
    assert own.secret == SECRET
    assert not list(key_problems(names, 2, only=(1,)))
    with pytest.raises(ConfigError, match=r"elsewhere\.key"):
        read_own_key(names, 0)
    assert read_own_key((), 1) is None
    assert read_keys((), 2) == [None, None]


# -- time stamps ------------------------------------------------------------------------------------------------------


def test_time_stamps_outlive_a_program(state: Path) -> None:
    file = StampFile(state, KEY, AGENT_LINK)
    assert file.load() == Stamps()
    file.save(Stamps(sent=5, received={VEHICLE: 7}))
    assert file.load() == Stamps(sent=5, received={VEHICLE: 7})
    StampFile(state, KEY, CHECK_LINK).save(Stamps(sent=9, received={VEHICLE: 6, Stream(1, 3, 1): 8}))
    assert file.load() == Stamps(sent=9, received={VEHICLE: 7, Stream(1, 3, 1): 8}), "of every program with this key"
    assert StampFile(state, SigningKey(bytes(32)), AGENT_LINK).load() == Stamps(), "and of no other key"
    for path in state.iterdir():
        assert SECRET.hex() not in path.name + path.read_text()
    assert stat.S_IMODE(state.stat().st_mode) & 0o077 == 0


def test_a_killed_program_is_followed_by_one_that_signs_with_newer_time_stamps_whatever_the_clock(state: Path) -> None:
    utc_us = UTC_US

    def clock() -> int:
        return utc_us

    with kept_channel(KEY, AGENT_LINK, clock) as killed:
        utc_us += 9_000_000  # two periods of saving, none of which was reached
        killed.sign(bytes.fromhex("fd 01 00 00 00 03 01 000000 00 0000"))
        left = StampFile(state, KEY, AGENT_LINK).load()
        assert left.sent > killed.stamps().sent
    assert StampFile(state, KEY, AGENT_LINK).load().sent == stamp_at(utc_us), "one that ends needs no reserve"
    again = SigningChannel(KEY, AGENT_LINK, lambda: UTC_US - 86_400_000_000, left)
    assert again.stamps().sent >= left.sent


def test_a_damaged_file_of_time_stamps_is_refused_and_one_that_cannot_be_written_too(
    state: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = StampFile(state, KEY, AGENT_LINK)
    file.save(Stamps(sent=5))
    [path] = state.iterdir()
    for content in (b"", b"{", b'{"sent": 1}', b'{"sent": "x", "received": []}', b"0" * 200_000):
        path.write_bytes(content)
        with pytest.raises(StartError, match="can't be read"):
            file.load()
    path.unlink()

    def full(path: Path, content: bytes) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(stamp_file, "replace_bytes", full)
    with pytest.raises(StartError, match="No space left"), kept_channel(KEY, AGENT_LINK, lambda: UTC_US):
        raise AssertionError


def test_a_disk_that_fills_up_meanwhile_is_reported_at_the_end(
    state: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(path: Path, content: bytes) -> None:
        raise OSError(28, "No space left on device")

    with kept_channel(KEY, AGENT_LINK, lambda: UTC_US):
        monkeypatch.setattr(stamp_file, "replace_bytes", full)
    assert "time stamps of signed frames could not be saved" in capsys.readouterr().err
