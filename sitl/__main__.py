"""`python -m sitl`: simulates N vehicles on loopback UDP in real time.

Vehicle i listens on 127.0.0.1:(local-port + i) and sends to 127.0.0.1:(port + i) until the first datagram arrives. From
then on it sends to that sender only, but obeys every sender, as PX4 does. With `--remote-ports` it obeys only those.
With `--gcs-port` each vehicle has a second link to a ground station there, from 127.0.0.1:(18570 + i). With
`--tcp-port` it serves one client on TCP (tcp-port + 10 i) instead, as ArduCopter's own simulator does.

Every single-valued key of `SimulatorConfig` is an option; `--set` reaches the others. Both are read and refused as
`--set` of a run's configuration is.
"""

from __future__ import annotations

import argparse
import gc
import json
import signal
import socket
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, get_args

from swarmctl.configuration.problems import validated
from swarmctl.configuration.source import override
from swarmctl.errors import EXIT_OK, EXIT_USAGE, ConfigError, SwarmError
from swarmctl.simulator_config import SimulatorConfig

if TYPE_CHECKING:
    from sitl.realtime import LoopStatistics
    from sitl.world import SitlWorld
    from swarmctl.mavlink.transport import Transport


_SET_HELP = "a key of [sitl] of a configuration, such as wind.turbulence_m_s=5, or spawn_ned_m=[[0, 1, 0]]"
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


def _ports(text: str) -> list[int]:
    parse = _integer(1, 65535)
    return [parse(part) for part in text.split(",")]


def _parser() -> argparse.ArgumentParser:
    parser = _OneLineParser(
        prog="python -m sitl", description="PX4-like (or ArduCopter-like) multirotor simulator on loopback."
    )
    add = parser.add_argument
    for key in _option_keys():
        add("--" + key.replace("_", "-"), dest=f"key.{key}", metavar="X", help=_option_help(key))
    add("--set", action="append", default=[], dest="sets", metavar="KEY=VALUE", help=_SET_HELP)
    add("--config-json", default="{}", metavar="JSON", help="all keys, as a launch gives them")
    add("--port", type=_integer(1, 65535), default=14540, help="first vehicle sends here until it receives")
    add("--local-port", type=_integer(1, 65535), default=14580, help="first vehicle listens here")
    add("--local-fds", type=_ports, metavar="FD,...", help="inherited, bound UDP sockets instead, one for each vehicle")
    add("--remote-ports", type=_ports, default=[], metavar="P0,P1,..", help="fixed destinations instead of --port")
    add(
        "--tcp-port", type=_integer(1, 65535), metavar="P", help="serve TCP on P, P+10, .. instead of UDP: 5760 as SITL"
    )
    add("--truth", type=Path, metavar="FILE", help="append true states, 50 Hz, raw TRUTH_DTYPE rows")
    add("--lockstep", action="store_true", help="physics waits for a setpoint every 20 ms of each vehicle in OFFBOARD")
    add("--control", type=Path, metavar="SOCKET", help="take faults here; see swarmctl fault")
    add("--events", type=Path, metavar="FILE", help="append faults as JSON lines")
    add("--stats", type=Path, metavar="FILE", help="write what the loop has done at the end, as JSON")
    realtime_help = "be scheduled before other programs, where that is permitted"
    add("--realtime", action=argparse.BooleanOptionalAction, default=True, help=realtime_help)
    add("--die-with-parent", action="store_true", help="be killed when the starting process ends (Linux)")
    return parser


def _option_keys() -> list[str]:
    """Return the keys of a simulation that have one value."""
    fields = SimulatorConfig.model_fields
    return [key for key, field in fields.items() if isinstance(field.default, (bool, int, float, str))]


def _option_help(key: str) -> str:
    field = SimulatorConfig.model_fields[key]
    allowed = " | ".join(map(str, get_args(field.annotation)))
    return f"{allowed + '; ' if allowed else ''}default {str(field.default).lower()}"


def main(arguments: list[str] | None = None) -> int:
    """Run the simulator and return the process exit code."""
    options = _parser().parse_args(arguments)
    if options.die_with_parent:
        from swarmctl.process_lifetime import die_with_parent

        die_with_parent()
    try:
        return _run(options)
    except SwarmError as error:
        print("sitl:", "; ".join(str(error).replace("sitl: ", "").splitlines()), file=sys.stderr)
        return error.exit_code


def _config(options: argparse.Namespace) -> SimulatorConfig:
    """Return the simulation that the command line describes.

    Raises:
        ConfigError: it is impossible; lists all problems.
    """
    try:
        tree: dict[str, Any] = json.loads(options.config_json)
    except ValueError as error:
        raise ConfigError("sitl", [f"config-json: {error}"]) from error
    given = {key: getattr(options, f"key.{key}") for key in _option_keys()}
    items = [f"{key}={text}" for key, text in given.items() if text is not None]
    problems = [problem for item in (*items, *options.sets) for problem in override(tree, item)]
    if problems:
        raise ConfigError("sitl", problems)
    return validated(SimulatorConfig, tree, "sitl")


def _run(options: argparse.Namespace) -> int:
    from sitl import realtime
    from sitl.fault_socket import ControlSocket
    from sitl.world import SitlWorld
    from swarmctl.process_lifetime import StopRequest
    from swarmctl.process_priority import request_realtime
    from swarmctl.signing_keys import read_keys
    from swarmctl.telemetry.recording.event_log import EventLog

    config = _config(options)
    count = config.vehicles
    if options.remote_ports and len(options.remote_ports) != count:
        given = ",".join(str(p) for p in options.remote_ports)
        raise ConfigError("sitl", [f"remote-ports = {given}: allowed: one port for each of {count} vehicles"])
    stop = StopRequest(signal.SIGINT, signal.SIGTERM)
    truth = realtime.TruthFile(options.truth) if options.truth else None
    links, places = _tcp_links(options.tcp_port, count) if options.tcp_port else _udp_links(options, count)
    gcs_links, gcs_place = _gcs_links(config)
    world = SitlWorld(config, links, gcs_links, read_keys(config.signing_keys, count))
    if config.speed != 1.0:
        world.scale_timeouts(config.speed)
    if options.events:
        log = EventLog(options.events, "sitl")
        world.faults.on_event = lambda name, since_boot_us, fields: log.write(
            name, since_boot_us=since_boot_us, **fields
        )
    if options.realtime and not options.lockstep:
        request_realtime()
    for i, (place, (x, y, z)) in enumerate(zip(places, config.spawns_ned_m(), strict=True)):
        print(f"vehicle sysid={config.sysid_base + i} {place} spawn={x:g},{y:g},{z:g}")
    if gcs_place:
        print(gcs_place)
    sys.stdout.flush()
    complaint = ""
    control = ControlSocket(options.control, options.die_with_parent) if options.control else None
    try:
        gc.freeze()  # the garbage collector need not traverse start-up objects in flight
        gate = realtime.Gate(world) if options.lockstep else None
        statistics = realtime.fly(world, stop, truth, speed=config.speed, control=control, gate=gate)
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


def _udp_links(options: argparse.Namespace, count: int) -> tuple[list[Transport], list[str]]:
    """Return the links of all vehicles, and their addresses."""
    from sitl import realtime
    from sitl.net.ports import OpenPort
    from swarmctl.mavlink.latch import nobody
    from swarmctl.mavlink.transport import UdpTransport

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


def _gcs_links(config: SimulatorConfig) -> tuple[list[Transport], str]:
    """Return the links to a ground station, and their addresses; none without a port for it."""
    from sitl import realtime
    from sitl.autopilot_kinds import AUTOPILOT_KINDS
    from sitl.net.ports import OpenPort

    if not config.gcs_port:
        return [], ""
    if not AUTOPILOT_KINDS[config.autopilot_kind].has_gcs_link:
        allowed = " or ".join(name for name, kind in AUTOPILOT_KINDS.items() if kind.has_gcs_link)
        raise ConfigError("sitl", [f"gcs_port = {config.gcs_port}: allowed: with autopilot_kind = {allowed} only"])
    sockets, _ = realtime.bind_range(GCS_LOCAL_PORT, config.vehicles)
    first, last = sockets[0].getsockname()[1], sockets[-1].getsockname()[1]
    place = f"ground station link: local={first}..{last} remote={config.gcs_port}"
    return [OpenPort(s, (realtime.HOST, config.gcs_port)) for s in sockets], place


def _tcp_links(port: int, count: int) -> tuple[list[Transport], list[str]]:
    from sitl.net.tcp import serve_tcp
    from sitl.realtime import HOST

    servers = serve_tcp(HOST, port, count)
    return list(servers), [f"tcp={server.port}" for server in servers]


def _summary(world: SitlWorld, statistics: LoopStatistics) -> str:
    seconds = statistics.steps / world.params.physics_hz
    ignored = sum(sum(e.ignored.values()) for e in world.endpoints) + sum(s.refused.total() for s in world.signing)
    refused = sum(sum(p.refused.values()) for p in world.autopilots)
    return (
        f"sitl: {seconds:.1f} s in {statistics.steps} steps, {statistics.late} late, {statistics.stalls} stalls "
        f"({statistics.lost_us / 1e6:.1f} s), {ignored} frames ignored, {refused} setpoints refused"
    )


if __name__ == "__main__":
    sys.exit(main())
