"""`report.html` and `reproduce.json` of a reproduction."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sitl.studies.thesis.figures import (
    FIGURES,
    FLIGHTS,
    SWARMS,
    Extra,
    FlightName,
    IndexPoint,
    body_rates_rad_s,
    body_velocity_m_s,
    draw,
    index_chart,
    separation_chart,
)
from sitl.studies.thesis.page import flight_of, ratio, write_json, write_page
from sitl.studies.thesis.trace import Row, Trace
from swarmctl.core.closest_pair import closest_pair_m
from swarmctl.core.obstacle import Obstacle
from tests.benches.pages import parsed

RESULTS = {
    5,
    *range(11, 32),
    *range(34, 56),
    *range(61, 83),
    *range(85, 89),
    *range(90, 94),
}  # figures of the thesis that show a flight; the others are diagrams
OBSTACLE = Obstacle(center_ned_m=(9.5, 5.5, -2.3))
SECONDS: Mapping[FlightName, float] = {"open_loop": 10, "pid_steps": 90, "pid_slow": 125.66, "mpc_slow": 125.66}


def line_trace(name: str, flight: FlightName, seconds: float = 10.0, full: bool = False) -> Trace:
    """A noisy flight along the line of the obstacle experiment, agents beside each other."""
    agents = 3 if flight in SWARMS else 1
    t_s = np.arange(0, seconds, 0.02)
    ref = np.column_stack([2 + 1.5 * t_s, 2 + 0.7 * t_s, -2 - 0.1 * t_s])
    ref_ned_m = np.repeat(ref[:, None], agents, axis=1)
    noise = np.random.default_rng(len(name)).normal(0, 0.01, (len(t_s), agents, 3))
    beside_m = 0.9 * np.arange(agents)[None, :, None] * np.array([0.0, 1.0, 0.0])
    return Trace(
        name=name,
        path="full" if full else "plant",
        t_s=t_s,
        pos_ned_m=ref_ned_m + beside_m + noise,
        vel_ned_m_s=np.zeros_like(noise) + np.array([1.5, 0.7, -0.1]),
        euler_rad=noise,
        ref_pos_ned_m=ref_ned_m,
        euler_ref_rad=0.5 * noise,
        thrust_n=9.81 + noise[:, :, 0],
        torque_n_m=np.full_like(noise, np.nan) if full else noise,
        failed=0,
        terminal_missed=2,
        obstacles=(OBSTACLE,) if flight == "obstacle" else (),
    )


def all_traces() -> dict[str, Sequence[Trace]]:
    """Every flight three times, as long as in the thesis."""
    return {
        key: [
            line_trace(f"{key} {name}", key, SECONDS.get(key, 37.7), name == "full")
            for name in ("preset", "improved", "full")
        ]
        for key in FLIGHTS
    }


ROWS = [
    Row(
        name="slow PID, MSE x",
        published=0.0020,
        ours=0.0022,
        limit=0.0025,
        path="plant",
        unit="m2",
        decimals=4,
        preset="slow",
        differs=("controller.pid.x 1 (thesis 2)",),
    ),
    Row(
        name="fast MPC, MSE y",
        published=0.0,
        ours=6e-6,
        limit=None,
        path="plant",
        unit="m2",
        note="printed as 0.0000",
        decimals=4,
    ),
    Row(
        name="circle, index at 0.90 m",
        published=2.19,
        ours=2.38,
        limit=2.19,
        path="full",
        unit="m",
        note="R < 1 & so on",
        lower_bound=1.559,
        bound_source="sqrt(3) r",
        decimals=2,
    ),
    Row(name="wall time", published=None, ours=float("nan"), limit=600.0, path="plant", unit="s"),
]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A page of everything."""
    directory = tmp_path_factory.mktemp("reproduce")
    index = [
        IndexPoint(radius_m=0.9, ours_m=2.38, published_m=2.19),
        IndexPoint(radius_m=0.6, ours_m=1.95),
        IndexPoint(radius_m=0.9, ours_m=2.1, published_m=2.19, series="improved"),
    ]
    path = write_page(directory, ROWS, all_traces(), Extra({"circle": 0.9, "obstacle": 0.9}, index, ["a < b"]))
    assert path == directory / "report.html"
    assert path.stat().st_size < 3e6
    return path.read_text(encoding="utf-8")


def test_every_result_of_the_thesis_is_in_the_table_once() -> None:
    numbers = [figure.number for figure in FIGURES]
    assert sorted(numbers) == numbers
    assert len(numbers) == len(set(numbers))
    assert set(numbers) == RESULTS


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (13, "position z [m], one step, PID"),
        (16, "yaw psi [rad], one step, PID"),
        (21, "path in space [m], consecutive steps, PID"),
        (22, "position x [m], consecutive steps, PID"),
        (31, "torque tau_z [N m], consecutive steps, PID"),
        (40, "thrust f_t [N], slow trajectory, PID"),
        (55, "path in space [m], fast trajectory, PID"),
        (65, "pitch theta [rad], slow trajectory, MPC"),
        (81, "torque tau_z [N m], fast trajectory, MPC"),
        (88, "path in space [m], swarm, distributed MPC"),
        (91, "position y [m], swarm and obstacle, distributed MPC"),
    ],
)
def test_captions_are_those_of_the_thesis(number: int, words: str) -> None:
    (figure,) = (figure for figure in FIGURES if figure.number == number)
    assert figure.title == f"Figure {number}: {words}"


def test_page_has_every_figure_once(page: str) -> None:
    assert sorted(map(int, re.findall(r'id="figure-(\d+)"', page))) == sorted(RESULTS)
    assert sorted(map(int, re.findall(r"<figcaption>Figure (\d+): ", page))) == sorted(RESULTS)
    assert "74 of 74" in page


def test_page_needs_nothing_from_outside(page: str) -> None:
    parser = parsed(page)
    assert set(parser.tags).isdisjoint({"script", "link", "img", "iframe", "object", "image", "use"})
    names = {name for name, _ in parser.attributes}
    assert names.isdisjoint({"src", "srcset", "action", "onload", "onclick", "xlink:href"})
    targets = [value for name, value in parser.attributes if name == "href"]
    ids = [value for name, value in parser.attributes if name == "id"]
    assert targets
    assert all(value is not None and value[:1] == "#" and value[1:] in ids for value in targets)
    assert len(ids) == len(set(ids))
    assert not re.search(r"https?:|url\(|@import", page)


def test_page_judges_and_escapes(page: str) -> None:
    assert "1 of 3</b><span>limits met" in page  # the slow PID; the index and the time without a number are missed
    assert page.count('<span class="bad">missed</span>') == 2
    assert "R &lt; 1 &amp; so on" in page
    assert "a &lt; b" in page
    assert "<td class=n>1.10</td>" in page
    assert "nan" not in re.sub(r"<style>.*?</style>", "", page, flags=re.S)


def test_missing_flights_leave_their_figures_out(tmp_path: Path) -> None:
    traces = {"pid_step": [line_trace("step", "pid_step")], "circle": []}
    text = write_page(tmp_path, ROWS, traces).read_text(encoding="utf-8")
    parsed(text)
    assert sorted(map(int, re.findall(r'id="figure-(\d+)"', text))) == list(range(11, 21))
    assert "#circle" not in text
    assert "Table 19" not in text


def test_page_without_any_flight(tmp_path: Path) -> None:
    text = write_page(tmp_path, [], {}).read_text(encoding="utf-8")
    parsed(text)
    assert "0 of 74" in text


def test_an_unknown_flight_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"\['loop'\]; known are .*open_loop"):
        write_page(tmp_path, [], {"loop": []})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("flight", ["open_loop", "mpc_fast", "circle", "obstacle"])
def test_a_flight_that_never_began_is_drawn_empty(tmp_path: Path, flight: FlightName) -> None:
    """The axes of its charts are there, and no curve; one of a flight that began has some."""
    drawn = []
    for name, seconds in (("never", 0.0), ("flown", 2.0)):
        page = write_page(tmp_path, [], {flight: [line_trace(name, flight, seconds=seconds)]})
        text = page.read_text(encoding="utf-8")
        assert 'class="grid"' in text
        assert parsed(text).tags.count("svg") >= 8
        drawn.append(len(re.findall(r"<path[^>]* stroke=", text)))
    assert drawn[0] == 0
    assert drawn[1] > 0


def test_torques_the_full_mavlink_loop_does_not_have() -> None:
    (figure,) = (figure for figure in FIGURES if figure.number == 68)
    plant, full = line_trace("plant", "mpc_slow"), line_trace("full", "mpc_slow", full=True)
    alone = draw(figure, [full])
    assert "Figure 68: torque tau_x [N m], slow trajectory, MPC (not recorded)" in alone
    assert "stroke-width" not in alone
    both = draw(figure, [plant, full])
    assert both.count("stroke-width") == 1
    assert "full" not in both


def test_gaps_break_lines() -> None:
    (figure,) = (figure for figure in FIGURES if figure.number == 67)
    trace = line_trace("gap", "mpc_slow")
    thrust_n = trace.thrust_n.copy()
    thrust_n[200:300] = np.nan
    (path,) = re.findall(r'd="([^"]*)" stroke=', draw(figure, [replace(trace, thrust_n=thrust_n)]))
    assert path.count("M") == 2
    assert "nan" not in path


def test_the_reference_leads_through_the_box_of_the_obstacle() -> None:
    trace = line_trace("obstacle", "obstacle")
    for number in (90, 91):
        (figure,) = (figure for figure in FIGURES if figure.number == number)
        drawing = draw(figure, [trace], points=5000)
        (reference,) = re.findall(r'd="M([^"]*)" stroke="var\(--reference\)"', drawing)
        curve = np.array([pair.split() for pair in reference.split("L")], np.float64)
        for style in ("obstacle", "keepout"):
            box = re.search(rf'class="{style}" x="([\d.]+)" y="([\d.]+)" width="([\d.]+)" height="([\d.]+)"', drawing)
            assert box is not None
            x, y, width, height = map(float, box.groups())
            assert np.interp(x + width / 2, curve[:, 0], curve[:, 1]) == pytest.approx(y + height / 2, abs=1.0)


def test_the_obstacle_is_drawn_in_space_with_its_keep_out() -> None:
    (figure,) = (figure for figure in FIGURES if figure.number == 93)
    drawing = draw(figure, [line_trace("obstacle", "obstacle")])
    balls = dict(re.findall(r'<circle class="(\w+)" cx="[\d.]+" cy="[\d.]+" r="([\d.]+)"', drawing))
    assert float(balls["keepout"]) / float(balls["obstacle"]) == pytest.approx(1.75, abs=0.02)


def test_swarm_figures_show_the_agents_of_the_first_trace() -> None:
    (figure,) = (figure for figure in FIGURES if figure.number == 85)
    drawing = draw(figure, [line_trace("first", "circle"), line_trace("second", "circle")])
    assert re.findall(r"</i>([^<]*)<", drawing) == ["agent 0", "agent 1", "agent 2", "reference"]


def test_nearest_pair() -> None:
    pos_ned_m = np.array(
        [[[0.0, 0.0, 0.0], [3.0, 4.0, 0.0], [0.0, 0.0, -1.0]], [[0.0, 0.0, 0.0], [0.0, 2.0, 0.0], [np.nan] * 3]]
    )
    assert closest_pair_m(pos_ned_m) == pytest.approx([1.0, 2.0])
    assert np.isnan(closest_pair_m(line_trace("alone", "pid_step").pos_ned_m)).all()


def test_every_constraint_radius_is_a_limit() -> None:
    traces = [line_trace("circle 0.90", "circle"), line_trace("circle 0.60", "circle")]
    drawing = separation_chart("circle", traces, {"circle": 0.9, "circle 0.60": 0.6}, 100)
    assert "constraint radius 0.9 m" in drawing
    assert "constraint radius 0.6 m" in drawing


def test_index_points_without_a_published_value() -> None:
    drawing = index_chart(
        [
            IndexPoint(radius_m=0.9, ours_m=2.38, published_m=2.19),
            IndexPoint(radius_m=0.6, ours_m=1.95),
            IndexPoint(radius_m=0.3, ours_m=None),
        ]
    )
    assert drawing.count('r="3.5"') == 3


def test_body_rates_are_those_of_the_rotation() -> None:
    t_s = np.arange(0, 2, 0.001)
    euler_rad = np.column_stack([0.3 * np.sin(2 * t_s), 0.2 + 0.4 * t_s, np.pi - 1.0 + 1.5 * t_s])
    euler_rad[:, 2] = (euler_rad[:, 2] + np.pi) % (2 * np.pi) - np.pi  # yaw goes once over the edge
    flown = line_trace("turn", "open_loop")
    trace = replace(flown, t_s=t_s, euler_rad=euler_rad[:, None])
    to_ned = Rotation.from_euler("ZYX", euler_rad[:, ::-1])
    rates = (to_ned[:-2].inv() * to_ned[2:]).as_rotvec() / 0.002
    assert body_rates_rad_s(trace)[1:-1] == pytest.approx(rates, abs=1e-4)


def test_body_velocity_of_known_attitudes() -> None:
    """Nose to the east and flown north; 30 deg nose up and flown north; 30 deg right wing down and sinking."""
    euler_rad = np.radians([[[0.0, 0.0, 90.0]], [[0.0, 30.0, 0.0]], [[30.0, 0.0, 0.0]]])  # (T, 1, 3)
    vel_ned_m_s = np.array([[[1.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]]])
    trace = replace(line_trace("known", "open_loop"), euler_rad=euler_rad, vel_ned_m_s=vel_ned_m_s)
    expected = [[0.0, -1.0, 0.0], [0.8660254, 0.0, 0.5], [0.0, 0.5, 0.8660254]]
    np.testing.assert_allclose(body_velocity_m_s(trace), expected, atol=1e-7)


@pytest.mark.parametrize(
    ("name", "flight"),
    [
        ("slow PID, MSE x", "pid_slow"),
        ("mpc_fast mean distance", "mpc_fast"),
        ("pid steps, overshoot", "pid_steps"),
        ("PID step: settling of z", "pid_step"),
        ("circle index at 0.90 m", "circle"),
        ("obstacle, index", "obstacle"),
        ("wall time", None),
    ],
)
def test_rows_are_grouped_by_what_their_names_speak_of(name: str, flight: FlightName | None) -> None:
    assert flight_of(name) == flight


def test_ratio() -> None:
    assert ratio(Row(name="a", published=2.0, ours=3.0, limit=None, path="plant", unit="m")) == 1.5
    assert ratio(Row(name="a", published=None, ours=3.0, limit=None, path="plant", unit="m")) is None
    assert ratio(Row(name="a", published=0.0, ours=3.0, limit=None, path="plant", unit="m")) is None
    assert ratio(Row(name="a", published=2.0, ours=float("nan"), limit=None, path="plant", unit="m")) is None


def test_json_has_finite_numbers_only(tmp_path: Path) -> None:
    path = write_json(tmp_path, ROWS)
    assert [file.name for file in tmp_path.iterdir()] == ["reproduce.json"]

    def refuse(word: str) -> None:
        raise AssertionError(word)

    rows = json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)["rows"]
    contract = ["name", "published", "ours", "limit", "path", "unit", "note", "ratio", "least"]
    assert list(rows[0])[: len(contract)] == contract
    assert [row["beside"] for row in rows] == ["worse", "equal", "worse", None]
    assert [row["out_of_reach"] for row in rows] == [False, False, False, False]
    assert [row["preset"] for row in rows] == ["slow", "", "", ""]
    assert rows[0]["differs"] == ["controller.pid.x 1 (thesis 2)"]
    assert rows[0]["ratio"] == pytest.approx(1.1)
    assert [row["met"] for row in rows] == [True, None, False, False]
    assert rows[1]["ratio"] is None
    assert rows[2]["least"] == 1.559
    assert rows[2]["path"] == "full"
    assert rows[3]["ours"] is None
    assert rows[3]["note"] == "ours is not finite"
