"""Tests that only files of bounded size are read and that nothing is written through symbolic links."""

from __future__ import annotations

import os
import secrets
import tracemalloc
from pathlib import Path

import pytest

from swarmctl.files import hold, is_held, read_file, replace_bytes, replace_text, replaced, replaced_by_program


def test_a_file_is_read_whole(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"12345")
    assert read_file(path, 5) == b"12345"
    with pytest.raises(FileNotFoundError):
        read_file(tmp_path / "b", 5)


def test_a_file_larger_than_asked_for_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a"
    with path.open("wb") as file:
        file.truncate(2**40)  # sparse: reading it would need 1 TB
    with pytest.raises(OSError, match="is larger than 1 MB"):
        read_file(path, 10**6)
    with path.open("wb") as file:
        file.truncate(20_000_001)
    tracemalloc.start()
    try:
        with pytest.raises(OSError, match="is larger than 20 MB"):
            read_file(path, 20_000_000)
        _, most_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most_bytes < 1_000_000, "it was read, and then refused"


def test_a_file_that_holds_more_than_it_says_is_refused() -> None:
    path = Path("/proc/self/status")  # a regular file of 0 bytes, as one that grows while it is read
    assert path.stat().st_size == 0
    with pytest.raises(OSError, match="is larger than"):
        read_file(path, 10)
    assert b"Name:" in read_file(path, 10**6)


@pytest.mark.timeout(10)
def test_a_pipe_and_a_device_are_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero"), tmp_path):
        with pytest.raises(OSError, match="is not a regular file"):
            read_file(path, 10**6, follow=True)


def test_a_link_is_followed_only_when_asked_to(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"secret")
    (tmp_path / "link").symlink_to("a")
    assert read_file(tmp_path / "link", 100, follow=True) == b"secret"
    with pytest.raises(OSError, match="is a symbolic link"):
        read_file(tmp_path / "link", 100)


def test_a_link_in_place_of_the_file_is_replaced_and_its_target_kept(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("mine")
    path = tmp_path / "out" / "report.html"
    path.parent.mkdir()
    for name in ("report.html", "report.html.part", ".report.html.part"):  # also where a neighbour might be expected
        (path.parent / name).symlink_to(precious)
    replace_text(path, "page")
    assert precious.read_text() == "mine"
    assert path.read_text() == "page"
    assert not path.is_symlink()
    with replaced_by_program(path) as part:
        part.write_text("packed")
    assert path.read_text() == "packed"
    assert precious.read_text() == "mine"


def test_a_link_at_the_name_of_the_new_file_is_not_written_through(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As if a neighbour had guessed the random part of the name."""
    precious = tmp_path / "precious"
    precious.write_text("mine")
    monkeypatch.setattr(secrets, "token_hex", lambda size: "0" * 2 * size)
    (tmp_path / f".report.html.{'0' * 16}.part").symlink_to(precious)
    with pytest.raises(FileExistsError):
        replace_text(tmp_path / "report.html", "page")
    assert precious.read_text() == "mine"
    assert not (tmp_path / "report.html").exists()


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "summary.json"
    replace_bytes(path, b"old")
    with pytest.raises(ZeroDivisionError), replaced(path) as file:
        file.write(b"half")
        raise ZeroDivisionError
    with pytest.raises(ZeroDivisionError), replaced_by_program(path) as part:
        part.write_bytes(b"half")
        raise ZeroDivisionError
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["summary.json"]


def test_what_is_no_file_is_not_replaced(tmp_path: Path) -> None:
    """Root replaced even /dev/null by a recording, and a folder without a name was a traceback."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("pipe")
    for path in (tmp_path / "pipe", tmp_path / "link", tmp_path, Path(), Path("/")):
        with pytest.raises(OSError, match="is not a regular file"):
            replace_text(path, "page")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link", "pipe"]
    assert (tmp_path / "pipe").is_fifo() and (tmp_path / "link").is_symlink()


def test_text_with_lone_surrogates_is_written(tmp_path: Path) -> None:
    replace_text(tmp_path / "a", "lone \ud800 surrogate")
    assert (tmp_path / "a").read_text() == "lone ? surrogate"


def test_a_file_is_held_until_it_is_closed(tmp_path: Path) -> None:
    path, free = tmp_path / "rows", tmp_path / "free"
    free.write_bytes(b"")
    with path.open("ab") as file:
        hold(file.fileno())
        assert [is_held(path), is_held(path), is_held(free), is_held(tmp_path / "none")] == [True, True, False, False]
    assert not is_held(path)
    os.mkfifo(tmp_path / "pipe")
    assert not is_held(tmp_path / "pipe"), "opening it would wait for a writer"


def test_a_file_that_cannot_be_held_costs_nothing() -> None:
    hold(-1 % 2**15)  # no such descriptor
