"""Tests of `report` on run folders with hostile content: it ends with a message and writes nothing but the report."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from swarmctl.api.run import load_run
from swarmctl.config import Config, dump, load
from swarmctl.core.recorded.records import TICK_DTYPE, TRUTH_DTYPE
from swarmctl.errors import ConfigError
from swarmctl.ops.flight.summary import rewrite_report
from swarmctl.telemetry.recording.new_run_folder import create_run_folder


@pytest.fixture
def folder(finished_run: Path, tmp_path: Path) -> Path:
    """A copy of a finished run to spoil."""
    return Path(shutil.copytree(finished_run, tmp_path / "run"))


def report(directory: Path) -> subprocess.CompletedProcess[str]:
    """Run the verb as on the command line."""
    command = [sys.executable, "-m", "swarmctl", "report", str(directory)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def summary_with(directory: Path, **changes: Any) -> None:
    path = directory / "summary.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def summary_holding(directory: Path, section: str, **changes: Any) -> None:
    summary = json.loads((directory / "summary.json").read_text())
    summary_with(directory, **{section: {**summary[section], **changes}})


def huge_number(directory: Path) -> None:
    text = (directory / "summary.json").read_text()
    (directory / "summary.json").write_text(text.replace('"agents": 3', f'"agents": 1{"0" * 5000}'))


def spread_of_times(directory: Path, name: str, dtype: np.dtype[np.void]) -> None:
    rows = np.zeros(2, dtype)
    rows["t_us"] = [0, 2**62]
    rows["armed"] = 1
    rows.tofile(directory / name)


def spread_of_utc(directory: Path) -> None:
    rows = np.zeros(2, TICK_DTYPE)
    rows["utc_us"] = [0, 2**62]
    rows.tofile(directory / "agent-0.ticks")


def too_many_rows(directory: Path) -> None:
    """Repeated numbers need hardly any place in a file, and 0.5 kB each in memory."""
    table = pa.table({"seq": pa.array(np.zeros(2**31 // TICK_DTYPE.itemsize + 1, np.uint8))})
    pq.write_table(table, directory / "agent-0.parquet", compression="zstd")


def text_column(directory: Path) -> None:
    pq.write_table(pa.table({"t_us": ["yesterday", "today"]}), directory / "agent-0.parquet")


def truth_of_text(directory: Path) -> None:
    pq.write_table(pa.table({"t_us": ["yesterday", "today"]}), directory / "truth.parquet")


def pipe_as(name: str) -> Callable[[Path], None]:
    def make(directory: Path) -> None:
        (directory / name).unlink(missing_ok=True)
        os.mkfifo(directory / name)

    return make


def device_as(name: str) -> Callable[[Path], None]:
    def make(directory: Path) -> None:
        (directory / name).unlink(missing_ok=True)
        (directory / name).symlink_to("/dev/zero")

    return make


def sparse_as(name: str) -> Callable[[Path], None]:
    def make(directory: Path) -> None:
        with (directory / name).open("wb") as file:
            file.truncate(2**40)  # reading it would need 1 TB

    return make


_NAMES = (
    "config.toml",
    "summary.json",
    "events.jsonl",
    "agent-0.parquet",
    "agent-7.ticks",
    "truth.bin",
    "truth.parquet",
)
REFUSED: dict[str, tuple[Callable[[Path], Any], str]] = {
    "summary torn": (lambda d: (d / "summary.json").write_text('{"outcome": "comp'), "summary.json"),
    "summary empty": (lambda d: (d / "summary.json").write_text(""), "summary.json"),
    "summary list": (lambda d: (d / "summary.json").write_text("[]"), "summary.json"),
    "summary without": (lambda d: (d / "summary.json").write_text('{"outcome": "failed"}'), "violations"),
    "summary deep inside": (
        lambda d: (d / "summary.json").write_text('{"x":' + "[" * 100_000 + "]" * 100_000 + "}"),
        "summary.json",
    ),
    "summary deep": (lambda d: (d / "summary.json").write_text("[" * 100_000), "summary.json"),
    "agents = 1e9": (lambda d: summary_with(d, agents=10**9), "of 1000000000 agents"),
    "agents of 5,000 digits": (huge_number, "summary.json"),
    "outcome of its own": (lambda d: summary_with(d, outcome='"><script>'), "outcome"),
    "figure of 1e300": (lambda d: summary_holding(d, "separation", min_m=1e300), "min_m"),
    "figure below -1e9": (lambda d: summary_holding(d, "tracking", index_m=-1e10), "index_m"),
    "count below 0": (lambda d: summary_holding(d, "timing", ticks=-1), "ticks"),
    "count of 2^60": (lambda d: summary_holding(d, "timing", late_ticks=2**60), "late_ticks"),
    "tracked agent 1e9": (
        lambda d: summary_holding(d, "tracking", agents=[{"id": 10**9, "mse_m2": [0.0, 0.0, 0.0]}]),
        "id",
    ),
    "Parquet of text": (text_column, "t_us holds no numbers"),
    "truth torn": (lambda d: (d / "truth.parquet").write_bytes(b"PAR1" + bytes(100) + b"PAR1"), "truth.parquet"),
    "truth of text": (truth_of_text, "t_us holds no numbers"),
    "Parquet torn": (lambda d: (d / "agent-1.parquet").write_bytes(b"PAR1" + bytes(100) + b"PAR1"), "agent-1.parquet"),
    "Parquet of noise": (lambda d: (d / "agent-1.parquet").write_bytes(os.urandom(1000)), "agent-1.parquet"),
    "ticks of 10,000 years": (lambda d: spread_of_times(d, "agent-0.ticks", TICK_DTYPE), "spans more than 48 hours"),
    "truth of 10,000 years": (lambda d: spread_of_times(d, "truth.bin", TRUTH_DTYPE), "spans more than 48 hours"),
    "UTC of 10,000 years": (spread_of_utc, "spans more than 48 hours"),
    "Parquet of too many rows": (too_many_rows, "rows, more than a day of one agent"),
    **{f"{name} of 1 TB": (sparse_as(name), "is larger than") for name in _NAMES},
    **{f"pipe as {name}": (pipe_as(name), "is not a regular file") for name in _NAMES},
    **{f"device as {name}": (device_as(name), "is a symbolic link") for name in _NAMES},
}


@pytest.mark.timeout(60)
@pytest.mark.parametrize(("spoil", "words"), REFUSED.values(), ids=REFUSED)
def test_refused_in_one_line(folder: Path, spoil: Callable[[Path], Any], words: str) -> None:
    spoil(folder)
    with pytest.raises(ConfigError) as caught:
        rewrite_report(folder)
    assert len(caught.value.problems) == 1
    assert str(folder) in str(caught.value)
    assert words in str(caught.value)


def test_the_verb_reports_it_and_exits_2(folder: Path) -> None:
    (folder / "summary.json").write_text("\x1b[2J")
    done = report(folder)
    assert (done.returncode, done.stdout) == (2, "")
    assert len(done.stderr.splitlines()) == 1


def test_a_path_that_is_no_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such run folder"):
        rewrite_report(tmp_path / "nowhere")
    with pytest.raises(ConfigError, match="is no run folder"):
        rewrite_report(tmp_path)


_DEEP = '{"a":' * 900 + "1" + "}" * 900
HOSTILE_EVENTS = [
    "[" * 100_000,
    _DEEP,
    f'{{"utc_us": 1{"0" * 5000}}}',
    f'{{"utc_us": 1{"0" * 400}, "t_us": 1{"0" * 400}, "event": "x"}}',
    '{"event": "deadlock", "lasted_s": 1e999, "begins": true}',
    '{"event": "commitments", "source": "agent-0", "worst_tracking_m": "much", "proposed": [1]}',
    '{"event": "bus_summary", "source": "agent-0", "rejected": {"stale": NaN, "x": 1e999}}',
    '{"event": "bus_summary", "source": "agent-0", "sent": {"path": {"messages": 1e999}, "tick": 3}}',
    '{"event": "bus_summary", "source": "agent-1", "sent": ["path"]}',
    '{"event": "\\ud800", "source": {"a": 1}, "utc_us": -9e18, "t_us": true}',
    '{"event": "<script>alert(1)</script>"}',
    '{"event": "unresponsive", "source": "agent-0", "agent": 1, "begins": true, "utc_us": "now"}',
    '{"event": "unresponsive", "source": "agent-0", "agent": 1, "begins": false, "lasted_s": "long", "utc_us": [1]}',
    '{"event": "refused", "source": "agent-0", "sender": {"a": 1}, "topic": [], "reason": null, "count": true}',
    "\x00\xff",
]


@pytest.mark.parametrize("finished", [True, False])
def test_hostile_events_are_skipped(folder: Path, finished: bool) -> None:
    with (folder / "events.jsonl").open("a", encoding="latin-1") as file:
        file.writelines(f"{line}\n" for line in HOSTILE_EVENTS)
    if not finished:
        (folder / "summary.json").unlink()
    page = rewrite_report(folder).read_text()
    assert "alert(1)" in page
    assert "<script" not in page


def test_report_writes_through_no_link(folder: Path, tmp_path: Path) -> None:
    precious = tmp_path / "authorized_keys"
    for finished in (True, False):
        precious.write_text("mine")
        for name in ("report.html", "summary.json", "events.jsonl", "agent-0.parquet"):
            (folder / f"{name}.part").unlink(missing_ok=True)
            (folder / f"{name}.part").symlink_to(precious)
        (folder / "report.html").unlink()
        (folder / "report.html").symlink_to(precious)
        if not finished:
            (folder / "summary.json").unlink()
        assert report(folder).returncode == 0
        assert precious.read_text() == "mine"
        assert not (folder / "report.html").is_symlink()


def test_a_new_run_refuses_a_folder_with_links(tmp_path: Path) -> None:
    (tmp_path / "launch.events.jsonl").symlink_to("/etc/hostname")
    with pytest.raises(ConfigError, match="symbolic link"):
        create_run_folder(tmp_path, "circle", 0)


@pytest.mark.parametrize(("seed", "within_us"), [(0, 10**10), *((seed, 10**9) for seed in range(1, 8))])
def test_noise_as_rows_is_reported_or_refused(folder: Path, seed: int, within_us: int) -> None:
    """Values that no agent records: every phase, NaN and infinity anywhere, times within the same hours or minutes."""
    random = np.random.default_rng(seed)
    for name, dtype in (("agent-0.ticks", TICK_DTYPE), ("agent-9.ticks", TICK_DTYPE), ("truth.bin", TRUTH_DTYPE)):
        rows = np.frombuffer(random.bytes(300 * dtype.itemsize), dtype).copy()
        rows["t_us"] = random.integers(0, within_us, 300)
        if "utc_us" in (dtype.names or ()):
            rows["utc_us"] = random.integers(0, within_us, 300)
        rows.tofile(folder / name)
    (folder / "summary.json").unlink()
    with np.errstate(all="ignore"):
        assert rewrite_report(folder).exists()


@pytest.mark.parametrize("section", ["mission", "controller"])
def test_what_a_received_configuration_names_is_neither_imported_nor_read(
    folder: Path, section: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The control: to fly it, it is imported, because then somebody wants to fly it."""
    module = f"planted_{section}"
    monkeypatch.setattr(sys, "path", [*sys.path])
    (folder / f"{module}.py").write_text(f"import pathlib; pathlib.Path({str(folder / 'ran')!r}).touch()")
    named = Config.model_validate({section: {"kind": f"{module}:Planted"}, "own_folder": str(folder)})
    (folder / "config.toml").write_text(dump(named))
    rewrite_report(folder)
    assert load_run(folder).config == named
    assert not (folder / "ran").exists()
    with pytest.raises(ConfigError, match="has no class Planted"):
        load(folder / "config.toml")
    assert (folder / "ran").exists()


def test_events_of_somebody_else_control_no_terminal(folder: Path) -> None:
    hostile = "\x1b]0;owned\x07\x9b2J\u202e"
    row = {"utc_us": 1, "t_us": 1, "source": "launch", "event": "agent_failed", hostile: [{"text": hostile}]}
    (folder / "launch.events.jsonl").write_text(json.dumps(row, ensure_ascii=False) + "\n", encoding="utf-8")
    (found,) = (event for event in load_run(folder).events if event["utc_us"] == 1)
    shown = r"\x1b]0;owned\x07\x9b2J\u202e"
    assert found[shown] == [{"text": shown}]
    (folder / "summary.json").unlink()
    assert report(folder).returncode == 0, "it is finished once more"
    written = (folder / "events.jsonl").read_text(encoding="utf-8")
    assert all(character.isprintable() or character == "\n" for character in written)
