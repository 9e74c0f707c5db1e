"""Which paths are published, and what they say of the setpoint that has left with them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from swarmctl.agent import assembly
from swarmctl.agent.sharing.path_publisher import PathPublisher
from swarmctl.bus.messages.path_messages import decode_path
from swarmctl.config import load
from swarmctl.core.types import Array, Plan, PlanStatus, PredictedPath
from tests import builders

TICK_US, STEPS = 20_000, 5
AHEAD = np.array([1.0, 0.0, 0.0])
PX4, ARDUCOPTER = (0.5, 0.5), (1.0, 2.0)


class Bench:
    """A publisher whose vehicle rests, and the paths that it has published."""

    def __init__(self, loss_s: tuple[float | None, float | None] = PX4) -> None:
        setup = assembly._setup_of(load(None, ["swarm.agents=2"]), 0, 1, {})
        self.now_us, self.unheard_us = 5_000_000, cast(int | None, None)
        self.paths: list[PredictedPath] = []
        autopilot = SimpleNamespace(
            setpoint_loss_s=loss_s[0], landing_delay_s=loss_s[1], unheard_since_us=lambda now_us: self.unheard_us
        )
        ports: Any = SimpleNamespace(
            bus=SimpleNamespace(publish=self._take), autopilot=autopilot, utc_of_us=lambda t_us: t_us
        )
        grid: Any = SimpleNamespace(dt_us=TICK_US, steps=STEPS)
        self._publisher = PathPublisher(setup, ports, grid, 0, widens_in_gusts=False)

    def _take(self, topic: Any, payload: bytes) -> None:
        path = decode_path(payload)
        assert path is not None
        self.paths.append(path)

    def tick(self, accel_ned_m_s2: Array | None, *, as_committed: bool = True, flies: bool = True) -> None:
        self.now_us += TICK_US
        state = builders.vehicle_state(t_us=self.now_us)
        plan = Plan(
            status=PlanStatus.OK,
            t0_us=self.now_us,
            dt_us=TICK_US,
            pos_ned_m=np.tile(state.pos_ned_m, (STEPS + 1, 1)),
            vel_ned_m_s=np.zeros((STEPS + 1, 3)),
            virtual_control=np.zeros((STEPS, 3)),
        )
        self._publisher.publish(
            self.now_us,
            state,
            plan if flies else None,
            1,
            setpoint_accel_ned_m_s2=accel_ned_m_s2,
            disturbance_ned_m_s2=np.zeros(3),
            margins_m=(),
            as_committed=as_committed,
        )


def test_each_path_says_what_the_setpoint_asks_for() -> None:
    bench = Bench()
    bench.tick(AHEAD, as_committed=False)
    bench.tick(None, as_committed=False)
    asked, none = (path.setpoint_accel_ned_m_s2 for path in bench.paths)
    assert asked is not None and none is None
    np.testing.assert_allclose(asked, AHEAD, atol=1e-3)


def test_of_a_setpoint_that_the_vehicle_may_not_have_heard_nothing_is_said() -> None:
    bench = Bench()
    bench.unheard_us = bench.now_us
    bench.tick(AHEAD)
    bench.tick(AHEAD, flies=False)
    assert [path.setpoint_accel_ned_m_s2 for path in bench.paths] == [None, None]


@pytest.mark.parametrize(
    ("loss_s", "change_m_s2", "told_at_once"),
    [(PX4, 0.7, False), (PX4, 0.9, True), (ARDUCOPTER, 0.12, False), (ARDUCOPTER, 0.18, True)],
    ids=["px4", "px4: 0.3 m off", "arducopter", "arducopter: 0.3 m off"],
)
def test_one_that_flies_as_committed_tells_at_once_where_its_last_setpoint_would_take_it(
    loss_s: tuple[float, float], change_m_s2: float, told_at_once: bool
) -> None:
    bench = Bench(loss_s)
    bench.tick(AHEAD)
    bench.tick(AHEAD)
    assert len(bench.paths) == 1, "peers know it from what is committed"
    bench.tick(AHEAD + np.array([0.0, change_m_s2, 0.0]))
    assert (len(bench.paths) == 2) is told_at_once


def test_until_it_is_known_how_long_the_autopilot_keeps_the_attitude_all_paths_are_told() -> None:
    bench = Bench((None, None))
    for _ in range(3):
        bench.tick(AHEAD)
    assert len(bench.paths) == 3
