"""The table of agents on a terminal of 80x24 and wider: every number and word whole, whatever the values."""

from __future__ import annotations

import io
import time
from collections.abc import Sequence

import msgspec
import pytest
from rich.console import Console

from swarmctl.bus.messages.json_messages import StatusMessage
from swarmctl.control.phases.control_mode import control_mode
from swarmctl.core.types import ControlMode, FlightMode, Mode, Phase
from swarmctl.ops.supervision.status_table import (
    COLUMNS,
    AgentView,
    LiveTable,
    PlainLines,
    headline,
    status_cells,
    status_table,
)
from tests import builders

ALERT = "plan not_certified: 0.71 m to agent-11, where 0.85 m are required (separation.radius_m)"


def status(agent: int, **fields: object) -> StatusMessage:
    return msgspec.structs.replace(builders.status_message(agent=agent), **fields)


def fleet(agents: int) -> list[AgentView]:
    """Return agents whose cells are as long as they get, half of them with a long alert."""
    longest = {
        "phase": Phase.GOTO_START,
        "control": "TRACKING",
        "flight_mode": FlightMode.EXTERNAL,
        "altitude_m": -1234.56,
        "ground_speed_m_s": 123.4,
        "battery_01": 1.0,
        "pos_accuracy_m": 1234.5,
        "link_age_ms": 98_765.4,
        "separation_m": 12_345.678,
        "position_error_m": 12_345.678,
        "deadline_misses": 123_456,
        "mission_t_s": 12_345.6,
        "ends_in_s": 12_345.6,
        "ticks": 12_345_678,
        "tick_p99_ms": 12_345.6,
        "plan_staleness_ms": 1_234_567.8,
    }
    return [
        AgentView(agent=i, status=status(i, **longest, active_alert=ALERT if i % 2 else "", alert_age_s=12.3))
        for i in range(agents)
    ]


def rendered(agents: Sequence[AgentView], width: int, height: int | None) -> list[str]:
    stream = io.StringIO()
    console = Console(file=stream, width=width, height=height, force_terminal=True, color_system=None)
    console.print(status_table(agents, width, height))
    return stream.getvalue().splitlines()


def flying(agents: int, **fields: object) -> list[AgentView]:
    calm = {"phase": Phase.TRACK, "control": "TRACKING", "active_alert": "", **fields}
    return [AgentView(agent=i, status=status(i, **calm)) for i in range(agents)]


@pytest.mark.parametrize(("agents", "height"), [(50, 24), (100, 24), (50, 40), (20, 12)])
def test_of_more_agents_than_lines_those_are_shown_that_need_somebody(agents: int, height: int) -> None:
    views = flying(agents)
    for needy in (views[3], views[-1]):
        needy.note = "killed by SIGKILL"
    views[-2].status = status(agents - 2, phase=Phase.TRACK, control="FAILSAFE", active_alert="")
    lines = rendered(views, 80, height)
    assert len(lines) <= height - 1, "one line is the prompt's"
    numbers = [int(line.split()[0]) for line in lines[3:] if line.split()[1:2] == ["TRACK"]]
    assert numbers == sorted(numbers) and {3, agents - 2, agents - 1} <= set(numbers)
    hidden = agents - len(numbers)
    assert f"{hidden} more: {hidden} TRACK TRACKING" in lines
    assert sum("killed by SIGKILL" in line for line in lines) == 2, "all alerts are read"


def test_all_agents_that_have_room_are_shown() -> None:
    assert not [line for line in rendered(flying(18), 80, 24) if "more" in line]
    assert [line for line in rendered(flying(20), 80, 24) if "more" in line]


@pytest.mark.parametrize("width", [80, 116, 117, 160])
@pytest.mark.parametrize("agents", [3, 12])
def test_no_word_is_cut_and_agent_numbers_are_readable(agents: int, width: int) -> None:
    lines = rendered(fleet(agents), width, 24)
    assert len(lines) <= 23, "one line is the prompt's"
    assert max(map(len, lines)) <= width
    assert "…" not in "".join(lines)
    columns = [column for column in COLUMNS if width >= 117 or not column.only_wide]
    assert lines[1].split() == [column.title for column in columns]
    for i in range(agents):
        cells = [column.cell_of(fleet(agents)[i]) for column in columns]
        assert lines[3 + i].split() == [word for cell in cells for word in cell.split()], "each cell is whole"
    below = " ".join(line.strip() for line in lines[3 + agents :])
    assert f" 1: {ALERT} (12 s)" in f" {below}"
    if (agents, width) == (12, 80):
        assert "more alerts: swarmctl status" in below


def test_without_a_limit_of_height_every_alert_is_there() -> None:
    below = " ".join(line.strip() for line in rendered(fleet(12), 80, None)[15:])
    assert [f"{i}: {ALERT}" in below for i in range(12)] == [bool(i % 2) for i in range(12)]


def test_three_agents_in_ordinary_flight_look_so() -> None:
    held = {"held": True, "control": "HOLD", "ends_in_s": -1.0}
    views = [AgentView(agent=i, status=status(i, **held if i == 1 else {})) for i in range(3)]
    assert [line.rstrip() for line in rendered(views, 80, 24)] == [
        "mission 12 s, ends in 25 s; without an end: 1 (held)",
        "id phase      control  flight   arm   alt  m/s bat  est link   sep error  miss",
        "                       mode             m        %    m    s     m     m",
        " 0 TRACK      TRACKING EXTERNAL yes   5.0  1.5  75 0.25  0.0  1.00  0.10     0",
        " 1 TRACK      HOLD     EXTERNAL yes   5.0  1.5  75 0.25  0.0  1.00  0.10     0",
        " 2 TRACK      TRACKING EXTERNAL yes   5.0  1.5  75 0.25  0.0  1.00  0.10     0",
    ]


def test_what_is_unknown_is_a_dash_and_an_agent_without_a_status_has_its_number() -> None:
    nothing = dict.fromkeys(("ground_speed_m_s", "battery_01", "pos_accuracy_m", "link_age_ms", "separation_m"), -1.0)
    unheard = status(7, **nothing, gps_fix=-1, flight_mode=FlightMode.UNKNOWN, armed=False)
    cells = status_cells(AgentView(agent=7, status=unheard))
    assert [cells[k] for k in (4, 5, 6, 7, 8, 9, 10, 18)] == ["-"] * 8
    assert status_cells(AgentView(agent=11))[0] == "11"


def test_a_vehicle_at_the_height_of_the_origin_is_at_no_negative_one() -> None:
    cells = status_cells(AgentView(agent=0, status=status(0, altitude_m=-1e-8)))
    assert cells[5] == "0.0"


def test_an_agent_that_is_silent_is_lost_and_its_link_ages() -> None:
    view = AgentView(agent=0, status=status(0, link_age_ms=100.0), received_s=time.monotonic() - 7.0)
    assert view.control == "LOST"
    view.status = status(0, link_age_ms=100.0, phase=Phase.DONE, control="AUTO")
    assert view.control == "AUTO", "its process has ended as it should"
    assert 7.0 <= float(status_cells(view)[9]) <= 8.0


@pytest.mark.parametrize(
    ("phase", "mode", "flags", "shown"),
    [
        (Phase.TRACK, Mode.TRACKING, "", "TRACKING"),
        (Phase.TRACK, Mode.TRACKING, "held", "HOLD"),
        (Phase.TRACK, Mode.TRACKING, "held goes_to_point", "GOTO"),
        (Phase.TRACK, Mode.TRACKING, "paused", "WAIT"),
        (Phase.TRACK, Mode.REPLAY, "held", "REPLAY"),
        (Phase.TRACK, Mode.PILOT_OVERRIDE, "held", "PILOT"),
        (Phase.TRACK, Mode.PILOT_OVERRIDE, "held setpoints_stopped", "FAILSAFE"),
        (Phase.TRACK, Mode.STATE_STALE, "held", "LOST"),
        (Phase.CONNECT, Mode.STATE_STALE, "", "AUTO"),
        (Phase.TAKEOFF, Mode.IDLE, "", "AUTO"),
        (Phase.TAKEOFF, Mode.IDLE, "held", "HOLD"),
        (Phase.GOTO_LAND, Mode.TRACKING, "", "RTL"),
        (Phase.GOTO_LAND, Mode.TRACKING, "completed", "RETURN"),
        (Phase.GOTO_LAND, Mode.TRACKING, "completed held", "HOLD"),
        (Phase.GOTO_LAND, Mode.TRACKING, "completed lands_in_place", "LANDING"),
        (Phase.GOTO_LAND, Mode.TRACKING, "held lands_in_place", "HOLD"),
        (Phase.GOTO_LAND, Mode.TRACKING, "lands_in_place", "LANDING"),
        (Phase.LAND, Mode.IDLE, "lands_in_place", "LANDING"),
        (Phase.DONE, Mode.IDLE, "", "AUTO"),
    ],
)
def test_the_control_mode_is_what_the_vehicle_does(phase: Phase, mode: Mode, flags: str, shown: str) -> None:
    names = ("held", "goes_to_point", "paused", "lands_in_place", "setpoints_stopped", "completed")
    asked = {name: name in flags.split() for name in names}
    assert control_mode(phase, mode, **asked).name == shown


def test_every_control_mode_fits_into_its_column() -> None:
    assert max(len(mode.name) for mode in ControlMode) <= 8


def test_lines_say_when_an_agent_is_held_and_when_no_more() -> None:
    stream = io.StringIO()
    lines = PlainLines(stream)
    view = AgentView(agent=2)
    for control in ("TRACKING", "REPLAY", "HOLD", "HOLD", "TRACKING"):
        view.status = status(2, control=control)
        lines.show([view])
    view.note = "dead"
    for received_s in (time.monotonic(), time.monotonic() - 10.0):  # that nothing comes any more is no news
        view.received_s = received_s
        lines.show([view])
    assert [line.split("s  ")[1] for line in stream.getvalue().splitlines()] == [
        "agent-2  TRACK",
        "agent-2  TRACK  HOLD",
        "agent-2  TRACK",
        "agent-2  TRACK  dead",
    ]


def test_lines_say_once_for_whom_an_agent_waits() -> None:
    stream = io.StringIO()
    lines, view = PlainLines(stream), AgentView(agent=2)
    for alert in ("", "bad link", "waits for agent-1 to stand by", "bad link", "waits for agent-1 to stand by", ""):
        view.status = status(2, phase=Phase.STANDBY, active_alert=alert)
        lines.show([view])
    assert [line.split("s  ")[1] for line in stream.getvalue().splitlines()] == [
        "agent-2  STANDBY",
        "agent-2  STANDBY  waits for agent-1 to stand by",
    ]


def test_lines_do_not_repeat_a_wait_whose_figure_changes() -> None:
    stream = io.StringIO()
    lines, view = PlainLines(stream), AgentView(agent=2)
    for wait in ("its processor (now 61 %)", "its processor (now 39 %)", "its clock (now 3 s)"):
        view.status = status(2, phase=Phase.STANDBY, active_alert=f"waits for {wait}")
        lines.show([view])
    assert [line.split("waits for ")[1] for line in stream.getvalue().splitlines()] == [
        "its processor (now 61 %)",
        "its clock (now 3 s)",
    ]


def test_the_live_table_fits_the_terminal_it_is_on() -> None:
    stream = io.StringIO()
    table = LiveTable(Console(file=stream, width=80, height=24, force_terminal=True, color_system=None))
    table.show(fleet(12))
    table.close()
    assert "more alerts" in stream.getvalue()
    assert "…" not in stream.getvalue()


AFTER = {"mission_t_s": -1.0}


@pytest.mark.parametrize(
    ("phases", "fields", "shown"),
    [
        ((Phase.STANDBY, Phase.READY), {**AFTER, "ends_in_s": 9.4}, "not begun, 1 of 2 agents ready, given up in 9 s"),
        ((Phase.READY, Phase.TRACK), {"ends_in_s": 25.4}, "12 s, ends in 25 s"),
        ((Phase.TRACK, Phase.TRACK), {"ends_in_s": -1.0, "held": True}, "12 s; without an end: 0, 1 (held)"),
        ((Phase.GOTO_LAND, Phase.LAND), {**AFTER, "ends_in_s": 60.0}, "over, landing, latest landing in 60 s"),
        ((Phase.DONE, Phase.DONE), {**AFTER, "ends_in_s": -1.0}, "over"),
    ],
)
def test_the_headline_says_the_mission_clock_and_what_ends_when(
    phases: tuple[Phase, Phase], fields: dict[str, object], shown: str
) -> None:
    views = [AgentView(agent=i, status=status(i, phase=phase, **fields)) for i, phase in enumerate(phases)]
    assert headline(views) == f"mission {shown}"
    assert headline([AgentView(agent=0)]) == "no status yet"


def test_the_name_of_the_run_stands_before_the_clock() -> None:
    stream = io.StringIO()
    Console(file=stream, width=80).print(status_table([AgentView(agent=0, status=status(0))], 80, run="circle-1a"))
    assert stream.getvalue().startswith("circle-1a: mission 12 s, ends in 25 s\n")
