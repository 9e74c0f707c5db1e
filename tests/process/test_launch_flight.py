"""Supervision of a launch, with processes that only sleep and end: which fails, which go on, and the result."""

from __future__ import annotations

import contextlib
import os
import pty
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from rich.console import Console

import swarmctl.ops.supervision.landing_order
import swarmctl.ops.supervision.recovery
import swarmctl.ops.supervision.supervisor
from swarmctl.bus.bus import Bus, agent_name
from swarmctl.bus.messages.json_messages import (
    EndedMessage,
    decode_ended,
    decode_obstacles,
    encode_message,
    first_list,
)
from swarmctl.bus.orders import Orders
from swarmctl.bus.refusals import Refusals
from swarmctl.bus.topics import ENDED, OBSTACLES, OPERATOR, Topic
from swarmctl.bus.traffic import CountedBus
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.types import Landed, Phase
from swarmctl.errors import EXIT_INTERRUPTED, EXIT_MISSION, EXIT_OK, EXIT_START, StartError
from swarmctl.ops.processes import ROUTER, SITL, VIEWER, Child, kill_all
from swarmctl.ops.supervision.background_display import BackgroundDisplay
from swarmctl.ops.supervision.hearing import Hearing
from swarmctl.ops.supervision.status_table import AgentView, Display, LiveTable
from swarmctl.telemetry.evaluation.referee import JudgedObstacle
from swarmctl.telemetry.recording.event_log import EventLog
from swarmctl.telemetry.recording.file_names import events_file
from swarmctl.telemetry.recording.obstacle_lists import recorded_obstacles
from swarmctl.telemetry.recording.run_files import read_events
from tests.benches.scripted_services import FLIES_LONG, IGNORES_SIGTERM, LOADS_MODULES, ScriptedServices, ends

pytestmark = pytest.mark.process


class DeafBus(CountedBus):
    """A session that sends, and from a time on receives nothing, until another one is opened."""

    def __init__(self, bus: Bus, deaf_from_s: float, opening_s: float) -> None:
        super().__init__(bus)
        self._deaf_s, self._opening_s = deaf_from_s, opening_s
        self._anew_s: float | None = None

    def receive(self, topic: Topic) -> list[tuple[str, bytes]]:
        arrived = super().receive(topic)
        return [] if time.monotonic() > self._deaf_s and not self.reopened() else arrived

    def reopen(self) -> bool:
        self._anew_s = self._anew_s or time.monotonic() + self._opening_s
        return not self.reopened()

    def reopened(self) -> int:
        return int(self._anew_s is not None and time.monotonic() > self._anew_s)


class ReopeningBus(CountedBus):
    """A session that is replaced once nobody is heard any more."""

    def __init__(self, bus: Bus, is_silent: Callable[[], bool]) -> None:
        super().__init__(bus)
        self._is_silent = is_silent

    def reopened(self) -> int:
        return int(self._is_silent())


@pytest.fixture(autouse=True)
def short_times(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(swarmctl.ops.supervision.supervisor, "_SILENCE_S", 1.0)
    monkeypatch.setattr(swarmctl.ops.supervision.supervisor, "_AFTER_DEATH_S", 0.5)
    monkeypatch.setattr(swarmctl.ops.supervision.supervisor, "_LAND_OBEYED_S", 1.0)


def test_all_agents_finish(tmp_path: Path) -> None:
    result = ScriptedServices(tmp_path, [ends(0), ends(0, 0.6)]).fly()
    assert (result.outcome, result.problems) == ("completed", [])
    assert result.exit_code(violated=False) == EXIT_OK
    assert result.exit_code(violated=True) == EXIT_MISSION


def test_who_has_landed_does_not_fail_because_it_waits_for_one_that_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where a pilot keeps one of two vehicles in the air after Ctrl-C."""
    monkeypatch.setattr(swarmctl.ops.supervision.supervisor, "_LAND_S", 2.0)
    services = ScriptedServices(tmp_path, [IGNORES_SIGTERM, IGNORES_SIGTERM])
    others = services.hub.connect("bravo", {ENDED: [OPERATOR]})
    services.phases, services.obeys, services.interrupts = {0: Phase.DONE}, False, 1
    problems = services.fly().problems
    assert len([problem for problem in problems if agent_name(1) in problem]) == 2
    assert not any(agent_name(0) in problem for problem in problems)
    told = [decode_ended(payload) for _, payload in others.receive(ENDED)]
    assert EndedMessage(agent=0, boot_id=1, is_down=True) in told, "agents of other computers hear nothing more of it"


@pytest.mark.parametrize(
    ("phase", "landing_s", "is_late"), [(Phase.LAND, 300.0, False), (Phase.LAND, 2.0, True), (Phase.TRACK, 300.0, True)]
)
def test_who_is_heard_landing_is_not_killed_on_its_way_down(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, phase: Phase, landing_s: float, is_late: bool
) -> None:
    """After Ctrl-C at a height of 90 m agents were killed before touchdown, and the flight had failed."""
    monkeypatch.setattr(swarmctl.ops.supervision.supervisor, "_LAND_S", 1.0)
    monkeypatch.setattr(swarmctl.ops.supervision.landing_order, "_LANDING_S", landing_s)
    services = ScriptedServices(tmp_path, [IGNORES_SIGTERM if is_late else ends(EXIT_INTERRUPTED, 5.0)])
    services.phase, services.obeys = phase, False
    services.act = lambda: setattr(services, "interrupts", 1)
    problems = services.fly().problems
    assert any("did not end in time and was killed" in text for text in problems) == is_late


def test_an_agent_that_ends_between_two_looks_still_says_how_it_ended(tmp_path: Path) -> None:
    services = ScriptedServices(tmp_path, [ends(EXIT_INTERRUPTED)])
    agent = services.children[agent_name(0)]

    def end_unseen() -> None:  # `show` is called after the agents are watched and before the flight is judged
        while agent.poll() is None:
            time.sleep(0.01)

    services.began_s, services.act = 0.0, end_unseen
    assert services.fly().outcome == "interrupted"


def test_a_killed_agent_is_named_and_the_others_finish(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [FLIES_LONG, ends(0, 2.0), ends(0, 2.0)])
    scene.act = lambda: scene.kill("agent-0")
    result = scene.fly()
    assert result.exit_code(violated=False) == EXIT_MISSION
    assert result.outcome == "failed"
    assert scene.printed("agent-0", "SIGKILL")
    assert scene.recovered == [0]
    assert scene.printed("the vehicle of agent-0", "disarmed")
    assert result.left == ()
    assert [scene.children[f"agent-{i}"].poll() for i in range(3)] == [130, 0, 0]
    assert "land" not in scene.orders
    assert 0 in {end.agent for end in scene.ended}, "the others need not wait for it"


def test_nobody_is_said_to_fly_on_where_the_last_one_has_died(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [FLIES_LONG])
    scene.act = lambda: scene.kill("agent-0")
    scene.fly()
    assert scene.printed("agent-0 was killed by SIGKILL")
    assert not scene.printed("the others fly on")


def test_ends_are_told_again_and_again_each_by_its_process(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [ends(0, 6.0), FLIES_LONG])
    scene.lands = ends(130, 1.5)
    scene.act = lambda: scene.kill("agent-1")
    scene.fly()
    told = Counter((end.boot_id, end.is_down) for end in scene.ended if end.agent == 1)
    assert told.keys() == {(1, False), (2, True)}, "the second process has landed the vehicle of the first"
    assert min(told.values()) >= 3


@pytest.mark.parametrize("agent", [ends(0, 1.0), ends(1, 1.0)])
def test_a_vehicle_that_was_handed_over_in_the_air_is_left_there_and_named_but_not_said_to_be_down(
    tmp_path: Path, agent: str
) -> None:
    scene = ScriptedServices(tmp_path, [ends(0, 1.5), agent])
    scene.phases, scene.vehicle = {1: Phase.DONE}, {"armed": True, "landed": Landed.IN_AIR}
    scene.fly()
    assert scene.recovered == []
    assert scene.printed("vehicle 2 (agent-1)", "was left to its autopilot", "No agent lands it")
    assert [end.is_down for end in scene.ended if end.agent == 1][:1] == [False]


def test_a_vehicle_that_can_not_be_recovered_is_named(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [FLIES_LONG, ends(0, 2.0)])
    scene.lands = ends(3, 0.3)
    scene.act = lambda: scene.kill("agent-0")
    result = scene.fly()
    assert scene.recovered == [0]
    assert len(result.left) == 1
    assert scene.printed("vehicle 1", "may be armed", "TRACK", "by hand")
    assert result.exit_code(violated=False) == EXIT_MISSION


def test_a_vehicle_whose_recovery_can_not_be_started_is_named_and_the_others_finish(tmp_path: Path) -> None:
    """The launcher has no descriptor left, for instance."""
    scene = ScriptedServices(tmp_path, [FLIES_LONG, ends(0, 2.0)])

    def fails(agent: int) -> Child:
        raise StartError("agent-0: too many open files")

    scene.recover = fails  # type: ignore[method-assign]
    scene.act = lambda: scene.kill("agent-0")
    result = scene.fly()
    assert scene.printed("agent-0", "can't be recovered", "too many open files")
    assert len(result.left) == 1
    assert result.exit_code(violated=False) == EXIT_MISSION
    assert scene.children["agent-1"].poll() == 0


def test_a_router_that_can_not_be_started_again_lands_all_agents(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [FLIES_LONG])

    def fails() -> None:
        raise StartError("router: too many open files")

    scene.restart_router = fails  # type: ignore[method-assign]
    scene.act = lambda: scene.kill(ROUTER)
    assert scene.fly().exit_code(violated=False) == EXIT_MISSION
    assert scene.printed("can't be started again")
    assert scene.children["agent-0"].poll() == 130


def test_an_interrupted_launch_that_leaves_a_vehicle_is_a_failed_one(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [FLIES_LONG, FLIES_LONG])
    scene.lands = ends(3, 0.3)

    def interrupt_and_kill() -> None:
        scene.interrupts = 1
        scene.kill("agent-1")

    scene.act = interrupt_and_kill
    result = scene.fly()
    assert result.interrupted
    assert len(result.left) == 1
    assert result.exit_code(violated=False) == EXIT_MISSION


def test_a_recovery_that_takes_too_long_is_ended_and_the_vehicle_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(swarmctl.ops.supervision.recovery, "RECOVERY_S", 1.0)
    scene = ScriptedServices(tmp_path, [FLIES_LONG, ends(0, 1.0)])
    scene.lands = FLIES_LONG
    scene.act = lambda: scene.kill("agent-0")
    began_s = time.monotonic()
    result = scene.fly()
    assert time.monotonic() - began_s < 20.0
    assert len(result.left) == 1


def test_an_agent_that_ends_before_anything_was_armed_could_not_start(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [ends(3, 1.0), FLIES_LONG])
    scene.phase = Phase.STANDBY
    result = scene.fly()
    assert scene.recovered == []
    assert result.exit_code(violated=False) == EXIT_START


def test_a_frozen_agent_is_given_up_when_the_others_have_finished(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [FLIES_LONG, ends(0, 3.0)])

    def freeze() -> None:
        os.kill(scene.children["agent-0"].pid, signal.SIGSTOP)
        scene.silent.add(0)

    scene.act = freeze
    result = scene.fly()
    assert result.exit_code(violated=False) == EXIT_MISSION
    assert scene.printed("agent-0", "silent")
    assert scene.children["agent-1"].poll() == 0
    assert scene.recovered == [0], "what is frozen is killed, and its vehicle landed"
    assert scene.children["agent-0"].poll() == 130


def test_one_failed_mission_fails_the_launch_and_says_why(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [ends(4, 1.0), ends(0, 1.5)])
    result = scene.fly()
    assert result.exit_code(violated=False) == EXIT_MISSION
    assert scene.printed("agent-0", "because")
    assert scene.children["agent-1"].poll() == 0


def test_an_agent_that_can_not_start_lands_the_others(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [FLIES_LONG, ends(3)])
    scene.phase = Phase.STANDBY
    result = scene.fly()
    assert result.exit_code(violated=False) == EXIT_START
    assert scene.printed("agent-1", "could not start", "because")
    assert scene.children["agent-0"].poll() == 130


@pytest.mark.parametrize(("armed", "code"), [(False, EXIT_START), (True, EXIT_MISSION)])
def test_a_stop_on_the_ground_is_told_from_a_flight_that_was_stopped(tmp_path: Path, armed: bool, code: int) -> None:
    """Both pass LAND, and a status of it may come, or not."""
    scene = ScriptedServices(tmp_path, [ends(130, 2.0), ends(EXIT_START, 0.5)])
    scene.phase, scene.vehicle = Phase.LAND, {"armed": armed}
    assert scene.fly().exit_code(violated=False) == code


def test_an_agent_that_crashes_before_its_first_status_did_not_start(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [ends(1)])
    scene.silent.add(0)
    assert scene.fly().exit_code(violated=False) == EXIT_START


def test_agents_that_an_interrupt_ends_while_they_load_have_not_failed_to_start(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [LOADS_MODULES, LOADS_MODULES])
    scene.silent |= {0, 1}
    scene.began_s, scene.act = 0.0, lambda: setattr(scene, "interrupts", 1)
    result = scene.fly()
    assert [scene.children[f"agent-{i}"].poll() for i in range(2)] == [143, 143]
    assert (result.outcome, result.problems) == ("interrupted", [])


def test_only_the_agent_that_can_not_start_is_blamed_where_others_still_load(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [LOADS_MODULES, ends(3)])
    scene.silent |= {0, 1}
    result = scene.fly()
    assert result.problems == ["agent-1 could not start: because"]
    assert result.exit_code(violated=False) == EXIT_START


def test_an_agent_that_somebody_ends_before_its_first_status_did_not_start(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [LOADS_MODULES])
    scene.silent.add(0)
    scene.began_s, scene.act = 0.0, lambda: scene.children["agent-0"].signal(signal.SIGTERM)
    result = scene.fly()
    assert result.problems == ["agent-0 could not start: it was killed by SIGTERM"]
    assert result.exit_code(violated=False) == EXIT_START


class OnTerminal(ScriptedServices):
    """Also shown on a terminal of which nobody reads, as one that was stopped with Ctrl-S, or whose link has dropped.

    Args:
        wrapped: makes the display of the live table.
    """

    def __init__(self, directory: Path, agents: Sequence[str], wrapped: Callable[[Display], Display]) -> None:
        super().__init__(directory, agents)
        self.unread_fd, terminal_fd = pty.openpty()
        stream = os.fdopen(terminal_fd, "w")
        self.shown = wrapped(LiveTable(Console(file=stream, force_terminal=True, width=120, height=40)))

    def show(self, agents: Sequence[AgentView]) -> None:
        super().show(agents)
        self.shown.print_line("x" * 2000)
        self.shown.show(agents)


def test_a_terminal_that_takes_nothing_holds_up_no_flight(tmp_path: Path) -> None:
    scene = OnTerminal(tmp_path, [FLIES_LONG, ends(0, 4.0)], lambda display: BackgroundDisplay(display, print))
    scene.act = lambda: scene.kill("agent-0")
    began_s = time.monotonic()
    assert scene.fly().outcome == "failed"
    assert scene.recovered == [0]
    assert time.monotonic() - began_s < 20.0
    os.close(scene.unread_fd)  # so that the thread does not wait for it as the interpreter ends


def test_negative_control_without_a_thread_of_its_own_it_does(tmp_path: Path) -> None:
    scene = OnTerminal(tmp_path, [FLIES_LONG, ends(0, 4.0)], lambda display: display)
    flight = threading.Thread(target=scene.fly, daemon=True)
    flight.start()
    flight.join(10.0)
    assert flight.is_alive()
    kill_all(list(scene.children.values()))
    os.set_blocking(scene.unread_fd, False)
    while flight.is_alive():  # until all is read
        with contextlib.suppress(BlockingIOError):
            os.read(scene.unread_fd, 65_536)


def test_first_interrupt_lands_all_agents(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [FLIES_LONG, FLIES_LONG])
    scene.act = lambda: setattr(scene, "interrupts", 1)
    result = scene.fly()
    assert (result.outcome, result.problems) == ("interrupted", [])
    assert result.exit_code(violated=True) == EXIT_INTERRUPTED
    assert "land" in scene.orders
    assert [scene.children[f"agent-{i}"].poll() for i in range(2)] == [130, 130]


def test_an_interrupt_lands_an_agent_that_an_operator_holds_on_its_way_back(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [FLIES_LONG])
    scene.phase, scene.held = Phase.GOTO_LAND, True
    scene.act = lambda: setattr(scene, "interrupts", 1)
    result = scene.fly()
    assert result.outcome == "interrupted"
    assert "land" in scene.orders


def test_an_agent_that_misses_the_order_gets_a_signal(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [FLIES_LONG])
    scene.obeys = False
    scene.act = lambda: setattr(scene, "interrupts", 1)
    result = scene.fly()
    assert result.problems == []
    assert scene.children["agent-0"].poll() == 130
    stamps_us = sorted({stamp_us for stamp_us, _ in scene.stamped_us})
    assert len(stamps_us) >= 2, "stamped anew every time: it would not be valid for long"
    assert all(age_us < 400_000 for _, age_us in scene.stamped_us)


def test_agents_whose_clock_is_an_hour_behind_are_ordered_to_land_by_their_own(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [FLIES_LONG, FLIES_LONG])
    scene.obeys, scene.behind_us = False, 3_600_000_000
    scene.act = lambda: setattr(scene, "interrupts", 1)
    scene.fly()
    ages_us = {round(age_us, -6) for _, age_us in scene.stamped_us}
    assert ages_us == {0, 3_600_000_000}
    refusals = Refusals(lambda *_, **__: None)
    orders, behind_us, verbs = Orders(0, refusals), scene.behind_us, []
    for heard_us, payload in scene.heard:
        order = orders.take(OPERATOR, payload, heard_us - behind_us)
        orders.refuse_misdated(heard_us - behind_us)
        verbs += [order.verb] if order else []
        assert refusals.alert(heard_us - behind_us) == "", "the copy by our clock is no forgery"
    assert len(verbs) > 2, "each repetition is obeyed anew"
    assert set(verbs) == {"land"}


def test_an_interrupt_leaves_a_recovery_the_time_that_it_has(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C is what an operator does who reads that an agent was lost."""
    monkeypatch.setattr(swarmctl.ops.supervision.supervisor, "_LAND_S", 1.0)
    scene = ScriptedServices(tmp_path, [FLIES_LONG, FLIES_LONG])
    scene.lands = ends(130, 3.0)

    def kill_then_interrupt() -> None:
        scene.kill(agent_name(0))
        scene.act = lambda: setattr(scene, "interrupts", 1) if scene.recovered else None

    scene.act = kill_then_interrupt
    result = scene.fly()
    assert scene.recovered == [0]
    assert scene.children[agent_name(0)].poll() == 130, "it has landed the vehicle"
    assert result.left == ()


def test_a_second_interrupt_names_the_vehicle_of_an_agent_that_has_just_ended(tmp_path: Path) -> None:
    vehicles = ",".join(f'{{url="udpin://127.0.0.1:{14540 + i}",sysid={1 + i}}}' for i in (0, 1))
    scene = ScriptedServices(tmp_path, [FLIES_LONG, FLIES_LONG])

    def kill_unseen() -> None:
        scene.kill(agent_name(0))
        while scene.children[agent_name(0)].poll() is None:
            time.sleep(0.01)
        scene.interrupts = 2

    scene.act = kill_unseen
    result = scene.fly("sitl.enabled=false", f"vehicles=[{vehicles}]")
    assert [words.split(" (")[0] for words in result.left] == ["vehicle 1", "vehicle 2"]


def test_second_interrupt_kills_at_once(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [FLIES_LONG, FLIES_LONG], {ROUTER: FLIES_LONG, SITL: FLIES_LONG})
    scene.obeys = False

    def twice() -> None:
        scene.interrupts = 1
        scene.act = lambda: setattr(scene, "interrupts", 2)

    scene.act = twice
    began_s = time.monotonic()
    assert scene.fly().exit_code(violated=False) == EXIT_INTERRUPTED
    assert time.monotonic() - began_s < 10.0
    assert {child.poll() for child in scene.children.values()} == {137}


@pytest.mark.parametrize("is_real", [True, False])
def test_who_kills_the_agents_of_real_vehicles_is_told_which_parameters_they_keep(
    tmp_path: Path, is_real: bool
) -> None:
    """Simulated ones are gone with their parameters; so is nothing of an agent that has ended, or has changed none."""
    were = {"COM_OBL_RC_ACT": 0, "COM_OF_LOSS_T": 1.5}
    scene = ScriptedServices(tmp_path, [FLIES_LONG, ends(0), FLIES_LONG], {ROUTER: FLIES_LONG, SITL: FLIES_LONG})
    for agent in (0, 1):
        EventLog(tmp_path / events_file(agent_name(agent)), agent_name(agent)).write("parameters_changed", were=were)
    EventLog(tmp_path / events_file(agent_name(2)), agent_name(2)).write("phase", phase="TRACK")
    scene.obeys = False
    scene.began_s, scene.act = 0.0, lambda: setattr(scene, "interrupts", 2)
    while scene.children[agent_name(1)].poll() is None:
        time.sleep(0.01)
    vehicles = ", ".join(f'{{sysid = {i + 1}, url = "udpin://127.0.0.1:{14_541 + i}"}}' for i in range(3))
    real = ("sitl.enabled=false", f"vehicles=[{vehicles}]")
    problems = scene.fly(*(real if is_real else ())).problems
    told = [text for text in problems if "parameters" in text]
    assert [text.split(",")[0] for text in told] == (
        ["vehicle 1 (agent-0) may keep the parameters of this flight"] if is_real else []
    )
    assert all('"COM_OBL_RC_ACT": 0' in text and '"COM_OF_LOSS_T": 1.5' in text for text in told)
    assert scene.printed("ground station") is is_real


@pytest.mark.parametrize("is_real", [True, False])
def test_who_can_not_recover_a_real_vehicle_tells_which_parameters_it_keeps(tmp_path: Path, is_real: bool) -> None:
    """It said that the vehicle is left, and the next launch would have taken its parameters for what they were."""
    scene = ScriptedServices(tmp_path, [ends(1), ends(1)], {ROUTER: FLIES_LONG, SITL: FLIES_LONG})
    for agent in (0, 1):
        log = EventLog(tmp_path / events_file(agent_name(agent)), agent_name(agent))
        log.write("parameters_changed", were={"COM_OF_LOSS_T": 1.5})
    scene.lands = ends(1)
    vehicles = ", ".join(f'{{sysid = {i + 1}, url = "udpin://127.0.0.1:{14_541 + i}"}}' for i in range(2))
    real = ("sitl.enabled=false", f"vehicles=[{vehicles}]")
    problems = scene.fly(*(real if is_real else ())).problems
    assert any("vehicle 1 (agent-0) may be armed or in the air" in text for text in problems)
    told = [text for text in problems if "parameters" in text]
    assert [text.split(" may")[0] for text in told] == (
        ["vehicle 1 (agent-0)", "vehicle 2 (agent-1)"] if is_real else []
    )


class RouterSeen(CountedBus):
    """Notes whether the router ran when an end was told."""

    def __init__(self, bus: Bus, router: Child) -> None:
        super().__init__(bus)
        self._router, self.ran = router, list[bool]()

    def publish(self, topic: Topic, payload: bytes) -> None:
        if topic is ENDED:
            self.ran.append(self._router.poll() is None)
        super().publish(topic, payload)


def test_a_host_that_kills_its_agents_tells_the_other_hosts_by_a_router_that_still_runs(tmp_path: Path) -> None:
    """They waited for these agents as for silent ones: of two hosts the other one landed, cut off."""
    scene = ScriptedServices(tmp_path, [FLIES_LONG])
    assert scene.bus is not None
    scene.bus = seen = RouterSeen(scene.bus, scene.children[ROUTER])
    scene.obeys, scene.act = False, lambda: setattr(scene, "interrupts", 2)
    assert scene.fly("swarm.agents=3").exit_code(violated=False) == EXIT_INTERRUPTED
    told = [decode_ended(payload) for _, payload in scene.agents[0].receive(ENDED)]
    assert (told, seen.ran) == ([EndedMessage(agent=0, boot_id=1, is_down=False)], [True])
    assert {child.poll() for child in scene.children.values()} == {137}


def test_a_launcher_that_did_not_run_calls_nobody_silent(tmp_path: Path) -> None:
    """On an overloaded machine agents have real-time priority, and the launcher waits; so does what it is sent."""
    scene = ScriptedServices(tmp_path, [ends(0, 6.0), ends(0, 6.0)])

    def hear_nothing() -> None:
        scene.silent = {0, 1}
        scene.act = sleep

    def sleep() -> None:
        time.sleep(3.0)  # three times as long as an agent may be silent
        scene.act = scene.silent.clear

    scene.act = hear_nothing
    result = scene.fly()
    assert (result.exit_code(violated=False), result.problems) == (EXIT_OK, [])


def deaf_flight(directory: Path, script: str, opening_s: float = 1.0) -> ScriptedServices:
    scene = ScriptedServices(directory, [script, script])
    assert scene.bus is not None
    scene.bus = DeafBus(scene.bus, time.monotonic() + 0.5, opening_s)
    return scene


def test_a_supervisor_that_is_deaf_hears_its_agents_again_and_calls_none_silent(tmp_path: Path) -> None:
    scene = deaf_flight(tmp_path, ends(0, 6.0))  # the silence lasts longer than that of an agent may
    result = scene.fly()
    assert (result.exit_code(violated=False), result.problems) == (EXIT_OK, [])
    assert scene.printed("agent-0", "its process runs", "another session")
    assert scene.printed("agent-1", "is heard on another session", "the one before was deaf")
    assert '"bus_reopened"' in (tmp_path / "launch.events.jsonl").read_text()
    assert "land" not in scene.orders


def test_silence_after_the_last_agent_has_ended_is_no_sign_of_a_deaf_session(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [ends(4, 0.3)])
    assert scene.bus is not None
    scene.bus = ReopeningBus(scene.bus, lambda: scene.children["agent-0"].poll() is not None)
    result = scene.fly()
    assert result.outcome == "failed"
    assert scene.bus.reopened()  # the launch has waited for so long
    assert not scene.printed("another session")
    assert '"bus_reopened"' not in (tmp_path / "launch.events.jsonl").read_text()


def test_who_is_only_landed_by_another_process_flies_on_for_nobody_and_is_not_listened_for(tmp_path: Path) -> None:
    """As of two agents of one process that is killed."""
    scene = ScriptedServices(tmp_path, [FLIES_LONG, FLIES_LONG])
    assert scene.bus is not None
    scene.bus = ReopeningBus(scene.bus, lambda: bool(scene.recovered))

    def kill_both() -> None:
        scene.kill("agent-0")
        scene.kill("agent-1")
        for i in (0, 1):
            scene.children[agent_name(i)].wait(10.0)

    scene.act = kill_both
    scene.fly()
    assert scene.recovered == [0, 1]
    assert scene.printed("agent-1 was killed by SIGKILL")
    assert not scene.printed("agent-1 was killed by SIGKILL; the others fly on")
    assert not scene.printed("another session")


def test_control_a_supervisor_that_believes_its_deaf_session_lands_its_agents(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Hearing, "is_silent", lambda self, agent, silent_s, limit_s: silent_s > limit_s)
    scene = deaf_flight(tmp_path, FLIES_LONG)
    assert scene.fly().exit_code(violated=False) == EXIT_MISSION
    assert scene.printed("agent-0", "silent")
    assert [scene.children[f"agent-{i}"].poll() for i in range(2)] == [130, 130]


def test_a_router_that_ends_is_started_again(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [ends(0, 2.0), ends(0, 2.0)])
    scene.act = lambda: scene.kill(ROUTER)
    result = scene.fly()
    assert (result.exit_code(violated=False), result.problems) == (EXIT_OK, [])
    assert scene.printed("router", "SIGKILL", "started again")
    assert "land" not in scene.orders


@pytest.mark.parametrize("name", [ROUTER, SITL])
def test_without_router_or_simulator_all_agents_land(tmp_path: Path, name: str) -> None:
    scene = ScriptedServices(tmp_path, [FLIES_LONG, FLIES_LONG], {ROUTER: FLIES_LONG, SITL: FLIES_LONG})
    scene.router = ends(3, 0.0)  # what is started instead can't run either
    scene.act = lambda: scene.kill(name)
    result = scene.fly()
    assert result.exit_code(violated=False) == EXIT_MISSION
    assert len(result.problems) == 1
    assert scene.printed(name, "SIGKILL")
    assert [scene.children[f"agent-{i}"].poll() for i in range(2)] == [130, 130]


def test_a_simulator_that_refuses_to_start_is_a_failed_start(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [FLIES_LONG], {ROUTER: FLIES_LONG, SITL: ends(2, 0.0)})
    scene.silent.add(0)
    assert scene.fly().exit_code(violated=False) == EXIT_START
    assert scene.printed("sitl", "because")


@pytest.mark.parametrize("signum", [signal.SIGKILL, signal.SIGSTOP])
def test_without_its_viewer_the_flight_goes_on(tmp_path: Path, signum: signal.Signals) -> None:
    viewer = "import time; print('viewer rerun+http://127.0.0.1:9876/proxy', flush=True); time.sleep(60)"
    scene = ScriptedServices(tmp_path, [ends(0, 2.0)], {ROUTER: FLIES_LONG, VIEWER: viewer})
    scene.act = lambda: os.kill(scene.children[VIEWER].pid, signum)
    result = scene.fly()
    assert result.exit_code(violated=False) == EXIT_OK
    assert scene.printed("announced rerun+http://127.0.0.1:9876/proxy")
    assert sum("the flight goes on" in line for line in scene.said) == 1


def test_an_interrupt_lands_those_that_fly_on_after_an_operator_has_landed_one(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [ends(130), FLIES_LONG])
    scene.act = lambda: setattr(scene, "interrupts", int(scene.children["agent-0"].poll() is not None))
    result = scene.fly()
    assert (result.outcome, result.problems) == ("interrupted", [])
    assert "land" in scene.orders


def test_what_failed_is_not_hidden_by_an_operator_who_landed_the_rest(tmp_path: Path) -> None:
    result = ScriptedServices(tmp_path, [ends(130), ends(EXIT_MISSION), ends(0)]).fly()
    assert (result.outcome, len(result.problems)) == ("failed", 1)
    assert result.exit_code(violated=False) == EXIT_MISSION


def test_landed_by_an_operator_is_an_interrupted_flight(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [ends(130), ends(130)])
    result = scene.fly()
    assert (result.outcome, result.problems) == ("interrupted", [])
    assert result.exit_code(violated=False) == EXIT_INTERRUPTED


def test_obstacles_of_an_operator_are_adopted_and_repeated(tmp_path: Path) -> None:
    scene = ScriptedServices(tmp_path, [ends(0, 2.0)])
    ball = Obstacle(center_ned_m=(1.0, 2.0, -3.0), radius_m=0.5, keep_out_m=1.0)
    column = ball.model_copy(update={"column": True})
    began_us = time.time_ns() // 1000
    repeated: list[int] = []
    sent = [first_list((ball, ball), began_us, 5), first_list((column,), began_us, 6)]

    def carry() -> None:
        if sent and (not repeated or repeated[-1] == 5):
            scene.hub.carry(OPERATOR, OBSTACLES, encode_message(sent.pop(0)))
        for _, payload in scene.agents[0].receive(OBSTACLES):
            message = decode_obstacles(payload)
            assert message is not None
            repeated.append(message.version)
        scene.act = carry

    scene.act = carry
    scene.join_as_operator()
    scene.fly()
    assert repeated[-1] == 6
    configured = (JudgedObstacle(number=7, obstacle=ball),)
    found = recorded_obstacles(configured, read_events(tmp_path))
    assert [(judged.number, judged.obstacle) for judged in found] == [(0, ball), (1, ball), (0, column)]
    assert [judged.until_utc_us is None for judged in found] == [False, False, True], "what is gone was there"
    assert all(judged.since_utc_us == began_us for judged in found)
    assert recorded_obstacles(configured, [{"event": "obstacles", "text": "1 obstacle"}]) == configured
