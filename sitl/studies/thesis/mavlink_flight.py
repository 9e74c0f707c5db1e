"""Flights in the full MAVLink loop: agents, MAVLink frames, commands and the simulator's own loops.

Ideal link: no latency, no loss. The simulator's physics runs at the thesis' 50 Hz, so that what is left of a difference
to a model-only flight is the bridge itself: frames in single precision, the sequence from arming to tracking, and its
estimate of the hover thrust.
"""

from __future__ import annotations

import numpy as np

from sitl.lockstep import Lockstep
from sitl.plant.airframes import PRESETS
from sitl.plant.attitude import THESIS_SAMPLE_S
from sitl.studies.thesis.trace import Trace
from swarmctl.config import Config
from swarmctl.core.frames import euler_from_quat
from swarmctl.core.types import Array, PlanStatus

PHYSICS_HZ = round(1.0 / THESIS_SAMPLE_S)


def fly_over_mavlink(name: str, config: Config) -> Trace:
    """Fly a configuration's mission in lockstep; return the trace of the mission alone, from true states.

    Raises:
        RuntimeError: the mission did not complete.
    """
    sitl = config.sitl.model_copy(update={"physics_hz": PHYSICS_HZ, "start": "air"})
    lockstep = Lockstep(config.model_copy(update={"sitl": sitl}))
    lockstep.run(Lockstep.mission_is_over)  # how they land is no part of the trace
    if not lockstep.mission_is_over():
        raise RuntimeError(f"{name}: the mission did not end")
    outcomes = [agent.outcome for agent in lockstep.agents if agent is not None]
    problems = [f"agent {i}: {outcome}" for i, outcome in enumerate(outcomes) if outcome != "completed"]
    if problems:
        raise RuntimeError(f"{name}: {'; '.join(problems)}")
    agents = config.swarm.agents
    ticks = [log.ticks[np.isfinite(log.ticks["mission_t_s"])] for log in lockstep.logs]
    steps = min(len(rows) for rows in ticks)
    truth = lockstep.truth.reshape(-1, agents)
    at = np.searchsorted(truth["t_us"][:, 0], ticks[0]["t_us"][:steps])  # true states at the ticks
    if (truth["t_us"][at, 0] != ticks[0]["t_us"][:steps]).any():
        raise RuntimeError(f"{name}: ticks and true states are not of the same times")
    true = truth[at]

    def of_ticks(field: str) -> Array:
        return np.stack([rows[field][:steps] for rows in ticks], axis=1).astype(np.float64)

    return Trace(
        name=name,
        path="full",
        t_s=np.asarray(ticks[0]["mission_t_s"][:steps], np.float64),
        pos_ned_m=true["pos_ned_m"],
        vel_ned_m_s=true["vel_ned_m_s"],
        euler_rad=_euler(true["q_nb"]),
        ref_pos_ned_m=of_ticks("ref_pos_ned_m"),
        euler_ref_rad=_euler(of_ticks("setpoint_q_nb")),
        thrust_n=of_ticks("setpoint_thrust_01") * PRESETS[config.sitl.preset].thrust_max_n,
        torque_n_m=np.full((steps, agents, 3), np.nan),
        failed=sum(int((rows["plan_status"] != PlanStatus.OK).sum()) for rows in ticks),
        terminal_missed=None,
        obstacles=config.obstacles,
    )


def _euler(q_nb: Array) -> Array:
    """Return roll, pitch, yaw (T, N, 3) of quaternions (T, N, 4)."""
    flat = [euler_from_quat(np.asarray(q, np.float64)) for q in q_nb.reshape(-1, 4)]
    return np.array(flat).reshape(*q_nb.shape[:2], 3)
