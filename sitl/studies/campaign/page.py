"""`report.html` of a campaign: one line per cell, exact intervals drawn to scale, and every run that did not arrive."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from pathlib import Path

from markupsafe import Markup

from sitl.studies.campaign.conditions.disturbances import NONE
from sitl.studies.campaign.conditions.scenarios import SCENARIOS
from sitl.studies.campaign.summary import CellSummary, Share, summaries
from sitl.studies.campaign.trials import Row, trial_of
from swarmctl.files import replace_text
from swarmctl.telemetry.report.pages import render
from swarmctl.telemetry.report.svg import element

REPORT = "report.html"
_MAX_LISTED = 300
_BAR_PX = 90
_Column = tuple[str, Callable[[CellSummary], str]]


def write_page(directory: Path, rows: Sequence[Row], runs_per_hour: float | None = None) -> Path:
    """Write the report of all rows into the campaign's folder and return its path.

    Args:
        directory: of the campaign.
        rows: every finished run.
        runs_per_hour: of the last call, on all its processes.
    """
    path = directory / REPORT
    page = render(
        __package__,
        "campaign.html",
        name=directory.resolve().name,
        rows=rows,
        runs_per_hour=runs_per_hour,
        cells=summaries(rows),
        scenarios=SCENARIOS,
        columns=_columns,
        failed=sorted((row for row in rows if row["arrived"] is False), key=trial_of),
        most_listed=_MAX_LISTED,
        again=again,
    )
    replace_text(path, page)
    return path


def _columns(cells: Sequence[CellSummary]) -> list[_Column]:
    """Return the columns that say something about any of the cells."""
    return [(name, text) for name, text in _COLUMNS if name in _ALWAYS or any(map(text, cells))]


def share_text(share: Share) -> str:
    """Return a share as `3/100 3.0 % [0.6, 8.5]`."""
    low, high = share.interval
    return f"{share.hits}/{share.trials} {share.share:.1%} [{100 * low:.1f}, {100 * high:.1f}]".replace("%", " %")


def _share(share: Share, good_is_all: bool) -> Markup:
    good = share.trials > 0 and share.hits == (share.trials if good_is_all else 0)
    low, high = (_BAR_PX * bound for bound in share.interval)
    bar = element(
        "svg",
        element("rect", class_="track", y=4, width=_BAR_PX, height=2),
        element("rect", class_="range", x=low, y=2, width=max(high - low, 1.0), height=6),
        element("rect", class_="hit", x=_BAR_PX * share.share - 1.0, width=2, height=10),
        class_="share",
        viewBox=f"0 0 {_BAR_PX} 10",
    )
    return bar + element("span", share_text(share), class_="ok" if good else "bad")


def _number(value: float | None, unit: str = "", digits: int = 2) -> str:
    return "" if value is None else f"{value:.{digits}f}{unit}"


def again(row: Row) -> str:
    """Return the command that flies a row again."""
    sets = "".join(f" --set {shlex.quote(item)}" for item in row["sets"].split())
    return (
        f"swarmctl campaign --scenario {row['scenario']} --agents {row['agents']} --delay {_exact(row['delay_ms'])} "
        f"--loss {_exact(row['loss'])} --noise {row['noise']} --wind {_exact(row['wind_m_s'])} "
        f"--protections {row['protections']} --airframe {row['airframe']} --disturbance {row['disturbance']}{sets} "
        f"--first-seed {row['seed']} --trials 1"
    )


def _exact(value: float) -> str:
    short = f"{value:g}"
    return short if float(short) == value else repr(value)


_ALWAYS = ("agents", "delay", "loss", "protections", "collided", "arrived")
_COLUMNS: tuple[_Column, ...] = (
    ("agents", lambda s: str(s.cell.agents)),
    ("delay", lambda s: f"{s.cell.delay_ms:g} ms"),
    ("loss", lambda s: f"{100 * s.cell.loss:g} %"),
    ("noise", lambda s: "" if s.cell.noise == "exact" else s.cell.noise),
    ("wind", lambda s: f"{s.cell.wind_m_s:g} m/s" if s.cell.wind_m_s else ""),
    ("protections", lambda s: s.cell.protections),
    ("airframe", lambda s: "" if s.cell.airframe == "own" else s.cell.airframe),
    ("disturbance", lambda s: "" if s.cell.disturbance == NONE else s.cell.disturbance),
    ("settings", lambda s: s.cell.sets),
    ("not flown", lambda s: str(s.not_flown) if s.not_flown else ""),
    ("collided", lambda s: _share(s.collided, False)),
    ("arrived", lambda s: _share(s.arrived, True)),
    ("deadlocked", lambda s: share_text(s.deadlocked) if s.deadlocked.hits else ""),
    ("least separation", lambda s: _number(s.min_separation_m, " m")),
    ("least clearance", lambda s: _number(s.min_clearance_m, " m")),
    ("time, median", lambda s: _number(s.time_median_s, " s", 1)),
    ("longest", lambda s: _number(s.time_max_s, " s", 1)),
    ("relative to single-agent time", lambda s: _number(s.time_relative, " x")),
    ("relative to lower bound", lambda s: _number(s.sum_relative, " x")),
    ("plans failed", lambda s: _number(s.plans_failed, digits=1) if s.plans_failed else ""),
    ("commits refused", lambda s: _number(s.commits_refused, digits=1) if s.commits_refused else ""),
    ("safety filter acted", lambda s: _number(s.safety_filter_acted, digits=1) if s.safety_filter_acted else ""),
    ("CPU a run", lambda s: _number(s.cpu_s, " s", 1)),
)
