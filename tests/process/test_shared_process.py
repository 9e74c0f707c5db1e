"""A launch whose agents share processes: each is seen to end by itself, or with its process."""

from __future__ import annotations

import os
import signal

import pytest

from tests.benches.launches import NEAR, Start

pytestmark = pytest.mark.process

FOUR = ("--agents", "4", "--set", "telemetry.enabled=false", "--set", "swarm.agents_per_process=2", *NEAR)


def test_a_killed_process_loses_no_vehicle_and_ctrl_c_lands_the_others(start: Start) -> None:
    launched = start(*FOUR, "--duration", "60")
    launched.until_phase("TRACK", 4)
    dies, lives = (launched.pid_of("agent", "--id", number) for number in ("0", "2"))
    assert launched.pid_of("agent", "--id", "1") == dies != lives == launched.pid_of("agent", "--id", "3")
    os.kill(dies, signal.SIGKILL)
    for agent in (0, 1):
        launched.until_event("recovered", f"the vehicle of agent-{agent} is on the ground and disarmed")
    launched.process.send_signal(signal.SIGINT)
    assert launched.end() == 130, launched.text()
    ended = {(row["agent"], row["exit_code"]) for row in launched.events("agent_ended")}
    assert ended == {(0, 137), (0, 130), (1, 137), (1, 130), (2, 130), (3, 130)}
    for agent in (0, 1):
        assert f"agent-{agent} was killed by SIGKILL" in launched.text()
        assert agent in [row["agent"] for row in launched.events("peer_ended", "agent-2")]
    assert launched.landed() == dict.fromkeys(range(4), True)
    assert launched.summary()["separation"]["min_m"] >= 0.85
