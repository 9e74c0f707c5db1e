"""Drives a swarm through the Python API: each agent in turn climbs above the others, then the mission goes on.

Fly with: python configs/examples/steer_swarm.py [CONFIGURATION.toml]
"""

import sys
import time

import swarmctl

CLIMB_M = 1.5


def climb_in_turn(swarm: swarmctl.Swarm, agents: range) -> None:
    """Hold all agents, send one after another up, and let all go on from there."""
    swarm.hold()
    for agent in agents:
        north_m, east_m, down_m = swarm.config.starts_ned_m()[agent]
        swarm.goto(agent, (north_m, east_m, down_m - CLIMB_M), speed_m_s=1.5)
        wait_for_height(swarm, agent, CLIMB_M - down_m)
        print(f"agent {agent} is at {swarm.status()[agent]['altitude_m']:.1f} m")
    swarm.resume()


def wait_for_height(swarm: swarmctl.Swarm, agent: int, height_m: float, timeout_s: float = 60.0) -> None:
    """Wait until an agent rests at a height above the shared origin."""
    until_s = time.monotonic() + timeout_s
    while time.monotonic() < until_s:
        status = swarm.status().get(agent)
        if status and abs(status["altitude_m"] - height_m) < 0.2 and abs(status["ground_speed_m_s"]) < 0.2:
            return
        time.sleep(0.2)
    raise TimeoutError(f"agent {agent} is not at {height_m:g} m after {timeout_s:g} s")


def main(path: str | None) -> None:
    """Fly a configuration, by default three agents that hover, until the script has done with them."""
    hover = {"mission.kind": "hover", "mission.duration_s": 300.0, "start.spacing_m": 2.0}
    config = swarmctl.load(path) if path else swarmctl.load(set=hover)
    with swarmctl.launch(config) as swarm:
        swarm.wait_for("TRACK")
        climb_in_turn(swarm, range(config.swarm.agents))
        swarm.land()
        run = swarm.wait()
    print(run, f"smallest separation {run.summary['separation']['min_m']} m")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else None)
