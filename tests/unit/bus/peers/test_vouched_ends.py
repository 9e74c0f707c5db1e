"""Which ends of agents' processes are believed, and of whom: an end names a process, and says nothing of the next."""

from __future__ import annotations

from swarmctl.bus.messages.json_messages import EndedMessage, encode_message
from swarmctl.bus.peers.vouched_ends import VouchedEnds
from swarmctl.bus.refusals import IDENTITY, MALFORMED, SEQUENCE

ALPHA, BRAVO = "alpha", "bravo"
MOST = 64  # processes of one agent


def ends() -> VouchedEnds:
    return VouchedEnds({ALPHA: {0, 1}, BRAVO: {2}})


def told(known: VouchedEnds, agent: int, boot_id: int | None, *, is_down: bool = False, sender: str = ALPHA) -> str:
    """Tell an end; return "news", "", or why it is refused."""
    message = EndedMessage(agent=agent, boot_id=boot_id, is_down=is_down)
    found, refusal = known.take(sender, encode_message(message))
    assert found in (None, message)
    return refusal or ("news" if found else "")


def test_an_end_is_of_one_process_and_not_of_the_one_that_follows() -> None:
    known = ends()
    assert told(known, 1, 7) == "news"
    assert known.has_ended(1, 7)
    assert not known.has_ended(1, 8)
    assert not known.has_ended(0, 7)


def test_a_repeated_end_is_no_news() -> None:
    known = ends()
    told(known, 1, 7)
    assert told(known, 1, 7) == ""


def test_nobody_is_believed_of_agents_that_run_elsewhere() -> None:
    known = ends()
    assert told(known, 2, 7) == IDENTITY
    assert told(known, 1, 7, sender=BRAVO) == IDENTITY
    assert told(known, 1, 7, sender="agent-1") == IDENTITY
    assert known.take(ALPHA, b"{}") == (None, MALFORMED)
    assert not known.has_ended(2, 7) and not known.has_ended(1, 7) and not known.has_ended(1, None)


def test_of_an_agent_that_was_never_heard_any_process_that_ended_was_the_one() -> None:
    known = ends()
    assert not known.has_ended(1, None)
    told(known, 1, 7)
    assert known.has_ended(1, None)


def test_an_end_of_a_process_that_its_supervisor_never_heard_is_not_that_of_one_heard_here() -> None:
    known = ends()
    told(known, 1, None)
    assert known.has_ended(1, None) and not known.has_ended(1, 7)


def test_a_vehicle_is_down_as_the_process_that_ended_last_has_left_it() -> None:
    known = ends()
    told(known, 1, 7)
    assert not known.is_down(1, 7)
    told(known, 1, 8, is_down=True)  # it was recovered
    assert known.is_down(1, 7) and known.is_down(1, 8)
    assert not known.is_down(1, 9), "another process flies it"
    told(known, 1, 9)
    assert not known.is_down(1, 7)


def test_who_recovered_a_vehicle_unheard_is_told_of_as_the_process_before() -> None:
    known = ends()
    told(known, 1, 7)
    assert told(known, 1, 7, is_down=True) == "news"
    assert known.is_down(1, 7)


def test_an_end_that_is_corrected_is_the_newest() -> None:
    known = ends()
    told(known, 1, 7)
    told(known, 1, 8)
    told(known, 1, 7, is_down=True)
    assert known.is_down(1, 8)


def test_an_operators_word_is_of_the_process_heard_and_claims_no_landing() -> None:
    known = ends()
    known.vouch(2, 7)
    assert known.has_ended(2, 7) and not known.has_ended(2, 8) and not known.is_down(2, 7)
    told(known, 2, 7, is_down=True, sender=BRAVO)
    known.vouch(2, 7)
    assert known.is_down(2, 7), "nor does it take one back"


def test_who_runs_an_agent_can_not_fill_memory_with_its_ends() -> None:
    known = ends()
    assert {told(known, 1, boot_id) for boot_id in range(MOST)} == {"news"}
    assert told(known, 1, MOST) == SEQUENCE
    assert not known.has_ended(1, MOST)
    assert told(known, 0, MOST) == "news", "those of another agent are counted apart"


def test_a_full_memory_takes_corrections_and_stays_full_whatever_an_operator_adds() -> None:
    known = ends()
    for boot_id in range(MOST):
        told(known, 1, boot_id)
    assert told(known, 1, MOST - 1, is_down=True) == "news"
    assert known.is_down(1, MOST - 1)
    known.vouch(1, MOST)
    assert told(known, 1, MOST + 1) == SEQUENCE
