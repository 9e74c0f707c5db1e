"""Tests that the documentation follows the code."""

from __future__ import annotations

import runpy
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_the_page_of_the_configuration_is_what_the_script_writes() -> None:
    written = runpy.run_path(str(ROOT / "tools" / "configuration_page.py"))["page"]()
    assert (ROOT / "docs" / "configuration.md").read_text() == written, "run python tools/configuration_page.py"
