"""Rows that closed-loop tests play."""

from __future__ import annotations

from tests.faults.elsewhere import ElsewhereRow

_IN = "tests/closed_loop/"


def _row(
    name: str, event: str, reaction: str, within_s: float, protection: str, file: str, test: str, control: str
) -> ElsewhereRow:
    where = f"{_IN}{file}::test_"
    return ElsewhereRow(
        name=name,
        event=event,
        reaction=reaction,
        within_s=within_s,
        protection=protection,
        test=where + test,
        control=where + control,
    )


ROWS = tuple(
    _row(*words)
    for words in (
        (
            "agent-stopped-0.3s",
            "an agent is stopped for 0.32 s",
            "it goes on before the autopilot's failsafe acts",
            0.4,
            "the mode is asked for after a pause",
            "test_gaps.py",
            "an_agent_stopped_for_a_third_of_a_second_continues_before_a_failsafe_acts",
            "negative_control_who_waits_to_be_told_the_mode_loses_the_vehicle",
        ),
        (
            "telemetry-gap-guaranteed",
            "telemetry of a vehicle stops for 0.35 s, with guaranteed separation",
            "what it has committed to is kept",
            0.35,
            "commitments outlive a short gap",
            "test_gaps.py",
            "a_short_telemetry_gap_keeps_what_is_committed",
            "negative_control_an_agent_that_idles_in_a_gap_commits_anew_at_speed",
        ),
        (
            "plan-too-close",
            "the plans of all agents would violate true distances",
            "they are not flown",
            8.0,
            "the certificate",
            "test_failures.py",
            "a_plan_that_would_come_too_close_is_not_flown",
            "a_plan_that_would_come_too_close_is_not_flown",
        ),
        (
            "agent-killed-takeoff",
            "an agent dies before OFFBOARD",
            "its autopilot lands and disarms the vehicle",
            40.0,
            "data-link failsafe of the autopilot",
            "test_takeoff_loss.py",
            "a_vehicle_whose_agent_dies_before_offboard_is_disarmed_within_forty_seconds",
            "negative_control_without_the_data_link_failsafe_it_hovers_armed",
        ),
        (
            "agent-restarted",
            "an agent is started again while its autopilot flies home",
            "it leaves control to the failsafe until an operator says so",
            2.0,
            "control is asked for, never taken by streaming",
            "test_handover.py",
            "a_restarted_agent_leaves_control_to_an_active_failsafe",
            "negative_control_streaming_to_a_vehicle_that_is_not_ours_takes_it",
        ),
        (
            "landed-at-speed",
            "an operator lands four agents where they cross",
            "they brake and make room before their autopilots land them",
            10.0,
            "landings begin at rest, apart",
            "test_handover.py",
            "a_landing_at_speed_among_others_brakes_and_moves_apart_first",
            "negative_control_an_autopilot_that_lands_at_speed_among_others_comes_too_close",
        ),
        (
            "peer-boot-id",
            "paths are forged under each agent's name, of another boot id and of the highest number",
            "the flight is bit for bit what it was; the run tells",
            2.0,
            "boot ids and numbers have to be plausible",
            "test_forgery.py",
            "forged_paths_change_nothing_and_are_reported",
            "negative_control_where_the_newest_is_believed_they_meet",
        ),
        (
            "messages-late-and-lost",
            "messages are 300 ms late and 30 % are lost, with guaranteed separation",
            "all arrive, at the distance that is committed to",
            40.0,
            "plans know of peers",
            "test_guaranteed.py",
            "late_and_lost_messages_cost_time_and_no_distance",
            "negative_control_agents_that_see_nobody_touch",
        ),
        (
            "split-halves",
            "the swarm falls into two halves that don't hear each other, for good",
            "both come to rest",
            12.0,
            "who is silent is waited for",
            "test_guaranteed_cut_off.py",
            "two_halves_that_are_cut_off_from_each_other_both_come_to_rest",
            "negative_control_halves_that_take_missing_tokens_for_deaths_collide",
        ),
        (
            "clocks-apart",
            "the clocks of hosts differ by a second, and drift",
            "all arrive, at the distance that is committed to",
            40.0,
            "offsets of clocks are measured on the messages",
            "test_guaranteed.py",
            "agents_whose_clocks_differ_by_a_second_keep_apart",
            "negative_control_by_stamps_as_they_are_agents_touch",
        ),
        (
            "all-starved",
            "all agents miss nine of ten deadlines",
            "wider distances, rest far apart, landing",
            15.0,
            "response to missed deadlines (agent.overload)",
            "test_overload.py",
            "agents_missing_nine_of_ten_deadlines_come_to_rest_far_apart_and_land",
            "negative_control_without_the_reaction_they_come_too_close",
        ),
        (
            "state-misdated",
            "states of another time come in the vehicle's name",
            "the flight is bit for bit what it was",
            0.1,
            "stamps far away are dropped",
            "test_stamps.py",
            "forged_states_of_another_time_change_no_bit_of_the_flight",
            "negative_control_believed_at_once_they_end_the_mission",
        ),
        (
            "estimate-jumps-among-others",
            "the estimate of a vehicle jumps by 5 m, away from a peer",
            "it flies on from where it was, its peers keep that much more away",
            5.0,
            "jumps are bridged",
            "test_jumps.py",
            "a_jump_of_the_estimate_keeps_distances_and_is_reported",
            "negative_control_a_jump_that_is_believed_at_once_ends_in_a_collision",
        ),
        (
            "wind-steps",
            "a wind of 8 m/s hits each of six vehicles from one instant to the next",
            "who is blown out of its tube commits anew; all keep apart",
            4.0,
            "commitments widen with what a vehicle is off",
            "test_gusts.py",
            "vehicles_that_are_blown_out_of_their_tubes_commit_anew_and_keep_apart",
            "negative_control_vehicles_that_chase_what_they_were_committed_to_touch",
        ),
    )
)
