"""The end of an encounter: the safety filter goes back to the plan as fast as it has left it."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
import pytest

from swarmctl.agent.flying.safety_filter import SafetyFilter
from swarmctl.agent.sensing.world_model import WorldModel
from swarmctl.control.collision.barrier import Barrier, BarrierParams, Body
from swarmctl.control.estimation.disturbance import Estimate
from swarmctl.control.model import VehicleModelParams
from swarmctl.core.frames import GRAVITY_M_S2
from swarmctl.core.types import Array
from tests import builders

DT_S = 0.02
SLEW = BarrierParams().slew_1_s * DT_S
HOVER = np.array([0.0, 0.0, GRAVITY_M_S2])
AHEAD = Body(pos_ned_m=(0.6, 0.0, -2.0), vel_ned_m_s=(-1.0, 0.0, 0.0), apart_m=0.53, responsibility_01=1.0)


class Scene:
    """A vehicle that wants to hover, and a body that comes at it from the north for a while."""

    def __init__(self) -> None:
        self.bodies_known: list[Body] = []
        self.noted: list[dict[str, Any]] = []
        self.held, self.now_us = HOVER, 0
        self.filter = SafetyFilter(
            BarrierParams(),
            VehicleModelParams(),
            DT_S,
            cast(WorldModel, self),
            downwash=1.0,
            note=lambda _, **fields: self.noted.append(fields),
            stopwatch_ns=lambda: 0,
        )

    def bodies(self, *_: object, **__: object) -> list[Body]:
        return self.bodies_known

    def tick(self, wanted: Array = HOVER, flies: bool = True) -> Array:
        self.now_us += round(DT_S * 1e6)
        start = builders.start(pos_ned_m=np.array([0.0, 0.0, -2.0]), vel_ned_m_s=np.zeros(3), virtual_control=self.held)
        estimate = Estimate(disturbance_ned_m_s2=np.zeros(3), hover_thrust_01=0.5)
        self.held = self.filter.keep_apart(
            self.now_us, self.now_us, wanted, start, estimate=estimate, flies=flies, committed_peers={}
        )
        return self.held

    def driven(self) -> Scene:
        """Fly until the filter tilts the vehicle far away from the body."""
        self.bodies_known = [AHEAD]
        for _ in range(10):
            self.tick()
        self.bodies_known = []
        assert abs(self.held[0]) > 5.0 * SLEW
        return self


def largest_step(scene: Scene, ticks: int = 15) -> float:
    """Return the largest change of u_x from one tick to the next."""
    flown = [scene.held[0], *(scene.tick()[0] for _ in range(ticks))]
    return float(np.abs(np.diff(flown)).max())


def test_after_an_encounter_the_attitude_goes_back_as_fast_as_it_came() -> None:
    scene = Scene().driven()
    assert largest_step(scene) <= SLEW + 1e-9
    assert scene.tick() is HOVER
    assert not scene.filter.acts


def test_negative_control_at_once_it_is_a_step_that_saturates_rotors(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Barrier, "eased", lambda _, wanted, __: wanted)
    assert largest_step(Scene().driven()) > 5.0 * SLEW


def test_it_acts_until_the_plan_is_flown_again() -> None:
    scene = Scene().driven()
    acted = 0
    while scene.filter.acts:
        scene.tick()
        acted += scene.filter.acts
    assert acted >= 5
    while len(scene.noted) < 2:
        scene.tick()
    assert scene.noted == [{"acts": True}, {"acts": False, "ticks": 10 + acted}]


def test_commands_of_a_plan_are_not_slowed_down_without_an_encounter() -> None:
    scene, steep = Scene(), np.array([0.3, -0.3, GRAVITY_M_S2])
    assert scene.tick(steep) is steep


def test_nothing_is_changed_while_the_autopilot_flies() -> None:
    assert Scene().driven().tick(flies=False) is HOVER


def test_a_command_that_is_no_number_is_left_for_the_output_to_refuse() -> None:
    broken = np.array([np.nan, 0.0, GRAVITY_M_S2])
    assert Scene().driven().tick(broken) is broken
