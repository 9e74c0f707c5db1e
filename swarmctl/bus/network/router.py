"""The router process of the bus: connects the clients on one computer, and links to the routers of other computers.

Clients reach it on a Unix socket in a private directory. Other routers reach it over QUIC, which is UDP, because a host
that vanishes from a TCP link freezes the data of all the others for 10 s (zenoh #1101). Both ends of such a link prove
by certificates of the swarm's own authority that they belong to it; there is no link without, and each may bring only
what the computer of this certificate may say (`swarmctl.bus.network.access`). Messages that may be lost do not take
these links: each is a datagram (`swarmctl.bus.network.datagram_links`).

`python -m swarmctl.bus.network.router unixsock-stream/DIR/bus.sock` is the router of a launch on one computer.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import zenoh

from swarmctl.bus.network.roster import identity_of_json
from swarmctl.bus.network.router_links import RouterLinks, link_endpoint
from swarmctl.bus.zenoh.client import CLOSE_DEADLINE_S, COMMON_SETTINGS, SCHEME, close_within, open_session, socket_file
from swarmctl.errors import EXIT_OK, StartError, SwarmError
from swarmctl.process_lifetime import die_with_parent, remove_socket
from swarmctl.process_priority import request_realtime

if TYPE_CHECKING:
    from swarmctl.bus.network.datagram_links import DatagramLinks


def run_router(endpoint: str, links: RouterLinks | None = None, *, realtime: bool = False) -> object:
    """Run the router until SIGTERM, which the caller has blocked, then remove the socket and its directory.

    Standard output ends with the line that it is ready: Zenoh writes its errors there too, and blocks where they are
    many and nobody reads them. They go to standard error.

    Args:
        endpoint: a Unix socket in a private directory.
        links: links to other computers; None: there are none.
        realtime: ask to be scheduled before other programs.

    Returns:
        What the caller keeps until the process ends: to destroy it waits for what closing it has waited for in vain.

    Raises:
        StartError: the endpoint is not a Unix socket in a private directory, another router holds it, or an address
            can't be used.
        ConfigError: an identity can't be used.
    """
    socket_path = _private_socket(endpoint)
    zenoh.init_log_from_env_or("error")
    endpoints = [endpoint, *([link_endpoint(links.listen)] if links is not None and links.listen else [])]
    settings = COMMON_SETTINGS | {"mode": "router", "listen/endpoints": endpoints, "scouting/delay": 0}
    link_settings, carry_datagrams = _linked(links)
    try:
        session = open_session(settings | link_settings)
    except zenoh.ZError as error:
        where = " and ".join(repr(place) for place in endpoints)
        raise StartError(f"bus endpoint {where}: can't be opened: {error}. Is another router using it?") from error
    datagrams = carry_datagrams(session)
    if realtime:
        request_realtime()
    print(f"router ready {endpoint}", flush=True)
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    signal.sigwait({signal.SIGTERM})
    if datagrams is None:
        close_within(session, CLOSE_DEADLINE_S)
    else:
        datagrams.close()
    remove_socket(socket_path)
    return session, datagrams


def _linked(links: RouterLinks | None) -> tuple[dict[str, Any], Callable[[Any], DatagramLinks | None]]:
    """Return what Zenoh is told of links to other computers, and what a session is given to for datagrams to them."""
    if links is None:
        return {}, lambda _: None
    # They load cryptography, which one computer alone does not need
    from swarmctl.bus.network.datagram_links import DatagramLinks, bind_datagrams
    from swarmctl.bus.network.keyring import load_keyring

    identity = links.identity
    keyring, sock = load_keyring(identity), bind_datagrams(identity)
    settings = links.settings(keyring.common_names)
    return settings, lambda session: DatagramLinks(session, identity, keyring.keys, sock)


def _private_socket(endpoint: str) -> Path:
    path = socket_file(endpoint)
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    if path.parent.stat().st_mode & 0o077:
        raise StartError(
            f"bus endpoint {endpoint!r}: {path.parent} is open to other users, who could fly the swarm; "
            "use a directory of mode 0700"
        )
    return path


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m swarmctl.bus.network.router", description="Router of one swarm's bus on one computer."
    )
    parser.add_argument("endpoint", metavar="ENDPOINT", help=f"{SCHEME}/DIR/bus.sock")
    parser.add_argument("--identity", metavar="JSON", help="own identity and those of others, an `OwnIdentity`")
    parser.add_argument("--listen", default="", metavar="ADDRESS:PORT", help="where other routers reach this one")
    parser.add_argument("--connect", action="append", default=[], metavar="ADDRESS:PORT", help="another router")
    parser.add_argument("--die-with-parent", action="store_true", help="end when the parent process ends")
    parser.add_argument(
        "--realtime", action=argparse.BooleanOptionalAction, default=False, help="be scheduled before other programs"
    )
    return parser


def main() -> NoReturn:
    """Run the router process from the command line, and end the process."""
    parser = _parser()
    options = parser.parse_args()
    links = None
    if options.identity is not None:
        links = RouterLinks(
            identity=identity_of_json(options.identity), listen=options.listen, connect=tuple(options.connect)
        )
    elif options.listen or options.connect:
        parser.error("--listen and --connect need --identity")
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})  # for sigwait; zenoh's threads inherit the mask
    if options.die_with_parent:
        die_with_parent(signal.SIGTERM)
    code = EXIT_OK
    try:
        _kept = run_router(options.endpoint, links, realtime=options.realtime)
    except SwarmError as error:
        print(error, file=sys.stderr)
        code = error.exit_code
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # threads of Zenoh can keep an interpreter from ending: one router of some hundreds did not


if __name__ == "__main__":
    main()
