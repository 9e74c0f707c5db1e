"""What the words of the table mean, and how many rows each is true of: the same on the page and in the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sitl.studies.thesis.trace import SHORT_M, Row

MEANING: Mapping[str, str] = {
    "beaten": "ours is less than the published figure, both at the digits that are printed, and the flight kept the "
    f"thesis' distances to {1000 * SHORT_M:g} mm; a tuned row beats the figure, not the thesis' controller",
    "equal": "the same at the digits that are printed",
    "worse": "ours is more than the published figure",
    "too close": f"ours is less, but the flight came more than {1000 * SHORT_M:g} mm closer than the distances allow: "
    "not beaten",
    "tuned": "the controller's values differ from those that the thesis prints; in what, is listed by preset",
    "matched start": "begins with the reference's velocity, of which the thesis says nothing; all others begin at rest",
    "met, missed": "ours beside the limit that this project asks of itself; a limit below the lower bound is out of "
    "reach for every controller, and missed all the same",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Counts:
    """Numbers of rows."""

    rows: int
    published: int  # with a published figure; the next four are of these
    beaten: int
    beaten_untuned: int  # of the beaten ones, those with the thesis' values
    beaten_matched: int  # of the beaten ones, those from a matched start
    equal: int
    worse: int
    too_close: int
    limits: int
    missed: int
    out_of_reach: int  # of the missed ones


def counted(rows: Sequence[Row]) -> Counts:
    """Return how many rows each verdict is true of."""
    beside = [row.beside for row in rows]
    return Counts(
        rows=len(rows),
        published=sum(found is not None for found in beside),
        beaten=beside.count("beaten"),
        beaten_untuned=sum(row.beside == "beaten" and not row.differs for row in rows),
        beaten_matched=sum(row.beside == "beaten" and row.matched_start for row in rows),
        equal=beside.count("equal"),
        worse=beside.count("worse"),
        too_close=beside.count("too close"),
        limits=sum(row.limit is not None for row in rows),
        missed=sum(row.met is False for row in rows),
        out_of_reach=sum(row.met is False and row.out_of_reach for row in rows),
    )


def counts_text(counts: Counts) -> str:
    """Return the counts as one sentence."""
    beside = (
        f"{counts.beaten} beaten ({counts.beaten_untuned} with the thesis' values, the others tuned; "
        f"{counts.beaten_matched} from a matched start), "
        f"{counts.equal} equal, {counts.worse} worse"
    )
    close = f", {counts.too_close} too close" if counts.too_close else ""
    reach = f" ({counts.out_of_reach} of them out of reach)" if counts.out_of_reach else ""
    return (
        f"{counts.rows} rows; {counts.published} published figures: {beside}{close}; "
        f"{counts.limits} limits: {counts.limits - counts.missed} met, {counts.missed} limits missed{reach}"
    )


def verdict_of(row: Row) -> str:
    """Return the word beside a row's limit; "" without one."""
    if row.met is None:
        return ""
    if row.met:
        return "met"
    return "missed, out of reach" if row.out_of_reach else "missed"


def preset_differences(rows: Sequence[Row]) -> Mapping[str, tuple[str, ...]]:
    """Return what differs from the thesis' values, by preset, in the order of the table."""
    return {row.preset: row.differs for row in rows if row.preset}
