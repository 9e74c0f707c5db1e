"""Floats are added one after the other, also by Pythons whose `sum` compensates what rounding loses."""

from __future__ import annotations

import pytest

from swarmctl.core.ordered_sums import dot, ordered_sum


def test_terms_are_added_in_their_order_and_rounded_each_time() -> None:
    assert ordered_sum([1e16, 1.0, -1e16]) == 0.0
    assert ordered_sum([1e16, -1e16, 1.0]) == 1.0
    assert dot((1e16, 1.0, -1e16), (1.0, 1.0, 1.0)) == 0.0
    assert dot((1.0, 2.0, 3.0), (4.0, 5.0, 6.0)) == 32.0
    assert ordered_sum([]) == dot((), ()) == 0.0


def test_vectors_of_different_lengths_have_no_product() -> None:
    with pytest.raises(ValueError, match="shorter"):
        dot((1.0, 2.0), (1.0,))
