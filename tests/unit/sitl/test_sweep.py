"""A sweep without its flights: combinations, refusals, resuming, sums over seeds, table and page."""

from __future__ import annotations

from pathlib import Path

import pyarrow.parquet as pq
import pytest

from sitl.studies.sweep.command import main
from sitl.studies.sweep.figures import FIGURES, Row, combinations
from sitl.studies.sweep.flight import FlySweep
from sitl.studies.sweep.points import Axis, Flight, flights_of, parse_axes, problems_of
from swarmctl.config import load
from swarmctl.errors import ConfigError

RADIUS = "--set=separation.radius_m=0.9,0.95"
KIND = "--set=mission.kind=hover,circle"


@pytest.fixture
def flown(monkeypatch: pytest.MonkeyPatch) -> list[Flight]:
    """The flights asked for, each with made-up figures instead of a flight; heavy ones of seed 3 fail."""
    asked: list[Flight] = []

    def fly(self: FlySweep, flight: Flight) -> Row:
        asked.append(flight)
        swept = {axis.key: axis.stored(text) for axis, (_, text) in zip(self.axes, flight.settings, strict=True)}
        figures = {figure.name: float(len(asked)) for figure in FIGURES} | {"min_clearance_m": None}
        outcome = "failed" if flight.seed == 3 else "completed"
        return {**swept, "seed": flight.seed, "outcome": outcome, **figures, "cpu_s": 0.0, "code": self.code}

    monkeypatch.setattr(FlySweep, "__call__", fly)
    return asked


def run(out: Path, *arguments: str) -> int:
    return main([*arguments, "--jobs", "1", "--out", str(out)])


def rows_in(out: Path) -> list[Row]:
    rows: list[Row] = pq.read_table(out / "rows.parquet").to_pylist()
    return rows


def test_values_are_split_outside_of_brackets_and_quotes() -> None:
    axes = parse_axes(["a.b=1,2.5,2.5", "c=x,y", "d=[0,0,-1],[0, 0, -2]", 'e="p,q",{k=1,l=2}', "f=true,false"])
    assert [axis.values for axis in axes] == [
        ("1", "2.5"),
        ("x", "y"),
        ("[0,0,-1]", "[0, 0, -2]"),
        ('"p,q"', "{k=1,l=2}"),
        ("true", "false"),
    ]
    assert [axis.is_number for axis in axes] == [True, False, False, False, False]
    assert axes[0].stored("1") == 1.0
    flights = flights_of(axes[:2], 7, 2)
    assert len(flights) == 8 == len(set(flights))
    assert str(flights[0]) == "--set a.b=1 --set c=x --seed 7"


@pytest.mark.parametrize(
    ("items", "words"),
    [
        ([], "nothing is swept"),
        (["separation.radius_m"], "write it as"),
        (["a=1,,2"], "write it as"),
        (["a=1", "a=2"], "given twice"),
        (["seed=1,2"], "--seeds"),
    ],
)
def test_what_is_no_sweep_is_refused(items: list[str], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        parse_axes(items)


def test_every_impossible_combination_is_named_before_anything_flies(
    flown: list[Flight], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(tmp_path / "out", "--set=separation.radius_m=0.9,-1,200", "--set=mission.knd=hover", "--seeds=2") == 2
    said = capsys.readouterr().err
    assert "separation.radius_m = -1" in said
    assert "separation.radius_m = 200" in said
    assert said.count("mission.knd") >= 1
    assert flown == [] and not (tmp_path / "out").exists()
    with pytest.raises(ConfigError, match="allowed: 100000"):
        flights_of([Axis("a", tuple(map(str, range(1000))))], 1, 1000)
    assert list(problems_of(flights_of([Axis("seed", ("1",))], 1, 1), None)) == []


def test_duration_and_first_seed_are_options_as_of_simulate(
    flown: list[Flight], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(tmp_path / "out", KIND, "--duration", "12", "--seed", "7", "--seeds", "2") == 0
    assert {flight.seed for flight in flown} == {7, 8}
    base = load(tmp_path / "out" / "config.toml")
    assert (base.mission.duration_s, base.seed) == (12.0, 1), "other seeds go on in the same folder"
    assert run(tmp_path / "out", KIND, "--duration", "12", "--seed", "9") == 0
    assert {row["seed"] for row in rows_in(tmp_path / "out")} == {7, 8, 9}
    assert run(tmp_path / "bad", KIND, "--duration", "-1") == 2
    assert "mission.duration_s = -1" in capsys.readouterr().err
    assert run(tmp_path / "bad", "--set=mission.duration_s=1,2", "--duration", "3") == 2
    assert "the same in every flight by another option" in capsys.readouterr().err
    for wrong in ("-1", "x", "2147483648"):
        with pytest.raises(SystemExit):
            run(tmp_path / "bad", KIND, f"--seed={wrong}")


def test_a_sweep_goes_on_where_it_stopped_and_can_grow(flown: list[Flight], tmp_path: Path) -> None:
    assert run(tmp_path, RADIUS, KIND) == 0
    assert len(flown) == 4
    before = rows_in(tmp_path)
    assert run(tmp_path, RADIUS, KIND) == 0
    assert len(flown) == 4, "nothing is flown twice"
    assert run(tmp_path, f"{RADIUS},0.98", KIND, "--seeds=2") == 0
    assert len(flown) == 12
    assert rows_in(tmp_path)[:4] == before
    assert {row["seed"] for row in rows_in(tmp_path)} == {1, 2}
    assert "--set separation.radius_m=0.98" in {str(flight).partition(" --set mission")[0] for flight in flown}


def test_another_configuration_other_keys_or_other_code_are_refused(
    flown: list[Flight], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(tmp_path, RADIUS) == 0
    other = tmp_path / "other.toml"
    other.write_text("[mission]\nduration_s = 5.0\n")
    assert run(tmp_path, str(other), RADIUS) == 2
    assert "mission.duration_s was 37.7 and is 5.0" in capsys.readouterr().err
    assert run(tmp_path, KIND) == 2
    assert "other columns" in capsys.readouterr().err
    monkeypatch.setattr("sitl.studies.campaign.source.code_id", lambda: "another")
    assert run(tmp_path, RADIUS) == 2
    said = capsys.readouterr().err
    assert "flown by other sources" in said and "give a new --out" in said
    assert "--mix" not in said, "a sweep has no such option"
    assert len(flown) == 2


OWN = """
from swarmctl.control.controllers.own import FeedbackController

class Own(FeedbackController):
    def accel_ned_m_s2(self, pos, vel, wanted_pos, wanted_vel, wanted_accel):
        return {gain} * (wanted_pos - pos)
"""


def test_an_own_controller_that_has_changed_is_other_code_and_is_found_from_the_folder(
    flown: list[Flight], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its rows were taken for those of the new one: "4 of them there already"."""
    base, out, kinds = tmp_path / "base.toml", tmp_path / "out", "--set=controller.kind=dmpc,swept_own:Own"
    base.write_text("[mission]\nkind = 'hover'\n")
    (tmp_path / "swept_own.py").write_text(OWN.format(gain=1.0))
    assert run(out, str(base), kinds) == run(out, str(base), kinds) == 0
    assert len(flown) == 2
    assert flown[1].config(out / "config.toml").own_folder == str(tmp_path)
    (tmp_path / "swept_own.py").write_text(OWN.format(gain=12.5))
    assert run(out, str(base), kinds) == 2
    assert "flown by other sources" in capsys.readouterr().err


def test_rows_of_a_combination_are_summed_up_over_seeds() -> None:
    axes = [Axis("mission.kind", ("hover", "circle"))]
    figures = dict.fromkeys((figure.name for figure in FIGURES), 1.0)
    rows: list[Row] = [
        {"mission.kind": "circle", "seed": seed, "outcome": outcome, **figures, "rmse_m": rmse_m, "min_separation_m": m}
        for seed, outcome, rmse_m, m in ((1, "completed", 0.1, 0.9), (2, "failed", 0.3, 0.7), (3, "failed", None, None))
    ]
    (one,) = combinations(axes, rows)
    assert (one.values, one.flights, one.completed) == (("circle",), 3, 1)
    assert one.figures["rmse_m"] == pytest.approx(0.2)
    assert one.figures["min_separation_m"] == 0.7
    assert one.figures["violations"] == 3


def test_the_table_has_units_and_the_page_every_combination(
    flown: list[Flight], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(tmp_path, RADIUS, KIND, "--set=swarm.agents=3", "--seeds=3") == 4, "a flight has failed"
    table = capsys.readouterr().out
    assert "radius_m" in table and table.count("2/3") == 4
    index = "index_m: summed mean tracking error [m], distances of all agents to their reference, added up"
    assert index in table and "violations: violations found" in table
    schema = pq.read_schema(tmp_path / "rows.parquet")
    assert schema.field("index_m").metadata[b"unit"] == b"m"
    page = (tmp_path / "report.html").read_text()
    assert f"<li>{index}" in page
    assert page.count("<figure>") == len(FIGURES) - 1, "nothing is drawn of what nobody measured"
    assert "mission.kind = hover" in page and "mission.kind = circle" in page, "a line for each value of the other key"
    assert page.count("<tr><td>") == 4
    assert "swarm.agents = 3" not in page, "a key with one value distinguishes no line"


def test_a_flight_that_cannot_be_flown_is_told_and_flown_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(self: FlySweep, flight: Flight) -> Row:
        raise RuntimeError("no such luck")

    monkeypatch.setattr(FlySweep, "__call__", broken)
    assert run(tmp_path, RADIUS) == 4
    assert "--set separation.radius_m=0.9 --seed 1: RuntimeError: no such luck" in capsys.readouterr().err
    assert run(tmp_path, RADIUS) == 4
    assert "0 of them there already" in capsys.readouterr().out


def test_a_folder_that_can_not_be_made_is_3_in_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert main(["--set", "sitl.mass_scale=1", "--out", str(tmp_path / "file" / "out")]) == 3
    said = capsys.readouterr().err
    assert said == f"{tmp_path}/file/out: can't be written: Not a directory. Choose another with --out\n"


def test_a_flight_that_an_error_ends_counts_and_is_flown_again(
    flown: list[Flight], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    flies = FlySweep.__call__

    def breaks(self: FlySweep, flight: Flight) -> Row:
        if flight.seed == 2:
            raise RuntimeError("diverged")
        return flies(self, flight)

    monkeypatch.setattr(FlySweep, "__call__", breaks)
    assert run(tmp_path, RADIUS, "--seeds=2") == 4
    assert [row["outcome"] for row in rows_in(tmp_path)].count("not flown: RuntimeError: diverged") == 2
    assert capsys.readouterr().out.count(" 1/2 ") == 2
    monkeypatch.setattr(FlySweep, "__call__", flies)
    assert run(tmp_path, RADIUS, "--seeds=2") == 0
    assert [row["outcome"] for row in rows_in(tmp_path)] == ["completed"] * 4


def test_rates_that_do_not_fly_in_lockstep_are_refused_before_anything_flies() -> None:
    flights = flights_of(parse_axes(["agent.rate_hz=25,30,50"]), 1, 1)
    (problem,) = problems_of(flights, None)
    assert problem.startswith("--set agent.rate_hz=30 --seed 1: sitl.physics_hz = 250: in lockstep a multiple of")
