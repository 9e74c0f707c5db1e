"""From the plan that is flown to the frame that leaves: which command, what is never sent, and what is remembered."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType, SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from swarmctl.agent import assembly
from swarmctl.agent.components import make_estimator
from swarmctl.agent.flying import setpoint_output
from swarmctl.agent.flying.safety_filter import SafetyFilter
from swarmctl.agent.flying.setpoint_output import SetpointOutput
from swarmctl.agent.sensing.own_state import OwnState
from swarmctl.agent.watches.alerts import Alerts
from swarmctl.config import load
from swarmctl.control.collision.barrier import BarrierParams, Body
from swarmctl.control.mpc.problem import Start
from swarmctl.core.frames import euler_from_quat, quat_from_euler
from swarmctl.core.trajectory import Trajectory, resting
from swarmctl.core.types import Array, AttitudeSetpoint, Plan, PlanStatus, VehicleState
from swarmctl.mavlink.codec import Codec
from swarmctl.mavlink.vehicle.setpoint_stream import SetpointStream
from tests import builders

MS = 1_000
DT_US, STEPS = 20 * MS, 5
UTC_AHEAD_US = 1_700_000_000_000_000
HERE = np.array([0.0, 0.0, -3.0])
LEVEL = (0.0, 0.0, 9.81)
HOVER_01 = 0.5
IN_FRONT = Body(
    pos_ned_m=(0.55, 0.0, -3.0), vel_ned_m_s=(-1.0, 0.0, 0.0), apart_m=0.5, responsibility_01=1.0, solid=True
)


class Bench:
    """One output, the frames that leave it, and the time that passes between a tick's begin and its setpoint."""

    def __init__(self, *overrides: str, enabled: bool = True) -> None:
        config = load(None, ["swarm.agents=1", f"vehicle_model.hover_thrust_01={HOVER_01}", *overrides])
        setup = assembly._setup_of(config, 0, 1, {})
        self.model, self.now_us, self.held_up_us = setup.vehicle_model, 5_000_000, 0
        self.own_state = OwnState(self.model, make_estimator(setup))
        self.remembered: list[tuple[Array, float]] = []
        cast(Any, self.own_state).sent = lambda _, control, thrust_01: self.remembered.append((control, thrust_01))
        self.frames: list[bytes] = []
        self.stream = SetpointStream(Codec(1, 191), 1, self.frames.append)
        self.bodies: list[Body] = []
        self.asked: list[tuple[int, Any]] = []  # when bodies were asked for: the time they are to be of, and by what
        self.heading_rad: float | None = None
        self.alerts, self.told = Alerts(), list[tuple[str, dict[str, Any]]]()
        ports = SimpleNamespace(
            autopilot=SimpleNamespace(send=lambda setpoint, at_us: self.stream.send(setpoint, at_us, None, 0)),
            clock=SimpleNamespace(now_us=lambda: self.now_us + self.held_up_us),
            utc_of_us=lambda t_us: t_us + UTC_AHEAD_US,
            note=lambda name, **fields: self.told.append((name, fields)),
        )
        self.filter = SafetyFilter(
            BarrierParams(enabled=enabled),
            self.model,
            0.02,
            cast(Any, SimpleNamespace(bodies=self._bodies)),
            downwash=1.0,
            note=ports.note,
            stopwatch_ns=lambda: 0,
        )
        self.output = SetpointOutput(
            setup,
            cast(Any, ports),
            self.filter,
            self.own_state,
            cast(Any, SimpleNamespace(heading_rad=lambda _: self.heading_rad)),
            alerts=self.alerts,
        )

    def _bodies(self, _: Array, act_utc_us: int, *__: float, committed_peers: Any) -> list[Body]:
        self.asked.append((act_utc_us, committed_peers))
        return self.bodies

    @property
    def act_us(self) -> int:
        """Time at which the setpoint of the next tick acts."""
        return self.now_us + 20 * MS + self.own_state.delay_us

    def plan(self, *commands: tuple[float, ...], t0_us: int | None = None) -> Plan:
        """Return a plan with these commands, the last one repeated, which begins when the next setpoint acts."""
        rows = np.array([*commands, *[commands[-1]] * (STEPS - len(commands))])
        rest = np.tile(HERE, (STEPS + 1, 1))
        return Plan(
            status=PlanStatus.OK,
            t0_us=self.act_us if t0_us is None else t0_us,
            dt_us=DT_US,
            pos_ned_m=rest,
            vel_ned_m_s=np.zeros((STEPS + 1, 3)),
            virtual_control=rows,
        )

    def send(
        self,
        flown: Plan | None,
        *,
        flies: bool = True,
        start: Start | None = None,
        state: VehicleState | None = None,
        followed_z_m: float | None = None,
        committed: Mapping[int, Sequence[Trajectory]] = MappingProxyType({}),
    ) -> list[float] | None:
        """Fly a tick 20 ms after the last; return quaternion and thrust of the frame that has left, if one has."""
        self.now_us += 20 * MS
        before = len(self.frames)
        begun = start or builders.start(t_us=self.now_us + self.own_state.delay_us, pos_ned_m=HERE)
        setpoint = self.output.send(
            self.now_us,
            flown,
            begun,
            state or builders.vehicle_state(t_us=self.now_us, pos_ned_m=HERE),
            flies=flies,
            committed_peers=committed,
            followed_z_m=followed_z_m,
        )
        frames = self.frames[before:]
        assert len(frames) == (setpoint is not None), "one frame for each setpoint that is said to have been sent"
        if setpoint is None:
            return None
        fields = struct.unpack("<I4f3ff3B", frames[0][10:-2])
        assert fields[1:5] == pytest.approx(tuple(setpoint.q_nb), abs=1e-6)
        return [*fields[1:5], fields[8]]

    def estimate(self, **changes: Any) -> None:
        estimate = replace(self.own_state.estimate, **changes)
        self.own_state._estimator = cast(Any, SimpleNamespace(estimate=estimate))


def tilt_of(sent: list[float] | None) -> tuple[float, float]:
    """Return (u_x, u_y), north and east of the body's down axis, of what was sent."""
    assert sent is not None
    w, x, y, z = sent[:4]
    return 2 * (x * z + w * y), 2 * (y * z - w * x)


# -- which command ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("begins_ms", "step"), [(0, 0), (-19, 0), (-20, 1), (-45, 2), (-80, 4), (-500, 4), (30, 0)], ids=str
)
def test_the_command_is_the_one_of_the_plan_at_the_time_it_acts(begins_ms: int, step: int) -> None:
    """Before its begin it is the first one, past its end the last."""
    bench = Bench()
    commands = [(0.01 * k, -0.02 * k, 9.0 + 0.1 * k) for k in range(STEPS)]
    sent = bench.send(bench.plan(*commands, t0_us=bench.act_us + begins_ms * MS))
    assert tilt_of(sent) == pytest.approx(commands[step][:2], abs=1e-6)
    assert sent is not None
    assert sent[4] == pytest.approx(HOVER_01 * commands[step][2] / 9.80665, rel=1e-3)


def test_where_setpoints_are_held_for_longer_it_is_the_command_of_their_middle() -> None:
    bench = Bench()
    commands = [(0.01 * k, 0.0, 9.81) for k in range(STEPS)]
    for _ in range(3):
        bench.send(bench.plan(*commands))
        bench.now_us += 60 * MS  # a tick in 80 ms
    sent = bench.send(bench.plan(*commands))
    assert tilt_of(sent)[0] == pytest.approx(0.01, abs=1e-6), "the middle of 80 ms is one step later than that of 20"


def test_without_a_plan_or_a_start_nothing_leaves_and_nothing_is_remembered() -> None:
    bench = Bench()
    assert bench.send(None) is None
    bench.now_us += 20 * MS
    state = builders.vehicle_state(pos_ned_m=HERE)
    plan = bench.plan(LEVEL)
    sent = bench.output.send(bench.now_us, plan, None, state, flies=True, committed_peers={}, followed_z_m=None)
    assert sent is None
    assert (bench.frames, bench.remembered, bench.told) == ([], [], [])


# -- what never leaves ------------------------------------------------------------------------------------------------

BROKEN = [
    (math.nan, 0.0, 9.81),
    (0.0, math.nan, 9.81),
    (0.0, 0.0, math.nan),
    (0.0, 0.0, math.inf),
    (0.0, 0.0, -math.inf),
    (math.inf, 0.0, 9.81),
    (math.nan, math.nan, math.nan),
]


@pytest.mark.parametrize("flies", [True, False])
@pytest.mark.parametrize("command", BROKEN, ids=str)
@pytest.mark.parametrize("bodies", [[], [IN_FRONT]], ids=["alone", "near"])
def test_a_command_that_is_no_number_never_leaves_and_is_told(
    command: tuple[float, ...], bodies: list[Body], flies: bool
) -> None:
    bench = Bench()
    bench.bodies = bodies
    assert bench.send(bench.plan(command), flies=flies) is None
    alert = bench.alerts.newest(bench.now_us)
    assert alert is not None
    assert alert.text.startswith("setpoint refused: ")
    assert bench.send(bench.plan(command), flies=flies, followed_z_m=HERE[2] - 5.0) is None
    assert bench.remembered == [], "what was not sent moves nothing"
    assert [name for name, _ in bench.told if name == "setpoint_refused"] == ["setpoint_refused"] * 2
    bench.bodies = []
    assert bench.send(bench.plan(LEVEL), flies=flies) is not None, "the next good one does"


@pytest.mark.parametrize("q_nb", [(0.0, 0.0, 0.0, 0.0), (0.5, 0.0, 0.0, 0.0), (1.0, 0.5, 0.0, 0.0)], ids=str)
def test_an_attitude_that_is_none_never_leaves_whoever_has_made_it(
    q_nb: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench()
    with monkeypatch.context() as wrong:
        made = AttitudeSetpoint(np.array(q_nb), 0.5, bench.now_us + 1_000_000)
        wrong.setattr(setpoint_output, "setpoint_of", lambda *_, **__: made)
        assert bench.send(bench.plan(LEVEL)) is None
    assert bench.remembered == []
    assert bench.send(bench.plan(LEVEL)) is not None


@pytest.mark.parametrize("hover_thrust_01", [math.nan, math.inf])
def test_a_hover_thrust_that_is_no_number_never_leaves(hover_thrust_01: float) -> None:
    bench = Bench()
    bench.estimate(hover_thrust_01=hover_thrust_01)
    assert bench.send(bench.plan(LEVEL)) is None
    assert bench.remembered == []


@pytest.mark.parametrize("yaw_rad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("flies", [True, False])
def test_a_heading_that_is_no_number_turns_nothing_and_spoils_none_later(yaw_rad: float, flies: bool) -> None:
    bench = Bench()
    bench.heading_rad = yaw_rad
    for _ in range(3):
        assert bench.send(bench.plan(LEVEL), flies=flies) == pytest.approx([1.0, 0.0, 0.0, 0.0, 0.5], abs=1e-3)
    bench.heading_rad = 0.1
    for _ in range(10):
        sent = bench.send(bench.plan(LEVEL))
    assert sent is not None
    assert euler_from_quat(np.array(sent[:4]))[2] == pytest.approx(0.1, abs=1e-3)


def test_a_setpoint_of_a_tick_that_was_held_up_is_not_sent_late() -> None:
    bench = Bench()
    bench.held_up_us = 100 * MS
    assert bench.send(bench.plan(LEVEL)) is not None
    bench.held_up_us = 101 * MS
    assert bench.send(bench.plan(LEVEL)) is None
    assert len(bench.remembered) == 1


def test_whatever_number_a_plan_asks_for_the_attitude_is_one_and_the_thrust_is_within_its_limits() -> None:
    rng = np.random.default_rng(7)
    for heading in ("euler", "swing_twist"):
        bench = Bench(f"vehicle_model.heading='{heading}'")
        for _ in range(300):
            ux, uy, thrust = (
                float(rng.choice([0.0, 1e-9, 0.3, 1.0, 50.0, 1e200]) * rng.choice([-1, 1])) for _ in "xyz"
            )
            bench.heading_rad = float(rng.uniform(-10.0, 10.0))
            state = builders.vehicle_state(q_nb=quat_from_euler(0.0, 0.0, float(rng.uniform(-3, 3))), pos_ned_m=HERE)
            sent = bench.send(bench.plan((ux, uy, thrust)), flies=bool(rng.integers(2)), state=state)
            assert sent is not None
            assert np.linalg.norm(sent[:4]) == pytest.approx(1.0, abs=1e-5)
            assert bench.model.thrust_min_01 - 1e-6 <= sent[4] <= bench.model.thrust_max_01 + 1e-6
            assert math.hypot(*tilt_of(sent)) <= bench.model.u_max() + 1e-5


# -- what is changed before it leaves, and remembered as it left ------------------------------------------------------


def test_a_tilt_beyond_the_vehicles_is_shortened_and_remembered_so() -> None:
    bench = Bench()
    most = bench.model.u_max()
    sent = bench.send(bench.plan((most, -most, 9.81)))
    assert tilt_of(sent) == pytest.approx((most / math.sqrt(2), -most / math.sqrt(2)), abs=1e-5)
    ((remembered, thrust_01),) = bench.remembered
    assert remembered[:2] == pytest.approx((most / math.sqrt(2), -most / math.sqrt(2)), abs=1e-9)
    assert sent is not None
    assert thrust_01 == pytest.approx(sent[4], abs=1e-6)


@pytest.mark.parametrize(("hover_01", "asked_m_s2", "flown_01"), [(0.8, 15.0, 1.0), (0.5, 25.0, 1.0), (0.5, 0.0, 0.05)])
def test_thrust_that_the_vehicle_has_not_is_remembered_as_what_is_flown(
    hover_01: float, asked_m_s2: float, flown_01: float
) -> None:
    bench = Bench()
    bench.estimate(hover_thrust_01=hover_01)
    sent = bench.send(bench.plan((0.1, 0.0, asked_m_s2)))
    ((remembered, thrust_01),) = bench.remembered
    assert sent is not None
    assert sent[4] == pytest.approx(flown_01, abs=1e-6)
    assert thrust_01 == pytest.approx(flown_01, abs=1e-9)
    assert remembered == pytest.approx([0.1, 0.0, flown_01 * 9.80665 / hover_01], rel=1e-3)


@pytest.mark.parametrize(("flies", "enabled", "acts"), [(True, True, True), (False, True, False), (True, False, False)])
def test_who_flies_is_kept_from_bodies_and_who_does_not_sends_what_is_planned(
    flies: bool, enabled: bool, acts: bool
) -> None:
    bench = Bench(enabled=enabled)
    bench.bodies = [IN_FRONT]
    towards = (-0.03, 0.0, 9.81)  # leans to the north
    begun = builders.start(pos_ned_m=HERE, vel_ned_m_s=np.array([1.0, 0.0, 0.0]))
    sent = bench.send(bench.plan(towards), flies=flies, start=begun)
    assert bench.filter.acts is acts
    assert bool(tilt_of(sent)[0] > 0.0) is acts, "leans back"
    ((remembered, _),) = bench.remembered
    assert remembered[:2] == pytest.approx(tilt_of(sent), abs=1e-5), "the next plan begins from what is flown"


def test_bodies_are_those_of_when_it_acts_and_of_what_peers_have_committed_to() -> None:
    bench, committed = Bench(), {1: [resting(np.array([5.0, 0.0, -3.0]), 0, DT_US)]}
    acts_us = bench.act_us
    bench.send(bench.plan(LEVEL), committed=committed)
    assert bench.asked == [(acts_us + UTC_AHEAD_US, committed)]


def test_an_encounter_in_which_nothing_is_sent_any_more_ends() -> None:
    bench = Bench()
    bench.bodies = [IN_FRONT]
    begun = builders.start(pos_ned_m=HERE, vel_ned_m_s=np.array([1.0, 0.0, 0.0]))
    bench.send(bench.plan((-0.03, 0.0, 9.81)), start=begun)
    assert bench.filter.acts
    for _ in range(30):
        bench.send(None)
    assert not bench.filter.acts
    assert bench.told[-1] == ("safety_filter", {"acts": False, "ticks": 1})


@pytest.mark.parametrize(("below_m", "shortened"), [(0.2, False), (3.0, True)])
def test_who_has_sunk_gives_up_tilt_and_says_so(below_m: float, shortened: bool) -> None:
    bench = Bench("controller.mpc.thrust_max_m_s2=12")
    most = bench.model.u_max()
    sent = bench.send(bench.plan((0.0, most, 12.0)), followed_z_m=HERE[2] - below_m)
    assert bool(tilt_of(sent)[1] < most - 0.02) is shortened
    alert = bench.alerts.newest(bench.now_us)
    assert (alert is not None and alert.text.startswith(f"{below_m:.1f} m too low")) is shortened


def test_without_a_reference_nobody_knows_how_low_it_is() -> None:
    bench = Bench("controller.mpc.thrust_max_m_s2=12")
    most = bench.model.u_max()
    assert tilt_of(bench.send(bench.plan((0.0, most, 12.0))))[1] == pytest.approx(most, abs=1e-5)


# -- the handover -----------------------------------------------------------------------------------------------------


def test_until_the_agent_flies_the_heading_is_the_vehicles_and_from_then_on_it_turns_at_a_bounded_rate() -> None:
    bench = Bench()
    bench.heading_rad = 0.0
    stands = builders.vehicle_state(pos_ned_m=HERE, q_nb=quat_from_euler(0.0, 0.0, 2.0))
    yaws = []
    for flies in [False] * 100 + [True] * 100:
        sent = bench.send(bench.plan(LEVEL), flies=flies, state=stands)
        assert sent is not None
        yaws.append(float(euler_from_quat(np.array(sent[:4]))[2]))
    assert min(yaws[:100]) > 1.85
    assert np.abs(np.diff(yaws)[100:]).max() <= 0.021
    assert yaws[150] == pytest.approx(yaws[100] - 1.0, abs=1e-3)
    assert yaws[199] == pytest.approx(0.0, abs=1e-3)
