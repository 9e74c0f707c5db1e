"""Refusals before a launch, the ports it reserves, and its display while it runs."""

from __future__ import annotations

import importlib.metadata
import io
import json
import signal
import socket
import sys
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from swarmctl.bus.messages.json_messages import StatusMessage
from swarmctl.bus.zenoh.client import SCHEME
from swarmctl.config import Config, dump, load
from swarmctl.configuration.view import viewed_flight
from swarmctl.core.types import Phase
from swarmctl.errors import ConfigError, StartError, SwarmError
from swarmctl.ops import preflight, running_launches
from swarmctl.ops.flight.summary import summary_lines, violation_lines
from swarmctl.ops.orders import operator
from swarmctl.ops.orders.fault import inject, parse_fault
from swarmctl.ops.processes import RunContext, agent_commands, sitl_command, viewer_command
from swarmctl.ops.supervision.launch_result import why_it_failed
from swarmctl.ops.supervision.status_table import (
    AgentView,
    LiveTable,
    PlainLines,
    open_display,
    print_statuses,
    status_cells,
    status_table,
)
from swarmctl.process_lifetime import StopRequest
from swarmctl.telemetry.scene.viewed_flight import ViewedFlight
from tests import builders


def test_vehicle_ports_are_held_and_are_not_those_every_simulator_sends_to() -> None:
    held, others = preflight.claim_ports(3), preflight.claim_ports(3)
    ports = [sock.getsockname()[1] for sock in (*held, *others)]
    assert len(set(ports)) == 6
    assert not set(ports) & set(range(14540, 14640))
    for sock in (*held, *others):
        sock.close()


def test_preflight_holds_the_ports_until_released() -> None:
    ground = preflight.inspect(load(None, ["telemetry.enabled=false"]), range(3))
    try:
        assert len(ground.ports) == 3
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as rival, pytest.raises(OSError):
            rival.bind(("127.0.0.1", ground.ports[0]))
        assert len({sock.getsockname()[1] for sock in (*ground.sockets, *ground.vehicle_sockets)}) == 6
    finally:
        ground.release()
    assert ground.view_port == 0


def test_a_taken_view_port_is_stepped_over() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen(1)
        port = taken.getsockname()[1]
        ground = preflight.inspect(load(None, [f"telemetry.port={port}"]), range(3))
        ground.release()
        assert port < ground.view_port < port + 50


def test_every_problem_at_once_and_nothing_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    versions = {"osqp": "0.6.7", "rerun-sdk": None}

    def version(name: str) -> str:
        found = versions.get(name, "99.0")
        if found is None:
            raise importlib.metadata.PackageNotFoundError(name)
        return found

    monkeypatch.setattr(importlib.metadata, "version", version)
    monkeypatch.setattr(preflight, "held_view_port", lambda _: nullcontext(0))
    with pytest.raises(StartError) as caught:
        preflight.inspect(load(None, ["telemetry.port=9876"]), range(3))
    lines = str(caught.value).splitlines()
    assert len(lines) == 3
    assert "osqp = 0.6.7: too old; pip install 'osqp>=1.1'" in lines[0]
    assert "rerun-sdk: not installed" in lines[1]
    assert "telemetry.port = 9876" in lines[2]


def vehicles(tmp_path: Path, url: str) -> Config:
    path = tmp_path / "one.toml"
    path.write_text(f'[swarm]\nagents=1\n[sitl]\nenabled=false\n[[vehicles]]\nsysid=1\nurl="{url}"\n')
    return load(path, ["telemetry.enabled=false"])


@pytest.mark.parametrize(
    ("url", "word"),
    [
        ("serial:///dev/no-such:57600", "does not exist"),
        ("udpin://192.0.2.1:14540", "can't be bound"),
        ("udpout://no-such-host.invalid:14540", "check the host"),
    ],
)
def test_vehicle_links_are_tried(tmp_path: Path, url: str, word: str) -> None:
    with pytest.raises(StartError, match=word) as caught:
        preflight.inspect(vehicles(tmp_path, url), (0,))
    assert "vehicles.0.url" in str(caught.value)
    assert url in str(caught.value)


@pytest.mark.skipif(sys.platform != "linux", reason="claims are names of Linux' abstract namespace")
@pytest.mark.parametrize("scheme", ["udpout", "tcp"])
def test_no_second_launch_flies_a_vehicle_that_is_reached_by_its_address(tmp_path: Path, scheme: str) -> None:
    """As behind a MAVLink router, which answers both."""
    (free,) = preflight.claim_ports(1)
    with free:
        port = free.getsockname()[1]
    config = vehicles(tmp_path, f"{scheme}://127.0.0.1:{port}")
    others = config.vehicles[0].model_copy(update={"sysid": 2})
    ground = preflight.inspect(config, (0,))
    with pytest.raises(StartError, match=rf"vehicles\.0\.url = .*:{port}': another launch .* of sysid 1 there; end it"):
        preflight.inspect(vehicles(tmp_path, f"{scheme}://localhost:{port}"), (0,))
    preflight.inspect(config.model_copy(update={"vehicles": (others,)}), (0,)).release()
    ground.release()
    preflight.inspect(config, (0,)).release()


def test_a_good_vehicle_port_is_left_free(tmp_path: Path) -> None:
    (held,) = preflight.claim_ports(1)
    port = held.getsockname()[1]
    held.close()
    ground = preflight.inspect(vehicles(tmp_path, f"udpin://127.0.0.1:{port}"), (0,))
    assert ground.sockets == ()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as agent:
        agent.bind(("127.0.0.1", port))


def test_command_lines_say_what_the_configuration_says(tmp_path: Path) -> None:
    config = load(None, ["swarm.agents=2", "start.spacing_m=1.5", "sitl.mass_scale=1.2", "seed=9"])
    context = RunContext("run", "unixsock-stream//tmp/x/bus.sock", tmp_path, (0, 1))
    sitl = sitl_command(config, context, (14540, 14541)).argv
    told = json.loads(sitl[sitl.index("--config-json") + 1])
    assert told == {"vehicles": 2, "spawn_ned_m": [[-0.75, 0, 2], [0.75, 0, 2]], "mass_scale": 1.2, "seed": 9}, (
        "on the ground"
    )
    assert sitl[sitl.index("--remote-ports") + 1] == "14540,14541"
    air = load(None, ["swarm.agents=1", "sitl.start='air'"]).simulator()
    assert air.spawn_ned_m == ((0.0, 0.0, 0.0),)
    held = preflight.claim_ports(2)
    agents = agent_commands(config, context, held)
    assert [command.name for command in agents] == ["agent-0", "agent-1"]
    assert [command.fds for command in agents] == [(sock.fileno(),) for sock in held]
    assert not {"--fd", "--vehicle-port"} & set(agent_commands(config, context, ())[0].argv)
    theirs = preflight.claim_ports(2)
    told = [command.argv for command in agent_commands(config, context, held, theirs)]
    ports = [argv[argv.index("--vehicle-port") + 1] for argv in told]
    assert ports == [f"{sock.getsockname()[1]}" for sock in theirs]
    inherits = sitl_command(config, context, (1, 2), theirs)
    assert inherits.fds == tuple(sock.fileno() for sock in theirs)
    assert inherits.argv[inherits.argv.index("--local-fds") + 1] == ",".join(map(str, inherits.fds))
    for sock in (*held, *theirs):
        sock.close()
    viewer = viewer_command(config, context, 9876, view=False, web=False).argv
    assert not {"--view", "--web"} & set(viewer)
    assert {"--view", "--web"} <= set(viewer_command(config, context, 9876, view=True, web=True).argv)
    shown = ViewedFlight.model_validate_json(viewer[viewer.index("--flight") + 1])
    assert shown == viewed_flight(config)
    assert len(shown.agents) == config.swarm.agents


def status(phase: int = Phase.TRACK, separation_m: float = 1.25, active_alert: str = "") -> StatusMessage:
    return builders.status_message(
        phase=phase, position_error_m=0.1234, separation_m=separation_m, deadline_misses=3, active_alert=active_alert
    )


def test_plain_lines_speak_on_changes_only() -> None:
    stream = io.StringIO()
    display = open_display(stream)
    assert isinstance(display, PlainLines)
    view = AgentView(agent=0)
    display.show([view])
    view.status = status(Phase.ARM)
    display.show([view])
    display.show([view])
    view.status = status(Phase.TRACK, active_alert="wind")
    display.show([view])
    view.note = "dead"
    display.show([view])
    lines = stream.getvalue().splitlines()
    assert len(lines) == 3
    assert "agent-0  ARM" in lines[0]
    assert "agent-0  TRACK  wind" in lines[1]
    assert "agent-0  TRACK  dead" in lines[2]


def test_a_lost_terminal_does_not_end_the_flight() -> None:
    class Gone(io.StringIO):
        def write(self, _: str) -> int:
            raise BrokenPipeError

    PlainLines(Gone()).print_line("x")


def test_table_cells() -> None:
    assert status_cells(AgentView(agent=0, status=status())) == (
        *("0", "TRACK", "TRACKING", "EXTERNAL", "yes", "5.0", "1.5", "75", "0.25", "0.0", "1.25", "0.12", "3"),
        *("100", "2.0", "20", "12", "25", "3D 10", ""),
    )
    unknown = status_cells(AgentView(agent=0, status=status(99, -1.0)))
    assert (unknown[1], unknown[10]) == ("99", "-")
    assert status_cells(AgentView(agent=1))[-1] == "no status yet"


def test_what_an_agent_says_is_shown_as_it_is() -> None:
    stream = io.StringIO()
    view = AgentView(agent=0, status=status(active_alert="refused [/bold] [red]"))
    Console(file=stream, width=200).print(status_table([view]))
    assert "refused [/bold] [red]" in stream.getvalue()
    stream = io.StringIO()
    LiveTable(Console(file=stream, width=200)).print_line("refused [/bold] [red]")
    assert stream.getvalue() == "refused [/bold] [red]\n"


def test_an_agents_text_controls_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    """ESC, the 8-bit CSI and direction marks, as a status, as the launcher's line and as JSON."""
    hostile = "\x1b]0;owned\x07\x9b2J\u202e\r\nDONE"
    stream = io.StringIO()
    lines = PlainLines(stream)
    lines.print_line(hostile)
    lines.show([AgentView(agent=0, status=status(active_alert=hostile))])
    Console(file=stream, width=200).print(
        status_table([AgentView(agent=0, status=status(active_alert=hostile), note="")])
    )
    LiveTable(Console(file=stream, force_terminal=False)).print_line(hostile)
    print_statuses([AgentView(agent=0, status=status(active_alert=hostile)), AgentView(agent=1, note=hostile)])
    print(operator.as_json({0: status(active_alert=hostile)}))
    shown = stream.getvalue() + capsys.readouterr().out
    assert "DONE" in shown
    assert all(c.isprintable() or c in "\n\t" for c in shown)
    assert not any(line.lstrip(" ,│").startswith("DONE") for line in shown.splitlines())


@pytest.mark.parametrize(
    ("outcome", "last_line", "words"),
    [
        ("not tracking after 90 s", "mission not completed: not tracking after 90 s", "not tracking after 90 s"),
        ("completed", "vehicle at udpin: silent for 15 s, given up", "vehicle at udpin: silent for 15 s, given up"),
        ("", "vehicle silent", "vehicle silent"),
        ("completed", "", "no reason given"),
        ("stopped by the operator", "vehicle silent for 15 s, given up", "vehicle silent for 15 s, given up"),
        ("battery", "vehicle silent for 15 s, given up", "battery; vehicle silent for 15 s, given up"),
        ("battery", "", "battery"),
    ],
)
def test_an_agent_failed_for_what_went_wrong_not_for_what_was_ordered(outcome: str, last_line: str, words: str) -> None:
    assert why_it_failed(outcome, last_line) == words


@pytest.mark.parametrize(
    ("settings", "error", "words"),
    [
        ((), StartError, "not up yet, or has ended"),
        (("sitl.enabled=false", "vehicles=[{sysid=1, url='udpin://127.0.0.1:14540'}]"), ConfigError, "no simulator"),
    ],
)
def test_a_fault_without_a_simulator_says_which_kind_of_without(
    tmp_path: Path, settings: tuple[str, ...], error: type[SwarmError], words: str
) -> None:
    (tmp_path / "config.toml").write_text(dump(load(None, ["swarm.agents=1", *settings])))
    launch = running_launches.RunningLaunch("run", f"{SCHEME}{tmp_path}/bus.sock", 1, 0.0, 1, str(tmp_path))
    with pytest.raises(error, match=words):
        inject(launch, parse_fault({"kind": "gps_loss"}, 1))


def test_a_summary_is_five_lines_even_when_almost_empty() -> None:
    for summary in ({}, {"outcome": "failed", "violations": ["a", "b"], "timing": {"tick_ms": {"p50": None}}}):
        lines = summary_lines(summary, Path("runs/x"))
        assert len(lines) == 5
        assert lines[-1] == "run folder runs/x"
        assert "0 bus messages refused" in lines[3], "an autopilot may refuse requests all the same"
    assert "2 violations" in lines[0]


def test_a_hangup_is_one_request_and_none_under_nohup() -> None:
    """SIGHUP comes from the kernel and again from the shell; a second Ctrl-C is still a second one."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    try:
        with StopRequest(signal.SIGINT, signal.SIGHUP) as interrupts:
            for signum, count in ((signal.SIGHUP, 1), (signal.SIGHUP, 1), (signal.SIGINT, 2), (signal.SIGHUP, 2)):
                signal.raise_signal(signum)
                assert interrupts.count == count
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup begins
        with StopRequest(signal.SIGINT, signal.SIGHUP) as interrupts:
            signal.raise_signal(signal.SIGHUP)
            assert interrupts.count == 0
    finally:
        signal.signal(signal.SIGHUP, before)


def test_every_violation_is_said() -> None:
    assert violation_lines({"violations": ["a", "b\x1b[2J"]}) == ("violation: a", r"violation: b\x1b[2J")
    alone = {"outcome": "failed", "violations": ["a"]}
    assert violation_lines(alone) == ()
    assert summary_lines(alone, Path("runs/x"))[0].endswith("1 violation: a")
    hostile = summary_lines({"outcome": "failed", "violations": ["b\x1b[2J"]}, Path("runs/x"))
    assert hostile[0].endswith(r"1 violation: b\x1b[2J")


def test_the_view_is_told_of_goals_where_references_come_to_rest() -> None:
    circle = viewed_flight(load(None))
    assert {bounds.goal_ned_m for bounds in circle.agents} == {None}
    assert 5.0 < circle.extent_m < 7.0
    goals = ((4.0, 0.0, -2.0), (0.0, 4.0, -2.0))
    there = ["swarm.agents=2", "mission.kind=goto", f"mission.goto.goals_ned_m={[list(goal) for goal in goals]}"]
    shown = viewed_flight(load(None, [*there, "vehicle_model.tilt_max_rad=0.4"]))
    assert np.allclose([bounds.goal_ned_m for bounds in shown.agents if bounds.goal_ned_m], goals)
    assert {bounds.tilt_max_rad for bounds in shown.agents} == {0.4}
