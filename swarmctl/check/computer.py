"""Check of the computer that flies: whether setpoints have to wait for its other programs. Pure."""

from __future__ import annotations

from swarmctl.check.finding import COMPUTER, Finding, line_of
from swarmctl.core.verdict import Verdict


def priority_finding(*, is_wanted: bool, is_permitted: bool) -> Finding:
    """Return whether what flies has real-time priority on this computer.

    Args:
        is_wanted: a launch would ask for it.
        is_permitted: the system would grant it.
    """
    line = line_of(COMPUTER, "real-time priority", "permitted, if a launch asks for it (agent.realtime)")
    if not is_wanted:
        return line(Verdict.OK, "not asked for")
    if is_permitted:
        return line(Verdict.OK, "permitted")
    advice = "setpoints wait for other programs: fly with CAP_SYS_NICE, or a limit rtprio of 10 or more (ulimit -r)"
    return line(Verdict.NOTE, "not permitted", advice)
