"""Command port through the codec: repeated until answered, one command at a time, integers bytewise in the float."""

from __future__ import annotations

import itertools
import math
import struct
from typing import Any

import pytest
from pymavlink.dialects.v20 import development as dialect

from swarmctl.core.types import Command, Verb
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.commands import CommandPort, CommandResult
from swarmctl.mavlink.dialects.arducopter import ARDUCOPTER
from swarmctl.mavlink.dialects.dialect import Dialect
from swarmctl.mavlink.dialects.px4 import PX4

SECOND = 1_000_000


class Bench:
    """`CommandPort`, its clock, and what it sends."""

    def __init__(self, dialect: Dialect | None = PX4) -> None:
        self.out: list[bytes] = []
        self.dialect = dialect
        self.port = CommandPort(self.out.append, Codec(5, 191), 5, lambda: self.dialect)
        self.now_us = 0

    def run(self, seconds: float) -> list[Any]:
        """Everything but heartbeats sent within that time, ticked at 50 Hz."""
        self.out.clear()
        for _ in range(round(seconds * 50)):
            self.port.step(self.now_us)
            self.now_us += 20_000
        decoded = [dialect.MAVLink(None).decode(bytearray(frame)) for frame in self.out]
        return [m for m in decoded if m.get_type() != "HEARTBEAT"]

    def hear(self, message: Any) -> list[CommandResult]:
        codec = Codec(5, 1)
        frame = codec.encode(message)
        self.port.frame(codec.decode(frame))
        return self.port.results()


def ack(command: int, result: int = 0, target: tuple[int, int] = (5, 191)) -> Any:
    return dialect.MAVLink_command_ack_message(command, result, 0, 0, *target)


def param_value(name: str, value: float, kind: int = 9) -> Any:
    return dialect.MAVLink_param_value_message(name.encode(), value, kind, 1, 0)


def bytewise(number: int) -> float:
    value: float = struct.unpack("<f", struct.pack("<i", number))[0]
    return value


@pytest.mark.parametrize(
    ("command", "number", "params"),
    [
        (Command(verb=Verb.ARM), 400, (1.0,)),
        (Command(verb=Verb.DISARM), 400, (0.0,)),
        (Command(verb=Verb.EXTERNAL), 176, (1.0, 6.0, 0.0)),
        (Command(verb=Verb.HOLD), 176, (1.0, 4.0, 3.0)),
        (Command(verb=Verb.RATE, value=50.0, number=331), 511, (331.0, 20_000.0)),
        (Command(verb=Verb.RATE, value=0.0, number=331), 511, (331.0, -1.0)),  # off
        (Command(verb=Verb.MESSAGE, number=49), 512, (49.0,)),
    ],
)
def test_what_is_asked_of_px4(command: Command, number: int, params: tuple[float, ...]) -> None:
    asked = PX4.long_command(command)
    assert asked is not None
    assert (asked.command, asked.params) == (number, params)


@pytest.mark.parametrize(
    ("command", "number", "params"),
    [
        (Command(verb=Verb.EXTERNAL), 176, (1.0, 4.0, 0.0)),  # GUIDED
        (Command(verb=Verb.HOLD), 176, (1.0, 17.0, 0.0)),  # BRAKE
        (Command(verb=Verb.LAND), 176, (1.0, 9.0)),
        (Command(verb=Verb.TAKEOFF, value=2.5), 22, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.5)),
        (Command(verb=Verb.ARM), 400, (1.0,)),
        (Command(verb=Verb.RATE, value=50.0, number=32), 511, (32.0, 20_000.0)),
    ],
)
def test_what_is_asked_of_arducopter(command: Command, number: int, params: tuple[float, ...]) -> None:
    asked = ARDUCOPTER.long_command(command)
    assert asked is not None
    assert (asked.command, asked.params) == (number, params)


@pytest.mark.parametrize("verb", [Verb.TAKEOFF, Verb.LAND])
def test_takeoff_and_land_happen_where_the_vehicle_is(verb: Verb) -> None:
    asked = PX4.long_command(Command(verb=verb, value=3.0))
    assert asked is not None
    assert asked.command == {Verb.TAKEOFF: 22, Verb.LAND: 21}[verb]
    assert len(asked.params) == 7
    assert all(math.isnan(p) for p in asked.params[4:])


def test_arming_is_never_forced() -> None:
    for verb, spoken in itertools.product((Verb.ARM, Verb.DISARM), (PX4, ARDUCOPTER)):
        asked = spoken.long_command(Command(verb=verb))
        assert asked is not None
        assert 21196.0 not in asked.params


def test_asked_four_times_every_half_second_then_no_answer() -> None:
    bench = Bench()
    bench.port.request(Command(verb=Verb.ARM))
    assert bench.port.busy
    sent = bench.run(0.5)
    assert [(m.command, m.confirmation, m.target_system, m.target_component) for m in sent] == [(400, 0, 5, 1)]
    assert [m.confirmation for m in bench.run(1.5)] == [1, 2, 3]
    assert bench.port.busy
    assert bench.run(0.5) == []
    assert bench.port.results() == [CommandResult(Command(verb=Verb.ARM), False, "no answer")]
    assert not bench.port.busy
    assert bench.port.results() == []


def test_an_acknowledgement_ends_the_asking() -> None:
    bench = Bench()
    bench.port.request(Command(verb=Verb.ARM))
    bench.run(0.1)
    assert bench.hear(ack(400)) == [CommandResult(Command(verb=Verb.ARM), True, "accepted")]
    assert bench.run(3.0) == []
    assert not bench.port.busy


@pytest.mark.parametrize(
    ("result", "words"),
    [(1, "temporarily rejected"), (2, "denied"), (3, "unsupported"), (4, "failed"), (77, "result 77")],
)
def test_a_refusal_is_a_result_in_words_and_is_not_asked_again(result: int, words: str) -> None:
    bench = Bench()
    bench.port.request(Command(verb=Verb.ARM))
    bench.run(0.1)
    (answer,) = bench.hear(ack(400, result))
    assert (answer.ok, answer.text) == (False, words)
    assert bench.run(3.0) == []


@pytest.mark.parametrize(
    ("command", "asked"),
    [
        (Command(verb=Verb.MESSAGE, number=49), "message GPS_GLOBAL_ORIGIN"),
        (Command(verb=Verb.RATE, number=331, value=50.0), "rate ODOMETRY"),
        (Command(verb=Verb.PARAM_INT, number=49, name="NAV_DLL_ACT"), "param_int NAV_DLL_ACT"),
        (Command(verb=Verb.ARM), "arm"),
    ],
)
def test_a_result_names_what_was_requested(command: Command, asked: str) -> None:
    assert CommandResult(command, True, "accepted").asked == asked


def test_in_progress_is_not_an_answer_yet() -> None:
    bench = Bench()
    bench.port.request(Command(verb=Verb.LAND))
    bench.run(0.1)
    for _ in range(20):  # for longer than silence is waited for
        assert bench.hear(ack(21, 5)) == []
        bench.run(0.5)
    assert bench.hear(ack(21, 0))[0].ok


@pytest.mark.parametrize("verb", [Verb.PARAM_GET, Verb.PARAM_FLOAT])
def test_what_is_said_of_another_parameter_is_no_answer(verb: Verb) -> None:
    bench = Bench()
    bench.port.request(Command(verb=verb, name="COM_OF_LOSS_T", value=0.5))
    bench.run(0.1)
    assert bench.hear(param_value("COM_RC_LOSS_T", 0.5)) == []
    assert bench.hear(dialect.MAVLink_param_error_message(5, 191, b"COM_RC_LOSS_T", -1, 1)) == []
    (answer,) = bench.hear(param_value("COM_OF_LOSS_T", 0.5))
    assert answer.ok


def test_the_answer_to_something_else_is_not_ours() -> None:
    bench = Bench()
    assert bench.hear(ack(400)) == []
    bench.port.request(Command(verb=Verb.EXTERNAL))
    bench.run(0.1)
    assert bench.hear(ack(400)) == []
    assert bench.hear(param_value("MIS_TAKEOFF_ALT", 3.0)) == []
    assert bench.port.busy


@pytest.mark.parametrize(
    ("target", "ours"),
    [
        *(((5, 191), True), ((5, 0), True), ((0, 191), True), ((0, 0), True)),
        *(((255, 190), False), ((5, 190), False), ((255, 191), False), ((255, 0), False), ((0, 190), False)),
    ],
)
def test_an_acknowledgement_counts_only_for_whom_it_names(target: tuple[int, int], ours: bool) -> None:
    bench = Bench()
    bench.port.request(Command(verb=Verb.ARM))
    bench.run(0.1)
    assert bool(bench.hear(ack(400, 0, target))) is ours, "a ground station asks the same vehicle to arm"


def test_one_after_the_other() -> None:
    bench = Bench()
    bench.port.request(Command(verb=Verb.ARM))
    bench.port.request(Command(verb=Verb.HOLD))
    assert [m.command for m in bench.run(0.4)] == [400]
    bench.hear(ack(400))
    assert bench.port.busy
    assert [m.command for m in bench.run(0.4)] == [176]


def test_takeoff_height_goes_into_the_parameter_before_the_command() -> None:
    bench = Bench()
    bench.port.request(Command(verb=Verb.TAKEOFF, value=3.1))
    (message,) = bench.run(0.2)
    assert (message.get_type(), message.param_id, message.param_type) == ("PARAM_SET", "MIS_TAKEOFF_ALT", 9)
    assert message.param_value == struct.unpack("<f", struct.pack("<f", 3.1))[0]
    (answer,) = bench.hear(param_value("MIS_TAKEOFF_ALT", 3.1))
    assert answer.ok
    assert [m.command for m in bench.run(0.2)] == [22]


def test_takeoff_is_not_asked_for_when_its_height_was_not_taken() -> None:
    bench = Bench()
    bench.port.request(Command(verb=Verb.TAKEOFF, value=3.1))
    for _ in range(4):
        assert [m.get_type() for m in bench.run(0.5)] == ["PARAM_SET"]
        assert bench.hear(param_value("MIS_TAKEOFF_ALT", 2.5)) == []
    assert bench.run(3.0) == []
    results = [(r.command.verb, r.ok, r.text) for r in bench.port.results()]
    why = "stays at 2.5"
    assert results == [(Verb.PARAM_FLOAT, False, why), (Verb.TAKEOFF, False, f"MIS_TAKEOFF_ALT: {why}")]


def test_an_answer_to_a_ground_station_does_not_end_the_setting_of_a_parameter() -> None:
    """It asks for the list when it sees the vehicle, just when the agent sets parameters; old values are in it."""
    bench = Bench()
    setting = Command(verb=Verb.PARAM_INT, name="NAV_DLL_ACT", number=3)
    bench.port.request(setting)
    bench.run(0.1)
    assert bench.hear(param_value("NAV_DLL_ACT", bytewise(0), 6)) == []
    assert bench.hear(param_value("NAV_DLL_ACT", bytewise(3), 6)) == [CommandResult(setting, True, "set")]


ASKED_IN_FLIGHT = frozenset((Verb.ARM, Verb.TAKEOFF, Verb.EXTERNAL))


@pytest.mark.parametrize("verb", [Verb.ARM, Verb.EXTERNAL])
def test_what_is_withdrawn_is_not_repeated_and_its_answer_is_waited_for(verb: Verb) -> None:
    bench = Bench()
    bench.port.request(Command(verb=verb))
    bench.port.request(Command(verb=Verb.LAND))
    assert len(bench.run(0.1)) == 1
    bench.port.withdraw(ASKED_IN_FLIGHT)
    assert bench.run(0.38) == [], "the vehicle may obey what it has got"
    assert bench.port.busy
    assert [m.command for m in bench.run(0.1)] == [21]
    assert [(r.command.verb, r.ok, r.text) for r in bench.port.results()] == [(verb, False, "no answer")]


def test_negative_control_what_is_not_withdrawn_is_repeated() -> None:
    bench = Bench()
    bench.port.request(Command(verb=Verb.ARM))
    bench.run(0.1)
    bench.port.withdraw(frozenset((Verb.TAKEOFF,)))
    assert [m.command for m in bench.run(2.0)] == [400, 400, 400]


def test_the_rest_of_a_withdrawn_request_is_not_sent() -> None:
    """PX4 is told the height of a take-off by a parameter first; a stop may come in between."""
    bench = Bench()
    bench.port.request(Command(verb=Verb.TAKEOFF, value=3.1))
    assert [m.get_type() for m in bench.run(0.1)] == ["PARAM_SET"]
    bench.port.withdraw(ASKED_IN_FLIGHT)
    height = next(step for step in PX4.steps(Command(verb=Verb.TAKEOFF, value=3.1)) if step.name)
    (result,) = bench.hear(param_value("MIS_TAKEOFF_ALT", struct.unpack("<f", struct.pack("<f", height.value))[0]))
    assert result.ok
    assert bench.run(3.0) == []
    assert not bench.port.busy


def test_what_waits_in_the_queue_and_is_withdrawn_is_never_sent() -> None:
    bench = Bench()
    bench.port.request(Command(verb=Verb.ARM))
    bench.port.withdraw(ASKED_IN_FLIGHT)
    assert bench.run(3.0) == []
    assert not bench.port.busy


def test_the_answer_to_a_repetition_acknowledges_no_other_command() -> None:
    bench = Bench()
    first, second = (Command(verb=Verb.RATE, value=5.0, number=n) for n in (245, 24))
    bench.port.request(first)
    bench.port.request(second)
    assert len(bench.run(0.6)) == 2, "the round trip is longer than half a second"
    assert bench.hear(ack(511)) == [CommandResult(first, True, "accepted")]
    assert len(bench.run(0.1)) == 1
    assert bench.hear(ack(511)) == [], "the second one for the first command"
    assert bench.hear(ack(511)) == [CommandResult(second, True, "accepted")]


def test_an_answer_that_was_lost_makes_one_command_be_repeated_and_not_all_that_follow() -> None:
    bench = Bench()
    rates = [Command(verb=Verb.RATE, value=5.0, number=n) for n in (245, 24, 1, 2)]
    for rate in rates:
        bench.port.request(rate)
    bench.run(0.6)  # asked twice, answered once
    assert bench.hear(ack(511)) == [CommandResult(rates[0], True, "accepted")]
    bench.run(0.1)
    assert bench.hear(ack(511)) == []
    assert len(bench.run(0.6)) == 1
    assert bench.hear(ack(511)) == [CommandResult(rates[1], True, "accepted")]
    for rate in rates[2:]:
        bench.run(0.1)
        assert bench.hear(ack(511)) == [CommandResult(rate, True, "accepted")]


def test_an_answer_before_the_command_was_sent_is_none() -> None:
    bench = Bench()
    first, second = (Command(verb=Verb.RATE, value=5.0, number=n) for n in (245, 24))
    bench.port.request(first)
    bench.port.request(second)
    bench.run(0.1)
    assert bench.hear(ack(511)) == [CommandResult(first, True, "accepted")]
    assert bench.hear(ack(511)) == []


def test_arducopter_takes_off_with_the_height_in_the_command() -> None:
    bench = Bench(ARDUCOPTER)
    bench.port.request(Command(verb=Verb.TAKEOFF, value=3.0))
    (message,) = bench.run(0.2)
    assert (message.command, message.param7) == (22, 3.0)


def test_nothing_is_asked_in_the_wrong_language() -> None:
    bench = Bench(None)
    bench.port.request(Command(verb=Verb.EXTERNAL))
    assert bench.run(5.0) == []
    assert bench.port.busy
    bench.dialect = ARDUCOPTER
    (message,) = bench.run(0.2)
    assert (message.command, message.param2) == (176, 4.0)


def test_integers_travel_as_floats_to_arducopter_and_are_read_so() -> None:
    bench = Bench(ARDUCOPTER)
    bench.port.request(Command(verb=Verb.PARAM_INT, number=8, name="GUID_OPTIONS"))
    (message,) = bench.run(0.1)
    assert (message.param_id, message.param_value) == ("GUID_OPTIONS", 8.0)
    assert bench.hear(param_value("GUID_OPTIONS", 8.0, 6))[0].ok
    assert ARDUCOPTER.from_wire(8.0, 6) == 8.0
    assert PX4.from_wire(bytewise(8), 6) == 8.0
    assert PX4.from_wire(0.625, 9) == 0.625


def test_a_parameter_is_read_by_its_name() -> None:
    bench = Bench()
    bench.port.request(Command(verb=Verb.PARAM_GET, name="MPC_THR_HOVER"))
    (message,) = bench.run(0.1)
    kind = message.get_type(), message.param_id, message.param_index, message.target_system
    assert kind == ("PARAM_REQUEST_READ", "MPC_THR_HOVER", -1, 5)
    (answer,) = bench.hear(param_value("MPC_THR_HOVER", 0.5))
    assert (answer.ok, answer.text) == (True, "0.5")


@pytest.mark.parametrize("number", [4, 0, -1, 2**31 - 1, -(2**31)])
def test_integer_parameters_travel_bytewise(number: int) -> None:
    bench = Bench()
    bench.port.request(Command(verb=Verb.PARAM_INT, number=number, name="COM_OBL_RC_ACT"))
    bench.run(0.02)
    frame = bench.out[-1]
    assert frame[7:10] == (23).to_bytes(3, "little")
    payload = frame[10:-2].ljust(23, b"\x00")
    assert payload[:4] == struct.pack("<i", number)
    assert payload[4:6] == b"\x05\x01"
    assert payload[6:22] == b"COM_OBL_RC_ACT\x00\x00"
    assert payload[22] == 6  # MAV_PARAM_TYPE_INT32
    (answer,) = bench.hear(param_value("COM_OBL_RC_ACT", bytewise(number), 6))
    assert answer.ok


def test_an_integer_that_the_vehicle_did_not_take_is_not_set() -> None:
    bench = Bench()
    bench.port.request(Command(verb=Verb.PARAM_INT, number=4, name="COM_OBL_RC_ACT"))
    bench.run(0.1)
    assert not any(r.ok for r in bench.hear(param_value("COM_OBL_RC_ACT", bytewise(0), 6)))


def test_a_float_that_the_vehicle_did_not_take_is_not_set() -> None:
    bench = Bench()
    bench.port.request(Command(verb=Verb.PARAM_FLOAT, value=0.5, name="MPC_LAND_SPEED"))
    bench.run(0.1)
    assert not any(r.ok for r in bench.hear(param_value("MPC_LAND_SPEED", 0.7)))


def test_a_parameter_that_does_not_exist_is_refused_at_once() -> None:
    bench = Bench()
    bench.port.request(Command(verb=Verb.PARAM_FLOAT, value=0.5, name="NO_SUCH"))
    bench.run(0.1)
    (answer,) = bench.hear(dialect.MAVLink_param_error_message(5, 191, b"NO_SUCH", -1, 1))
    assert (answer.ok, answer.text) == (False, "parameter error 1")


def test_a_ground_station_beats_five_times_a_second_whatever_happens() -> None:
    bench = Bench()
    bench.port.request(Command(verb=Verb.ARM))
    bench.run(10.0)
    beats = [f for f in bench.out if f[7:10] == b"\x00\x00\x00"]
    assert len(beats) == 50
    assert beats[0][5:7] == bytes([5, 191])
    assert struct.unpack("<I5B", beats[0][10:-2]) == (0, 6, 8, 0, 4, 3)  # ground station, active


def test_heartbeats_stop_while_nobody_attends_to_the_vehicle_and_commands_do_not() -> None:
    bench = Bench()
    bench.port.request(Command(verb=Verb.ARM))
    sent = []
    for k in range(500):  # 10 s, of which 3 to 7 unattended
        bench.port.step(20_000 * k, heartbeat=not 150 <= k < 350)
        sent += [(k, dialect.MAVLink(None).decode(bytearray(frame)).get_type()) for frame in bench.out]
        bench.out.clear()
    beats = [k for k, kind in sent if kind == "HEARTBEAT"]
    assert beats == [*range(0, 150, 10), *range(350, 500, 10)]
    assert any(kind == "COMMAND_LONG" for _, kind in sent)
