"""One cell of the matrix of orders and phases, by the tool that flies all of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from swarmctl.core.types import Phase

pytestmark = [pytest.mark.process, pytest.mark.timeout(200)]


def test_a_hold_on_the_way_up_is_obeyed_within_a_second_by_who_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "tools")
    from verb_matrix import cell

    found = cell(Phase.TAKEOFF, "hold", to_all=False)
    assert found["result"] == "obeyed", found
    assert found["answered_s"] + found["seen_s"] < 1.0
