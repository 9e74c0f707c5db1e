"""Tests of an estimate that jumps in flight: no vehicle flies across the difference, and peers are informed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sitl.lockstep import Lockstep
from swarmctl.mavlink.vehicle import local_frame
from swarmctl.mavlink.vehicle.local_frame import LocalFrame
from tests.closed_loop.conftest import Flight, Fly, closer_than
from tests.closed_loop.test_lost_position import BESIDE, one_is_down, separation_aloft_m

JUMP_M = 5.0
AT_S = 4.0  # mission time of the jump
WATCHED_S = 5.0
BODY_M = 0.48


def fly_with_a_jump(fly: Fly, until: Callable[[Lockstep], bool] | None = None) -> tuple[Flight, float]:
    """The estimate of vehicle 0 jumps 5 m away from vehicle 1, through which it would fly to return."""
    jumped_us: list[int] = []

    def jump(running: Lockstep) -> None:
        pos = running.world.plant.pos_ned_m[:2] + np.array(running.config.starts_ned_m())[:, :2].T
        away = pos[:, 0] - pos[:, 1]
        running.world.estimator.jump(0, np.array([*(JUMP_M * away / np.linalg.norm(away)), 0.0]))
        jumped_us.append(running.clock.now_us())

    def over(running: Lockstep) -> bool:
        return bool(jumped_us) and running.clock.now_us() - jumped_us[0] > WATCHED_S * 1e6

    flight = fly("sitl.start=air", "mission.duration_s=20", at={AT_S: jump}, until=until or over)
    return flight, jumped_us[0] * 1e-6


def test_a_jump_of_the_estimate_keeps_distances_and_is_reported(fly: Fly) -> None:
    flight, jumped_s = fly_with_a_jump(fly)
    assert flight.separation_m() >= 0.85
    assert flight.event_names(0).count("estimate_jumped") == 1
    after = flight.t_s > jumped_s
    step_m_s = np.linalg.norm(np.diff(flight.pos_ned_m[after, 0], axis=0), axis=1) / np.diff(flight.t_s[after])
    assert step_m_s.max() < 3.5, "it flies its mission, at 2.5 m/s, and does not race back"
    others = flight.pos_ned_m[after][:, 1:] - flight.pos_ned_m[after][:, :1]
    apart_m = np.linalg.norm(others, axis=2)  # (T, 2)
    assert apart_m[-1].min() > 1.3, "its peers make room for where else it may be"


def test_negative_control_a_jump_that_is_believed_at_once_ends_in_a_collision(
    fly: Fly, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(LocalFrame, "_fit", lambda *_, **__: None)
    flight, _ = fly_with_a_jump(fly, until=closer_than(BODY_M))
    assert flight.config.separation.body_m == BODY_M
    assert flight.separation_m() < BODY_M
    assert "estimate_jumped" not in flight.event_names(0)


SHORT_JUMP_NED_M = (0.5, 0.0, 0.0)  # away from the other: drawn in, the vehicle comes that much closer


def fly_beside_a_peer(fly: Fly, *sets: str, until: Callable[[Lockstep], bool] | None = None) -> float:
    """Return the least true distance of two that hover 1.2 m apart, while both are in the air."""
    jump = {AT_S: lambda running: running.world.estimator.jump(0, np.array(SHORT_JUMP_NED_M))}
    return separation_aloft_m(fly(*BESIDE, *sets, at=jump, until=until))


@pytest.mark.parametrize("mode", ["best_effort", "guaranteed"])
def test_a_jump_that_has_been_drawn_in_is_still_allowed_for(fly: Fly, mode: str) -> None:
    assert fly_beside_a_peer(fly, f"separation.mode={mode}", until=one_is_down) >= 0.85


def test_negative_control_a_jump_that_was_drawn_in_and_is_forgotten(fly: Fly, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        LocalFrame, "drawn_ned_m", property(lambda self: local_frame._NOTHING, lambda self, _: None), raising=False
    )
    assert fly_beside_a_peer(fly, until=closer_than(0.75)) < 0.75
