"""Move blocking: the steps at which inputs may change, and by how much."""

from __future__ import annotations

import numpy as np
import pytest

from swarmctl.control.mpc.condensed_qp.axes import Horizon
from swarmctl.control.mpc.condensed_qp.prediction import Prediction
from tests.benches.condensed_problems import AXIS

EVERY = np.arange(1, 41)  # numbers of increments


def horizon(control: int, spread: bool) -> Horizon:
    return Horizon(control=control, prediction=40, dt_s=0.02, euler=False, spread=spread)


@pytest.mark.parametrize("control", EVERY)
def test_the_first_increments_are_those_of_the_thesis_unless_they_are_spread(control: int) -> None:
    plain = horizon(control, spread=False)
    np.testing.assert_array_equal(plain.starts(), np.arange(control))
    np.testing.assert_array_equal(plain.blocks(), np.ones(control))


@pytest.mark.parametrize("control", EVERY)
def test_spread_increments_begin_with_the_next_step_and_no_two_act_at_once(control: int) -> None:
    starts = horizon(control, spread=True).starts()
    assert starts[0] == 0
    assert (np.diff(starts) >= 1).all()
    assert starts[-1] < 40


@pytest.mark.parametrize("control", [6, 10, 15])
def test_spread_increments_reach_the_last_third_ever_farther_apart(control: int) -> None:
    starts = horizon(control, spread=True).starts()
    assert starts[-1] > 40 * 2 / 3
    assert (np.diff(starts, 2) >= -1).all()  # but for rounding
    assert np.diff(starts)[-1] > np.diff(starts)[0]


@pytest.mark.parametrize("control", [1, 6, 10, 40])
def test_an_increment_may_be_as_large_as_the_steps_since_the_one_before_allow(control: int) -> None:
    spread = horizon(control, spread=True)
    ahead = Prediction((AXIS,), spread)
    np.testing.assert_allclose(ahead.du_max[0].cumsum(), AXIS.du_max * (spread.starts() + 1))
    raised = np.minimum(AXIS.u_max, AXIS.du_max * (spread.starts() + 1))
    np.testing.assert_allclose(ahead.extremes(np.zeros(1))[0, 0].cumsum(), raised)
    most = ahead.increments(np.full(control, 7.0), np.zeros(1))
    assert most[0, 0] == pytest.approx(AXIS.du_max)
    np.testing.assert_allclose((ahead.hold @ most[0])[spread.starts()], raised)
