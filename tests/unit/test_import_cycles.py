"""No module imports itself in a circle, not even by an import within a function."""

from __future__ import annotations

from collections.abc import Mapping
from graphlib import CycleError, TopologicalSorter

import grimp
import pytest


def cycle(imports: Mapping[str, set[str]]) -> list[str]:
    """Modules of a circle, the first one repeated at the end; empty without one."""
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


@pytest.fixture(scope="module")
def imports() -> dict[str, set[str]]:
    graph = grimp.build_graph("swarmctl", "sitl", cache_dir=None)
    return {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}


def test_no_module_imports_itself_in_a_circle(imports: dict[str, set[str]]) -> None:
    assert len(imports) > 150
    assert cycle(imports) == []


def test_a_circle_through_a_function_would_be_found(imports: dict[str, set[str]]) -> None:
    optional = "swarmctl.control.mpc.solvers.qp_daqp"  # imported within a function only
    assert optional in imports["swarmctl.control.mpc.solvers.registry"]
    closed = {**imports, optional: {*imports[optional], "swarmctl.control.mpc.solvers.registry"}}
    assert set(cycle(closed)) == {optional, "swarmctl.control.mpc.solvers.registry"}
