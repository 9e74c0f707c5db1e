"""Hashes of the true states of twelve lockstep flights, one a line: equal wherever flights are the same bit for bit.

`python tools/flight_hashes.py [--only NAME,NAME]`. Two processors, or two settings of `OPENBLAS_CORETYPE` and
`NPY_DISABLE_CPU_FEATURES`, are compared by `diff`. Standard error says when nothing keeps the processor out of it.
"""

from __future__ import annotations

import argparse
import hashlib
from dataclasses import dataclass
from pathlib import Path

from sitl.lockstep import Lockstep
from swarmctl.config import load

CONFIGS = Path(__file__).parents[1] / "configs"
DIES_AT_US = 12_000_000  # under way on the circle


@dataclass(frozen=True, slots=True)
class Flown:
    """A row of the table: what is flown, and who dies on the way."""

    config: str | None
    sets: tuple[str, ...] = ()
    dies: int | None = None


FLIGHTS = {
    "circle": Flown("thesis_5_circle.toml", ("mission.duration_s=6",)),
    "pid": Flown("thesis_4_pid_fast.toml", ("mission.duration_s=6",)),
    "mpc": Flown("thesis_4_mpc_fast.toml", ("mission.duration_s=6",)),
    "obstacle": Flown("thesis_6_obstacle.toml"),
    "swap": Flown("swap8.toml", ("mission.duration_s=6", "sitl.start=air")),
    "swap-guaranteed": Flown("swap8.toml", ("mission.duration_s=6", "sitl.start=air", "separation.mode=guaranteed")),
    "delay": Flown(None, ("mission.duration_s=6", "bus.delay_ms=60", "bus.loss_01=0.2")),
    "dead-peer": Flown(None, ("mission.duration_s=8",), dies=1),
    "goto": Flown(
        None,
        (
            "mission.duration_s=6",
            "mission.kind=goto",
            "mission.goto.goals_ned_m=[[1.0,0.3,-1.0],[0.0,0.0,-1.0],[-1.0,-0.3,-1.0]]",
        ),
    ),
    "x500": Flown("x500_circle.toml", ("mission.duration_s=6",)),
    "arducopter": Flown("ardupilot_sitl.toml", ("mission.duration_s=6",)),
    "dmpc3": Flown("improved_5_circle_dmpc3.toml", ("mission.duration_s=4",)),
}


def truth_hash(flown: Flown) -> str:
    """Fly it, to its end; 16 hexadecimal digits of SHA-256 over every true state."""
    lockstep = Lockstep(load(CONFIGS / flown.config if flown.config else None, flown.sets))

    def on_step(running: Lockstep) -> None:
        if flown.dies is not None and running.clock.now_us() == DIES_AT_US:
            running.kill(flown.dies)

    lockstep.run(on_step)
    return hashlib.sha256(lockstep.truth.tobytes()).hexdigest()[:16]


def main() -> None:
    """Fly what is asked for and print a line each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", metavar="NAME,NAME", default=",".join(FLIGHTS), help=f"of {', '.join(FLIGHTS)}")
    names = parser.parse_args().only.split(",")
    for unknown in set(names) - set(FLIGHTS):
        parser.error(f"{unknown!r}: allowed: {', '.join(FLIGHTS)}")
    for name in names:
        print(f"{truth_hash(FLIGHTS[name])} {name}", flush=True)


if __name__ == "__main__":
    main()
