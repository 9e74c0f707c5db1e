"""Tests of a small campaign: protections and negative control, repeated seeds, resuming after a kill, the report."""

from __future__ import annotations

import re
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import psutil
import pyarrow.parquet as pq
import pytest

from sitl.studies.campaign.command import main
from sitl.studies.campaign.conditions.scenarios import layout_of
from sitl.studies.campaign.flight import TrialFlight, drawn, fly
from sitl.studies.campaign.page import REPORT
from sitl.studies.campaign.quick import QUICK
from sitl.studies.campaign.summary import Share, summaries
from sitl.studies.campaign.trials import Cell, Row, Trial, trial_of
from swarmctl.core.types import Phase
from swarmctl.telemetry.recording.file_names import STUDY_ROWS
from tests.benches.guaranteed_trials import GUARANTEED_SWAP

ROOT = Path(__file__).parents[2]
SHOWN = "    swarmctl campaign "
TOUCH_M = {"swap": 0.48, "random": 0.15}


def rows_in(directory: Path) -> list[Row]:
    rows: list[Row] = pq.read_table(directory / STUDY_ROWS).to_pylist()
    return rows


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The campaign shown in README.md or docs/."""
    out = tmp_path_factory.mktemp("campaign")
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    (line,) = (line for page in pages for line in page.read_text().splitlines() if line.startswith(SHOWN))
    command = [sys.executable, "-m", *shlex.split(line), "--out", str(out)]
    assert subprocess.run(command, cwd=ROOT, check=False).returncode == 0
    return out


def test_agents_that_see_each_other_do_not_collide(quick: Path) -> None:
    rows = [row for row in rows_in(quick) if row["protections"] != "off"]
    assert {row["protections"] for row in rows} == {"default", "guaranteed"}
    assert {row["outcome"] for row in rows} == {"arrived"}
    assert all(row["min_separation_m"] > TOUCH_M[row["scenario"]] for row in rows)
    (alone,) = [row["unconstrained_time_s"] for row in rows if row["scenario"] == "random"]
    assert 2.0 < alone < 8.0


def test_negative_control_agents_that_see_nobody_do(quick: Path) -> None:
    rows = [row for row in rows_in(quick) if row["protections"] == "off"]
    assert rows and all(row["collided"] and not row["arrived"] for row in rows)
    assert all(row["min_separation_m"] < TOUCH_M[row["scenario"]] for row in rows)


@pytest.mark.usefixtures("configured_starts")
def test_the_same_seed_gives_the_same_row_and_another_one_does_not(quick: Path) -> None:
    flown, other = (row for row in rows_in(quick) if row["protections"] == "off")
    assert trial_of(flown).cell == trial_of(other).cell
    again = fly(trial_of(flown))
    measured = [name for name in flown if name not in ("cpu_s", "seed")]
    assert [again[name] for name in measured] == [flown[name] for name in measured]
    assert other["min_separation_m"] != flown["min_separation_m"]


def test_a_finished_campaign_flies_nothing(quick: Path) -> None:
    before = rows_in(quick)
    assert main(["--quick", "--jobs", "1", "--out", str(quick)]) == 0
    assert rows_in(quick) == before
    assert {trial_of(row) for row in before} == set(QUICK)


def test_the_report_has_every_cell_with_its_exact_interval(quick: Path) -> None:
    from scipy.stats import binomtest  # is slow to import, and every worker imports this module

    page = (quick / REPORT).read_text(encoding="utf-8")
    off = [row for row in rows_in(quick) if row["protections"] == "off"]
    hits = sum(row["collided"] for row in off)
    exact = binomtest(hits, len(off)).proportion_ci(0.95, method="exact")
    share = f"{hits}/{len(off)} {100 * hits / len(off):.1f} % [{100 * exact.low:.1f}, {100 * exact.high:.1f}]"
    assert share in page
    assert len(re.findall(r"<td>(?:default|off|guaranteed)</td>", page)) == len({trial.cell for trial in QUICK})
    assert "--scenario swap --agents 3 --delay 100 --loss 0.1" in page, "what flies a failed run again"


def test_scenario_events_happen_in_flight() -> None:
    """The bus of two agents is partitioned for 2 s: plans get stale, and both reach their goals."""
    trial = Trial(
        Cell(
            scenario="partition", agents=2, delay_ms=0.0, loss=0.0, noise="exact", wind_m_s=0.0, protections="default"
        ),
        1,
    )
    flight = TrialFlight(trial, layout_of("partition", 1, 2))
    flight.run()
    assert flight.row(None)["outcome"] == "arrived"
    for log in flight.lockstep.logs:
        ages_ms = log.ticks["plan_staleness_ms"][log.ticks["phase"] == Phase.TRACK]
        assert 1950.0 < ages_ms.max() < 2200.0
        assert ages_ms[-1] < 150.0


def test_a_disturbance_of_every_vehicle_has_a_flight_alone_to_compare_with() -> None:
    both_named = "masses"  # settings that name both vehicles
    cell = replace(GUARANTEED_SWAP, scenario="random", agents=2, protections="default", disturbance=both_named)
    row = fly(Trial(cell, 1))
    assert row["outcome"] == "arrived"
    assert 2.0 < row["unconstrained_time_s"] < 8.0


def test_two_halves_that_stay_apart_stop_and_are_not_asked_to_arrive() -> None:
    cell = replace(GUARANTEED_SWAP, agents=2, disturbance="split:0")
    flight = TrialFlight(Trial(cell, 1), replace(drawn(cell, 1), limit_s=10.0))
    flight.run()
    row = flight.row(None) | {"cpu_s": 0.0}
    assert (row["outcome"], row["arrived"], row["collided"]) == ("stopped", None, False)
    (summary,) = summaries([row])
    assert (summary.arrived, summary.collided) == (Share(0, 0), Share(0, 1))


@pytest.mark.process
def test_a_killed_campaign_resumes(tmp_path: Path) -> None:
    asked = ["--scenario", "swap", "--agents", "2", "--protections", "off", "--jobs", "2", "--out", str(tmp_path)]
    command = [sys.executable, str(ROOT / "tools" / "campaign.py"), *asked, "--trials", "50"]  # as other programs do
    campaign = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL)
    children: list[psutil.Process] = []
    try:
        deadline_s = time.monotonic() + 100.0
        while not (tmp_path / STUDY_ROWS).exists() and time.monotonic() < deadline_s:
            time.sleep(0.1)
        children = psutil.Process(campaign.pid).children(recursive=True)
    finally:
        campaign.send_signal(signal.SIGKILL)
        campaign.wait()
    _, alive = psutil.wait_procs(children, timeout=10.0)
    assert children and alive == [], "no worker outlives its campaign"
    before = rows_in(tmp_path)
    assert 1 <= len(before) < 50
    highest = max(row["seed"] for row in before)
    assert main([*asked, "--jobs", "1", "--mix", "--trials", str(highest + 1)]) == 0
    after = rows_in(tmp_path)
    assert after[: len(before)] == before, "processor times included: not flown again"
    assert sorted(row["seed"] for row in after) == list(range(1, highest + 2))
