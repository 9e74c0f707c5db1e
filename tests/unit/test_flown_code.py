"""The name of the code that flies, by which hosts notice that theirs differs."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from swarmctl import __version__
from swarmctl.flown_code import code_in_words
from swarmctl.own_modules import make_importable

OWN = "own_gain_of_a_test"


def code_with(folder: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> str:
    """Return the code of a computer that has imported an own module of this text."""
    folder.mkdir()
    (folder / f"{OWN}.py").write_text(text)
    (folder / "not_imported.py").write_text(str(folder))
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, OWN, raising=False)
    make_importable(str(folder))
    __import__(OWN)
    try:
        return code_in_words(str(folder))
    finally:
        sys.modules.pop(OWN)


def test_without_own_modules_it_is_swarmctl_itself() -> None:
    assert re.fullmatch(rf"swarmctl {re.escape(__version__)} \([0-9a-f]{{8}}\)", code_in_words(""))


def test_own_modules_count_by_what_they_say_and_not_by_where_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, same, other = (
        code_with(tmp_path / name, monkeypatch, f"GAIN = {gain}\n") for name, gain in (("a", 1), ("b", 1), ("c", 2))
    )
    assert one == same != other
    assert one.startswith(f"{code_in_words('')} with own modules ")
