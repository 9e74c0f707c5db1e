"""A recorded run for notebooks: configuration, summary, events, and tables of ticks and true states."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from swarmctl.config import Config, load_recorded
from swarmctl.core.recorded.records import PLAN_COLUMNS, TRUTH_COLUMNS
from swarmctl.core.recorded.tick_record import COLUMNS
from swarmctl.core.text import counted
from swarmctl.errors import ConfigError
from swarmctl.telemetry.evaluation.referee import RunData
from swarmctl.telemetry.recording.file_names import SUMMARY
from swarmctl.telemetry.recording.run_files import load_run as read_recording
from swarmctl.telemetry.recording.run_files import (
    read_plans,
    read_summary,
    read_text,
    refuse_other_swarm,
)
from swarmctl.telemetry.recording.tables import named_table

if TYPE_CHECKING:
    import pyarrow as pa


class Run:
    """What a finished run has recorded.

    Positions are in the shared NED frame, quaternions (w, x, y, z) body FRD to NED. The unit of a column is in its name
    and, with its meaning, in the metadata of its field. Columns are described in `docs/data_formats.md`.

    Attributes:
        folder: the run folder.
        config: the configuration that was flown.
        summary: the referee's judgement, as in `summary.json`.
        events: what happened, in order of time, one dictionary each.
    """

    def __init__(self, folder: Path, config: Config, summary: dict[str, Any], data: RunData) -> None:
        self.folder = folder
        self.config = config
        self.summary = summary
        self.events: list[dict[str, Any]] = data.events
        self._data = data

    def __repr__(self) -> str:
        """Return the name of the folder, and how the run has ended."""
        return f"<Run {self.folder.name}: {counted(len(self.agents), 'agent')}, {self.outcome}>"

    @property
    def outcome(self) -> str:
        """How the run ended: "completed" (without a violation), "failed" or "interrupted"."""
        return str(self.summary["outcome"])

    @property
    def violations(self) -> list[str]:
        """What the referee has found wrong, in words."""
        return list(self.summary["violations"])

    @property
    def agents(self) -> tuple[int, ...]:
        """Numbers of the agents that have recorded ticks."""
        return tuple(self._data.ticks)

    def ticks(self, agent: int) -> pa.Table:
        """Return every tick of an agent: phase, modes and plan status as words, one column for each component."""
        return named_table(self.tick_rows(agent), COLUMNS)

    def tick_rows(self, agent: int) -> NDArray[np.void]:
        """Return the same as a structured array (T,): `rows["pos_ned_m"]` is (T, 3), enumerations are numbers.

        Raises:
            KeyError: the agent has recorded nothing.
        """
        if agent not in self._data.ticks:
            raise KeyError(f"agent {agent!r} has recorded no ticks; those that have: {list(self.agents)}")
        return self._data.ticks[agent]

    def plans(self, agent: int) -> pa.Table:
        """Return the predicted paths of an agent, of each tick that flew one, a row a point; no rows without any.

        Raises:
            ConfigError: their file has not the expected content.
        """
        return named_table(self.plan_rows(agent), PLAN_COLUMNS)

    def plan_rows(self, agent: int) -> NDArray[np.void]:
        """Return the same as a structured array (K,); rows of one `t_us` are one path."""
        return read_plans(self.folder, agent)

    def true_states(self, vehicle: int | None = None) -> pa.Table:
        """Return the simulator's true states of one vehicle or of all, 50 a second; no rows without a simulator."""
        return named_table(self.true_rows(vehicle), TRUTH_COLUMNS)

    def true_rows(self, vehicle: int | None = None) -> NDArray[np.void]:
        """Return the same as a structured array (T,), on the clock `t_us` of the ticks."""
        truth = self._data.truth
        return truth if vehicle is None else truth[truth["vehicle"] == vehicle]


def load_run(folder: str | Path) -> Run:
    """Open a run folder that `launch` or `simulate` has written, also one from another person.

    Raises:
        ConfigError: it is no run folder, the run has not ended, or a file in it has not the expected content.
    """
    folder = Path(folder)
    config = load_recorded(folder)
    checked = read_summary(folder)
    if checked is None:
        advice = f"Then complete it: swarmctl report {shlex.quote(str(folder))}"
        problem = f"holds no {SUMMARY}: the run still flies, or was cut off. {advice}"
        raise ConfigError(str(folder), [problem])
    refuse_other_swarm(folder, checked, config.swarm.agents)
    summary = json.loads(read_text(folder / SUMMARY))  # all of it, while `checked` is what the report needs
    return Run(folder, config, summary, read_recording(folder))
