"""Tests of what the view shows: references and goals, margins to bounds, the table, colours."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from swarmctl.core.obstacle import Obstacle
from swarmctl.core.recorded.records import PLAN_DTYPE, TICK_DTYPE, TRUTH_DTYPE
from swarmctl.core.types import Mode, Phase, PlanStatus
from swarmctl.telemetry.evaluation.referee import RunData
from swarmctl.telemetry.palette import LIMIT_RGB, REFERENCE_RGB, agent_rgb
from swarmctl.telemetry.scene.curves import left_percent
from swarmctl.telemetry.scene.references import References
from swarmctl.telemetry.scene.states import status_table
from swarmctl.telemetry.scene.stream import Stream
from swarmctl.telemetry.scene.viewed_flight import AgentBounds, ViewedFlight
from swarmctl.telemetry.view.recordings import simulated_recording

SECONDS = 3.0
GOALS = ((9.0, 0.0, -2.0), None, (0.0, 8.0, -2.0))
COLUMN = Obstacle(center_ned_m=(0.0, 10.0, 0.0), column=True, keep_out_m=2.0, vel_ned_m_s=(0.0, -1.0, 0.0))


def flown(agent: int) -> NDArray[np.void]:
    """Agents 0 and 1 share a reference that moves north at 1 m/s, agent 2 has one that moves east."""
    rows = np.zeros(round(50 * SECONDS), TICK_DTYPE)
    t_s = 0.02 * np.arange(len(rows))
    rows["t_us"] = np.round(t_s * 1e6)
    rows["utc_us"] = rows["t_us"] + 1_780_000_000_000_000
    rows["seq"], rows["mission_t_s"] = np.arange(len(rows)), t_s
    rows["phase"], rows["mode"] = Phase.TRACK, Mode.TRACKING
    rows["ref_pos_ned_m"][:, 0 if agent < 2 else 1] = t_s
    rows["pos_ned_m"] = rows["ref_pos_ned_m"]
    rows["pos_ned_m"][:, 2] = -1.0 * agent
    rows["q_nb"][:, 0] = rows["setpoint_q_nb"][:, 0] = 1.0
    rows["nearest_peer_m"], rows["battery_01"], rows["tick_ms"] = 1.25, 0.625, 5.0
    rows["phase"][-25:] = Phase.GOTO_LAND
    rows["disturbance_ned_m_s2"][:, 1] = 0.8 if agent == 1 else 0.05
    return rows


def points_of(plans: int) -> NDArray[np.void]:
    points = np.zeros(2 * plans, PLAN_DTYPE)
    points["t_us"] = np.repeat(100_000 * np.arange(plans), 2)
    points["pos_ned_m"][1::2, 0] = 1.0
    return points


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[dict[str, Any]]]:
    """Rows of a recording by entity, each with its components and `t_s`, NaN where it is static."""
    from rerun.chunk import RrdReader

    flight = ViewedFlight(agents=tuple(AgentBounds(goal_ned_m=goal) for goal in GOALS), obstacles=(COLUMN,))
    run = RunData({agent: flown(agent) for agent in range(3)}, np.zeros(0, TRUTH_DTYPE), [])
    path = simulated_recording(tmp_path_factory.mktemp("run"), run, flight, {0: points_of(20)})
    rows: dict[str, list[dict[str, Any]]] = {}
    for chunk in RrdReader(str(path)).stream():
        batch: Any = chunk.to_record_batch()
        times = [math.nan] * batch.num_rows
        if not chunk.is_static:
            times = [t.total_seconds() for t in batch.column("flight_time").to_pylist()]
        for k, t_s in enumerate(times):
            row = {name.split(":")[-1]: batch.column(name)[k].as_py() for name in batch.schema.names}
            rows.setdefault(str(chunk.entity_path), []).append(row | {"t_s": t_s})
    for entity in rows.values():
        entity.sort(key=lambda row: row["t_s"])
    return rows


def drawn(found: dict[str, list[dict[str, Any]]], entity: str, component: str) -> list[tuple[float, Any]]:
    return [(row["t_s"], row[component]) for row in found[entity] if row.get(component) is not None]


def moving(found: dict[str, list[dict[str, Any]]], entity: str, component: str) -> list[tuple[float, Any]]:
    return [(t_s, value) for t_s, value in drawn(found, entity, component) if not math.isnan(t_s)]


def test_a_reference_is_drawn_once_for_those_who_share_it_and_goes_with_the_mission(
    found: dict[str, list[dict[str, Any]]],
) -> None:
    assert not moving(found, "/world/reference/1", "positions"), "agent 0 has the same"
    for agent, axis in ((0, 0), (2, 1)):
        *shown, last = moving(found, f"/world/reference/{agent}", "positions")
        assert len(shown) > 20
        assert all(abs(points[0][axis] - t_s) < 1e-6 for t_s, points in shown)
        assert last[1] == [], "after the mission there is none"


def test_goals_are_named_by_their_agents(found: dict[str, list[dict[str, Any]]]) -> None:
    shown = {agent: drawn(found, f"/world/goal/{agent}/name", "labels")[0][1] for agent in (0, 2)}
    assert shown == {0: ["goal 0"], 2: ["goal 2"]}
    assert "/world/goal/1" not in found
    assert drawn(found, "/world/goal/2", "positions")[0][1] == [list(GOALS[2] or ())]


def test_every_vehicle_has_its_number_and_north_a_name(found: dict[str, list[dict[str, Any]]]) -> None:
    numbers = [drawn(found, f"/world/agent/{agent}/number", "labels")[0][1] for agent in range(3)]
    assert numbers == [["0"], ["1"], ["2"]]
    (_, vectors), (_, labels) = (drawn(found, "/world/compass", name)[0] for name in ("vectors", "labels"))
    assert vectors == [[0.5, 0.0, 0.0], [0.0, 0.5, 0.0]], "the scene is 3 m long"
    assert labels == ["N", "E, 0.5 m"]


def test_margins_are_distances_beyond_those_that_are_kept(found: dict[str, list[dict[str, Any]]]) -> None:
    margins = moving(found, "/plot/margin/2", "scalars")
    assert len(margins) == 30
    for t_s, (peers_m, obstacles_m) in margins:
        assert peers_m == pytest.approx(1.25 - 0.9)
        assert obstacles_m == pytest.approx((10.0 - t_s) - t_s - 2.0, abs=1e-6), "a column that comes closer"


def test_what_pushes_a_vehicle_is_an_arrow_from_its_place(found: dict[str, list[dict[str, Any]]]) -> None:
    pushed = [vectors for _, vectors in moving(found, "/world/place/1/wind", "vectors")]
    assert len(pushed) >= 3
    assert all(np.allclose(vectors, [[0.0, 0.8, 0.0]]) for vectors in pushed)
    assert not any(vectors for _, vectors in moving(found, "/world/place/0/wind", "vectors")), "next to nothing"


def test_columns_do_not_run_to_infinity(found: dict[str, list[dict[str, Any]]]) -> None:
    lengths = moving(found, "/world/columns/body", "lengths")
    assert max(length for _, values in lengths for length in values) < 10.0
    assert all(values == [] for _, values in moving(found, "/world/obstacles/body", "half_sizes"))


def test_trails_have_no_gaps_and_predicted_paths_are_drawn_when_they_were_flown(
    found: dict[str, list[dict[str, Any]]],
) -> None:
    for trail in ("trail", "reference_trail"):
        drawn_at = moving(found, f"/world/{trail}/0", "strips")
        assert len(drawn_at) > 20
        assert all(abs(strips[0][-1][0] - t_s) < 1e-6 for t_s, strips in drawn_at), "each ends where the vehicle is"
        assert all(np.allclose(a[1][0][-1], b[1][0][0]) for a, b in itertools.pairwise(drawn_at))
    lines = [strips[0] for _, strips in moving(found, "/world/trail/0", "strips")]
    assert (lines[0][0][0], lines[-1][-1][0]) == pytest.approx((0.0, SECONDS - 0.02))
    assert [t_s for t_s, _ in moving(found, "/world/plan/0", "strips")] == pytest.approx(0.1 * np.arange(20))


def test_the_table_tells_staleness_battery_and_plan() -> None:
    rows = np.zeros(2, TICK_DTYPE)
    rows["phase"], rows["mode"], rows["plan_status"] = Phase.TRACK, Mode.REPLAY, PlanStatus.SOLVER_FAILED
    rows["battery_01"], rows["plan_staleness_ms"], rows["nearest_peer_m"] = (0.42, np.nan), 240.0, np.inf
    rows["pos_ned_m"], rows["vel_ned_m_s"], rows["deadline_misses"] = (0.0, 0.0, -3.0), (3.0, 4.0, 0.0), 7
    text = status_table({0: rows[0], 11: rows[1]}).text.as_arrow_array().to_pylist()[0]
    first, second = text.splitlines()[2:]
    assert first == "| **0** | TRACK | REPLAY | SOLVER_FAILED | 3.0 | 5.0 | 42 % | - | 240 | 7 |"
    assert second.startswith("| **11** | ")
    assert " | - | - | 240 | " in second, "a battery that nobody reports"


@pytest.mark.parametrize(
    ("tilt_rad", "thrust_01", "left"), [(0.3, 0.525, (50, 100)), (0.6, 1.0, (0, 0)), (0.0, 0.05, (100, 0))]
)
def test_what_is_left_of_tilt_and_thrust_is_nothing_at_the_bound(
    tilt_rad: float, thrust_01: float, left: tuple[float, float]
) -> None:
    rows = np.zeros(1, TICK_DTYPE)
    half = tilt_rad / 2
    rows["setpoint_q_nb"] = np.array([math.cos(half), math.sin(half), 0.0, 0.0])
    rows["setpoint_thrust_01"], rows["tick_ms"] = thrust_01, 5.0
    assert left_percent(rows, AgentBounds(), 20.0)[0] == pytest.approx([*left, 75.0], abs=1e-3)


def test_twenty_agents_have_colours_that_can_be_told_apart_on_white_and_on_dark() -> None:
    colors = [agent_rgb(agent) for agent in range(20)]
    shades = [oklab(rgb) for rgb in colors]
    assert min(math.dist(a, b) for a, b in itertools.combinations(shades, 2)) > 0.11
    assert min(math.dist(shade, oklab(rgb)) for shade in shades for rgb in (LIMIT_RGB, REFERENCE_RGB)) > 0.1
    assert all(contrast(rgb, (255, 255, 255)) > 1.9 and contrast(rgb, (17, 21, 29)) > 4.0 for rgb in colors)


def oklab(rgb: tuple[int, int, int]) -> list[float]:
    """Return Ottosson's OKLab, in which equal distances look about equally different."""
    to_cones = [[0.4122214708, 0.5363325363, 0.0514459929], [0.2119034982, 0.6806995451, 0.1073969566]]
    to_cones.append([0.0883024619, 0.2817188376, 0.6299787005])
    to_lab = [[0.2104542553, 0.7936177850, -0.0040720468], [1.9779984951, -2.4285922050, 0.4505937099]]
    to_lab.append([0.0259040371, 0.7827717662, -0.8086757660])
    lab: list[float] = (np.array(to_lab) @ np.cbrt(np.array(to_cones) @ linear(rgb))).tolist()
    return lab


def linear(rgb: tuple[int, int, int]) -> NDArray[np.float64]:
    share = np.array(rgb) / 255
    return np.asarray(np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4), np.float64)


def contrast(rgb: tuple[int, int, int], other: tuple[int, int, int]) -> float:
    """Return the contrast ratio of the Web Content Accessibility Guidelines."""
    low, high = sorted(float(linear(color) @ [0.2126, 0.7152, 0.0722]) for color in (rgb, other))
    return (high + 0.05) / (low + 0.05)


class Goals(Stream):
    """A stream that keeps what is drawn of goals, by its path."""

    def __init__(self) -> None:
        self.shown: dict[str, list[list[float]]] = {}

    def static(self, path: str, archetype: Any) -> None:
        if path.startswith("world/goal") and not path.endswith("name"):
            self.shown[path] = archetype.positions.as_arrow_array().to_pylist()

    def now(self, path: str, t_us: int, archetype: Any) -> None:
        """Nothing else is kept."""

    def columns(self, path: str, t_us: Any, columns: Any) -> None:
        """Nothing else is kept."""

    def strips(self, path: str, t_us: Any, strips: Any) -> None:
        """Nothing else is kept."""


def test_a_goal_goes_with_its_mission_and_another_is_where_the_new_reference_rests() -> None:
    first, other = [1.0, 0.0, -2.0], [4.0, 4.0, -2.0]
    stream, flight = Goals(), ViewedFlight(agents=(AgentBounds(goal_ned_m=(1.0, 0.0, -2.0)),) * 2)
    references = References(stream, flight)
    references.begin()
    assert stream.shown == {"world/goal/0": [first]}, "of both"
    rows = flown(0)
    rows = rows[rows["phase"] == Phase.TRACK][:40]
    references.take(0, rows["t_us"].astype(np.int64), rows)
    again = rows.copy()
    again["mission_t_s"] -= again["mission_t_s"][0] + 0.5
    rows["mission_t_s"] += 10.0
    references.take(0, rows["t_us"].astype(np.int64), rows)
    assert stream.shown == {"world/goal/0": [first]}, "while it flies the mission of its configuration"
    references.take(0, again["t_us"].astype(np.int64), again)
    assert stream.shown == {"world/goal/0": [], "world/goal/1": [first]}, "the other agent still has it"
    again["mission_t_s"] += 1.0
    again["ref_pos_ned_m"] = other
    references.take(0, again["t_us"].astype(np.int64), again)
    assert stream.shown == {"world/goal/0": [other], "world/goal/1": [first]}
