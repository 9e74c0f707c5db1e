"""Quantiles of a few numbers are those of NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from swarmctl.core.quantile import quantile


@pytest.mark.parametrize("share_01", [0.0, 0.5, 0.9, 0.99, 1.0])
@given(values=st.lists(st.floats(0.0, 1e3), min_size=1, max_size=260))
def test_a_quantile_is_that_of_numpy(share_01: float, values: list[float]) -> None:
    assert quantile(values, share_01) == pytest.approx(float(np.quantile(values, share_01)), rel=1e-9, abs=1e-9)
