"""What an agent's status says of its recent ticks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmctl.agent.sharing.telemetry_publisher import percentile_99


@given(st.lists(st.floats(0.0, 1e3), min_size=1, max_size=260))
def test_the_percentile_is_that_of_numpy(values: list[float]) -> None:
    assert percentile_99(values) == pytest.approx(float(np.percentile(values, 99)), rel=1e-9, abs=1e-9)
