"""Scenarios of a campaign: one table, each row a function of seed and agents.

Two sizes of vehicle. `THESIS`: its airframe, bodies of 0.48 m that keep 0.9 m, as everywhere else here. `SMALL`: a
Crazyflie (0.14 m from tip to tip, counted as 0.15 m) that keeps 0.3 m, the figures of the public baselines for boxes,
forests and mazes (online_dmpc: minimum distance 0.3 m, 1 m/s2, a box of 3 x 3 x 2 m; judged at 0.15 m).
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sitl.studies.campaign.conditions.events import Appearance, Death, Partition, ScenarioEvent
from sitl.studies.campaign.conditions.layouts import far_goals, forest, permuted, ring, scattered, walls
from swarmctl.bus.messages.json_messages import MAX_OBSTACLES
from swarmctl.core.clock import ClockError
from swarmctl.core.types import Array


@dataclass(frozen=True, slots=True)
class Size:
    """A vehicle and its separation."""

    radius_m: float
    body_m: float
    settings: tuple[str, ...]


THESIS = Size(0.9, 0.48, ("sitl.preset=thesis",))
SMALL = Size(
    0.3,
    0.15,
    (
        "sitl.preset=crazyflie",
        "limits.min_separation_m=0.15",
        "vehicle_model={delay_s=0.04,attitude_rad_s=20.0,drag_1_s=0.25,hover_thrust_01=0.43}",
    ),
)
X500 = Size(
    0.9,
    0.65,
    (
        "sitl.preset=x500",
        "sitl.physics_hz=250",
        "separation.tracking_m=0.05",
        "limits.min_separation_m=0.65",
        "agent.state_filter={enabled=true,disturbance_m_s2=1.5}",
        "agent.commit.tilt_fraction_01=0.9",
        "controller.mpc={dt_s=0.05,horizon_xy=40,control_xy=15,thrust_max_m_s2=15.0,u_max=0.85,"
        "z={q_pos=20.0,q_vel=0.05,r=1.0}}",
        "vehicle_model={delay_s=0.08,attitude_rad_s=9.5,attitude_damping=1.0,drag_1_s=1.0,tilt_max_rad=1.05,"
        "thrust_max_01=0.95,hover_thrust_01=0.49}",
    ),
)
AIRFRAMES: dict[str, Size | None] = {"own": None, "x500": X500}  # instead of the scenario's own


@dataclass(frozen=True, slots=True, kw_only=True)
class Layout:
    """One drawn instance of a scenario."""

    size: Size
    starts_ned_m: Array  # (N, 3)
    settings: tuple[str, ...]
    limit_s: float  # of mission time
    goals_ned_m: Array | None = None  # (N, 3); None: the mission is flown to its end
    arrive_m: float = 0.15
    settles: bool = False  # one goal for all: arrived when all vehicles are at rest
    events: tuple[ScenarioEvent, ...] = ()
    uncooperative: frozenset[int] = frozenset()  # agents that avoid nothing
    lost: frozenset[int] = frozenset()  # agents that are not expected to arrive
    clocks: Mapping[int, ClockError] = field(default_factory=dict)  # errors of agents' clocks

    @property
    def agents(self) -> int:
        """Return the number of agents."""
        return len(self.starts_ned_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """A row of the table."""

    title: str
    draw: Callable[[np.random.Generator, int], Layout]
    agents: tuple[int, ...]  # default numbers of agents
    alone: bool = False  # also fly the longest path with a single agent, for comparison
    needs: int = 1  # smallest sensible number of agents


_JITTER_M = 0.05
_SPEED_M_S, _ACCEL_M_S2 = 2.0, 1.2
_SMALL_M_S, _SMALL_M_S2 = 1.0, 1.0
_FAST_M_S, _FAST_M_S2 = 6.0, 4.0
AGILE = (  # what an x500 needs above 4 m/s, as in configs/x500_fast_circle.toml
    "controller.mpc.blocking_xy=spread",
    "controller.mpc.control_xy=10",
    "controller.mpc.du_max=0.1",
    "controller.mpc.thrust_max_m_s2=18.0",
    "vehicle_model.heading=swing_twist",
)
_COLUMN_M = 0.3  # radius of a tree
_POST_RADIUS_M = 0.15
_HULL_MARGIN_M = 0.15  # planned between a small vehicle's hull and a surface; plans are certified to 0.1 m less
_GUSTY_M = 4.0  # what an x500 keeps where the wind may change by 8 m/s at once
_SWAP_S = (1.5, 3.5)  # mission time at which all vehicles are on the way to the middle


def _go(goals: Array, speed_m_s: float = _SPEED_M_S, accel_m_s2: float = _ACCEL_M_S2) -> tuple[str, ...]:
    return (
        "mission.kind=goto",
        f"mission.goto={{goals_ned_m={goals.tolist()},speed_m_s={speed_m_s},accel_m_s2={accel_m_s2}}}",
    )


def _columns(axes: Array, radius_m: float, size: Size) -> str:
    keep_out_m = radius_m + 0.5 * size.body_m + _HULL_MARGIN_M
    entry = f"column=true,radius_m={radius_m},keep_out_m={keep_out_m:.3f},visibility_m=2.0"
    items = ",".join(f"{{center_ned_m={axis},{entry}}}" for axis in axes.tolist())
    return f"obstacles=[{items}]"


def _circle(rng: np.random.Generator, agents: int) -> Layout:
    line = np.zeros((agents, 3))
    line[:, 0] = np.arange(agents) - (agents - 1) / 2
    line[:, :2] += rng.uniform(-_JITTER_M, _JITTER_M, (agents, 2))
    return Layout(size=THESIS, starts_ned_m=line, settings=("mission.kind=circle",), limit_s=25.0)


def _swap(
    rng: np.random.Generator,
    agents: int,
    *,
    jitter_m: float = _JITTER_M,
    least_m: float = 4.0,
    apart_m: float = THESIS.radius_m,
    speed_m_s: float = _SPEED_M_S,
    accel_m_s2: float = _ACCEL_M_S2,
) -> Layout:
    radius_m = max(least_m, 0.7 * apart_m / math.sin(math.pi / agents))
    exact = ring(agents, radius_m, float(rng.uniform(0.0, 2.0 * math.pi)))
    starts = exact.copy()
    starts[:, :2] += rng.uniform(-jitter_m, jitter_m, (agents, 2))
    goals = -starts
    settings = _go(goals, speed_m_s, accel_m_s2)
    return Layout(size=THESIS, starts_ned_m=starts, settings=settings, limit_s=40.0, goals_ned_m=goals)


def _symmetric(rng: np.random.Generator, agents: int) -> Layout:
    return _swap(rng, agents, jitter_m=0.0)


def _wide_swap(rng: np.random.Generator, agents: int) -> Layout:
    return _swap(rng, agents, least_m=7.0, apart_m=_GUSTY_M)


def _fast_swap(rng: np.random.Generator, agents: int) -> Layout:
    layout = _swap(rng, agents, least_m=10.0, apart_m=X500.radius_m, speed_m_s=_FAST_M_S, accel_m_s2=_FAST_M_S2)
    return replace(layout, size=X500, settings=(*layout.settings, *AGILE))


def _random(rng: np.random.Generator, agents: int) -> Layout:
    low, high = np.array([-1.5, -1.5, -2.2]), np.array([1.5, 1.5, -0.2])
    starts = scattered(rng, agents, low, high, apart_m=0.5)
    goals = far_goals(rng, starts, low, high, apart_m=0.5, way_m=1.0)
    return Layout(
        size=SMALL,
        starts_ned_m=starts,
        settings=_go(goals, _SMALL_M_S, _SMALL_M_S2),
        limit_s=30.0,
        goals_ned_m=goals,
        arrive_m=0.1,
    )


def _permutation(rng: np.random.Generator, agents: int) -> Layout:
    low, high = np.array([-20.0, -20.0, -12.0]), np.array([20.0, 20.0, -2.0])
    starts = scattered(rng, agents, low, high, apart_m=2.0 * THESIS.radius_m)
    goals = permuted(rng, starts, way_m=5.0)
    return Layout(size=THESIS, starts_ned_m=starts, settings=_go(goals), limit_s=60.0, goals_ned_m=goals)


def _same_goal(rng: np.random.Generator, agents: int) -> Layout:
    starts = ring(agents, max(4.0, 0.7 * THESIS.radius_m / math.sin(math.pi / max(agents, 2))), 0.0)
    starts[:, :2] += rng.uniform(-0.2, 0.2, (agents, 2))
    goal = np.zeros((1, 3))
    return Layout(
        size=THESIS,
        starts_ned_m=starts,
        settings=_go(goal),
        limit_s=30.0,
        goals_ned_m=np.repeat(goal, agents, axis=0),
        settles=True,
    )


def _forest(rng: np.random.Generator, agents: int) -> Layout:
    axes = forest(rng, 20, 4.0, 1.1)  # the tightest gap: 0.5 m between surfaces
    starts = ring(agents, 5.0, float(rng.uniform(0.0, 2.0 * math.pi)))
    starts[:, 2] = -1.0
    goals = starts * [-1.0, -1.0, 1.0]
    settings = (*_go(goals, _SMALL_M_S, _SMALL_M_S2), _columns(axes, _COLUMN_M, SMALL))
    return Layout(size=SMALL, starts_ned_m=starts, settings=settings, limit_s=60.0, goals_ned_m=goals, arrive_m=0.1)


def _maze_posts(rng: np.random.Generator) -> Array:
    return walls(rng, np.array([-3.0, -1.0, 1.0, 3.0]), 4.0, (0.6, 1.2), gap_m=1.2)


def _maze(rng: np.random.Generator, agents: int) -> Layout:
    posts = _maze_posts(rng)
    while len(posts) > MAX_OBSTACLES:  # drawn again, so that every seed that fits keeps its own
        posts = _maze_posts(rng)
    width = np.linspace(-3.0, 3.0, agents)
    starts = np.stack([np.full(agents, -4.5), rng.permutation(width), np.full(agents, -1.0)], axis=1)
    goals = np.stack([np.full(agents, 4.5), rng.permutation(width), np.full(agents, -1.0)], axis=1)
    other_way = np.arange(agents) % 2 == 1
    starts[other_way], goals[other_way] = goals[other_way].copy(), starts[other_way].copy()
    settings = (*_go(goals, _SMALL_M_S, _SMALL_M_S2), _columns(posts, _POST_RADIUS_M, SMALL))
    return Layout(size=SMALL, starts_ned_m=starts, settings=settings, limit_s=60.0, goals_ned_m=goals, arrive_m=0.1)


def _with(layout: Layout, event: ScenarioEvent, **changes: object) -> Layout:
    return replace(layout, events=(event,), **changes)  # type: ignore[arg-type]


def _sudden(rng: np.random.Generator, agents: int, speed_m_s: float) -> Layout:
    victim, at_s = int(rng.integers(agents)), float(rng.uniform(*_SWAP_S))
    side = int(rng.choice((-1, 1)))
    swap = _swap(rng, agents)
    assert swap.goals_ned_m is not None
    appears = Appearance(
        victim=victim,
        at_s=at_s,
        ahead_m=3.5 if speed_m_s else 2.5,
        clear_m=2.2,
        radius_m=0.5,
        keep_out_m=1.0,
        speed_m_s=speed_m_s,
        side=side,
        goals_ned_m=swap.goals_ned_m,
    )
    return _with(swap, appears)


def _sudden_static(rng: np.random.Generator, agents: int) -> Layout:
    return _sudden(rng, agents, 0.0)


def _sudden_moving(rng: np.random.Generator, agents: int) -> Layout:
    return _sudden(rng, agents, float(rng.uniform(0.5, 1.0)))


def _uncooperative(rng: np.random.Generator, agents: int) -> Layout:
    return replace(_swap(rng, agents), uncooperative=frozenset({int(rng.integers(agents))}))


def _death(rng: np.random.Generator, agents: int) -> Layout:
    victim = int(rng.integers(agents))
    return _with(_swap(rng, agents), Death(victim, float(rng.uniform(*_SWAP_S))), lost=frozenset({victim}))


def _partition(rng: np.random.Generator, agents: int) -> Layout:
    return _with(_swap(rng, agents), Partition(float(rng.uniform(*_SWAP_S)), 2.0))


SCENARIOS: dict[str, Scenario] = {
    "circle": Scenario(title="the thesis' climbing circle, one reference for all", draw=_circle, agents=(3,)),
    "swap": Scenario(
        title="every agent to the opposite side of a circle, starts 5 cm off", draw=_swap, agents=(6, 10), needs=2
    ),
    "symmetric": Scenario(title="the same from a perfect polygon", draw=_symmetric, agents=(6, 10), needs=2),
    "wide_swap": Scenario(
        title="a swap on a circle of 7 m or more, with room for what gusts need", draw=_wide_swap, agents=(6,), needs=2
    ),
    "fast_swap": Scenario(
        title="a swap of x500s at 6 m/s, on a circle of 10 m or more", draw=_fast_swap, agents=(8,), needs=2
    ),
    "random": Scenario(
        title="random transitions in 3 x 3 x 2 m, small vehicles", draw=_random, agents=(4, 10, 20), alone=True
    ),
    "permutation": Scenario(
        title="every agent to the start of another one, in 40 x 40 x 10 m", draw=_permutation, agents=(10, 100), needs=2
    ),
    "same_goal": Scenario(title="all agents to one point", draw=_same_goal, agents=(3, 6, 10)),
    "forest": Scenario(title="swap through 20 columns, small vehicles", draw=_forest, agents=(10,), needs=2),
    "maze": Scenario(title="both ways through four rows of walls, small vehicles", draw=_maze, agents=(10,)),
    "sudden_static": Scenario(
        title="an obstacle appears in the middle of a swap", draw=_sudden_static, agents=(6,), needs=2
    ),
    "sudden_moving": Scenario(title="one crosses the swap at 0.5 to 1 m/s", draw=_sudden_moving, agents=(6,), needs=2),
    "uncooperative": Scenario(title="one agent of a swap avoids nothing", draw=_uncooperative, agents=(6,), needs=2),
    "death": Scenario(title="one agent of a swap dies on the way", draw=_death, agents=(6,), needs=2),
    "partition": Scenario(title="the bus delivers nothing for 2 s of a swap", draw=_partition, agents=(6, 10), needs=2),
}


def layout_of(scenario: str, seed: int, agents: int) -> Layout:
    """Return the instance that a seed draws; it is the same for every other condition of a cell."""
    rng = np.random.default_rng([seed, agents, zlib.crc32(scenario.encode()), _LAYOUT])
    return SCENARIOS[scenario].draw(rng, agents)


def settings_of(layout: Layout, agents: int) -> Sequence[str]:
    """Return the layout as settings of a run's configuration."""
    size = layout.size
    return (
        *size.settings,
        f"swarm.agents={agents}",
        f"start.positions_ned_m={layout.starts_ned_m.tolist()}",
        f"separation.radius_m={size.radius_m}",
        f"separation.body_m={size.body_m}",
        f"separation.max_neighbours={min(max(agents - 1, 1), _NEIGHBOURS)}",
        f"mission.duration_s={layout.limit_s}",
        *layout.settings,
    )


_LAYOUT = 5  # purpose of the random stream
_NEIGHBOURS = 9
