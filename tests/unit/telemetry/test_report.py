"""Tests of what reports show: references and goals of each agent, narrow and dark screens, files, runs compared."""

from __future__ import annotations

import json
import re
import shutil
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray
from PIL import Image

from swarmctl.config import Config, dump, load_recorded
from swarmctl.configuration.sections import SwarmParams
from swarmctl.core.recorded.tick_record import CURVES
from swarmctl.core.types import ControlMode, Phase
from swarmctl.errors import ConfigError, StartError
from swarmctl.ops.flight.summary import compare
from swarmctl.ops.verbs.folders import report
from swarmctl.telemetry.evaluation.referee import Rules, evaluate
from swarmctl.telemetry.evaluation.tracks import shared_references
from swarmctl.telemetry.palette import agent_rgb, css
from swarmctl.telemetry.recording.run_files import load_run
from swarmctl.telemetry.recording.run_folder import Outcome, compare_runs, finish_run
from swarmctl.telemetry.report import svg
from swarmctl.telemetry.report.charts import Line
from swarmctl.telemetry.report.comparison import differences
from swarmctl.telemetry.report.event_table import event_rows
from swarmctl.telemetry.report.from_above import Place, top_view
from swarmctl.telemetry.report.moments import _words
from swarmctl.telemetry.report.run_charts import RunCharts
from swarmctl.telemetry.report.run_report import summary_rows
from swarmctl.telemetry.report.thinning import shape_of
from tests.benches.recorded_runs import UTC_US, flight, write_run
from tests.unit.telemetry.test_referee import run, ticks

SVG = "{http://www.w3.org/2000/svg}"


def finish(directory: Path, seconds: float = 6.0, goals: bool = False, **keys: object) -> Path:
    """Write a finished run of three agents; with `goals` each has a reference that ends at a place of its own."""
    directory.mkdir()
    write_run(directory, 3, seconds)
    if goals:
        for agent in range(3):
            own_goal(agent, seconds).tofile(directory / f"agent-{agent}.ticks")
    config = Config(**keys)  # type: ignore[arg-type]
    (directory / "config.toml").write_text(dump(config))
    finish_run(directory, config.rules(), Outcome(outcome="completed"))
    return directory


def own_goal(agent: int, seconds: float) -> NDArray[np.void]:
    rows, _ = flight(agent, 3, seconds)
    tracking = rows["phase"] == Phase.TRACK
    rows["ref_pos_ned_m"][tracking] = (3.0 * agent, -2.0, -1.0)
    rows["ref_pos_ned_m"][tracking, 1] += np.linspace(-1.0, 0.0, tracking.sum()).clip(max=-0.2)
    return rows


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return finish(tmp_path_factory.mktemp("runs") / "first", goals=True)


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return finish(tmp_path_factory.mktemp("runs") / "second", seconds=7.0, seed=5)


def figures(page: str) -> dict[str, str]:
    """Return the figures of a page by their titles."""
    parts = re.findall(r"<figure[^>]*><figcaption>(.*?)</figcaption>(.*?)</figure>", page, re.DOTALL)
    return dict(parts)


def dashed(figure: str) -> list[str]:
    return re.findall(r'<path d="[^"]+" stroke="([^"]+)" [^>]*stroke-dasharray', figure)


def test_every_agent_has_its_own_reference_and_goal(folder: Path) -> None:
    drawn = figures((folder / "report.html").read_text())
    colors = [css(agent_rgb(agent)) for agent in range(3)]
    for title in ("From above: north up, east right [m]", "x north [m]", "y east [m]", "z down [m]"):
        assert dashed(drawn[title]) == colors, title
    above = drawn["From above: north up, east right [m]"]
    assert re.findall(r">(goal[^<]*)</text>", above) == ["goal 0", "goal 1", "goal 2"]
    assert re.findall(r'<circle [^>]*r="7" fill="none" stroke="([^"]+)"', above) == colors


def test_a_reference_that_all_share_is_drawn_once_and_one_that_moves_on_is_no_goal(shared: Path) -> None:
    drawn = figures((shared / "report.html").read_text())
    for title in ("From above: north up, east right [m]", "x north [m]"):
        assert dashed(drawn[title]) == ["var(--reference)"], title
    assert "goal" not in drawn["From above: north up, east right [m]"]


def operators_flight(directory: Path) -> Path:
    """Write a run of three agents with orders: all are held, agent 1 goes to a point, all fly a second mission."""
    finish(directory, seconds=16.0)
    for agent, rows in load_run(directory).ticks.items():
        t_s = (rows["t_us"] - rows["t_us"][0]) * 1e-6  # the mission begins at 3 s
        rows["control"][(t_s >= 5) & (t_s < 6)] = ControlMode.HOLD
        rows["control"][(t_s >= 7) & (t_s < 8)] = ControlMode.GOTO if agent == 1 else ControlMode.TRACKING
        again = (t_s >= 9) & (rows["phase"] == Phase.TRACK)
        rows["mission_t_s"][again] = t_s[again] - 10.0
        rows.tofile(directory / f"agent-{agent}.ticks")
    orders: tuple[tuple[float, str, tuple[int, ...], dict[str, float]], ...] = (
        (5.0, "hold", (0, 1, 2), {}),
        (6.0, "resume", (0, 1, 2), {}),
        (7.0, "goto", (1,), {"north_m": 4.0, "east_m": 0.0, "down_m": -5.0}),
        (9.0, "mission", (0, 1, 2), {}),
        (16.0, "exclude", (0, 1), {"peer": 2.0}),
    )
    lines = []
    for at_s, verb, agents, arguments in orders:
        for agent in agents:
            t_us = 5_000_000 + round(at_s * 1e6) + 20_000 * agent
            stamp = {"t_us": t_us, "utc_us": t_us + UTC_US, "source": f"agent-{agent}", "event": "operator"}
            lines.append(json.dumps({**stamp, "verb": verb, **arguments}))
    (directory / "orders.events.jsonl").write_text("\n".join(lines) + "\n")
    (directory / "summary.json").unlink()
    finish_run(directory, Config().rules(), Outcome(outcome="completed"))
    return directory


def legend(figure: str) -> list[str]:
    return re.findall(r"<span>(?:<i .*?</i>|<svg .*?</svg>)?([^<]+)</span>", figure)


def test_orders_and_further_missions_are_marked_and_told_apart(tmp_path: Path) -> None:
    page = (operators_flight(tmp_path / "operated") / "report.html").read_text()
    assert ", 5.0 s of the second mission, 12.0 s in TRACK. Times count from the start of the first mission;" in page
    drawn = figures(page)
    did = drawn["What the agent did"]
    assert legend(did) == [
        *("AUTO", "TRACKING", "HOLD", "GOTO"),
        *("1 hold, 2.0 s", "2 resume, 3.0 s", "3 goto 4, 0, -5 (agent 1), 4.0 s"),
        *("4 mission set, 6.0 s", "5 second mission begins, 7.0 s"),
    ]
    assert re.findall(r"<title>(?:HOLD|GOTO) [^<]*</title>", did) == [
        *("<title>HOLD 2.0 to 3.0 s</title>",) * 2,
        *("<title>GOTO 4.0 to 5.0 s</title>", "<title>HOLD 2.0 to 3.0 s</title>"),
    ]
    bars = [path.count("M") for path in re.findall(r'<path class="moment" d="([^"]*)"', did)]
    assert bars == [3, 3, 1, 3, 3], "across the bars of the agents that were told"
    (upright,) = re.findall(r'<path class="upright" d="([^"]*)"', drawn["Distance to the reference [m]"])
    assert upright.count("M") == 5
    above = drawn["From above: north up, east right [m]"]
    (reference,) = re.findall(r'<path d="([^"]*)" [^>]*stroke-dasharray', above)
    assert reference.count("M") == 2, "one stretch for each mission"


def test_a_run_without_orders_has_one_mission_and_no_marks(shared: Path) -> None:
    page = (shared / "report.html").read_text()
    assert ", 3.0 s of mission time. Times count from mission start;" in page
    assert "upright" not in page.split("</style>")[1]


def test_a_run_that_an_earlier_version_recorded_shows_the_modes_of_its_agents(tmp_path: Path) -> None:
    directory = finish(tmp_path / "old")
    for agent in range(3):
        path = directory / f"agent-{agent}.parquet"
        pq.write_table(pq.read_table(path).drop_columns("control"), path)
    report([directory])
    assert legend(figures((directory / "report.html").read_text())["What the agent did"]) == ["IDLE", "TRACKING"]


def test_from_above_the_mission_is_told_from_the_way_there_and_all_signs_are_explained(tmp_path: Path) -> None:
    moving = {"center_ned_m": (2.0, 2.0, -1.0), "radius_m": 0.5, "keep_out_m": 1.5, "vel_ned_m_s": (-0.1, 0.0, 0.0)}
    directory = finish(tmp_path / "above", goals=True, obstacles=(moving,))
    above = figures((directory / "report.html").read_text())["From above: north up, east right [m]"]
    assert legend(above) == [
        *("reference", "mission", "way out and back", "agent 0", "agent 1", "agent 2"),
        *("way of an obstacle", "keep-out", "obstacle", "goal", "end"),
    ]
    drawing = above.split("<div class=legend>")[0]
    for agent in range(3):
        curves = re.findall(rf'<path d="[^"]*" stroke="{css(agent_rgb(agent))}" [^>]*>', drawing)
        assert ["opacity" in curve for curve in curves if "dasharray" not in curve] == [True, False]
    assert re.findall(r">(end \d)</text>", drawing) == ["end 0", "end 1", "end 2"]
    radii = {style: float(r) for style, r in re.findall(r'<circle class="(\w+)" [^>]*r="([\d.]+)"', drawing)}
    assert radii["keepout"] == pytest.approx(3.0 * radii["obstacle"], rel=0.02)


def test_names_of_places_keep_clear_of_each_other() -> None:
    crowd = [Place(np.array([0.1 * k, 0.0, 0.0]), f"end {k}", "#000", "dot") for k in range(3)]
    line = Line(x=np.array([-10.0, 10.0]), y=np.array([-3.0, 3.0]), color="#000")
    drawn = top_view("crowd", [line], [], places=crowd)
    at = re.findall(r'<text class="tick mark" x="([-\d.]+)" y="([-\d.]+)" [^>]*text-anchor="(\w+)"', drawn)
    assert len({(anchor, round(float(y) / 13)) for _, y, anchor in at}) == 3


def off_px(px: float, py: float, path_px: NDArray[np.float64], path_py: NDArray[np.float64]) -> float:
    """Return how far a point is from a path (K,)."""
    along_x, along_y = np.diff(path_px), np.diff(path_py)
    share = ((px - path_px[:-1]) * along_x + (py - path_py[:-1]) * along_y) / (along_x**2 + along_y**2)
    share = np.clip(share, 0.0, 1.0)
    return float(np.hypot(path_px[:-1] + share * along_x - px, path_py[:-1] + share * along_y - py).min())


def test_a_long_flight_keeps_its_shape_from_above() -> None:
    t = np.linspace(0, 18 * 2 * np.pi, 11_000)  # a figure-8, eighteen times
    px, py = 300 + 200 * np.sin(t), 200 + 100 * np.sin(2 * t)
    few_px, few_py = shape_of(px, py, 2_500)
    assert 500 < len(few_px) <= 2_500
    for k in range(0, len(t), 97):
        assert off_px(px[k], py[k], few_px, few_py) < 0.21
    fewer_px, fewer_py = shape_of(px, py, 200)
    assert len(fewer_px) <= 200
    gap = np.where(np.abs(t - 20) < 3, np.nan, px)
    assert np.isnan(shape_of(gap, py, 2_500)[0]).sum() == 1
    assert np.isnan(fewer_py).sum() == 0


def test_accepted_requests_are_one_row_and_refused_ones_are_not() -> None:
    def event(at_s: float, agent: int, name: str, **fields: object) -> dict[str, object]:
        return {"utc_us": 0, "t_us": round(at_s * 1e6), "source": f"agent-{agent}", "event": name, **fields}

    def accepted(at_s: float, agent: int, verb: str) -> dict[str, object]:
        return event(at_s, agent, "command", verb=verb, ok=True, text="result 0")

    asked = [accepted(0.1 * k, k % 2, "rate" if k < 30 else f"param_get P{k}") for k in range(40)]
    refused = event(4.0, 0, "command", verb="message", ok=False, text="result 2")
    events = [*asked, refused, accepted(5.0, 1, "arm"), event(6.0, 1, "state", phase="TAKEOFF")]
    assert [tuple(row) for row in event_rows(events, lambda event: event["t_us"] * 1e-6)] == [
        ("0.00", "agent-0, agent-1", "command", "40 accepted: rate 30, param_get 10"),
        ("4.00", "agent-0", "command", "verb=message, ok=False, text=result 2"),
        ("5.00", "agent-1", "command", "verb=arm, ok=True, text=result 0"),
        ("6.00", "agent-1", "state", "phase=TAKEOFF"),
    ]


def test_references_are_compared_at_the_same_mission_times() -> None:
    late = flight(1, 3, 6.0)[0][7:]
    late["mission_t_s"] += 0.007
    late["ref_pos_ned_m"][:, 0] += 0.01
    away = flight(2, 3, 6.0)[0]
    away["ref_pos_ned_m"][-80:, 2] -= 1.0  # parts from the others at the end only
    assert shared_references({0: flight(0, 3, 6.0)[0], 1: late, 2: away}) == {0: [0, 1], 2: [2]}


def test_goals_are_those_of_the_mission_that_an_operator_has_set_last(tmp_path: Path) -> None:
    directory = finish(tmp_path / "changed", goals=True)
    ticks = load_run(directory).ticks
    for agent, rows in ticks.items():
        tracking = np.flatnonzero(rows["phase"] == Phase.TRACK)
        again = tracking[len(tracking) // 2 :]  # all of one mission, then each another place, two of them the same
        rows["mission_t_s"][again] -= rows["mission_t_s"][again[0]]
        rows["ref_pos_ned_m"][again] = (-4.0, max(agent, 1), -1.0)
        rows.tofile(directory / f"agent-{agent}.ticks")
    report([directory])
    above = figures((directory / "report.html").read_text())["From above: north up, east right [m]"]
    assert re.findall(r">(goal[^<]*)</text>", above) == ["goal 0, 1", "goal 2"]


def test_table_and_chart_count_the_same_deadline_misses(tmp_path: Path) -> None:
    directory = finish(tmp_path / "late")
    ticks = load_run(directory).ticks
    for agent, rows in ticks.items():
        begun = np.clip(np.arange(len(rows)) // 10, 0, 3) + np.where(rows["phase"] >= Phase.TRACK, agent, 0)
        rows["deadline_misses"] = begun  # three before arming, and in flight as many as the agent's number
        rows.tofile(directory / f"agent-{agent}.ticks")
    finish_run(directory, Config().rules(), Outcome(outcome="completed"))
    page = (directory / "report.html").read_text()
    chart = RunCharts(load_run(directory), {"agents": 3}, None)
    counted = [values for _, values in chart.curve_of_agents("deadline_misses", CURVES["deadline_misses"])]
    assert [(values[0], values[-1]) for values in counted] == [(0, 0), (0, 1), (0, 2)]
    assert "Deadline misses from arming on" in figures(page)
    assert re.search(r"<td>deadline misses from arming on</td>\s*<td[^>]*>3 of \d+<", page)


def test_every_colour_of_a_page_is_known_by_day_and_in_the_dark(folder: Path) -> None:
    page = (folder / "report.html").read_text()
    light, dark = page.split("@media (prefers-color-scheme: dark)", 1)
    used = set(re.findall(r"var\((--[a-z-]+)\)", page))
    assert len(used) > 10
    for sheet in (light, dark.split("} }", 1)[0]):
        assert used - set(re.findall(r"(--[a-z-]+):", sheet)) == set()
    assert "color-scheme: light dark" in page


def test_axes_can_be_read_on_a_phone(folder: Path) -> None:
    page = (folder / "report.html").read_text()
    base_px = float(re.findall(r"\.tick \{ font: (\d+)px", page)[0])
    rules = [
        (float(w), float(px)) for w, px in re.findall(r"max-width: (\d+)px\) \{ \.tick \{ font-size: (\d+)px", page)
    ]
    for width_px in range(280, 641):  # of the figure; a drawing is scaled to it
        size_px = [base_px, *(px for most_px, px in rules if width_px <= most_px)][-1] * width_px / svg.WIDTH_PX
        assert size_px >= 10.0, width_px
    widest_px = 0.6 * max(px for _, px in rules) * len("-0.5")
    assert widest_px < svg.LEFT_PX, "the largest text has room beside the axis"


def test_every_figure_is_written_as_a_drawing_of_its_own(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report([folder], figures=True)
    assert capsys.readouterr().out.split() == [str(folder / "report.html"), str(folder / "figures")]
    titles = [title.split(" [")[0] for title in figures((folder / "report.html").read_text())]
    files = sorted((folder / "figures").glob("*.svg"))
    assert len(files) == len(titles) > 10
    for path, title in zip(files, titles, strict=True):
        drawing = ET.parse(path).getroot()
        assert drawing.tag == f"{SVG}svg"
        texts = ["".join(text.itertext()) for text in drawing.iter(f"{SVG}text")]
        assert texts[0].startswith(title)
    named = (folder / "figures" / "02-distance-to-the-reference.svg").read_text()
    assert all(f">agent {agent}</text>" in named for agent in range(3)), "the legend"
    assert "var(" not in named, "colours are written out, for programs that know no variables"
    assert re.findall(r">(-?\d+ s)</text>", named), "what is on the axis below"


def test_figures_are_drawn_as_png_where_it_is_asked_for(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copied = Path(shutil.copytree(folder, tmp_path / "copied", ignore=shutil.ignore_patterns("figures")))
    report([copied], png=True)
    drawn, files = sorted((copied / "figures").glob("*.png")), sorted((copied / "figures").glob("*.svg"))
    assert [path.stem for path in drawn] == [path.stem for path in files]
    image = np.asarray(Image.open(drawn[0]).convert("RGB"))
    assert image.shape[1] == 2 * svg.WIDTH_PX
    for color in (agent_rgb(0), agent_rgb(1), (255, 255, 255)):
        assert (image == color).all(axis=2).sum() > 100, color
    monkeypatch.setitem(sys.modules, "resvg_py", None)
    with pytest.raises(StartError, match=r"pip install '\.\[png\]'"):
        report([copied], png=True)


def test_figures_are_not_written_through_a_link(tmp_path: Path) -> None:
    folder, elsewhere = finish(tmp_path / "run"), tmp_path / "elsewhere"
    elsewhere.mkdir()
    (folder / "figures").symlink_to(elsewhere)
    with pytest.raises(ConfigError, match="is a symbolic link"):
        report([folder], figures=True)
    assert list(elsewhere.iterdir()) == []


def test_runs_are_set_beside_each_other(folder: Path, shared: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report([folder, shared])
    path = shared.parent / "first-against-second.html"
    assert capsys.readouterr().out.strip() == str(path)
    page = path.read_text()
    assert re.search(r"<td>seed</td><td>1</td><td>5</td>", page)
    drawn = figures(page)
    for title in ("Distances to the reference, summed over agents [m]", "Smallest distance between two agents [m]"):
        assert [css(agent_rgb(k)) in drawn[title] for k in range(2)] == [True, True]
    assert page.count("From above: north up, east right [m]") == 2
    (cells,) = re.findall(r"<td>summed mean tracking error[^<]*</td>(.*?)</tr>", page)
    first, second, change = re.findall(r"<td class=n>(.*?)</td>", cells)
    expected = float(second.split()[0]) / float(first.split()[0]) - 1.0
    assert float(change.rstrip("%")) / 100 == pytest.approx(expected, abs=0.002)


def test_only_what_differs_in_the_configuration_is_listed() -> None:
    texts = ["a = 1\n[b]\nc = [1, 2]\nd = 'x'\n", "a = 1\n[b]\nc = [1, 3]\nd = 'x'\ne = true\n"]
    assert list(differences(texts)) == [("b.c", ["[1, 2]", "[1, 3]"]), ("b.e", ["", "True"])]


def test_of_long_values_that_part_is_listed_in_which_they_differ() -> None:
    rows = [f"rows = {[[float(t), 0.0] for t in range(1000)] + [[float(end), 1.0]]}\n" for end in (1, 2)]
    ((key, (first, second)),) = differences(rows)
    assert key == "rows"
    assert "[1.0, 1.0]" in first and "[2.0, 1.0]" in second
    assert first.startswith("... ") and max(len(first), len(second)) < 130
    ((_, (many, none, absent)),) = differences([rows[0], "rows = []\n", ""])
    assert many.startswith("[[0.0, 0.0], [1.0") and many.endswith(" ...") and (none, absent) == ("[]", "")
    ((_, (alone, _)),) = differences([rows[0], ""])
    assert alone.startswith("[[0.0, 0.0], [1.0")


def test_what_can_not_be_compared_is_refused(folder: Path, tmp_path: Path) -> None:
    cut_off = tmp_path / "cut"
    cut_off.mkdir()
    write_run(cut_off, 3, 4.0)
    (cut_off / "config.toml").write_text(dump(load_recorded(folder)))
    assert load_run(cut_off).ticks
    with pytest.raises(ConfigError, match=rf"Complete the run: swarmctl report {cut_off}"):
        report([folder, cut_off])
    with pytest.raises(ConfigError, match="one run folder"):
        report([folder, folder], figures=True)
    with pytest.raises(ConfigError, match="several folders"):
        report([folder], output=tmp_path / "page.html")


def test_verdict_and_report_count_from_the_same_instant_and_name_it() -> None:
    """Where no mission began: the verdict counted from the first arming, the report from the first tick."""
    rows = ticks(10, (0.0, 0.0, 0.0))
    rows["phase"], rows["mission_t_s"] = Phase.TAKEOFF, np.nan
    rows["armed"][:150] = 0  # 3 s
    rows["q_nb"][400:] = (0.0, 1.0, 0.0, 0.0)
    data, rules = run({0: rows}), Rules(agents=1, required_separation_m=0.5)
    summary = evaluate(data, rules, "failed")
    assert summary["time_zero"] == "the first arming"
    assert summary["violations"] == ["agent 0 turned over at 5.0 s"]
    charts = RunCharts(data, summary, rules)
    assert charts.time_zero == summary["time_zero"]
    assert charts.time_of({"utc_us": int(rows["utc_us"][400])}) == pytest.approx(5.0)
    rows["armed"] = 0
    assert evaluate(data, rules, "failed")["time_zero"] == "the first tick"
    assert evaluate(run({0: ticks(10, (0.0, 0.0, 0.0))}), rules, "failed")["time_zero"] == "mission start"


def test_runs_of_one_name_are_told_apart_by_their_parents(tmp_path: Path) -> None:
    runs = [tmp_path / parent / "flight" for parent in ("before", "after")]
    for folder in runs:
        folder.mkdir(parents=True)
        write_run(folder, 1, 3.0)
        (folder / "config.toml").write_text(dump(Config()))
        finish_run(folder, Rules(agents=1, required_separation_m=0.5), Outcome(outcome="completed"))
    rules = Rules(agents=1, required_separation_m=0.5)
    page = compare_runs(tmp_path / "page.html", [(folder, rules) for folder in runs]).read_text()
    assert page.count("before/flight") > 0
    assert page.count("after/flight") > 0


def test_many_runs_are_compared_on_a_page_whose_name_file_systems_take(tmp_path: Path) -> None:
    folders = [tmp_path / f"20261129T01450{k}Z-circle-with-a-name" for k in range(9)]
    for folder in folders:
        folder.mkdir()
        write_run(folder, 1, 3.0)
        (folder / "config.toml").write_text(dump(Config(swarm=SwarmParams(agents=1))))
        finish_run(folder, Rules(agents=1, required_separation_m=0.5), Outcome(outcome="completed"))
    path = compare(folders, None)
    assert path.name == f"{folders[0].name}-against-7-and-{folders[-1].name}.html"
    assert path.exists()
    assert compare(folders[:2], None).name == f"{folders[0].name}-against-{folders[1].name}.html"


@pytest.mark.parametrize(("limit_01", "shown"), [(0.2, "20%"), (0.004, "0.4%"), (0.0, "0%"), (1.0, "100%")])
def test_a_small_limit_of_deadline_misses_is_shown_as_it_is(limit_01: float, shown: str) -> None:
    rules = Rules(agents=1, required_separation_m=0.5, deadline_misses_01=limit_01)
    summary = evaluate(run({0: ticks(2, (0.0, 0.0, 0.0))}), rules, "completed")
    (row,) = [row for row in summary_rows(summary, rules) if row.name.startswith("deadline misses")]
    assert row.limit == shown


@pytest.mark.parametrize("north", ["x", None, [1], float("nan")])
def test_an_order_that_was_recorded_wrongly_is_shown_all_the_same(north: object) -> None:
    assert _words({"verb": "goto", "north_m": north, "east_m": 1.0, "down_m": -2.0}).startswith("goto ")
