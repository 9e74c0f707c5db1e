"""`report.html` of a campaign: one line per cell, exact intervals drawn to scale, and every run that did not arrive."""

from __future__ import annotations

import html
import itertools
from collections.abc import Callable, Sequence
from pathlib import Path

from sitl.studies.campaign.scenarios import SCENARIOS
from sitl.studies.campaign.summary import CellSummary, Share, summaries
from sitl.studies.campaign.trials import Row, trial_of
from swarmctl.files import replace_text
from swarmctl.telemetry.report_style import STYLE

REPORT = "report.html"
_MAX_LISTED = 300
_BAR_PX = 90
_BAR_STYLE = """
.share { width: 90px; height: 10px; display: inline-block; vertical-align: -1px; margin-right: 6px }
.share .track { fill: #e2e8f0 } .share .range { fill: #94a3b8 } .share .hit { fill: #1e293b }
td { white-space: nowrap }
"""

_Column = tuple[str, Callable[[CellSummary], str]]


def write_page(directory: Path, rows: Sequence[Row], runs_per_hour: float | None = None) -> Path:
    """Write the report of all rows into the campaign's folder and return its path.

    Args:
        directory: of the campaign.
        rows: every finished run.
        runs_per_hour: of the last call, on all its processes.
    """
    found = summaries(rows)
    title = f"Campaign {html.escape(directory.resolve().name)}"
    speed = "" if runs_per_hour is None else f" {runs_per_hour:.0f} runs an hour in the last call."
    parts = [
        f"<h1>{title}</h1><p class=sub>{len(rows)} runs in {len(found)} cells.{speed} Judged on true states only. "
        "Intervals: 95 %, Clopper-Pearson; the bar is the interval, the mark the share. "
        f"Sources: {html.escape(', '.join(sorted({str(row['code']) for row in rows})))}.</p>",
        *(_section(name, list(group)) for name, group in itertools.groupby(found, lambda s: s.cell.scenario)),
        _failures(rows),
    ]
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{title}</title>'
    body = "".join(parts)
    page = f"<head>{head}<style>{STYLE}{_BAR_STYLE}</style></head><body><main>{body}</main></body>"
    path = directory / REPORT
    replace_text(path, f"<!doctype html><html lang=en>{page}</html>\n")
    return path


def _section(scenario: str, found: Sequence[CellSummary]) -> str:
    title = SCENARIOS[scenario].title if scenario in SCENARIOS else ""
    shown = [(name, value) for name, value in _COLUMNS if name in _ALWAYS or any(value(s) for s in found)]
    head = "".join(f"<th>{name}</th>" for name, _ in shown)
    lines = "".join(f"<tr>{''.join(f'<td>{value(s)}</td>' for _, value in shown)}</tr>" for s in found)
    return (
        f"<h2>{html.escape(scenario)}: {html.escape(title)}</h2>"
        f'<div class="card wide"><table><tr>{head}</tr>{lines}</table></div>'
    )


def share_text(share: Share) -> str:
    """Return a share as `3/100 3.0 % [0.6, 8.5]`."""
    low, high = share.interval
    return f"{share.hits}/{share.trials} {share.share:.1%} [{100 * low:.1f}, {100 * high:.1f}]".replace("%", " %")


def _share(share: Share, good_is_all: bool) -> str:
    good = share.hits == (share.trials if good_is_all else 0)
    low, high = (_BAR_PX * bound for bound in share.interval)
    bar = (
        f'<svg class=share viewBox="0 0 {_BAR_PX} 10"><rect class=track y=4 width={_BAR_PX} height=2 />'
        f"<rect class=range x={low:.1f} y=2 width={max(high - low, 1.0):.1f} height=6 />"
        f"<rect class=hit x={_BAR_PX * share.share - 1.0:.1f} width=2 height=10 /></svg>"
    )
    return f"{bar}<span class={'ok' if good else 'bad'}>{share_text(share)}</span>"


def _number(value: float | None, unit: str = "", digits: int = 2) -> str:
    return "" if value is None else f"{value:.{digits}f}{unit}"


def _failures(rows: Sequence[Row]) -> str:
    failed = sorted((row for row in rows if not row["arrived"]), key=trial_of)
    if not failed:
        return "<h2>Runs that did not arrive</h2><p>None.</p>"
    more = f"<p>and {len(failed) - _MAX_LISTED} more</p>" if len(failed) > _MAX_LISTED else ""
    lines = "".join(
        f"<tr><td>{html.escape(row['outcome'])}</td><td>{html.escape(again(row))}</td></tr>"
        for row in failed[:_MAX_LISTED]
    )
    return (
        "<h2>Runs that did not arrive</h2><details class=card><summary>"
        f"{len(failed)} runs, each with what flies it again</summary>"
        f"<div class=wide><table>{lines}</table></div>{more}</details>"
    )


def again(row: Row) -> str:
    """Return the command that flies a row again."""
    sets = "".join(f" --set {item}" for item in row["sets"].split())
    return (
        f"python tools/campaign.py --scenario {row['scenario']} --agents {row['agents']} --delay {row['delay_ms']:g} "
        f"--loss {row['loss']:g} --noise {row['noise']} --wind {row['wind_m_s']:g} --protections {row['protections']}"
        f"{sets} --first-seed {row['seed']} --trials 1"
    )


_ALWAYS = ("agents", "delay", "loss", "protections", "collided", "arrived")
_COLUMNS: tuple[_Column, ...] = (
    ("agents", lambda s: str(s.cell.agents)),
    ("delay", lambda s: f"{s.cell.delay_ms:g} ms"),
    ("loss", lambda s: f"{100 * s.cell.loss:g} %"),
    ("noise", lambda s: "" if s.cell.noise == "exact" else s.cell.noise),
    ("wind", lambda s: f"{s.cell.wind_m_s:g} m/s" if s.cell.wind_m_s else ""),
    ("protections", lambda s: s.cell.protections),
    ("settings", lambda s: html.escape(s.cell.sets)),
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
    ("barrier acted", lambda s: _number(s.safety_filter_acted, digits=1) if s.safety_filter_acted else ""),
    ("CPU a run", lambda s: _number(s.cpu_s, " s", 1)),
)
