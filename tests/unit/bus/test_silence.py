"""When a session of the bus counts as deaf."""

from __future__ import annotations

import pytest

from swarmctl.bus.silence import SilenceWatch

STEP_S = 0.02


def deaf_at_s(watch: SilenceWatch, begin_s: float, end_s: float, step_s: float = STEP_S) -> list[float]:
    """Return when a watch that looks in these steps says that the session is deaf."""
    steps = round((end_s - begin_s) / step_s)
    return [round(t_s, 1) for t_s in (begin_s + k * step_s for k in range(steps)) if watch.is_deaf(t_s)]


def test_a_session_that_has_heard_and_hears_nobody_for_3_s_is_deaf() -> None:
    watch = SilenceWatch(3.0)
    watch.hear()
    assert deaf_at_s(watch, 0.0, 2.9) == []
    assert deaf_at_s(watch, 2.9, 3.5) == [3.0]


def test_while_silence_goes_on_it_is_replaced_less_and_less_often() -> None:
    watch = SilenceWatch(3.0)
    watch.hear()
    assert deaf_at_s(watch, 0.0, 50.0) == pytest.approx([3.0, 9.0, 21.0, 45.0], abs=0.2)
    watch.hear()
    assert deaf_at_s(watch, 50.0, 54.0) == pytest.approx([53.0], abs=0.2)


def test_who_has_never_heard_anybody_may_be_alone() -> None:
    assert deaf_at_s(SilenceWatch(3.0), 0.0, 100.0) == []


def test_time_in_which_the_process_did_not_run_does_not_count() -> None:
    watch = SilenceWatch(3.0)
    watch.hear()
    assert deaf_at_s(watch, 0.0, 1.0) == []
    assert not watch.is_deaf(20.0), "it was stopped, or got no processor"
    assert deaf_at_s(watch, 20.0, 21.0) == []


def test_control_time_counts_where_a_process_looks() -> None:
    watch = SilenceWatch(3.0)
    watch.hear()
    assert deaf_at_s(watch, 0.0, 5.0, step_s=0.4)
