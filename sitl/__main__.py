"""`python -m sitl`: simulates N vehicles on loopback UDP in real time.

Vehicle i listens on 127.0.0.1:(local-port + i) and sends to 127.0.0.1:(port + i) until the first datagram arrives. From
then on it sends to that sender only, but obeys every sender, as PX4 does. With `--remote-ports` it obeys only those.
With `--gcs-port` each vehicle has a second link to a ground station there, from 127.0.0.1:(18570 + i). With
`--tcp-port` it serves one client on TCP (tcp-port + 10 i) instead, as ArduCopter's own simulator does.
"""

from __future__ import annotations

import argparse
import gc
import json
import math
import signal
import socket
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from sitl.plant.attitude import THESIS_GAINS
from swarmctl.errors import EXIT_OK, EXIT_USAGE, SwarmError

if TYPE_CHECKING:
    from sitl.realtime import LoopStatistics
    from sitl.world import SitlParams, SitlWorld
    from swarmctl.core.simulated import RealismParams
    from swarmctl.mavlink.transport import Transport


_SET_HELP = "wind, battery, rotors, faults as under [sitl] of a configuration, such as wind.turbulence_m_s=5"

GCS_LOCAL_PORT = 18570  # of the first vehicle, as in PX4


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


def _wind(text: str) -> tuple[float, float, float]:
    return _triple(text, "N,E,D in m/s")


def _spawns(text: str) -> list[tuple[float, float, float]]:
    return [_triple(part, '"x,y,z;x,y,z" in NED metres, one for each vehicle') for part in text.split(";")]


def _ports(text: str) -> list[int]:
    parse = _integer(1, 65535)
    return [parse(part) for part in text.split(",")]


def _parser() -> argparse.ArgumentParser:
    parser = _OneLineParser(
        prog="python -m sitl", description="PX4-like (or ArduCopter-like) multirotor simulator on loopback."
    )
    add = parser.add_argument
    add("--vehicles", type=_integer(1, 100), default=3, metavar="N")
    add(
        "--preset",
        choices=("thesis", "x500", "crazyflie", "arducopter"),
        default="thesis",
        help="airframe and attitude loop",
    )
    add("--attitude-gains", choices=tuple(THESIS_GAINS), default="swarm", help="attitude PIDs of the thesis airframe")
    add("--estimator", choices=("exact", "gps", "external"), default="exact", help="errors of the vehicles' estimates")
    add("--autopilot", choices=("px4", "arducopter"), default="px4", help="autopilot that the vehicles imitate")
    add("--spawn", type=_spawns, metavar='"x,y,z;..."', help="NED metres; default: a line along x, 1 m apart")
    add("--origin", type=_origin, default=(47.397742, 8.545594, 489.4), metavar="LAT,LON,ALT", help="shared origin")
    add("--port", type=_integer(1, 65535), default=14540, help="first vehicle sends here until it receives")
    add("--local-port", type=_integer(1, 65535), default=14580, help="first vehicle listens here")
    add("--local-fds", type=_ports, metavar="FD,...", help="inherited, bound UDP sockets instead, one for each vehicle")
    add("--gcs-port", type=_integer(0, 65535), default=0, help="second link of every vehicle to here; 0: none")
    add("--accept-bad-setpoints", action="store_true", help="NaN and zero quaternions do what they do to PX4 1.18")
    add("--remote-ports", type=_ports, default=[], metavar="P0,P1,..", help="fixed destinations instead of --port")
    add(
        "--tcp-port", type=_integer(1, 65535), metavar="P", help="serve TCP on P, P+10, .. instead of UDP: 5760 as SITL"
    )
    add("--seed", type=_integer(0, 2**31 - 1), default=1)
    add("--physics-hz", type=_integer(50, 1000), default=250)
    add("--mass-scale", type=_real(0.3, 1.9), default=1.0, help="true mass over the airframe's nominal one")
    add("--start", choices=("ground", "air"), default="ground", help="air: clamped at the spawn pose until OFFBOARD")
    add("--truth", type=Path, metavar="FILE", help="append true states, 50 Hz, raw TRUTH_DTYPE rows")
    add("--sysid-base", type=_integer(1, 255), default=1)
    add("--ekf-ready", type=_real(0, 60), default=1.0, metavar="S", help="armable this long after start; PX4 takes 4")
    add("--speed", type=_real(0.1, 100), default=1.0, metavar="X", help="simulated over wall time; timeouts stay wall")
    add("--lockstep", action="store_true", help="physics waits for a setpoint every 20 ms of each vehicle in OFFBOARD")
    add("--wind", dest="mean_wind", type=_wind, metavar="N,E,D", help="mean wind, m/s NED; see also --set")
    add("--turbulence", type=_real(0, 30), metavar="M/S", help="Dryden: wind at 6 m height; light is 7.7")
    add("--set", action="append", default=[], dest="sets", metavar="KEY=VALUE", help=_SET_HELP)
    add("--realism-json", metavar="JSON", help="all of wind, battery, rotors and faults, as a launch gives them")
    add("--control", type=Path, metavar="SOCKET", help="take faults here; see swarmctl fault")
    add("--events", type=Path, metavar="FILE", help="append faults as JSON lines")
    add("--stats", type=Path, metavar="FILE", help="write what the loop has done at the end, as JSON")
    add("--die-with-parent", action="store_true", help="be killed when the starting process ends (Linux)")
    return parser


def _joined(arguments: list[str]) -> list[str]:
    """Join `--spawn -1,0,0` to `--spawn=-1,0,0`: argparse takes a value that begins with a minus for an option."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] in ("--spawn", "--origin", "--wind"):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def main(arguments: list[str] | None = None) -> int:
    """Run the simulator and return the process exit code."""
    options = _parser().parse_args(_joined(sys.argv[1:] if arguments is None else arguments))
    if options.die_with_parent:
        from swarmctl.process_lifetime import die_with_parent

        die_with_parent()
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
        estimator=options.estimator,
        autopilot_kind=options.autopilot,
        realism=_realism(options),
        reject_bad_setpoints=not options.accept_bad_setpoints,
    )


def _realism(options: argparse.Namespace) -> RealismParams:
    """Return wind, battery, rotors and faults, parsed and refused as in the configuration of a run."""
    from swarmctl.core.simulated import RealismParams

    if options.realism_json:
        return RealismParams.model_validate_json(options.realism_json)
    sets = [f"wind.mean_ned_m_s={list(options.mean_wind)}"] if options.mean_wind else []
    sets += [f"wind.turbulence_m_s={options.turbulence!r}"] if options.turbulence is not None else []
    sets += options.sets
    if not sets:
        return RealismParams()
    from swarmctl.config import load

    known = RealismParams.model_fields
    strange = [f"set {item}: allowed: keys of {', '.join(known)}" for item in sets if _section(item) not in known]
    if strange:
        from swarmctl.errors import ConfigError

        raise ConfigError("sitl", strange)
    prefixed = [f"swarm.agents={options.vehicles}", *(f"sitl.{item}" for item in sets)]
    return load(None, prefixed).sitl.realism()


def _section(item: str) -> str:
    return item.partition("=")[0].partition(".")[0].strip()


def _run(options: argparse.Namespace) -> int:
    from sitl import realtime
    from sitl.fault_socket import ControlSocket
    from sitl.world import SitlWorld
    from swarmctl.errors import ConfigError
    from swarmctl.process_lifetime import StopRequest
    from swarmctl.telemetry.event_log import EventLog

    params = _params(options)
    count = params.vehicles
    if options.remote_ports and len(options.remote_ports) != count:
        given = ",".join(str(p) for p in options.remote_ports)
        raise ConfigError("sitl", [f"remote-ports = {given}: allowed: one port for each of {count} vehicles"])
    stop = StopRequest(signal.SIGINT, signal.SIGTERM)
    truth = realtime.TruthFile(options.truth) if options.truth else None
    links, places = _tcp_links(options) if options.tcp_port else _udp_links(options)
    gcs_links, gcs_place = _gcs_links(options)
    world = SitlWorld(params, links, gcs_links)
    if options.speed != 1.0:
        world.scale_timeouts(options.speed)
    if options.events:
        log = EventLog(options.events, "sitl")
        world.faults.on_event = lambda name, since_boot_us, fields: log.write(
            name, since_boot_us=since_boot_us, **fields
        )
    for i, place in enumerate(places):
        x, y, z = params.spawn_ned_m[i]
        print(f"vehicle sysid={params.sysid_base + i} {place} spawn={x:g},{y:g},{z:g}")
    if gcs_place:
        print(gcs_place)
    sys.stdout.flush()
    complaint = ""
    control = ControlSocket(options.control, options.die_with_parent) if options.control else None
    try:
        gc.freeze()  # the garbage collector need not traverse start-up objects in flight
        gate = realtime.Gate(world) if options.lockstep else None
        statistics = realtime.fly(world, stop, truth, speed=options.speed, control=control, gate=gate)
    finally:
        if control is not None:
            control.close()
        complaint = truth.close() if truth else ""
        for endpoint in (*world.endpoints, *world.gcs_endpoints):
            endpoint.transport.close()
    if options.stats:
        options.stats.write_text(json.dumps({"boot_us": world.boot_us, **asdict(statistics)}), encoding="utf-8")
    print("; ".join(filter(None, (_summary(world, statistics), complaint))), flush=True)
    return EXIT_OK


def _udp_links(options: argparse.Namespace) -> tuple[list[Transport], list[str]]:
    """Return the links of all vehicles, and their addresses."""
    from sitl import realtime
    from sitl.net.ports import OpenPort
    from swarmctl.errors import ConfigError
    from swarmctl.mavlink.latch import nobody
    from swarmctl.mavlink.transport import UdpTransport

    count = options.vehicles
    if options.local_fds and len(options.local_fds) != count:
        given = ",".join(str(fd) for fd in options.local_fds)
        raise ConfigError("sitl", [f"local-fds = {given}: allowed: one socket for each of {count} vehicles"])
    if options.local_fds:
        sockets, shift = [socket.socket(fileno=fd) for fd in options.local_fds], 0
    else:
        sockets, shift = realtime.bind_range(options.local_port, count)
    remotes = realtime.remote_ports(options.port, shift, count, options.remote_ports)
    if max(remotes) > realtime.MAX_PORT:
        raise ConfigError(
            "sitl", [f"port = {options.port}: allowed: up to {realtime.MAX_PORT - count - shift + 1} here"]
        )
    if shift:
        print(f"sitl: ports {options.local_port}.. are taken; shifted by {shift}")
    places = [f"local={s.getsockname()[1]} remote={r}" for s, r in zip(sockets, remotes, strict=True)]
    pairs = zip(sockets, remotes, strict=True)
    if options.remote_ports:  # given peers are the only ones: a stray datagram must not take a vehicle over
        return [UdpTransport(s, (realtime.HOST, r), nobody) for s, r in pairs], places
    return [OpenPort(s, (realtime.HOST, r)) for s, r in pairs], places


def _gcs_links(options: argparse.Namespace) -> tuple[list[Transport], str]:
    """Return the links to a ground station, and their addresses; none without a port for it."""
    from sitl import realtime
    from sitl.net.ports import OpenPort
    from swarmctl.errors import ConfigError

    if not options.gcs_port:
        return [], ""
    if options.autopilot != "px4":
        raise ConfigError("sitl", [f"gcs-port = {options.gcs_port}: allowed: with --autopilot px4 only"])
    sockets, _ = realtime.bind_range(GCS_LOCAL_PORT, options.vehicles)
    first, last = sockets[0].getsockname()[1], sockets[-1].getsockname()[1]
    place = f"ground station link: local={first}..{last} remote={options.gcs_port}"
    return [OpenPort(s, (realtime.HOST, options.gcs_port)) for s in sockets], place


def _tcp_links(options: argparse.Namespace) -> tuple[list[Transport], list[str]]:
    from sitl.net.tcp import serve_tcp
    from sitl.realtime import HOST

    servers = serve_tcp(HOST, options.tcp_port, options.vehicles)
    return list(servers), [f"tcp={server.port}" for server in servers]


def _summary(world: SitlWorld, statistics: LoopStatistics) -> str:
    seconds = statistics.steps / world.params.physics_hz
    ignored = sum(sum(e.ignored.values()) for e in world.endpoints)
    refused = sum(sum(p.refused.values()) for p in world.autopilots)
    return (
        f"sitl: {seconds:.1f} s in {statistics.steps} steps, {statistics.late} late, {statistics.stalls} stalls "
        f"({statistics.lost_us / 1e6:.1f} s), {ignored} frames ignored, {refused} setpoints refused"
    )


if __name__ == "__main__":
    sys.exit(main())
