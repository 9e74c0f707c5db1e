"""Run folders as a flight leaves them, made up: agents on a circle, with take-off and landing."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from swarmctl.config import Config, dump
from swarmctl.core.obstacle import Obstacle
from swarmctl.core.recorded.records import TICK_DTYPE, TRUTH_DTYPE
from swarmctl.core.types import ControlMode, Mode, Phase
from swarmctl.telemetry.evaluation.referee import JudgedObstacle, Rules
from swarmctl.telemetry.recording.run_folder import Outcome, finish_run

UTC_US = 1_780_000_000_000_000
FAR_BALL = JudgedObstacle(number=0, obstacle=Obstacle(center_ned_m=(20.0, 20.0, -2.0)))
RULES = Rules(agents=3, required_separation_m=0.85, obstacles=(FAR_BALL,))


def flight(agent: int, agents: int, seconds: float) -> tuple[NDArray[np.void], NDArray[np.void]]:
    """Return ticks and truth of one agent on a circle, with take-off and landing."""
    t_s = np.arange(0, seconds, 0.02)
    rows, true = np.zeros(len(t_s), TICK_DTYPE), np.zeros(len(t_s), TRUTH_DTYPE)
    rows["t_us"] = true["t_us"] = 5_000_000 + (t_s * 1e6).astype(np.int64)
    rows["utc_us"] = rows["t_us"] + UTC_US
    rows["seq"] = np.arange(len(t_s))
    rows["phase"] = np.select([t_s < 1, t_s < 3, t_s < seconds - 1], [Phase.STANDBY, Phase.TAKEOFF, Phase.TRACK], 8)
    rows["mode"] = np.where(rows["phase"] == Phase.TRACK, Mode.TRACKING, Mode.IDLE)
    rows["control"] = np.where(rows["phase"] == Phase.TRACK, ControlMode.TRACKING, ControlMode.AUTO)
    rows["mission_t_s"] = np.where(rows["phase"] == Phase.TRACK, t_s - 3, np.nan)
    rows["armed"] = true["armed"] = t_s >= 1
    angle = 0.5 * t_s
    rows["ref_pos_ned_m"] = np.column_stack([5 * np.cos(angle), 5 * np.sin(angle), -1 - 0.1 * t_s])
    around = 2 * np.pi * agent / agents
    offset = 0.2 * agents * np.array([np.cos(around), np.sin(around), 0.0])
    rows["pos_ned_m"] = true["pos_ned_m"] = rows["ref_pos_ned_m"] + offset
    rows["q_nb"][:, 0] = true["q_nb"][:, 0] = 1.0
    rows["setpoint_q_nb"] = np.where(rows["mode"][:, None] == Mode.IDLE, np.nan, rows["q_nb"])
    noise = np.random.default_rng([1, agent]).gamma(2.0, 0.5, (2, len(t_s)))
    rows["solve_ms"], rows["tick_ms"], rows["iterations"] = 1 + noise[0], 2 + noise[1], 25
    rows["setpoint_thrust_01"], rows["hover_thrust_01"] = 0.5 + 0.02 * noise[0], 0.5
    rows["plan_staleness_ms"] = np.nan
    true["vehicle"] = agent
    return rows, true


def write_run(directory: Path, agents: int, seconds: float) -> None:
    """Write the files that processes leave before the launcher finishes the run."""
    true = []
    for agent in range(agents):
        rows, own = flight(agent, agents, seconds)
        rows.tofile(directory / f"agent-{agent}.ticks")
        true.append(own)
        event = {"utc_us": UTC_US + agent, "t_us": agent, "source": f"agent-{agent}", "event": "phase", "to": "<b>"}
        (directory / f"agent-{agent}.events.jsonl").write_text(json.dumps(event) + "\n")
    np.concatenate(true).tofile(directory / "truth.bin")
    (directory / "config.toml").write_text('name = "x<y"\n')


def write_finished_run(directory: Path) -> None:
    """Write a finished run of three agents without faults."""
    write_run(directory, 3, 6.0)
    (directory / "config.toml").write_text(dump(Config()))
    finish_run(directory, RULES, Outcome(outcome="completed"))


def write_configured_run(directory: Path, agents: int, seconds: float) -> None:
    """Write a finished run that is judged as configured by default."""
    write_run(directory, agents, seconds)
    (directory / "config.toml").write_text(dump(Config()))
    finish_run(directory, Config().rules(), Outcome(outcome="completed"))
