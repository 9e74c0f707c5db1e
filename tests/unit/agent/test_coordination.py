"""Which acknowledgements count, and which peers are kept clear of in spite of a commitment."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from swarmctl.bus import topics
from swarmctl.bus.messages.commitment_messages import decode_trajectory_message
from swarmctl.bus.messages.json_messages import encode_message
from swarmctl.control.collision.encounters import Encounters
from swarmctl.control.collision.separation import SeparationParams
from swarmctl.core.trajectory_message import Exclusions, Reach
from swarmctl.core.types import Phase
from tests import builders
from tests.benches.agent_and_peer import HERE, PEER, PLACE, SPEED_M_S, STRETCH_M, Bench


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_a_peer_that_acknowledges_lets_us_fly_and_one_that_does_not_does_not(bench: Bench) -> None:
    bench.fly(1.0, each=bench.send)
    before = bench.committed
    assert before > 3
    bench.fly(2.0)
    assert bench.committed == before


def test_a_missing_token_is_no_evidence_that_a_peer_has_died(bench: Bench) -> None:
    bench.fly(1.0, each=bench.send)
    before = bench.committed
    bench.alive.discard(PEER)
    bench.fly(5.0)
    assert bench.committed == before, "it may be cut off, and fly on without our acknowledgement"
    assert list(bench.coordination.committed_peers) == [1], "nor is its silence a reason to doubt its commitment"
    bench.world_model.statuses.exclude(1)
    bench.fly(0.5)
    assert bench.coordination.committed_peers == {}
    assert bench.committed > before, "somebody vouches that it has ended"


def test_a_peer_that_was_heard_landed_and_disarmed_is_not_waited_for(bench: Bench) -> None:
    bench.fly(1.0, each=bench.send)
    before = bench.committed
    bench.fly(1.0)
    assert bench.committed == before
    done = builders.status_message(agent=1, phase=Phase.DONE, utc_us=bench.clock.utc_us())
    bench.peer.publish(topics.STATUS, encode_message(done))
    bench.fly(0.5)
    assert bench.committed > before


def test_a_peer_that_flies_in_best_effort_is_not_waited_for_until_it_commits_again(bench: Bench) -> None:
    bench.fly(1.0, each=bench.send)
    before = bench.committed
    bench.fly(1.0)
    assert bench.committed == before
    for commits in (False, True):
        status = builders.status_message(agent=1, utc_us=bench.clock.utc_us())
        said = msgspec.structs.replace(status, uses_commitments=commits, ticks=100 + commits)
        bench.peer.publish(topics.STATUS, encode_message(said))
        bench.fly(0.5)
        assert (bench.committed > before) is not commits
        bench.fly(1.0)  # what was proposed meanwhile is decided
        before = bench.committed


def test_of_two_that_do_not_hear_each_other_none_excludes_the_other_and_both_land(bench: Bench) -> None:
    bench.fly(1.0, each=bench.send)
    before = bench.committed
    bench.fly(19.0)
    assert bench.coordination.cut_off == ""
    assert ("membership", {"suspected": [1], "promised": [], "excluded": []}) in bench.told
    bench.fly(2.0)
    assert bench.coordination.cut_off == "cut off from agent-1"
    assert bench.committed == before
    bench.fly(0.1, each=bench.send)
    assert bench.coordination.cut_off == "", "who is heard again is waited for again"
    assert ("membership", {"suspected": [], "promised": [], "excluded": []}) in bench.told


@pytest.mark.parametrize("excludes", [True, False])
def test_who_never_came_and_is_excluded_takes_nobodys_vote_away(excludes: bool) -> None:
    """None of the others suspected anybody: of a host that was lost they were cut off, and landed."""
    bench = Bench(peers=(1, 2))
    if excludes:
        bench.world_model.statuses.exclude(2)
    bench.fly(1.0, each=bench.send)
    bench.fly(6.0)
    suspects = ("membership", {"suspected": [1], "promised": [], "excluded": []}) in bench.told
    assert suspects is excludes, "who may have been started again amid the flight makes no promises"


def test_an_excluded_agent_lands_where_it_is(bench: Bench) -> None:
    bench.fly(1.0, each=bench.send)
    bench.exclusions = Exclusions(promised=frozenset({0}))
    bench.fly(0.1, each=bench.send)
    assert bench.coordination.cut_off == "excluded by agent-1 after silence"


def test_nothing_is_proposed_while_the_clock_of_a_peer_is_not_known(bench: Bench) -> None:
    bench.ahead_us = 1_500_000  # as late as an answer may seem to be, the two clocks may differ
    bench.fly(1.0, each=bench.send)
    assert bench.committed == 0
    assert bench.coordination.alert == "the clock of agent-1 is not known well enough"


def test_a_peer_that_has_widened_its_tube_is_kept_clear_of_by_its_path(bench: Bench) -> None:
    bench.fly(1.0, each=bench.send)
    assert 1 in bench.coordination.committed_peers
    bench.tube_m = 0.5
    bench.fly(0.1, each=bench.send)
    assert bench.coordination.committed_peers == {}


def test_a_vehicle_off_its_commitment_commits_anew_tells_peers_and_stops(bench: Bench) -> None:
    bench.fly(1.0, each=bench.send)
    assert (bench.coordination.margin_m, bench.coordination.alert) == (0.0, "")
    for times in (1, 2, 3):
        bench.blown_m = np.array([0.0, 0.8 * times, 0.0])
        bench.fly(0.04, each=bench.send)
        place, _ = bench.coordination.sample_committed(np.array([bench.clock.utc_us()]))
        np.testing.assert_allclose(place[0], HERE + bench.blown_m, atol=0.05)
    assert bench.coordination.alert == "blown off what it had committed to: stopped"
    before = bench.coordination.counts.proposed
    bench.fly(0.5, each=bench.send)
    assert bench.coordination.counts.proposed == before
    bench.fly(1.0, each=bench.send)
    assert bench.coordination.counts.proposed > before, "it has stayed in its tube for a second"
    grips = [fields["grip"] for name, fields in bench.told if name == "tracking_violation"]
    assert grips == ["WIDENED", "STOPPED", "HELD"]


def test_who_has_ended_gets_no_acknowledgement(bench: Bench) -> None:
    """A false word about its end must not let two fly without each other's acknowledgement."""
    bench.proposes = True
    bench.fly(0.5, each=bench.send)
    assert bench.acknowledged == {1: 5}
    bench.world_model.statuses.exclude(1)
    bench.fly(0.1, each=bench.send)
    assert bench.acknowledged == {}


def test_the_committed_end_of_a_lost_peer_is_a_keep_out(bench: Bench) -> None:
    """No commitment leads there any more, so an agent that is blocked has to look for a path around it."""
    bench.fly(2.5, each=bench.send)
    assert bench.coordination.lost_peer_keep_outs == []
    bench.world_model.statuses.exclude(1)
    bench.fly(0.3)
    (left,) = bench.coordination.lost_peer_keep_outs
    assert left.priority_id == 1
    assert left.pos_ned_m[0] == pytest.approx(PLACE)
    bench.coordination.idle(bench.clock.utc_us(), None)
    assert bench.coordination.lost_peer_keep_outs == []


def test_a_deviating_peer_is_where_its_path_says(bench: Bench) -> None:
    bench.fly(0.5, each=bench.send)
    assert set(bench.coordination.committed_peers) == {1}
    aside = PLACE + np.array([0.0, 0.5, 0.0])
    bench.fly(0.5, each=lambda: bench.send(aside))
    assert bench.coordination.committed_peers == {}
    (body,) = bench.world_model.bodies(
        HERE, bench.clock.utc_us(), 0.0, 0.0, committed_peers=bench.coordination.committed_peers
    )
    assert body.pos_ned_m == pytest.approx(tuple(aside))


def test_the_margin_of_a_committed_peer_does_not_grow_with_age(bench: Bench) -> None:
    bench.fly(0.5, each=bench.send)
    bench.fly(1.0)
    utc_us, apart_m = bench.clock.utc_us(), SeparationParams().body_m
    bodies = bench.world_model.bodies(HERE, utc_us, 0.0, 0.0, committed_peers=bench.coordination.committed_peers)
    assert {body.apart_m for body in bodies} == {apart_m}
    (control,) = bench.world_model.bodies(HERE, utc_us, 0.0, 0.0, committed_peers={})
    assert control.apart_m > apart_m + 0.9, "a path as old may have been left by a metre"


def test_the_certificate_against_a_stale_peer_has_all_of_its_margin(bench: Bench) -> None:
    bench.fly(0.5, each=bench.send)
    bench.fly(1.0)
    utc_us, params = bench.clock.utc_us(), SeparationParams()
    (kept,) = bench.coordination._other_keep_outs(utc_us, bench.state, Phase.TRACK, set(), Encounters())
    (control,) = bench.world_model.keep_outs(HERE, utc_us, 100_000, 5, phase=Phase.TRACK)
    assert control.hard_min_distance_m == params.budget.hard_min_distance_m, "which would not grow with age"
    assert kept.hard_min_distance_m > params.budget.planned_m + 0.5


def test_an_encounter_with_who_does_not_take_part_is_measured_from_where_it_began(bench: Bench) -> None:
    """Plan by plan, each 2 cm closer than the one before, an agent would come as close as it wants."""
    bench.tube_m = 0.5  # the peer is where its path says

    def came_m(north_m: float) -> float | None:
        bench.fly(0.1, each=lambda: bench.send(HERE + np.array([north_m, 0.0, 0.0])))
        encounters = bench.coordination._entered_now
        (kept,) = bench.coordination._other_keep_outs(bench.clock.utc_us(), bench.state, Phase.TRACK, set(), encounters)
        return kept.entered_m

    bench.fly(0.2, each=bench.send)
    assert came_m(3.0) is None
    entered_m = came_m(0.75)
    assert entered_m == pytest.approx(0.75, abs=0.02)
    assert came_m(0.70) == entered_m
    assert came_m(0.60) == entered_m


def test_an_agent_without_a_state_commits_nothing(bench: Bench) -> None:
    bench.fly(1.0, each=bench.send)
    bench.coordination.idle(bench.clock.utc_us(), None)
    bench.coordination.publish(bench.clock.utc_us(), unsure_m=0.0, relays=True)
    bench.clock.advance(20_000)
    *_, (_, payload) = bench.peer.receive(topics.TRAJECTORY)
    message = decode_trajectory_message(payload)
    assert message is not None
    assert not message.is_committed and message.proposal is None
    assert [name for name, _ in bench.told] == ["commitments"]


@pytest.fixture
def far_bench() -> Bench:
    """The peer rests 30 m away, and has told that the agent is far from it, too."""
    made = Bench(far_hz=4.0)
    made.place = np.array([30.0, 0.0, -2.0])
    made.reach = Reach(far=frozenset({0}), speed_m_s=SPEED_M_S, stretch_m=STRETCH_M)
    return made


def committed_unanswered(bench: Bench) -> int:
    """Return how often the agent commits in a second in which the peer hears it, and acknowledges nothing."""
    bench.fly(1.0, each=bench.send)
    before, bench.answers = bench.committed, False
    bench.fly(1.0, each=bench.send)
    return bench.committed - before


def test_a_far_peer_need_not_acknowledge(far_bench: Bench, bench: Bench) -> None:
    assert committed_unanswered(far_bench) > 3
    assert committed_unanswered(bench) == 0


def test_a_far_peer_that_falls_silent_has_to_acknowledge_once_the_lease_is_over(far_bench: Bench) -> None:
    far_bench.fly(1.0, each=far_bench.send)
    far_bench.fly(1.7)
    before = far_bench.committed
    far_bench.fly(3.0)
    assert far_bench.committed == before


@pytest.mark.parametrize(("away_m", "was_far"), [(8.0, True), (8.0, False), (30.0, True), (300.0, True)])
def test_an_excluded_peer_matters_only_where_it_may_have_committed_unseen(
    far_bench: Bench, away_m: float, was_far: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is silent, and a majority has excluded it; at 8 m it is nearer than it may have come."""
    far_bench.place = np.array([away_m, 0.0, -2.0])
    far_bench.reach = replace(far_bench.reach, far=frozenset({0}) if was_far else frozenset())
    far_bench.fly(1.0, each=far_bench.send)
    monkeypatch.setattr(far_bench.coordination._membership, "excluded", frozenset({1}))
    far_bench.fly(2.0)
    before = far_bench.committed
    far_bench.fly(1.0)
    assert (far_bench.committed == before) is (was_far and away_m == 8.0)


def test_a_peer_that_is_far_hears_a_few_messages_a_second(far_bench: Bench) -> None:
    heard = far_bench.peer.receive
    far_bench.fly(1.0, each=far_bench.send)
    counted = dict.fromkeys((topics.TRAJECTORY, topics.FAR_TRAJECTORY), 0)

    def count() -> None:
        for topic in counted:
            counted[topic] += len(heard(topic))

    far_bench.fly(2.0, each=count)
    assert 6 <= counted[topics.FAR_TRAJECTORY] <= 20
    assert counted[topics.TRAJECTORY] >= 40


@pytest.mark.parametrize("is_promised", [True, False])
def test_who_is_promised_to_be_excluded_is_told_of_nothing_later_that_was_heard(
    far_bench: Bench, is_promised: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its lease ends, although it goes on sending, and hears the agent."""
    told_us: list[int] = []

    def note() -> None:
        far_bench.send()
        for _, payload in far_bench.peer.receive(topics.FAR_TRAJECTORY):
            message = decode_trajectory_message(payload)
            assert message is not None
            told_us.extend(stamp_us for agent, (stamp_us, _) in message.heard.items() if agent == 1)

    far_bench.fly(2.0, each=note)
    assert told_us[-1] > told_us[0]
    if is_promised:
        monkeypatch.setattr(far_bench.coordination._membership, "_promised", frozenset({1}))
    told_us.clear()
    far_bench.fly(4.0, each=note)
    assert (len(set(told_us)) == 1) is is_promised


@pytest.mark.parametrize(("far_hz", "share_01"), [(2.0, 1.0), (4.0, 0.5)])
def test_seldom_messages_to_all_say_each_time_what_was_heard_of_who_is_far(far_hz: float, share_01: float) -> None:
    """Half of them in turns, as with 4 Hz, one lost message would let the lease end."""
    bench, told = Bench(far_hz=far_hz), list[bool]()
    bench.place, bench.reach = (
        np.array([30.0, 0.0, -2.0]),
        Reach(far=frozenset({0}), speed_m_s=SPEED_M_S, stretch_m=STRETCH_M),
    )

    def note() -> None:
        bench.send()
        for _, payload in bench.peer.receive(topics.FAR_TRAJECTORY):
            message = decode_trajectory_message(payload)
            assert message is not None
            told.append(1 in message.heard)

    bench.fly(1.0, each=note)
    told.clear()
    bench.fly(6.0, each=note)
    assert sum(told) / len(told) == pytest.approx(share_01, abs=0.1)


@pytest.mark.parametrize("has_ended", [True, False])
def test_a_far_peer_that_has_ended_makes_no_proposal_ask_all(far_bench: Bench, has_ended: bool) -> None:
    far_bench.fly(1.0, each=far_bench.send)
    if has_ended:
        far_bench.world_model.statuses.exclude(1)
    far_bench.fly(2.0)  # its lease ends
    far_bench.peer.receive(topics.FAR_TRAJECTORY)
    far_bench.fly(1.0)
    said = [decode_trajectory_message(payload) for _, payload in far_bench.peer.receive(topics.FAR_TRAJECTORY)]
    asked = {message.proposal.asks_far for message in said if message is not None and message.proposal is not None}
    assert (True in asked) is not has_ended


def test_a_peer_that_is_heard_and_answers_no_proposal_is_named() -> None:
    """It may have been told that this agent has ended, which others know better."""
    bench = Bench()
    bench.fly(1.0, each=bench.send)
    assert bench.coordination.alert == ""
    bench.answers = False
    bench.fly(12.0, each=bench.send)
    assert bench.coordination.alert == "agent-1 answers no proposal, and may take it for ended"
    bench.answers = True
    bench.fly(3.0, each=bench.send)
    assert bench.coordination.alert == ""
