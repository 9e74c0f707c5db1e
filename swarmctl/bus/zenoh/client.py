"""Opens and closes clients of the router (`swarmctl.bus.network.router`), and says where it is."""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import zenoh

from swarmctl.errors import ConfigError, StartError

SCHEME = "unixsock-stream/"
NO_BUS = "none"  # endpoint of an agent without a bus
CONNECT_TIMEOUT_MS = 10_000
CLOSE_DEADLINE_S = 2.0
THREADS = "bus-"  # how names of threads begin that open and close sessions
_MAX_MESSAGE_BYTES = 1 << 20
_LINK_OPEN_TIMEOUT_MS = 5000  # of links between routers: one that was cut is back 0.9 s after (2.0 s: 0.8, 11 s: 3.1)
# A client waits for longer than the router does (accept_timeout, 10 s), because its own time limit may strike when
# half of the opening is done: then it sends and is kept alive, but never reads (Zenoh 1.10.2). A client that got no
# processor for 2 s, as in a launch on a machine under load, was deaf for good.
_CLIENT_OPEN_TIMEOUT_MS = 60_000
_MAX_SOCKET_PATH = 100  # sun_path is 108 bytes

COMMON_SETTINGS: dict[str, Any] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "transport/unicast/open_timeout": _LINK_OPEN_TIMEOUT_MS,
    "transport/link/rx/max_message_size": _MAX_MESSAGE_BYTES,
    "transport/shared_memory/enabled": False,
}


def socket_file(endpoint: str) -> Path:
    """Return the path of a Unix socket endpoint.

    Raises:
        ConfigError: the endpoint is of another kind.
        StartError: its path is too long for the kernel, as in a long TMPDIR.
    """
    path = endpoint.removeprefix(SCHEME)
    if path == endpoint or not path.startswith("/"):
        raise ConfigError(f"bus endpoint {endpoint!r}", [f"is of another kind; use {SCHEME}/ABSOLUTE/PATH"])
    if len(path.encode()) > _MAX_SOCKET_PATH:
        raise StartError(
            f"bus endpoint {endpoint!r}: path longer than {_MAX_SOCKET_PATH} bytes; set TMPDIR to a shorter directory"
        )
    return Path(path)


def open_client(endpoint: str, lease_ms: int, timeout_ms: int) -> Any:
    settings = COMMON_SETTINGS | {
        "mode": "client",
        "transport/unicast/open_timeout": _CLIENT_OPEN_TIMEOUT_MS,
        "connect/endpoints": [endpoint],
        "connect/timeout_ms": timeout_ms,
        "connect/exit_on_failure": True,
        "connect/retry": {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 2},
        "transport/link/tx/lease": lease_ms,
    }
    try:
        return open_session(settings)
    except zenoh.ZError as error:
        raise StartError(
            f"bus endpoint {endpoint!r}: no router answers within {timeout_ms / 1000:.1f} s. "
            f"Start one with: python -m swarmctl.bus.network.router {endpoint}"
        ) from error


def open_session(settings: Mapping[str, Any]) -> Any:
    """Open a session of Zenoh with these settings.

    Raises:
        zenoh.ZError: it can't be opened.
    """
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


def close_session(session: Any) -> None:
    """Close a session, however long that takes."""
    with contextlib.suppress(zenoh.ZError):
        session.close()


def is_blocked() -> bool:
    """Return whether a thread of this process still opens or closes a session, as without a router.

    When the interpreter ends, Python unwinds such a thread when it returns. Zenoh's frames abort the process then:
    a launch whose router was lost ended with -6.
    """
    return any(thread.name.startswith(THREADS) for thread in threading.enumerate())


def close_within(session: Any, deadline_s: float) -> None:
    """Close a session; give up after the deadline, since a link without its other end can block."""
    run_within(partial(close_session, session), deadline_s)


def run_within(leave: Callable[[], None], deadline_s: float) -> None:
    """Do what may have to wait for the other end of a link; go on without it after the deadline."""
    leaving = threading.Thread(target=leave, name=f"{THREADS}close", daemon=True)
    leaving.start()
    leaving.join(deadline_s)
