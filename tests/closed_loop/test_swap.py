"""Eight agents change places through one centre."""

from __future__ import annotations

import numpy as np

from tests.closed_loop.conftest import Fly


def test_eight_agents_swap_without_touching(fly: Fly) -> None:
    flight = fly("mission.duration_s=12", "sitl.start=air", config="swap8.toml")  # all have arrived after 10.4 s
    assert flight.problems == []
    assert flight.separation_m() >= 0.85
    for agent in range(8):
        _, error = flight.tracked(agent)
        assert np.linalg.norm(error[-1]) < 0.1, "everybody arrives"
        assert not flight.ticks(agent)["barrier_acted"].any(), "the last layer is not what keeps them apart"
