"""What the thesis prints for its controllers, and by which of these values a configuration differs: then it is tuned.

Tables 3, 4 and 10 (chapters 2 and 3), 16 to 18 (4.3) and 4.4. What has no value because the thesis does not have it is
listed with the value that switches it off. Not compared, because no key turns it back: distances are linearised around
the previous own prediction and softened, plans are certified before they are shared (the thesis solves the nonlinear
problem with fmincon), and one bound holds for u_x and u_y alike (chapter 3: 0.18 and 0.2, in moves 0.05 and 0.06).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import reduce
from typing import Any

from pydantic import BaseModel

from sitl.studies.thesis.figures import FlightName
from swarmctl.config import Config

_MODEL: Mapping[str, Any] = {
    "vehicle_model.delay_s": 0.0,
    "vehicle_model.attitude_rad_s": 0.0,
    "vehicle_model.drag_1_s": 0.0,
    "vehicle_model.hover_thrust_01": 0.4905,  # its mass is known: 1 kg under 20 N
    "agent.disturbance.enabled": False,
}
_PID: Mapping[str, Any] = {"controller.kind": "pid", "controller.pid.accel_feed_forward": 0.0, **_MODEL}
_STEP: Mapping[str, Any] = {
    **_PID,
    "controller.pid.derivative": "measurement",
    "controller.pid.x": (-0.25, -0.0001, -0.3),
    "controller.pid.y": (0.15, 0.0001, 0.25),
    "controller.pid.z": (-1.5, -0.001, -2.55),
}
_TRAJECTORY: Mapping[str, Any] = {
    **_PID,
    "controller.pid.derivative": "error",
    "controller.pid.x": (-0.25, -0.001, -0.3),
    "controller.pid.y": (0.05, 0.0, 0.45),
    "controller.pid.z": (-3.5, -0.001, -4.0),
}


def _weights(axis: str, q_pos: float, q_vel: float, r: float) -> dict[str, float]:
    key = f"controller.mpc.{axis}"
    return {f"{key}.q_pos": q_pos, f"{key}.q_vel": q_vel, f"{key}.r": r}


_MPC: Mapping[str, Any] = {
    "controller.mpc.discretisation": "euler",
    "controller.mpc.thrust_ahead": "held",
    "controller.mpc.control_z": 3,
    "controller.mpc.control_xy": 6,
    "controller.mpc.thrust_min_m_s2": -20.0,
    "controller.mpc.thrust_max_m_s2": 20.0,
    "controller.mpc.du_max": 0.05,
    **_MODEL,
}
_SINGLE: Mapping[str, Any] = {
    **_MPC,
    "controller.kind": "mpc",
    "controller.mpc.horizon_z": 30,
    "controller.mpc.horizon_xy": 20,
    **_weights("z", 1.0, 0.05, 0.5),
    **_weights("x", 1.0, 0.01, 0.75),
    **_weights("y", 1.0, 0.01, 0.5),
    "controller.mpc.dthrust_max_m_s2": 10.0,
    "controller.mpc.u_max": 0.18,
    "controller.mpc.terminal_z": "position_velocity",
    "controller.mpc.terminal_xy": "position",
}
_SWARM: Mapping[str, Any] = {
    **_MPC,
    "controller.kind": "dmpc",
    "controller.mpc.dthrust_max_m_s2": 5.0,
    "controller.mpc.u_max": 0.2,
    "controller.mpc.terminal_xy": "none",
    "separation.relax_01": 1.0,  # share of the reachable displacement that a distance constraint may ask for
    "separation.approach_01": 0.0,
    "separation.right_of_way_rad": 0.0,
    "separation.right_of_way_obstacle_rad": 0.0,
}
_CIRCLE: Mapping[str, Any] = {
    **_SWARM,
    "controller.mpc.horizon_z": 40,
    "controller.mpc.horizon_xy": 40,
    **_weights("z", 2.0, 0.05, 0.01),
    **_weights("x", 1.5, 0.5, 0.01),
    **_weights("y", 1.5, 0.5, 0.01),
    "controller.mpc.terminal_z": "position_velocity",
}
_OBSTACLE: Mapping[str, Any] = {
    **_SWARM,
    "controller.mpc.horizon_z": 50,
    "controller.mpc.horizon_xy": 50,
    **_weights("z", 1.0, 0.0, 0.1),
    **_weights("x", 0.75, 0.0, 0.5),
    **_weights("y", 0.75, 0.0, 0.5),
    "controller.mpc.terminal_z": "position",
    "separation.radius_m": 0.9,
    "obstacles.0.keep_out_m": 1.75,
}

THESIS_VALUES: Mapping[FlightName, Mapping[str, Any]] = {
    "open_loop": {"controller.kind": "open_loop"},
    "pid_step": _STEP,
    "pid_steps": _STEP,
    "pid_slow": _TRAJECTORY,
    "pid_fast": _TRAJECTORY,
    "mpc_slow": _SINGLE,
    "mpc_fast": _SINGLE,
    "circle": _CIRCLE,
    "obstacle": _OBSTACLE,
}


def differences(flight: FlightName, config: Config) -> tuple[str, ...]:
    """Return every key in which the configuration differs, as `controller.mpc.z.r 1 (thesis 0.01)`; none: not tuned."""
    values = THESIS_VALUES[flight].items()
    flown = {key: value_of(config, key) for key, _ in values}
    return tuple(
        f"{key} {_text(flown[key])} (thesis {_text(thesis)})" for key, thesis in values if flown[key] != thesis
    )


def with_thesis_values(flight: FlightName) -> tuple[str, ...]:
    """Return the overrides after which a configuration of the flight has no differences, obstacles aside."""
    values = THESIS_VALUES[flight].items()
    return tuple(f"{key}={json.dumps(value)}" for key, value in values if not key.startswith("obstacles"))


def value_of(config: Config, key: str) -> Any:
    """Return the value of a dotted key; a number is a place in a list."""
    return reduce(_inside, key.split("."), config)


def _inside(found: Any, name: str) -> Any:
    return getattr(found, name) if isinstance(found, BaseModel) else found[int(name)]


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, tuple):
        return f"({', '.join(map(_text, value))})"
    return f"{value:g}" if isinstance(value, float) else str(value)
