"""Tests of what own controllers and missions are, where they are found, and how bad ones are refused."""

from __future__ import annotations

import importlib.metadata
import itertools
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from swarmctl.config import dump, load
from swarmctl.control.controllers.discovery import ControllerParams, make_controller
from swarmctl.control.controllers.guard import BAD_IN_A_ROW, LATE_IN_A_ROW, Guard
from swarmctl.control.controllers.kind import Controller
from swarmctl.control.controllers.own import OwnController
from swarmctl.control.model import VehicleModelParams
from swarmctl.control.mpc.problem import Problem
from swarmctl.control.rollout import ModelledVehicle
from swarmctl.core.types import Array, PlanStatus, Reference
from swarmctl.errors import ConfigError
from tests import builders

ROOT = Path(__file__).parents[3]
HERE = np.array([1.0, 2.0, -3.0])
EXAMPLE = ROOT / "configs" / "examples" / "own_pid.toml"


class Scripted(OwnController):
    """Commands what a test has put here."""

    answer: Any = None

    def commands(self, problem: Problem) -> Array:
        found: Array = type(self).answer(self, problem)
        return found


def guarded(answer: Any, took_s: float = 0.0) -> Controller:
    Scripted.answer = answer
    clock = itertools.count(0, round(took_s * 1e9))
    return make_controller(
        ControllerParams(kind=f"{__name__}:Scripted"),
        builders.controller_setup(stopwatch_ns=lambda: next(clock)),
    )


def hover(controller: Controller, *peers_ned_m: tuple[float, ...]) -> Problem:
    points = controller.longest + 1
    keep_outs = [builders.keep_out(pos_ned_m=np.tile(HERE + at, (controller.steps + 1, 1))) for at in peers_ned_m]
    return Problem(
        start=builders.start(t_us=7_000_000, pos_ned_m=HERE),
        reference=Reference(np.tile(HERE, (points, 1)), np.zeros((points, 3)), 0.0),
        disturbance_ned_m_s2=np.zeros(3),
        keep_outs=tuple(keep_outs),
        guess_ned_m=None,
    )


def level(own: OwnController, problem: Problem) -> Array:
    return np.tile([0.0, 0.0, 9.81], (own.steps, 1))


def north(own: OwnController, problem: Problem) -> Array:
    return np.tile([-0.2, 0.0, 10.0], (own.steps, 1))


def test_good_commands_are_flown_with_the_motion_that_they_give() -> None:
    controller = guarded(north)
    assert isinstance(controller, Guard)
    plan = controller.plan(hover(controller))
    assert (plan.status, plan.failure) == (PlanStatus.OK, "")
    np.testing.assert_allclose(plan.virtual_control, north(_own(controller), hover(controller)))
    end_s = controller.steps * controller.dt_us * 1e-6
    assert plan.pos_ned_m[-1, 0] - HERE[0] == pytest.approx(0.5 * 10.0 * 0.2 * end_s**2, rel=1e-6)  # x'' = -f u_x


def _own(controller: Controller) -> OwnController:
    assert isinstance(controller, Guard)
    return controller._own


class UnshowableError(Exception):
    def __str__(self) -> str:
        raise ValueError


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        (lambda own, problem: np.full((own.steps, 3), np.nan), "not finite"),
        (lambda own, problem: np.zeros((2, 3)), "shape (2, 3)"),
        (lambda own, problem: None, "shape ()"),
        (lambda own, problem: "level", "raised ValueError"),
        (lambda own, problem: 1 / 0, "raised ZeroDivisionError"),
        (lambda own, problem: (_ for _ in ()).throw(OSError("\x1b]0;owned")), r"raised OSError: \x1b]0;owned"),
        (lambda own, problem: exit(3), "raised SystemExit"),
        (lambda own, problem: (_ for _ in ()).throw(UnshowableError()), "raised UnshowableError, which can't be shown"),
    ],
)
def test_what_is_no_command_is_replaced_and_after_half_a_second_not_asked_for(answer: Any, why: str) -> None:
    controller = guarded(answer)
    for tick in range(BAD_IN_A_ROW):
        plan = controller.plan(hover(controller))
        assert plan.status is PlanStatus.OK and np.isfinite(plan.virtual_control).all()
        assert f"{__name__}:Scripted" in plan.failure and why in plan.failure and plan.failure.isprintable()
        assert plan.suspended == (tick == BAD_IN_A_ROW - 1)
    Scripted.answer = level
    assert controller.plan(hover(controller)).suspended, "it is not asked any more"
    controller.reset()
    assert controller.plan(hover(controller)).suspended, "nor after a handover"


def test_beside_a_keep_out_without_a_place_nothing_of_its_own_is_flown() -> None:
    controller = guarded(level)
    plan = controller.plan(hover(controller, (9.0, 0.0, 0.0), (0.0, 9.0, 0.0), (math.nan, 0.0, 0.0)))
    assert plan.failure.endswith("plans too close to a peer or an obstacle")
    assert plan.status is not PlanStatus.OK, "nor of the fallback"


def test_a_late_controller_is_suspended_and_a_punctual_one_is_not() -> None:
    late, punctual = guarded(level, took_s=0.1), guarded(level, took_s=0.03)
    told = [[controller.plan(hover(controller)) for _ in range(LATE_IN_A_ROW)] for controller in (late, punctual)]
    assert [plan.suspended for plan in told[0]] == [False] * (LATE_IN_A_ROW - 1) + [True]
    assert "took 100 ms" in told[0][-1].failure
    assert not any(plan.failure for plan in told[1])


def test_commands_towards_a_peer_are_replaced_and_commands_beside_it_are_not() -> None:
    controller = guarded(north)
    plan = controller.plan(hover(controller, (1.5, 0.0, 0.0)))
    assert "plans too close" in plan.failure
    assert not plan.suspended
    assert controller.plan(hover(controller, (-1.5, 0.0, 0.0))).failure == ""


def test_a_vehicle_must_be_able_to_stop_behind_its_plan() -> None:
    """At the end of its plan the vehicle is 1.1 m from the peer, beyond the 0.9 m it keeps, with 1.6 m/s towards it."""
    controller = guarded(north)
    plan = controller.plan(hover(controller, (1.75, 0.0, 0.0)))
    assert "plans too close" in plan.failure
    assert controller.plan(hover(controller, (4.0, 0.0, 0.0))).failure == ""


@pytest.mark.parametrize(("priority_id", "refused"), [(-1, True), (1, False)])
def test_behind_its_plan_an_obstacle_moves_on_and_a_peer_brakes(priority_id: int, refused: bool) -> None:
    """Comes from 4.4 m north at 2 m/s: while the vehicle stops, in 0.53 s, 1.06 m, or 0.64 m of a peer that brakes."""
    controller = guarded(north)
    way = -2.0 * np.arange(controller.steps + 1) * controller.dt_us * 1e-6
    pos = HERE + np.column_stack([4.4 + way, 0 * way, 0 * way])
    problem = replace(hover(controller), keep_outs=(builders.keep_out(pos_ned_m=pos, priority_id=priority_id),))
    assert ("plans too close" in controller.plan(problem).failure) == refused


def falling(own: OwnController, problem: Problem) -> Array:
    return np.tile([0.0, 0.0, 0.0], (own.steps, 1))


@pytest.mark.parametrize("above_m", [None, 100.0, 2.0])
def test_a_plan_into_the_ground_is_replaced(above_m: float | None) -> None:
    """One that asked for no thrust fell from 2 m to the ground: its agent crashed at 0.7 s."""
    controller = guarded(falling)
    problem = replace(hover(controller), ground_z_m=None if above_m is None else HERE[2] + above_m)
    assert ("plans to fly into the ground" in controller.plan(problem).failure) == (above_m == 2.0)


def test_a_plan_that_follows_its_reference_below_the_place_of_the_take_off_is_flown() -> None:
    controller = guarded(level)
    here = hover(controller)
    assert controller.plan(replace(here, ground_z_m=HERE[2] - 5.0)).failure == "", "down a slope"
    above = replace(here.reference, pos_ned_m=here.reference.pos_ned_m - [0.0, 0.0, 5.0])
    low = replace(here, reference=above, ground_z_m=HERE[2] + 0.1)
    assert "plans to fly into the ground" in controller.plan(low).failure


def test_what_it_is_told_can_be_changed_without_effect() -> None:
    def meddle(own: OwnController, problem: Problem) -> Array:
        problem.keep_outs[0].pos_ned_m[:] += 100.0
        problem.start.pos_ned_m[:] -= 100.0
        return north(own, problem)

    controller = guarded(meddle)
    problem = hover(controller, (1.5, 0.0, 0.0))
    assert "plans too close" in controller.plan(problem).failure
    np.testing.assert_array_equal(problem.start.pos_ned_m, HERE)


# -- where they are found, and what is refused -------------------------------------------------------------------------


def refusal(*overrides: str, path: Path | None = None) -> str:
    with pytest.raises(ConfigError) as caught:
        load(path, overrides)
    return str(caught.value)


def test_own_modules_are_found_beside_the_configuration_also_from_the_run_folder(tmp_path: Path) -> None:
    config = load(EXAMPLE)
    assert config.own_folder == str(EXAMPLE.parent)
    resolved = tmp_path / "config.toml"
    resolved.write_text(dump(config))
    assert load(resolved) == config


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (("controller.kind=own_pidd:Pid",), ("own_pidd", "can't be imported", "own_folder")),
        (("controller.kind=own_pid:Pad",), ("own_pid has no class Pad",)),
        (("controller.kind=os:PathLike",), ("no class PathLike derived from",)),
        (("controller.kind=dmpcc",), ("did you mean 'dmpc'?", "'package.module:Class'")),
        (("mission.kind=figure8",), ("did you mean 'lemniscate'?", "'package.module:Class'")),
        (("controller.own.kp=-1",), ("controller.own.kp = -1", "greater than")),
        (("controller.own.kpp=1",), ("controller.own.kpp = 1: unknown key; did you mean 'kp'?",)),
        (("separation.mode=guaranteed",), ("controller.kind = 'own_pid:Pid'", "best_effort")),
        (("agent.barrier.enabled=false",), ("agent.barrier.enabled = false", "set it to true")),
    ],
)
def test_an_own_controller_that_can_not_fly_is_refused(overrides: tuple[str, ...], words: tuple[str, ...]) -> None:
    said = refusal(*overrides, path=EXAMPLE)
    assert [word for word in words if word not in said] == []


def test_a_module_that_misses_another_is_not_looked_for_elsewhere(tmp_path: Path) -> None:
    (tmp_path / "imports_numpyy.py").write_text("import numpyy")
    (tmp_path / "own.toml").write_text('[mission]\nkind = "imports_numpyy:Own"\n')
    said = refusal(path=tmp_path / "own.toml")
    assert "imports_numpyy can't be imported: ModuleNotFoundError: No module named 'numpyy'" in said
    assert "own_folder" not in said
    assert "own_folder" in refusal("mission.kind=nowhere.at.all:Own")


MISSION = """
import numpy as np
from swarmctl.control.reference.kind import MissionKind

class Own(MissionKind):
    def reference(self, place):
        {body}
"""


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("return lambda t: (np.tile(place.start_ned_m, (len(t), 1)), np.zeros((len(t), 3)))", ""),
        ("return lambda t: 1 / 0", "raised ZeroDivisionError"),
        ("return lambda t: (np.zeros((len(t), 2)), np.zeros((len(t), 2)))", "of shape"),
        ("return lambda t: (np.full((len(t), 3), np.nan), np.zeros((len(t), 3)))", "not a finite number"),
        ("return lambda t: (np.tile([0.0, 0.0, -1.0], (len(t), 1)), np.zeros((len(t), 3)))", "0.00 m apart"),
    ],
)
def test_an_own_mission_is_checked_before_it_is_flown(
    body: str, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    name = f"mission_{abs(hash(body))}"
    (tmp_path / f"{name}.py").write_text(MISSION.format(body=body))
    (tmp_path / "own.toml").write_text(f'[mission]\nkind = "{name}:Own"\nduration_s = 3.0\n')
    if words:
        assert words in refusal(path=tmp_path / "own.toml")
    else:
        assert load(tmp_path / "own.toml").mission.is_own


HOOKS = """
import numpy as np
from swarmctl.control.reference.kind import MissionKind

class Own(MissionKind):
    def reference(self, place):
        return lambda t: (np.tile(place.start_ned_m, (len(t), 1)), np.zeros((len(t), 3)))

    {hook}
"""


def written(folder: Path, hook: str) -> Path:
    name = f"hook_{abs(hash(hook))}"
    (folder / f"{name}.py").write_text(HOOKS.format(hook=hook))
    (folder / "own.toml").write_text(f'[mission]\nkind = "{name}:Own"\nduration_s = 3.0\n')
    return folder / "own.toml"


@pytest.mark.parametrize(
    ("hook", "words"),
    [
        ("def problems(self, agents): yield 'too many'", "too many"),
        ("def problems(self, agents): return {}[agents]", "its problems raised KeyError"),
        ("def problems(self, agents): pass", "its problems raised TypeError"),
        ("fixed_in_time = property(lambda self: 1 / 0)", "raised ZeroDivisionError"),
        ("def heading(self, place): return lambda t: np.zeros((len(t), 1))", "yaws of shape (151, 1) for 151 times"),
        ("def heading(self, place): return 0.5", "raised TypeError"),
        ("def offset_ned_m(self, place): return np.zeros(2)", "an offset of shape (2,), not (3,)"),
    ],
)
def test_what_else_an_own_mission_says_is_checked_too(hook: str, words: str, tmp_path: Path) -> None:
    assert words in refusal(path=written(tmp_path, hook))


@pytest.mark.parametrize(
    ("hook", "said"),
    [
        ("def excess(self, start, pos, vel): return 'too far'", "too far"),
        ("def excess(self, start, pos, vel): return None", ""),
        ("def excess(self, start, pos, vel): return 1 / 0", "mission hook_{} raised ZeroDivisionError"),
        ("def excess(self, start, pos, vel):\n        pos -= 100.0\n        return ''", ""),
    ],
)
def test_what_an_own_mission_does_in_a_tick_ends_the_flight_at_most(hook: str, said: str, tmp_path: Path) -> None:
    config = load(written(tmp_path, hook))
    reference = config.mission.references(np.array(config.starts_ned_m()), 1.0)[0]
    here = HERE.copy()
    assert reference.excess(here, np.zeros(3)).startswith(said.format(f"{abs(hash(hook))}:Own"))
    np.testing.assert_array_equal(here, HERE)


CONTROLLER = """
from swarmctl.control.controllers.own import FeedbackController
from swarmctl.core.params import Params

class Gains(Params):
    {gains}

class Own(FeedbackController):
    Params = Gains

    def accel_ned_m_s2(self, pos, vel, wanted_pos, wanted_vel, wanted_accel):
        return wanted_accel
"""


def configured(folder: Path, gains: str) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "own_gains.py").write_text(CONTROLLER.format(gains=gains))
    (folder / "own.toml").write_text('[controller]\nkind = "own_gains:Own"\n')
    return folder / "own.toml"


def test_own_modules_that_have_changed_are_imported_anew(tmp_path: Path) -> None:
    """A notebook was told `unknown key` of a parameter that it had just added, until its kernel was started again."""
    path = configured(tmp_path / "a", "kp: float = 1.0")
    assert load(path, ["controller.own.kp=2"])
    assert "unknown key" in refusal("controller.own.kd=2", path=path)
    before = sys.modules["own_gains"]
    assert load(path) and sys.modules["own_gains"] is before, "it is the same as long as its file is"
    configured(tmp_path / "a", "kp: float = 1.0; kd: float = 1.0")
    assert load(path, ["controller.own.kd=2"])
    other = configured(tmp_path / "b", "gain: float = 1.0")
    assert load(other, ["controller.own.gain=2"]), "another folder has a module of the same name"
    assert load(path, ["controller.own.kd=2"])


def test_parameters_of_an_own_controller_that_are_none_are_refused(tmp_path: Path) -> None:
    path = configured(tmp_path, "kp: float = 1.0")
    (tmp_path / "own_gains.py").write_text(CONTROLLER.format(gains="kp: float = 1.0").replace("(Params)", ""))
    assert "own_gains:Own: its Params is no class derived from swarmctl.core.params.Params" in refusal(path=path)


def test_a_pid_that_would_take_ticks_for_longer_or_shorter_is_refused() -> None:
    said = refusal("controller.kind=pid", "agent.rate_hz=25")
    assert "controller.pid.dt_s = 0.02: ticks are 0.04 s apart by agent.rate_hz = 25" in said
    assert load(None, ["controller.kind=pid", "agent.rate_hz=25", "controller.pid.dt_s=0.04"])
    assert load(None, ["agent.rate_hz=25"])


def test_installed_packages_offer_missions_and_controllers(monkeypatch: pytest.MonkeyPatch) -> None:
    def offered(group: str) -> list[importlib.metadata.EntryPoint]:
        return [importlib.metadata.EntryPoint("scripted", f"{__name__}:Scripted", group)]

    monkeypatch.setattr(importlib.metadata, "entry_points", offered)
    assert load(None, ["controller.kind=scripted"]).controller.is_own
    assert "'scripted'" in refusal("controller.kind=scriptd")


# -- the motion that commands give -------------------------------------------------------------------------------------


@pytest.mark.parametrize("drag_1_s", [0.0, 0.4])
def test_the_controls_of_an_acceleration_give_it_against_wind_and_drag(drag_1_s: float) -> None:
    wanted, wind = np.array([1.0, -0.5, -0.7]), np.array([0.3, 0.2, -0.1])
    start = builders.start(pos_ned_m=HERE, vel_ned_m_s=np.array([2.0, 0.0, 0.5]))
    vehicle = ModelledVehicle(start, VehicleModelParams(drag_1_s=drag_1_s), wind)
    vehicle.step(vehicle.control_for(wanted), 0.02)
    np.testing.assert_allclose((vehicle.vel_ned_m_s - start.vel_ned_m_s) / 0.02, wanted, atol=1e-9)


def test_commands_beyond_the_vehicle_are_limited_as_its_setpoints_are() -> None:
    params = VehicleModelParams(tilt_max_rad=0.3, hover_thrust_01=0.5, thrust_max_01=0.8)
    vehicle = ModelledVehicle(builders.start(pos_ned_m=HERE), params, np.zeros(3))
    ux, uy, thrust = vehicle.bounded(np.array([0.6, 0.8, 100.0]))
    assert (ux, uy) == pytest.approx((0.6 * np.sin(0.3), 0.8 * np.sin(0.3)))
    assert thrust == pytest.approx(0.8 / 0.5 * 9.80665, rel=1e-3)
    harsh = vehicle.control_for(np.array([50.0, 0.0, 30.0]))
    assert np.hypot(*harsh[:2]) <= np.sin(0.3) + 1e-9
    assert harsh[2] >= params.thrust_range_m_s2()[0] - 1e-9


def test_a_lagging_vehicle_turns_later() -> None:
    lagging, prompt = (
        ModelledVehicle(builders.start(pos_ned_m=HERE), VehicleModelParams(attitude_rad_s=w), np.zeros(3))
        for w in (9.5, 0.0)
    )
    for vehicle in (lagging, prompt):
        for _ in range(20):
            vehicle.step(np.array([-0.2, 0.0, 9.81]), 0.02)
    assert 0.1 < lagging.vel_ned_m_s[0] < 0.7 * prompt.vel_ned_m_s[0]
