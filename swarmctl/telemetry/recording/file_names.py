"""Names of the files of a run folder, for all that write and read them, and the size that one of events may have."""

from __future__ import annotations

import re

from swarmctl.bus.bus import agent_name

EVENTS = "events.jsonl"  # of all sources, in a finished run
SUMMARY = "summary.json"
OUTCOME = "outcome.json"  # how a run is flown, and how it ended
TRUTH = "truth.bin"  # while the simulator flies
PACKED_TICKS = ".parquet"  # of an agent in a finished run; while it flies, .ticks
PACKED_PLANS = ".plans.parquet"  # likewise; while it flies, .plans
PACKED_RECEIVED = ".received.parquet"  # likewise; while it flies, .received
PACKED_TRUTH = "truth.parquet"  # of a finished run
CONFIG = "config.toml"
RECORDING = "telemetry.rrd"
STUDY_ROWS = "rows.parquet"  # of a campaign or a sweep, whose folder holds no run
AGENT_FILE = re.compile(r"^agent-(\d{1,3})\.(ticks|parquet)$")

MAX_EVENTS_BYTES = 2**28


def events_file(source: str) -> str:
    """Return the name of the events of one source while it runs: an agent, the launch or the simulator."""
    return f"{source}.{EVENTS}"


def ticks_file(agent: int) -> str:
    """Return the name of the raw rows of an agent's ticks."""
    return f"{agent_name(agent)}.ticks"


def plans_file(agent: int) -> str:
    """Return the name of the raw points of an agent's predicted paths."""
    return f"{agent_name(agent)}.plans"


def received_file(agent: int) -> str:
    """Return the name of the raw rows of what an agent's ticks have received."""
    return f"{agent_name(agent)}.received"


def frames_file(agent: int) -> str:
    """Return the name of the MAVLink frames of an agent, as ground stations write them."""
    return f"{agent_name(agent)}.tlog"
