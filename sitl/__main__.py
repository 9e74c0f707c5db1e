"""`python -m sitl`: N PX4-like vehicles on loopback UDP, in real time. Arguments in, exit code out.

Vehicle i listens on 127.0.0.1:(local-port + i) and sends to 127.0.0.1:(port + i) until the first datagram arrives; from
then on it talks to, and obeys, that sender only.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from sitl.attitude import THESIS_GAINS
from swarmctl.errors import EXIT_OK, EXIT_USAGE, SwarmError

if TYPE_CHECKING:
    from sitl.realtime import Tally
    from sitl.world import SitlParams, SitlWorld


class _OneLineParser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        self.exit(EXIT_USAGE, f"sitl: {message}\n")


def _integer(low: int, high: int) -> Callable[[str], int]:
    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = low - 1
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r}: allowed: an integer {low} to {high}")
        return value

    return parse


def _real(low: float, high: float) -> Callable[[str], float]:
    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r}: allowed: a number {low:g} to {high:g}")
        return value

    return parse


def _triple(text: str, form: str) -> tuple[float, float, float]:
    try:
        a, b, c = (float(part) for part in text.split(","))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r}: allowed: {form}") from error
    if not all(math.isfinite(v) for v in (a, b, c)):
        raise argparse.ArgumentTypeError(f"{text!r}: allowed: finite numbers, as {form}")
    return a, b, c


def _origin(text: str) -> tuple[float, float, float]:
    return _triple(text, "LAT,LON,ALT in degrees and metres")


def _spawns(text: str) -> list[tuple[float, float, float]]:
    return [_triple(part, '"x,y,z;x,y,z" in NED metres, one for each vehicle') for part in text.split(";")]


def _ports(text: str) -> list[int]:
    parse = _integer(1, 65535)
    return [parse(part) for part in text.split(",")]


def _parser() -> argparse.ArgumentParser:
    parser = _OneLineParser(prog="python -m sitl", description="PX4-like multirotor simulator on loopback UDP.")
    add = parser.add_argument
    add("--vehicles", type=_integer(1, 100), default=3, metavar="N")
    add("--preset", choices=("thesis", "x500"), default="thesis", help="airframe and attitude loop")
    add("--attitude-gains", choices=tuple(THESIS_GAINS), default="swarm", help="attitude PIDs of the thesis airframe")
    add("--spawn", type=_spawns, metavar='"x,y,z;..."', help="NED metres; default: a line along x, 1 m apart")
    add("--origin", type=_origin, default=(47.397742, 8.545594, 489.4), metavar="LAT,LON,ALT", help="shared origin")
    add("--port", type=_integer(1, 65535), default=14540, help="first vehicle sends here until somebody talks to it")
    add("--local-port", type=_integer(1, 65535), default=14580, help="first vehicle listens here")
    add("--remote-ports", type=_ports, default=[], metavar="P0,P1,..", help="fixed destinations instead of --port")
    add("--seed", type=_integer(0, 2**31 - 1), default=1)
    add("--physics-hz", type=_integer(50, 1000), default=250)
    add("--mass-scale", type=_real(0.3, 1.9), default=1.0, help="true mass over the airframe's nominal one")
    add("--start", choices=("ground", "air"), default="ground", help="air: clamped at the spawn pose until OFFBOARD")
    add("--truth", type=Path, metavar="FILE", help="append true states, 50 Hz, raw TRUTH_DTYPE rows")
    add("--sysid-base", type=_integer(1, 255), default=1)
    add("--ekf-ready", type=_real(0, 60), default=1.0, metavar="S", help="armable this long after start; PX4 takes 4")
    add("--die-with-parent", action="store_true", help="be killed when the starting process ends (Linux)")
    return parser


def _joined(arguments: list[str]) -> list[str]:
    """`--spawn -1,0,0` as `--spawn=-1,0,0`: argparse would take a value that begins with a minus for an option."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] in ("--spawn", "--origin"):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def main(arguments: list[str] | None = None) -> int:
    """Run the simulator; returns the process exit code."""
    options = _parser().parse_args(_joined(sys.argv[1:] if arguments is None else arguments))
    if options.die_with_parent:
        from swarmctl.lifeline import die_with_parent

        die_with_parent()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: matrices here are far too small to share out
    try:
        return _run(options)
    except SwarmError as error:
        print("sitl:", "; ".join(str(error).replace("sitl: ", "").splitlines()), file=sys.stderr)
        return error.exit_code


def _params(options: argparse.Namespace) -> SitlParams:
    import numpy as np

    from sitl.world import SitlParams, line_of_spawns

    spawns = np.array(options.spawn) if options.spawn else line_of_spawns(options.vehicles)
    lat_deg, lon_deg, alt_m = options.origin
    return SitlParams(
        vehicles=options.vehicles,
        spawn_ned_m=spawns,
        preset=options.preset,
        attitude_gains=options.attitude_gains,
        origin_lat_deg=lat_deg,
        origin_lon_deg=lon_deg,
        origin_alt_m=alt_m,
        seed=options.seed,
        physics_hz=options.physics_hz,
        mass_scale=options.mass_scale,
        start=options.start,
        ekf_ready_s=options.ekf_ready,
        sysid_base=options.sysid_base,
    )


def _run(options: argparse.Namespace) -> int:
    from sitl import realtime
    from sitl.world import SitlWorld
    from swarmctl.errors import ConfigError
    from swarmctl.links.transport import UdpTransport

    params = _params(options)
    count = params.vehicles
    if options.remote_ports and len(options.remote_ports) != count:
        given = ",".join(str(p) for p in options.remote_ports)
        raise ConfigError("sitl", [f"remote-ports = {given}: allowed: one port for each of {count} vehicles"])
    stop = realtime.StopRequest()
    stop.install()
    truth = realtime.TruthFile(options.truth) if options.truth else None
    sockets, shift = realtime.bind_range(options.local_port, count)
    remotes = realtime.remote_ports(options.port, shift, count, options.remote_ports)
    if max(remotes) > realtime.MAX_PORT:
        raise ConfigError(
            "sitl", [f"port = {options.port}: allowed: up to {realtime.MAX_PORT - count - shift + 1} here"]
        )
    latch = not options.remote_ports  # given peers are the only ones: a stray datagram must not take a vehicle over
    pairs = zip(sockets, remotes, strict=True)
    world = SitlWorld(params, [UdpTransport(s, (realtime.HOST, r), latch=latch) for s, r in pairs])
    if shift:
        print(f"sitl: ports {options.local_port}.. are taken; shifted by {shift}")
    for i, (sock, remote) in enumerate(zip(sockets, remotes, strict=True)):
        x, y, z = params.spawn_ned_m[i]
        local = sock.getsockname()[1]
        print(f"vehicle sysid={params.sysid_base + i} local={local} remote={remote} spawn={x:g},{y:g},{z:g}")
    sys.stdout.flush()
    complaint = ""
    try:
        tally = realtime.fly(world, stop, truth)
    finally:
        complaint = truth.close() if truth else ""
        for endpoint in world.endpoints:
            endpoint.transport.close()
    print("; ".join(filter(None, (_summary(world, tally), complaint))), flush=True)
    return EXIT_OK


def _summary(world: SitlWorld, tally: Tally) -> str:
    seconds = tally.steps / world.params.physics_hz
    ignored = sum(sum(e.ignored.values()) for e in world.endpoints)
    refused = sum(sum(p.refused.values()) for p in world.autopilots)
    return (
        f"sitl: {seconds:.1f} s in {tally.steps} steps, {tally.late} late, {tally.stalls} stalls "
        f"({tally.lost_us / 1e6:.1f} s), {ignored} frames ignored, {refused} setpoints refused"
    )


if __name__ == "__main__":
    sys.exit(main())
