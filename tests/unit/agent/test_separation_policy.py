"""What each separation policy asks of a tick."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from swarmctl.agent.components import SEPARATION_MODES
from swarmctl.agent.planning.separation_policy import BestEffort, Guaranteed, SeparationInputs, SeparationPolicy
from swarmctl.control.collision.keep_outs import KeepOuts
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.control.commit.situation import DesiredReference
from swarmctl.core.types import Phase
from tests import builders
from tests.benches.agent_and_peer import HERE, PLACE, Bench

YAW_RAD = 0.3
KEEP_OUT = builders.keep_out(pos_ned_m=np.tile(PLACE, (3, 1)))


@pytest.fixture
def bench() -> Bench:
    return Bench()


def inputs(bench: Bench) -> SeparationInputs:
    utc_us = bench.clock.utc_us()
    return SeparationInputs(
        utc_us=utc_us,
        state=bench.state,
        state_utc_us=utc_us,
        phase=Phase.TRACK,
        desired=DesiredReference(bench.wanted),
        horizon_utc_us=utc_us + np.arange(6) * 100_000,
        keep_outs=KeepOuts([KEEP_OUT]),
        disturbance_ned_m_s2=np.zeros(3),
    )


def guaranteed(bench: Bench) -> Guaranteed:
    times_ns = iter(range(0, 10_000, 7))
    return Guaranteed(bench.coordination, YAW_RAD, lambda: next(times_ns))


def test_there_is_a_policy_for_every_mode_of_the_configuration() -> None:
    assert set(SEPARATION_MODES) == set(get_args(SeparationParams.model_fields["mode"].annotation))


def test_best_effort_plans_along_the_desired_reference_around_all_keep_outs(bench: Bench) -> None:
    policy: SeparationPolicy = BestEffort(bench.world_model)
    bench.fly(0.5, each=bench.send)
    for directive in (
        policy.step(inputs(bench)),
        policy.idle(bench.clock.utc_us(), bench.state, KeepOuts([KEEP_OUT])),
    ):
        assert directive.reference is None
        assert directive.keep_outs == (KEEP_OUT,)
        assert directive.committed_peers == {} and directive.lost_peer_keep_outs == ()
        assert not directive.unresponsive_peer and directive.duration_ns == 0
    assert policy.commits_refused is None and not policy.uses_commitments


def test_best_effort_waits_for_a_silent_peer_also_without_a_state_and_guaranteed_does_not(bench: Bench) -> None:
    bench.fly(0.5, each=bench.send)
    bench.fly(1.0)
    utc_us = bench.clock.utc_us()
    assert BestEffort(bench.world_model).step(inputs(bench)).unresponsive_peer
    assert BestEffort(bench.world_model).idle(utc_us, None, KeepOuts()).unresponsive_peer
    assert not guaranteed(bench).step(inputs(bench)).unresponsive_peer
    assert not guaranteed(bench).idle(utc_us, None, KeepOuts()).unresponsive_peer


def test_guaranteed_follows_the_committed_trajectory_and_names_committed_peers(bench: Bench) -> None:
    bench.fly(0.5, each=bench.send)
    policy: SeparationPolicy = guaranteed(bench)
    directive = policy.step(inputs(bench))
    assert directive.reference is not None
    assert directive.reference.pos_ned_m == pytest.approx(np.tile(HERE, (6, 1)), abs=0.05)
    assert directive.reference.yaw_rad == YAW_RAD
    assert directive.keep_outs == (), "the committed trajectory keeps clear of them"
    assert set(directive.committed_peers) == {1}
    assert directive.duration_ns == 7
    assert policy.commits_refused == 0 and policy.uses_commitments


def test_guaranteed_names_the_keep_outs_of_lost_peers(bench: Bench) -> None:
    bench.fly(2.5, each=bench.send)
    bench.world_model.statuses.exclude(1)
    bench.fly(0.3)
    directive = guaranteed(bench).step(inputs(bench))
    assert [keep_out.priority_id for keep_out in directive.lost_peer_keep_outs] == [1]
    assert directive.committed_peers == {}


def test_guaranteed_names_why_an_agent_is_cut_off(bench: Bench) -> None:
    bench.fly(0.5, each=bench.send)
    assert guaranteed(bench).step(inputs(bench)).cut_off == ""
    bench.fly(21.0)
    assert guaranteed(bench).step(inputs(bench)).cut_off == "cut off from agent-1"


def test_guaranteed_leaves_an_agent_that_does_not_fly_to_its_controller(bench: Bench) -> None:
    bench.fly(0.5, each=bench.send)
    directive = guaranteed(bench).idle(bench.clock.utc_us(), bench.state, KeepOuts([KEEP_OUT]))
    assert directive.reference is None
    assert directive.keep_outs == (KEEP_OUT,)
    assert directive.committed_peers == {} and directive.lost_peer_keep_outs == ()
    assert directive.duration_ns == 0
