"""Prints hashes of the true states of twelve lockstep flights, one per line: equal where flights agree bit for bit.

`python tools/flight_hashes.py [--only NAME,NAME]`. Compare two processors, or two settings of `OPENBLAS_CORETYPE` and
`NPY_DISABLE_CPU_FEATURES`, with `diff`. A note on standard error says when results depend on the processor.
"""

from __future__ import annotations

import argparse
import hashlib
from dataclasses import dataclass
from pathlib import Path

from sitl.lockstep import Lockstep
from swarmctl.config import load

CONFIGS = Path(__file__).parents[1] / "configs"
DIES_AT_US = 9_000_000  # on the way along the circle
UNTIL_US = 13_000_000  # every mission has begun by 10 s


@dataclass(frozen=True, slots=True)
class Flown:
    """A row of the table: the flight, and the agent that dies on the way."""

    config: str | None
    sets: tuple[str, ...] = ()
    dies: int | None = None


_GOALS = "mission.goto.goals_ned_m=[[1.0,0.3,-1.0],[0.0,0.0,-1.0],[-1.0,-0.3,-1.0]]"
FLIGHTS = {
    "circle": Flown("thesis_5_circle.toml"),
    "pid": Flown("thesis_4_pid_fast.toml"),
    "mpc": Flown("thesis_4_mpc_fast.toml"),
    "obstacle": Flown("thesis_6_obstacle.toml"),
    "swap": Flown("swap8.toml"),
    "swap-guaranteed": Flown("swap8.toml", ("separation.mode=guaranteed",)),
    "delay": Flown(None, ("bus.delay_ms=60", "bus.loss_01=0.2")),
    "dead-peer": Flown(None, dies=1),
    "goto": Flown(None, ("mission.kind=goto", _GOALS)),
    "x500": Flown("x500_circle.toml"),
    "arducopter": Flown("ardupilot_sitl.toml"),
    "dmpc3": Flown("improved_5_circle_dmpc3.toml"),
}


def truth_hash(flown: Flown) -> str:
    """Fly and return 16 hexadecimal digits of SHA-256 over every true state of its first seconds."""
    lockstep = Lockstep(load(CONFIGS / flown.config if flown.config else None, ("sitl.start=air", *flown.sets)))
    while lockstep.clock.now_us() < UNTIL_US:
        if flown.dies is not None and lockstep.clock.now_us() == DIES_AT_US:
            lockstep.kill(flown.dies)
        lockstep.step()
    return hashlib.sha256(lockstep.truth.tobytes()).hexdigest()[:16]


def main() -> None:
    """Fly what is requested and print a line each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", metavar="NAME,NAME", default=",".join(FLIGHTS), help=f"of {', '.join(FLIGHTS)}")
    names = parser.parse_args().only.split(",")
    for unknown in set(names) - set(FLIGHTS):
        parser.error(f"{unknown!r}: allowed: {', '.join(FLIGHTS)}")
    for name in names:
        print(f"{truth_hash(FLIGHTS[name])} {name}", flush=True)


if __name__ == "__main__":
    main()
